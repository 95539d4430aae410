"""Every Warp kernel and device function of the package, by room; imports only warp, ``precision`` and each other.

In: Warp arrays. Out: Warp arrays, of whatever the paper's equations say of each Gaussian, element, point or pixel.
"""
