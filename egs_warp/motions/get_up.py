"""Getting up: a lying body pushes itself up, rolls over an edge of its base, and straightens from a crouch.

See docs/concepts/motions.md.
"""

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
    centre_of_mass_velocity,
    deformation_velocities,
    node_velocities,
)
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.gait import smooth
from egs_warp.motions.push_capacity import push_capacity
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import RestDetector
from egs_warp.motions.stand import Stand
from egs_warp.motions.tipping import TippingPath, tipping_path

MAX_UPRIGHT_TILT = 15.0
"""Maximum tilt in degrees of a body that counts as having got up and stands at rest."""
MAX_TRIES = 3
"""Maximum number of attempts."""
_STROKE = 0.12
"""Angle in radians over which a body can push itself up during the roll."""
_MIN_STROKE = 0.04
"""Minimum remaining angle in radians for which a push is planned."""
_MIN_MARGIN, _MAX_MARGIN = 0.05, 0.07
"""Bounds of the planned excess energy at the top of the roll, divided by the weight, in body heights."""
_PASSED_HEIGHT = 0.005
"""Remaining rise in body heights below which a body counts as past the top of the roll."""
_MIN_LIFT_SHARE = 0.5
"""Minimum share of the required rise that a push has to reach for the body to try again."""
_PUSH_RAMP_TIME = 0.4
"""Time in sqrt(H / g) in which a push grows to its full strength."""
_BASE_HEIGHT = 0.3
"""Height in body heights above the sole of the standing body up to which nodes belong to the base."""
_EDGE_ANGLE = 35.0
"""Angle, in degrees, that defines the edge over which the body rolls: the nodes of the edge would touch first if the
ground were steeper by this angle, or by half of the tilt of the base if that is smaller."""
_EDGE_BAND = 0.005
"""Height in body heights above the lowest node up to which nodes belong to the edge; heights are measured from the
steeper ground."""
_TOUCHING_HEIGHT = 0.02
"""Height in body heights above the lowest node up to which nodes of a lying body can push against the ground."""
_LANDED_ANGLE = 20.0
"""Maximum tilt in degrees of a base that is considered landed."""
_CROUCH_FRACTION = 0.75
"""Height to which the body crouches from the free roll until it is at rest, as a fraction of its standing height. A low
centre of mass needs less energy to pass the top, and more to tip over the other side of the base."""
_RELAX_TIME, _MIN_EXCESS = 0.35, 0.03
"""Time in sqrt(H / g) of the free roll in which the strain of the push relaxes before the excess is measured; and
excess of energy at the top, divided by the weight, in body heights, below which a rolling body crouches."""
_MIN_PUSH_DISTANCE = 0.1
"""Distance behind the edge, in body heights, beyond which contact points can push."""
_MAX_LIE_TIME, _MAX_ROLL_TIME, _MAX_STRAIGHTEN_TIME = 6.0, 6.0, 10.0
"""Maximum times in sqrt(H / g) for coming to rest while lying, for rolling, and for coming to rest on the feet."""
_FAIL_TIME, _FAIL_RATE = 0.6, 0.05
"""Time in sqrt(H / g) after which an attempt has failed if the body rolls back, and minimum rate of rolling back in
radians per sqrt(H / g)."""
_MAX_CATCH_TILT = 40.0
"""Maximum tilt in degrees, of a body or of its base, from which the body can still come to rest on its base."""


class GetUpPhase(Enum):
    """Phases of getting up."""

    LIE = "lie"
    ROLL = "roll"
    CATCH = "catch"
    """The body comes to rest on its base in a crouch."""
    STAND = "stand"
    GIVEN_UP = "given up"


@dataclass(frozen=True)
class GetUpPlan:
    """Planned quantities of an attempt to get up."""

    tries: float


@dataclass(frozen=True)
class GetUpOutcome:
    """Measured result of getting up."""

    tries: float


@dataclass(frozen=True)
class GetUpControl:
    """Weights of the objectives; speeds are in units of sqrt(g H)."""

    com: float = 600.0
    spin: float = 600.0
    pose: float = 0.05
    """Weight of the standing shape while the body pushes."""
    free: float = 0.3
    """Weight of the rigid rotation and of the crouch while the body rolls without pushing."""
    follow: float = 8.0
    """Rate in sqrt(g / H) at which the shape is approached."""


