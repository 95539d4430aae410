"""The two-stage stepper: predict the contact states, optimise the muscles, correct with the full mechanics (Eq. 12, 13)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from egs_warp.body import BodyState, SoftBody
from egs_warp.complementarity import (
    SEPARATE,
    ContactLayout,
    proposed_pivots,
    states_from_prediction,
)
from egs_warp.contact import (
    ContactDetector,
    ContactGeometry,
    ContactSet,
    independent_contacts,
    push_out_speeds,
    tangent_directions,
)
from egs_warp.contact_step import ContactStepResult, contact_step
from egs_warp.dynamics import Factorisation, ImplicitStep, conserve_angular_momentum
from egs_warp.muscles import MuscleColumns, MuscleSet
from egs_warp.objectives import Objective, SpinObjective, lifted_contacts
from egs_warp.prediction import Prediction, predict
from egs_warp.qp import QpSolution, QuadraticProgram


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
    """QPs a step at most."""
    activation_weight: float = 2e-4
    activation_change_weight: float = 3e-4
    drag: float = 0.0
    """alpha, 1/s."""


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
        columns = self._columns.sparse(state.positions)
        points = self.choose_contacts(step, memory)
        clock.lap("detect")
        contacts = self.detector.contact_set(points, state.positions)
        passive = self._gravity_force + (columns @ memory.activations).reshape(-1, 3)
        prediction = predict(
            step,
            contacts,
            passive,
            state.velocities,
            normal_forces=self.matched_forces(memory, points)[:, 0],
            friction=self.geometry.friction,
            push_out_cap=self.settings.push_out_cap * self.speed_scale,
        )
        clock.lap("predict")
        plan = self._optimise(step, columns, contacts, prediction, memory, objectives, clock)
        result = contact_step(
            step,
            self.detector,
            points,
            self._gravity_force + (columns @ plan.activations).reshape(-1, 3),
            start_velocities=plan.velocities,
            start_forces=plan.forces,
            push_out_cap=self.settings.push_out_cap * self.speed_scale,
            penetration_tolerance=self.settings.penetration_tolerance * self.body.height,
        )
        clock.lap("correct")
        return self._finish(step, state, plan, result, clock)

    def choose_contacts(self, step: ImplicitStep, memory: StepMemory) -> np.ndarray:
        """(n,) points that the step may bring to a plane, well-conditioned, last step's first (DESIGN 7)."""
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

    def _optimise(self, step, columns, contacts, prediction: Prediction, memory, objectives, clock) -> _Plan:
        body, settings = self.body, self.settings
        all_contacts = contacts.count
        contacts = contacts.head(settings.qp_contact_limit)
        layout = ContactLayout(self.muscles.segment_count, contacts.count, settings.directions)
        linear = _linearise(step, columns, contacts, prediction, self.muscles.bounds, layout, body.weight)
        clock.lap("linearise")
        previous = memory.activations / self.muscles.bounds
        moments = _moment_rows(step, contacts, layout, body.weight)
        P, q = _quadratic_cost(step, linear, moments, objectives, layout, previous, settings, self.speed_scale)
        shift = push_out_speeds(contacts.gaps, step.dt, settings.push_out_cap * self.speed_scale)
        A, offset = _rows(linear, contacts, shift, layout, self.geometry.friction, self.speed_scale)
        program = QuadraticProgram(P, q, A)
        states = states_from_prediction(
            prediction.normal_forces[: contacts.count],
            prediction.tangential_forces[: contacts.count],
            prediction.tangential_velocities[: contacts.count],
            self.geometry.friction,
            settings.directions,
        )
        states[lifted_contacts(contacts, objectives)] = SEPARATE
        best, count, infeasible = _pivot(program, layout, states, offset, linear, contacts, self, settings.qp_limit)
        clock.lap("qp")
        if best is None:
            return _Plan(memory.activations, prediction.velocities, _frame_forces(prediction), count, infeasible)
        y = best.x
        activations = np.clip(y[: layout.activations], -1.0, 1.0) * self.muscles.bounds
        tangent = y[layout.tangent].reshape(contacts.count, settings.directions) @ tangent_directions(
            settings.directions
        )
        forces = np.zeros((all_contacts, 3))
        forces[: contacts.count] = body.weight * np.column_stack([np.maximum(y[layout.normal], 0.0), tangent])
        velocities = (linear.base + linear.response @ y).reshape(-1, 3)
        if not np.isfinite(step.energy(velocities, self._gravity_force)):
            velocities = prediction.velocities
        return _Plan(activations, velocities, forces, count, infeasible)

    def _finish(self, step, state, plan: _Plan, result: ContactStepResult, clock):
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
            end_gaps=gaps[result.contacts.points],
            min_gap=float(gaps.min()),
            activations=plan.activations,
            qp_count=plan.qp_count,
            qp_infeasible=plan.qp_infeasible,
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
    qp_count: int
    qp_infeasible: int


@dataclass(frozen=True)
class _LinearResponse:
    """v = base + response y, linearised at the prediction (DESIGN 8)."""

    base: np.ndarray
    """(3N,) m/s without muscles and contact."""
    response: np.ndarray
    """(3N, variables)."""


class _Clock:
    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.milliseconds[name] = 1e3 * (now - self._last)
        self._last = now


def _frame_forces(prediction: Prediction) -> np.ndarray:
    return np.column_stack([prediction.normal_forces, prediction.tangential_forces])


