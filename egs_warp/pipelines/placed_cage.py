"""Placement of a captured body: its frame on the ground, its cage in this frame, and its facing direction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.errors import ArgumentError
from egs_warp.fem.body import MAX_HEIGHT, MIN_HEIGHT
from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.capture import Capture
from egs_warp.meshing.body_gaussians import body_gaussians, centred, find_body_frame, representatives
from egs_warp.meshing.cage import Cage, cage_of_body, cage_of_mesh
from egs_warp.meshing.cage_file import read_cage_in
from egs_warp.meshing.occupancy import solid_from_gaussians
from egs_warp.motions.feet import SupportKind, support_kind_of
from egs_warp.motions.limbs import Limbs, Sections, find_limbs
from egs_warp.pipelines.facing_direction import Front, find_front
from egs_warp.segmentation.base_plane import find_base_plane, guess_up
from egs_warp.short_repr import short_repr

_CAGE_BITS = 32
"""Number of bits to which the cage's coordinates, divided by the height, are rounded."""
_FRONT_GRID = np.pi / 2**12
"""Rounding step of the facing direction, radians. Jumps are sensitive to the last bits of coordinates, which change if
a capture is rotated or its unit changes."""
_NOTED_NODE_RATIO = 1.25
"""Ratio of the number of cage nodes to the requested number above which a note says so."""
_FOOT_HEIGHT = 0.1
"""Fraction of the height above uneven ground below which parts of the object may touch it."""


def estimated_up(cloud: GaussianCloud, *, advice: str, tilted: bool = True) -> tuple[np.ndarray, str]:
    """Return the up direction (3,) of a capture, from its file or else estimated, also off the six axes if ``tilted``
    (``guess_up``). The second result is a note for the user that ends with ``advice``."""
    file_up, vertical_axis = (cloud.up, cloud.vertical_axis) if isinstance(cloud, Capture) else (None, None)
    up, reason = guess_up(cloud, file_up, tilted=tilted, vertical_axis=vertical_axis)
    axis = int(np.argmax(np.abs(up)))
    is_axis = np.abs(up[axis]) == 1.0
    name = f"{'-' if up[axis] < 0 else '+'}{'xyz'[axis]}" if is_axis else ",".join(f"{x:.3f}" for x in up)
    verb = "is" if file_up is not None else "is estimated as"
    return up, f"up {verb} {name} ({reason}); if that is wrong, {advice}"


def plane_below(cloud: GaussianCloud, ground: HeightField) -> Plane:
    """Return the reference plane of ``ground``, moved to the lowest ground under the object's foot.

    Raises ``ArgumentError`` if no part of ``cloud`` is above the ground.
    """
    means = cloud.means.numpy()[cloud.visible(0.3)].astype(np.float64)
    heights = ground.heights(means)
    if len(means) == 0 or not (heights > 0.0).any():
        raise ArgumentError("ground", "no part of the object lies above it", check=("plane",))
    low = means[(heights > 0.0) & (heights < _FOOT_HEIGHT * float(np.quantile(heights, 0.99)))]
    lift = float(ground.ground_height(low).min()) if len(low) else 0.0
    return Plane(ground.normal, ground.plane.offset - lift)


def simulation_device(cloud: GaussianCloud) -> str:
    """Return the device on which the body's steps are computed.

    This is the device of ``cloud``, or the CPU if PyTorch, whose tensors hold the matrices of the steps on a GPU, is
    missing or cannot use the GPU.
    """
    if cloud.device.is_cpu:
        return str(cloud.device)
    try:
        import torch
    except ImportError:
        return "cpu"
    return str(cloud.device) if torch.cuda.is_available() else "cpu"


@dataclass(frozen=True)
class PlacedCage:
    """The cage of a capture, in metres and in the frame of the body."""

    __repr__ = short_repr

    frame: BodyFrame
    """Frame of the body in the capture."""
    gaussians: GaussianCloud
    """Gaussians that define the body (``body_gaussians``); in a large capture, these are a subset
    (``representatives``)."""
    cage: Cage
    """Tetrahedral mesh around the Gaussians."""
    limbs: Limbs
    """Limbs on which the body stands, detected in the captured solid."""


