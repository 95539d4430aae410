"""Numbers of a jump, from what is asked and the body's height alone (docs/concepts/motions.md)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from egs_warp.motions.style import Style

EXIT_SPEED_FACTOR = 2.0
"""Speed ahead at the end of a crouch, in leans over its time: 2 is a steady acceleration, 0 a stop."""
LEAN_FRACTION = 0.15
"""Of the distance: how far the weight is put ahead before take-off. With it over the middle of the feet a push forward
would turn the body backward."""
MAX_LEAN = 0.35
"""Of the way from under the centre of mass to the front of the feet."""
MAX_CROUCH = 0.26
"""Of the height of the centre of mass, deeper ones crush elements to a fifth; a higher jump thrusts harder instead."""
THRUST_ACCELERATION = 2.8
"""Of gravity: mean acceleration of a thrust. A harder one takes a shallower crouch, which strains a stiff body less.
"""
FRICTION_FRACTION = 0.9
"""Of what friction gives while a thrust lasts: what its speed ahead may take. A thrust to which it would give less
lasts longer, in a crouch that is deeper by ``DEEPER`` body heights at most."""
_LEAST_FRICTION = 1e-6
MIN_CROUCH, MAX_EXTRA_CROUCH = 0.02, 0.02
"""Body heights that a crouch is deep at least, without the way of half a step; and more for the sake of friction."""
THRUST_START_FRACTION, THRUST_RAMP_FRACTION = 0.3, 0.4
"""Share of its full strength with which a thrust begins, where the crouch has left it, and share of its time until it
is reached.
"""

_EXTENSION, _EXTENDED = 0.04, 0.25
"""How much higher than it stands a body leaves the ground: body heights, and of the height of the jump at most."""
SETTLE_TIME = 0.3
"""Of sqrt(H / g): when it begins to crouch."""
USUAL_LANDING, USUAL_LANDING_AHEAD = 0.7, 1.0
"""Of sqrt(H / g): from touch-down until it is at rest, as a rule, and more for each body height ahead (measured on the
pawn)."""
LANDING_TIME = 0.35
"""Of sqrt(H / g): in which the fall of a body on legs is stopped, while it goes on over its feet (measured on the
robot, whose feet stay where they touch down).
"""


class JumpPhase(Enum):
    """Phases of a jump in their order."""

    SETTLE = "settle"
    CROUCH = "crouch"
    THRUST = "thrust"
    FLIGHT = "flight"
    LAND = "land"
    REST = "rest"


@dataclass(frozen=True)
class JumpTarget:
    """What is asked, in metres."""

    distance: float
    height: float
    rise: float = 0.0
    """How much higher the landing is than the start."""


@dataclass(frozen=True)
class JumpPlan:
    """Numbers a jump is planned with; metres, seconds, m/s."""

    crouch_depth: float
    extension: float
    crouch_time: float
    """A whole number of steps: what is asked goes over into the thrust without a jolt."""
    thrust_time: float
    flight_time: float
    speed_up: float
    speed_forward: float
    lean: float
    """How far the centre of mass moves ahead while crouching."""
    landing_lag: float
    """How far it is behind its place over the base at touch-down."""
    landing_rate: float
    """1/s of the critically damped descent on landing."""

    @property
    def _down(self) -> np.ndarray:
        """(3,) from where the centre of mass stands to where the crouch brings it."""
        return np.array([self.lean, 0.0, -self.crouch_depth])

    @property
    def _onset(self) -> np.ndarray:
        """(3,) m/s. The crouch ends at rest over the ground but already on the way ahead: friction has little left to
        give during the thrust."""
        return np.array([min(EXIT_SPEED_FACTOR * self.lean / self.crouch_time, self.speed_forward), 0.0, 0.0])

    def crouch(self, start: np.ndarray, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity (3,) of the centre of mass that stood at ``start`` (3,), ``elapsed`` seconds into the
        crouch."""
        s = min(elapsed / self.crouch_time, 1.0)
        blend, slope = s * s * (3 - 2 * s), 6 * s * (1 - s) / self.crouch_time
        carried, rate = s * s * (s - 1) * self.crouch_time, s * (3 * s - 2)
        return start + blend * self._down + carried * self._onset, slope * self._down + rate * self._onset

    def thrust(self, start: np.ndarray, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """The same, ``elapsed`` seconds into the thrust, which grows to a steady acceleration to the take-off's
        speed.
        """
        gained = np.array([self.speed_forward, 0.0, self.speed_up]) - self._onset
        speed, way = ramp_integrals(elapsed / self.thrust_time)
        position = start + self._down + self._onset * elapsed + way * self.thrust_time * gained
        return position, self._onset + speed * gained

    def expected_duration(self, ahead: float, time_unit: float) -> float:
        """Seconds until a jump of ``ahead`` body heights is at rest; ``time_unit`` is sqrt(H / g)."""
        landing = USUAL_LANDING + USUAL_LANDING_AHEAD * ahead
        return self.crouch_time + self.thrust_time + self.flight_time + (SETTLE_TIME + landing) * time_unit

    def take_off_time(self, step: float) -> float:
        """Seconds from the crouch until the thrust ends; both take whole steps of ``step`` s."""
        return step * float(sum(np.ceil(seconds / step - 1e-6) for seconds in (self.crouch_time, self.thrust_time)))

    def planned_displacement(self, elapsed: float, gravity: float) -> np.ndarray:
        """(3,) metres from where the centre of mass stood, ``elapsed`` seconds after the crouch began; NaN after
        touch-down."""
        nothing = np.zeros(3)
        if elapsed <= self.crouch_time:
            return self.crouch(nothing, elapsed)[0]
        elapsed -= self.crouch_time
        if elapsed <= self.thrust_time:
            return self.thrust(nothing, elapsed)[0]
        position, _ = self.thrust(nothing, self.thrust_time)
        elapsed -= self.thrust_time
        if elapsed > self.flight_time:
            return np.full(3, np.nan)
        speed = np.array([self.speed_forward, 0.0, self.speed_up])
        return position + elapsed * speed - 0.5 * gravity * elapsed**2 * np.array([0.0, 0.0, 1.0])


def sufficient_speed(rise: float, gravity: float, dt: float) -> float:
    """Speed up, m/s, at the end of a step of ``dt`` s from which free flight rises by ``rise`` metres from where the
    step began."""
    step_gain = gravity * dt  # v dt + (v - g dt/2)^2 / 2g = rise, solved for v
    return float(max(-0.5 * step_gain + np.sqrt(max(2.0 * gravity * rise, 0.0)), 0.0))


def ramp_integrals(share: float) -> tuple[float, float]:
    """Speed and way, of the speed gained and of that speed times the thrust's time, when a ``share`` of that time has
    passed.

    The push grows from ``ONSET`` to its full strength over the first ``RAMP`` of the thrust: muscles cannot be switched
    on at once.
    """
    ramp = min(share, THRUST_RAMP_FRACTION)
    speed = THRUST_START_FRACTION * ramp + (1.0 - THRUST_START_FRACTION) * ramp**2 / (2.0 * THRUST_RAMP_FRACTION)
    way = THRUST_START_FRACTION * ramp**2 / 2.0 + (1.0 - THRUST_START_FRACTION) * ramp**3 / (6.0 * THRUST_RAMP_FRACTION)
    rest = share - ramp
    way += speed * rest + 0.5 * rest**2
    speed += rest
    whole = 1.0 - 0.5 * (1.0 - THRUST_START_FRACTION) * THRUST_RAMP_FRACTION
    return speed / whole, way / whole


def stopping_time(com_height: float, fall_speed: float, gravity: float, landing_time: float = 0.0) -> float:
    """Seconds t such that a body that lands at speed v ahead, with its feet v t ahead of its centre of mass, comes to
    rest over them.

    Landing without spin, the ground's push goes through the centre of mass at ``com_height`` h above feet that are y
    ahead: y'' = W^2 y, with W^2 = (g + w / T) / h for the ``landing_time`` T that the ``fall_speed`` w takes to stop,
    and w^2 = g / h after it, when the capture point is to be at the feet, -y' = w y. At once (T = 0) the push takes w
    y / h off the speed ahead.
    """
    swaying = np.sqrt(gravity / com_height)
    if landing_time <= 0.0:
        return float(1.0 / (swaying + fall_speed / com_height))
    pressed = np.sqrt((gravity + fall_speed / landing_time) / com_height)
    even, odd = np.cosh(pressed * landing_time), np.sinh(pressed * landing_time)
    return float((even + swaying / pressed * odd) / (swaying * even + pressed * odd))


def level_flight(jump_height: float, height: float, gravity: float) -> float:
    """Seconds that a body of ``height`` metres, whose centre of mass rises by ``jump_height`` metres, is off the ground
    when it lands as high as it started."""
    rise = jump_height - min(_EXTENSION * height, _EXTENDED * jump_height)
    return float(np.sqrt(8.0 * rise / gravity))


def height_of_flight(seconds: float, height: float, gravity: float) -> float:
    """Metres: what ``level_flight`` undoes."""
    rise = gravity * seconds**2 / 8.0
    return min(rise + _EXTENSION * height, rise / (1.0 - _EXTENDED))


def plan_jump(
    target: JumpTarget,
    *,
    height: float,
    com_height: float,
    support_ahead: float,
    gravity: float,
    step: float,
    lean: float,
    friction: float = np.inf,
    landing_time: float = 0.0,
    style: Style | None = None,
) -> JumpPlan:
    """Stroke, times and take-off velocity for a jump of ``target`` by a body of ``height`` H
    (docs/concepts/motions.md).

    Its centre of mass is ``com_height`` over the ground and the front of its feet ``support_ahead`` of it, gravity is
    in m/s^2, a solver step takes ``step`` seconds, ``lean`` is that of the plan, ``friction`` the ground's, and the
    fall is stopped within ``landing_time`` seconds; metres.
    """
    style = style or Style()
    time_unit = np.sqrt(height / gravity)
    extension = min(_EXTENSION * height, _EXTENDED * target.height)
    rise = target.height - extension
    speed_up = np.sqrt(2.0 * gravity * rise) + 0.5 * gravity * step
    flight_time = np.sqrt(2.0 * rise / gravity) + np.sqrt(2.0 * max(rise - target.rise, 0.0) / gravity)
    # The front of the footprint helps a body that comes in to stop over its base.
    fall_speed = np.sqrt(2.0 * gravity * max(rise - target.rise, 0.0))
    capture_time = stopping_time(com_height, fall_speed, gravity, landing_time)
    footprint_help = min(0.3 * support_ahead, 0.5 * target.distance * capture_time / flight_time)
    crouch_time = np.ceil(style.anticipation * style.timing * 1.1 * time_unit / step) * step
    acceleration = THRUST_ACCELERATION * gravity / style.timing
    shortest = extension + MIN_CROUCH * height
    stroke = max(speed_up**2 / (2.0 * acceleration), shortest)
    # A low jump far ahead is long on the ground: what friction gives ahead goes with what presses, speed up and weight.
    ahead = (target.distance - lean + footprint_help) / (
        flight_time + capture_time
    ) - EXIT_SPEED_FACTOR * lean / crouch_time
    needed = (ahead / (FRICTION_FRACTION * max(friction, _LEAST_FRICTION)) - speed_up) / gravity
    stroke = max(stroke, min(ramp_integrals(1.0)[1] * speed_up * needed, shortest + MAX_EXTRA_CROUCH * height))
    # Every step goes its whole way at the speed of its end: half a step's way more than the thrust itself.
    stroke += 0.5 * speed_up * step
    crouch_depth = min(style.anticipation * (stroke - extension), MAX_CROUCH * com_height)
    way = crouch_depth + extension - 0.5 * speed_up * step
    thrust_time = max(way / (ramp_integrals(1.0)[1] * speed_up), 2.0 * step)
    speed_forward = (target.distance - lean + footprint_help) / (flight_time + capture_time + 0.5 * thrust_time)
    return JumpPlan(
        crouch_depth=float(crouch_depth),
        extension=float(extension),
        crouch_time=float(crouch_time),
        thrust_time=float(thrust_time),
        flight_time=float(flight_time),
        speed_up=float(speed_up),
        speed_forward=float(speed_forward),
        lean=float(lean),
        landing_lag=float(speed_forward * capture_time - footprint_help),
        landing_rate=float(4.0 / (style.squash * time_unit)),
    )
