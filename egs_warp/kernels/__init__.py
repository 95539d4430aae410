"""Every Warp kernel and device function, by package of the host code; imports only warp, ``precision`` and each other.

Input: Warp arrays. Output: Warp arrays: the quantities of the paper's equations, one thread or block for each element.
"""
