"""All Warp kernels and device functions, by package. They import only warp, ``precision`` and each other.

Input: Warp arrays. Output: Warp arrays with the quantities of the paper's equations. Comments group the parameters of a
kernel into constant data (Model), inputs (In), workspaces (Scratch) and outputs (Out).
"""
