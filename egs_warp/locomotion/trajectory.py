"""What a simulation leaves behind: every solver step, its contacts, all that acted on the body; and what it reached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.io.arrays import read_npz
from egs_warp.io.atomic import atomic_write

SCHEMA = 2
"""Of ``trajectory.npz`` (docs/guide/report.md)."""
STATES = ("time", "positions", "velocities", "min_gap")
"""Arrays of F+1 rows."""
STEPS = ("dt", "activations")
"""Arrays of F rows."""
CONTACTS = (
    "contact_step",
    "contact_nodes",
    "contact_weights",
    "contact_plane",
    "contact_normal",
    "contact_force",
    "contact_gap",
)
"""Arrays of C rows."""
KICKS = ("kick_step", "kick_velocity")
"""Arrays of a row for each step that something from outside pushes in."""
FIRST_PART = "start.npz"
"""Of a recording that goes on: what never changes, and the state it began at."""


@dataclass(frozen=True)
class Trajectory:
    """F solver steps of N nodes with C contacts in all. Metres, seconds, kilograms, newtons; z is up, square to the
    ground.

    The frame is the body's own: where that lies in the capture, the last three fields say.
    """

    time: np.ndarray
    """(F+1,)."""
    dt: np.ndarray
    """(F,) of each step."""
    positions: np.ndarray
    """(F+1, N, 3)."""
    velocities: np.ndarray
    """(F+1, N, 3)."""
    rest_positions: np.ndarray
    """(N, 3)."""
    tets: np.ndarray
    """(T, 4) int32."""
    node_mass: np.ndarray
    """(N,)."""
    gravity: np.ndarray
    """(3,)."""
    planes: np.ndarray
    """(P, 4) rows n, d of n.x + d = 0; the first is the ground, or where it is not flat the level that its heights are
    told from in the body's frame."""
    solid_from_plane: np.ndarray
    """(P,) int32: a point is inside a solid if it is below all of its planes; a solid of one plane is a half space."""
    friction: float
    drag: float
    """alpha of Rayleigh damping, 1/s."""
    young_modulus: float
    """Pascals."""
    poisson_ratio: float
    damping_time: float
    """beta of Rayleigh damping, s."""
    height: float
    """H, metres."""
    contact_step: np.ndarray
    """(C,) int32: step i leads from time i to time i+1."""
    contact_nodes: np.ndarray
    """(C, 4) int32."""
    contact_weights: np.ndarray
    """(C, 4)."""
    contact_plane: np.ndarray
    """(C,) int32: row of ``planes``; 0 is the ground, flat or not."""
    contact_normal: np.ndarray
    """(C, 3) unit, of that plane, or of uneven ground where the contact was at the start of the step."""
    contact_force: np.ndarray
    """(C, 3) newtons on the body, world axes."""
    contact_gap: np.ndarray
    """(C,) metres at the end of the step, from the plane that it is held to in the step."""
    min_gap: np.ndarray
    """(F+1,) metres, smallest gap of all contact Gaussians."""
    activations: np.ndarray
    """(F, M) metres: a segment pulls with its stiffness times this, constant over the step."""
    muscle_end_starts: np.ndarray
    """(K+1,) int32: end k of the muscles is the sum of weight times node over the entries ``starts[k]`` to
    ``starts[k + 1]``."""
    muscle_end_nodes: np.ndarray
    """(E,) int32."""
    muscle_end_weights: np.ndarray
    """(E,)."""
    muscle_segments: np.ndarray
    """(M, 2) int32: the two ends of each segment."""
    muscle_rest_lengths: np.ndarray
    """(M,)."""
    muscle_stiffness: np.ndarray
    """(M,) N/m."""
    ground_axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3) rows: along columns, rows and heights of uneven ground."""
    ground_origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) where its node (0, 0) lies at height 0."""
    ground_spacing: float = 1.0
    """Metres between its nodes."""
    ground_coefficients: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """(rows, columns) metres, of its biquadratic B-spline (``HeightField``); of none where the ground is flat."""
    kick_step: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    """(K,) int32: steps in which something from outside pushed."""
    kick_velocity: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """(K, N, 3) m/s that it gave the nodes as the step began."""
    planned_com: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """(F+1, 3) centre of mass as planned, NaN where nothing was; or no rows."""
    body_axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3) rows: this frame's x, y and z in the capture's axes."""
    body_origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) this frame's origin in the capture, capture's units."""
    metres_per_unit: float = 1.0
    """Of the capture's unit."""

    def in_capture(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of this frame in the capture's frame and units."""
        return BodyFrame(self.body_axes, self.body_origin, self.metres_per_unit).capture_points(points)

    def with_plan(self, planned_com: np.ndarray) -> Trajectory:
        """The same trajectory beside where the centre of mass was planned to be, (F+1, 3)."""
        return replace(self, planned_com=planned_com)

    def save(self, path: Path) -> None:
        """Write ``trajectory.npz``; the same trajectory gives the same bytes."""
        write_arrays(path, {name: np.asarray(getattr(self, name)) for name in self.__dataclass_fields__})

    @classmethod
    def load(cls, path: Path) -> Trajectory:
        """Read what ``save`` wrote, or as much of a run as there is in the folder of a ``Recorder``.

        Raises ``ValueError`` for a file of another schema.
        """
        if not path.is_dir():
            return cls._of(read_arrays(path))
        return cls.joined([read_arrays(part) for part in (path / FIRST_PART, *part_paths(path))])

    @classmethod
    def joined(cls, parts: Sequence[dict[str, np.ndarray]]) -> Trajectory:
        """Of the parts of a recording, the first of which holds the start and all that never changes."""
        values = dict(parts[0])
        for name in (*STATES, *STEPS, *CONTACTS, *KICKS):
            values[name] = np.concatenate([part[name] for part in parts])
        return cls._of(values)

    @classmethod
    def _of(cls, values: dict[str, Any]) -> Trajectory:
        known = {name: values[name] for name in cls.__dataclass_fields__ if name in values}
        for name in known.keys() & {name for name, kind in cls.__annotations__.items() if kind == "float"}:
            known[name] = float(known[name])
        return cls(**known)


def part_name(number: int) -> str:
    """File of the steps of part ``number`` of a recording, counted from 0."""
    return f"steps-{number:06d}.npz"


def part_paths(folder: Path) -> list[Path]:
    """Files of the steps in the ``folder`` of a recording, in their order; one that is missing among them is named,
    too.
    """
    return [folder / part_name(number) for number in range(len(list(folder.glob("steps-*.npz"))))]


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write ``arrays`` by name, whole or not at all."""
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, schema=np.int64(SCHEMA), **arrays)  # pyright: ignore[reportArgumentType]


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """What ``write_arrays`` wrote. Raises ``ValueError`` for a file of another schema, and ``DAMAGES``."""
    arrays = read_npz(path)
    schema = int(arrays.pop("schema", 1))
    if schema != SCHEMA:
        raise ValueError(f"it is of schema {schema}, this version reads schema {SCHEMA}")
    return arrays


@dataclass(frozen=True)
class MotionOutcome:
    """What a motion did; lengths in body heights."""

    distance: float
    """Horizontal displacement of the centre of mass from start to end."""
    height: float
    """Apex of the centre of mass minus its standing height."""
    heading_degrees: float
    """Turn about the plane's normal; whole turns count."""
    tilt_degrees: float
    """Angle between the up of the body's best-fit rotation and the normal, at the end."""
    airborne_frames: float
    """60 x the longest time during which every contact Gaussian is above the plane."""


def measure(trajectory: Trajectory, *, first: int = 0, last: int = -1) -> MotionOutcome:
    """What was reached between two states of the trajectory (indices into ``time``)."""
    t = trajectory
    last = last % len(t.time)
    up = -t.gravity / np.linalg.norm(t.gravity)
    com = np.einsum("n,fni->fi", t.node_mass, t.positions[first : last + 1]) / t.node_mass.sum()
    moved = com[-1] - com[0]
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
        distance=float(np.linalg.norm(moved - (moved @ up) * up) / t.height),
        height=float(((com - com[0]) @ up).max() / t.height),
        heading_degrees=float(np.degrees(heading)),
        tilt_degrees=float(np.degrees(np.arccos(np.clip(upright @ up, -1.0, 1.0)))),
        airborne_frames=round(60.0 * longest, 6),
    )


def _best_fit(t: Trajectory, positions: np.ndarray) -> np.ndarray:
    rest = t.rest_positions - t.node_mass @ t.rest_positions / t.node_mass.sum()
    arms = positions - t.node_mass @ positions / t.node_mass.sum()
    return kabsch_rotation(t.node_mass, rest, arms)


def _headings(t: Trajectory, first: int, last: int, up: np.ndarray) -> np.ndarray:
    """(n,) radians about ``up`` since ``first``, followed from step to step so that whole turns count."""
    start = _best_fit(t, t.positions[first])
    angles = []
    for positions in t.positions[first : last + 1]:
        turn = _best_fit(t, positions) @ start.T
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        angles.append(np.arctan2(axis @ up, np.trace(turn) - up @ turn @ up))
    return np.unwrap(angles)
