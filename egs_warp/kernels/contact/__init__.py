"""Kernels of ``egs_warp.contact``."""
