"""Kernels of ``egs_warp.fem``."""
