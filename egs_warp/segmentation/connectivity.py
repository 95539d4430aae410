"""Connected parts of Gaussians, and the space that a shell of them encloses."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.unique_rows import distinct_rows

_ARM = 1.5
"""Half-length of a Gaussian along each axis, in standard deviations; it is limited to four cells."""
_FOURTH = 4
"""Number, counted from 1, of the nearest neighbour whose distance measures how sparse a capture is."""
_MAX_GAUSSIANS = 200_000
"""Maximum number of Gaussians, spread evenly, from which the sparsity is measured."""


def connected_parts(
    cloud: GaussianCloud, chosen: np.ndarray, *, cell: float, plane: Plane | HeightField, above: float
) -> np.ndarray:
    """Return the connected part (m,) int32 of each of the ``chosen`` (m,) Gaussians.

    Gaussians are connected if points on their axes, the mean included, lie in the same cell of a grid.

    Args:
        cloud: the capture.
        chosen: (m,) indices.
        cell: minimum cell side, scene units; sparse Gaussians get wider cells.
        plane: the ground.
        above: height over ``plane`` below which means and axis ends connect nothing.
    """
    points = cloud.means.numpy()[chosen].astype(np.float64)
    if len(points) > _FOURTH:
        # The distance to the nearest neighbour is often zero, because training that splits Gaussians in place leaves
        # many of them at the same point.
        few = points[:: -(-len(points) // _MAX_GAUSSIANS)]
        cell = max(cell, 2.0 * float(np.median(KDTree(points).query(few, k=_FOURTH + 1)[0][:, _FOURTH])))
    lengths = np.minimum(_ARM * np.exp(cloud.log_scales.numpy()[chosen].astype(np.float64)), 4.0 * cell)
    rotations = Rotation.from_quat(cloud.rotations.numpy()[chosen][:, [1, 2, 3, 0]]).as_matrix()
    arms = (rotations * lengths[:, None, :]).transpose(0, 2, 1)
    centres = points[:, None]
    reached = np.concatenate([centres, centres + arms, centres - arms], axis=1)
    owner = np.broadcast_to(np.arange(len(points))[:, None], (len(points), 7))
    counts = plane.heights(reached) > above
    voxel = np.floor((reached[counts] - points.min(axis=0)) / cell).astype(np.int64)
    _, cells = distinct_rows(voxel)
    count = len(points) + int(cells.max(initial=-1)) + 1
    links = coo_array((np.ones(len(cells), np.int8), (owner[counts], len(points) + cells)), shape=(count, count))
    return connected_components(links, directed=False)[1][: len(points)]


def enclosed(points: np.ndarray, shell: np.ndarray, cell: float) -> np.ndarray:
    """Return the mask (n,) bool of those ``points`` (n, k) that are in or within the closed shell of the points
    ``shell`` (m, k), on a grid with cells of side ``cell``.

    Gaps of up to four cells are closed.
    """
    if len(shell) == 0:
        return np.zeros(len(points), bool)
    corner = shell.min(axis=0) - 3.0 * cell
    shape = np.ceil((shell.max(axis=0) + 3.0 * cell - corner) / cell).astype(int) + 1
    grid = np.zeros(shape, bool)
    grid[tuple(np.floor((shell - corner) / cell).astype(int).T)] = True
    # Holes are filled before the erosion, because a plain morphological closing would leave gaps in curved shells.
    cube = np.ones((3,) * grid.ndim)
    swollen = ndimage.binary_fill_holes(ndimage.binary_dilation(grid, cube, iterations=2))
    filled = np.asarray(ndimage.binary_erosion(swollen, cube, iterations=2)) | grid
    place = np.floor((points - corner) / cell).astype(int)
    in_grid = np.all((place >= 0) & (place < shape), axis=1)
    result = np.zeros(len(points), bool)
    result[in_grid] = filled[tuple(place[in_grid].T)]
    return result


def close_to(points: np.ndarray, others: np.ndarray, reach: float) -> np.ndarray:
    """Return the mask (n,) bool of those ``points`` (n, k) that are within ``reach`` of one of ``others`` (m, k)."""
    if len(others) == 0:
        return np.zeros(len(points), bool)
    return KDTree(others).query(points, distance_upper_bound=reach)[0] <= reach


def nearer_to(points: np.ndarray, targets: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the mask (n,) bool of those ``points`` (n, k) that are nearer to one of the ``targets`` (m, k) than to any
    of the ``others`` (l, k)."""
    if len(targets) == 0 or len(others) == 0:
        return np.full(len(points), len(others) == 0 < len(targets))
    return KDTree(targets).query(points)[0] < KDTree(others).query(points)[0]
