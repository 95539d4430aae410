"""Kernels of ``egs_warp.segmentation``."""
