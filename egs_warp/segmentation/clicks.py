"""Clicks on and beside an object: the Gaussians that each one hits, and the cut that separates the object from the
rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.spatial import KDTree

from egs_warp.checked_calls import Finite, checked_constructor
from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.votes import MaskedView, blending_votes
from egs_warp.short_repr import short_repr

_RADIUS = 0.004
"""Radius of a click as a fraction of the picture's longer side."""
_MIN_WEIGHT_FRACTION = 0.1
"""Minimum blending weight of a Gaussian that a click hits, as a fraction of the largest weight under the click."""
_SURFACE_FRACTION = 0.25
"""Fraction of the blending weight under a click. The clicked surface lies at the depth at which the weight, summed from
the front, reaches this fraction, unless another surface is dominant."""
_DOMINANT = 2.0
"""Ratio of the blending weights of two surfaces above which a click selects the one that contributes more, even behind
the other one."""
_WIDE, _FAINT = 0.05, 0.5
"""Minimum width, as a fraction of the distance, and maximum opacity of haze. A click selects what is behind Gaussians
that are wider and fainter than these."""
_MAX_DEPTH_DIFFERENCE = 0.03
"""Maximum distance of a Gaussian, in front of or behind the clicked surface, as a fraction of the surface's distance
from the camera. Gaussians farther from the surface belong to another surface."""
_SURE = 0.5
"""Absolute score, computed from distances alone, above which the colour of a Gaussian is a sample of the colours of its
side."""
_ALIKE = 8
"""Rank of the nearest colour whose distance measures how common a colour is on one side."""
_BY_COLOUR = 0.5
"""Maximum contribution of colours to the score, relative to the contribution of distances."""
_ISLAND = 0.1
"""Minimum size of a connected part, as a fraction of the largest one. A smaller part without a click is dropped."""


@checked_constructor
@dataclass(frozen=True)
class Click:
    """A click, and the Gaussians that it hits."""

    __repr__ = short_repr

    point: Annotated[np.ndarray, 3]
    """(3,) point at which the ray of the click meets the capture, scene units."""
    hits: Annotated[np.ndarray, "hits"]
    """(k,) int, indices of the Gaussians that paint the clicked surface."""
    inside: bool = True
    """True for a click on the object; False for one beside it."""
    camera: Camera | None = None
    """Camera of the clicked picture, if there is one."""
    pixel: tuple[Finite, Finite] = (0.0, 0.0)
    """Position in the picture, in pixels from its top left corner."""
    text: str | None = None
    """Text of the click, such as ``+u,v@photo``, if the user has written it."""


def click_at(cloud: GaussianCloud, camera: Camera, u: Finite, v: Finite, *, inside: bool = True) -> Click | None:
    """Return the click at pixel (``u``, ``v``), from the top left corner of ``camera``'s picture; None if nothing is
    there.

    Only a window around the click is rendered. The depth of the click is the depth at which the blending weight, summed
    from the front, reaches a quarter of its total, so that a click on foliage selects the leaves and not the wall that
    is visible between them. If a surface at another depth contributes more than twice as much, the click selects that
    surface, because the user sees it through what is in front of it. Haze in the air, as in captures from a turntable,
    is ignored if the other Gaussians have enough weight. The hits are the Gaussians that paint the window at the depth
    of the click.
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
    weights = clear if clear.sum() > _SURFACE_FRACTION * weights.sum() else weights
    depth = _surface_depth(depths[seen], weights[seen])
    hits = (np.abs(depths - depth) < _MAX_DEPTH_DIFFERENCE * depth) & (weights > 0.0)
    hits &= weights > _MIN_WEIGHT_FRACTION * weights[hits].max(initial=0.0)
    point = camera.centre + depth * camera_rays(window)[reach, reach]
    return Click(point, np.flatnonzero(hits), inside, camera, (u, v))


def _surface_depth(depths: np.ndarray, weights: np.ndarray) -> float:
    """Return the depth of the clicked surface from the ``depths`` (m,), which are positive, and the blending
    ``weights`` (m,) of the Gaussians under a click."""
    order = np.argsort(depths, kind="stable")
    depths, sums = depths[order], np.append(0.0, np.cumsum(weights[order]))
    ends = [np.searchsorted(depths, (1.0 + sign * _MAX_DEPTH_DIFFERENCE) * depths) for sign in (-1.0, 1.0)]
    nearby = sums[ends[1]] - sums[ends[0]]
    front = int(np.searchsorted(sums[1:], _SURFACE_FRACTION * sums[-1]))
    most = int(np.argmax(nearby))
    return float(depths[most if nearby[most] > _DOMINANT * nearby[front] else front])


def describe_click(click: Click) -> str:
    """Return a ``click`` as the user has written it; or else its pixel, or its point if it has no picture."""
    sign = "+" if click.inside else "-"
    return click.text or sign + ",".join(f"{x:g}" for x in (click.point if click.camera is None else click.pixel))


def _is_haze(cloud: GaussianCloud, rows: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Return the mask (m,) bool of the wide and faint Gaussians among those with the indices ``rows`` (m,) of
    ``cloud``; ``depths`` (n,) are the depths of all Gaussians."""
    return (cloud.breadths(rows) > _WIDE * depths[rows]) & (cloud.opacities()[rows] < _FAINT)


