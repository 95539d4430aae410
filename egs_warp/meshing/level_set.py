"""Level set of a body in its rest shape: its signed distance as a smooth function, for contact between bodies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from egs_warp.errors import UserError
from egs_warp.kernels.contact.level_set import LevelSetLattice, level_set_kernel
from egs_warp.kernels.meshing.surface_distance import surface_distance_kernel, unsigned_distance_kernel
from egs_warp.launching import Device, empty, launch_rows
from egs_warp.meshing.occupancy import LatticeSolid
from egs_warp.precision import Vec3, real
from egs_warp.short_repr import short_repr

MIN_CELLS, MAX_CELLS = 64, 96
"""Minimum and maximum number of lattice cells along the longest side of a body."""
EXPOSURE_RADIUS = 4.0
"""Radius in cells of the empty balls that reach the outer points of a body (``outer_points``)."""
_MARGIN = 5
"""Number of cells between the body and the boundary of the lattice."""
_MIN_THIN_LENGTH = 3.0
"""Minimum distance in cells to which a connected thin part extends from the rest of the body; shorter components are
edges and the roughness of the surface."""
_FILTER_MARGIN = 4
"""Number of layers of nodes outside the lattice whose values affect the coefficients of the spline."""
_SURFACE_BLUR = 0.9
"""Standard deviation in cells of the filter that removes the steps of the occupied lattice."""
_THIN_SLACK = 0.3
"""Maximum distance in cells by which the filter may move the surface inwards; the limit preserves thin parts."""
_FIT_SCALES = (4.0, 2.0, 1.5, 1.0, 1.0)
"""Standard deviations in cells of the weights in the successive corrections that move the surface to the outer
points."""
_FIT_FLOOR = 1e-3
"""Density of outer points, relative to the maximum density, below which a correction fades out."""


@dataclass(frozen=True)
class ThinParts:
    """Parts of a body that are too thin for its lattice."""

    fraction: float
    """Fraction of the volume of the body that is thinner than two cells."""
    centres: np.ndarray
    """(n, 3) m, centre of each connected part, the longest first."""
    lengths: np.ndarray
    """(n,) m, distance to which each part extends from the rest of the body, or its largest extent along an axis if the
    whole body is thin."""
    thickness: float
    """Thickness below which a part is thin, m: two cells."""


@dataclass(frozen=True, eq=False)
class LevelSet:
    """Signed distance of a body in its rest shape, negative inside: a triquadratic B-spline over a cubic lattice.

    Value and gradient are continuous. The zero set is the outer surface of the body, up to the lattice's resolution.
    """

    __repr__ = short_repr

    origin: np.ndarray
    """(3,) m, position of lattice node (0, 0, 0)."""
    spacing: float
    """Distance between lattice nodes, m."""
    coefficients: np.ndarray
    """(nx, ny, nz) float32, coefficients of the spline, m."""

    @classmethod
    def through(cls, origin: np.ndarray, spacing: float, values: np.ndarray) -> LevelSet:
        """Create the level set with ``values`` (nx, ny, nz), m, at its nodes."""
        # Continue the values linearly beyond the lattice: the filter's mirror condition would set the slope at the
        # boundary to zero.
        margin = (slice(_FILTER_MARGIN, -_FILTER_MARGIN),) * 3
        extended = np.pad(values, _FILTER_MARGIN, mode="reflect", reflect_type="odd")
        coefficients = ndimage.spline_filter(extended, order=2, output=np.float64, mode="mirror")[margin]
        return cls(np.asarray(origin, float), float(spacing), np.asarray(coefficients, np.float32))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only the fields, because the cached Warp structs and arrays cannot be pickled."""
        return LevelSet, (self.origin, self.spacing, self.coefficients)

    @cached_property
    def lattice(self) -> Any:
        """Lattice as a Warp struct for kernels (``LevelSetLattice``)."""
        lattice: Any = LevelSetLattice()
        lattice.counts = wp.vec3i(*self.coefficients.shape)
        lattice.origin = Vec3(*self.origin.tolist())
        lattice.spacing = self.spacing
        return lattice

    def on_device(self, device: Device) -> wp.array:
        """Return a copy of the coefficients (nx ny nz,) on ``device``."""
        return wp.array(self.coefficients.ravel(), dtype=wp.float32, device=device)

    def resampled(self, cells: int) -> LevelSet:
        """Return a level set with the same domain and about the same values, whose lattice has ``cells`` cells along
        its longest side."""
        extents = self.spacing * (np.array(self.coefficients.shape) - 1)
        spacing = float(extents.max()) / cells
        # ``through`` needs a few nodes along each axis.
        counts = np.maximum(np.ceil(extents / spacing - 1e-9).astype(int) + 1, _FILTER_MARGIN + 1)
        nodes = self.origin + spacing * np.moveaxis(np.indices(tuple(counts.tolist())), 0, -1).reshape(-1, 3)
        return LevelSet.through(self.origin, spacing, self.evaluate(nodes)[0].reshape(counts))

    def evaluate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values (P,) m and gradients (P, 3) at ``points`` (P, 3) m, computed on the CPU."""
        device, points = wp.get_device("cpu"), np.ascontiguousarray(points, np.float64)
        values = empty(len(points), real, device)
        gradients = empty(len(points), Vec3, device)
        launch_rows(
            level_set_kernel,
            len(points),
            inputs=[self.lattice, self._on_cpu, wp.array(points, dtype=Vec3, device=device)],
            outputs=[gradients, values],
            device=device,
        )
        return values.numpy(), gradients.numpy()

    @cached_property
    def _on_cpu(self) -> wp.array:
        return self.on_device("cpu")


def level_set_of_surface(vertices: np.ndarray, faces: np.ndarray, *, cells: int = MAX_CELLS) -> LevelSet:
    """Return the level set of a closed surface.

    Args:
        vertices: (V, 3) m, corners of the triangles.
        faces: (F, 3) indices into ``vertices``, wound outwards.
        cells: number of cells along the longest side, ``MIN_CELLS`` to ``MAX_CELLS``.

    Raises:
        UserError: the number of cells is out of range, or the surface has no extent.
    """
    if not MIN_CELLS <= cells <= MAX_CELLS:
        raise UserError(f"level set: {cells} cells are requested; give a number from {MIN_CELLS} to {MAX_CELLS}")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    spacing = float((high - low).max()) / cells
    if not spacing > 0.0:
        raise UserError("level set: the surface has no extent; give one that encloses a volume")
    origin = low - _MARGIN * spacing
    counts = np.ceil((high - low) / spacing).astype(int) + 2 * _MARGIN + 1
    return LevelSet.through(origin, spacing, _signed_distances(vertices, faces, origin, spacing, counts))


def level_set_of_body(solid: LatticeSolid, points: np.ndarray) -> LevelSet:
    """Return the level set of a captured body whose zero set passes through the outer contact points.

    The occupied lattice defines the shape, but the position of its surface is wrong by up to a cell. Therefore a smooth
    field moves the surface to the outer points (multilevel approximation of scattered data). The level set is the
    signed distance to the moved surface.

    Args:
        solid: the solid of the capture, in metres (``solid_from_gaussians`` with a resolution of ``MIN_CELLS`` to
            ``MAX_CELLS``).
        points: (P, 3) m, contact points at rest, without those of detached fragments, which would move the surface and
            hide points of it.
    """
    from skimage import measure

    inside: np.ndarray = np.pad(solid.inside, _MARGIN)
    origin, spacing = solid.spacing * (solid.corner - _MARGIN), solid.spacing
    outside_distance, depth = (
        np.asarray(ndimage.distance_transform_edt(each)) for each in (np.logical_not(inside), inside)
    )
    sharp = outside_distance - depth
    sharp -= 0.5 * np.sign(sharp)
    shape = np.minimum(np.asarray(ndimage.gaussian_filter(sharp, _SURFACE_BLUR)), sharp + _THIN_SLACK)
    places = (points[outer_points(points, EXPOSURE_RADIUS * spacing)] - origin) / spacing
    # End points lie three standard deviations from their means, so some may be outside the lattice.
    in_lattice = ((places >= 0.0) & (places < np.array(shape.shape) - 1.0)).all(axis=1)
    shape = _moved_to_points(shape, places[in_lattice])
    vertices, faces, _, _ = measure.marching_cubes(shape, 0.0)
    vertices = origin + spacing * vertices.astype(np.float64)
    counts = np.array(inside.shape)
    # Marching cubes places the surface between nodes at which ``shape`` has different signs.
    return LevelSet.through(
        origin, spacing, _signed_distances(vertices, faces, origin, spacing, counts, inside=shape < 0.0)
    )


def thin_parts(solid: LatticeSolid) -> ThinParts:
    """Return the parts of ``solid`` (in metres) that are thinner than two cells and may therefore be missing in its
    level set."""
    inside = np.pad(solid.inside, 1)
    # Mirror the solid in the plane, because the bottom of the body is not a free surface.
    inside[:, :, 0] = inside[:, :, 2]
    # This is a morphological opening by a block of two cells: the minimum filter covers a point and its successor, the
    # maximum filter a point and its predecessor.
    opened = ndimage.maximum_filter(ndimage.minimum_filter(inside, 2, origin=-1), 2)
    thin = (inside & np.logical_not(opened))[1:-1, 1:-1, 1:-1]
    labels = np.zeros(thin.shape, np.int32)
    ndimage.label(thin, structure=np.ones((3, 3, 3), bool), output=labels)
    sizes = np.bincount(labels.ravel())[1:]
    rest = opened[1:-1, 1:-1, 1:-1]
    if rest.any():
        from_rest = ndimage.distance_transform_edt(np.logical_not(rest))
        lengths = np.asarray(ndimage.maximum(from_rest, labels, 1 + np.arange(len(sizes)))).reshape(-1)
    else:
        boxes = ndimage.find_objects(labels)
        lengths = np.array([max(side.stop - side.start for side in box) for box in boxes], float)
    order = np.argsort(-lengths, kind="stable")
    order = order[lengths[order] >= _MIN_THIN_LENGTH]
    centres = np.array(ndimage.center_of_mass(thin, labels, 1 + order)).reshape(-1, 3)
    fraction = float(sizes[order].sum() / solid.inside.sum())
    return ThinParts(fraction, solid.points(centres), solid.spacing * lengths[order], 2.0 * solid.spacing)


def outer_points(points: np.ndarray, radius: float) -> np.ndarray:
    """Return the mask (P,) bool of the points that are exposed to the outside, which are the vertices of the outer
    boundary of the points' alpha shape (Edelsbrunner and Muecke 1994).

    A point is exposed if a ball of this radius can be moved from infinity until it touches the point without ever
    containing another point.

    Args:
        points: (P, 3) m, not all in one plane.
        radius: radius of the ball, m.
    """
    delaunay = Delaunay(points)
    neighbours, faces = delaunay.neighbors, delaunay.simplices[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]]
    # The ball passes from one tetrahedron to the next through their common face; face i is opposite to corner i.
    sides = [
        np.linalg.norm(points[faces[..., i]] - points[faces[..., j]], axis=-1) for i, j in ((0, 1), (1, 2), (2, 0))
    ]
    first, second = (points[faces[..., i]] - points[faces[..., 0]] for i in (1, 2))
    doubled_areas = np.linalg.norm(np.cross(first, second), axis=-1)
    passes = sides[0] * sides[1] * sides[2] > 2.0 * radius * doubled_areas
    here, there = np.nonzero(passes & (neighbours >= 0))
    there = neighbours[here, there]
    graph = coo_matrix((np.ones(len(here)), (here, there)), shape=(len(neighbours),) * 2)
    part = connected_components(graph, directed=False)[1]
    reached = np.isin(part, part[(passes & (neighbours < 0)).any(axis=1)])
    exposed = np.zeros(len(points), bool)
    exposed[delaunay.simplices[reached]] = True
    exposed[delaunay.convex_hull] = True
    return exposed


def _moved_to_points(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return ``values`` (nx, ny, nz) minus a smooth field such that their spline is nearly zero at ``places`` (n, 3).

    All lengths are in cells. Each correction is a Gaussian-weighted average of the spline's values at ``places``; it
    reduces the residual that the previous, wider corrections have left.
    """
    corner = np.floor(places).astype(int)
    fraction = places - corner
    cells, shares = [], []
    for offset in np.ndindex(2, 2, 2):
        cells.append(np.ravel_multi_index(tuple((corner + offset).T), values.shape))
        shares.append(np.prod(np.where(offset, fraction, 1.0 - fraction), axis=1))
    index, share = np.concatenate(cells), np.concatenate(shares)
    density = np.bincount(index, share, values.size).reshape(values.shape)
    for scale in _FIT_SCALES:
        coefficients = ndimage.spline_filter(values, order=2, output=np.float64, mode="mirror")
        errors = ndimage.map_coordinates(coefficients, places.T, order=2, prefilter=False, mode="mirror")
        total = np.bincount(index, share * np.tile(errors, 8), values.size).reshape(values.shape)
        smooth_total, smooth_density = (
            np.asarray(ndimage.gaussian_filter(each, scale, mode="constant")) for each in (total, density)
        )
        values = values - smooth_total / np.maximum(smooth_density, _FIT_FLOOR * smooth_density.max())
    return values


