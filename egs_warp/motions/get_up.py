"""Get up: a body that lies throws itself up with the spin that turns it onto its feet, lands on them and stands.

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
from egs_warp.geometry.frames import best_turn
from egs_warp.locomotion.objectives import (
    AnyObjective,
    SpinObjective,
    centre_of_mass_velocity,
    straining_velocities,
)
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.feet import Base
from egs_warp.motions.gait import smooth
from egs_warp.motions.sequence import Place
from egs_warp.motions.stance import Calm
from egs_warp.motions.stand import Stand

UPRIGHT = 15.0
"""Degrees: a body that stands at rest within this is up."""
_LEANS = 40.0
"""Degrees within which a body that has come down is caught as one that stands."""
_RISES = (0.12, 0.2, 0.3)
"""Body heights over that of a standing body's centre of mass to which each throw takes it, one after the other."""
_DEPTH, _CROUCH = 0.25, 1.2
"""Of the height at which its centre of mass lies, and of sqrt(H / g): how far, and in what time, it draws down."""
_EXTENDED = 1.15
"""Of that height: where the thrust ends at the latest."""
_FLAT, _SLOW = 8.0, 0.15
"""Degrees and sqrt(g H) within which it stands with all of its feet on the ground."""
_STRAIGHTENS = 10.0
"""Of sqrt(H / g), in which it must have come upright on its feet."""
_SPIN, _MOST_SPIN = 1.4, 2.5
"""Times what turns it upright until it comes down: a soft body leaves the ground with so much less than is asked; and
the most, of a throw after others that did not turn it enough."""
_LIES, _TURNS = 6.0, 3.5
"""Of sqrt(H / g): for how long it waits to lie calm, and to come down."""


class GetUpPhase(Enum):
    """Phases of getting up."""

    LIE = "lie"
    CROUCH = "crouch"
    THRUST = "thrust"
    TURN = "turn"
    LAND = "land"
    STAND = "stand"
    GIVEN_UP = "given up"


@dataclass(frozen=True)
class GetUpPlan:
    """How often it may try."""

    throws: float


@dataclass(frozen=True)
class GetUpReached:
    """How it got up."""

    throws: float


@dataclass(frozen=True)
class GetUpControl:
    """Weights of the objectives; speeds are compared in sqrt(g H)."""

    com: float = 600.0
    spin: float = 600.0
    pose: float = 0.05
    airborne: float = 2.0
    landing: float = 0.1
    """Share of ``com`` and ``spin`` that is asked for from touch-down until it stands."""
    righting: float = 2.0
    """Of the tilt from then on, in sqrt(g / H)."""
    follow: float = 8.0
    """Of the shape, in sqrt(g / H)."""


