"""Types that all packages share: Gaussian clouds, cameras, planes, tetrahedral meshes, frames (section 3.1).

Input: arrays. Output: frozen records of them, with shapes and units under each field. Nothing here reads a file or
launches a kernel.
"""
