"""Follow a user's own key frames as nearly as the muscles and the ground allow (docs/concepts/motions.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from egs_warp.motions.feet import order_counterclockwise
from egs_warp.motions.keyframes import Channel, Key, Quantity, channels
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController, RestDetector, Weights

MISSED = 0.1
"""Of the largest value of its channel: a key missed by more is noted."""
LONGEST_HOLD = 9.0
"""Of sqrt(H / g): at most for how long, after the last key, the body is waited for to be calm."""
USUAL_HOLD = 1.5
"""The same, as it usually takes."""


@dataclass(frozen=True)
class FollowPlan:
    """Key frames asked for, and how they are kept so far."""

    keys: float
    duration: float
    """Seconds."""
    worst_miss: float
    """In the unit of its quantity."""


@dataclass(frozen=True)
class FollowOutcome:
    """How near a trajectory came to its key frames."""

    worst_miss: float
    """In the unit of its quantity."""


class FollowPhase(Enum):
    """Phases of a trajectory."""

    FOLLOW = "follow"
    HOLD = "hold"
    REST = "rest"


class Follow:
    """The keys' own objectives, and beside them a standing body:
    balance, no spin, its shape, each unless a key rules it.
    """

    def __init__(self, place: Stance, keys: Sequence[Key], *, weights: Weights | None = None) -> None:
        """Raises ``UserError`` for a key of a part that the body does not have."""
        self.body, self.ground, self.weights = place.body, place.ground, weights or Weights()
        self.keys, self.channels = tuple(keys), channels(keys)
        self.parts = {part.name: part for part in parts_of_body(place)}
        for key in self.keys:
            if key.part not in self.parts:
                raise UserError(f"{key.where}: the body has no part {key.part!r}; it has {', '.join(self.parts)}")
        self.pose = BalanceController(self.body, place.ground, place.standing, place.contact_points, place.friction)
        self.phase = FollowPhase.FOLLOW
        self._standing = place.standing
        self._gravity = float(np.linalg.norm(self.body.gravity))
        self._rate = 6.0 * float(np.sqrt(self._gravity / self.body.height))
        self._began: float | None = None
        self._end = max(key.time for key in self.keys)
        self._calm = RestDetector(self.body)
        self._restless = False
        self._reached: dict[int, np.ndarray] = {}
        self._turned = {name: np.zeros(3) for name in self.parts}

    @property
    def expected_time(self) -> float:
        """Seconds: the keys, and what a body usually takes to be calm after them."""
        return self._end + USUAL_HOLD * float(np.sqrt(self.body.height / self._gravity))

    @property
    def is_at_rest(self) -> bool:
        """Whether the body is calm after the last key, or was waited for long enough."""
        return self.phase is FollowPhase.REST

    def plan_record(self) -> FollowPlan:
        """How many keys there are, how long they take, and the worst miss so far."""
        misses = [float(np.linalg.norm(self._miss(index))) for index in self._reached]
        return FollowPlan(float(len(self.keys)), self._end, max(misses, default=0.0))

    def planned_com(self, elapsed: float) -> None:
        """Nothing: keys are of parts of the body."""

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> FollowOutcome:
        """The worst miss of all keys."""
        return FollowOutcome(self.plan_record().worst_miss)

    def notes(self) -> list[str]:
        """Which keys were missed, and whether the body never came to rest."""
        notes = []
        for index, key in enumerate(self.keys):
            group = [np.linalg.norm(k.value) for k in self.keys if (k.part, k.quantity) == (key.part, key.quantity)]
            name = f"{key.where}: {key.part} {key.quantity.value} at {key.time:g} s"
            if index not in self._reached:
                notes.append(f"{name} was not reached in time")
            elif np.linalg.norm(self._miss(index)) > MISSED * max(group):
                told = ", ".join(f"{value:.3g}" for value in self._reached[index])
                notes.append(f"{name}: reached ({told})")
        if self._restless:
            notes.append("the body was not yet at rest when the time for it, after the last key, was up")
        return notes

    def _miss(self, index: int) -> np.ndarray:
        """(3,) from a key's value to that at its time, in its unit; of an orientation, the rotation between the two."""
        key, reached = self.keys[index], self._reached[index]
        if key.quantity is Quantity.ORIENTATION:
            return turn_between(np.array(key.value), reached)
        return reached - np.array(key.value)

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        if self._began is None:
            self._began = state.time
        elapsed = state.time - self._began
        for index, key in enumerate(self.keys):
            if index not in self._reached and elapsed >= key.time - 0.5 * dt:
                self._reached[index] = self._measured(key.part, key.quantity, state)
        self._advance_phase(state, elapsed)
        # Where a part is, is held after its last key; how fast it goes, is not.
        ruling = [c for c in self.channels if c.quantity in _HELD or elapsed < c.times[-1] - 0.5 * dt]
        return [
            *self._standing_objectives(state, report, dt, {(channel.part, channel.quantity) for channel in ruling}),
            *(self._keyed(channel, state, elapsed, dt) for channel in ruling),
        ]

    def _advance_phase(self, state: BodyState, elapsed: float) -> None:
        """After the last key the body holds still until its centre of mass has been slow for a while, or time is up."""
        if self.phase is FollowPhase.FOLLOW and elapsed > self._end:
            self.phase = FollowPhase.HOLD
        if self.phase is not FollowPhase.HOLD:
            return
        calm = self._calm.update(self.body.centre_of_mass(state.velocities), elapsed)
        late = elapsed - self._end > LONGEST_HOLD * np.sqrt(self.body.height / self._gravity)
        if calm or late:
            self.phase, self._restless = FollowPhase.REST, not calm

    def _standing_objectives(
        self, state: BodyState, report: StepReport | None, dt: float, ruled: set[tuple[str, Quantity]]
    ) -> list[AnyObjective]:
        seen = self.pose.measure(state, report)
        balance = np.array([*(seen.foot_centre - self.pose.base_offset), self.pose.standing_height])
        rules: list[AnyObjective] = []
        velocity = self._rate / 3.0 * (balance - seen.com)
        pose = self.pose.over_base(seen.com, seen.foot_centre, seen.heading)
        upright = self.pose.turn_towards(seen, pose) * 0.7 * self._rate
        velocity, spin = self.pose.balance_targets(seen, velocity, upright, dt)
        if not {("body", Quantity.POSITION), ("body", Quantity.VELOCITY)} & ruled:
            rules.append(centre_of_mass_velocity(self.body, self.ground.axes.T @ velocity, self.weights.com))
        if not {("body", Quantity.ORIENTATION), ("body", Quantity.ANGULAR_MOMENTUM)} & ruled:
            rules.append(AngularMomentumObjective(seen.inertia @ spin, self.weights.spin))
        # The shape at rest goes along with the centre of mass.
        arms = self._standing - self.body.centre_of_mass(self._standing)
        now = state.positions - self.body.centre_of_mass(state.positions)
        drift = self.body.centre_of_mass(state.velocities)
        rules.append(node_velocities(self.body, drift + self._rate * (arms - now), self.weights.pose))
        return rules

    def _keyed(self, channel: Channel, state: BodyState, elapsed: float, dt: float) -> AnyObjective:
        part, body, whole = self.parts[channel.part], self.body, channel.part == "body"
        axes = Coordinates(self.ground.axes, False)
        value, rate = channel.at(elapsed + dt)
        now = self._measured(channel.part, channel.quantity, state)
        # Sums of steps may end a hair after their key, so the middle of the step says on the way to which key it is.
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

    def _measured(self, name: str, quantity: Quantity, state: BodyState) -> np.ndarray:
        """(3,) in the unit of the quantity, axes of the ground;
        of a turn, the one that the body came by since the last look at it.
        """
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
_HELD = (Quantity.POSITION, Quantity.ORIENTATION)