def hits_among(nodes: np.ndarray, clicks: Sequence[Click], *, inside: bool) -> np.ndarray:
    """Return the mask (m,) bool of the indices ``nodes`` (m,) that are hit by clicks on the object (``inside``), or by
    clicks beside it."""
    hits = [click.hits for click in clicks if click.inside is inside]
    return np.isin(nodes, np.concatenate(hits)) if hits else np.zeros(len(nodes), bool)


def removed_by_clicks(
    cloud: GaussianCloud, nodes: np.ndarray, clicks: Sequence[Click], heights: np.ndarray, low: float
) -> np.ndarray:
    """Return the mask (m,) bool of the Gaussians with the indices ``nodes`` (m,) of ``cloud`` that ``clicks`` remove.

    If all hits of a click beside the object are lower than ``low``, the click selects something on the ground, such as
    a shadow. Such a click does not remove Gaussians that are higher than ``low`` and higher than twice its highest hit.
    ``heights`` (m,) are the heights of the nodes above the ground, scene units.
    """
    removed = np.zeros(len(nodes), bool)
    inside = [click for click in clicks if click.inside]
    flat = {}
    for click in clicks:
        at = heights[np.isin(nodes, click.hits)]
        if not click.inside and len(at):
            flat[id(click)] = float(at.max())
    on_ground = [click for click in clicks if flat.get(id(click), np.inf) < low]
    others = [click for click in clicks if not click.inside and flat.get(id(click), np.inf) >= low]
    if others:
        removed |= ~cut_by_clicks(cloud, nodes, [*inside, *others])
    for click in on_ground:
        left = np.flatnonzero(~removed)
        higher = heights[left] > 2.0 * max(flat[id(click)], 0.5 * low)
        removed[left[~cut_by_clicks(cloud, nodes[left], [*inside, click], required=higher)]] = True
    return removed


def cut_by_clicks(
    cloud: GaussianCloud, nodes: np.ndarray, clicks: Sequence[Click], *, required: np.ndarray | None = None
) -> np.ndarray:
    """Return the mask (m,) bool of the Gaussians with the indices ``nodes`` (m,) of ``cloud`` that still belong to the
    object after the ``clicks``. The ``required`` (m,) bool Gaussians still belong to it unless a click beside the
    object hits them.

    The score of each Gaussian compares its distances from the two kinds of clicks, and how common its colour is on each
    side. The distances are measured along links between neighbours, which are longer where colours differ more. The
    labels are the minimum cut. Nothing is cut unless a click hits something that does not belong to the object.
    """
    hit, out = (hits_among(nodes, clicks, inside=inside) for inside in (True, False))
    # Gaussians that are hit by both kinds of clicks give no information.
    hit, out = hit & ~out, out & ~hit
    sure = hit if required is None else (hit | required) & ~out
    object_seeds, other_seeds = np.flatnonzero(sure), np.flatnonzero(out)
    if not len(object_seeds) or not len(other_seeds):
        return np.ones(len(nodes), bool)
    graph = SplatGraph.of(cloud, nodes)
    near, far = graph.distances(object_seeds), graph.distances(other_seeds)
    # Gaussians that cannot be reached from any click stay with the object.
    score = np.ones(len(nodes))
    reached = np.isfinite(near) & np.isfinite(far)
    to_kept, to_dropped = near[reached], far[reached]
    score[reached] = (to_dropped - to_kept) / np.maximum(to_dropped + to_kept, 1e-12)
    score[np.isfinite(far) & ~np.isfinite(near)] = -1.0
    score = score + _BY_COLOUR * _by_colour(cloud, nodes, score)
    inside = graph.cut(score, sure, out)
    parts = graph.parts(inside)
    sizes = np.bincount(parts[inside], minlength=parts.max() + 1)
    clicked = np.isin(np.arange(len(sizes)), parts[object_seeds])
    return inside & (clicked | (sizes > _ISLAND * sizes.max()))[parts]


def _by_colour(cloud: GaussianCloud, nodes: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Return (m,) scores, -1 to 1: how much more common a Gaussian's colour is on the object's side than on the other.
    This is measured by the distance to the eighth nearest colour among those Gaussians of each side whose score is
    clear."""
    colours = cloud.sh.numpy()[nodes, 0].astype(np.float64) * SH_BAND_0
    away = []
    for side in (score > _SURE, score < -_SURE):
        if side.sum() < _ALIKE:
            return np.zeros(len(nodes))
        away.append(KDTree(colours[side]).query(colours, k=_ALIKE)[0][:, -1] * np.cbrt(side.sum()))
    own, other = away
    return (other - own) / np.maximum(own + other, 1e-12)
