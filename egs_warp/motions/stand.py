"""Standing upright over the feet, for a given time or between two motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.capture_step import capture_motion
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPhase
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import REST_SPEED, BalanceController, RestDetector, Weights, sole_shares
from egs_warp.motions.walk import Walk

MAX_CAPTURE_STEPS = 3
"""Maximum number of capture steps of one stand."""
_RATE = 4.0
"""Rate in sqrt(g / H) at which the centre of mass returns over the feet."""


@dataclass(frozen=True)
class PostureTarget:
    """Target posture of a standing body relative to the upright one, ground axes."""

    offset: np.ndarray
    """(3,) m, displacement of the centre of mass."""
    velocity: np.ndarray
    """(3,) m/s, rate of ``offset``."""
    acceleration: np.ndarray
    """(3,) m/s^2, rate of ``velocity``."""
    turn: np.ndarray
    """(3,) rotation vector of the whole body, radians."""


@dataclass(frozen=True)
class StandPlan:
    """Planned quantities of standing."""

    seconds: float


@dataclass(frozen=True)
class StandOutcome:
    """Measured result of standing; body heights."""

    sole_shift: float
    """Largest displacement of the middle of a sole along the ground."""
    lean: float
    """Largest displacement of the centre of mass along the ground."""


class Stand:
    """Balance over the current position of the feet, for example after a jump, for any length of time."""

    def __init__(self, stance: Stance, *, at_rest: bool = True, crouch: float = 1.0) -> None:
        """Create the motion of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            at_rest: True if the previous motion has ended at rest.
            crouch: target height of the centre of mass as a fraction of its standing height.
        """
        self.body = stance.body
        self.controller = BalanceController(
            stance.body, stance.ground, stance.standing, stance.contact_points, stance.friction
        )
        self._gravity = float(np.linalg.norm(stance.body.gravity))
        self._time_unit = float(np.sqrt(stance.body.height / self._gravity))
        self._height = crouch * self.controller.standing_height
        self.posture: PostureTarget | None = None
        """Posture of the next time step; None for the upright posture."""
        self._rest_detector = RestDetector(stance.body)
        self._is_resting = at_rest

    @property
    def is_at_rest(self) -> bool:
        """True if the body is at rest."""
        return self._is_resting

    def notes(self) -> list[str]:
        """Return no messages: standing has no target."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` seconds from ``state``; ``report`` is the report of
        the previous step."""
        measurement = self.controller.measure(state, report)
        slow = bool(np.linalg.norm(measurement.velocity) <= REST_SPEED * np.sqrt(self._gravity * self.body.height))
        self._is_resting = self._rest_detector.update(measurement.velocity, state.time) or (self._is_resting and slow)
        rate = _RATE / self._time_unit
        goal, posture = np.array([*(measurement.foot_centre - self.controller.base_offset), self._height]), self.posture
        if posture is not None:
            goal += posture.offset
        acceleration = rate**2 * (goal - measurement.com) - 2.0 * rate * measurement.velocity
        acceleration[:2] = self.controller.capture_acceleration(measurement, goal[:2])
        if posture is not None:
            # Feed-forward terms: the errors of both control laws are relative to the moving goal.
            rates = np.array([*np.full(2, np.sqrt(self._gravity / self.controller.standing_height)), rate])
            acceleration += posture.acceleration + 2.0 * rates * posture.velocity
        acceleration[2] = max(acceleration[2], -0.8 * self._gravity)
        velocity = measurement.velocity + dt * acceleration
        heading = self.controller.sole_heading(state.positions)
        pose = self.controller.over_base(measurement.com + dt * velocity, measurement.foot_centre, heading)
        if posture is not None:
            axes = self.controller.ground.axes
            pose = axes.T @ Rotation.from_rotvec(posture.turn).as_matrix() @ axes @ pose
        upright = self.controller.turn_towards(measurement, pose) * 4.0 / self._time_unit
        velocity, spin = self.controller.balance_targets(measurement, velocity, upright, dt)
        return self.controller.objectives(
            state,
            measurement,
            com_velocity=velocity,
            pose=pose,
            pose_rate=np.zeros((3, 3)),
            spin=spin,
            follow=6.0 / self._time_unit,
            weights=Weights(),
        )


class StandFor:
    """Stand for ``seconds`` s, and then until the body is at rest. A body that loses its balance takes a capture step
    (``egs_warp.motions.capture_step``)."""

    def __init__(self, stance: Stance, seconds: float) -> None:
        self.seconds, self._stand, self._stance = seconds, Stand(stance), stance
        self._started: float | None = None
        self._is_over = False
        self._step: Walk | Jump | None = None
        self.step_count = 0
        """Number of capture steps so far."""

    @property
    def is_at_rest(self) -> bool:
        """True if the time has passed and the body is at rest."""
        return self._is_over and self._step is None and self._stand.is_at_rest

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds until the body is at rest."""
        return self.seconds

    def plan_record(self) -> StandPlan:
        """Return the planned duration."""
        return StandPlan(self.seconds)

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return zero displacement (3,)."""
        return np.zeros(3)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> StandOutcome:
        """Measure the displacements of the soles and the centre of mass between two states of the trajectory."""
        t, stance = trajectory, self._stance
        states = t.positions[first : last + 1]
        base = np.flatnonzero(sole_shares(stance.body, stance.ground, stance.standing))
        soles = [foot.sole for foot in stance.feet()] or [base]
        points = [states[:, sole].mean(axis=1) for sole in soles]
        points.append(np.einsum("n,fni->fi", t.node_mass, states) / t.node_mass.sum())
        along = stance.ground.axes[:2].T
        *shifts, lean = (float(np.linalg.norm((way - way[0]) @ along, axis=1).max()) / t.height for way in points)
        return StandOutcome(max(shifts), lean)

    def notes(self) -> list[str]:
        """Return a message for the user about capture steps."""
        count = self.step_count
        return [f"took {count} step{'s' * (count > 1)} to keep its balance"] if count else []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` seconds from ``state``; ``report`` is the report of
        the previous step."""
        self._started = state.time if self._started is None else self._started
        self._is_over = state.time - self._started >= self.seconds - 1e-9
        if self._step is not None and self._step.is_at_rest:
            self._stance, self._step = self._stance.moved_to(state.positions), None
            self._stand = Stand(self._stance)
        has_landed = self._step is None or (isinstance(self._step, Jump) and self._step.phase is JumpPhase.LAND)
        if has_landed and report is not None and self.step_count < MAX_CAPTURE_STEPS:
            controller = self._stand.controller
            measurement = controller.measure(state, report)
            step = capture_motion(self._stance, controller, measurement, state.positions, report)
            if step is not None:
                self._step, self.step_count = step, self.step_count + 1
        moving = self._stand if self._step is None else self._step
        return list(moving.objectives(state, report, dt))
