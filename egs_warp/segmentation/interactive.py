"""Interactive segmentation: the Gaussians of an object from clicks, in about one second for a few hundred thousand
Gaussians.

A capture is prepared once: neighbouring Gaussians are grouped into clusters, and neighbouring clusters are linked. For
each change of the clicks, a problem with some ten thousand clusters is solved. See docs/concepts/segmentation.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.above_plane import MIN_OPACITY, SceneAbovePlane
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.floor_remnants import floor_remnants
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.supervoxels import link_gaps, supervoxels

_NEIGHBOURS = 6
"""Number of nearest neighbours to which a Gaussian is linked."""
_MAX_GAP = 2.0
"""Longest gap that a link bridges, as a multiple of the median distance between neighbours. Without this limit, a
floater in empty space would be linked to the object alone, and cutting these links would cost more than including the
floater."""
_CLUSTER = 12
"""Maximum number of Gaussians in a cluster."""
_MIN_PART = 8
"""Minimum number of clusters in the part that a click selects."""
_MAX_EXTENT = 0.9
"""Maximum extent along the ground of the part that one click selects, as a fraction of the capture's diagonal."""
_FOOT = 0.015
"""Foot height: height above the ground, as a fraction of the object's size, below which Gaussians have no links."""
_FIRST_FOOT = 0.1
"""Foot height before the object's size is known, as a fraction of the lowest click's height above the ground."""
_LEVEL_FOOT = 3.0
"""Multiple of the foot height below which Gaussians that lie flat along the ground have no links."""
_MIN_STANDING = 0.25
"""Share of a cluster's Gaussians that must be above the foot height; a cluster with a smaller share is ground."""
_GROUND_WEIGHT = 0.5
"""Cost of cutting a link to the ground, relative to its strength. It is reduced, because every object has such links at
its foot."""
_MAX_REMOVED = 2.0 / 3.0
"""Maximum share of a proposal that a click beside the object removes if there is no click on the object."""
_UNDER = 0.1
"""Height, as a fraction of the object's size, below which the outline of the object's parts is the outline of its
foot."""


@dataclass(frozen=True)
class ClickGraph:
    """A capture prepared for ``segment_by_clicks``."""

    cloud: GaussianCloud
    cluster: np.ndarray
    """(n,) int32, cluster of each Gaussian; a faint Gaussian has the cluster of the nearest opaque one."""
    links: SplatGraph
    """Links between clusters."""
    middles: np.ndarray
    """(k, 3) centre of each cluster, scene units."""
    means: np.ndarray
    """(n, 3) float64, means of the Gaussians, scene units."""

    @classmethod
    def of(cls, cloud: GaussianCloud) -> ClickGraph:
        """Prepare ``cloud``: five seconds for 300,000 Gaussians on one core."""
        means = cloud.means.numpy().astype(np.float64)
        opaque = cloud.visible(MIN_OPACITY)
        if not opaque.any():
            opaque[:] = True
        points = means[opaque]
        colours = cloud.sh.numpy()[opaque, 0].astype(np.float64) * SH_BAND_0 + 0.5
        nodes = np.flatnonzero(opaque)
        links = SplatGraph.of(cloud, nodes, neighbours=_NEIGHBOURS)
        links = links.where(link_gaps(cloud, nodes, links) < _MAX_GAP)
        levels = max(0, int(np.ceil(np.log2(max(len(points), 1) / _CLUSTER))))
        own = supervoxels(points, np.clip(colours, 0.0, 1.0), levels)
        # A cluster is a box, which may contain a part of the object and a floater far from it.
        parts = links.parts(np.ones(len(own), bool)).astype(np.int64)
        own = np.unique(own * len(own) + parts, return_inverse=True)[1].astype(np.int32)
        count = int(own.max()) + 1
        middles, shades = (
            np.stack([np.bincount(own, weights=column, minlength=count) for column in values.T], axis=1)
            / np.bincount(own, minlength=count)[:, None]
            for values in (points, colours)
        )
        links = links.clustered(own, middles, shades)
        cluster = np.empty(len(means), np.int32)
        cluster[opaque] = own
        if not opaque.all():
            cluster[~opaque] = own[KDTree(points).query(means[~opaque])[1]]
        return cls(cloud, cluster, links, middles, means)


