"""Walk: diagonal pairs of feet swing and stand in turn, and the body moves on evenly over them.

See docs/concepts/motions.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState
from egs_warp.geometry.frames import best_turn
from egs_warp.locomotion.objectives import (
    AnyObjective,
    BodyPart,
    LoadObjective,
    Objective,
    SpinObjective,
    centre_of_mass_velocity,
    held_contacts,
    node_velocities,
    part_nodes,
)
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.feet import feet_around, foot_loads, foot_of_contact, foot_of_node
from egs_warp.motions.footfalls import Footfalls, footfalls
from egs_warp.motions.gait import Gait, Passage, nearest_in_hull
from egs_warp.motions.sequence import Place

FORWARD = np.array([1.0, 0.0])
REACH = 0.5
"""Longest step over the shortest leg's length."""
LOADED = 0.01
"""Share of the weight that a foot must carry to count as landed."""


class WalkPhase(Enum):
    """Phases of a walk; swing and stand alternate."""

    SHIFT = "shift"
    """The body rises and leans until its centre of mass comes over the crossing of the diagonals at walking speed."""
    SWING = "swing"
    STAND = "stand"
    GATHER = "gather"
    """Back to the pose it stood in."""
    REST = "rest"


@dataclass(frozen=True)
class WalkPlan:
    """Numbers of a walk; metres, seconds."""

    steps: float
    step_length: float
    swing_time: float
    double_time: float
    lift: float
    stride: float


@dataclass(frozen=True)
class WalkControl:
    """Weights of the objectives (speeds are compared in sqrt(g H)) and gains of the feedback."""

    com: float = 600.0
    spin: float = 600.0
    pose: float = 1.0
    swing: float = 40.0
    support: float = 1000.0
    """Of contact points that stand and would slide, each by its share of the weight."""
    unload: float = 100.0
    """Of what contact points of a foot carry that is lifted."""
    balance: float = 3.0
    """How far the centre of pressure goes for each metre that the divergent part of the motion is off."""
    turn_rate: float = 4.0
    """Of the body's tilt, in sqrt(g / H)."""
    follow: float = 12.0
    """Of the pose, in sqrt(g / H)."""
    foot_share: float = 0.3
    """Of a swinging foot's error that is removed in one step."""
    margin: float = 0.8
    """Part of each sole over which the centre of pressure may move."""


