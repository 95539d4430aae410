"""Types that all packages share: Gaussian clouds, cameras, planes, tetrahedral meshes, frames (section 3.1).

Input: arrays. Output: frozen records of arrays, with shapes and units under each field. This package reads no files and
launches no kernels.
"""
