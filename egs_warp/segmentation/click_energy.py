"""Energy whose minimum is the object that clicks in photos describe; a graph cut over supervoxels minimises it.

It is a conditional random field on the surface of the capture. ``benchmarks/fit_clicks.py`` fits its weights. See
docs/concepts/segmentation.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import root
from scipy.special import expit

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.framing import picture_radii
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.plane_search import lies_along
from egs_warp.segmentation.surface_graph import SurfaceGraph


@dataclass(frozen=True)
class EnergyWeights:
    """Weights of the energy, fitted by ``benchmarks/fit_clicks.py``."""

    links: tuple[float, ...] = (0.462, 1.646, 0.510, 0.341, 0.038)
    """Weights, in the log-odds that a link crosses a boundary, of contrast, concavity, convexity, turn and gap."""
    link_bias: float = -5.992
    nodes: tuple[float, ...] = (-3.35, -4.08, -0.34, -8.78, -7.29)
    """Weights, in the log-odds that a supervoxel belongs to the object, of the logarithm of the surface distance, of
    lying on the ground, of being below the ground, of the distance from the middle of the photos, and of being outside
    their frames."""
    node_bias: float = 3.01
    smoothness: float = 0.015
    """Weight of the links: the energy of a boundary of unit length relative to the energy of a unit area."""
    colour: float = 5.0
    """Energy of a unit area of object and a unit area of surroundings with the same colour."""
    variance: float = 100.0
    """Variance of the log-odds of a supervoxel about those that its features give."""
    correction: float = 3.0
    """Factor on the distances from clicks on the object after the first one; such clicks correct smaller parts."""
    crossing: float = 0.1
    """Additional length, in picture radii, of a path where it certainly crosses a boundary."""
    barrier: float = 10.0
    """The same length for the correlation of log-odds. It is larger, so that a click on the ground removes no part of a
    foot that stands on the ground."""


WEIGHTS = EnergyWeights()
_GAP_DETOUR = 5.0
"""Additional length of a path in empty space, relative to its true length there."""
_SIGMAS = 3.0
"""Visible half-length of a Gaussian, in standard deviations; the far end of a Gaussian is farther from a click by this
length."""
_NEAREST = 0.02
"""Radius around a click, in picture radii, within which distances are ignored."""
_FOOT = 0.1
"""Height, in picture radii, up to which ground is uneven; the evidence of lying flat decreases over this height."""
_CLEAR = 5.0
"""Maximum absolute log-odds of a supervoxel."""
_MAX_WIDTH = 0.1
"""Maximum spacing of Gaussians in the measure of areas and lengths, in picture radii."""
_BRIGHTNESS_STEP, _HUE_STEP = 1.0 / 12.0, 1.0 / 60.0
"""Differences of the mean of the colour channels, and of the opponent channels, within which colours count as the same.
Shading and shadows change the brightness of a surface more than its hue."""
_MIN_COMMON = 0.1
"""Minimum fraction of the area of a colour that is on the object, for the colour to be one of the object's colours."""
_NEARBY = 2.0
"""Surface distance from the clicks, in picture radii, within which colours are compared."""
Observation = tuple[np.ndarray, bool]
"""Supervoxels (s,) int that a click hits, and True if the click is on the object."""


@dataclass(frozen=True)
class Evidence:
    """The evidence of clicks, photos and ground for each supervoxel."""

    included: np.ndarray
    """(k,) bool, supervoxels that clicks on the object hit."""
    excluded: np.ndarray
    """(k,) bool, supervoxels that clicks beside the object hit."""
    features: np.ndarray
    """(k, 5) factors of ``EnergyWeights.nodes``."""
    log_odds: np.ndarray
    """(k,) log-odds that a supervoxel belongs to the object, without the links and colours."""
    nearby: np.ndarray
    """(k,) bool, supervoxels whose colours are compared."""


def picture_scale(point: np.ndarray, cameras: Sequence[Camera]) -> float:
    """Return the picture radius, scene units: half of the shorter side of a photo at the distance of the ``point``
    (3,), as the median over the ``cameras``. It is a measure of the object's size, because photographers fill the
    picture with the object."""
    return float(np.median([picture_radii(point[None], camera)[1][0] for camera in cameras]))