def segment_by_clicks(
    graph: ClickGraph,
    clicks: Sequence[Click],
    ground: Plane | HeightField,
    *,
    proposal: np.ndarray | None = None,
    outside: np.ndarray | None = None,
) -> np.ndarray:
    """Find the Gaussians of the object that the clicks describe.

    Each click on the object adds a part. The candidates are the sets of clusters nearer to the click than some distance
    along the links, and the part is the candidate with the weakest boundary for its size. Clicks beside the object then
    remove everything that a minimum cut separates from the clicks on it; without a click on the object, they remove the
    part around them from the proposal. Links below the foot height above the ground are ignored.

    Args:
        graph: the prepared capture.
        clicks: clicks on the object and beside it; strokes are clicks with more hits. Of two opposite clicks on the
            same place, the later one counts.
        ground: the ground, in the frame of the capture.
        proposal: (n,) bool, Gaussians that belong to the object unless clicks beside it remove them; None if there is
            no proposal.
        outside: (n,) 0 to 1, for each Gaussian the share of the photos of the object whose frames do not contain it;
            None if it is unknown. Photographers keep the object in the frame, so this share of the strength of the
            Gaussian's links counts as links that leave the object.

    Returns:
        (n,) bool, True for the object's Gaussians; all False without a click on it and without a proposal.
    """
    scene = SceneAbovePlane.of(graph.cloud, ground)
    heights, level = scene.heights, scene.is_level
    hits, others = _consistent_hits(graph, clicks)
    own = [graph.means[hit] for hit in hits] + ([graph.means[proposal]] if proposal is not None else [])
    if not own or not sum(map(len, own)):
        return np.zeros(len(heights), bool)
    foot = _FIRST_FOOT * max(min(float(np.median(ground.heights(points))) for points in own if len(points)), 0.0)
    chosen, linked, size = np.zeros(len(heights), bool), np.zeros(len(heights), bool), 0.0
    flat = graph.middles @ np.stack(ground.tangents(), axis=1)
    # The first round measures the size of the object.
    for _ in range(2):
        standing = (heights > foot) & ~(level & (heights < _LEVEL_FOOT * foot))
        chosen, linked = _chosen(graph, hits, others, standing, flat, proposal, outside)
        if not chosen.any():
            return chosen
        size = float(np.linalg.norm(np.subtract(*np.quantile(graph.means[chosen], [0.995, 0.005], axis=0))))
        foot = _FOOT * size
    # Gaussians without links under the object are its foot, unless they have the colours of the floor.
    low = ~linked & (heights > foot) & (heights < _UNDER * size)
    chosen |= low & scene.is_under(chosen, _UNDER * size, size)
    for hit in others:
        chosen[hit] = False
    remnants = floor_remnants(scene, chosen, size)
    for hit in hits:
        remnants[hit] = False
    return chosen & ~remnants


def _outside(graph: ClickGraph, outside: np.ndarray) -> np.ndarray:
    """Return the mean (k,) of ``outside`` (n,) over the Gaussians of each cluster."""
    return np.bincount(graph.cluster, weights=outside, minlength=graph.links.count) / np.bincount(
        graph.cluster, minlength=graph.links.count
    )


