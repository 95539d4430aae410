"""Trajectory of a simulation, with all solver steps, contacts and external pushes; and the outcome of a motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np

from egs_warp.checked_calls import checked_method
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.io.arrays import read_npz
from egs_warp.io.atomic import atomic_write

SCHEMA = 3
"""Version of ``trajectory.npz`` (docs/guide/report.md)."""
FIRST_PART = "start.npz"
"""File of the first part of a recording: all constant data, and the first state."""


@dataclass(frozen=True)
class Trajectory:
    """Trajectory of F solver steps of N nodes, with C contacts and J joint forces in total. Units: m, s, kg, N. The
    annotation of an array contains its extents (``EXTENTS``).

    The coordinates are in the body's frame, whose z axis points up, orthogonal to the ground. ``body_axes``,
    ``body_origin`` and ``metres_per_unit`` place this frame in the capture.
    """

    time: Annotated[np.ndarray, "states"]
    """(F+1,) s, time of each state."""
    dt: Annotated[np.ndarray, "steps"]
    """(F,) s, size of each step."""
    positions: Annotated[np.ndarray, "states", "nodes", 3]
    """(F+1, N, 3) m, nodal positions."""
    velocities: Annotated[np.ndarray, "states", "nodes", 3]
    """(F+1, N, 3) m/s, nodal velocities."""
    rest_positions: Annotated[np.ndarray, "nodes", 3]
    """(N, 3) m, nodal positions of the captured shape, in which Gaussians and muscles are embedded."""
    unloaded_positions: Annotated[np.ndarray, "nodes", 3]
    """(N, 3) m, nodal positions without elastic stress."""
    tets: Annotated[np.ndarray, "tets", 4]
    """(T, 4) int32, nodes of each tetrahedron."""
    node_mass: Annotated[np.ndarray, "nodes"]
    """(N,) kg, lumped masses."""
    gravity: Annotated[np.ndarray, 3]
    """(3,) m/s^2, gravitational acceleration."""
    planes: Annotated[np.ndarray, "planes", 4]
    """(P, 4) rows (n, d) of the planes n.x + d = 0. The first plane is the ground; if the ground is not flat, it is the
    level from which its heights are measured."""
    solid_from_plane: Annotated[np.ndarray, "planes"]
    """(P,) int32, solid of each plane. A point is inside a solid if it is below all of its planes; a solid of one plane
    is a half space."""
    friction: float
    """Coulomb coefficient mu."""
    drag: float
    """alpha of the Rayleigh damping, 1/s."""
    young_modulus: float
    """Young's modulus E, Pa."""
    poisson_ratio: float
    """Poisson's ratio nu."""
    damping_time: float
    """beta of the Rayleigh damping, s."""
    height: float
    """Height H of the body, m."""
    contact_step: Annotated[np.ndarray, "contacts"]
    """(C,) int32, step of each contact; step i leads from state i to state i+1."""
    contact_nodes: Annotated[np.ndarray, "contacts", 4]
    """(C, 4) int32, nodes of the tetrahedron of each contact point."""
    contact_weights: Annotated[np.ndarray, "contacts", 4]
    """(C, 4) barycentric weights of the contact point."""
    contact_plane: Annotated[np.ndarray, "contacts"]
    """(C,) int32, row of ``planes``; 0 is the ground, flat or not; -1 - k for a contact with body k of the world."""
    contact_normal: Annotated[np.ndarray, "contacts", 3]
    """(C, 3) unit normal of the contact plane, or of uneven ground below the contact at the start of the step."""
    contact_force: Annotated[np.ndarray, "contacts", 3]
    """(C, 3) N, force on the body in world axes."""
    contact_gap: Annotated[np.ndarray, "contacts"]
    """(C,) m, gap of the contact at the end of the step."""
    min_gap: Annotated[np.ndarray, "states"]
    """(F+1,) m, minimum gap of all contact points of the body to the ground, the solids and other bodies."""
    activations: Annotated[np.ndarray, "steps", "segments"]
    """(F, M) m, muscle activations, constant over a step; the tension of a segment is its stiffness times its
    activation."""
    muscle_end_starts: Annotated[np.ndarray, "offsets"]
    """(K+1,) int32, offset of each muscle end in ``muscle_end_nodes`` and ``muscle_end_weights``. The position of end k
    is the sum of weight times node position over its entries."""
    muscle_end_nodes: Annotated[np.ndarray, "entries"]
    """(E,) int32, node of each entry."""
    muscle_end_weights: Annotated[np.ndarray, "entries"]
    """(E,) weight of each entry."""
    muscle_segments: Annotated[np.ndarray, "segments", 2]
    """(M, 2) int32, the two ends of each segment."""
    muscle_rest_lengths: Annotated[np.ndarray, "segments"]
    """(M,) m, rest length of each segment."""
    muscle_stiffness: Annotated[np.ndarray, "segments"]
    """(M,) N/m, stiffness of each segment."""
    ground_axes: Annotated[np.ndarray, 3, 3] = field(default_factory=lambda: np.eye(3))
    """(3, 3) rows: axes along columns, rows and heights of uneven ground."""
    ground_origin: Annotated[np.ndarray, 3] = field(default_factory=lambda: np.zeros(3))
    """(3,) m, position of grid node (0, 0) at height 0."""
    ground_spacing: float = 1.0
    """Distance between grid nodes, m."""
    ground_coefficients: Annotated[np.ndarray, "rows", "columns"] = field(default_factory=lambda: np.zeros((0, 0)))
    """(rows, columns) m, coefficients of the biquadratic B-spline of the ground (``HeightField``); empty if the ground
    is flat."""
    joint_step: Annotated[np.ndarray, "joints"] = field(default_factory=lambda: np.zeros(0, np.int32))
    """(J,) int32, step of each force of a joint on the body."""
    joint_index: Annotated[np.ndarray, "joints"] = field(default_factory=lambda: np.zeros(0, np.int32))
    """(J,) int32, index of the joint in the world."""
    joint_nodes: Annotated[np.ndarray, "joints", 4] = field(default_factory=lambda: np.zeros((0, 4), np.int32))
    """(J, 4) int32, nodes of the tetrahedron with which the point of the joint moves."""
    joint_weights: Annotated[np.ndarray, "joints", 4] = field(default_factory=lambda: np.zeros((0, 4)))
    """(J, 4) barycentric weights of the point."""
    joint_force: Annotated[np.ndarray, "joints", 3] = field(default_factory=lambda: np.zeros((0, 3)))
    """(J, 3) N, force on the body in world axes."""
    kick_step: Annotated[np.ndarray, "kicks"] = field(default_factory=lambda: np.zeros(0, np.int32))
    """(K,) int32, steps with external pushes."""
    kick_velocity: Annotated[np.ndarray, "kicks", "nodes", 3] = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """(K, N, 3) m/s, velocities that the pushes added to the nodes at the start of the step."""
    planned_com: Annotated[np.ndarray, "planned", 3] = field(default_factory=lambda: np.zeros((0, 3)))
    """(F+1, 3) m, planned centre of mass, NaN for states without a plan; no rows if nothing was planned."""
    body_axes: Annotated[np.ndarray, 3, 3] = field(default_factory=lambda: np.eye(3))
    """(3, 3) rows: this frame's x, y and z in the capture's axes."""
    body_origin: Annotated[np.ndarray, 3] = field(default_factory=lambda: np.zeros(3))
    """(3,) this frame's origin in the capture, in the capture's unit."""
    metres_per_unit: float = 1.0
    """Length of the capture's unit, m."""
    front: Annotated[np.ndarray, 3] = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    """(3,) unit vector along the ground in which the body at rest faces; the x axis if the file does not contain it."""
    relative_stiffness: Annotated[np.ndarray, "tets"] = field(default_factory=lambda: np.zeros(0))
    """(T,) Young's modulus of each element relative to ``young_modulus``; empty if it is the same everywhere."""
    world_index: int = -1
    """Index of a creature in its world, as in ``contact_plane``; -1 for a creature alone and for a prop, which have no
    contact with themselves."""

    def __repr__(self) -> str:
        states, nodes = self.positions.shape[:2]
        return f"Trajectory({self.time[0]:.2f} to {self.time[-1]:.2f} s, {states:,} states of {nodes} nodes)"

    @property
    def is_self_contact(self) -> np.ndarray:
        """(C,) bool, True for the contacts of the body with itself; each has two records with opposite forces."""
        return (self.contact_plane < 0) & (self.contact_plane == -1 - self.world_index)

    @property
    def capture_frame(self) -> BodyFrame:
        """Placement of this frame in the capture."""
        return BodyFrame(self.body_axes, self.body_origin, self.metres_per_unit)

    def in_capture(self, points: np.ndarray) -> np.ndarray:
        """Transform ``points`` (..., 3) m from this frame to the frame and unit of the capture."""
        return self.capture_frame.capture_points(points)

    def with_plan(self, planned_com: np.ndarray) -> Trajectory:
        """Return a copy with the planned centre of mass, (F+1, 3) m."""
        return replace(self, planned_com=planned_com)

    @checked_method
    def save(self, path: Path) -> None:
        """Write ``trajectory.npz``; equal trajectories give equal bytes."""
        write_arrays(path, {name: np.asarray(getattr(self, name)) for name in self.__dataclass_fields__})

    @classmethod
    @checked_method
    def load(cls, path: Path) -> Trajectory:
        """Read a file that ``save`` has written, or the steps so far in the folder of a ``Recorder``.

        Raises:
            ValueError: the file has another schema.
        """
        if not path.is_dir():
            return cls._of(read_arrays(path))
        return cls.from_parts([read_arrays(part) for part in (path / FIRST_PART, *part_paths(path))])

    @classmethod
    def from_parts(cls, parts: Sequence[dict[str, np.ndarray]]) -> Trajectory:
        """Concatenate the parts of a recording; the first one contains the first state and all constant data."""
        values = dict(parts[0])
        for name, extents in EXTENTS.items():
            if extents[0] in ("states", "steps", "contacts", "joints", "kicks") and name in values:
                values[name] = np.concatenate([part[name] for part in parts])
        return cls._of(values)

    @classmethod
    def _of(cls, values: dict[str, Any]) -> Trajectory:
        known = {name: values[name] for name in cls.__dataclass_fields__ if name in values}
        for name in known.keys() & {name for name, kind in cls.__annotations__.items() if kind == "float"}:
            known[name] = float(known[name])
        if "world_index" in known:
            known["world_index"] = int(known["world_index"])
        return cls(**known)


