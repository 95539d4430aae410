"""Stepper of a world of several bodies on a common ground (docs/concepts/bodies.md).

Bodies that have a common joint or may touch each other in a step form an island. An island of one body without joints
that does not touch itself is stepped by the ``LocomotionStepper`` of this body, any other island by an
``IslandStepper``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from egs_warp.contact.detection import mean_frictions
from egs_warp.contact.pair_contact import PairBody, PairContactDetector
from egs_warp.fem.body import BodyState
from egs_warp.fem.driven_step import Drive, DrivenStep, step_of
from egs_warp.fem.joints import PointJoint
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.island_stepper import IslandStepper
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.meshing.level_set import LevelSet
from egs_warp.short_repr import short_repr

_SLEEP_SPEED = 1e-6
"""Maximum velocity component of the nodes of a prop that falls asleep, in sqrt(g H)."""
_SLEEP_STEPS = 20
"""Number of successive steps below ``_SLEEP_SPEED`` after which a prop falls asleep."""


@dataclass(frozen=True)
class WorldBody:
    """A body of a world. All bodies are in the same frame and on the same ground."""

    __repr__ = short_repr

    stepper: LocomotionStepper
    """Body, muscles and contact with the ground; a prop has no muscles."""
    level_set: LevelSet
    """Level set of the captured shape."""
    rest_positions: np.ndarray
    """(N, 3) m, nodes of the cage at rest in the frame of the level set."""
    drive: Drive | None = None
    """Drive of a body that is fixed or follows a path; None if forces move it."""
    self_contact: bool = False
    """True if parts of the body may touch each other; False if they pass through each other."""

    def step(self, state: BodyState, dt: float) -> StepProblem:
        """Return the step of ``dt`` s from ``state``."""
        return step_of(self.stepper.body, state, dt, self.stepper.settings.drag, self.drive)


class WorldStepper:
    """Stepper of the bodies of one world."""

    def __init__(
        self,
        bodies: Sequence[WorldBody],
        *,
        frictions: np.ndarray | None = None,
        joints: Sequence[PointJoint] = (),
    ) -> None:
        """Make the stepper of k bodies.

        Args:
            bodies: the bodies; the Coulomb coefficient of each with the ground is that of its contact geometry.
            frictions: (k, k) Coulomb coefficients between the bodies, symmetric; None uses the geometric mean of their
                coefficients with the ground.
            joints: joints of the bodies. Bodies with a common joint do not touch each other.
        """
        self.bodies, self.joints = tuple(bodies), tuple(joints)
        with_ground = [body.stepper.geometry.friction for body in bodies]
        self.frictions = mean_frictions(with_ground) if frictions is None else np.asarray(frictions)
        """(k, k) Coulomb coefficients between the bodies."""
        self.pairs = PairContactDetector(
            [
                PairBody(
                    *(body.stepper.geometry, body.stepper.selector, body.level_set, body.rest_positions),
                    is_driven=body.drive is not None,
                    self_contact=body.self_contact,
                )
                for body in bodies
            ],
            connected=[joint.bodies for joint in joints if len(joint.bodies) == 2],
            device="cpu",
        )
        """Detector of the contacts between the bodies."""
        self._has_joint = [any(body in joint.bodies for joint in joints) for body in range(len(bodies))]
        self._islands: dict[tuple[int, ...], IslandStepper] = {}
        self._quiet_steps = np.zeros(len(bodies), int)
        self._last_reports: list[StepReport | None] = [None] * len(bodies)

    @property
    def carried(self) -> set[int]:
        """Indices of the bodies that follow a path, and of those that joints connect to them, directly or through other
        bodies."""
        carried = {index for index, body in enumerate(self.bodies) if body.drive is not None}
        # A chain of joints is at most as long as the list of joints.
        for _ in self.joints:
            carried |= {i for joint in self.joints if carried.intersection(joint.bodies) for i in joint.bodies}
        return carried

    def initial_memories(self) -> list[WarmStart]:
        """Return the warm start of a first step of each body."""
        return [body.stepper.initial_memory() for body in self.bodies]

    def advance(
        self,
        states: Sequence[BodyState],
        memories: Sequence[WarmStart],
        objectives: Sequence[Sequence[AnyObjective]],
        dt: float,
    ) -> list[list[StepReport]]:
        """Make one step of ``dt`` s of all bodies.

        Args:
            states: state of each body at the start.
            memories: warm start of each body from the previous step.
            objectives: objectives of each body on the end of the step; none for a prop.
            dt: step size, s.

        Returns:
            For each body, the report of each step into which its step was divided, in order. The last report contains
            the state at the end and the warm start of the next step (``WarmStart.from_report``). The contacts of a
            report include those with other bodies (``IslandStepper``); their faces are negative.

        Props that have been at rest for some steps sleep until a body that is awake comes close: they do not move, and
        their contact forces do not change.
        """
        done: list[list[StepReport]] = [[] for _ in self.bodies]
        for members in self.islands(states, dt):
            asleep = self._asleep(members, states, memories, dt)
            if asleep is not None:
                for body, report in zip(members, asleep, strict=True):
                    done[body] = [report]
            elif len(members) == 1 and not self._is_coupled(members[0], states, dt):
                body = members[0]
                if self.bodies[body].drive is not None:
                    done[body] = [self._driven(body, states[body], dt)]
                    continue
                memory = _with_ground_only(memories[body], self.pairs.point_counts[body])
                _, _, done[body] = self.bodies[body].stepper.advance(states[body], memory, objectives[body], dt)
            else:
                parts = [states[i] for i in members], [memories[i] for i in members], [objectives[i] for i in members]
                with one_blas_thread():
                    reports = self.island(members).advance(*parts, dt)
                for body, each in zip(members, reports, strict=True):
                    done[body] = each
        self.observe(done)
        return done

    def _asleep(
        self, members: Sequence[int], states: Sequence[BodyState], memories: Sequence[WarmStart], dt: float
    ) -> list[StepReport] | None:
        """Return the reports of an island whose bodies all sleep, with their last contact forces. Return None if a body
        is awake, or if its state is not the one in which it fell asleep."""
        reports = []
        for body in members:
            last, state = self._last_reports[body], states[body]
            if (
                last is None
                or self._quiet_steps[body] < _SLEEP_STEPS
                or last.dt != dt
                or not np.array_equal(last.contacts.points, memories[body].points)
                or not np.array_equal(last.forces, memories[body].forces)
                or not np.array_equal(last.state.positions, state.positions)
                or not np.array_equal(last.state.velocities, state.velocities)
                or self._will_be_driven(body, state, dt)
            ):
                return None
            reports.append(replace(last, state=replace(state, time=state.time + dt), newton_iterations=0))
        return reports

    def _is_coupled(self, body: int, states: Sequence[BodyState], dt: float) -> bool:
        """Return True if a body that no other body is near has a joint, or may touch itself in the step."""
        if not self.bodies[body].self_contact:
            return self._has_joint[body]
        positions = self.bodies[body].step(states[body], dt).ballistic_positions
        return self._has_joint[body] or self.pairs.may_touch_itself(body, positions)

    def _will_be_driven(self, body: int, state: BodyState, dt: float) -> bool:
        """Return True if the path of a body moves it in the step."""
        step = self.bodies[body].step(state, dt)
        return isinstance(step, DrivenStep) and not np.array_equal(step.end, state.positions)

    def _driven(self, body: int, state: BodyState, dt: float) -> StepReport:
        """Return the report of a driven body that touches no other body."""
        step = self.bodies[body].step(state, dt)
        assert isinstance(step, DrivenStep)
        contacts = self.bodies[body].stepper.detector.contact_set(np.zeros(0, int), state.positions)
        none = np.zeros(0)
        return StepReport(
            *(BodyState(step.end, step.rigid_guess, state.time + dt), dt, contacts, np.zeros((0, 3)), none, 0.0, none),
            qp_count=0,
            qp_infeasible=0,
            newton_iterations=0,
            converged=True,
            added_spin=0.0,
            drive=step.drive(np.zeros_like(state.positions)),
        )

    def observe(self, done: Sequence[Sequence[StepReport]]) -> None:
        """Count the steps for which each prop has been at rest, after a step of all bodies. ``done`` are the reports
        that ``advance`` returned for this step, possibly in an earlier process."""
        for body, reports in enumerate(done):
            last, soft_body = reports[-1], self.bodies[body].stepper.body
            is_prop = self.bodies[body].stepper.muscles.segment_count == 0
            speed = np.abs(last.state.velocities).max()
            is_quiet = is_prop and last.converged and len(reports) == 1 and speed < _SLEEP_SPEED * soft_body.speed_unit
            self._quiet_steps[body] = self._quiet_steps[body] + 1 if is_quiet else 0
            self._last_reports[body] = last

    def islands(self, states: Sequence[BodyState], dt: float) -> list[tuple[int, ...]]:
        """Return the islands of a step of ``dt`` s, in the order of their first bodies. An island is a set of bodies
        that joints, or overlaps of their inflated boxes at the end of a ballistic motion, connect."""
        ends = [body.step(state, dt).ballistic_positions for body, state in zip(self.bodies, states, strict=True)]
        joined = [joint.bodies for joint in self.joints if len(joint.bodies) == 2]
        island = list(range(len(self.bodies)))
        for a, b in [*self.pairs.body_pairs(np.concatenate(ends)), *joined]:
            first, second = sorted((island[a], island[b]))
            island = [first if number == second else number for number in island]
        return [tuple(body for body, number in enumerate(island) if number == first) for first in sorted(set(island))]

    def island(self, members: tuple[int, ...]) -> IslandStepper:
        """Return the stepper of the island of the bodies ``members``."""
        if members not in self._islands:
            steppers = [self.bodies[i].stepper for i in members]
            frictions, drives = self.frictions[np.ix_(members, members)], [self.bodies[i].drive for i in members]
            # A joint connects its bodies, so they are in the same island.
            joints = {i: joint.among(members) for i, joint in enumerate(self.joints) if joint.bodies[0] in members}
            self._islands[members] = IslandStepper(
                members, steppers, self.pairs.subset(members), frictions, drives, joints
            )
        return self._islands[members]


def _with_ground_only(memory: WarmStart, point_count: int) -> WarmStart:
    """Return the warm start without contacts with other bodies, for a body with ``point_count`` contact points."""
    on_ground = (memory.points >= 0) & (memory.points < point_count)
    if on_ground.all():
        return memory
    return replace(memory, points=memory.points[on_ground], forces=memory.forces[on_ground])