def _signed_distances(
    vertices: np.ndarray,
    faces: np.ndarray,
    origin: np.ndarray,
    spacing: float,
    counts: np.ndarray,
    *,
    inside: np.ndarray | None = None,
) -> np.ndarray:
    """Return the signed distances (nx, ny, nz) m of lattice nodes from a closed surface, negative inside. ``inside``
    (nx, ny, nz) is True at the nodes inside; if it is None, the winding number of the surface decides."""
    device = wp.get_device("cpu")
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    with wp.ScopedDevice(device):
        mesh = wp.Mesh(
            points=wp.array((vertices - centre).astype(np.float32), dtype=wp.vec3),
            indices=wp.array(np.ascontiguousarray(faces).ravel(), dtype=wp.int32),
            support_winding_number=inside is None,
        )
        nodes = origin - centre + spacing * np.moveaxis(np.indices(tuple(counts.tolist())), 0, -1).reshape(-1, 3)
        points = wp.array(nodes.astype(np.float32), dtype=wp.vec3)
        distances = empty(len(nodes), wp.float32, device)
    reach = spacing * float(np.linalg.norm(counts))
    launch_rows(
        surface_distance_kernel if inside is None else unsigned_distance_kernel,
        len(nodes),
        inputs=[mesh.id, points, reach],
        outputs=[distances],
        device=device,
    )
    values = distances.numpy().astype(np.float64).reshape(counts)
    return values if inside is None else np.where(inside, -values, values)
