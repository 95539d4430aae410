"""egs_warp: still objects in 3D Gaussian Splatting captures come to life (EnliveningGS, CVPR 2025) in Warp kernels."""

__version__ = "0.1.0"