def place_cage(
    cloud: GaussianCloud,
    *,
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    metres_per_unit: float | None = None,
    height: float | None = None,
    nodes: int = 500,
    cage_file: Path | None = None,
) -> PlacedCage:
    """Find the body's frame on its ground plane, and build its cage in that frame.

    Args:
        cloud: The capture.
        up: (3,) Up direction in the capture; without a ``plane``, the ground is the object's base, orthogonal to it.
        plane: Ground plane in the capture.
        metres_per_unit: Length of one unit of the capture, m; None uses ``height``.
        height: Height of the body, m; None makes it 1 m tall.
        nodes: Approximate number of cage nodes.
        cage_file: File with the tetrahedra of the cage (``read_cage_mesh``); None generates the tetrahedra.
    """
    near, anchor = centred(representatives(cloud))
    if plane is None:
        assert up is not None, "make_creature requires plane or up"
        plane = find_base_plane(near, up)
    else:
        plane = plane.moved(-anchor)
    frame = find_body_frame(near, plane)
    gaussians = body_gaussians(near, frame)
    solid = solid_from_gaussians(gaussians)
    if cage_file is None:
        cage = cage_of_body(gaussians, target_nodes=nodes, solid=solid)
    else:
        cage = cage_of_mesh(gaussians, read_cage_in(cage_file, frame.moved(anchor)), solid)
    metres = (height or 1.0) / cage.height(GROUND) if metres_per_unit is None else metres_per_unit / frame.scale
    cage = _rounded(cage.scaled(metres))
    limbs = find_limbs(Sections.of_solid(solid.scaled(metres), cage.mesh), cage.mesh.nodes)
    return PlacedCage(frame.moved(anchor).scaled(metres), gaussians.scaled(metres), cage, limbs)


def node_count_note(mesh: TetMesh, requested: int) -> tuple[str, ...]:
    """Return a note about a cage with many more nodes than ``requested``, on which the time of a step depends."""
    count = len(mesh.nodes)
    if count <= _NOTED_NODE_RATIO * requested:
        return ()
    return (
        f"the simulation takes longer: the cage needs {count} nodes instead of {requested} to enclose the thin parts of"
        " the body",
    )


def _rounded(cage: Cage) -> Cage:
    """Round the coordinates to ``_CAGE_BITS``, because their last bits depend on the unit of the capture."""
    step = 2.0 ** (np.rint(np.log2(cage.height(GROUND))) - _CAGE_BITS)
    return replace(cage, mesh=TetMesh(step * np.rint(cage.mesh.nodes / step), cage.mesh.tets))


def choose_front(
    standing: PlacedCage, front: np.ndarray | None = None, *, seen_from: np.ndarray | None = None
) -> Front:
    """Return the facing direction: ``front`` (3,) if given, otherwise the estimate of ``find_front``.

    Args:
        standing: The body.
        front: (3,) Facing direction in the capture's frame.
        seen_from: (3,) Mean of the unit vectors from the object to the cameras of its photos, in the capture's frame.
    """
    axes = standing.frame.axes
    if front is None:
        seen_in_body_frame = None if seen_from is None else axes @ seen_from
        mesh = standing.cage.mesh
        lies = support_kind_of(mesh, mesh.nodes[:, 2], standing.limbs.count) is SupportKind.LYING
        estimate = find_front(standing.gaussians, mesh, seen_from=seen_in_body_frame, lengthwise=lies)
        angle = _FRONT_GRID * np.rint(np.arctan2(estimate.direction[1], estimate.direction[0]) / _FRONT_GRID)
        return replace(estimate, direction=np.array([np.cos(angle), np.sin(angle), 0.0]))
    x, y, _ = axes @ front
    return Front(np.array([x, y, 0.0]) / np.hypot(x, y), None)


def check_front(up: np.ndarray, front: np.ndarray) -> None:
    """Raise ``ArgumentError`` if ``front`` (3,) is parallel to ``up`` (3,)."""
    if np.linalg.norm(np.cross(front, up)) < 1e-3 * np.linalg.norm(front) * np.linalg.norm(up):
        given = ",".join(f"{x:g}" for x in front)
        raise ArgumentError("front", "points up or down; give a direction along the ground", value=given)


def check_height(height: float | None, metres_per_unit: float | None) -> None:
    """Raise ``ArgumentError`` if ``height`` (m) is outside its limits, or given together with ``metres_per_unit``."""
    if height is None:
        return
    if metres_per_unit is not None:
        raise ArgumentError("height", "metres_per_unit defines the size, too; give one of them", value=height)
    if not MIN_HEIGHT <= height <= MAX_HEIGHT:
        raise ArgumentError("height", f"give metres from {MIN_HEIGHT:g} to {MAX_HEIGHT:g}", value=height)
