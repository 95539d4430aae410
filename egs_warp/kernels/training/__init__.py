"""Kernels of ``egs_warp.training``."""
