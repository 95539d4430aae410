"""Kernels of ``egs_warp.assets``."""
