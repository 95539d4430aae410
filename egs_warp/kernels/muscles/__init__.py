"""Kernels of ``egs_warp.muscles``."""
