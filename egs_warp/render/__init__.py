"""Tile-based Gaussian splatting (section 3.1; Kerbl et al. 2023): projection, tiles, compositing, and its gradients.

Input: a cloud and a camera. Output: colour, alpha and depth; ``autograd`` adds gradients for PyTorch.
"""

from egs_warp.render.compositing import RenderedImage
from egs_warp.render.rasteriser import render_gaussians, render_views

__all__ = ["RenderedImage", "render_gaussians", "render_views"]