@dataclass(frozen=True)
class _Roll:
    """State of the roll about the edge of the base; world axes."""

    axis: np.ndarray
    """(3,) horizontal unit vector, axis of the rotation to the upright orientation."""
    arm: np.ndarray
    """(3,) m, vector from the edge to the centre of mass, orthogonal to ``axis``."""
    inertia: float
    """kg m^2, moment of inertia about the edge."""
    rate: float
    """rad/s, angular velocity about the edge."""
    edge_nodes: np.ndarray
    """(k,) nodes of the edge."""
    path: TippingPath
    missing: float
    """Height in metres by which the centre of mass still has to rise to pass the top of the roll."""
    rear: float
    """Position of the rear end of the support, in the direction of the roll, relative to the centre of mass, m."""
    pushes: bool
    """True if the ground supports the body behind the edge."""


class GetUp:
    """Push the body up until it stands; give up after ``MAX_TRIES`` attempts, or at once if the muscles are too
    weak."""

    def __init__(self, stance: Stance, *, control: GetUpControl | None = None) -> None:
        """Create the motion.

        Args:
            stance: upright stance of the body before it fell.
            control: weights of the objectives.

        Raises:
            UserError: for a ball.
        """
        if stance.base() is SupportKind.ROUND_BASE:
            raise UserError("get up: a ball cannot fall over; walk or jump instead")
        body = stance.body
        self._stance, self.body, self.ground = stance, body, stance.ground
        self.control = control or GetUpControl()
        self._gravity = float(np.linalg.norm(body.gravity))
        self._unit = body.time_unit
        self._arms = stance.standing - body.centre_of_mass(stance.standing)
        heights = stance.standing @ stance.ground.surface_normal
        self._base = np.flatnonzero(heights < heights.min() + _BASE_HEIGHT * body.height)
        if len(self._base) < 4:
            self._base = np.argsort(heights)[:8]
        self._rest_detector = RestDetector(body)
        self.phase, self._entered = GetUpPhase.LIE, -1.0
        self.tries = 0
        self._aim = self._margin = self._excess = self._start_degrees = 0.0
        self._rise = self._shortfall = 0.0
        self._crouch_depth = self._free_time = 0.0
        self._axis = np.zeros(3)
        self._ground_level = 0.0
        self._stand: Stand | None = None
        self._weakness: str | None = None
        self._degrees = self._base_degrees = 180.0

    @property
    def is_at_rest(self) -> bool:
        """True if the body stands at rest, or has given up."""
        if self.phase is GetUpPhase.STAND:
            return self._stand is not None and self._stand.is_at_rest and self._degrees < MAX_UPRIGHT_TILT
        return self.phase is GetUpPhase.GIVEN_UP

    @property
    def is_up(self) -> bool:
        """True if the body stands on its feet."""
        return self.phase is GetUpPhase.STAND

    @property
    def expected_time(self) -> float:
        """Expected duration of one attempt, s."""
        return 8.0 * self._unit

    def plan_record(self) -> GetUpPlan:
        """Return the planned quantities: the maximum number of attempts."""
        return GetUpPlan(float(MAX_TRIES))

    def planned_com(self, elapsed: float) -> None:
        """Return None: each attempt is planned from the measured body."""

    def notes(self) -> list[str]:
        """Return messages for the user about a body that stays on the ground."""
        if self.phase is not GetUpPhase.GIVEN_UP:
            return []
        return [f"cannot get up: {self._weakness or f'it still lies after {self.tries} tries'}"]

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> GetUpOutcome:
        """Return the number of attempts."""
        return GetUpOutcome(float(self.tries))

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        roll = self._measure(state, report)
        self._advance(state, report, roll)
        if self.phase in (GetUpPhase.CATCH, GetUpPhase.STAND):
            assert self._stand is not None
            return self._stand.objectives(state, report, dt)
        return self._roll_objectives(state, roll, dt) if self.phase is GetUpPhase.ROLL else []

    def _measure(self, state: BodyState, report: StepReport | None) -> _Roll:
        body, up, normal = self.body, self.ground.axes[2], self.ground.surface_normal
        x, com = state.positions, body.centre_of_mass(state.positions)
        angle, axis, turn = self._tilt(x)
        base_angle, _, _ = self._tilt(x, self._base)
        self._degrees, self._base_degrees = float(np.degrees(angle)), float(np.degrees(base_angle))
        ahead = np.cross(axis, up)
        steeper = min(0.5 * base_angle, np.radians(_EDGE_ANGLE))
        first = np.cos(steeper) * ((x - self.ground.origin) @ normal) - np.sin(steeper) * (x @ ahead)
        edge_nodes = np.flatnonzero(first < first.min() + _EDGE_BAND * body.height)
        edge = x[edge_nodes].mean(axis=0)
        arm = com - edge
        arm = arm - (arm @ axis) * axis
        inertia = float(axis @ body.inertia(x) @ axis) + body.mass * float(arm @ arm)
        momentum = body.angular_momentum(x, state.velocities)
        momentum = momentum + body.mass * np.cross(arm, body.centre_of_mass(state.velocities))
        if self.phase is GetUpPhase.LIE:
            # The origin of a fallen body's frame is at the height of its base, which may be above the ground.
            self._ground_level = float((x @ normal).min())
        behind, rear = 0.0, float((edge - com) @ ahead)
        if report is not None and report.contacts.count:
            points = np.einsum("cw,cwi->ci", report.contacts.weights, x[report.contacts.nodes])
            loads, places = report.forces[:, 0], (points - com) @ ahead
            rear = float(places[loads > 0.0].min(initial=rear))
            behind = float(loads[places < float((edge - com) @ ahead) - _MIN_PUSH_DISTANCE * body.height].sum())
        pushes = behind > 0.02 * body.weight
        # A push straightens the body, so its path is that of the standing shape. The top of a crouched body's path is
        # lower.
        shape = x - com if self._crouch_depth > 0.0 and not pushes else self._arms @ turn.T
        path = tipping_path(body.node_mass, shape, axis, angle, normal)
        rise = max(path.top + self._ground_level - float(com @ normal), 0.0)
        return _Roll(axis, arm, inertia, float(axis @ momentum) / inertia, edge_nodes, path, rise, rear, pushes)

    def _advance(self, state: BodyState, report: StepReport | None, roll: _Roll) -> None:
        if self._entered < 0.0:
            self._entered = state.time
        elapsed = (state.time - self._entered) / self._unit
        calm = self._rest_detector.update(self.body.centre_of_mass(state.velocities), state.time)
        load = 0.0 if report is None else float(report.forces[:, 0].sum()) / self.body.weight
        upright = self._degrees < MAX_UPRIGHT_TILT
        if self.phase is GetUpPhase.LIE and (calm or elapsed > _MAX_LIE_TIME):
            if upright:
                self._catch(state, GetUpPhase.STAND, 1.0)
            elif self.tries == MAX_TRIES or self._is_too_weak(state, roll) or self._fell_far_short():
                self._enter(GetUpPhase.GIVEN_UP, state.time)
            else:
                self._begin_try(roll)
                self._enter(GetUpPhase.ROLL, state.time)
        elif self.phase is GetUpPhase.ROLL:
            self._shortfall = min(self._shortfall, roll.missing)
            self._excess = 0.5 * roll.inertia * roll.rate * abs(roll.rate) / self.body.weight - roll.missing
            rolls_back = roll.rate * self._unit < -_FAIL_RATE and self._degrees > _LANDED_ANGLE
            if self._base_degrees < _LANDED_ANGLE and load > 0.05 and self._has_captured(roll):
                self._shortfall = 0.0
                self._catch(state, GetUpPhase.CATCH, _CROUCH_FRACTION)
            elif elapsed > _MAX_ROLL_TIME or (elapsed > _FAIL_TIME and rolls_back):
                self._enter(GetUpPhase.LIE, state.time)
        elif self.phase in (GetUpPhase.CATCH, GetUpPhase.STAND):
            assert self._stand is not None
            late = elapsed > _MAX_STRAIGHTEN_TIME
            if max(self._degrees, self._base_degrees) > _MAX_CATCH_TILT or (late and not upright):
                self._enter(GetUpPhase.LIE, state.time)
            elif self.phase is GetUpPhase.CATCH and upright and (self._stand.is_at_rest or late):
                self._catch(state, GetUpPhase.STAND, 1.0)

    def _has_captured(self, roll: _Roll) -> bool:
        """Return True if the capture point has passed the rear end of the support. As long as it has not, the body can
        roll back."""
        height = max(float(roll.arm @ self.ground.axes[2]), _PASSED_HEIGHT * self.body.height)
        # A body that rolls rigidly about the edge has the angular momentum J w = m h v about it.
        velocity = roll.inertia * roll.rate / (self.body.mass * height)
        return velocity * np.sqrt(height / self._gravity) > roll.rear

    def _is_too_weak(self, state: BodyState, roll: _Roll) -> bool:
        """Return True if no push of the muscles can lift the centre of mass over the edge, and store the reason."""
        muscles, body, up = self._stance.muscles, self.body, self.ground.axes[2]
        if muscles is None or muscles.segment_count == 0 or self.tries > 0:
            return False
        x = state.positions
        low = (x - self.ground.origin) @ self.ground.surface_normal
        behind = (body.centre_of_mass(x) - roll.arm - x) @ np.cross(roll.axis, up)
        touching = np.flatnonzero(low < low.min() + _TOUCHING_HEIGHT * body.height)
        far = touching[behind[touching].argmax()]
        if behind[far] < _MIN_PUSH_DISTANCE * body.height:
            return False
        push = push_capacity(body, muscles, x, np.array([far]), roll.edge_nodes, self.ground.surface_normal)
        ahead = np.cross(roll.axis, up)
        # The point pushes at most until the centre of mass is over the edge.
        arc = float(behind[far] * np.arctan2(-roll.arm @ ahead, roll.arm @ up))
        torque = -body.weight * float(roll.arm @ ahead)
        lift = push.work(arc) / body.weight if push.force * behind[far] > torque else 0.0
        if lift > roll.missing:
            return False
        self._weakness = (
            f"a push of its muscles lifts the centre of mass by at most {lift / body.height:.2g} of the "
            f"{roll.missing / body.height:.2g} body heights needed to roll over the edge of its base"
        )
        return True

    def _fell_far_short(self) -> bool:
        """Return True if the last push lifted the centre of mass by less than ``_MIN_LIFT_SHARE`` of the required
        rise, and store the reason."""
        lift = self._rise - self._shortfall
        if self.tries == 0 or lift >= _MIN_LIFT_SHARE * self._rise:
            return False
        self._weakness = (
            f"its push lifted the centre of mass by {max(lift, 0.0) / self.body.height:.2f} of the "
            f"{self._rise / self.body.height:.2f} body heights needed to roll over the edge of its base"
        )
        return True

    def _begin_try(self, roll: _Roll) -> None:
        """Plan the next attempt. After a failed attempt, correct the planned excess by the difference between the first
        plan and the measured excess, but by at least half of the first plan."""
        height = self.body.height
        if self.tries == 0:
            self._aim = float(np.clip(0.5 * roll.path.max_excess, _MIN_MARGIN * height, _MAX_MARGIN * height))
            self._margin = self._aim
        elif roll.axis @ self._axis < 0.0:
            self._margin -= max(self._excess - self._aim, 0.5 * self._aim)
        else:
            self._margin += max(self._aim - self._excess, 0.5 * self._aim)
        self._start_degrees = self._degrees
        self._crouch_depth = self._free_time = 0.0
        self._rise = self._shortfall = roll.missing
        self._axis = roll.axis
        self.tries += 1

    def _enter(self, phase: GetUpPhase, time: float) -> None:
        self.phase, self._entered = phase, time

    def _catch(self, state: BodyState, phase: GetUpPhase, crouch: float) -> None:
        self._stand = Stand(self._stance.moved_to(state.positions), at_rest=False, crouch=crouch)
        self._enter(phase, state.time)

    def _tilt(
        self, positions: np.ndarray, nodes: np.ndarray | slice = slice(None)
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the tilt from upright of the body, or of some of its ``nodes``, in radians, and the horizontal axis
        (3,), world axes, about which a rotation by the tilt makes it upright."""
        mass, arms, up = self.body.node_mass[nodes], self._arms[nodes], self.ground.axes[2]
        now = positions[nodes]
        turn = kabsch_rotation(mass, arms - mass @ arms / mass.sum(), now - mass @ now / mass.sum())
        head = turn @ up
        axis = np.cross(head, up)
        size = float(np.linalg.norm(axis))
        angle = float(np.arctan2(size, head @ up))
        return angle, axis / size if size > 1e-9 else self.ground.axes[0], turn

    def _roll_objectives(self, state: BodyState, roll: _Roll, dt: float) -> list[AnyObjective]:
        """Return objectives for the centre of mass and the spin: those of a body that rolls rigidly about its edge at
        the rate that takes it over the top, or, if no contact can push the body, those of a free roll."""
        elapsed = state.time - self._entered + dt
        if not roll.pushes and elapsed - dt > 0.3 * self._unit:
            return self._free_roll_objectives(state, roll, dt)
        body, control = self.body, self.control
        arms = state.positions - body.centre_of_mass(state.positions)
        rate = roll.rate + dt * self._push_acceleration(roll, elapsed)
        turn = kabsch_rotation(body.node_mass, self._arms, arms)
        shape = control.follow / self._unit * (self._arms @ turn.T - arms)
        return [
            centre_of_mass_velocity(body, rate * np.cross(roll.axis, roll.arm), control.com),
            AngularMomentumObjective(body.inertia(state.positions) @ (rate * roll.axis), control.spin),
            deformation_velocities(body, state.positions, shape, control.pose),
        ]

    def _free_roll_objectives(self, state: BodyState, roll: _Roll, dt: float) -> list[AnyObjective]:
        """Return objectives of a body that no contact can push any further: it follows the free roll about its edge and
        crouches. With a lower centre of mass, it passes the top with less energy."""
        body, control = self.body, self.control
        arms = state.positions - body.centre_of_mass(state.positions)
        ahead = np.cross(roll.axis, self.ground.axes[2])
        rate = roll.rate + dt * body.weight * float(roll.arm @ ahead) / roll.inertia
        length = float(np.linalg.norm(roll.arm))
        outward = roll.arm / length
        self._free_time += dt
        if self._free_time > _RELAX_TIME * self._unit:
            # A body that pushes itself up is stretched, so the path of its centre of mass is higher than that of the
            # standing shape.
            rise = length - float(roll.arm @ self.ground.axes[2])
            excess = 0.5 * roll.inertia * roll.rate**2 / body.weight - rise
            depth = min((_MIN_EXCESS * body.height - excess) / length, 1.0 - _CROUCH_FRACTION)
            self._crouch_depth = max(self._crouch_depth, depth)
        velocity = rate * np.cross(roll.axis, roll.arm)
        shape = np.zeros_like(arms)
        if self._crouch_depth > 0.0:
            follow = min(control.follow / self._unit, 0.7 / dt)
            crouch = self._crouched_arms(arms)
            arm = -crouch[roll.edge_nodes].mean(axis=0)
            velocity += follow * (float(arm @ outward) - length) * outward
            shape = follow * (crouch - arms)
        nodes = velocity + rate * np.cross(roll.axis, arms) + shape
        return [
            centre_of_mass_velocity(body, velocity, control.com),
            AngularMomentumObjective(body.inertia(state.positions) @ (rate * roll.axis), control.spin),
            node_velocities(body, nodes, control.free),
        ]

    def _crouched_arms(self, arms: np.ndarray) -> np.ndarray:
        """Return the nodes (N, 3) of the crouched body relative to its centre of mass, in the orientation of the body
        with ``arms`` (N, 3): shortened along its up axis, and wider across it by half of the change."""
        turn = kabsch_rotation(self.body.node_mass, self._arms, arms)
        along = np.outer(turn @ self.ground.axes[2], turn @ self.ground.axes[2])
        depth = self._crouch_depth
        return self._arms @ turn.T @ (np.eye(3) - depth * along + 0.5 * depth * (np.eye(3) - along))

    def _push_acceleration(self, roll: _Roll, elapsed: float) -> float:
        """Return the angular acceleration in rad/s^2 of a body that pushes itself up. A constant torque over the rest
        of the stroke supplies the missing energy for passing the top with the planned excess."""
        weight = self.body.weight
        kinetic = 0.5 * roll.inertia * max(roll.rate, 0.0) ** 2
        rise = roll.missing + (self._margin if roll.missing > _PASSED_HEIGHT * self.body.height else 0.0)
        rolled = np.radians(self._start_degrees - self._degrees)
        # Contacts behind the edge can only push, so the torque is not negative.
        torque = max(weight * rise - kinetic, 0.0) / max(_STROKE - rolled, _MIN_STROKE)
        ramp = max(smooth(elapsed / (_PUSH_RAMP_TIME * self._unit)), 0.1)
        return float((ramp * torque + weight * (roll.arm @ np.cross(roll.axis, self.ground.axes[2]))) / roll.inertia)


def lie_down(stance: Stance, degrees: float, axis: np.ndarray) -> np.ndarray:
    """Return the nodes (N, 3) of the body of ``stance``, tilted by ``degrees`` about ``axis`` (3,) and placed just
    above the ground."""
    body = stance.body
    com = body.centre_of_mass(stance.standing)
    turn = Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis)).as_matrix()
    laid = com + (stance.standing - com) @ turn.T
    low = float(((laid - stance.ground.origin) @ stance.ground.surface_normal).min())
    return laid + (1e-3 * body.height - low) * stance.ground.surface_normal
