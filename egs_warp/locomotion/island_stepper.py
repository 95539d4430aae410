"""Step of an island, that is, of bodies that may touch each other: planned one by one and solved together.

The QP of each creature is over its activations; the forces of the contacts that it touches follow from them
(``contact_modes``). The other contacts keep their predicted modes (``other_contacts``), so the other bodies yield to
the creature. Plans are made in the order of the bodies (Gauss-Seidel): the plan of a creature uses the new activations
of the creatures before it, and the previous activations of those after it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.coupled_step import CoupledResult
from egs_warp.contact.island_contacts import IslandContacts, IslandSolver
from egs_warp.contact.newton import ContactLinearization, ContactLinearizer
from egs_warp.contact.pair_contact import PairContactDetector
from egs_warp.fem.body import BodyState
from egs_warp.fem.driven_step import Drive, DrivenStep, step_of
from egs_warp.fem.island_problem import IslandProblem
from egs_warp.fem.joints import JointForces, JointRows, PointJoint
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.locomotion.linear_step import PredictedStep, SolveInputs
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.planner import Plan, StageClock, StepPlanner
from egs_warp.locomotion.prediction import predict_end
from egs_warp.locomotion.step_cost import objectives_value
from egs_warp.locomotion.stepper import (
    MAX_HALVINGS,
    REPLAN_FACTOR,
    REPLAN_MARGIN,
    LocomotionStepper,
    StepReport,
    WarmStart,
    rank_half_steps,
)
from egs_warp.muscles.tension import MuscleEnergy

MAX_PAIR_DEPTH = 0.01
"""Depth of a body in another one or in the ground, divided by the height of the shortest body of the island, that is
tolerated at the end of a step. A step that ends deeper than this and deeper than it began is repeated as half steps.
The contact planes are those at the start of the step, which is inaccurate where a body moves far over an edge."""

States: TypeAlias = Sequence[BodyState]
Memories: TypeAlias = Sequence[WarmStart]
Objectives: TypeAlias = Sequence[Sequence[AnyObjective]]


class IslandStepper:
    """Stepper of the bodies of an island."""

    def __init__(
        self,
        members: Sequence[int],
        steppers: Sequence[LocomotionStepper],
        pairs: PairContactDetector,
        frictions: np.ndarray,
        drives: Sequence[Drive | None],
        joints: Mapping[int, PointJoint] | None = None,
    ) -> None:
        """Make the stepper of some bodies of a world.

        Args:
            members: indices of the bodies in the world, ascending.
            steppers: stepper of each of the k bodies.
            pairs: detector of the contacts between them.
            frictions: (k, k) Coulomb coefficients between them.
            drives: drive of each body that is fixed or follows a path, None for others.
            joints: joints of the bodies, whose bodies are indices in ``members``, by their indices in the world.
        """
        self.members, self.steppers, self.drives = tuple(members), tuple(steppers), tuple(drives)
        with_ground = np.array([[stepper.geometry.friction] for stepper in steppers])
        detectors = tuple(stepper.detector for stepper in steppers)
        driven = frozenset(body for body, drive in enumerate(drives) if drive is not None)
        self.contacts = IslandContacts(detectors, pairs, driven, np.hstack([frictions, with_ground]))
        self.solver = IslandSolver(
            steppers[0].detector,
            steppers[0].selector,
            push_out_cap=min(stepper.solver.push_out_cap for stepper in steppers),
            penetration_tolerance=min(stepper.solver.penetration_tolerance for stepper in steppers),
            contacts=self.contacts,
        )
        self._linearizer = ContactLinearizer()
        self._joint_numbers = np.array([*joints] if joints else [], int)
        self._joint_rows = JointRows.of([*joints.values()], pairs.node_starts) if joints else None

    @cached_property
    def _planners(self) -> tuple[StepPlanner, ...]:
        """Planner of each body, with the Coulomb coefficient of the island."""
        return tuple(replace(stepper.planner, friction=self.contacts.friction) for stepper in self.steppers)

    @cached_property
    def _factors(self) -> tuple[LinearSolver, ...]:
        return tuple(stepper.factors for stepper in self.steppers)

    def advance(self, states: States, memories: Memories, objectives: Objectives, dt: float) -> list[list[StepReport]]:
        """Make one step of ``dt`` s. If it does not converge, or if bodies penetrate too far, repeat it as half steps;
        see ``WorldStepper.advance`` and ``LocomotionStepper.advance``."""
        reports = self._step(states, memories, objectives, None, dt)
        if reports[0].converged:
            if not self._is_too_deep(reports, states):
                return [[report] for report in reports]
            return self._half_steps(states, memories, [r.activations for r in reports], dt, MAX_HALVINGS)
        candidates = [
            self._half_steps(states, memories, activations, dt, MAX_HALVINGS)
            for activations in ([r.activations for r in reports], [memory.activations for memory in memories])
        ]
        bodies = [stepper.body for stepper in self.steppers]
        return min(candidates, key=lambda done: rank_half_steps(bodies, states, done, objectives))

    def _half_steps(
        self, states: States, memories: Memories, activations: Sequence[np.ndarray], dt: float, max_halvings: int
    ) -> list[list[StepReport]]:
        """Make two steps of ``dt`` / 2 s with given activations. A step that does not converge, or in which bodies
        penetrate too far, is halved again, up to ``max_halvings`` - 1 times."""
        done: list[list[StepReport]] = [[] for _ in self.steppers]
        for _ in range(2):
            ends = self._step(states, memories, [()] * len(states), activations, 0.5 * dt)
            reports = [[end] for end in ends]
            if max_halvings > 1 and (not ends[0].converged or self._is_too_deep(ends, states)):
                reports = self._half_steps(states, memories, activations, 0.5 * dt, max_halvings - 1)
            for before, after in zip(done, reports, strict=True):
                before += after
            states = [each[-1].state for each in done]
            memories = [WarmStart.from_report(each[-1]) for each in done]
        return done

    def _is_too_deep(self, ends: Sequence[StepReport], states: States) -> bool:
        """Return True if a step from ``states`` has moved a body too deep into another one, the ground or itself."""
        height = min(stepper.body.height for stepper in self.steppers)
        after = np.concatenate([report.state.positions for report in ends])
        end = np.minimum([report.min_gap for report in ends], self.contacts.min_self_gaps(after))
        limit = -MAX_PAIR_DEPTH * height
        if end.min() >= limit:
            return False
        before = np.concatenate([state.positions for state in states])
        start = np.minimum(self.contacts.min_gaps(before), self.contacts.min_self_gaps(before))
        return bool(((end < limit) & (end < start)).any())

    def _step(
        self,
        states: States,
        memories: Memories,
        objectives: Objectives,
        activations: Sequence[np.ndarray] | None,
        dt: float,
    ) -> list[StepReport]:
        """Make one step of ``dt`` s with given ``activations``, or with planned ones if they are None. Return the
        report of each body."""
        clock = StageClock()
        start = self._start(states, *self._previous_contacts(memories), dt)
        problem = start.problem
        clock.lap("detect")
        current = [memory.activations for memory in memories] if activations is None else list(activations)
        response, velocities, forces = predict_end(self._linearizer, self._factors, start, self._tensions(current))
        clock.lap("predict")
        plans = [Plan(each, velocities, forces) for each in current]
        if activations is not None:
            result = self._solve(response, plans)
            clock.lap("solve")
            return self._reports(problem, plans, result, clock)
        predicted = PredictedStep(response, start.normal_bias, np.zeros(0), velocities, forces)
        plans = self._plan(predicted, plans, memories, objectives, clock)
        expected = self._values(problem, response.contacts, plans[0], objectives)
        result = self._solve(response, plans)
        clock.lap("solve")
        if result.converged:
            plans, result = self._replan(problem, plans, expected, result, memories, objectives, clock)
        return self._reports(problem, plans, result, clock)

    def passive_step(self, states: States, previous: np.ndarray, forces: np.ndarray, dt: float) -> CoupledResult:
        """Solve a step of ``dt`` s without muscles; see ``LocomotionStepper.passive_step``.

        Args:
            states: state of each body at the start.
            previous: (m,) indices of the contacts of the previous step (``PairContactDetector``).
            forces: (m, 3) N, their forces.
            dt: step size, s.
        """
        start = self._start(states, previous, forces, dt)
        guess = start.problem.rigid_guess
        response = self._linearizer(start.problem.tangent(self._factors, guess, None), start.contacts)
        result = self.solver.solve(response, None, velocities=guess, forces=start.forces)
        lengths = self.contacts.tangent_lengths(self.contacts.pairs.keys(result.contacts.points))
        return replace(result, forces=result.forces * lengths)

    def _start(self, states: States, previous: np.ndarray, forces: np.ndarray, dt: float) -> SolveInputs:
        """Detect the contacts of a step, and collect the inputs of the step; arguments as for ``passive_step``."""
        problem = IslandProblem(
            tuple(
                step_of(stepper.body, state, dt, stepper.settings.drag, drive)
                for stepper, state, drive in zip(self.steppers, states, self.drives, strict=True)
            ),
            self._joint_rows,
        )
        indices = self.contacts.select(previous, forces[:, 0] > 0.0, problem.ballistic_positions)
        contacts = self.contacts.contact_set(indices, problem.state.positions)
        forces = contacts.transferred_forces(previous, forces)
        forces = forces / self.contacts.tangent_lengths(self.contacts.pairs.keys(indices))
        bias = self.solver.normal_bias(contacts, dt)
        return SolveInputs(problem, contacts, bias, self.contacts.friction, forces)

    def _previous_contacts(self, memories: Memories) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices (m,) and forces (m, 3) N of the contacts of the previous step."""
        pairs, indices, forces = self.contacts.pairs, [], []
        for body, memory in enumerate(memories):
            others, points = np.divmod(memory.points, pairs.point_counts[body])
            for other in np.unique(others).tolist():
                # 0 is the ground, k + 1 is body k. Negative numbers are contacts at points of the other body, whose
                # memory contains them too.
                if other == 0 or (other > 0 and other - 1 in self.members):
                    chosen = others == other
                    touched = -1 if other == 0 else self.members.index(other - 1)
                    indices.append(pairs.indices(body, points[chosen], touched))
                    forces.append(memory.forces[chosen])
        return np.concatenate([np.zeros(0, int), *indices]), np.concatenate([np.zeros((0, 3)), *forces])

    def _tensions(self, activations: Sequence[np.ndarray]) -> list[MuscleEnergy | None]:
        return [
            MuscleEnergy.of(stepper.muscles, each) if len(each) else None
            for stepper, each in zip(self.steppers, activations, strict=True)
        ]

    def _plan(
        self,
        predicted: PredictedStep,
        plans: Sequence[Plan],
        memories: Memories,
        objectives: Objectives,
        clock: StageClock,
        bodies: Sequence[int] | None = None,
    ) -> list[Plan]:
        """Plan the activations of the ``bodies`` that have muscles, one after the other.

        Args:
            predicted: predicted end of the step; its activations and forces are replaced for each body.
            plans: previous plan of each body, with the activations that it has until it is planned.
            memories: warm start of each body.
            objectives: objectives of each body.
            clock: timer of the stages.
            bodies: indices of the bodies; None for all.
        """
        plans = list(plans)
        forces = predicted.forces
        for body in range(len(plans)) if bodies is None else bodies:
            stepper = self.steppers[body]
            if stepper.muscles.segment_count == 0:
                continue
            tensions = self._tensions([plan.activations for plan in plans])
            tensions[body] = None
            own = replace(
                predicted, activations=plans[body].activations, forces=forces, body=body, other_tensions=tensions
            )
            plans[body] = self._planners[body].plan(own, memories[body].activations, objectives[body], clock)
            forces = plans[body].forces
            # The end that the last plan expects results from the activations of all plans.
            plans = [replace(plan, velocities=plans[body].velocities, forces=forces) for plan in plans]
        return plans

    def _solve(self, response: ContactLinearization, plans: Sequence[Plan]) -> CoupledResult:
        tensions: Any = self._tensions([plan.activations for plan in plans])
        return self.solver.solve(response, tensions, velocities=plans[0].velocities, forces=plans[0].forces)

    def _replan(
        self,
        problem: IslandProblem,
        plans: Sequence[Plan],
        expected: np.ndarray,
        result: CoupledResult,
        memories: Memories,
        objectives: Objectives,
        clock: StageClock,
    ) -> tuple[Sequence[Plan], CoupledResult]:
        """Plan the creatures whose objectives cost clearly more than ``expected`` (k,) again about the solved end, and
        solve again. Return the plans and the result with the lower total cost; see ``LocomotionStepper.step``."""
        reached = self._values(problem, result.contacts, result, objectives)
        worse = np.flatnonzero(reached > REPLAN_FACTOR * expected + REPLAN_MARGIN)
        if len(worse) == 0:
            return plans, result
        response, bias = result.linearization, self.solver.normal_bias(result.contacts, problem.dt)
        predicted = PredictedStep(response, bias, np.zeros(0), result.velocities, result.forces)
        others = self._plan(predicted, plans, memories, objectives, clock, worse.tolist())
        end = self._solve(response, others)
        clock.lap("replan")
        is_better = end.converged and self._values(problem, end.contacts, end, objectives).sum() < reached.sum()
        chosen = others if is_better else plans
        counted = [
            one.counting(plan, other) if body in worse else one
            for body, (one, plan, other) in enumerate(zip(chosen, plans, others, strict=True))
        ]
        return counted, end if is_better else result

    def _values(
        self, problem: IslandProblem, contacts: ContactSet, end: Plan | CoupledResult, objectives: Objectives
    ) -> np.ndarray:
        """Return the objective value of each body at ``end``."""
        pushes = problem.split(contacts.nodal_forces(end.forces))
        parts = zip(problem.problems, problem.split(end.velocities), pushes, objectives, strict=True)
        return np.array([objectives_value(own, targets, ends, push) for own, ends, push, targets in parts])

    def _reports(
        self, problem: IslandProblem, plans: Sequence[Plan], result: CoupledResult, clock: StageClock
    ) -> list[StepReport]:
        """Return the report of each body at the end of a solve."""
        contacts, ends = result.contacts, problem.end_positions(result.velocities)
        joint_forces = self._joint_forces(problem, plans, result)
        keys, end_gaps = self.contacts.pairs.keys(contacts.points), contacts.end_gaps(problem.dt, result.velocities)
        lengths = self.contacts.tangent_lengths(keys)
        contacts = replace(contacts, axes=contacts.axes / lengths[:, :, None])
        forces = result.forces * lengths
        min_gaps, tensions = self.contacts.min_gaps(ends), self._tensions([plan.activations for plan in plans])
        clock.lap("report")
        reports = []
        for body, (own, end, velocities) in enumerate(
            zip(problem.problems, problem.split(ends), problem.split(result.velocities), strict=True)
        ):
            chosen, own_contacts = self._contacts_of(body, keys, contacts, problem)
            spin = own.momentum_correction(own.internal_gradient(velocities, tensions[body]))
            plan, drive = plans[body], None
            if isinstance(own, DrivenStep):
                drive = own.drive(_external_forces(own_contacts, forces[chosen], joint_forces[body]))
            reports.append(
                StepReport(
                    state=BodyState(end, velocities, own.state.time + problem.dt),
                    dt=problem.dt,
                    contacts=own_contacts,
                    forces=forces[chosen],
                    end_gaps=end_gaps[chosen],
                    min_gap=float(min_gaps[body]),
                    activations=plan.activations,
                    qp_count=plan.qp_count,
                    qp_infeasible=plan.qp_infeasible,
                    newton_iterations=result.iterations,
                    converged=result.converged,
                    added_spin=float(np.linalg.norm(spin)),
                    drive=drive,
                    joints=joint_forces[body],
                    milliseconds=clock.milliseconds,
                )
            )
        return reports

    def _joint_forces(
        self, problem: IslandProblem, plans: Sequence[Plan], result: CoupledResult
    ) -> list[JointForces | None]:
        """Return the forces of the joints on each body at the end of a solve; None for a body without joints."""
        if problem.joints is None:
            return [None] * len(plans)
        tensions: Any = self._tensions([plan.activations for plan in plans])
        pushes = result.contacts.nodal_forces(result.forces)
        residual = problem.residual(result.velocities, tensions) - problem.dt * pushes
        forces = problem.joints.impulses(residual).reshape(-1, 3) / problem.dt
        of_bodies: list[list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]] = [[] for _ in plans]
        for number, joint, force in zip(self._joint_numbers, problem.joints.rows.joints, forces, strict=True):
            for point, sign in zip(joint.points, joint.signs, strict=True):
                of_bodies[point.body].append((int(number), point.nodes, point.weights, sign * force))
        return [JointForces(*map(np.array, zip(*each, strict=True))) if each else None for each in of_bodies]

    def _contacts_of(
        self, body: int, keys: np.ndarray, contacts: ContactSet, problem: IslandProblem
    ) -> tuple[np.ndarray, ContactSet]:
        """Return the indices of the contacts of a body, and these contacts with the nodes of this body alone.

        The face of a contact with body j of the world is -1 - j. If its point is point p of the P points of this body,
        it has the number (j + 1) P + p. If it is point p of body j, it has the number -1 - p, and its frame is
        reversed, so that the force has the same components.
        """
        pairs, start = self.contacts.pairs, int(problem.node_starts[body])
        owned, touched = np.flatnonzero(keys[:, 0] == body), np.flatnonzero(keys[:, 1] == body)
        chosen = np.concatenate([owned, touched])
        others = np.array([*self.members, -1])[np.concatenate([keys[owned, 1], keys[touched, 0]])]
        sides = np.repeat([0, 1], [len(owned), len(touched)])
        entries = np.arange(len(chosen))
        nodes = contacts.nodes[chosen].reshape(-1, 2, 4)[entries, sides] - start
        weights = contacts.weights[chosen].reshape(-1, 2, 4)[entries, sides]
        signs = 1.0 - 2.0 * sides
        points = np.where(sides == 0, (others + 1) * pairs.point_counts[body] + keys[chosen, 2], -1 - keys[chosen, 2])
        return chosen, ContactSet(
            points,
            nodes.astype(np.int32),
            weights * signs[:, None],
            contacts.axes[chosen] * signs[:, None, None],
            contacts.gaps[chosen],
            np.where(others < 0, contacts.faces[chosen], -1 - others).astype(np.int32),
            len(problem.problems[body].node_mass),
        )


def _external_forces(contacts: ContactSet, forces: np.ndarray, joints: JointForces | None) -> np.ndarray:
    """Return the forces (N, 3) N of ``contacts`` with ``forces`` (n, 3) N, and of joints, on the nodes of a body."""
    nodal = contacts.nodal_forces(forces)
    return nodal if joints is None else nodal + joints.nodal_forces(len(nodal))