def _linearise(step, columns, contacts, prediction, bounds, layout, weight) -> _LinearResponse:
    """S v = M v0 + dt (f + A a + W^T f_c) around p + dt v^ with the projected stiffness."""
    body, dt = step.body, step.dt
    step.factor(prediction.velocities, projected=True)
    force = body.node_mass[:, None] * body.gravity
    residual = step.gradient(prediction.velocities, force)
    base = (prediction.velocities - step.factorisation.solve(residual)).ravel()
    sources = np.hstack([columns.toarray() * bounds, weight * contacts.frame.T.toarray()])
    solved = dt * step.factorisation.solve(sources)
    muscle = solved[:, : layout.activations]
    contact = solved[:, layout.activations :].reshape(len(base), contacts.count, 3)
    tangent = np.einsum("vnt,dt->vnd", contact[:, :, 1:], tangent_directions(layout.directions))
    response = np.concatenate(
        [
            muscle,
            contact[:, :, 0],
            tangent.reshape(len(base), layout.contacts * layout.directions),
            np.zeros((len(base), contacts.count)),
        ],
        axis=1,
    )
    return _LinearResponse(base, response)


def _moment_rows(step, contacts, layout, weight) -> np.ndarray:
    """(3, variables) change of angular momentum over the step, arms at its start, for each unknown."""
    positions = step.state.positions
    points = np.einsum("nw,nwi->ni", contacts.weights, positions[contacts.nodes])
    arms = points - step.body.centre_of_mass(positions)
    torques = step.dt * weight * np.cross(arms[:, None, :], contacts.axes)
    rows = np.zeros((3, layout.variables))
    rows[:, layout.normal] = torques[:, 0].T
    tangent = np.einsum("nti,dt->ndi", torques[:, 1:], tangent_directions(layout.directions))
    rows[:, layout.tangent] = tangent.reshape(layout.contacts * layout.directions, 3).T
    return rows


def _quadratic_cost(
    step, linear, moments, objectives, layout, previous, settings, speed_scale
) -> tuple[np.ndarray, np.ndarray]:
    body, state = step.body, step.state
    P = 1e-7 * np.eye(layout.variables)
    q = np.zeros(layout.variables)
    for objective in objectives:
        if isinstance(objective, SpinObjective):
            gyration = np.sqrt(0.5 * np.trace(body.inertia(state.positions)) / body.mass)
            unit = body.mass * gyration * speed_scale
            rows = moments / unit
            gap = (body.angular_momentum(state.positions, state.velocities) - objective.target) / unit
        else:
            rows = (objective.rows @ linear.response) / speed_scale
            gap = (objective.rows @ linear.base - objective.target) / speed_scale
        P += 2.0 * objective.weight * rows.T @ rows
        q += 2.0 * objective.weight * rows.T @ gap
    m = np.arange(layout.activations)
    P[m, m] += 2.0 * (settings.activation_weight + settings.activation_change_weight)
    q[m] -= 2.0 * settings.activation_change_weight * previous
    return P, q


def _rows(linear, contacts, shift, layout, friction, speed_scale) -> tuple[np.ndarray, np.ndarray]:
    """Rows A y + offset of ``ContactLayout``: y itself, then c, D^T u' + E lambda and mu f_n - E^T f_t."""
    n, nd = layout.contacts, layout.directions
    speed = (contacts.frame @ linear.response).reshape(n, 3, layout.variables) / speed_scale
    base = (contacts.frame @ linear.base).reshape(n, 3) / speed_scale
    table = tangent_directions(nd)
    lam = np.zeros((n, layout.variables))
    lam[np.arange(n), layout.slip.start + np.arange(n)] = 1.0
    slip = np.einsum("dt,ntv->ndv", table, speed[:, 1:]) + lam[:, None, :]
    cone = np.zeros((n, layout.variables))
    for i in range(n):
        cone[i, layout.normal.start + i] = friction
        cone[i, layout.tangent.start + i * nd : layout.tangent.start + (i + 1) * nd] = -1.0
    A = np.vstack([np.eye(layout.variables), speed[:, 0], slip.reshape(n * nd, layout.variables), cone])
    offset = np.concatenate(
        [np.zeros(layout.variables), base[:, 0] + shift / speed_scale, (base[:, 1:] @ table.T).ravel(), np.zeros(n)]
    )
    return A, offset


def _pivot(program, layout, states, offset, linear, contacts, stepper, limit) -> tuple[QpSolution | None, int, int]:
    """Solve, move the best contact to its better state, solve again, while that lowers the objective."""

    def solve(candidate: np.ndarray, soft: bool = False) -> QpSolution:
        lower, upper = layout.bounds(candidate, soft=soft)
        return program.solve(lower - offset, upper - offset)

    best = solve(states)
    count, infeasible = 1, 0
    if not best.usable:
        infeasible += 1
        best = solve(states, soft=True)
        count += 1
        return (best if best.usable else None), count, infeasible
    visited = {states.tobytes()}
    improved = True
    while improved and count < limit:
        improved = False
        velocity = linear.base + linear.response @ best.x
        tangential = (contacts.frame @ velocity).reshape(-1, 3)[:, 1:] / stepper.speed_scale
        for _, contact, state in proposed_pivots(
            layout, states, best.x, best.multipliers, tangential, stepper.geometry.friction
        ):
            trial = states.copy()
            trial[contact] = state
            if trial.tobytes() in visited or count >= limit:
                continue
            visited.add(trial.tobytes())
            solution = solve(trial)
            count += 1
            if solution.usable and solution.objective < best.objective - 1e-9:
                best, states, improved = solution, trial, True
                break
    return best, count, infeasible
