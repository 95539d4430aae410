"""Kernels of ``egs_warp.lighting``."""