def parts_of_body(place: Stance) -> list[BodyPart]:
    """The parts that keys may name: the whole body, its base, its head and its feet.

    A single foot is the base. Several are numbered anticlockwise as seen from above, from straight ahead on.
    """
    body, ground, standing = place.body, place.ground, place.standing
    heights = (standing - ground.origin) @ ground.surface_normal
    base = BodyPart.base(body, heights)
    found = [BodyPart.whole(body), base, BodyPart.head(body, ground.local(standing)[:, 2])]
    feet = place.feet()
    if len(feet) < 2:
        return [*found, BodyPart("foot", base.nodes, base.masses)]
    soles = [base.nodes[foot.leg[base.nodes] > 0.0] for foot in feet]
    # A leg that is too short to reach the base stands on its own lowest nodes.
    soles = [nodes if len(nodes) else foot.sole for nodes, foot in zip(soles, feet, strict=True)]
    order = order_counterclockwise(np.array([ground.local(standing[foot.sole])[:, :2].mean(axis=0) for foot in feet]))
    return found + [BodyPart.of(body, f"foot {number}", soles[index]) for number, index in enumerate(order, start=1)]


def turn_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(3,) the rotation that leads from one orientation to another, all rotation vectors in degrees.

    Its angle is at most 360: orientations a whole turn apart are told apart, those two turns apart are not.
    """
    (a, *u), (b, *v) = _quaternion(first), _quaternion(second)
    w, axis = a * b + np.dot(u, v), a * np.array(v) - b * np.array(u) - np.cross(v, u)
    sine = float(np.linalg.norm(axis))
    return np.degrees(2.0 * np.arctan2(sine, w)) * (axis / sine if sine > 0.0 else np.array([0.0, 0.0, 1.0]))


def _quaternion(turn: np.ndarray) -> np.ndarray:
    """(4,) scalar first, of a rotation vector (3,) in degrees; of opposite sign for turns that differ by 360."""
    half = 0.5 * np.radians(turn)
    angle = float(np.linalg.norm(half))
    return np.array([np.cos(angle), *(np.sinc(angle / np.pi) * half)])


def _lift_near(turn: np.ndarray, last: np.ndarray) -> np.ndarray:
    """(3,) ``turn``, a rotation vector of at most 180 degrees,
    or the same rotation the longer way round if that is nearer to ``last``.
    """
    if _quaternion(turn) @ _quaternion(last) >= 0.0:
        return turn
    angle = float(np.linalg.norm(turn))
    return turn * (1.0 - 360.0 / angle) if angle > 0.0 else np.array([0.0, 0.0, 360.0])
