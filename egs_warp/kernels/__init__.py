"""All Warp kernels and device functions, by package. They import only warp, ``precision`` and each other.

Input: Warp arrays. Output: Warp arrays with the quantities of the paper's equations. Parameters are grouped by
comments: constant data (Model), inputs (In), workspaces (Scratch) and outputs (Out). A parameter ``first_row`` or
``first`` is the index of the element that the first thread computes.
"""
