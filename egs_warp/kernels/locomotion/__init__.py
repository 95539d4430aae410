"""Kernels of ``egs_warp.locomotion``."""