_HINTS = {name: get_args(hint) for name, hint in get_type_hints(Trajectory, include_extras=True).items()}
EXTENTS: dict[str, tuple[str | int, ...]] = {name: arguments[1:] for name, arguments in _HINTS.items() if arguments}
"""Extents of each array of a ``Trajectory``, as numbers or names; extents with the same name are equal. Arrays with one
row for each of the states, steps, contacts, joint forces or kicks grow during a run."""
CONTACTS = tuple(name for name, extents in EXTENTS.items() if extents[0] == "contacts")
"""Arrays with one row for each of the C contacts."""
JOINTS = tuple(name for name, extents in EXTENTS.items() if extents[0] == "joints")
"""Arrays with one row for each of the J forces of joints."""


def part_name(number: int) -> str:
    """Return the file name of part ``number`` of a recording, counted from 0."""
    return f"steps-{number:06d}.npz"


def part_paths(folder: Path) -> list[Path]:
    """Return the paths of the parts with steps in the ``folder`` of a recording, in order, including missing ones in
    between."""
    return [folder / part_name(number) for number in range(len(list(folder.glob("steps-*.npz"))))]


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write ``arrays`` under their names; the file is complete or absent."""
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, schema=np.int64(SCHEMA), **arrays)  # pyright: ignore[reportArgumentType]


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a file that ``write_arrays`` has written.

    Raises:
        ValueError: the file has another schema.
        READ_ERRORS: the file cannot be read.
    """
    arrays = read_npz(path)
    schema = int(arrays.pop("schema", 1))
    if schema != SCHEMA:
        raise ValueError(f"its schema is {schema}, but this version reads schema {SCHEMA}")
    return arrays