def _consistent_hits(graph: ClickGraph, clicks: Sequence[Click]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the hits of the clicks on the object and of the clicks beside it. Clusters that are hit by a later click
    of the other kind are left out."""
    hits: dict[bool, list[np.ndarray]] = {True: [], False: []}
    claimed = {kind: np.zeros(graph.links.count, bool) for kind in hits}
    for click in reversed(clicks):
        left = click.hits[~claimed[not click.inside][graph.cluster[click.hits]]]
        if len(left):
            hits[click.inside].append(left)
            claimed[click.inside][graph.cluster[left]] = True
    return hits[True][::-1], hits[False][::-1]


def _chosen(
    graph: ClickGraph,
    hits: Sequence[np.ndarray],
    others: Sequence[np.ndarray],
    standing: np.ndarray,
    flat: np.ndarray,
    proposal: np.ndarray | None,
    outside: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask (n,) bool of the object, and the mask (n,) bool of the Gaussians that link others, which are a
    subset of the ``standing`` (n,) bool ones. ``flat`` (k, 2) are the coordinates of the clusters along the ground."""
    count = graph.links.count
    share = np.bincount(graph.cluster, weights=standing, minlength=count)
    alive = share > _MIN_STANDING * np.bincount(graph.cluster, minlength=count)
    seeds = [np.unique(graph.cluster[hit]) for hit in hits]
    for seed in seeds:
        alive[seed] = True
    links, number = graph.links.among(alive), np.cumsum(alive) - 1
    at_ground = _GROUND_WEIGHT * graph.links.strength_to(~alive)[alive]
    if outside is not None:
        at_ground = at_ground + _outside(graph, outside)[alive] * links.strength_to(np.ones(links.count, bool))
    seeds = [number[seed] for seed in seeds]
    extent = _MAX_EXTENT * float(np.linalg.norm(np.subtract(*np.quantile(flat, [0.99, 0.01], axis=0))))
    inside = np.zeros(links.count, bool)
    if proposal is not None:
        members = np.bincount(graph.cluster, weights=proposal, minlength=count)
        inside |= (members > 0.5 * np.bincount(graph.cluster, minlength=count))[alive]
    for seed in seeds:
        if not inside[seed].all():
            inside |= _part_around(links, seed, at_ground, flat[alive], extent)
    removed = np.unique(graph.cluster[np.concatenate(others)]) if others else np.zeros(0, int)
    removed = number[removed[alive[removed]]]
    kept, removed = _within(inside, seeds), _within(inside, [removed])
    if len(removed):
        among = links.among(inside)
        if len(kept):
            inside[inside] = _without(among, kept, removed)
        else:
            limit = int(_MAX_REMOVED * among.count)
            inside[inside] = ~_part_around(among, removed, np.zeros(among.count), flat[alive][inside], extent, limit)
    result = np.zeros(count, bool)
    result[np.flatnonzero(alive)[inside]] = True
    chosen = result[graph.cluster] & standing
    for hit in hits:
        chosen[hit] = True
    for hit in others:
        chosen[hit] = False
    return chosen, standing & alive[graph.cluster]


def _within(inside: np.ndarray, seeds: Sequence[np.ndarray]) -> np.ndarray:
    """Return the indices (k,) int of ``seeds`` among the ``inside`` (m,) bool nodes; seeds outside are left out."""
    number = np.cumsum(inside) - 1
    joined = np.concatenate(seeds) if len(seeds) else np.zeros(0, int)
    return np.unique(number[joined[inside[joined]]])


def _part_around(
    links: SplatGraph,
    seeds: np.ndarray,
    at_ground: np.ndarray,
    flat: np.ndarray,
    extent: float,
    max_nodes: int | None = None,
) -> np.ndarray:
    """Return the mask (m,) bool of the part around ``seeds`` (k,) that has the weakest boundary for its size.

    The candidates are the sets of nodes up to each distance along the links (sweep cut; Spielman and Teng 2004). The
    measure is the strength of the links that leave a set, including the links ``at_ground`` (m,) of its nodes to the
    ground, divided by the square root of the strength of all links of its nodes. On a surface both are proportional to
    the set's diameter, so the measure favours no size. Sets whose diagonal in the coordinates ``flat`` (m, 2) exceeds
    ``extent`` are excluded, because a room is not an object, and so are sets of more than ``max_nodes`` nodes.
    """
    distances = links.distances(seeds)
    order = np.argsort(distances, kind="stable")
    reached = min(int(np.isfinite(distances).sum()), links.count if max_nodes is None else max(max_nodes, len(seeds)))
    rank = np.empty(links.count, int)
    rank[order] = np.arange(links.count)
    near, far = np.sort(rank[np.stack([links.first, links.second])], axis=0)
    begun, ended = (np.bincount(end, links.strength, links.count) for end in (near, far))
    leaving = np.cumsum(begun - ended + at_ground[order])
    volume = np.cumsum(begun + ended + at_ground[order])
    ratio = np.maximum(leaving, 0.0) / np.sqrt(np.maximum(volume, 1e-12))
    first = min(max(_MIN_PART, len(seeds)), reached) - 1
    ordered = flat[order[:reached]]
    diagonal = np.linalg.norm(np.maximum.accumulate(ordered) - np.minimum.accumulate(ordered), axis=1)
    last = max(int(np.searchsorted(diagonal, extent)), first + 1)
    best = first + int(np.argmin(ratio[first:last]))
    inside = np.zeros(links.count, bool)
    inside[order[: best + 1]] = True
    return inside


def _without(links: SplatGraph, seeds: np.ndarray, removed: np.ndarray) -> np.ndarray:
    """Return the mask (m,) bool of the nodes that a minimum cut assigns to ``seeds`` (k,) rather than to ``removed``
    (l,); neither may be empty.

    The score of a node compares its distances along the links from both. Parts without links to a removed node remain.
    """
    near, away = links.distances(seeds), links.distances(removed)
    score = np.ones(links.count)
    both = np.isfinite(away) & np.isfinite(near)
    score[both] = (away[both] - near[both]) / np.maximum(away[both] + near[both], 1e-12)
    score[np.isfinite(away) & ~np.isfinite(near)] = -1.0
    included, excluded = np.zeros((2, links.count), bool)
    included[seeds], excluded[removed] = True, True
    mean = 2.0 * links.strength.sum() / max(links.count, 1)
    return links.cut(score, included, excluded, smoothness=1.0 / max(mean, 1e-12))
