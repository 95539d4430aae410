"""Obstacles of a world from a captured scene: the ground with its edge, and convex solids beside and above it.

The remaining scene is represented by the occupied cells of a lattice in the frame of the world. Occupied cells near the
plane of the lowest object are ground. Where there are no such cells, the ground falls to the surface below, or to a
floor. Occupied cells above the ground are covered with boxes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from scipy import ndimage

from egs_warp.contact.terrain import Solid
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.geometry.bitmaps import connected_parts
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.box_cover import cover_with_boxes
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.kernels.meshing.occupancy import OPACITY_UNIT, splat_occupancy_kernel
from egs_warp.meshing.occupancy import fill_enclosed
from egs_warp.pipelines.prepare_objects import PreparedObjects
from egs_warp.short_repr import short_repr

_CELL = 0.04
"""Distance between lattice points, relative to the height of the tallest object."""
_REACH, _DEPTH, _ABOVE = 2.5, 2.0, 0.5
"""Extents of the lattice, relative to the height of the tallest object: beside the objects, below the ground, and above
the highest object. A body that falls over the edge of the ground lands on a floor at the depth ``_DEPTH``, unless the
capture shows a surface above this floor."""
_OPACITY = 0.5
"""Sum of opacities above which a cell is occupied."""
_MIN_OPACITY, _MAX_WIDTH = 0.2, 0.25
"""Minimum opacity of Gaussians that count, and maximum of their smallest standard deviation, relative to the height of
the tallest object. All other Gaussians are haze."""
_MAX_SIGMA = 0.5
"""Maximum standard deviation of a Gaussian in the lattice, relative to the height of the tallest object."""
_BAND = 1.5
"""Maximum distance of ground cells from the height of the ground, cells."""
_CLOSED = 2
"""Half of the maximum width of gaps in the ground that are closed, cells."""
_MIN_GROUND, _MAX_HOLE = 40, 200
"""Minimum number of columns in a part of the ground, and maximum number of columns in a hole in it that is closed."""
_FOOT = 0.1
"""Height below which points of an object are its feet, relative to the height of the tallest object."""
_MIN_EDGE = 0.02
"""Fraction of the columns that have no ground above which the ground is considered to have an edge."""
_MIN_SOLID = 60
"""Minimum number of cells of an obstacle; smaller parts are specks."""
_CLEARANCE = 2
"""Distance from the objects, in cells, within which cells are not obstacles, because they are remnants of the
objects."""
_MAX_BOXES = 32
"""Maximum number of boxes. The time for contact detection is proportional to the number of their faces."""
_GROUND_SPACING = 0.05
"""Distance between the nodes of the ground, relative to the height of the shortest object."""


@dataclass(frozen=True)
class SceneObstacles:
    """Ground and obstacles of a world that were measured in a scene; metres, in the frame of the world."""

    __repr__ = short_repr

    ground: HeightField | None
    """The ground; None if it is the plane z = 0 without an edge."""
    solids: tuple[Solid, ...]
    """Convex solids beside and above the ground."""
    low: np.ndarray
    """(3,) lower corner of the measured box."""
    high: np.ndarray
    """(3,) upper corner of the measured box."""
    notes: tuple[str, ...] = ()
    """Notes for the user."""


@dataclass(frozen=True)
class _Lattice:
    """Occupied cells of the remaining scene."""

    origin: np.ndarray
    """(3,) m, position of cell (0, 0, 0)."""
    spacing: float
    """Distance between cells, m."""
    occupied: np.ndarray
    """(nx, ny, nz) bool."""

    def axis(self, number: int) -> np.ndarray:
        """Return the coordinates (n,) m of the cells along an axis."""
        return self.origin[number] + self.spacing * np.arange(self.occupied.shape[number])

    def cells_of(self, points: np.ndarray) -> np.ndarray:
        """Return the cells (n, 3) int of ``points`` (m, 3) m that are in the lattice."""
        cells = np.rint((points - self.origin) / self.spacing).astype(int)
        return cells[((cells >= 0) & (cells < self.occupied.shape)).all(axis=1)]


def measure_obstacles(
    prepared: PreparedObjects,
    frame: BodyFrame,
    *,
    height: float,
    solids: tuple[Solid, ...] | None = None,
    is_measured: bool = True,
) -> SceneObstacles:
    """Measure the ground and the obstacles near the objects of a scene.

    Args:
        prepared: The objects and the remaining scene.
        frame: Frame of the world in the capture.
        height: Height of the tallest object, m.
        solids: Obstacles in the frame and units of the capture that replace the measured ones; None measures them.
        is_measured: True to measure the edge of the ground and the obstacles.
    """
    given = None if solids is None else tuple(Solid(tuple(frame.plane(face) for face in one.faces)) for one in solids)
    objects = {name: _points(scene.object, frame) for name, scene in prepared.scenes.items()}
    lattice = _occupied(to_body_frame(prepared.background, frame), np.concatenate(list(objects.values())), height)
    low, high = lattice.origin, lattice.origin + lattice.spacing * (np.array(lattice.occupied.shape) - 1)
    field = _measured_ground(prepared, frame, lattice, min(float(np.ptp(each[:, 2])) for each in objects.values()))
    if not is_measured:
        ground = field if any(scene.ground is not None for scene in prepared.scenes.values()) else None
        return SceneObstacles(ground, given or (), low, high)
    notes = []
    heights = field.ground_height(_columns(lattice))
    feet = np.concatenate([each[each[:, 2] < _FOOT * height] for each in objects.values()])
    known = _known_ground(lattice, heights, feet)
    is_uneven = any(scene.ground is not None for scene in prepared.scenes.values())
    if (~known).mean() > _MIN_EDGE:
        field = _with_edge(field, lattice, heights, known, height)
        notes.append(
            f"the ground ends beside the objects ({100 * float(known.mean()):.0f} % of the area within"
            f" {_REACH * height:.2g} m is ground); what goes over its edge falls"
        )
    elif not is_uneven:
        field = None
    if given is None:
        planes = {name: frame.plane(plane) for name, plane in prepared.planes.items()}
        given, note = _boxes(lattice, heights, objects, planes)
        notes.append(note)
    return SceneObstacles(field, given, low, high, tuple(notes))


def _points(cloud: GaussianCloud, frame: BodyFrame) -> np.ndarray:
    """Return the means (n, 3) m of the opaque Gaussians of an object in the frame of the world."""
    return frame.points(cloud.means.numpy()[cloud.visible(_MIN_OPACITY)])


def _occupied(scene: GaussianCloud, objects: np.ndarray, height: float) -> _Lattice:
    """Return the occupied cells of ``scene`` around the ``objects`` (n, 3) m."""
    spacing = _CELL * height
    low, high = np.quantile(objects, [0.002, 0.998], axis=0)
    low = np.append(low[:2] - _REACH * height, -_DEPTH * height)
    high = high + [_REACH * height, _REACH * height, _ABOVE * height]
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    thickness = np.exp(scene.log_scales.numpy()).min(axis=1)
    chosen = scene.subset(scene.visible(_MIN_OPACITY) & (thickness < _MAX_WIDTH * height))
    total = wp.zeros(tuple(counts.tolist()), dtype=wp.int32, device=scene.device)
    wp.launch(
        splat_occupancy_kernel,
        dim=chosen.count,
        inputs=[
            chosen.means,
            chosen.rotations,
            chosen.log_scales,
            chosen.opacity_logits,
            wp.vec3(*low.tolist()),
            spacing,
            _MAX_SIGMA * height,
        ],
        outputs=[total],
        device=scene.device,
    )
    return _Lattice(low, spacing, total.numpy() >= int(_OPACITY * int(OPACITY_UNIT)))


def _columns(lattice: _Lattice) -> np.ndarray:
    """Return the positions (nx, ny, 3) m of the columns of the lattice on the plane z = 0."""
    x, y = np.meshgrid(lattice.axis(0), lattice.axis(1), indexing="ij")
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def _measured_ground(prepared: PreparedObjects, frame: BodyFrame, lattice: _Lattice, height: float) -> HeightField:
    """Return the ground without an edge: the mean of the grounds that were measured around the lowest objects, weighted
    by the inverse squares of the distances from the objects. For an object on flat ground, the plane z = 0 is used."""
    spacing = _GROUND_SPACING * height
    low, high = (np.array([lattice.axis(k)[end] for k in range(2)]) for end in (0, -1))
    columns, rows = np.ceil((high - low) / spacing).astype(int) + 1
    x, y = np.meshgrid(low[0] + spacing * np.arange(columns), low[1] + spacing * np.arange(rows))
    nodes = np.stack([x, y, np.zeros_like(x)], axis=-1)
    total, weights = np.zeros(x.shape), np.zeros(x.shape)
    for name, scene in prepared.scenes.items():
        if prepared.planes[name] is not prepared.lowest_plane:
            continue
        weight = 1.0 / (((nodes - frame.points(scene.located.centre))[..., :2] ** 2).sum(axis=-1) + spacing**2)
        if scene.ground is not None:
            total += weight * _heights_along_z(frame.height_field(scene.ground), nodes)
        weights += weight
    return HeightField.through(np.eye(3), np.append(low, 0.0), spacing, total / weights)


def _heights_along_z(field: HeightField, points: np.ndarray) -> np.ndarray:
    """Return the heights (...,) m of ``field`` along z over ``points`` (..., 3) m of the plane z = 0, by simplified
    Newton iterations with the normal of the reference plane."""
    up, moved = np.array([0.0, 0.0, 1.0]), points.copy()
    for _ in range(4):
        moved = moved - (field.heights(moved) / float(up @ field.normal))[..., None] * up
    return moved[..., 2]


def _known_ground(lattice: _Lattice, heights: np.ndarray, feet: np.ndarray) -> np.ndarray:
    """Return the mask (nx, ny) bool of columns that have ground at ``heights`` (nx, ny) m. The columns of the ``feet``
    (n, 3) m, which are the lower parts of the objects, and small holes count as ground."""
    band = np.abs(lattice.axis(2) - heights[..., None]) <= _BAND * lattice.spacing
    known = np.asarray((lattice.occupied & band).any(axis=2))
    at = lattice.cells_of(feet)
    known[at[:, 0], at[:, 1]] = True
    known = np.asarray(ndimage.binary_closing(np.pad(known, _CLOSED, mode="edge"), iterations=_CLOSED), bool)
    known = known[_CLOSED:-_CLOSED, _CLOSED:-_CLOSED]
    for mask, limit in ((known, _MIN_GROUND), (~known, _MAX_HOLE)):
        parts, _ = connected_parts(mask)
        small = np.bincount(parts.ravel()) < limit
        small[0] = False
        known = known ^ small[parts]
    return known


def _with_edge(
    field: HeightField, lattice: _Lattice, heights: np.ndarray, known: np.ndarray, height: float
) -> HeightField:
    """Return the ground with an edge: beyond the ``known`` (nx, ny) columns, it falls to the highest occupied cell
    below, or to a floor ``_DEPTH`` below z = 0. The slope at the edge is as wide as one spacing of the nodes."""
    z = lattice.axis(2)
    below = lattice.occupied & (z < heights[..., None] + _BAND * lattice.spacing)
    top = np.where(below, z, -_DEPTH * height).max(axis=2)
    # The median filter removes specks of a single column.
    top = np.asarray(ndimage.median_filter(top, 5))
    nodes = field.nodes()
    at = ((nodes[..., :2] - lattice.origin[:2]) / lattice.spacing).transpose(2, 0, 1)
    # Because of the dilation, the ground ends one cell beyond the far side of its outermost cells.
    wide = np.asarray(ndimage.binary_dilation(known))
    is_ground = ndimage.map_coordinates(wide.astype(float), at, order=1, mode="nearest") > 0.5
    lower = ndimage.map_coordinates(top, at, order=1, mode="nearest")
    # Use the heights of the nodes as coefficients of the spline, so that it does not overshoot at the edge.
    return replace(field, coefficients=np.where(is_ground, field.coefficients, np.minimum(lower, field.coefficients)))


def _boxes(
    lattice: _Lattice, heights: np.ndarray, objects: dict[str, np.ndarray], planes: dict[str, Plane]
) -> tuple[tuple[Solid, ...], str]:
    """Return boxes that cover the occupied cells above the ground, and a note for the user.

    The top of a box below an object is moved to the plane of the object if it is less than a cell away.
    """
    spacing, z = lattice.spacing, lattice.axis(2)
    above = z > heights[..., None] + _BAND * spacing
    free = np.zeros(above.shape, bool)
    for name, points in objects.items():
        near = np.zeros(above.shape, bool)
        near[tuple(lattice.cells_of(points).T)] = True
        near = np.asarray(ndimage.binary_dilation(near, np.ones((3, 3, 3), bool), iterations=_CLEARANCE), bool)
        free |= near & (z > -planes[name].offset + 0.25 * spacing)
    solid = _filled(lattice.occupied | ~above, free) & above & ~free
    labels = np.zeros(solid.shape, np.int32)
    ndimage.label(solid, structure=np.ones((3, 3, 3), bool), output=labels)
    large = np.bincount(labels.ravel()) >= _MIN_SOLID
    large[0] = False
    solid = large[labels]
    cover = cover_with_boxes(solid, max_boxes=_MAX_BOXES)
    boxes = []
    for first, last in cover.boxes:
        low = lattice.origin + spacing * (first - 0.5)
        high = lattice.origin + spacing * (last - 0.5)
        ground = heights[first[0] : last[0], first[1] : last[1]]
        if low[2] < float(ground.max()) + 2.0 * spacing:
            low[2] = float(ground.min()) - 2.0 * spacing
        for name, points in objects.items():
            base = -planes[name].offset
            is_below = ((points[:, :2] > low[:2]) & (points[:, :2] < high[:2])).all(axis=1).any()
            if is_below and abs(high[2] - base) < spacing:
                high[2] = base
        boxes.append(box_between(low, high))
    count = f"{len(boxes)} boxes cover" if len(boxes) > 1 else "a box covers"
    note = f"obstacles: {count} {100 * cover.share:.0f} % of what stands beside the objects"
    return tuple(boxes), note if boxes else "obstacles: none; nothing stands beside the objects"


def _filled(occupied: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return ``occupied`` (nx, ny, nz) bool with enclosed space filled, except for space that is connected to ``free``
    cells, because the walls of a room also enclose its objects."""
    added = fill_enclosed(occupied, wp.get_device("cpu")) & ~occupied
    labels = np.zeros(added.shape, np.int32)
    ndimage.label(added, output=labels)
    is_free = np.bincount(labels[free & added], minlength=int(labels.max()) + 1) > 0
    is_free[0] = True
    return occupied | ~is_free[labels]


def box_between(low: np.ndarray, high: np.ndarray) -> Solid:
    """Return the box from ``low`` (3,) to ``high`` (3,)."""
    axes = np.eye(3)
    faces = [Plane(axes[k], -float(high[k])) for k in range(3)] + [Plane(-axes[k], float(low[k])) for k in range(3)]
    return Solid(tuple(faces))
