"""Motion that follows key frames of the user as closely as muscles and ground allow (docs/concepts/motions.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.locomotion.objectives import (
    AngularMomentumObjective,
    AnyObjective,
    BodyPart,
    Coordinates,
    centre_of_mass_velocity,
    node_velocities,
    part_angular_momentum,
    part_angular_velocity,
    part_velocity,
)
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.meshing.protrusions import find_protrusions
from egs_warp.motions.balance import Weights
from egs_warp.motions.body_parts import ShapeParts, find_shape_parts
from egs_warp.motions.feet import order_counterclockwise
from egs_warp.motions.keyframes import Channel, Key, Quantity, channels
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController, RestDetector

MISS_TOLERANCE = 0.1
"""Maximum error at a key, as a fraction of the largest value of its channel; larger errors are reported."""
_MIN_HEAD_MASS, _MIN_SIDE_SHARE = 0.05, 0.2
"""Minimum mass of a head that sticks out of a body, relative to the body mass, and of its parts to the left and to the
right of the centre of mass, relative to its own mass."""
MAX_HOLD_TIME = 9.0
"""Maximum time in sqrt(H / g) after the last key in which the body must come to rest."""
USUAL_HOLD_TIME = 1.5
"""Typical time in sqrt(H / g) after the last key until the body is at rest."""


@dataclass(frozen=True)
class FollowPlan:
    """Number and duration of the key frames, and the largest errors so far."""

    keys: float
    duration: float
    """Time of the last key, s."""
    worst_miss: Mapping[str, float]
    """Largest error at the keys of each quantity, by the quantity's name and in its unit."""


@dataclass(frozen=True)
class FollowOutcome:
    """Measured result of following key frames."""

    worst_miss: Mapping[str, float]
    """Largest error at the keys of each quantity, by the quantity's name and in its unit."""


class FollowPhase(Enum):
    """Phases of a motion that follows key frames."""

    FOLLOW = "follow"
    HOLD = "hold"
    REST = "rest"


