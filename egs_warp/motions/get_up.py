"""Get up: a body that lies presses itself up about the edge of its base, rolls over it, and comes to stand from a
crouch.

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
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import RestDetector
from egs_warp.motions.stand import Stand

UPRIGHT = 15.0
"""Degrees: a body that stands at rest within this is up."""
_TRIES = ((1.2, 0.1), (1.6, 0.1), (1.0, 0.05), (1.3, 0.2), (2.2, 0.1), (1.6, 0.2), (3.0, 0.15), (1.0, 0.15))
"""Of each try, one after the other: its push over the one that would just do in ``_STROKE``, and the height, in body
heights, that it is to have in hand over the top."""
_STROKE = 0.35
"""Radians of the roll over which a body can press itself up."""
_SWITCHED = 0.4
"""Of sqrt(H / g), in which a push grows to its full size."""
_OVER = 0.25
"""Radians in sqrt(H / g): how fast it is to roll over the top at the least."""
_BRAKES = 4.0
"""Radians in H / g: the most that it slows down by."""
_BASE = 0.3
"""Body heights: what is at most this high above a standing body's sole turns as its base does."""
_EDGE = 35.0
"""Degrees: the body rolls over what would touch first if the ground were steeper by this, or by half of what its base
is still off the ground."""
_LANDED = 20.0
"""Degrees from the ground within which its base has come down."""
_CROUCH = 0.75
"""Of the height at which its centre of mass stands: how low it is held until it is calm. Held low, it has further to
go over the other side of its base."""
_ASIDE = 0.1
"""Body heights behind the edge: what presses there can push."""
_LIES, _ROLLS, _STRAIGHTENS = 6.0, 6.0, 10.0
"""Of sqrt(H / g): for how long it waits to lie calm, may roll, and may take to come to rest on its feet."""
_SINKS_AFTER, _SINKS = 0.6, 0.05
"""Of sqrt(H / g), and radians in it: what by then rolls back so fast has not got over."""
_LOST = 60.0
"""Degrees: with its base further off the ground it does not stand."""


class GetUpPhase(Enum):
    """Phases of getting up."""

    LIE = "lie"
    ROLL = "roll"
    CATCH = "catch"
    """It comes to rest on its base, held low."""
    STAND = "stand"
    GIVEN_UP = "given up"


@dataclass(frozen=True)
class GetUpPlan:
    """How often it may try."""

    tries: float


@dataclass(frozen=True)
class GetUpOutcome:
    """How it got up."""

    tries: float


@dataclass(frozen=True)
class GetUpControl:
    """Weights of the objectives; speeds are compared in sqrt(g H)."""

    com: float = 600.0
    spin: float = 600.0
    pose: float = 0.05
    """Of the standing shape while it pushes."""
    carried: float = 0.3
    """Of the shape that it has once it only rolls on."""
    follow: float = 8.0
    """Of the shape, in sqrt(g / H)."""


@dataclass(frozen=True)
class _Roll:
    """How the body rolls over its edge; world axes."""

    axis: np.ndarray
    """(3,) unit, level: about it the body turns up."""
    arm: np.ndarray
    """(3,) metres from the edge to the centre of mass, square to ``axis``."""
    inertia: float
    """kg m^2 about the edge."""
    rate: float
    """rad/s about it."""
    missing: float
    """Metres by which the centre of mass has to rise on its way over the top."""
    pushes: bool
    """Whether anything bears it behind the edge."""


