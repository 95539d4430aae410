"""Kernels of SSIM for a CPU: sixteen floats per thread, as many as the largest vector registers contain."""

from egs_warp.kernels.training.ssim import ssim_kernels

KERNELS = ssim_kernels(__name__, 16)
