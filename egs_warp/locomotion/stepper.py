"""The two-stage stepper: predict the contact states, optimise the muscles,
correct with the full mechanics (Eq. 12, 13).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from egs_warp.contact.corrector import ContactStepResult, contact_step
from egs_warp.contact.detection import ContactDetector, ContactGeometry, ContactSet, independent_contacts
from egs_warp.contact.penalty import Prediction, predict
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.factorisation import Factorisation
from egs_warp.fem.implicit_step import ImplicitStep, conserve_angular_momentum
from egs_warp.locomotion.complementarity import SEPARATE, ContactLayout, states_from_prediction
from egs_warp.locomotion.objectives import Objective, SpinObjective, lifted_contacts
from egs_warp.locomotion.program import CostScales, contact_program, linear_response
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import SearchResult, Strategy, find_states
from egs_warp.muscles.muscle_set import MuscleColumns, MuscleSet
from egs_warp.muscles.tension import MuscleTension

_ORDINARY_STRENGTH = 4.0
"""Body weights, of the muscle that the weights of activations are given for."""


@dataclass(frozen=True)
class LocomotionSettings:
    """Numbers of the stepper; lengths are in body heights, forces in body weights, speeds in sqrt(g H)."""

    directions: int = 4
    """n_d, edges of the friction pyramid."""
    contact_limit: int = 32
    """Points of the corrector's contact set."""
    qp_contact_limit: int = 32
    """Of these, the most independent ones take part in the QP."""
    contact_pivot_tolerance: float = 1e-3
    near: float = 0.01
    """A point takes part if the step may bring it this near to a plane."""
    penetration_tolerance: float = 5e-3
    push_out_cap: float = 0.05
    qp_limit: int = 3
    """QPs a step at most; ``strategies.PATIENCE`` times as many where the contact states are in doubt."""
    qp_solver: QpSolver | str = QpSolver.OSQP
    strategy: Strategy | str = Strategy.TWO_STAGE
    activation_weight: float = 2e-4
    """For a step of sqrt(H / g) / 19 and a muscle of 4 body weights. Shorter steps change speeds by less, so they weigh
    activations less: by the square of their share. Stronger muscles weigh more, as their force."""
    activation_change_weight: float = 3e-4
    """Likewise, by the step's share, and by the square of the force: the strong muscles of a stiff body would else play
    full strokes against each other from step to step, further than the linearised program knows the way."""
    drag: float = 0.0
    """alpha, 1/s."""

    def __post_init__(self) -> None:
        # Names that are not known are refused here, not in the first step.
        QpSolver(self.qp_solver)
        Strategy(self.strategy)


@dataclass(frozen=True)
class StepMemory:
    """What a step hands to the next."""

    points: np.ndarray
    """(n,) contact points in use."""
    forces: np.ndarray
    """(n, 3) newtons."""
    activations: np.ndarray
    """(M,) metres."""


@dataclass(frozen=True)
class StepReport:
    """What happened in one step."""

    state: BodyState
    dt: float
    contacts: ContactSet
    forces: np.ndarray
    """(n, 3) newtons in each contact's frame."""
    end_gaps: np.ndarray
    """(n,) metres."""
    min_gap: float
    """Smallest gap of all contact points at the end of the step, metres."""
    activations: np.ndarray
    """(M,) metres."""
    qp_count: int
    qp_infeasible: int
    newton_iterations: int
    converged: bool
    added_spin: float
    """rad/s, see ``conserve_angular_momentum``."""
    milliseconds: dict[str, float] = field(default_factory=dict)