class GetUp:
    """Presses itself up and stands, or gives up after ``_TRIES``."""

    def __init__(self, place: Stance, *, control: GetUpControl | None = None) -> None:
        """``place``: how the body stands where it does; it lies anyhow. Raises ``UserError`` for a ball."""
        if place.base() is SupportKind.ROUND_BASE:
            raise UserError("get up: a ball lies any way up; walk or jump on")
        body = place.body
        self._place, self.body, self.ground = place, body, place.ground
        self.control = control or GetUpControl()
        self._gravity = float(np.linalg.norm(body.gravity))
        self._unit = body.time_unit
        self._arms = place.standing - body.centre_of_mass(place.standing)
        heights = place.standing @ place.ground.surface_normal
        self._base = np.flatnonzero(heights < heights.min() + _BASE * body.height)
        if len(self._base) < 4:
            self._base = np.argsort(heights)[:8]
        self._calm = RestDetector(body)
        self.phase, self._entered = GetUpPhase.LIE, -1.0
        self.tries = 0
        self._push, self._in_hand = 0.0, 0.0
        self._stand: Stand | None = None
        self._degrees = self._base_degrees = 180.0

    @property
    def is_at_rest(self) -> bool:
        """Whether it stands calmly, or has given up."""
        if self.phase is GetUpPhase.STAND:
            return self._stand is not None and self._stand.resting and self._degrees < UPRIGHT
        return self.phase is GetUpPhase.GIVEN_UP

    @property
    def up(self) -> bool:
        """Whether it has come to its feet."""
        return self.phase is GetUpPhase.STAND

    @property
    def expected_time(self) -> float:
        """Seconds, of one try."""
        return 8.0 * self._unit

    def plan_record(self) -> GetUpPlan:
        """How often it may try."""
        return GetUpPlan(float(len(_TRIES)))

    def planned_com(self, elapsed: float) -> None:
        """Nothing: it goes on from how it lies."""

    def notes(self) -> list[str]:
        """What kept it from its feet, for the user."""
        return [f"it does not get up: it lies after {self.tries} tries"] if self.phase is GetUpPhase.GIVEN_UP else []

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> GetUpOutcome:
        """How often it tried."""
        return GetUpOutcome(float(self.tries))

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        roll = self._measured(state, report)
        self._advance(state, report, roll)
        if self.phase in (GetUpPhase.CATCH, GetUpPhase.STAND):
            assert self._stand is not None
            return self._stand.objectives(state, report, dt)
        return self._rolling(state, roll, dt) if self.phase is GetUpPhase.ROLL else []

    def _measured(self, state: BodyState, report: StepReport | None) -> _Roll:
        body, up, normal = self.body, self.ground.axes[2], self.ground.surface_normal
        x, com = state.positions, body.centre_of_mass(state.positions)
        angle, axis = self._tilt(x)
        base_angle, _ = self._tilt(x, self._base)
        self._degrees, self._base_degrees = float(np.degrees(angle)), float(np.degrees(base_angle))
        ahead = np.cross(axis, up)
        steeper = min(0.5 * base_angle, np.radians(_EDGE))
        first = np.cos(steeper) * ((x - self.ground.origin) @ normal) - np.sin(steeper) * (x @ ahead)
        edge = x[first < first.min() + 0.005 * body.height].mean(axis=0)
        arm = com - edge
        arm = arm - (arm @ axis) * axis
        inertia = float(axis @ body.inertia(x) @ axis) + body.mass * float(arm @ arm)
        momentum = body.angular_momentum(x, state.velocities)
        momentum = momentum + body.mass * np.cross(arm, body.centre_of_mass(state.velocities))
        rise = max(self._top(x - com, axis, angle) - float((com - self.ground.origin) @ normal), 0.0)
        behind = 0.0
        if report is not None and report.contacts.count:
            points = np.einsum("cw,cwi->ci", report.contacts.weights, x[report.contacts.nodes])
            behind = float(report.forces[(points - edge) @ ahead < -_ASIDE * body.height, 0].sum())
        return _Roll(axis, arm, inertia, float(axis @ momentum) / inertia, rise, behind > 0.02 * body.weight)

    def _advance(self, state: BodyState, report: StepReport | None, roll: _Roll) -> None:
        if self._entered < 0.0:
            self._entered = state.time
        elapsed = (state.time - self._entered) / self._unit
        calm = self._calm.update(self.body.centre_of_mass(state.velocities), state.time)
        load = 0.0 if report is None else float(report.forces[:, 0].sum()) / self.body.weight
        upright = self._degrees < UPRIGHT
        if self.phase is GetUpPhase.LIE and (calm or elapsed > _LIES):
            if upright:
                self._catch(state, GetUpPhase.STAND, 1.0)
            elif self.tries == len(_TRIES):
                self._enter(GetUpPhase.GIVEN_UP, state.time)
            else:
                push, in_hand = _TRIES[self.tries]
                needed = max(roll.missing, 0.02 * self.body.height)
                self._push = push * self.body.mass * self._gravity * needed / (roll.inertia * _STROKE)
                self._in_hand = in_hand * self.body.height
                self.tries += 1
                self._enter(GetUpPhase.ROLL, state.time)
        elif self.phase is GetUpPhase.ROLL:
            sinks = roll.rate * self._unit < -_SINKS and self._degrees > _LANDED
            if self._base_degrees < _LANDED and load > 0.05:
                self._catch(state, GetUpPhase.CATCH, _CROUCH)
            elif elapsed > _ROLLS or (elapsed > _SINKS_AFTER and sinks):
                self._enter(GetUpPhase.LIE, state.time)
        elif self.phase in (GetUpPhase.CATCH, GetUpPhase.STAND):
            assert self._stand is not None
            late = elapsed > _STRAIGHTENS
            if self._base_degrees > _LOST or (late and not upright):
                self._enter(GetUpPhase.LIE, state.time)
            elif self.phase is GetUpPhase.CATCH and upright and (self._stand.resting or late):
                self._catch(state, GetUpPhase.STAND, 1.0)

    def _enter(self, phase: GetUpPhase, time: float) -> None:
        self.phase, self._entered = phase, time

    def _catch(self, state: BodyState, phase: GetUpPhase, crouch: float) -> None:
        self._stand = Stand(self._place.moved_to(state.positions), at_rest=False, crouch=crouch)
        self._enter(phase, state.time)

    def _tilt(self, positions: np.ndarray, nodes: np.ndarray | slice = slice(None)) -> tuple[float, np.ndarray]:
        """Radians by which the body, or what some of its ``nodes`` are of it, is off upright, and the level axis (3,),
        world axes, about which that is undone."""
        mass, arms, up = self.body.node_mass[nodes], self._arms[nodes], self.ground.axes[2]
        now = positions[nodes]
        turn = kabsch_rotation(mass, arms - mass @ arms / mass.sum(), now - mass @ now / mass.sum())
        head = turn @ up
        axis = np.cross(head, up)
        size = float(np.linalg.norm(axis))
        angle = float(np.arctan2(size, head @ up))
        return angle, axis / size if size > 1e-9 else self.ground.axes[0]

    def _top(self, arms: np.ndarray, axis: np.ndarray, angle: float) -> float:
        """Metres over the ground: the highest that the centre of mass of a body of ``arms`` (N, 3) comes on its way, as
        it rolls about ``axis`` (3,) by ``angle`` radians, whatever edges it rolls over."""
        normal = self.ground.surface_normal
        turns = Rotation.from_rotvec(np.linspace(0.0, angle, max(int(np.degrees(angle) / 3.0), 2))[:, None] * axis)
        return float((-(turns.inv().apply(normal) @ arms.T).min(axis=1)).max())

    def _rolling(self, state: BodyState, roll: _Roll, dt: float) -> list[AnyObjective]:
        """The centre of mass and the spin of a body that turns about its edge as a whole, as fast as brings it over
        the top; once nothing pushes it any more, as it does by itself."""
        body, control, unit = self.body, self.control, self._unit
        weight = body.mass * self._gravity
        elapsed = state.time - self._entered + dt
        ahead = np.cross(roll.axis, self.ground.axes[2])
        arms = state.positions - body.centre_of_mass(state.positions)
        carried = not roll.pushes and elapsed - dt > 0.3 * unit
        if carried:
            rate = roll.rate + dt * weight * float(roll.arm @ ahead) / roll.inertia
        else:
            rise = roll.missing + (self._in_hand if roll.missing > 0.01 * body.height else 0.0)
            enough = float(np.sqrt(2.0 * weight * rise / roll.inertia + (_OVER / unit) ** 2))
            push = self._push * max(smooth(elapsed / (_SWITCHED * unit)), 0.1)
            rate = roll.rate + float(np.clip(enough - roll.rate, -_BRAKES * dt / unit**2, push * dt))
        velocity = rate * np.cross(roll.axis, roll.arm)
        if carried:
            pose = node_velocities(body, velocity + rate * np.cross(roll.axis, arms), control.carried)
        else:
            turn = kabsch_rotation(body.node_mass, self._arms, arms)
            shape = control.follow / unit * (self._arms @ turn.T - arms)
            pose = deformation_velocities(body, state.positions, shape, control.pose)
        return [
            centre_of_mass_velocity(body, velocity, control.com),
            AngularMomentumObjective(body.inertia(state.positions) @ (rate * roll.axis), control.spin),
            pose,
        ]


def lie_down(place: Stance, degrees: float, axis: np.ndarray) -> np.ndarray:
    """(N, 3) the body that stands at ``place`` laid over by ``degrees`` about ``axis`` (3,), just over the ground."""
    body = place.body
    com = body.centre_of_mass(place.standing)
    turn = Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis)).as_matrix()
    laid = com + (place.standing - com) @ turn.T
    low = float(((laid - place.ground.origin) @ place.ground.surface_normal).min())
    return laid + (1e-3 * body.height - low) * place.ground.surface_normal