@dataclass(frozen=True)
class MotionOutcome:
    """Measured outcome of a motion; lengths are in body heights."""

    distance: float
    """Horizontal displacement of the centre of mass from the start, or from the standing body, to the end."""
    height: float
    """Maximum height of the centre of mass minus its height at the start, or of the standing body."""
    heading_degrees: float
    """Rotation about the plane's normal, including full turns."""
    tilt_degrees: float
    """Angle between the normal and the up axis of the body's best-fit rotation, at the end."""
    airborne_frames: float
    """Longest time during which no contact point touches the ground or a solid, in frames of 1/60 s."""


def measure(
    trajectory: Trajectory, *, first: int = 0, last: int = -1, standing_com: np.ndarray | None = None
) -> MotionOutcome:
    """Measure the outcome between the states ``first`` and ``last`` (indices into ``time``). ``standing_com`` (3,) m is
    the centre of mass from which distance and height are measured; None uses the one of the first state."""
    t = trajectory
    last = last % len(t.time)
    up = -t.gravity / np.linalg.norm(t.gravity)
    com = np.einsum("n,fni->fi", t.node_mass, t.positions[first : last + 1]) / t.node_mass.sum()
    start = com[0] if standing_com is None else standing_com
    displacement = com[-1] - start
    upright = _best_fit(t, t.positions[last]) @ up
    heading = _headings(t, first, last, up)[-1]
    longest = run_start = 0.0
    above = False
    for time, gap in zip(t.time[first : last + 1], t.min_gap[first : last + 1], strict=True):
        if gap > 0.0:
            run_start = run_start if above else time
            longest = max(longest, time - run_start)
        above = gap > 0.0
    return MotionOutcome(
        distance=float(np.linalg.norm(displacement - (displacement @ up) * up) / t.height),
        height=float(((com - start) @ up).max() / t.height),
        heading_degrees=float(np.degrees(heading)),
        tilt_degrees=float(np.degrees(np.arccos(np.clip(upright @ up, -1.0, 1.0)))),
        airborne_frames=round(60.0 * longest, 6),
    )


def _best_fit(t: Trajectory, positions: np.ndarray) -> np.ndarray:
    """Return (3, 3), best-fit rotation from the rest positions to ``positions`` (Kabsch)."""
    rest = t.rest_positions - t.node_mass @ t.rest_positions / t.node_mass.sum()
    arms = positions - t.node_mass @ positions / t.node_mass.sum()
    return kabsch_rotation(t.node_mass, rest, arms)


def _headings(t: Trajectory, first: int, last: int, up: np.ndarray) -> np.ndarray:
    """Return (n,) rad, rotation about ``up`` since the state ``first``, unwrapped so that full turns are included."""
    start = _best_fit(t, t.positions[first])
    angles = []
    for positions in t.positions[first : last + 1]:
        rotation = _best_fit(t, positions) @ start.T
        axis = np.array(
            [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
        )
        angles.append(np.arctan2(axis @ up, np.trace(rotation) - up @ rotation @ up))
    return np.unwrap(angles)