class Follow:
    """Follow key frames. Objectives of a standing body (balance, zero spin, shape) apply in addition to those of the
    keys, except for quantities that a key sets."""

    def __init__(self, stance: Stance, keys: Sequence[Key], *, weights: Weights | None = None) -> None:
        """Create the motion of the body that stands at ``stance``.

        Raises:
            UserError: for a key of a part that the body does not have.
        """
        self.body, self.ground, self.weights = stance.body, stance.ground, weights or Weights()
        self.keys, self.channels = tuple(keys), channels(keys)
        self.parts = {part.name: part for part in parts_of_body(stance)}
        for key in self.keys:
            if key.part not in self.parts:
                raise UserError(f"{key.where}: the body has no part {key.part!r}; it has {', '.join(self.parts)}")
        self.controller = BalanceController(
            self.body, stance.ground, stance.standing, stance.contact_points, stance.friction
        )
        self.phase = FollowPhase.FOLLOW
        self._standing = stance.standing
        self._gravity = float(np.linalg.norm(self.body.gravity))
        self._rate = 6.0 * float(np.sqrt(self._gravity / self.body.height))
        self._start_time: float | None = None
        self._end = max(key.time for key in self.keys)
        self._rest_detector = RestDetector(self.body)
        self._restless = False
        self._reached: dict[int, np.ndarray] = {}
        self._turned = {name: np.zeros(3) for name in self.parts}

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds: time of the last key plus the typical time to come to rest."""
        return self._end + USUAL_HOLD_TIME * float(np.sqrt(self.body.height / self._gravity))

    @property
    def is_at_rest(self) -> bool:
        """True if the body is at rest after the last key, or the time limit for that has passed."""
        return self.phase is FollowPhase.REST

    def plan_record(self) -> FollowPlan:
        """Return the number of keys, their duration and the largest errors so far."""
        misses: dict[str, float] = {}
        for index in self._reached:
            name = self.keys[index].quantity.value
            misses[name] = max(misses.get(name, 0.0), float(np.linalg.norm(self._miss(index))))
        return FollowPlan(float(len(self.keys)), self._end, misses)

    def planned_com(self, elapsed: float) -> None:
        """Return None: key frames do not define a path of the centre of mass."""

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> FollowOutcome:
        """Return the largest error at the keys of each quantity."""
        return FollowOutcome(self.plan_record().worst_miss)

    def notes(self) -> list[str]:
        """Return messages for the user about missed keys, and about a body that did not come to rest."""
        notes = []
        for index, key in enumerate(self.keys):
            group = [np.linalg.norm(k.value) for k in self.keys if (k.part, k.quantity) == (key.part, key.quantity)]
            name = f"{key.where}: {key.part} {key.quantity.value} at {key.time:g} s"
            if index not in self._reached:
                notes.append(f"{name} was not reached in time")
            elif np.linalg.norm(self._miss(index)) > MISS_TOLERANCE * max(group):
                values = ", ".join(f"{value:.3g}" for value in self._reached[index])
                notes.append(f"{name}: reached ({values})")
        if self._restless:
            notes.append("the body did not come to rest in the time allowed after the last key")
        return notes

    def _miss(self, index: int) -> np.ndarray:
        """Return the error (3,) at a key: measured value minus value of the key, in the unit of the quantity. For an
        orientation, it is the rotation between both."""
        key, reached = self.keys[index], self._reached[index]
        if key.quantity is Quantity.ORIENTATION:
            return turn_between(np.array(key.value), reached)
        return reached - np.array(key.value)

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        if self._start_time is None:
            self._start_time = state.time
        elapsed = state.time - self._start_time
        for index, key in enumerate(self.keys):
            if index not in self._reached and elapsed >= key.time - 0.5 * dt:
                self._reached[index] = self._measure(key.part, key.quantity, state)
        self._advance_phase(state, elapsed)
        # After the last key of their channel, positions and orientations are held, but velocities and momenta are not.
        ruling = [c for c in self.channels if c.quantity in _POSE_QUANTITIES or elapsed < c.times[-1] - 0.5 * dt]
        return [
            *self._standing_objectives(state, report, dt, {(channel.part, channel.quantity) for channel in ruling}),
            *(self._key_objective(channel, state, elapsed, dt) for channel in ruling),
        ]

    def _advance_phase(self, state: BodyState, elapsed: float) -> None:
        """Advance the phase: after the last key, the body holds still until it is at rest or the time limit has
        passed."""
        if self.phase is FollowPhase.FOLLOW and elapsed > self._end:
            self.phase = FollowPhase.HOLD
        if self.phase is not FollowPhase.HOLD:
            return
        calm = self._rest_detector.update(self.body.centre_of_mass(state.velocities), elapsed)
        late = elapsed - self._end > MAX_HOLD_TIME * np.sqrt(self.body.height / self._gravity)
        if calm or late:
            self.phase, self._restless = FollowPhase.REST, not calm

    def _standing_objectives(
        self, state: BodyState, report: StepReport | None, dt: float, ruled: set[tuple[str, Quantity]]
    ) -> list[AnyObjective]:
        measurement = self.controller.measure(state, report)
        balance = np.array([*(measurement.foot_centre - self.controller.base_offset), self.controller.standing_height])
        rules: list[AnyObjective] = []
        velocity = self._rate / 3.0 * (balance - measurement.com)
        pose = self.controller.over_base(measurement.com, measurement.foot_centre, float(measurement.heading))
        upright = self.controller.turn_towards(measurement, pose) * 0.7 * self._rate
        velocity, spin = self.controller.balance_targets(measurement, velocity, upright, dt)
        if not {("body", Quantity.POSITION), ("body", Quantity.VELOCITY)} & ruled:
            # A key that bends the body moves the centre of mass, so keys have priority over the position of the centre
            # of mass.
            weight = self.weights.landing * self.weights.com
            rules.append(centre_of_mass_velocity(self.body, self.ground.axes.T @ velocity, weight))
        if not {("body", Quantity.ORIENTATION), ("body", Quantity.ANGULAR_MOMENTUM)} & ruled:
            rules.append(AngularMomentumObjective(measurement.inertia @ spin, self.weights.spin))
        # The target shape is the shape at rest, moving with the centre of mass.
        arms = self._standing - self.body.centre_of_mass(self._standing)
        now = state.positions - self.body.centre_of_mass(state.positions)
        drift = self.body.centre_of_mass(state.velocities)
        rules.append(node_velocities(self.body, drift + self._rate * (arms - now), self.weights.pose))
        return rules

    def _key_objective(self, channel: Channel, state: BodyState, elapsed: float, dt: float) -> AnyObjective:
        part, body, whole = self.parts[channel.part], self.body, channel.part == "body"
        axes = Coordinates(self.ground.axes, False)
        value, rate = channel.at(elapsed + dt)
        now = self._measure(channel.part, channel.quantity, state)
        # Rounding may place the end of a time step just after a key, so the middle of the step determines the next key.
        weight = channel.weight_at(elapsed + 0.5 * dt)
        weight *= self.weights.com if channel.quantity in _LINEAR else self.weights.spin
        if channel.quantity is Quantity.POSITION:
            target = body.height * (rate + self._rate * (value - now - dt * rate))
            return part_velocity(body, part, target, weight, axes)
        if channel.quantity is Quantity.VELOCITY:
            return part_velocity(body, part, body.height * value, weight, axes)
        if channel.quantity is Quantity.ORIENTATION:
            before = value - dt * rate
            turning = np.radians(turn_between(before, value) / dt + self._rate * turn_between(now, before))
            if whole:
                return AngularMomentumObjective(body.inertia(state.positions) @ (self.ground.axes.T @ turning), weight)
            return part_angular_velocity(body, part, state, turning, weight, axes)
        momentum = body.mass * body.height**2 * value
        if whole:
            return AngularMomentumObjective(self.ground.axes.T @ momentum, weight)
        return part_angular_momentum(body, part, state, momentum, weight, axes)

    def _measure(self, name: str, quantity: Quantity, state: BodyState) -> np.ndarray:
        """Return the measured value (3,) of a ``quantity`` of the part ``name``, in the unit of the quantity and in
        ground axes. A rotation is unwrapped relative to the last call."""
        part, axes, height = self.parts[name], self.ground.axes, self.body.height
        if quantity is Quantity.POSITION:
            return axes @ (part.centre(state.positions) - part.centre(self._standing)) / height
        if quantity is Quantity.VELOCITY:
            return axes @ part.centre(state.velocities) / height
        if quantity is Quantity.ORIENTATION:
            before, after = (x[part.nodes] - part.centre(x) for x in (self._standing, state.positions))
            turn = kabsch_rotation(part.masses, before, after)
            shorter = axes @ Rotation.from_matrix(turn).as_rotvec(degrees=True)
            self._turned[name] = _lift_near(shorter, self._turned[name])
            return self._turned[name]
        arms = state.positions[part.nodes] - part.centre(state.positions)
        spin = (part.masses[:, None] * np.cross(arms, state.velocities[part.nodes])).sum(axis=0)
        return axes @ spin / (self.body.mass * height**2)


_LINEAR = (Quantity.POSITION, Quantity.VELOCITY)
_POSE_QUANTITIES = (Quantity.POSITION, Quantity.ORIENTATION)


def parts_of_body(stance: Stance) -> list[BodyPart]:
    """Return the parts to which keys may refer: the whole body, its base, its head, its feet and its branches.

    A single foot counts as the base. Several feet, and the branches, are numbered counterclockwise as seen from above,
    beginning straight ahead. If the shape shows no head, the head is the part that sticks out at the top of the body
    (``_protruding_top``), or otherwise the top of the body without its branches.
    """
    body, ground, standing = stance.body, stance.ground, stance.standing
    heights = (standing - ground.origin) @ ground.surface_normal
    shape = shape_parts(stance)
    branches = [
        BodyPart.of(body, f"branch {number}", branch.nodes) for number, branch in enumerate(shape.branches, start=1)
    ]
    base = BodyPart.base(body, heights)
    if shape.head is not None:
        head = BodyPart.of(body, "head", shape.head)
    else:
        levels = ground.local(standing)[:, 2]
        for branch in branches:
            levels[branch.nodes] = -np.inf
        top = _protruding_top(stance, levels)
        head = BodyPart.head(body, levels) if top is None else BodyPart.of(body, "head", top)
    return [BodyPart.whole(body), base, head, *_feet(stance, base), *branches]


def _protruding_top(stance: Stance, levels: np.ndarray) -> np.ndarray | None:
    """Return the nodes (k,) of the part that sticks out of the body and contains its highest node, such as a head with
    its neck; None if there is none, if it is too light for a head, or if it is on one side of the body, such as an ear.

    Args:
        stance: stance of the body.
        levels: (N,) m, heights of the nodes; -inf for nodes that belong to other parts.
    """
    body = stance.body
    left = stance.ground.local(stance.standing)[:, 1]
    left -= body.node_mass @ left / body.mass
    for part in find_protrusions(body.mesh, stance.ground.surface_normal):
        nodes = part.nodes
        masses, is_left = body.node_mass[nodes], left[nodes] > 0.0
        share = float(masses[is_left].sum() / masses.sum())
        is_heavy = masses.sum() >= _MIN_HEAD_MASS * body.mass
        if int(np.argmax(levels)) in nodes and np.isfinite(levels[nodes]).all() and is_heavy:
            return nodes if _MIN_SIDE_SHARE <= share <= 1.0 - _MIN_SIDE_SHARE else None
    return None


def head_note(stance: Stance, parts: Sequence[BodyPart]) -> str | None:
    """Return a note for the user if it is not certain which part is the head; otherwise None.

    It is uncertain if a branch that does not belong to the head, such as a raised arm, ends above the middle of the
    head.

    Args:
        stance: stance of the body.
        parts: parts of the body (``parts_of_body``).
    """
    local = stance.ground.local(stance.standing) / stance.body.height
    (head,) = (part for part in parts if part.name == "head")
    low, high = float(local[head.nodes, 2].min()), float(local[head.nodes, 2].max())
    rivals = [
        part
        for part in parts
        if part.name.startswith("branch")
        and local[part.nodes, 2].max() > 0.5 * (low + high)
        and not np.isin(part.nodes, head.nodes).any()
    ]
    if not rivals:
        return None
    names = " and ".join(f"{part.name} ({describe_position(local[part.nodes].mean(axis=0))})" for part in rivals)
    place = describe_position(local[head.nodes].mean(axis=0))
    number = rivals[0].name.split()[1]
    return (
        f"the head is taken to be the part {place}, not {names}, which is as high; to move that instead, give"
        f" branch={number}"
    )


def describe_position(position: np.ndarray) -> str:
    """Return a ``position`` (3,), ground axes, as text: its distances ahead and to the side."""
    ahead, left, _ = position
    along, aside = "ahead" if ahead >= 0.0 else "behind", "left" if left >= 0.0 else "right"
    return f"{abs(ahead):.2f} {along}, {abs(left):.2f} {aside}"


def shape_parts(stance: Stance) -> ShapeParts:
    """Return the head and the branches of the body that stands at ``stance``; the branches are in the order of their
    numbers."""
    body, ground = stance.body, stance.ground
    shape = find_shape_parts(body.mesh, body.node_mass, ground.surface_normal)
    if not shape.branches:
        return shape
    local = ground.local(stance.standing)
    order = order_counterclockwise(np.array([local[branch.nodes, :2].mean(axis=0) for branch in shape.branches]))
    return replace(shape, branches=tuple(shape.branches[index] for index in order))


def _feet(stance: Stance, base: BodyPart) -> list[BodyPart]:
    body, ground, standing = stance.body, stance.ground, stance.standing
    feet = stance.feet()
    if len(feet) < 2:
        return [BodyPart("foot", base.nodes, base.masses)]
    soles = [base.nodes[foot.leg[base.nodes] > 0.0] for foot in feet]
    # If the sole of a leg does not reach down to the base, use the lowest nodes of the leg instead.
    soles = [nodes if len(nodes) else foot.sole for nodes, foot in zip(soles, feet, strict=True)]
    order = order_counterclockwise(np.array([ground.local(standing[foot.sole])[:, :2].mean(axis=0) for foot in feet]))
    return [BodyPart.of(body, f"foot {number}", soles[index]) for number, index in enumerate(order, start=1)]


def turn_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the rotation (3,) from one orientation to another; all are rotation vectors in degrees.

    The angle of the result is at most 360 degrees. Orientations that differ by one full turn are distinguished, but
    orientations that differ by two full turns are not.
    """
    (a, *u), (b, *v) = _quaternion(first), _quaternion(second)
    w, axis = a * b + np.dot(u, v), a * np.array(v) - b * np.array(u) - np.cross(v, u)
    sine = float(np.linalg.norm(axis))
    return np.degrees(2.0 * np.arctan2(sine, w)) * (axis / sine if sine > 0.0 else np.array([0.0, 0.0, 1.0]))


def _quaternion(turn: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (4,), scalar first, of a rotation vector (3,) in degrees; the sign of the quaternion
    changes with every full turn."""
    half = 0.5 * np.radians(turn)
    angle = float(np.linalg.norm(half))
    return np.array([np.cos(angle), *(np.sinc(angle / np.pi) * half)])


def _lift_near(turn: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return ``turn``, a rotation vector (3,) of at most 180 degrees, or the equivalent one about the opposite axis if
    that is nearer to ``last``."""
    if _quaternion(turn) @ _quaternion(last) >= 0.0:
        return turn
    angle = float(np.linalg.norm(turn))
    return turn * (1.0 - 360.0 / angle) if angle > 0.0 else np.array([0.0, 0.0, 360.0])
