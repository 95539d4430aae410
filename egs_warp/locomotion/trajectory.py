"""What a simulation leaves behind: every solver step, its contacts,
and the measures and audit computed from them alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.contact.detection import ContactGeometry
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.frames import best_turn
from egs_warp.io.atomic import atomic_write
from egs_warp.locomotion.stepper import StepReport


@dataclass(frozen=True)
class Trajectory:
    """F solver steps of N nodes with C contacts in all. Metres, seconds, kilograms, newtons; z is up, square to the
    ground.

    The frame is the body's own: where that lies in the capture, the last three fields say.
    """

    time: np.ndarray
    """(F+1,)."""
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
    """(P, 4) rows n, d of n.x + d = 0; the first is the ground."""
    solid_from_plane: np.ndarray
    """(P,) int32: a point is inside a solid if it is below all of its planes; a solid of one plane is a half space."""
    friction: float
    drag: float
    """1/s."""
    height: float
    """H, metres."""
    contact_step: np.ndarray
    """(C,) int32: step i leads from time i to time i+1."""
    contact_nodes: np.ndarray
    """(C, 4) int32."""
    contact_weights: np.ndarray
    """(C, 4)."""
    contact_normal: np.ndarray
    """(C, 3) unit."""
    contact_force: np.ndarray
    """(C, 3) newtons on the body, world axes."""
    contact_gap: np.ndarray
    """(C,) metres at the end of the step."""
    min_gap: np.ndarray
    """(F+1,) metres, smallest gap of all contact Gaussians."""
    activations: np.ndarray
    """(F, M) metres."""
    body_axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3) rows: this frame's x, y and z in the capture's axes."""
    body_origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) this frame's origin in the capture, capture's units."""
    metres_per_unit: float = 1.0
    """Of the capture's unit."""

    def placed(self, frame: BodyFrame) -> Trajectory:
        """The same trajectory of a body whose ``frame`` in the capture is known."""
        return replace(self, body_axes=frame.axes, body_origin=frame.origin, metres_per_unit=frame.scale)

    def in_capture(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of this frame in the capture's frame and units."""
        return BodyFrame(self.body_axes, self.body_origin, self.metres_per_unit).capture_points(points)

    def save(self, path: Path) -> None:
        """Write ``trajectory.npz``; the same trajectory gives the same bytes."""
        with atomic_write(path) as temporary, temporary.open("wb") as stream:
            arrays: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in self.__dataclass_fields__}
            np.savez(stream, **arrays)

    @classmethod
    def load(cls, path: Path) -> Trajectory:
        """Read what ``save`` wrote."""
        with np.load(path) as data:
            values = {name: data[name] for name in cls.__dataclass_fields__ if name in data}
        # Files of before there were solids: every plane a half space.
        values.setdefault("solid_from_plane", np.arange(len(values["planes"]), dtype=np.int32))
        for name in {"friction", "drag", "height", "metres_per_unit"} & values.keys():
            values[name] = float(values[name])
        return cls(**values)


@dataclass(frozen=True)
class Audit:
    """Maxima over all steps, as defined in docs/report.md; all but the counts are dimensionless."""

    momentum_residual: float
    angular_momentum_residual: float
    cone_violation: float
    penetration: float
    complementarity_gap: float
    inverted_elements: int
    newton_unconverged: int


@dataclass(frozen=True)
class Reached:
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


def record(
    body: SoftBody,
    geometry: ContactGeometry,
    start: BodyState,
    start_gap: float,
    reports: Sequence[StepReport],
    *,
    drag: float,
    segments: int,
) -> Trajectory:
    """Gather the steps of a simulation that began at ``start``, whose smallest gap was ``start_gap``."""
    states = [start, *(report.state for report in reports)]
    counts = [report.contacts.count for report in reports]

    def joined(pieces: list[np.ndarray], shape: tuple[int, ...], dtype: type) -> np.ndarray:
        return np.concatenate([np.zeros((0, *shape), dtype), *pieces]).astype(dtype)

    return Trajectory(
        time=np.array([state.time for state in states]),
        positions=np.stack([state.positions for state in states]),
        velocities=np.stack([state.velocities for state in states]),
        rest_positions=body.mesh.nodes,
        tets=body.mesh.tets,
        node_mass=body.node_mass,
        gravity=body.gravity,
        planes=np.array([[*plane.normal, plane.offset] for plane in geometry.planes]),
        solid_from_plane=geometry.solid_of_each_plane,
        friction=geometry.friction,
        drag=drag,
        height=body.height,
        contact_step=np.repeat(np.arange(len(reports)), counts).astype(np.int32),
        contact_nodes=joined([r.contacts.nodes for r in reports], (4,), np.int32),
        contact_weights=joined([r.contacts.weights for r in reports], (4,), np.float64),
        contact_normal=joined([r.contacts.axes[:, 0] for r in reports], (3,), np.float64),
        contact_force=joined([np.einsum("na,nai->ni", r.forces, r.contacts.axes) for r in reports], (3,), np.float64),
        contact_gap=joined([r.end_gaps for r in reports], (), np.float64),
        min_gap=np.array([start_gap, *(report.min_gap for report in reports)]),
        activations=joined([r.activations[None] for r in reports], (segments,), np.float64),
    )


