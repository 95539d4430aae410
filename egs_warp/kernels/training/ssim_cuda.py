"""Kernels of SSIM for a GPU: one float per thread."""

from egs_warp.kernels.training.ssim import ssim_kernels

KERNELS = ssim_kernels(__name__, 1)
