"""Tile-based Gaussian splatting in Warp kernels: ``render``; and pictures and videos on disk."""

from egs_warp.render.compositing import RenderedImage
from egs_warp.render.rasteriser import render, render_views
from egs_warp.render.video import VideoWriter, contact_sheet, write_png

__all__ = ["RenderedImage", "VideoWriter", "contact_sheet", "render", "render_views", "write_png"]
