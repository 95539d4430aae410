"""Kernels of ``egs_warp.render``."""