def audit(trajectory: Trajectory, *, newton_unconverged: int = 0) -> Audit:
    """Recompute every bound of the audit from the trajectory."""
    t = trajectory
    mass = t.node_mass.sum()
    weight = mass * np.linalg.norm(t.gravity)
    steps = len(t.time) - 1
    dt = np.diff(t.time)
    com = np.einsum("n,fni->fi", t.node_mass, t.positions) / mass
    momentum = np.einsum("n,fni->fi", t.node_mass, t.velocities)
    arms = t.positions - com[:, None]
    spin = np.einsum("n,fni->fi", t.node_mass, np.cross(arms, t.velocities))
    force = np.zeros((steps, 3))
    np.add.at(force, t.contact_step, t.contact_force)
    points = np.einsum("cw,cwi->ci", t.contact_weights, t.positions[t.contact_step[:, None], t.contact_nodes])
    torque = np.zeros((steps, 3))
    np.add.at(torque, t.contact_step, np.cross(points - com[t.contact_step], t.contact_force))
    drag_force = t.drag * momentum[1:]
    drag_torque = t.drag * np.einsum("n,fni->fi", t.node_mass, np.cross(arms[:-1], t.velocities[1:]))
    linear = np.diff(momentum, axis=0) / dt[:, None] - mass * t.gravity - force + drag_force
    angular = np.diff(spin, axis=0) / dt[:, None] - torque + drag_torque
    normal = np.einsum("ci,ci->c", t.contact_force, t.contact_normal)
    tangent = np.linalg.norm(t.contact_force - normal[:, None] * t.contact_normal, axis=1)
    edges = t.positions[:, t.tets[:, 1:]] - t.positions[:, t.tets[:, :1]]
    return Audit(
        momentum_residual=float(np.linalg.norm(linear, axis=1).max(initial=0.0) / weight),
        angular_momentum_residual=float(np.linalg.norm(angular, axis=1).max(initial=0.0) / (weight * t.height)),
        cone_violation=float(max(np.maximum(tangent - t.friction * normal, -normal).max(initial=0.0) / weight, 0.0)),
        penetration=float(max(-t.min_gap.min(), 0.0) / t.height),
        complementarity_gap=float((normal * np.maximum(t.contact_gap, 0.0)).max(initial=0.0) / (weight * t.height)),
        inverted_elements=int((np.linalg.det(edges) <= 0.0).sum()),
        newton_unconverged=newton_unconverged,
    )


def measure(trajectory: Trajectory, *, first: int = 0, last: int = -1) -> Reached:
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
    return Reached(
        distance=float(np.linalg.norm(moved - (moved @ up) * up) / t.height),
        height=float(((com - com[0]) @ up).max() / t.height),
        heading_degrees=float(np.degrees(heading)),
        tilt_degrees=float(np.degrees(np.arccos(np.clip(upright @ up, -1.0, 1.0)))),
        airborne_frames=round(60.0 * longest, 6),
    )


def _best_fit(t: Trajectory, positions: np.ndarray) -> np.ndarray:
    rest = t.rest_positions - t.node_mass @ t.rest_positions / t.node_mass.sum()
    arms = positions - t.node_mass @ positions / t.node_mass.sum()
    return best_turn(t.node_mass, rest, arms)


def _headings(t: Trajectory, first: int, last: int, up: np.ndarray) -> np.ndarray:
    """(n,) radians about ``up`` since ``first``, followed from step to step so that whole turns count."""
    start = _best_fit(t, t.positions[first])
    angles = []
    for positions in t.positions[first : last + 1]:
        turn = _best_fit(t, positions) @ start.T
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        angles.append(np.arctan2(axis @ up, np.trace(turn) - up @ turn @ up))
    return np.unwrap(angles)