def boundary_log_odds(surface: SurfaceGraph, weights: EnergyWeights = WEIGHTS) -> np.ndarray:
    """Return the log-odds (m,) that each link between opaque Gaussians crosses the boundary of an object."""
    return surface.features.matrix() @ np.array(weights.links) + weights.link_bias


@dataclass(frozen=True)
class ClickScene:
    """Terms of the energy that do not depend on the clicks on an object."""

    surface: SurfaceGraph
    links: SplatGraph
    """Links between supervoxels. ``length`` is the length of the path in picture radii, increased where the path
    crosses a boundary or a gap; ``strength`` is the cost of cutting the link."""
    barriers: SplatGraph
    """The same links, but with much larger lengths where they cross a boundary (``EnergyWeights.barrier``)."""
    reach: np.ndarray
    """(k,) visible half-length of the Gaussians, picture radii."""
    lying: np.ndarray
    """(k,) 0 to 1, evidence of a supervoxel lying flat on the ground."""
    below: np.ndarray
    """(k,) 1 for supervoxels below the ground, otherwise 0."""
    off_middle: np.ndarray
    """(k,) distance from the middle of the photos, picture radii."""
    outside: np.ndarray
    """(k,) share of the photos that do not show a supervoxel within a picture radius."""
    colours: np.ndarray
    """(k, 3) 0 to 1, mean colours."""
    area: np.ndarray
    """(k,) area of each supervoxel or its visible area, whichever is larger, in squared picture radii."""

    @classmethod
    def of(
        cls, surface: SurfaceGraph, ground: Plane | HeightField, scale: float, *, weights: EnergyWeights = WEIGHTS
    ) -> ClickScene:
        """Prepare the energy of ``surface`` above the ``ground``, for an object with the picture radius ``scale``,
        scene units."""
        middles, count = surface.middles(), surface.count
        links, barriers = _links(surface, middles, scale, weights)
        lengths = np.exp(surface.cloud.log_scales.numpy()[surface.nodes].max(axis=1).astype(np.float64))
        heights = surface.per_cluster(ground.heights(surface.means[surface.nodes])) / scale
        level = surface.per_cluster(lies_along(surface.cloud, ground)[surface.nodes].astype(np.float64))
        off_middle, outside = _framing(middles, surface.cameras)
        area = np.bincount(surface.own, np.minimum(surface.spacing / scale, _MAX_WIDTH) ** 2, count)
        visible = np.bincount(surface.cluster, surface.visible_area, count)
        return cls(
            surface,
            links,
            barriers,
            _SIGMAS * surface.per_cluster(lengths) / scale,
            level * np.exp(-np.maximum(heights, 0.0) / _FOOT),
            (heights < 0.0).astype(np.float64),
            off_middle,
            outside,
            surface.per_cluster(surface.colours),
            np.maximum(area, visible),
        )

    def evidence(self, clicks: Sequence[Observation], *, weights: EnergyWeights = WEIGHTS) -> Evidence:
        """Collect the evidence of ``clicks``, as ``consistent`` returns them. The first one, which is on the object,
        defines where the photos show it."""
        first, corrections = clicks[0][0], [hits for hits, inside in clicks[1:] if inside]
        paths = _paths(self.links, first)
        if corrections:
            paths = np.minimum(paths, weights.correction * _paths(self.links, np.concatenate(corrections)))
        columns = (
            np.log(paths + self.reach + _NEAREST),
            self.lying,
            self.below,
            np.maximum(self.off_middle - float(self.off_middle[first].mean()) + self.reach, 0.0),
            self.outside,
        )
        features = np.stack(columns, axis=1)
        log_odds = np.clip(features @ np.array(weights.nodes) + weights.node_bias, -_CLEAR, _CLEAR)
        if len(clicks) > 1:
            log_odds = np.clip(log_odds + self._correction(log_odds, clicks, weights), -_CLEAR, _CLEAR)
        labels = np.zeros(self.links.count, np.int8)
        for hits, inside in clicks:
            labels[hits] = 1 if inside else -1
        return Evidence(labels == 1, labels == -1, features, log_odds, paths < _NEARBY)

    def _correction(self, log_odds: np.ndarray, clicks: Sequence[Observation], weights: EnergyWeights) -> np.ndarray:
        """Return the change (k,) of the ``log_odds`` (k,) by the labels that the ``clicks`` observe.

        The log-odds are a Gaussian process on the surface. Its mean is the given log-odds, and its correlation
        decreases exponentially with the length of the shortest path, in picture radii.
        """
        paths = np.stack([_paths(self.barriers, hits) for hits, _ in clicks])
        covariance = weights.variance * np.exp(-paths)
        among = np.stack([covariance[:, hits].mean(axis=1) for hits, _ in clicks])
        mean = np.array([log_odds[hits].mean() for hits, _ in clicks])
        labels = np.array([float(inside) for _, inside in clicks])
        return residuals_of_labels(mean, 0.5 * (among + among.T), labels) @ covariance


