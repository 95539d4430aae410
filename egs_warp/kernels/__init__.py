"""Every Warp kernel and device function of the package; imports only warp, ``precision`` and each other."""
