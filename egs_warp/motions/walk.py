"""Walk: groups of feet swing and stand in turn, and the body balances over them as a linear inverted pendulum.

See docs/concepts/motions.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.locomotion.objectives import (
    AngularMomentumObjective,
    AnyObjective,
    BodyPart,
    LoadObjective,
    Objective,
    centre_of_mass_velocity,
    no_slip_contacts,
    node_velocities,
    part_nodes,
)
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.feet import foot_loads, foot_of_contact, foot_of_node, no_slip_feet
from egs_warp.motions.footfalls import Footfalls, footfalls
from egs_warp.motions.footing import FootholdPlanner
from egs_warp.motions.gait import Gait, smooth
from egs_warp.motions.pendulum import PendulumPlan, drift, max_lag
from egs_warp.motions.route import Route, StepLimits
from egs_warp.motions.route_check import check_route
from egs_warp.motions.sequence import Stance
from egs_warp.motions.walk_plan import WalkControl, WalkPhase, WalkPlan
from egs_warp.motions.walk_posture import RockingPosture, rocking_reason, walking_feet

MIN_FOOT_LOAD = 0.01
"""Share of the weight that a foot must carry to be considered landed."""
MAX_LAG = 0.5
"""Mean lag of the feet, in steps, or of the capture point, relative to the largest lag that can be corrected, above
which a step is repeated."""
MIN_REAR_MARGIN, MAX_LEAD = 0.21, 0.04
"""Minimum distance by which the centre of mass of a walking body is in front of the rear edge of the support polygon of
the standing body, relative to the height of the centre of mass; and maximum forward lean for maintaining this distance,
in body heights (measured for the robot)."""
MIN_RESERVE, MIN_STEP_LENGTH = 0.01, 0.002
"""Lag of the capture point that can always be corrected, and minimum step length, in body heights."""
_SHIFT_TIME, _GATHER_TIME, _REST_TIME = 1.5, 3.0, 1.0
"""Durations of the first and the last phase, and of standing afterwards, in sqrt(H / g)."""
_PLAN_STEP, _PLANNED_PHASES = 1.0 / 12.0, 8
"""Time step of a plan in sqrt(H / g), and number of phases that the plan covers."""


class Walk:
    """Walk: shift the weight, swing and stand in turn until the last swing has closed the feet, and return to the
    standing pose."""

    def __init__(
        self,
        stance: Stance,
        route: Route,
        step_length: float,
        *,
        speed: float = 1.0,
        step_fraction: float = 1.0,
        crouch: float = 1.0,
        control: WalkControl | None = None,
        skips_shift: bool = False,
    ) -> None:
        """Plan the walk of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            route: route to follow.
            step_length: step length in metres; it is reduced to the longest step that the body can make.
                With infinity, the body makes its longest steps.
            speed: speed relative to the nominal speed.
            step_fraction: factor on the maximum length and maximum turn of the steps, at most 1.
            crouch: height of the centre of mass between the first and the last phase, relative to its standing height.
            control: weights and gains.
            skips_shift: True starts the first swing at the first time step.

        Raises:
            UserError: for a body without feet or a flat base, for too little friction to turn the base, and for a route
                over a step in the ground.
        """
        body = stance.body
        feet, posture = walking_feet(stance)
        if not feet:
            raise UserError(
                "walk: the body has neither feet nor a flat base with a side that it could lift; jump, hop or twist"
                " instead"
            )
        self.body, self.ground = body, stance.ground
        self.control, self._crouch = control or WalkControl(), crouch
        self._shift_time = 0.0 if skips_shift else _SHIFT_TIME
        normal = stance.ground.axes @ stance.ground.surface_normal
        self._slope = -normal[:2] / normal[2]
        """(2,) slope of the ground: metres of rise per metre forward and to the left."""
        standing = self.ground.local(stance.standing)
        self.feet = feet
        self._posture = posture(stance, feet)
        self._gait_notes = [f"the body waddles: {rocking_reason(stance)}"] if posture is RockingPosture else []
        self._planner = FootholdPlanner(stance, feet)
        self._start_com = body.centre_of_mass(standing)
        self._footprint = self.ground.local(stance.contact_points)[:, :2] - self._start_com[:2]
        """(n, 2) m, contact points of the standing body relative to its centre of mass."""
        self.gravity = float(np.linalg.norm(body.gravity))
        self._time_unit, self._plan_step = body.time_unit, _PLAN_STEP * body.time_unit
        self._requested_length = step_length
        limits = StepLimits(min(step_length, self._posture.step_limits.length), self._posture.step_limits.turn)
        if limits.length < MIN_STEP_LENGTH * body.height:
            raise UserError(
                f"walk: friction {stance.friction:g} cannot turn the body about a side of its base; jump or hop"
            )
        self.planar_poses = route(StepLimits(step_fraction * limits.length, step_fraction * limits.turn))
        """(P+1, 3) planar poses of the body before the first step and after each step; see ``motions.route``."""
        check_route(stance, self.planar_poses)
        step_count, lift, timing = len(self.planar_poses) - 1, self._posture.lift, self._posture.timing
        self.gait = Gait.create(len(feet), step_count, lift, timing, time_unit=self._time_unit / speed)
        self._step_limits = limits
        self._parts = [BodyPart.of(body, f"foot {index}", foot.sole) for index, foot in enumerate(feet)]
        self._near_points = [np.flatnonzero(foot_of_node(feet) == index) for index in range(len(feet))]
        """Indices (k,) of the nodes that belong to each foot."""
        self._rate = float(np.sqrt(self.gravity / self._start_com[2]))
        self.phase = WalkPhase.SHIFT
        self.with_gestures: Callable[[np.ndarray], np.ndarray] | None = None
        """Function that adds gestures to a pose (N, 3), ground coordinates; None leaves it as it is."""
        self.swing = -1
        self._entered: float | None = None
        self._footprints = self._planner.start
        """(F, 4) foothold of each foot; while a foot swings, its previous foothold. See ``motions.walk_posture``."""
        self.swinging: tuple[int, ...] = ()
        """Indices of the feet that are being lifted, moved or set down."""
        self._sidestep = np.zeros(2)
        """(2,) m, offset of the swinging feet from their nominal footholds to catch the body."""
        self._capture_error = np.zeros(2)
        """(2,) m, capture point minus its plan at the last time step."""
        self._target_pressure: np.ndarray | None = None
        """(2,) m, target of the centre of pressure in the last time step."""
        self._late_swings = self._repeated_steps = 0
        self._requested_steps = step_count
        self._arrived_footholds = [0] * len(feet)
        """Index, for each foot, of the step at whose planar pose it has last landed."""

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds if all swings end in time."""
        gait = self.gait
        swings = gait.swings * (gait.swing_time + gait.double_time) - gait.double_time
        return self._duration(WalkPhase.SHIFT) + swings + self._duration(WalkPhase.GATHER)

    @property
    def is_at_rest(self) -> bool:
        """True if the body has returned to its standing pose."""
        return self.phase is WalkPhase.REST

    def plan_record(self) -> WalkPlan:
        """Return the planned quantities of the walk."""
        gait, steps = self.gait, np.diff(self.planar_poses, axis=0)
        length = float(np.linalg.norm(steps[:, :2], axis=1).max())
        return WalkPlan(float(gait.step_count), length, gait.swing_time, gait.double_time, gait.lift, self._stride())

    def _stride(self) -> float:
        """Return the largest distance in metres between two consecutive footprints of one foot, including turns."""
        rounds = len(self.gait.groups)
        prints = np.array(
            [
                [self._planner.nominal_foothold(planar_pose, foot)[:2] for planar_pose in self.planar_poses]
                for foot in range(len(self.feet))
            ]
        )
        apart = prints[:, min(rounds, self.gait.step_count) :] - prints[:, : -min(rounds, self.gait.step_count)]
        return float(np.linalg.norm(apart, axis=2).max())

    def planned_com(self, elapsed: float) -> None:
        """Return None: each step is planned from the measured feet."""

    def notes(self) -> list[str]:
        """Return messages for the user about the gait and about shortened, repeated and late steps."""
        notes = list(self._gait_notes)
        if self._step_limits.length < self._requested_length < np.inf:
            requested, reached = self._requested_length / self.body.height, self._step_limits.length / self.body.height
            notes.append(
                f"steps of {requested:.2f} body heights are too long for the body; "
                f"it can make steps of {reached:.2f} at most"
            )
        if self._repeated_steps:
            notes.append(
                f"the body fell behind: {self._repeated_steps} step{'s' * (self._repeated_steps > 1)} repeated"
            )
        if self._late_swings:
            notes.append(f"{self._late_swings} swings took too long: a foot found no ground")
        return notes

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> Footfalls:
        """Measure the footfalls between two states of a trajectory."""
        return footfalls(trajectory, self.feet, stride=self._stride(), first=first, last=last)

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        body, axes, control = self.body, self.ground.axes, self.control
        local = self.ground.local(state.positions)
        self._advance_phase(local, report, state.time)
        assert self._entered is not None
        elapsed = state.time - self._entered + dt
        com = body.centre_of_mass(local)
        com_velocity = self._com_velocity(local, axes @ body.centre_of_mass(state.velocities), elapsed, dt)
        before, after = self._foot_targets(elapsed - dt), self._foot_targets(elapsed)
        pose = self._posture.pose(com, self._heading(elapsed - dt), before)
        next_pose = self._posture.pose(com + dt * com_velocity, self._heading(elapsed), after)
        if self.with_gestures is not None:
            pose, next_pose = self.with_gestures(pose), self.with_gestures(next_pose)
        spin = (
            control.turn_rate / self._time_unit * self._best_fit_rotation(local, pose)
            + self._best_fit_rotation(pose, next_pose) / dt
        )
        follow = min(control.follow / self._time_unit, 0.7 / dt)
        return [
            centre_of_mass_velocity(body, com_velocity @ axes, control.com),
            AngularMomentumObjective(body.inertia(state.positions) @ (spin @ axes), control.spin),
            node_velocities(body, follow * (next_pose - local) @ axes, control.pose),
            *(self._foot_objective(index, local, before, after, elapsed, dt) for index in self.swinging),
            *(
                self._unload_objectives(index, elapsed)
                for index in self.swinging
                if elapsed < self.gait.transfer_end_time
            ),
            *(self._no_slip_objectives(report, elapsed) if report is not None else []),
        ]

    def _advance_phase(self, local: np.ndarray, report: StepReport | None, time: float) -> None:
        if self._entered is None:
            self._enter(WalkPhase.SHIFT, time, local)
        assert self._entered is not None
        elapsed, gait = time - self._entered + 1e-9, self.gait
        if self.swinging and elapsed >= gait.transfer_end_time:
            loads = foot_loads(self.feet, report, self.body.weight)
            for index in self.swinging:
                if loads[index] > MIN_FOOT_LOAD or (elapsed >= gait.swing_time and self._planner.is_down(index, local)):
                    self._has_landed(index, local)
        if self.phase is WalkPhase.SWING and elapsed >= gait.swing_time:
            if not self.swinging or elapsed >= 2.0 * gait.swing_time:
                self._late_swings += bool(self.swinging)
                for index in self.swinging:
                    self._has_landed(index, local)
                self._enter(self._after_swing(self.swing), time, local)
        elif self.phase in (WalkPhase.SHIFT, WalkPhase.STAND) and elapsed >= self._duration(self.phase):
            self._plan_swing(self.swing + 1, local)
            self.swing += 1
            self.swinging, self._sidestep = gait.swing_feet(self.swing), np.zeros(2)
            self._enter(WalkPhase.SWING, time, local)
        elif self.phase is WalkPhase.GATHER and elapsed >= self._duration(self.phase):
            self._enter(WalkPhase.REST, time, local)

    def _plan_swing(self, swing: int, local: np.ndarray) -> None:
        """Plan ``swing``, which starts with the nodes at ``local`` (N, 3). If the feet or the capture point lag too far
        behind, a step is repeated. A walk under commands (``motions.drive``) extends its route here."""
        if (
            self._repeated_steps < self._requested_steps
            and swing < self.gait.step_count
            and max(self._mean_lag(local), self._capture_lag(swing)) > MAX_LAG
        ):
            self.planar_poses = np.insert(self.planar_poses, swing + 1, self.planar_poses[swing], axis=0)
            self.gait = replace(self.gait, step_count=self.gait.step_count + 1)
            self._repeated_steps += 1

    def _mean_lag(self, local: np.ndarray) -> float:
        """Return the mean lag of the feet behind their nominal footholds, in steps."""
        ahead = self._nominal_footholds([step + 1 for step in self._arrived_footholds]) - self._nominal_footholds(
            self._arrived_footholds
        )
        return float((self._foothold_error(local) * ahead).sum() / max((ahead**2).sum(), 1e-12))

    def _capture_lag(self, swing: int) -> float:
        """Return the lag of the capture point behind its plan in the direction of travel, as a fraction of the largest
        lag that the centre of pressure under the feet that stand during ``swing`` can correct; 0 for a turn."""
        ahead = (self.planar_poses[swing + 1] - self.planar_poses[swing])[:2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-12)
        standing = sorted(set(range(len(self.feet))) - set(self.gait.swing_feet(swing)))
        under, step = self._planner.support(self._footprints, standing, self.control.margin), self._plan_step
        pressure = next(pressure for phase, pressure in self._pressures(step) if phase is WalkPhase.SWING)
        reserve = max_lag(pressure @ ahead + under.extent(-ahead), step, self._rate)
        return float(-self._capture_error @ ahead) / max(reserve, MIN_RESERVE * self.body.height)

    def _foothold_error(self, local: np.ndarray) -> np.ndarray:
        """Return the error (F, 2) in metres, nominal minus measured position, of each foot."""
        return self._nominal_footholds(self._arrived_footholds) - np.array(
            [local[foot.sole, :2].mean(axis=0) for foot in self.feet]
        )

    def _nominal_footholds(self, steps: Sequence[int]) -> np.ndarray:
        """Return the nominal positions (F, 2) of the feet; ``steps`` contains the index of the step of each foot."""
        planar_poses = [self.planar_poses[min(step, self.gait.step_count)] for step in steps]
        return np.array(
            [self._planner.nominal_foothold(planar_pose, foot)[:2] for foot, planar_pose in enumerate(planar_poses)]
        )

    def _enter(self, phase: WalkPhase, time: float, local: np.ndarray) -> None:
        self.phase, self._entered = phase, time
        for foot in set(range(len(self.feet))) - set(self.swinging):
            # The foot may have slid, so its foothold is updated to the current position.
            self._footprints[foot] = self._planner.landed_foothold(foot, local, float(self._footprints[foot, 3]))
        self._plan = self._planned_pendulum()

    def _after_swing(self, swing: int) -> WalkPhase:
        return WalkPhase.GATHER if swing == self.gait.swings - 1 else WalkPhase.STAND

    def _duration(self, phase: WalkPhase) -> float:
        """Return the duration of a phase in seconds."""
        return {
            WalkPhase.SHIFT: self._shift_time * self._time_unit,
            WalkPhase.SWING: self.gait.swing_time,
            WalkPhase.STAND: self.gait.double_time,
            WalkPhase.GATHER: (_GATHER_TIME + _REST_TIME) * self._time_unit,
            WalkPhase.REST: _REST_TIME * self._time_unit,
        }[phase]

    def _has_landed(self, index: int, local: np.ndarray) -> None:
        """Record that foot ``index`` has landed at its current position."""
        self.swinging = tuple(foot for foot in self.swinging if foot != index)
        self._arrived_footholds[index] = self.gait.target_step(self.swing)
        planned = float(self.planar_poses[self._arrived_footholds[index]][2])
        self._footprints[index] = self._planner.landed_foothold(index, local, planned)

    def _progress(self, phase: WalkPhase, swing: int, elapsed: float) -> float:
        """Return the number of steps that the body should have completed ``elapsed`` seconds into a phase."""
        if phase is WalkPhase.SHIFT:
            return 0.0
        if phase in (WalkPhase.GATHER, WalkPhase.REST):
            return float(self.gait.step_count)
        if phase is WalkPhase.STAND:
            elapsed = self.gait.swing_time + min(elapsed, self.gait.double_time)
        return self.gait.progress(swing, elapsed)

    def _place_at(self, progress: float) -> np.ndarray:
        """Return the planar pose (3,) of the body after ``progress`` steps."""
        count = self.gait.step_count
        progress = min(max(progress, 0.0), float(count))
        k = min(int(progress), count - 1)
        return self.planar_poses[k] + (progress - k) * (self.planar_poses[k + 1] - self.planar_poses[k])

    def _heading(self, elapsed: float) -> float:
        return float(self._place_at(self._progress(self.phase, self.swing, elapsed))[2])

    def _planned_pendulum(self) -> PendulumPlan:
        """Plan the pendulum from the start of the current phase. During swings, the centre of pressure is as near to
        the planned centre of mass as the standing feet allow; between swings, it is interpolated."""
        step, phases = self._plan_step, list(self._pressures(self._plan_step))
        pieces = []
        for number, (phase, pressure) in enumerate(phases):
            if phase is not WalkPhase.SWING:
                fractions = (np.arange(len(pressure)) + 0.5) / len(pressure)
                start = phases[number - 1][1][-1] if number else self._target_pressure
                if start is None or phase is WalkPhase.SHIFT:
                    start = pressure[0]
                end = phases[number + 1][1][0] if number + 1 < len(phases) else pressure[-1]
                if phase is WalkPhase.SHIFT:
                    fractions = np.array([smooth(fraction) for fraction in fractions])
                elif phase is WalkPhase.GATHER:
                    fractions = np.array([smooth(fraction * (_GATHER_TIME + _REST_TIME)) for fraction in fractions])
                pressure = start + fractions[:, None] * (end - start)
            pieces.append(pressure)
        return PendulumPlan.from_pressure(np.concatenate(pieces), step, self._rate)

    def _pressures(self, step: float) -> Iterator[tuple[WalkPhase, np.ndarray]]:
        """Yield the current and the future phases, each with its centres of pressure (n, 2), one every ``step``
        seconds. During swings, these are the supported points nearest to the planned centre of mass."""
        footprints, phase, swing = self._footprints.copy(), self.phase, self.swing
        for _ in range(_PLANNED_PHASES):
            count = max(round(self._duration(phase) / step), 1)
            progresses = [self._progress(phase, swing, (k + 0.5) * step) for k in range(count)]
            targets = np.array([self._com_at(progress) for progress in progresses])
            if phase not in (WalkPhase.GATHER, WalkPhase.REST):
                targets += [self._lead_at(progress) for progress in progresses]
            if phase is not WalkPhase.SWING:
                yield phase, targets
                if phase in (WalkPhase.GATHER, WalkPhase.REST):
                    return
                phase, swing = WalkPhase.SWING, swing + 1
                continue
            lifted = self.gait.swing_feet(swing)
            standing = [foot for foot in range(len(self.feet)) if foot not in lifted]
            under = self._planner.support(footprints, standing, self.control.planned_margin)
            yield phase, np.array([under.nearest(target) for target in targets])
            for foot in lifted:
                footprints[foot] = self._planner.nominal_foothold(self.planar_poses[self.gait.target_step(swing)], foot)
            phase = self._after_swing(swing)

    def _com_at(self, progress: float) -> np.ndarray:
        """Return the planned position (2,) of the centre of mass after ``progress`` steps."""
        return self._start_com[:2] + self._place_at(progress)[:2]

    def _lead_at(self, progress: float) -> np.ndarray:
        """Return the distance (2,) in metres by which a body with a narrow support leans in the direction of travel.

        Swinging a leg forward pushes the body back, towards the rear edge of its feet.
        """
        count = self.gait.step_count
        k = min(max(int(progress), 0), count - 1)
        step = (self.planar_poses[k + 1] - self.planar_poses[k])[:2]
        length = float(np.linalg.norm(step))
        if length == 0.0:
            return np.zeros(2)
        cosine, sine = np.cos(self.planar_poses[k][2]), np.sin(self.planar_poses[k][2])
        ahead = step / length
        margin = float((-self._footprint @ np.array([[cosine, sine], [-sine, cosine]]) @ ahead).max())
        lead = np.clip(MIN_REAR_MARGIN * self._start_com[2] - margin, 0.0, MAX_LEAD * self.body.height)
        return max(min(0.5 + progress, 1.0, 0.5 + count - progress), 0.0) * lead * ahead

    def _com_velocity(self, local: np.ndarray, velocity: np.ndarray, elapsed: float, dt: float) -> np.ndarray:
        """Return the target velocity (3,) in m/s of the centre of mass at the end of the time step.

        The centre of pressure under the standing feet steers the divergent component of motion to its plan. The next
        footprints compensate the remaining error.
        """
        com = self.body.centre_of_mass(local)
        pressure, divergent = self._plan.at(elapsed)
        off = self._capture_error = com[:2] + velocity[:2] / self._rate - divergent
        standing = [foot for foot in range(len(self.feet)) if foot not in self.swinging]
        under = self._planner.support(
            self._planner.current_footholds(local, self._footprints), standing, self.control.margin
        )
        pressed = under.nearest(pressure + self.control.balance * off)
        self._target_pressure = pressed
        if self.swinging and elapsed < self.gait.transfer_end_time:
            left = max(self.gait.swing_time - elapsed, 0.0)
            caught = drift(off, pressed - pressure, float(np.exp(self._rate * left)))
            caught *= min(1.0, self._posture.capture_range / max(float(np.linalg.norm(caught)), 1e-12))
            share = 1.0 - float(np.exp(-self.control.sidestep * dt / self._time_unit))
            self._sidestep = self._sidestep + share * (caught - self._sidestep)
        level = velocity[:2] + dt * self._rate**2 * (com[:2] - pressed)
        height = self._height(elapsed) + self._slope @ (com[:2] - self._start_com[:2])
        up = self._slope @ velocity[:2] + 6.0 / self._time_unit * (height - com[2])
        return np.array([*level, up])

    def _height(self, elapsed: float) -> float:
        """Return the target height in metres of the centre of mass on level ground ``elapsed`` seconds into the
        phase."""
        depth = 1.0 - self._crouch
        if self.phase is WalkPhase.SHIFT:
            depth *= smooth(elapsed / self._duration(self.phase))
        elif self.phase is WalkPhase.GATHER:
            depth *= 1.0 - smooth(elapsed / self._duration(self.phase))
        elif self.phase is WalkPhase.REST:
            depth = 0.0
        return float(self._start_com[2]) * (1.0 - depth)

    def _foot_targets(self, elapsed: float) -> np.ndarray:
        """Return the target footholds (F, 4) ``elapsed`` seconds into the phase."""
        targets, gait = self._footprints.copy(), self.gait
        for index in self.swinging:
            progress = elapsed / gait.swing_time
            goal = self._planner.nominal_foothold(self.planar_poses[gait.target_step(self.swing)], index)
            goal[:3] += [*self._sidestep, self._slope @ self._sidestep]
            targets[index] += gait.transfer_progress(progress) * (goal - self._footprints[index])
            # Lower a foot that has no contact with the ground at the end of its swing.
            targets[index, 2] += gait.foot_height(progress) - 0.02 * self.body.height * max(progress - 1.0, 0.0)
        return targets

    def _foot_objective(
        self, index: int, local: np.ndarray, before: np.ndarray, after: np.ndarray, elapsed: float, dt: float
    ) -> Objective:
        sole, part, control = self.feet[index].sole, self._parts[index], self.control
        now, then = (self._planner.sole(index, footholds[index]) for footholds in (before, after))
        # A loaded sole is deformed, and it would drag on the ground if it were straightened in the first time step.
        share = control.foot_share * self.gait.steering_progress(elapsed / self.gait.swing_time)
        velocity = (share * (now - local[sole]) + then - now) / dt
        return part_nodes(self.body, part, velocity @ self.ground.axes, self._posture.swing_weight)

    def _unload_objectives(self, index: int, elapsed: float) -> LoadObjective:
        """Return the objective that unloads a foot gradually before it rises."""
        return LoadObjective(
            self._near_points[index], self.control.unload * self.gait.steering_progress(elapsed / self.gait.swing_time)
        )

    def _no_slip_objectives(self, report: StepReport, elapsed: float) -> list[Objective]:
        """Return the objectives of zero sliding velocity for standing feet, and for lifted feet until they move
        forward: one objective for all contact points, and one for each foot."""
        contacts, control = report.contacts, self.control
        ahead = self.swinging if elapsed > self.gait.transfer_start_time else ()
        stands = ~np.isin(foot_of_contact(self.feet, contacts), ahead)
        loads = np.where(stands, report.forces[:, 0], 0.0) / self.body.weight
        return [
            no_slip_contacts(contacts, loads, self._posture.stance_weight),
            *no_slip_feet(self.body, self.feet, contacts, loads, self.ground.axes[:2], control.slip),
        ]

    def _best_fit_rotation(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the (3,) best-fit rotation (Kabsch) from ``before`` (N, 3) to ``after`` (N, 3) as a rotation
        vector."""
        arms, aims = (x - self.body.centre_of_mass(x) for x in (before, after))
        return Rotation.from_matrix(kabsch_rotation(self.body.node_mass, arms, aims)).as_rotvec()
