"""Kernels of ``egs_warp.deformation``."""