class LocomotionStepper:
    """Orchestrates the kernels and the QP for one body."""

    def __init__(
        self,
        body: SoftBody,
        muscles: MuscleSet,
        geometry: ContactGeometry,
        *,
        settings: LocomotionSettings | None = None,
        device: str | None = None,
    ) -> None:
        self.body, self.muscles, self.geometry = body, muscles, geometry
        self.settings = settings or LocomotionSettings()
        self.detector = ContactDetector(geometry, device=device)
        self._columns = MuscleColumns(muscles, device=device or "cpu")
        self._factorisation = Factorisation(body)
        self._gravity_force = body.node_mass[:, None] * body.gravity
        self.speed_scale = float(np.sqrt(np.linalg.norm(body.gravity) * body.height))

    def initial_memory(self) -> StepMemory:
        """No contacts, muscles at rest."""
        return StepMemory(np.zeros(0, int), np.zeros((0, 3)), np.zeros(self.muscles.segment_count))

    @staticmethod
    def matched_forces(memory: StepMemory, points: np.ndarray) -> np.ndarray:
        """(n, 3) last step's forces of ``points`` (n,), zero for new ones."""
        forces = np.zeros((len(points), 3))
        _, now, before = np.intersect1d(points, memory.points, return_indices=True)
        forces[now] = memory.forces[before]
        return forces

    @staticmethod
    def remember(result: ContactStepResult, activations: np.ndarray) -> StepMemory:
        """What the next step wants to know."""
        return StepMemory(result.contacts.points, result.forces, activations)

    def advance(
        self,
        state: BodyState,
        memory: StepMemory,
        objectives: Sequence[Objective | SpinObjective],
        dt: float,
        *,
        depth: int = 0,
    ) -> tuple[BodyState, StepMemory, list[StepReport]]:
        """One step of ``dt``; a step that does not converge is done again as two halves, at most four times over."""
        end, after, report = self.step(state, memory, objectives, dt)
        if report.converged or depth == 4:
            return end, after, [report]
        middle, between, first = self.advance(state, memory, objectives, dt / 2, depth=depth + 1)
        end, after, second = self.advance(middle, between, objectives, dt / 2, depth=depth + 1)
        return end, after, first + second

    def step(
        self, state: BodyState, memory: StepMemory, objectives: Sequence[Objective | SpinObjective], dt: float
    ) -> tuple[BodyState, StepMemory, StepReport]:
        """Predict, optimise, correct, audit."""
        clock = _Clock()
        step = ImplicitStep(self.body, state, dt, self._factorisation, drag=self.settings.drag)
        points = self.choose_contacts(step, memory)
        clock.lap("detect")
        contacts = self.detector.contact_set(points, state.positions)
        before = MuscleTension.of(self.muscles, memory.activations)
        prediction = predict(
            step,
            contacts,
            self._gravity_force,
            state.velocities,
            tension=before,
            normal_forces=self.matched_forces(memory, points)[:, 0],
            friction=self.geometry.friction,
            push_out_cap=self.settings.push_out_cap * self.speed_scale,
        )
        clock.lap("predict")
        columns = self._columns.sparse(step.end_positions(prediction.velocities))
        plan = self._optimise(step, before, columns, contacts, prediction, memory, objectives, clock)
        result = contact_step(
            step,
            self.detector,
            points,
            self._gravity_force,
            tension=MuscleTension.of(self.muscles, plan.activations),
            start_velocities=plan.velocities,
            start_forces=plan.forces,
            push_out_cap=self.settings.push_out_cap * self.speed_scale,
            penetration_tolerance=self.settings.penetration_tolerance * self.body.height,
        )
        clock.lap("correct")
        return self._finish(step, state, plan, result, clock)

    def choose_contacts(self, step: ImplicitStep, memory: StepMemory) -> np.ndarray:
        """(n,) points that the step may bring to a plane, well-conditioned, last step's first.

        See docs/concepts/contact.md.
        """
        ballistic = step.state.velocities + step.dt * self.body.gravity
        gaps, _ = self.detector.gaps(step.end_positions(ballistic))
        candidates = self.detector.candidates(memory.points, gaps, self.settings.near * self.body.height)
        if len(candidates) <= 1:
            return candidates
        contacts = self.detector.contact_set(candidates, step.state.positions)
        normals = contacts.frame[0::3]
        step.factor(np.zeros_like(step.state.velocities), projected=True)
        compliance = normals @ step.factorisation.solve(normals.T.toarray())
        kept = int(np.isin(candidates, memory.points).sum())
        chosen = independent_contacts(
            compliance, kept, self.settings.contact_limit, self.settings.contact_pivot_tolerance
        )
        return candidates[chosen]

    def _optimise(
        self,
        step: ImplicitStep,
        before: MuscleTension,
        columns: sparse.csc_matrix,
        contacts: ContactSet,
        prediction: Prediction,
        memory: StepMemory,
        objectives: Sequence[Objective | SpinObjective],
        clock: _Clock,
    ) -> _Plan:
        body, settings = self.body, self.settings
        all_contacts = contacts.count
        contacts = contacts.head(settings.qp_contact_limit)
        layout = ContactLayout(self.muscles.segment_count, contacts.count, settings.directions)
        actuation = columns.toarray() * self.muscles.bounds
        linear = linear_response(step, actuation, contacts, prediction.velocities, layout, before)
        clock.lap("linearise")
        share = step.dt / (np.sqrt(body.height / np.linalg.norm(body.gravity)) / 19.0)
        strength = self.muscles.max_forces / (_ORDINARY_STRENGTH * body.weight)
        program = contact_program(
            step,
            linear,
            contacts,
            layout,
            objectives,
            memory.activations / self.muscles.bounds,
            friction=self.geometry.friction,
            push_out_cap=settings.push_out_cap * self.speed_scale,
            scales=CostScales(
                self.speed_scale,
                settings.activation_weight * share**2 * strength,
                settings.activation_change_weight * share * strength**2,
            ),
        )
        states = states_from_prediction(
            prediction.normal_forces[: contacts.count],
            prediction.tangential_forces[: contacts.count],
            prediction.tangential_velocities[: contacts.count],
            self.geometry.friction,
            settings.directions,
        )
        states[lifted_contacts(contacts, objectives)] = SEPARATE
        found = find_states(
            program,
            settings.strategy,
            states,
            memory.activations / self.muscles.bounds,
            qp_limit=settings.qp_limit,
            solver=settings.qp_solver,
        )
        clock.lap("qp")
        if found.y is None:
            forces = np.column_stack([prediction.normal_forces, prediction.tangential_forces])
            return _Plan(memory.activations, prediction.velocities, forces, found)
        activations = np.clip(found.y[: layout.activations], -1.0, 1.0) * self.muscles.bounds
        forces = np.zeros((all_contacts, 3))
        forces[: contacts.count] = body.weight * program.contact_forces(found.y)
        velocities = (linear.base + linear.response @ found.y).reshape(-1, 3)
        if not np.isfinite(step.energy(velocities, self._gravity_force)):
            velocities = prediction.velocities
        return _Plan(activations, velocities, forces, found)

    def _finish(
        self, step: ImplicitStep, state: BodyState, plan: _Plan, result: ContactStepResult, clock: _Clock
    ) -> tuple[BodyState, StepMemory, StepReport]:
        end = step.end_positions(result.velocities)
        external = result.nodal_forces - self.settings.drag * self.body.node_mass[:, None] * result.velocities
        velocities, spin = conserve_angular_momentum(self.body, state, end, result.velocities, external, step.dt)
        gaps, _ = self.detector.gaps(end)
        after = BodyState(end, velocities, state.time + step.dt)
        memory = self.remember(result, plan.activations)
        clock.lap("audit")
        report = StepReport(
            state=after,
            dt=step.dt,
            contacts=result.contacts,
            forces=result.forces,
            end_gaps=result.contacts.end_gaps(step.dt, result.velocities),
            min_gap=float(gaps.min()),
            activations=plan.activations,
            qp_count=plan.search.qp_count,
            qp_infeasible=plan.search.infeasible,
            newton_iterations=step.newton_iterations,
            converged=result.converged,
            added_spin=spin,
            milliseconds=clock.milliseconds,
        )
        return after, memory, report


@dataclass(frozen=True)
class _Plan:
    activations: np.ndarray
    velocities: np.ndarray
    forces: np.ndarray
    search: SearchResult


class _Clock:
    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.milliseconds[name] = 1e3 * (now - self._last)
        self._last = now
