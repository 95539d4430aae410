"""Gesture on top of a motion: objectives of its parts, and their measured size (docs/motions/gestures.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.soft_parts import stiffness_at_nodes
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.locomotion.objectives import AnyObjective, BodyPart, Coordinates, part_angular_velocity, part_shape
from egs_warp.motions.follow import turn_between
from egs_warp.motions.gestures import WHOLE_BODY, Gesture, GestureOutcome
from egs_warp.motions.keyframes import Quantity
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import heading_between
from egs_warp.motions.stand import PostureTarget

_WEIGHT = 600.0
"""Weight of the angular velocity of a part, equal to the weights of balance."""
_SHAPE_WEIGHT = 6.0
"""Weight of the velocities of a part's nodes that deform it. Without it, nodes that protrude, such as the ears of a
head, could carry the angular momentum while the rest of the part hardly rotates."""
CORRECTION_RATE = 6.0
"""Rate in sqrt(g / H) at which errors of the pose are corrected."""
_SOFT = 0.5
"""Relative stiffness up to which a node is soft (``overlap`` of a style)."""
_JOINT_SHARE, _SMALL_TURN = 0.25, 0.1
"""Fraction of a part's nodes, nearest to the rest of the body, whose centroid is the joint of the part; and angle, in
radians, of the finite difference that measures by how much a rotation of the part rotates the whole body."""


class Layer:
    """Gesture that starts ``begin`` seconds after the underlying motion."""

    def __init__(self, stance: Stance, gesture: Gesture, begin: float) -> None:
        self.gesture, self.begin, self.end = gesture, begin, begin + gesture.duration
        self._ground, self._body, self._standing = stance.ground, stance.body, stance.standing
        self._shares = [self._rest(part) for part in gesture.parts]
        self._joints = [part.nodes if part.name == WHOLE_BODY else self._joint(part) for part in gesture.parts]
        self._driven = [_stiff_part(self._body, part) for part in gesture.parts]
        """Nodes of the parts that objectives move and that are measured; the others follow by elasticity."""
        self._outer = [
            BodyPart.of(self._body, part.name, np.setdiff1d(part.nodes, joint))
            for part, joint in zip(self._driven, self._joints, strict=True)
        ]
        """Driven nodes without those at the joints, which bend."""
        self._turned = [
            np.zeros((3, 3)) if part.name == WHOLE_BODY else self._share_of_turn(index)
            for index, part in enumerate(gesture.parts)
        ]
        self._headings, self._has_started = np.zeros(len(gesture.parts)), False
        measured = gesture.channels[0]
        sizes = np.linalg.norm(measured.values, axis=1)
        self._size = float(sizes.max())
        self._extremes = [k for k in range(len(sizes)) if sizes[k] > (1.0 - 1e-9) * self._size]
        self._reached = dict.fromkeys(self._extremes, 0.0)

    def _rest(self, part: BodyPart) -> np.ndarray:
        """Return weights (N,) of the nodes outside ``part``. The rotation of these nodes about the up axis defines the
        heading."""
        mass = self._body.node_mass.copy()
        if part.name != WHOLE_BODY:
            mass[part.nodes] = 0.0
        return mass / mass.sum()

    def _joint(self, part: BodyPart) -> np.ndarray:
        """Return the indices of the nodes whose centroid is the joint of ``part`` with the rest of the body."""
        middle = self._rest(part) @ self._standing
        away = np.linalg.norm(self._standing[part.nodes] - middle, axis=1)
        return part.nodes[away <= np.quantile(away, _JOINT_SHARE)]

    def _share_of_turn(self, index: int) -> np.ndarray:
        """Return the matrix (3, 3), ground axes, that maps a small rotation of a part about its joint to the best-fit
        rotation of the whole body."""
        body, axes, turns = self._body, self._ground.axes, []
        for axis in axes:
            turned = self._rotated(index, self._standing, Rotation.from_rotvec(_SMALL_TURN * axis))
            before, after = (x - body.centre_of_mass(x) for x in (self._standing, turned))
            turn = kabsch_rotation(body.node_mass, before, after)
            turns.append(axes @ Rotation.from_matrix(turn).as_rotvec() / _SMALL_TURN)
        return np.stack(turns, axis=1)

    def _rotated(self, index: int, nodes: np.ndarray, turn: Rotation) -> np.ndarray:
        """Return ``nodes`` (N, 3) with a part rotated about its joint."""
        part, result = self.gesture.parts[index].nodes, nodes.copy()
        joint = nodes[self._joints[index]].mean(axis=0)
        result[part] = joint + turn.apply(nodes[part] - joint)
        return result

    def turn(self, time: float) -> np.ndarray:
        """Return the rotation vector (3,) of the body, radians, ground axes, that the rotations of the parts cause
        ``time`` seconds after the start of the gesture."""
        shares = zip(self._turned, self.gesture.channels, strict=True)
        return np.sum([share @ np.radians(channel.at(time)[0]) for share, channel in shares], axis=0)

    def pose(self, time: float, nodes: np.ndarray) -> np.ndarray:
        """Return ``nodes`` (N, 3), ground coordinates, with the rotations of the parts ``time`` seconds after the start
        of the gesture."""
        for index, (part, channel) in enumerate(zip(self.gesture.parts, self.gesture.channels, strict=True)):
            if part.name != WHOLE_BODY:
                heading = Rotation.from_rotvec([0.0, 0.0, self._headings[index]])
                value = Rotation.from_rotvec(channel.at(time)[0], degrees=True)
                nodes = self._rotated(index, nodes, heading * value * heading.inv())
        return nodes

    def outcome(self) -> GestureOutcome:
        """Return the requested and the measured size of the gesture."""
        unit = "degrees" if self.gesture.channels[0].quantity is Quantity.ORIENTATION else "body heights"
        reached = min(self._reached.values())
        return GestureOutcome(self.gesture.name, self._size, reached, self.gesture.quantity, unit)

    def measure(self, state: BodyState, elapsed: float) -> None:
        """Measure the first channel ``elapsed`` seconds after the start of the motion."""
        channel, time = self.gesture.channels[0], elapsed - self.begin
        for k in self._extremes:
            low, high = channel.times[max(k - 1, 0)], channel.times[min(k + 1, len(channel.times) - 1)]
            if 0.5 * (low + channel.times[k]) <= time <= 0.5 * (channel.times[k] + high):
                value = float(self._value(0, state) @ channel.values[k]) / self._size
                self._reached[k] = max(self._reached[k], value)

    def _value(self, index: int, state: BodyState) -> np.ndarray:
        """Return the measured value (3,) of channel ``index`` in ground axes: a position in body heights, or an
        orientation as a rotation vector in degrees."""
        part, ground = self._driven[index], self._ground
        if self.gesture.channels[index].quantity is Quantity.POSITION:
            com, start = (self._body.centre_of_mass(x) for x in (state.positions, self._standing))
            return ground.axes @ (com - start) / self._body.height
        before, after = (x[part.nodes] - part.centre(x) for x in (self._standing, state.positions))
        turn = kabsch_rotation(part.masses, before, after)
        level = ground.rotation_about_up(self._headings[index])
        return ground.axes @ Rotation.from_matrix(level.T @ turn).as_rotvec(degrees=True)

    def _rigid_motion(self, part: BodyPart, state: BodyState, turning: np.ndarray, rate: float) -> np.ndarray:
        """Return the velocities (k, 3) m/s of the nodes of ``part`` relative to its centre in a rotation by ``turning``
        (3,) rad/s, world axes, in which the part returns to its shape in the standing pose at ``rate`` 1/s."""
        before, after = (x[part.nodes] - part.centre(x) for x in (self._standing, state.positions))
        rigid = before @ kabsch_rotation(part.masses, before, after).T
        return np.cross(turning, after) + rate * (rigid - after)

    def posture(self, time: float) -> PostureTarget:
        """Return the target posture of the whole body ``time`` seconds after the start of the gesture."""
        height = self._body.height
        target = PostureTarget(*np.zeros((4, 3)))
        for part, channel in zip(self.gesture.parts, self.gesture.channels, strict=True):
            if part.name != WHOLE_BODY:
                continue
            (value, rate), second = channel.at(time), channel.second_rate(time)
            if channel.quantity is Quantity.POSITION:
                target = PostureTarget(height * value, height * rate, height * second, target.turn)
            else:
                turn = target.turn + np.radians(value)
                target = PostureTarget(target.offset, target.velocity, target.acceleration, turn)
        return target

    def at(self, name: str, elapsed: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the target value (3,) of the part ``name`` and its rate (3,) per second, ``elapsed`` seconds after the
        start of the motion; None if the gesture does not move this part."""
        found = [channel for channel in self.gesture.channels if channel.part == name]
        return found[0].at(elapsed - self.begin) if found else None

    def objectives(self, state: BodyState, elapsed: float, dt: float, active: Sequence[Layer]) -> list[AnyObjective]:
        """Return the objectives of the parts for a time step of ``dt`` seconds, ``elapsed`` seconds after the start of
        the motion. The values that all ``active`` gestures set for a part are added, and only the first of these
        gestures returns the objective of the sum."""
        axes, rules, body = self._ground.axes, [], self._body
        rate = CORRECTION_RATE * float(np.sqrt(np.linalg.norm(body.gravity) / body.height))
        for index, part in enumerate(self.gesture.parts):
            if part.name == WHOLE_BODY:
                continue
            before = self._headings[index]
            heading = heading_between(self._standing, state.positions, self._shares[index], self._ground)
            self._headings[index] = heading
            turned = np.remainder(heading - before + np.pi, 2.0 * np.pi) - np.pi if self._has_started else 0.0
            targets = {layer: layer.at(part.name, elapsed + dt) for layer in active}
            found = {layer: target for layer, target in targets.items() if target is not None}
            if next(iter(found)) is not self:
                continue
            value, value_rate = np.sum([*found.values()], axis=0)
            last = value - dt * value_rate
            turning = np.radians(turn_between(last, value) / dt + rate * turn_between(self._value(index, state), last))
            turning = turning + [0.0, 0.0, turned / dt]
            ground = Coordinates(axes @ self._ground.rotation_about_up(heading).T, False)
            rules.append(part_angular_velocity(body, self._driven[index], state, turning, _WEIGHT, ground))
            outer = self._outer[index]
            moving = self._rigid_motion(outer, state, ground.axes.T @ turning, rate)
            rules.append(part_shape(body, outer, moving, _SHAPE_WEIGHT))
        self._has_started = True
        return rules


def _stiff_part(body: SoftBody, part: BodyPart) -> BodyPart:
    """Return ``part`` without its soft nodes (``stiffness_at_nodes``), or unchanged if it is the whole body or most of
    it is soft."""
    is_stiff = stiffness_at_nodes(body)[part.nodes] > _SOFT
    if part.name == WHOLE_BODY or is_stiff.all() or is_stiff.mean() <= 0.5:
        return part
    return BodyPart.of(body, part.name, part.nodes[is_stiff])