class Walk:
    """Shifts its weight, swings and stands until the last swing has closed the feet, and gathers itself."""

    def __init__(self, place: Place, steps: int, step_length: float, *, control: WalkControl | None = None) -> None:
        """``step_length`` in metres, shortened to what the legs reach. Raises ``UserError`` unless the body has four
        separate feet.

        It walks along the side of its feet that is nearest to the forward of ``place``.
        """
        body = place.body
        feet = place.feet()
        order = feet_around(feet, place.standing, place.ground.axes[2])
        corners = np.array([place.standing[feet[index].sole].mean(axis=0) for index in order])
        sides = [corners[0] + corners[1] - corners[2] - corners[3], corners[1] + corners[2] - corners[3] - corners[0]]
        ways = [sign * side / np.linalg.norm(side) for side in sides for sign in (1.0, -1.0)]
        place = place.facing(max(ways, key=lambda way: float(way @ place.ground.axes[0])))
        self.body, self.ground, self.feet = body, place.ground, feet
        self.control = control or WalkControl()
        normal = place.ground.axes @ place.ground.surface_normal
        self._slope = -normal[:2] / normal[2]
        """Metres that the ground rises for each metre forward and to the left."""
        self.pairs = (order[0], order[2]), (order[1], order[3])
        self.gravity = float(np.linalg.norm(body.gravity))
        self._asked_length = step_length
        reachable = min(step_length, REACH * min(foot.length for foot in feet))
        self.gait = Gait.of(steps, reachable, height=body.height, gravity=self.gravity)
        self._time_unit = float(np.sqrt(body.height / self.gravity))
        self._standing = self.ground.local(place.standing)
        self._soles = np.array([self._standing[foot.sole].mean(axis=0) for foot in feet])
        self._legs = np.array([foot.leg for foot in feet])
        self._leg_mass = self._legs @ body.node_mass / body.mass
        self._parts = [BodyPart.of(body, f"foot {index}", foot.sole) for index, foot in enumerate(feet)]
        self._near = [np.flatnonzero(foot_of_node(feet) == index) for index in range(len(feet))]
        """Nodes that go with each foot."""
        self._start_com = body.centre_of_mass(self._standing)
        self._passages = self._plan_passages()
        self.phase = WalkPhase.SHIFT
        self.swing = -1
        self._entered: float | None = None
        self._places = self._soles.copy()
        """(4, 3) where each foot stands, or was lifted from."""
        self.swinging: tuple[int, ...] = ()
        """The feet that are lifted, carried and set down."""
        self._late = 0

    def _plan_passages(self) -> dict[WalkPhase, Passage]:
        gait, still = self.gait, np.zeros(2)
        centre, velocity = self._soles[:, :2].mean(axis=0), self.gait.speed * FORWARD
        first = centre + gait.place(0, 0.0) * FORWARD
        last = centre + gait.place(gait.swings - 1, gait.swing_time) * FORWARD
        start, end = self._start_com[:2], self._start_com[:2] + gait.distance * FORWARD
        return {
            WalkPhase.SHIFT: Passage(start, still, first, velocity, 1.5 * self._time_unit),
            WalkPhase.GATHER: Passage(last, velocity, end, still, 3.0 * self._time_unit),
        }

    @property
    def resting(self) -> bool:
        """Whether the body has gathered itself."""
        return self.phase is WalkPhase.REST

    def planned(self) -> WalkPlan:
        """What the walk aims at."""
        gait = self.gait
        return WalkPlan(
            float(gait.steps), gait.step_length, gait.swing_time, gait.double_time, gait.lift, stride=gait.stride
        )

    def planned_com(self, elapsed: float) -> None:
        """Nothing: it goes on from the measured feet."""

    def notes(self) -> list[str]:
        """What kept the walk from its target, for the user."""
        found = []
        if self.gait.step_length < self._asked_length:
            asked, reached = self._asked_length / self.body.height, self.gait.step_length / self.body.height
            found.append(f"steps of {asked:.2f} body heights were asked; the legs are long enough for {reached:.2f}")
        if self._late:
            found.append(f"{self._late} swings took too long: a foot found no ground")
        return found

    def reached(self, trajectory: Trajectory, first: int, last: int) -> Footfalls:
        """What the feet did between two states of a trajectory."""
        return footfalls(trajectory, self.feet, stride=self.gait.stride, first=first, last=last)

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        body, axes, control = self.body, self.ground.axes, self.control
        local = self.ground.local(state.positions)
        self._advance_phase(local, report, state.time)
        assert self._entered is not None
        elapsed = state.time - self._entered + dt
        com = body.centre_of_mass(local)
        com_velocity = self._com_velocity(local, axes @ body.centre_of_mass(state.velocities), elapsed, dt)
        before, after = self._foot_targets(elapsed - dt), self._foot_targets(elapsed)
        pose, next_pose = self._pose(com, before), self._pose(com + dt * com_velocity, after)
        spin = control.turn_rate / self._time_unit * self._turn(local, pose) + self._turn(pose, next_pose) / dt
        follow = min(control.follow / self._time_unit, 0.7 / dt)
        return [
            centre_of_mass_velocity(body, com_velocity @ axes, control.com),
            SpinObjective(body.inertia(state.positions) @ (spin @ axes), control.spin),
            node_velocities(body, follow * (next_pose - local) @ axes, control.pose),
            *(self._foot_objective(index, local, before, after, elapsed, dt) for index in self.swinging),
            *(self._let_go(index, elapsed) for index in self.swinging if elapsed < self.gait.carried_until),
            *([self._hold(report, elapsed)] if report is not None else []),
        ]

    def _advance_phase(self, local: np.ndarray, report: StepReport | None, time: float) -> None:
        if self._entered is None:
            self._entered = time
        elapsed, gait = time - self._entered + 1e-9, self.gait
        if self.swinging and elapsed >= gait.carried_until:
            loads = foot_loads(self.feet, report, self.body.weight)
            for index in self.swinging:
                if loads[index] > LOADED:
                    self._stands(index, local)
        if self.phase is WalkPhase.SWING and elapsed >= gait.swing_time:
            if not self.swinging or elapsed >= 2.0 * gait.swing_time:
                self._late += bool(self.swinging)
                for index in self.swinging:
                    self._stands(index, local)
                last = self.swing == gait.swings - 1
                self.phase, self._entered = WalkPhase.GATHER if last else WalkPhase.STAND, time
        elif (self.phase is WalkPhase.STAND and elapsed >= gait.double_time) or (
            self.phase is WalkPhase.SHIFT and elapsed >= self._passages[self.phase].duration
        ):
            self.phase, self._entered = WalkPhase.SWING, time
            self.swing += 1
            self.swinging = self.pairs[self.swing % 2]
        elif self.phase is WalkPhase.GATHER and elapsed >= self._passages[self.phase].duration + self._time_unit:
            self.phase = WalkPhase.REST

    def _stands(self, index: int, local: np.ndarray) -> None:
        """Foot ``index`` has landed where it is."""
        self.swinging = tuple(foot for foot in self.swinging if foot != index)
        self._places[index] = self._on_ground(index, local[self.feet[index].sole, :2].mean(axis=0))

    def _com_reference(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Place and velocity (2,) of the centre of mass ``elapsed`` seconds into the phase."""
        if self.phase is WalkPhase.REST:
            return self._passages[WalkPhase.GATHER].at(np.inf)
        if self.phase in self._passages:
            return self._passages[self.phase].at(elapsed)
        gait = self.gait
        if self.phase is WalkPhase.STAND:
            elapsed = gait.swing_time + min(elapsed, gait.double_time)
        place = self._soles[:, :2].mean(axis=0) + gait.place(self.swing, elapsed) * FORWARD
        return place, gait.speed * FORWARD

    def _rise(self, elapsed: float) -> float:
        """Metres by which the body stands taller than at rest.

        Legs that push are stretched, and swing at their length at rest; legs drawn in by their muscles would buckle.
        """
        if self.phase is WalkPhase.REST:
            return 0.0
        s = min(elapsed / self._passages[self.phase].duration, 1.0) if self.phase in self._passages else 1.0
        s = 1.0 - s if self.phase is WalkPhase.GATHER else s
        return self.gait.lift * s * s * (3.0 - 2.0 * s)

    def _com_velocity(self, local: np.ndarray, velocity: np.ndarray, elapsed: float, dt: float) -> np.ndarray:
        """(3,) m/s at the end of the step; steered by a centre of pressure under the standing feet, so that the
        divergent part of the motion (com + v sqrt(h/g), linear inverted pendulum) follows the reference."""
        com = self.body.centre_of_mass(local)
        place, speed = self._com_reference(elapsed)
        rate = np.sqrt(self.gravity / self._start_com[2])
        off = com[:2] + velocity[:2] / rate - (place + speed / rate)
        pressure = nearest_in_hull(self._support(local), place + self.control.balance * off)
        level = velocity[:2] + dt * rate**2 * (com[:2] - pressure)
        height = self._start_com[2] + self._rise(elapsed) + self._slope @ (com[:2] - self._start_com[:2])
        up = self._slope @ velocity[:2] + 6.0 / self._time_unit * (height - com[2])
        return np.array([*level, up])

    def _support(self, local: np.ndarray) -> np.ndarray:
        """(k, 2) the soles of the standing feet, each drawn in towards its middle."""
        soles = [local[foot.sole, :2] for index, foot in enumerate(self.feet) if index not in self.swinging]
        return np.concatenate([s.mean(axis=0) + self.control.margin * (s - s.mean(axis=0)) for s in soles])

    def _on_ground(self, index: int, place: np.ndarray) -> np.ndarray:
        """(3,) where foot ``index`` stands at ``place`` (2,)."""
        start = self._soles[index]
        return np.array([*place, start[2] + self._slope @ (place - start[:2])])

    def _foot_targets(self, elapsed: float) -> np.ndarray:
        """(4, 3) where the feet should be ``elapsed`` seconds into the phase."""
        targets, gait = self._places.copy(), self.gait
        for index in self.swinging:
            progress = elapsed / gait.swing_time
            goal = self._on_ground(index, self._soles[index, :2] + gait.landing(self.swing) * FORWARD)
            targets[index] += gait.carried(progress) * (goal - self._places[index])
            # One that has found no ground in time reaches down for it.
            targets[index, 2] += gait.lifted(progress) - 0.02 * self.body.height * max(progress - 1.0, 0.0)
        return targets

    def _foot_objective(
        self, index: int, local: np.ndarray, before: np.ndarray, after: np.ndarray, elapsed: float, dt: float
    ) -> Objective:
        sole, part, control = self.feet[index].sole, self._parts[index], self.control
        error = before[index] - self._soles[index] + self._standing[sole] - local[sole]
        # The sole that stood is not the flat one that swings: torn straight in the first step, it would drag.
        share = control.foot_share * self.gait.eased(elapsed / self.gait.swing_time)
        velocity = (share * error + after[index] - before[index]) / dt
        return part_nodes(self.body, part, velocity @ self.ground.axes, control.swing)

    def _let_go(self, index: int, elapsed: float) -> LoadObjective:
        """A foot is unloaded bit by bit before it rises."""
        return LoadObjective(self._near[index], self.control.unload * self.gait.eased(elapsed / self.gait.swing_time))

    def _hold(self, report: StepReport, elapsed: float) -> Objective:
        """What stands does not slide, nor does what is lifted before it goes ahead."""
        contacts = report.contacts
        ahead = self.swinging if elapsed > self.gait.carried_from else ()
        stands = ~np.isin(foot_of_contact(self.feet, contacts), ahead)
        return held_contacts(
            contacts, np.where(stands, report.forces[:, 0], 0.0) / self.body.weight, self.control.support
        )

    def _pose(self, com: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """(N, 3) the standing shape with its feet at ``targets`` (4, 3) and its centre of mass at ``com`` (3,)."""
        moved = targets - self._soles
        body = (com - self._start_com - self._leg_mass @ moved) / (1.0 - self._leg_mass.sum())
        return self._standing + body + self._legs.T @ (moved - body)

    def _turn(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """(3,) rotation vector that best carries ``before`` (N, 3) to ``after`` (N, 3)."""
        arms, aims = (x - self.body.centre_of_mass(x) for x in (before, after))
        return Rotation.from_matrix(best_turn(self.body.node_mass, arms, aims)).as_rotvec()
