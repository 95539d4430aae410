"""Tile-based Gaussian splatting in Warp kernels: ``render``; and pictures and videos on disk."""

from egs_warp.render.compositing import RenderedImage
from egs_warp.render.rasteriser import render, render_views

__all__ = ["RenderedImage", "render", "render_views"]
