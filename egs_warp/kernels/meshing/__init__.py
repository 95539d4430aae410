"""Kernels of ``egs_warp.meshing``."""
