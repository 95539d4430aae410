"""All Warp kernels and device functions, by package of their host code. Imports: warp, ``precision`` and each other.

Input: Warp arrays. Output: Warp arrays with the quantities of the paper's equations, computed by one thread or block
for each element.
"""
