"""All Warp kernels and device functions, by package of their host code. They import only warp, ``precision`` and each
other.

Input: Warp arrays. Output: Warp arrays with the quantities of the paper's equations. One thread or block computes each
element.
"""