class GetUp:
    """Throws itself up and stands, or gives up after ``_RISES``."""

    def __init__(self, place: Place, *, control: GetUpControl | None = None) -> None:
        """``place``: how the body stands where it does; it lies anyhow. Raises ``UserError`` for a ball."""
        if place.base() is Base.ROUND:
            raise UserError("get up: a ball lies any way up; walk or jump on")
        body = place.body
        self._place, self.body, self.ground = place, body, place.ground
        self.control = control or GetUpControl()
        self._gravity = float(np.linalg.norm(body.gravity))
        self._unit = body.time_unit
        self._arms = place.standing - body.centre_of_mass(place.standing)
        self._standing_height = float(place.ground.local(body.centre_of_mass(place.standing))[2])
        self._calm = Calm(body)
        self.phase, self._entered = GetUpPhase.LIE, -1.0
        self.throws = 0
        self._stand: Stand | None = None
        self._low = self._speed = 0.0
        self._spin, self._asked = _SPIN, 0.0
        self._degrees = 180.0

    @property
    def resting(self) -> bool:
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
        """Seconds, of one throw."""
        return 8.0 * self._unit

    def planned(self) -> GetUpPlan:
        """How often it may try."""
        return GetUpPlan(float(len(_RISES)))

    def planned_com(self, elapsed: float) -> None:
        """Nothing: it goes on from how it lies."""

    def notes(self) -> list[str]:
        """What kept it from its feet, for the user."""
        return [f"it does not get up: it lies after {self.throws} throws"] if self.phase is GetUpPhase.GIVEN_UP else []

    def reached(self, trajectory: Trajectory, first: int, last: int) -> GetUpReached:
        """How often it threw itself up."""
        return GetUpReached(float(self.throws))

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        local = self.ground.local(state.positions)
        com = self.body.centre_of_mass(local)
        moving = self.ground.axes @ self.body.centre_of_mass(state.velocities)
        self._advance(state, report, com, moving)
        elapsed = state.time - self._entered
        if self.phase is GetUpPhase.STAND:
            assert self._stand is not None
            return self._stand.objectives(state, report, dt)
        if self.phase is GetUpPhase.CROUCH:
            depth = _DEPTH * self._low
            goal = self._low - depth * smooth((elapsed + dt) / (_CROUCH * self._unit))
            return self._shaped(state, com, moving, [0.0, 0.0, 6.0 / self._unit * (goal - com[2])], 0.0, dt)
        if self.phase is GetUpPhase.THRUST:
            stroke = (_EXTENDED - 1.0 + _DEPTH) * self._low
            push = 0.5 * self._speed**2 / (0.7 * stroke)
            share = 0.3 + 0.7 * min((com[2] - (1.0 - _DEPTH) * self._low) / (0.4 * stroke), 1.0)
            up = moving[2] + dt * max(share, 0.3) * push
            angle, _ = self._tilt(state.positions)
            gained = min(max(up, 0.0) / self._speed, 1.0)
            self._asked = self._spin * gained * angle / self._flight(self._speed)
            return self._shaped(state, com, moving, [0.0, 0.0, up], self._asked, dt)
        if self.phase is GetUpPhase.TURN:
            return self._turning(state, com, moving)
        if self.phase is GetUpPhase.LAND:
            return self._landing(state, moving, dt)
        return []

    def _advance(self, state: BodyState, report: StepReport | None, com: np.ndarray, moving: np.ndarray) -> None:
        if self._entered < 0.0:
            self._entered = state.time
        elapsed, unit = state.time - self._entered, self._unit
        load = 0.0 if report is None else float(report.forces[:, 0].sum()) / self.body.weight
        calm = self._calm.held(moving, state.time)
        angle, _ = self._tilt(state.positions)
        degrees = self._degrees = float(np.degrees(angle))
        if self.phase is GetUpPhase.LIE and (calm or elapsed > _LIES * unit):
            if degrees < UPRIGHT:
                self._catch(state)
            elif self.throws == len(_RISES):
                self._enter(GetUpPhase.GIVEN_UP, state.time)
            else:
                self._low = float(com[2])
                rise = max(self._standing_height - self._low, 0.0) + _RISES[self.throws] * self.body.height
                self._speed = float(np.sqrt(2.0 * self._gravity * rise))
                self.throws += 1
                self._enter(GetUpPhase.CROUCH, state.time)
        elif self.phase is GetUpPhase.CROUCH and elapsed >= _CROUCH * unit:
            self._enter(GetUpPhase.THRUST, state.time)
        elif self.phase is GetUpPhase.THRUST:
            flies = moving[2] >= 0.3 * self._speed and load <= 0.0
            fast = moving[2] >= np.sqrt(max(self._speed**2 - 2.0 * self._gravity * (com[2] - self._low), 0.0))
            if fast or flies or com[2] > 1.5 * _EXTENDED * self._low or elapsed > 2.0 * unit:
                # The next throw, if it comes to that, asks for what this one has fallen short by.
                self._spin = float(np.clip(self._spin * self._asked / max(self._rate(state), 1e-9), _SPIN, _MOST_SPIN))
                self._enter(GetUpPhase.TURN, state.time)
        elif self.phase is GetUpPhase.TURN:
            if degrees < _LEANS and load > 0.05 and moving[2] < 0.2 * self.body.speed_unit:
                self._enter(GetUpPhase.LAND, state.time)
            elif elapsed > (1.0 if calm else 2.0) * _TURNS * unit:
                self._enter(GetUpPhase.LIE, state.time)
        elif self.phase is GetUpPhase.LAND and (
            (degrees < _FLAT and float(np.linalg.norm(moving)) < _SLOW * self.body.speed_unit)
            or elapsed > _TURNS * unit
        ):
            self._catch(state)
        elif (self.phase in (GetUpPhase.LAND, GetUpPhase.STAND) and degrees > 60.0) or (
            self.phase is GetUpPhase.STAND and elapsed > _STRAIGHTENS * unit and degrees > UPRIGHT
        ):
            self._enter(GetUpPhase.LIE, state.time)

    def _enter(self, phase: GetUpPhase, time: float) -> None:
        self.phase, self._entered = phase, time

    def _catch(self, state: BodyState) -> None:
        self._stand = Stand(self._place.now(state.positions))
        self._stand._resting = False
        self._enter(GetUpPhase.STAND, state.time)

    def _tilt(self, positions: np.ndarray) -> tuple[float, np.ndarray]:
        """Radians by which the body is off upright, and the level axis (3,), world axes, about which that is undone."""
        turn = best_turn(self.body.node_mass, self._arms, positions - self.body.centre_of_mass(positions))
        up = self.ground.axes[2]
        head = turn @ up
        axis = np.cross(head, up)
        size = float(np.linalg.norm(axis))
        angle = float(np.arctan2(size, head @ up))
        return angle, axis / size if size > 1e-9 else self.ground.axes[0]

    def _rate(self, state: BodyState) -> float:
        """Radians a second at which it turns up."""
        body = self.body
        momentum = body.angular_momentum(state.positions, state.velocities)
        _, axis = self._tilt(state.positions)
        return float(axis @ np.linalg.solve(body.inertia(state.positions), momentum))

    def _flight(self, speed: float) -> float:
        """Seconds in which a body that leaves at ``speed`` m/s comes down to the height at which it stands."""
        rise = max(self._standing_height - self._low, 0.0)
        return (speed + float(np.sqrt(max(speed**2 - 2.0 * self._gravity * rise, 0.0)))) / self._gravity

    def _shape(self, positions: np.ndarray, stretch: float) -> np.ndarray:
        """(N, 3) arms of the standing shape, turned as the body is and stretched along up."""
        turn = best_turn(self.body.node_mass, self._arms, positions - self.body.centre_of_mass(positions))
        bulge = stretch**-0.25
        strain = self.ground.axes.T @ np.diag([bulge, bulge, stretch]) @ self.ground.axes
        return self._arms @ turn.T @ strain

    def _shaped(
        self, state: BodyState, com: np.ndarray, moving: np.ndarray, velocity: Sequence[float], rate: float, dt: float
    ) -> list[AnyObjective]:
        """The centre of mass at ``velocity`` (3,), ground axes, the body turning up at ``rate`` rad/s."""
        body, control = self.body, self.control
        _, axis = self._tilt(state.positions)
        arms = state.positions - body.centre_of_mass(state.positions)
        stretch = float(np.clip((com[2] + dt * velocity[2]) / self._low, 0.7, 1.25))
        shape = control.follow / self._unit * (self._shape(state.positions, stretch) - arms)
        return [
            centre_of_mass_velocity(body, np.asarray(velocity) @ self.ground.axes, control.com),
            SpinObjective(body.inertia(state.positions) @ (rate * axis), control.spin),
            straining_velocities(body, state.positions, shape, control.pose),
        ]

    def _turning(self, state: BodyState, com: np.ndarray, moving: np.ndarray) -> list[AnyObjective]:
        """In the air, and on an edge: to the standing shape, and the spin that brings it upright when it comes down."""
        body, control = self.body, self.control
        angle, axis = self._tilt(state.positions)
        fall = com[2] - self._standing_height
        left = (moving[2] + float(np.sqrt(max(moving[2] ** 2 + 2.0 * self._gravity * fall, 0.0)))) / self._gravity
        rate = self._spin * angle / max(left, 0.3 * self._unit)
        arms = state.positions - body.centre_of_mass(state.positions)
        shape = control.follow / self._unit * (self._shape(state.positions, 1.0) - arms)
        return [
            SpinObjective(body.inertia(state.positions) @ (rate * axis), 0.1 * control.spin),
            straining_velocities(body, state.positions, shape, control.airborne),
        ]

    def _landing(self, state: BodyState, moving: np.ndarray, dt: float) -> list[AnyObjective]:
        """On an edge of its feet: it comes to rest and goes over onto all of them, in the shape in which it stands."""
        body, control = self.body, self.control
        angle, axis = self._tilt(state.positions)
        arms = state.positions - body.centre_of_mass(state.positions)
        shape = control.follow / self._unit * (self._shape(state.positions, 1.0) - arms)
        velocity = (1.0 - 2.0 * dt / self._unit) * moving
        righting = control.righting / self._unit * angle
        return [
            centre_of_mass_velocity(body, velocity @ self.ground.axes, control.landing * control.com),
            SpinObjective(body.inertia(state.positions) @ (righting * axis), control.landing * control.spin),
            straining_velocities(body, state.positions, shape, control.airborne),
        ]


def lie_down(place: Place, degrees: float, axis: np.ndarray) -> np.ndarray:
    """(N, 3) the body that stands at ``place`` laid over by ``degrees`` about ``axis`` (3,), just over the ground."""
    body = place.body
    com = body.centre_of_mass(place.standing)
    turn = Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis)).as_matrix()
    laid = com + (place.standing - com) @ turn.T
    low = float(((laid - place.ground.origin) @ place.ground.surface_normal).min())
    return laid + (1e-3 * body.height - low) * place.ground.surface_normal
