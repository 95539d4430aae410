"""A capture prepared for clicks: supervoxels, the links between them, and the evidence of the photos.

See docs/concepts/segmentation.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from egs_warp.geometry.camera import Camera, downscale
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.segmentation.above_plane import MIN_OPACITY
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.supervoxels import link_gaps, supervoxels
from egs_warp.segmentation.votes import MaskedView, blending_votes

_NEIGHBOURS = 6
"""Number of nearest neighbours to which a Gaussian is linked."""
_MAX_CLUSTERS = 1 << 14
"""Maximum number of supervoxels before supervoxels that consist of several connected components are divided."""
_VIEWS, _SIDE = 16, 160
"""Maximum number of photos that orient the normals and measure visible areas, and the longer side of their renders,
pixels."""
_AREA_RATIO = 4.0
"""Ratio of the surface area of a convex body to its mean silhouette (Cauchy's formula)."""


@dataclass(frozen=True)
class LinkFeatures:
    """Properties of each link between two neighbouring Gaussians that indicate a boundary between objects."""

    contrast: np.ndarray
    """(m,) distance between the colours of the ends, divided by the mean over all links."""
    concavity: np.ndarray
    """(m,) 0 to 2, component along the link of the difference of the outward normals, where the surface is concave."""
    convexity: np.ndarray
    """(m,) 0 to 2, the same component where the surface is convex."""
    turn: np.ndarray
    """(m,) 0 to 2, one minus the cosine of the angle between the normals of the ends."""
    gap: np.ndarray
    """(m,) length of the empty part of the link, divided by the median length of all links; at least 0."""

    def matrix(self) -> np.ndarray:
        """Return the features as the columns of an array (m, 5)."""
        return np.stack([self.contrast, self.concavity, self.convexity, self.turn, self.gap], axis=1)


@dataclass(frozen=True)
class SurfaceGraph:
    """Capture prepared for ``photo_clicks.object_of_clicks``."""

    cloud: GaussianCloud
    means: np.ndarray
    """(n, 3) float64, means of the Gaussians, scene units."""
    nodes: np.ndarray
    """(m,) int, indices of the opaque Gaussians."""
    links: SplatGraph
    """Links between opaque Gaussians, numbered as in ``nodes``; lengths in scene units."""
    features: LinkFeatures
    spacing: np.ndarray
    """(m,) mean length of the links of each opaque Gaussian, scene units."""
    colours: np.ndarray
    """(m, 3) colours of the opaque Gaussians, 0 to 1."""
    cluster: np.ndarray
    """(n,) int32, supervoxel of each Gaussian; a faint Gaussian has the supervoxel of the nearest opaque one."""
    cameras: tuple[Camera, ...]
    """Cameras of the photos; empty if they are unknown."""
    visible_area: np.ndarray
    """(n,) four times the mean area of each Gaussian in the photos, measured by blending weight; the unit of length is
    half of the shorter side of a photo. Its sum over a convex object is the surface area of the object."""

    @property
    def count(self) -> int:
        """Number of supervoxels."""
        return int(self.cluster.max(initial=-1)) + 1

    @property
    def own(self) -> np.ndarray:
        """(m,) int32, supervoxel of each opaque Gaussian."""
        return self.cluster[self.nodes]

    @classmethod
    def of(cls, cloud: GaussianCloud, cameras: Sequence[Camera] = ()) -> SurfaceGraph:
        """Prepare ``cloud``. Its photos have the ``cameras``, in the frame of ``cloud``."""
        means = cloud.means.numpy().astype(np.float64)
        opaque = cloud.visible(MIN_OPACITY)
        if not opaque.any():
            opaque[:] = True
        nodes = np.flatnonzero(opaque)
        points = means[nodes]
        colours = np.clip(cloud.sh.numpy()[nodes, 0].astype(np.float64) * SH_BAND_0 + 0.5, 0.0, 1.0)
        links = SplatGraph.of(cloud, nodes, neighbours=_NEIGHBOURS)
        towards, visible_area = _sight(cloud, cameras)
        features = _features(cloud, nodes, links, colours, towards[nodes])
        lengths = np.linalg.norm(points[links.first] - points[links.second], axis=1)
        ends = np.concatenate([links.first, links.second])
        degree = np.bincount(ends, minlength=len(nodes))
        spacing = np.bincount(ends, np.tile(lengths, 2), len(nodes)) / np.maximum(degree, 1)
        links = SplatGraph(links.count, links.first, links.second, lengths, np.ones(len(lengths)), links.colour_unit)
        levels = int(np.ceil(np.log2(min(max(len(points), 1), _MAX_CLUSTERS))))
        own = supervoxels(points, colours, levels)
        # A cluster is a box, which may contain a part of the object and a floater far from it.
        parts = links.where(features.gap == 0.0).parts(np.ones(len(own), bool)).astype(np.int64)
        own = np.unique(own * len(own) + parts, return_inverse=True)[1].astype(np.int32)
        cluster = np.empty(len(means), np.int32)
        cluster[nodes] = own
        if len(nodes) < len(means):
            cluster[~opaque] = own[KDTree(points).query(means[~opaque])[1]]
        return cls(cloud, means, nodes, links, features, spacing, colours, cluster, tuple(cameras), visible_area)

    def middles(self) -> np.ndarray:
        """Return the centres (k, 3) of the supervoxels, scene units."""
        return self.per_cluster(self.means[self.nodes])

    def per_cluster(self, values: np.ndarray) -> np.ndarray:
        """Return the means (k, ...) over each supervoxel of ``values`` (m, ...) of the opaque Gaussians."""
        own, columns = self.own, np.reshape(values, (len(values), -1))
        sizes = np.bincount(own, minlength=self.count)
        result = np.stack([np.bincount(own, one, self.count) for one in columns.T], axis=1)
        return np.reshape(result / sizes[:, None], (self.count, *np.shape(values)[1:]))


def _features(
    cloud: GaussianCloud, nodes: np.ndarray, links: SplatGraph, colours: np.ndarray, towards: np.ndarray
) -> LinkFeatures:
    """Return the features of the ``links`` between the Gaussians with the indices ``nodes`` (m,) and the ``colours``
    (m, 3), as seen from the directions ``towards`` (m, 3)."""
    first, second = links.first, links.second
    points = cloud.means.numpy()[nodes].astype(np.float64)
    contrast = np.linalg.norm(colours[first] - colours[second], axis=1) / links.colour_unit
    arms = points[second] - points[first]
    along = arms / np.maximum(np.linalg.norm(arms, axis=1), 1e-30)[:, None]
    normals = _outward_normals(cloud, nodes, links, towards)
    bend = np.einsum("ij,ij->i", along, normals[second] - normals[first])
    known = np.linalg.norm(normals, axis=1) > 0.0
    both = known[first] & known[second]
    turn = np.where(both, 1.0 - np.einsum("ij,ij->i", normals[first], normals[second]), 0.0)
    bend = np.where(both, bend, 0.0)
    gap = np.maximum(link_gaps(cloud, nodes, links), 0.0)
    return LinkFeatures(contrast, np.maximum(-bend, 0.0), np.maximum(bend, 0.0), turn, gap)


def _sight(cloud: GaussianCloud, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean direction (n, 3) from which the photos show each Gaussian, weighted by blending weight and not
    normalised, which is zero if no photo shows it; and ``SurfaceGraph.visible_area`` (n,)."""
    towards, area = np.zeros((cloud.count, 3)), np.zeros(cloud.count)
    means = cloud.means.numpy().astype(np.float64)
    chosen = cameras[:: -(-len(cameras) // _VIEWS) or 1]
    for camera in chosen:
        small = downscale(camera, _SIDE)
        weights = blending_votes(cloud, [MaskedView(small, np.ones((small.height, small.width), bool))]).inside
        arms = small.centre - means
        towards += (weights / np.maximum(np.linalg.norm(arms, axis=1), 1e-30))[:, None] * arms
        area += weights * (2.0 / min(small.width, small.height)) ** 2
    return towards, _AREA_RATIO * area / max(len(chosen), 1)


def _outward_normals(cloud: GaussianCloud, nodes: np.ndarray, links: SplatGraph, towards: np.ndarray) -> np.ndarray:
    """Return the unit normals (m, 3) of the surface at the Gaussians with the indices ``nodes`` (m,). They point to the
    side ``towards`` (m, 3) from which the photos show the Gaussians; they are zero for Gaussians that no photo shows.

    The normal of a Gaussian is its shortest axis. It is averaged with those of its neighbours, with the weight of the
    Gaussian's flatness and of the squared cosine of the angle, so that creases stay sharp.
    """
    axes = Rotation.from_quat(cloud.rotations.numpy()[nodes], scalar_first=True).as_matrix()
    scales = cloud.log_scales.numpy()[nodes].astype(np.float64)
    normals = axes[np.arange(len(nodes)), :, np.argmin(scales, axis=1)]
    normals *= np.sign(np.einsum("ij,ij->i", normals, towards))[:, None]
    flatness = 1.0 - np.exp(scales.min(axis=1) - np.sort(scales, axis=1)[:, 1])
    weighted = flatness[:, None] * normals
    agreement = np.maximum(np.einsum("ij,ij->i", normals[links.first], normals[links.second]), 0.0) ** 2
    ends = np.concatenate([links.first, links.second]), np.concatenate([links.second, links.first])
    mixing = coo_array((np.tile(agreement, 2), ends), shape=(len(nodes),) * 2).tocsr()
    weighted = weighted + mixing @ weighted
    return weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-12)
