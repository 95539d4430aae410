"""Kernels of ``egs_warp.inpainting``."""