def _links(
    surface: SurfaceGraph, middles: np.ndarray, scale: float, weights: EnergyWeights
) -> tuple[SplatGraph, SplatGraph]:
    """Return ``ClickScene.links`` and ``ClickScene.barriers``."""
    log_odds = boundary_log_odds(surface, weights)
    links, own = surface.links, surface.own
    linked = links.length > 0.0
    unit = float(np.median(links.length[linked])) if linked.any() else 1.0
    width = 0.5 * (surface.spacing[links.first] + surface.spacing[links.second]) / scale
    cost = np.minimum(width, _MAX_WIDTH) * np.maximum(-log_odds, 0.0)
    low, high = np.sort(own[np.stack([links.first, links.second])].astype(np.int64), axis=0)
    between = low != high
    codes, link = np.unique(low[between] * surface.count + high[between], return_inverse=True)
    first, second = (ends.astype(np.int32) for ends in np.divmod(codes, surface.count))
    number = np.bincount(link, minlength=len(codes))
    crossed = np.bincount(link, 1.0 / (1.0 + np.exp(-log_odds[between])), len(codes)) / number
    gap = np.full(len(codes), np.inf)
    np.minimum.at(gap, link, unit * surface.features.gap[between])
    length = (np.linalg.norm(middles[first] - middles[second], axis=1) + _GAP_DETOUR * gap) / scale
    strength = np.bincount(link, cost[between], len(codes))
    paths, barriers = (
        SplatGraph(surface.count, first, second, length + factor * crossed, strength)
        for factor in (weights.crossing, weights.barrier)
    )
    return paths, barriers


def consistent(clicks: Sequence[Observation], count: int) -> list[Observation]:
    """Return the ``clicks`` on ``count`` supervoxels without the supervoxels that later clicks of the other kind hit,
    the first one on the object first; empty without a click on the object."""
    labels = np.zeros(count, np.int8)
    for hits, inside in clicks:
        labels[hits] = 1 if inside else -1
    left = [(hits[labels[hits] == (1 if inside else -1)], inside) for hits, inside in clicks]
    left = [click for click in left if len(click[0])]
    first = next((number for number, (_, inside) in enumerate(left) if inside), None)
    return [] if first is None else [left[first], *left[:first], *left[first + 1 :]]


