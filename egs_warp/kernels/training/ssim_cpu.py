"""Kernels of SSIM for a CPU: sixteen floats, the largest vector register, per thread."""

from egs_warp.kernels.training.ssim import ssim_kernels

KERNELS = ssim_kernels(__name__, 16)
