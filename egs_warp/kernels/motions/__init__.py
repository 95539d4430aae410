"""Kernels of ``motions``."""
