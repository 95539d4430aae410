"""Clicks on an object and beside it: what each one hits, and the cut between the one and the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.votes import MaskedView, blending_votes

_RADIUS = 0.004
"""Of the picture's longer side: so far about a click counts as clicked."""
_HIT = 0.1
"""Of the largest blending weight under a click: what shows less there was not meant."""
_FIRST = 0.25
"""Of the light of a click: what it comes from is what is clicked on."""
_WIDE, _FAINT = 0.05, 0.5
"""Of the distance, across, and of opacity: what is wider and fainter is a veil in the air, and one means what is behind
it.
"""
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
    camera: Camera | None = None
    """Whose picture was clicked on, if any was."""
    pixel: tuple[float, float] = (0.0, 0.0)
    """Where in it, from its top left corner."""


def click_at(cloud: GaussianCloud, camera: Camera, u: float, v: float, *, inside: bool = True) -> Click | None:
    """What pixel (``u``, ``v``), from the top left corner of ``camera``'s picture, hits; None where it shows nothing.

    Only a window about the click is drawn. What it shows is as far away as the first quarter of its light comes from:
    between leaves one sees through to the wall, and means the leaves. Veils in the air, as captures from a turntable
    have them, do not count where there is enough light without them. Hits are what paints it there.
    """
    reach = max(1, round(_RADIUS * max(camera.width, camera.height)))
    left, top, side = int(u) - reach, int(v) - reach, 2 * reach + 1
    window = replace(camera, width=side, height=side, cx=camera.cx - left, cy=camera.cy - top)
    across, down = np.meshgrid(np.arange(side) - reach, np.arange(side) - reach)
    disc = across**2 + down**2 <= reach**2
    weights = blending_votes(cloud, [MaskedView(window, disc, "click")]).inside
    if weights.sum() < 0.5 * disc.sum():
        return None
    depths = cloud.means.numpy().astype(np.float64) @ camera.rotation[2] + camera.translation[2]
    clear, seen = weights.copy(), np.flatnonzero(weights)
    clear[seen[_is_haze(cloud, seen, depths)]] = 0.0
    weights = clear if clear.sum() > _FIRST * weights.sum() else weights
    order = np.argsort(depths, kind="stable")
    depth = float(depths[order[np.searchsorted(np.cumsum(weights[order]), _FIRST * weights.sum())]])
    hits = (np.abs(depths - depth) < _DEEP * depth) & (weights > 0.0)
    hits &= weights > _HIT * weights[hits].max(initial=0.0)
    point = camera.centre + depth * camera_rays(window)[reach, reach]
    return Click(point, np.flatnonzero(hits), inside, camera, (u, v))


def _is_haze(cloud: GaussianCloud, rows: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """(m,) bool: which of the ``rows`` (m,) of ``cloud`` are wide and faint as seen from ``depths`` (n,) of all."""
    return (cloud.breadths(rows) > _WIDE * depths[rows]) & (cloud.opacities()[rows] < _FAINT)


def hits_among(nodes: np.ndarray, clicks: Sequence[Click], *, inside: bool) -> np.ndarray:
    """(m,) bool: those of the ``nodes`` (m,), indices, that clicks on the object hit, or clicks beside it."""
    hits = [click.hits for click in clicks if click.inside is inside]
    return np.isin(nodes, np.concatenate(hits)) if hits else np.zeros(len(nodes), bool)


def removed_by_clicks(
    cloud: GaussianCloud, nodes: np.ndarray, clicks: Sequence[Click], heights: np.ndarray, low: float
) -> np.ndarray:
    """(m,) bool: which of the ``nodes`` (m,), indices of ``cloud``, ``clicks`` take away; ``heights`` (m,) of them over
    the ground, scene units.

    A click beside the object that is lower than ``low`` means what lies on the ground, such as a shadow: it takes
    nothing away that is more than twice as high as it, or as half of ``low``.
    """
    gone = np.zeros(len(nodes), bool)
    mine = [click for click in clicks if click.inside]
    flat = {}
    for click in clicks:
        at = heights[np.isin(nodes, click.hits)]
        if not click.inside and len(at):
            flat[id(click)] = float(at.max())
    on_ground = [click for click in clicks if flat.get(id(click), np.inf) < low]
    others = [click for click in clicks if not click.inside and click not in on_ground]
    if others:
        gone |= ~cut_by_clicks(cloud, nodes, [*mine, *others])
    for click in on_ground:
        left = np.flatnonzero(~gone)
        higher = heights[left] > 2.0 * max(flat[id(click)], 0.5 * low)
        gone[left[~cut_by_clicks(cloud, nodes[left], [*mine, click], held=higher)]] = True
    return gone


def cut_by_clicks(
    cloud: GaussianCloud, nodes: np.ndarray, clicks: Sequence[Click], *, held: np.ndarray | None = None
) -> np.ndarray:
    """(m,) bool: which of the ``nodes`` (m,), indices of ``cloud``, the ``clicks`` leave; of them those that are
    ``held`` (m,) bool in any case.

    Each Gaussian leans to the clicks that are nearer, along links between neighbours that are the longer the more
    their colours differ; and to the side that has its colour more often. The cut between them is the least one. Nothing
    is cut where no click hits what is not to go along.
    """
    hit, out = (hits_among(nodes, clicks, inside=inside) for inside in (True, False))
    # Hit by both, as what lies between: it says nothing.
    hit, out = hit & ~out, out & ~hit
    sure = hit if held is None else (hit | held) & ~out
    kept, dropped = np.flatnonzero(sure), np.flatnonzero(out)
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
    inside = graph.cut(leaning, sure, out)
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
