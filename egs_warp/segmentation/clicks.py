"""Clicks on an object and beside it: what each one hits, and the cut between the one and the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.votes import MaskedView, blending_votes

_RADIUS = 0.004
"""Of the picture's longer side: so far about a click counts as clicked."""
_HIT = 0.1
"""Of the largest blending weight under a click: what shows less there was not meant."""
_DEEP = 0.03
"""Of the distance: what is so far before or behind the surface that is clicked on is another."""
_SURE = 0.5
"""Leaning by nearness from which a Gaussian's colour is one of its side's."""
_ALIKE = 8
"""Nearest colours that tell how often a side has a colour."""
_BY_COLOUR = 0.5
"""Of the leaning by nearness: the most that colours can say."""
_ISLAND = 0.1
"""Of what is kept: a piece without a click of its own goes where it is smaller than this."""


@dataclass(frozen=True)
class Click:
    """One click, and what it hits."""

    point: np.ndarray
    """(3,) where its ray meets the capture, scene units."""
    hits: np.ndarray
    """(k,) int: Gaussians that paint what is clicked on."""
    inside: bool = True
    """Whether the object is clicked on; else what is not to go along."""


def click_at(cloud: GaussianCloud, camera: Camera, u: float, v: float, *, inside: bool = True) -> Click | None:
    """What pixel (``u``, ``v``), from the top left corner of ``camera``'s picture, hits; None where it shows nothing.

    Only a window about the click is drawn. What it shows is as far away as half of the light says, and hits are what
    paints it there: not what shines through.
    """
    reach = max(1, round(_RADIUS * max(camera.width, camera.height)))
    left, top, side = int(u) - reach, int(v) - reach, 2 * reach + 1
    window = replace(camera, width=side, height=side, cx=camera.cx - left, cy=camera.cy - top)
    image = render_gaussians(cloud, window, geometry=True)
    assert image.median_depth is not None
    depth = float(image.median_depth.numpy()[reach, reach])
    if image.alpha.numpy()[reach, reach] < 0.5 or depth <= 0.0:
        return None
    across, down = np.meshgrid(np.arange(side) - reach, np.arange(side) - reach)
    disc = across**2 + down**2 <= reach**2
    weights = blending_votes(cloud, [MaskedView(window, disc, "click")]).inside
    depths = cloud.means.numpy().astype(np.float64) @ camera.rotation[2] + camera.translation[2]
    hits = (np.abs(depths - depth) < _DEEP * depth) & (weights > 0.0)
    hits &= weights > _HIT * weights[hits].max(initial=0.0)
    return Click(camera.centre + depth * camera_rays(window)[reach, reach], np.flatnonzero(hits), inside)


def hits_among(nodes: np.ndarray, clicks: Sequence[Click], *, inside: bool) -> np.ndarray:
    """(m,) bool: those of the ``nodes`` (m,), indices, that clicks on the object hit, or clicks beside it."""
    hits = [click.hits for click in clicks if click.inside is inside]
    return np.isin(nodes, np.concatenate(hits)) if hits else np.zeros(len(nodes), bool)


def cut_apart(cloud: GaussianCloud, nodes: np.ndarray, clicks: Sequence[Click]) -> np.ndarray:
    """(m,) bool: which of the ``nodes`` (m,), indices of ``cloud``, the ``clicks`` leave.

    Each Gaussian leans to the clicks that are nearer, along links between neighbours that are the longer the more
    their colours differ; and to the side that has its colour more often. The cut between them is the least one. Nothing
    is cut where no click hits what is not to go along.
    """
    held, out = (hits_among(nodes, clicks, inside=inside) for inside in (True, False))
    # Hit by both, as what lies between: it says nothing.
    held, out = held & ~out, out & ~held
    kept, dropped = np.flatnonzero(held), np.flatnonzero(out)
    if not len(kept) or not len(dropped):
        return np.ones(len(nodes), bool)
    graph = SplatGraph.of(cloud, nodes)
    near, far = graph.distances(kept), graph.distances(dropped)
    # What no click reaches goes with the object, in which it was found.
    leaning = np.ones(len(nodes))
    reached = np.isfinite(near) & np.isfinite(far)
    to_kept, to_dropped = near[reached], far[reached]
    leaning[reached] = (to_dropped - to_kept) / np.maximum(to_dropped + to_kept, 1e-12)
    leaning[np.isfinite(far) & ~np.isfinite(near)] = -1.0
    leaning = leaning + _BY_COLOUR * _by_colour(cloud, nodes, leaning)
    inside = graph.cut(leaning, held, out)
    parts = graph.parts(inside)
    sizes = np.bincount(parts[inside], minlength=parts.max() + 1)
    clicked = np.isin(np.arange(len(sizes)), parts[kept])
    return inside & (clicked | (sizes > _ISLAND * sizes.max()))[parts]


def _by_colour(cloud: GaussianCloud, nodes: np.ndarray, leaning: np.ndarray) -> np.ndarray:
    """(m,) -1 to 1: how much more often the one side has a Gaussian's colour than the other, by the distance of its
    eighth nearest on either, of those that lean clearly.
    """
    colours = cloud.sh.numpy()[nodes, 0].astype(np.float64) * SH_BAND_0
    away = []
    for side in (leaning > _SURE, leaning < -_SURE):
        if side.sum() < _ALIKE:
            return np.zeros(len(nodes))
        away.append(KDTree(colours[side]).query(colours, k=_ALIKE)[0][:, -1] * np.cbrt(side.sum()))
    own, other = away
    return (other - own) / np.maximum(own + other, 1e-12)