def residuals_of_labels(mean: np.ndarray, covariance: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return the vector (n,) whose product with the covariance is the change of the most probable log-odds of a
    Gaussian process by the observation of ``labels`` (Rasmussen and Williams 2006, Eq. 3.17).

    It is the difference between the labels and their probabilities after the observation, so a label that the mean
    predicts changes little.

    Args:
        mean: (n,) log-odds before the observation.
        covariance: (n, n) covariance of the log-odds.
        labels: (n,) 0 or 1.
    """

    def error(residuals: np.ndarray) -> np.ndarray:
        return labels - expit(mean + covariance @ residuals) - residuals

    def slope(residuals: np.ndarray) -> np.ndarray:
        probability = expit(mean + covariance @ residuals)
        return -(probability * (1.0 - probability))[:, None] * covariance - np.eye(len(mean))

    return root(error, np.zeros(len(mean)), jac=slope).x


def minimise(scene: ClickScene, evidence: Evidence, *, weights: EnergyWeights = WEIGHTS) -> np.ndarray:
    """Return the mask (k,) bool of the supervoxels of the object, which is the minimum of the energy.

    One minimum cut decides over the object and its colours together (Tang, Gorelick, Veksler and Boykov 2013), so the
    result does not depend on an initial guess of the object.
    """
    score = scene.area * evidence.log_odds
    count = len(score)
    member, shade, strength = _colour_links(scene, evidence)
    shades = int(shade.max(initial=-1)) + 1
    graph = SplatGraph(
        count + shades,
        np.concatenate([scene.links.first, member]).astype(np.int32),
        np.concatenate([scene.links.second, count + shade]).astype(np.int32),
        np.zeros(len(scene.links.first) + len(member)),
        np.concatenate([weights.smoothness * scene.links.strength, weights.colour * strength]),
    )
    # Scores and strengths are scaled to a common range, because the cut rounds them.
    unit = 1.0 / max(float(np.mean(np.abs(score))), 1e-30)
    score, included, excluded = (
        np.append(values, np.zeros(shades, values.dtype))
        for values in (unit * score, evidence.included, evidence.excluded)
    )
    return graph.cut(score, included, excluded, smoothness=unit)[:count]


def _colour_links(scene: ClickScene, evidence: Evidence) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return links between supervoxels and additional nodes, one for each colour: the indices (m,) of the supervoxels,
    the numbers (m,) of their colours, and the strengths (m,).

    The node of a colour takes the label of the larger part of the colour's area, so its links cost the area of the
    smaller part. The strength also has the factor of how clearly the log-odds assign the colour as a whole to one side:
    a colour that is common both on the object and around it is no evidence.
    """
    red, green, blue = scene.colours.T
    opponent = np.stack([(red + green + blue) / 3.0, red - green, 0.5 * (red + green) - blue], axis=1)
    cells = np.floor(opponent / [_BRIGHTNESS_STEP, _HUE_STEP, _HUE_STEP]).astype(np.int64)
    cells -= cells.min(axis=0)
    code = np.asarray(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)))
    member = np.flatnonzero(evidence.nearby)
    shade = np.unique(code[member], return_inverse=True)[1]
    area = scene.area[member]
    balance = np.bincount(shade, area * np.tanh(0.5 * evidence.log_odds[member]))
    clarity = np.abs(balance) / np.maximum(np.bincount(shade, area), 1e-30)
    return member, shade, clarity[shade] * area


def shared_colours(scene: ClickScene, evidence: Evidence, inside: np.ndarray) -> float:
    """Return how much of the object ``inside`` (k,) bool has colours that continue in its surroundings, relative to the
    area of the object.

    It is the sum, over the colours, of the smaller of the areas inside the object and in the surroundings that are
    connected to the object along supervoxels of the object's colours. It is large if the cut runs through a part of
    one colour, such as the crown of a tree.
    """
    member, shade, _ = _colour_links(scene, evidence)
    if len(member) == 0 or not inside.any():
        return 0.0
    own = np.bincount(shade, scene.area[member] * inside[member])
    common = own > _MIN_COMMON * np.bincount(shade, scene.area[member])
    alike = inside.copy()
    alike[member] |= common[shade]
    parts = scene.links.parts(alike)
    connected = alike & ~inside & np.isin(parts, np.unique(parts[inside]))
    outside = np.bincount(shade, scene.area[member] * connected[member])
    return float(np.minimum(own, outside).sum() / max(scene.area[inside].sum(), 1e-30))


def _paths(links: SplatGraph, seeds: np.ndarray) -> np.ndarray:
    """Return the lengths (k,) of the shortest paths from the ``seeds``; for unreachable nodes, a large number."""
    paths = links.distances(seeds)
    return np.where(np.isfinite(paths), paths, 10.0)


def _framing(middles: np.ndarray, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (k,) of each of the ``middles`` (k, 3) from the middle of the photos, in picture radii, and
    the share (k,) of the photos that do not show it within a picture radius."""
    radii = np.stack([picture_radii(middles, camera)[0] for camera in cameras])
    return np.minimum(radii, 2.0).mean(axis=0), (radii >= 1.0).mean(axis=0)
