"""Standing upright over the feet, for a given time or between two motions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.reduced_objectives import ReducedObjectives
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.balance import Weights
from egs_warp.motions.capture_step import capture_motion
from egs_warp.motions.free_turn import rotations_of
from egs_warp.motions.joined_motion import JoinedMotion, MotionWorlds
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPhase
from egs_warp.motions.moments import ReducedState
from egs_warp.motions.sequence import BodyMotion, JudgedOutcome, MotionTask, Stance, TargetError
from egs_warp.motions.stance import REST_SPEED, BalanceController, sole_shares, update_rest
from egs_warp.motions.walk import Walk

MAX_CAPTURE_STEPS = 3
"""Maximum number of capture steps of one stand."""
_INSTEAD_TIME = 0.1
"""Duration of a stand in place of another motion, s."""
_RATE = 4.0
"""Rate in sqrt(g / H) at which the centre of mass returns over the feet."""


@dataclass(frozen=True)
class PostureTarget:
    """Target posture of a standing body relative to the upright one, ground axes."""

    offset: np.ndarray
    """(3,) m, displacement of the centre of mass from its upright position."""
    velocity: np.ndarray
    """(3,) m/s, time derivative of ``offset``."""
    acceleration: np.ndarray
    """(3,) m/s^2, time derivative of ``velocity``."""
    turn: np.ndarray
    """(3,) rotation vector of the whole body, radians."""


@dataclass(frozen=True)
class StandPlan:
    """Planned quantities of standing."""

    seconds: float


@dataclass(frozen=True)
class StandOutcome:
    """Measured result of standing, in body heights."""

    sole_shift: float
    """Largest displacement of the middle of a sole along the ground."""
    lean: float
    """Largest displacement of the centre of mass along the ground."""


@dataclass(frozen=True)
class InsteadOutcome(StandOutcome, JudgedOutcome):
    """Measured result of a stand in place of a motion whose target was out of reach."""


@dataclass(frozen=True)
class StandWorlds(MotionWorlds):
    """State of the standing bodies of c worlds."""

    speed_unit: float
    """sqrt(g H), m/s."""
    time_unit: float
    """sqrt(H / g), s."""
    height: np.ndarray
    """(c,) m, target height of the centre of mass."""
    offset: np.ndarray
    """(c, 3) m, ``PostureTarget.offset`` of the next time step; the next three arrays hold its other fields."""
    offset_velocity: np.ndarray
    offset_acceleration: np.ndarray
    turn: np.ndarray
    slow_since: np.ndarray
    """(c,) s, time since which the body has been slow; see ``update_rest``."""
    rests: np.ndarray
    """(c,) bool, True if the body is at rest."""

    @property
    def is_resting(self) -> np.ndarray:
        """(c,) bool, True for bodies at rest."""
        return self.rests

    def step(self, state: ReducedState, dt: float) -> ReducedObjectives:
        """Return the objectives of the time step of ``dt`` s that starts at ``state`` and detect rest."""
        balance, measurement = self.current, self.current.measure(state)
        is_slow = np.linalg.norm(measurement.velocity, axis=1) <= REST_SPEED * self.speed_unit
        operands = self.slow_since, measurement.velocity, state.time, self.speed_unit, self.time_unit
        self.slow_since[:], at_rest = update_rest(*operands)
        self.rests[:] = at_rest | (self.rests & is_slow)
        rate = _RATE / self.time_unit
        feet = measurement.foot_centre
        goal = np.concatenate([feet - balance.base_offset, self.height[:, None]], axis=1) + self.offset
        acceleration = rate**2 * (goal - measurement.com) - 2.0 * rate * measurement.velocity
        acceleration[:, :2] = balance.capture_acceleration(measurement, goal[:, :2])
        # Feed-forward terms, because the errors of both control laws are relative to the moving goal.
        swaying = np.sqrt(balance.gravity / balance.standing_height)
        rates = np.stack([swaying, swaying, np.full_like(swaying, rate)], axis=1)
        acceleration += self.offset_acceleration + 2.0 * rates * self.offset_velocity
        acceleration[:, 2] = np.maximum(acceleration[:, 2], -0.8 * balance.gravity)
        velocity = measurement.velocity + dt * acceleration
        pose = balance.leaning_pose(measurement.com + dt * velocity, feet, measurement.sole_heading)
        if self.turn.any():
            axes = balance.axes
            pose = axes.swapaxes(1, 2) @ rotations_of(self.turn) @ axes @ pose
        upright = balance.turn_towards(measurement, pose) * 4.0 / self.time_unit
        velocity, spin = balance.balance_targets(measurement, velocity, upright, dt)
        return balance.objectives(
            state.moments,
            measurement,
            com_velocity=velocity,
            pose=pose,
            pose_rate=np.zeros_like(pose),
            spin=spin,
            follow=6.0 / self.time_unit,
            weights=Weights(),
        )


class Stand(JoinedMotion[StandWorlds]):
    """Balance over the current position of the feet, for example after a jump, for any length of time."""

    def __init__(self, stance: Stance, *, at_rest: bool = True, crouch: float = 1.0) -> None:
        """Create the motion of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            at_rest: True if the previous motion has ended at rest.
            crouch: target height of the centre of mass as a fraction of its standing height.
        """
        body = self.body = stance.body
        controller = BalanceController(
            stance.body, stance.ground, stance.standing, stance.contact_points, stance.friction
        )
        super().__init__(
            controller,
            StandWorlds(
                current=controller.balance.with_world_axis(),
                speed_unit=body.speed_unit,
                time_unit=body.time_unit,
                height=np.array([crouch * controller.standing_height]),
                offset=np.zeros((1, 3)),
                offset_velocity=np.zeros((1, 3)),
                offset_acceleration=np.zeros((1, 3)),
                turn=np.zeros((1, 3)),
                slow_since=np.array([np.nan]),
                rests=np.array([at_rest]),
            ),
        )

    @property
    def controller(self) -> BalanceController:
        """Balance controller of the body."""
        return self.reference

    def set_posture(self, posture: PostureTarget | None) -> None:
        """Set the posture for the following time steps; None sets the upright posture."""
        worlds, row = self._worlds, self._row
        posture = posture or PostureTarget(*np.zeros((4, 3)))
        worlds.offset[row], worlds.offset_velocity[row] = posture.offset, posture.velocity
        worlds.offset_acceleration[row], worlds.turn[row] = posture.acceleration, posture.turn

    @property
    def is_at_rest(self) -> bool:
        """True if the body is at rest."""
        return bool(self._worlds.rests[self._row])

    def notes(self) -> list[str]:
        """Return no messages: standing has no target."""
        return []


class StandFor:
    """Stand for ``seconds`` s, and then until the body is at rest. A body that loses its balance takes up to
    ``MAX_CAPTURE_STEPS`` capture steps (``egs_warp.motions.capture_step``)."""

    def __init__(self, stance: Stance, seconds: float) -> None:
        self.seconds, self._stand, self._stance = seconds, Stand(stance), stance
        self._started: float | None = None
        self._is_over = False
        self._step: Walk | Jump | None = None
        self.step_count = 0
        """Number of capture steps so far. Each is a walk, which may have several steps, or a hop."""

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
        """Return a planned displacement of zero (3,)."""
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
        return [f"stepped or hopped {'once' if count == 1 else f'{count} times'} to keep its balance"] if count else []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
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


class StandInstead(StandFor):
    """Short stand in place of a motion whose target is out of reach when the motion starts."""

    def __init__(self, stance: Stance, reason: str) -> None:
        """Create the stand; ``reason`` states in the report why the target is out of reach."""
        super().__init__(stance, _INSTEAD_TIME)
        self._reason = reason

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> InsteadOutcome:
        """Return the missed target, and the displacements measured as for ``StandFor``."""
        stood = super().outcome_record(trajectory, first, last)
        return InsteadOutcome((self._reason,), stood.sole_shift, stood.lean)


def or_stand(task: MotionTask) -> MotionTask:
    """Return ``task`` with a fallback: if the target of its motion is out of reach when the motion starts, the body
    stands for a moment instead, and the result of this stand reports the missed target."""

    def begin(stance: Stance) -> BodyMotion:
        try:
            return task.begin(stance)
        except TargetError as error:
            return StandInstead(stance, str(error))

    return replace(task, begin=begin)
