"""Plan of a jump, computed from its target and the dimensions of the body (docs/concepts/motions.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from egs_warp.fem.batched import BatchedRecord
from egs_warp.motions.style import Style

EXIT_SPEED_FACTOR = 2.0
"""Forward speed at the end of a crouch, as a multiple of lean / crouch time. A value of 2 corresponds to a constant
acceleration, 0 to a stop."""
LEAN_FRACTION = 0.15
"""Usual forward displacement of the centre of mass before take-off, as a fraction of the jump distance. Without this
displacement, a forward push would rotate the body backward."""
MAX_USUAL_LEAN = 0.35
"""Largest usual lean, as a fraction of the horizontal distance from the centre of mass to the front of the feet."""
CROUCH_TIME = 1.1
"""Usual duration of a crouch in sqrt(H / g)."""
CROUCH_PRESSURE_FRACTION = 0.5
"""Fraction of the distance from the centre of mass back to the edge of the feet by which a crouch may move the centre
of pressure back in order to accelerate the body forward. The rest is for the rotation of the body, which bends."""
MAX_CROUCH = 0.26
"""Maximum depth of a crouch and of a landing, as a fraction of the height of the centre of mass. Deeper ones would
compress elements to a fifth of their size, so higher jumps have a harder thrust and a harder landing instead."""
THRUST_ACCELERATION = 2.8
"""Mean acceleration of a thrust, in g. A harder thrust needs a shallower crouch, which strains a stiff body less."""
FRICTION_FRACTION = 0.9
"""Fraction of the friction impulse of a thrust that the forward speed may use. If friction does not suffice, the thrust
lasts longer, from a crouch that is deeper by at most ``MAX_EXTRA_CROUCH`` body heights."""
_MIN_FRICTION = 1e-6
MIN_CROUCH, MAX_EXTRA_CROUCH = 0.02, 0.02
"""Minimum depth of a crouch, without the displacement of half a time step, and maximum additional depth if friction
limits the forward speed, both in body heights."""
THRUST_START_FRACTION, THRUST_RAMP_FRACTION = 0.3, 0.4
"""Fraction of its full acceleration with which a thrust starts after the crouch, and fraction of its duration after
which the full acceleration is reached."""

_MAX_EXTENSION, _MAX_EXTENSION_FRACTION = 0.04, 0.25
"""Limits of the height of the centre of mass above its standing height at take-off: in body heights, and as a fraction
of the height of the jump."""
SETTLE_TIME = 0.3
"""Time from the start of the motion to the start of the crouch, in sqrt(H / g)."""
MIN_CONTACT_TIME = 0.3
"""Minimum time in sqrt(H / g) from the touch-down of a jump to the start of the jump that follows at once."""
USUAL_LANDING_TIME, USUAL_LANDING_TIME_PER_DISTANCE = 0.7, 1.0
"""Typical time from touch-down to rest in sqrt(H / g), and additional time per body height of jump distance; measured
for the pawn."""
LANDING_TIME = 0.35
"""Time in sqrt(H / g) in which the fall of a body on legs is stopped while it moves forward over its feet (measured for
the robot, whose feet do not move after touch-down)."""

LANDING_RATE = 4.0
"""Natural frequency of the descent on landing, in sqrt(g / H)."""


class JumpPhase(Enum):
    """Phases of a jump, in order."""

    SETTLE = "settle"
    CROUCH = "crouch"
    THRUST = "thrust"
    FLIGHT = "flight"
    LAND = "land"
    REST = "rest"


@dataclass(frozen=True)
class JumpTarget:
    """Target of a jump, in metres."""

    distance: float
    height: float
    rise: float = 0.0
    """Height of the landing place above the start, m."""


@dataclass(frozen=True)
class JumpPlan(BatchedRecord):
    """Planned quantities of a jump, or (c,) arrays for the jumps of c worlds; metres, seconds and m/s."""

    crouch_depth: Any
    extension: Any
    crouch_time: Any
    """Duration of the crouch, s. It is a whole number of time steps, so that the objectives are continuous at the start
    of the thrust."""
    thrust_time: Any
    flight_time: Any
    speed_up: Any
    speed_forward: Any
    lean: Any
    """Forward displacement of the centre of mass during the crouch, m."""
    landing_lag: Any
    """Distance, at touch-down, of the centre of mass behind its standing position over the feet, m."""
    landing_rate: Any
    """1/s, natural frequency of the descent on landing."""
    landing_damping: Any
    """Damping ratio of the descent on landing; below 1, the body rises above its standing height before it settles."""

    @property
    def distance(self) -> Any:
        """(...,) m, planned displacement of the centre of mass along the ground. It is shorter than requested if the
        body could not stop after the requested one."""
        return self.lean + self.speed_forward * (self.flight_time + 0.5 * self.thrust_time) + self.landing_lag

    @property
    def _down(self) -> np.ndarray:
        """(..., 3) m, displacement of the centre of mass during the crouch."""
        return _vector(self.lean, -self.crouch_depth)

    @property
    def _onset(self) -> np.ndarray:
        """(..., 3) m/s, velocity at the end of the crouch: zero upward but already forward, because friction limits the
        forward acceleration during the thrust."""
        return _vector(np.minimum(EXIT_SPEED_FACTOR * self.lean / self.crouch_time, self.speed_forward), 0.0)

    @property
    def _take_off(self) -> np.ndarray:
        """(..., 3) m/s, velocity at take-off."""
        return _vector(self.speed_forward, self.speed_up)

    def crouch(
        self,
        start: np.ndarray,
        elapsed: np.ndarray | float,
        offset: np.ndarray | float = 0.0,
        velocity: np.ndarray | float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity of the centre of mass in the crouch, a cubic curve of time.

        Args:
            start: (..., 3) m, standing position of the centre of mass.
            elapsed: (...,) s, time since the start of the crouch.
            offset: (..., 3) m, position at the start of the crouch relative to ``start``; not zero if the body has just
                landed.
            velocity: (..., 3) m/s, velocity at the start of the crouch.

        Returns:
            Position (..., 3), m, and velocity (..., 3), m/s.
        """
        time = np.asarray(self.crouch_time)[..., None]
        s = np.minimum(np.asarray(elapsed)[..., None] / time, 1.0)
        blend, slope = s * s * (3 - 2 * s), 6 * s * (1 - s) / time
        carried, rate = s * s * (s - 1) * time, s * (3 * s - 2)
        leaving, leaving_rate = s * (1 - s) ** 2 * time, (1 - s) * (1 - 3 * s)
        change = self._down - offset
        return (
            start + offset + blend * change + carried * self._onset + leaving * velocity,
            slope * change + rate * self._onset + leaving_rate * velocity,
        )

    def thrust(self, start: np.ndarray, elapsed: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Return position (..., 3) and velocity (..., 3) of the centre of mass ``elapsed`` (...,) seconds into the
        thrust.

        The acceleration grows to a constant value, and the thrust ends with the take-off velocity. ``start`` (..., 3)
        is the standing position.
        """
        time, elapsed = np.asarray(self.thrust_time)[..., None], np.asarray(elapsed)[..., None]
        gained = self._take_off - self._onset
        speed, displacement = ramp_integrals(elapsed / time)
        position = start + self._down + self._onset * elapsed + displacement * time * gained
        return position, self._onset + speed * gained

    def landing(
        self, height: np.ndarray, speed: np.ndarray, falling: np.ndarray, dt: float, gravity: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return height (...,) in m and upward speed (...,) in m/s after a time step of ``dt`` s of the landing: a free
        fall during ``falling`` (...,) s, at most ``dt``, then a damped oscillation about the height 0; ``height``
        (...,) and ``speed`` (...,) are those at the start."""
        drop = (speed - 0.5 * gravity * falling) * falling
        return damped_motion(
            height + drop, speed - gravity * falling, dt - falling, self.landing_rate, self.landing_damping
        )

    def push_deficit(self, com_height: float, gravity: float) -> float:
        """Return the forward speed of the thrust that would rotate the body backward, m/s, at most 0 if none does.

        The ground force acts at the place of the centre of pressure at rest. It does not rotate a body whose centre of
        mass is in front of this place by the share of its height that the forward impulse has in the upward one, which
        is the sum of the upward momentum and the impulse of the weight.

        Args:
            com_height: standing height of the centre of mass, m.
            gravity: magnitude of gravity, m/s^2.
        """
        onset = float(self._onset[0])
        # The centre of mass is at its mean position after half of the thrust.
        ahead = self.lean + 0.25 * self.thrust_time * (onset + self.speed_forward)
        height = com_height - 0.5 * (self.crouch_depth - self.extension)
        return self.speed_forward - onset - (self.speed_up + gravity * self.thrust_time) * ahead / height

    def expected_duration(self, distance: float, time_unit: float, *, is_followed: bool = False) -> float:
        """Return the expected time in seconds until the body is at rest after a jump over ``distance`` body heights, or
        until the next jump if one follows at once (``is_followed``); ``time_unit`` is sqrt(H / g), s."""
        landing = USUAL_LANDING_TIME + USUAL_LANDING_TIME_PER_DISTANCE * distance
        if is_followed:
            landing = 2.0 * MIN_CONTACT_TIME
        return self.crouch_time + self.thrust_time + self.flight_time + (SETTLE_TIME + landing) * time_unit

    def take_off_time(self, step: float) -> float:
        """Return the time in seconds from the start of the crouch to the end of the thrust; both take whole numbers of
        time steps of ``step`` s."""
        return step * float(sum(np.ceil(seconds / step - 1e-6) for seconds in (self.crouch_time, self.thrust_time)))

    def planned_displacement(
        self, elapsed: float, gravity: float, offset: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return the planned displacement (3,) in metres of the centre of mass ``elapsed`` seconds after the crouch
        began; NaN after touch-down. ``offset`` (3,) and ``velocity`` (3,) are as for ``crouch``."""
        if elapsed <= self.crouch_time:
            return self.crouch(-offset, elapsed, offset, velocity)[0]
        elapsed -= self.crouch_time
        if elapsed <= self.thrust_time:
            return self.thrust(-offset, elapsed)[0]
        position, _ = self.thrust(-offset, self.thrust_time)
        elapsed -= self.thrust_time
        if elapsed > self.flight_time:
            return np.full(3, np.nan)
        return position + elapsed * self._take_off - 0.5 * gravity * elapsed**2 * np.array([0.0, 0.0, 1.0])


def sufficient_speed(rise: np.ndarray | float, gravity: float, dt: float) -> np.ndarray:
    """Return the upward speed (...,) in m/s at the end of a time step of ``dt`` s with which the body, in free flight,
    rises by ``rise`` (...,) metres above its position at the start of the step."""
    step_gain = gravity * dt  # Solve v dt + (v - g dt/2)^2 / 2g = rise for v.
    return np.maximum(-0.5 * step_gain + np.sqrt(np.maximum(2.0 * gravity * rise, 0.0)), 0.0)


def ramp_integrals(share: np.ndarray | float) -> tuple[Any, Any]:
    """Return the dimensionless speed and displacement of a thrust after the fraction ``share`` (...,) of its duration.

    The unit of speed is the total gain of speed in the thrust; the unit of displacement is this gain times the
    duration.

    The acceleration grows from ``THRUST_START_FRACTION`` to its full value over the first ``THRUST_RAMP_FRACTION`` of
    the thrust, because muscles cannot be switched on at once.
    """
    ramp = np.minimum(share, THRUST_RAMP_FRACTION)
    speed = THRUST_START_FRACTION * ramp + (1.0 - THRUST_START_FRACTION) * ramp**2 / (2.0 * THRUST_RAMP_FRACTION)
    displacement = THRUST_START_FRACTION * ramp**2 / 2.0 + (1.0 - THRUST_START_FRACTION) * ramp**3 / (
        6.0 * THRUST_RAMP_FRACTION
    )
    rest = share - ramp
    displacement = displacement + speed * rest + 0.5 * rest**2
    whole = 1.0 - 0.5 * (1.0 - THRUST_START_FRACTION) * THRUST_RAMP_FRACTION
    return (speed + rest) / whole, displacement / whole


def stopping_time(
    com_height: np.ndarray | float,
    fall_speed: np.ndarray | float,
    gravity: float,
    landing_time: np.ndarray | float = 0.0,
) -> Any:
    """Return the time t (...,) in seconds such that a body that lands with forward speed v comes to rest over its feet
    if they are v t ahead of its centre of mass at touch-down.

    Let y be the distance of the feet ahead of the centre of mass, h its height above them (``com_height``), s the
    ``fall_speed`` and T the ``landing_time`` in which the fall is stopped. In a landing without spin, the ground force
    passes through the centre of mass, so y'' = W^2 y, with W^2 = (g + s / T) / h until T has passed, and W^2 = g / h
    afterwards. After T, the capture point must be at the feet: -y' = sqrt(g / h) y. For T = 0, the landing impulse
    reduces the forward speed by s y / h at once.
    """
    swaying = np.sqrt(gravity / com_height)
    is_gradual = np.asarray(landing_time) > 0.0
    duration = np.where(is_gradual, landing_time, 1.0)
    loaded_rate = np.sqrt((gravity + fall_speed / duration) / com_height)
    even, odd = np.cosh(loaded_rate * duration), np.sinh(loaded_rate * duration)
    gradual = (even + swaying / loaded_rate * odd) / (swaying * even + loaded_rate * odd)
    return np.where(is_gradual, gradual, 1.0 / (swaying + fall_speed / com_height))


def damped_motion(
    height: np.ndarray | float,
    speed: np.ndarray | float,
    time: np.ndarray | float,
    rate: np.ndarray | float,
    damping: np.ndarray | float,
) -> tuple[Any, Any]:
    """Return the height (...,) and speed (...,) of a damped oscillator after ``time`` (...,): the exact solution of
    y'' = -rate^2 y - 2 damping rate y' that starts with ``height`` (...,) and ``speed`` (...,)."""
    decay = damping * rate
    # The frequency is imaginary above critical damping, which makes the cosine a hyperbolic one.
    phase = np.sqrt((1.0 - np.square(damping)) * np.square(rate) + 0j) * time
    envelope, even, odd = np.exp(-decay * time), np.real(np.cos(phase)), time * np.real(np.sinc(phase / np.pi))
    return (
        envelope * (height * even + (speed + decay * height) * odd),
        envelope * (speed * even - (decay * speed + np.square(rate) * height) * odd),
    )


def damped_dip(rate: float, damping: float) -> float:
    """Return the largest descent of a damped oscillator (``damped_motion``) that starts at height 0 with downward speed
    1."""
    # The speed is zero when tan(phase) = sqrt(1 - damping^2) / damping.
    root = np.sqrt(1.0 - damping**2 + 0j)
    # The angle of damping + i root; at critical damping the ratio of angle and root is 1.
    angle = np.log(damping + 1j * root) / 1j
    ratio = (angle / root).real if abs(root) > 1e-6 else 1.0
    return float(np.exp(-damping * ratio) / rate)


def _vector(forward: Any, up: Any) -> np.ndarray:
    """Return the vectors (..., 3) with these forward and upward components (...,) and no component to the left."""
    vectors = np.zeros((*np.shape(forward), 3))
    vectors[..., 0], vectors[..., 2] = forward, up
    return vectors


def level_flight(jump_height: float, height: float, gravity: float) -> float:
    """Return the flight time in seconds of a jump that lands at the level of its start; the centre of mass of the body,
    which is ``height`` metres tall, rises by ``jump_height`` metres."""
    rise = jump_height - min(_MAX_EXTENSION * height, _MAX_EXTENSION_FRACTION * jump_height)
    return float(np.sqrt(8.0 * rise / gravity))


def height_of_flight(seconds: float, height: float, gravity: float) -> float:
    """Return the jump height in metres for a flight time; this is the inverse of ``level_flight``."""
    rise = gravity * seconds**2 / 8.0
    return min(rise + _MAX_EXTENSION * height, rise / (1.0 - _MAX_EXTENSION_FRACTION))


def sufficient_lean(
    plan: Callable[[float], JumpPlan], usual: float, support_ahead: float, com_height: float, gravity: float
) -> float:
    """Return the lean in metres, at least ``usual``, with which the thrust does not rotate the body
    (``JumpPlan.push_deficit``), but at most the lean with which the capture point is over the feet as the thrust
    begins. The other arguments are those of ``plan_jump``; ``plan`` returns the plan with a given lean."""
    first = plan(usual)
    # The capture point is lean + onset / rate ahead, and the onset is proportional to the lean.
    largest = support_ahead / (1.0 + EXIT_SPEED_FACTOR / (first.crouch_time * np.sqrt(gravity / com_height)))
    if usual >= largest:
        return usual
    least, most = (each.push_deficit(com_height, gravity) for each in (first, plan(largest)))
    # The deficit is nearly linear in the lean.
    share = np.clip(least / (least - most), 0.0, 1.0) if least > max(most, 0.0) else 0.0
    return float(usual + share * (largest - usual))


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
    support_behind: float = np.inf,
    landing_reach: float = np.inf,
    max_offset: float = np.inf,
    max_lag: float = np.inf,
    style: Style | None = None,
) -> JumpPlan:
    """Plan the stroke, the phase durations and the take-off velocity of a jump (docs/concepts/motions.md).

    If the capture point at touch-down would be more than ``landing_reach`` ahead of the place over the feet where the
    centre of mass comes to rest, the feet land farther in front of the body. If that exceeds ``max_lag``, the plan is
    shorter than the target (``JumpPlan.distance``). If only a stop at that place would exceed it, the body moves faster
    and stops farther ahead over its feet.

    Args:
        target: target of the jump.
        height: body height H, m.
        com_height: standing height of the centre of mass, m.
        support_ahead: distance from the centre of mass to the front of the feet, m.
        gravity: magnitude of gravity, m/s^2.
        step: solver time step, s.
        lean: forward displacement of the centre of mass during the crouch, m.
        friction: Coulomb coefficient of the ground.
        landing_time: time in which the fall is stopped, s.
        support_behind: distance from the centre of mass straight back to the edge of the feet, m.
        landing_reach: largest distance, at touch-down, of the capture point ahead of the standing position of the
            centre of mass over the feet, m.
        max_offset: largest distance of the feet ahead of the place at which a landing impulse stops the body, m.
        max_lag: largest ``JumpPlan.landing_lag``, m.
        style: factors of the jump; None uses the default style.
    """
    style = style or Style()
    time_unit = np.sqrt(height / gravity)
    extension = min(_MAX_EXTENSION * height, _MAX_EXTENSION_FRACTION * target.height)
    rise = target.height - extension
    speed_up = np.sqrt(2.0 * gravity * rise) + 0.5 * gravity * step
    flight_time = np.sqrt(2.0 * rise / gravity) + np.sqrt(2.0 * max(rise - target.rise, 0.0) / gravity)
    # The part of the footprint that is in front of the centre of mass helps a landing body to stop.
    fall_speed = np.sqrt(2.0 * gravity * max(rise - target.rise, 0.0))
    capture_time = stopping_time(com_height, fall_speed, gravity, landing_time)
    footprint_help = min(0.3 * support_ahead, 0.5 * target.distance * capture_time / flight_time)
    # The crouch accelerates the body forward at the constant rate 2 lean / time^2, with the centre of pressure behind
    # the centre of mass.
    pushing_time = np.sqrt(2.0 * max(lean, 0.0) * com_height / (gravity * CROUCH_PRESSURE_FRACTION * support_behind))
    crouch_time = style.anticipation * style.timing * max(CROUCH_TIME * time_unit, pushing_time)
    crouch_time = np.ceil(crouch_time / step) * step
    acceleration = THRUST_ACCELERATION * gravity / style.timing
    min_stroke = extension + MIN_CROUCH * height
    stroke = max(speed_up**2 / (2.0 * acceleration), min_stroke)
    # A low, long jump needs a long thrust: the forward impulse is at most the friction coefficient times the normal
    # impulse, which is the upward momentum plus the impulse of the weight.
    ahead = (target.distance - lean + footprint_help) / (
        flight_time + capture_time
    ) - EXIT_SPEED_FACTOR * lean / crouch_time
    needed = (ahead / (FRICTION_FRACTION * max(friction, _MIN_FRICTION)) - speed_up) / gravity
    stroke = max(stroke, min(ramp_integrals(1.0)[1] * speed_up * needed, min_stroke + MAX_EXTRA_CROUCH * height))
    # In each time step, the body moves with the velocity at the end of the step, which adds half a time step of
    # displacement to the thrust.
    stroke += 0.5 * speed_up * step
    crouch_depth = min(style.anticipation * (stroke - extension), MAX_CROUCH * com_height)
    displacement = crouch_depth + extension - 0.5 * speed_up * step
    thrust_time = max(displacement / (ramp_integrals(1.0)[1] * speed_up), 2.0 * step)
    carried_time = flight_time + 0.5 * thrust_time
    speed_forward = (target.distance - lean + footprint_help) / (carried_time + capture_time)
    landing_lag = speed_forward * capture_time - footprint_help
    if landing_lag > max_lag:
        speed_forward, landing_lag = (target.distance - lean - max_lag) / carried_time, max_lag
    # If the fall stops at once, the muscles cannot brake with its impulse, so the body must be able to stop without it.
    stop_time = capture_time if landing_time > 0.0 else np.sqrt(com_height / gravity)
    if speed_forward * stop_time - landing_lag > landing_reach:
        # The feet land farther ahead, if flight may place them there.
        slower = min(
            (target.distance - lean + landing_reach) / (carried_time + stop_time), (max_lag + landing_reach) / stop_time
        )
        if slower * (stop_time - capture_time) <= landing_reach + max_offset:
            speed_forward, landing_lag = slower, slower * stop_time - landing_reach
        else:
            speed_forward = min(speed_forward, (max_lag + footprint_help) / capture_time)
            landing_lag = speed_forward * capture_time - footprint_help
    landing_damping = style.bounce**-2
    # A landing that would be deeper than the deepest crouch is harder instead.
    landing_rate = max(
        LANDING_RATE / (style.squash * time_unit),
        fall_speed * damped_dip(1.0, landing_damping) / (MAX_CROUCH * com_height),
    )
    return JumpPlan(
        crouch_depth=float(crouch_depth),
        extension=float(extension),
        crouch_time=float(crouch_time),
        thrust_time=float(thrust_time),
        flight_time=float(flight_time),
        speed_up=float(speed_up),
        speed_forward=float(speed_forward),
        lean=float(lean),
        landing_lag=float(landing_lag),
        landing_rate=float(landing_rate),
        landing_damping=float(landing_damping),
    )
