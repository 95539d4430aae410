"""Kernels of the lighting."""
