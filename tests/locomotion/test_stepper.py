"""Stepper (Eq. 4, 9, 12, 13): an independent audit of each step, deterministic runs, a body that follows its
objectives, and subdivision of a failed step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from egs_warp.contact.detection import ContactGeometry
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.fem.step_problem import StepProblem
from egs_warp.fem.warp_elasticity import WarpElasticity
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion import stepper as stepping
from egs_warp.locomotion.linear_step import PredictedStep
from egs_warp.locomotion.objectives import (
    AngularMomentumObjective,
    AnyObjective,
    centre_of_mass_velocity,
    node_velocities,
)
from egs_warp.locomotion.planner import Plan, StepPlanner
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.locomotion.strategies import Strategy
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.muscles.fibres import Fibre, FibreKind
from egs_warp.muscles.muscle_set import attach_fibres
from tests.support.creatures import coarse_creature
from tests.support.meshes import block_mesh

DT, FRICTION = 1 / 60, 0.8
FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


SIDE = np.linspace(-0.2, 0.2, 5)
GRID = np.array([[x, y] for x in SIDE for y in SIDE])


def muscular_block(
    device: str = "cpu", *, feet: np.ndarray = GRID, settings: LocomotionSettings | None = None
) -> LocomotionStepper:
    """Create a block with eight longitudinal and six radial fibres and contact points ``feet`` (n, 2), m, on its
    base."""
    mesh = block_mesh()
    body = make_body(mesh, FLOOR, sag=0.03, device=device)
    heights = np.array([0.02, 0.26, 0.5, 0.74, 0.98])
    fibres = []
    for k in range(8):
        across = 0.15 * np.array([np.cos(k * np.pi / 4), np.sin(k * np.pi / 4)])
        points = np.column_stack([np.tile(across, (5, 1)), heights])
        fibres.append(Fibre(f"long{k}", FibreKind.LONGITUDINAL, points, 2.0 * body.weight))
    for k, z in enumerate((0.25, 0.5, 0.75)):
        for axis in np.eye(3)[:2]:
            ends = np.stack([-0.18 * axis, 0.18 * axis]) + [0, 0, z]
            fibres.append(Fibre(f"radial{k}{axis}", FibreKind.RADIAL, ends, 2.0 * body.weight))
    embedding = embed_points(mesh, np.column_stack([feet, np.zeros(len(feet))]), device="cpu")
    geometry = ContactGeometry(mesh, (FLOOR,), FRICTION, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    return LocomotionStepper(body, attach_fibres(mesh, fibres), geometry, settings=settings, device=device)


def hop(body: SoftBody, step: int) -> list[AnyObjective]:
    """Return the objectives of a hop: the body is upright and moves down for six steps, then up and forwards."""
    velocity = np.array([0.0, 0.0, -0.4]) if step < 6 else np.array([0.1, 0.0, 0.25 * (step - 5)])
    pose = np.tile(velocity, (len(body.mesh.nodes), 1))
    return [
        centre_of_mass_velocity(body, velocity, 1.0),
        AngularMomentumObjective(np.zeros(3), 1.0),
        node_velocities(body, pose, 0.02),
    ]


def run_hop(stepper: LocomotionStepper, steps: int) -> tuple[list[BodyState], list[StepReport]]:
    body = stepper.body
    states, reports = [BodyState(body.mesh.nodes, np.zeros_like(body.mesh.nodes))], []
    memory = stepper.initial_memory()
    for i in range(steps):
        end, memory, fresh = stepper.advance(states[-1], memory, hop(body, i), DT)
        reports += fresh
        states += [report.state for report in fresh]
        assert end is fresh[-1].state
    return states, reports


def test_audit_of_a_hop(device: str) -> None:
    """Eq. (4), Eq. (9), Eq. (12), Eq. (13): in units of weight and height, the balance of linear momentum holds to
    1e-5, the balance of angular momentum, the friction cone and complementarity hold to 1e-4, and the penetration is at
    most 0.01.
    """
    stepper = muscular_block(device)
    body = stepper.body
    states, reports = run_hop(stepper, 16)
    weight, height = body.weight, body.height
    assert len(states) == len(reports) + 1
    for before, report in zip(states[:-1], reports, strict=True):
        after, dt = report.state, report.dt
        # The balances are evaluated explicitly, with forces in world axes at points in world coordinates.
        points = np.einsum("nw,nwi->ni", report.contacts.weights, before.positions[report.contacts.nodes])
        forces = np.einsum("na,nai->ni", report.forces, report.contacts.axes)
        gain = (body.node_mass[:, None] * (after.velocities - before.velocities)).sum(0) / dt
        assert np.linalg.norm(gain - body.mass * body.gravity - forces.sum(0)) <= 1e-5 * weight
        arms = points - body.centre_of_mass(before.positions)
        spin = (
            body.angular_momentum(after.positions, after.velocities)
            - body.angular_momentum(before.positions, before.velocities)
        ) / dt
        assert np.linalg.norm(spin - np.cross(arms, forces).sum(0)) <= 1e-4 * weight * height
        assert report.forces[:, 0].min(initial=0.0) >= -1e-4 * weight
        slack = np.linalg.norm(report.forces[:, 1:], axis=1) - FRICTION * report.forces[:, 0]
        assert slack.max(initial=0.0) <= 1e-4 * weight
        ends = np.einsum("nw,nwi->ni", report.contacts.weights, after.positions[report.contacts.nodes])
        gaps = FLOOR.heights(ends)
        assert np.allclose(gaps, report.end_gaps, atol=1e-12)
        assert (report.forces[:, 0] * np.maximum(gaps, 0.0)).max(initial=0.0) <= 1e-4 * weight * height
        assert report.min_gap >= -0.01 * height
        assert report.converged and body.assembly.determinants(after.positions).min() > 0.0
        assert np.all(np.abs(report.activations) <= stepper.muscles.bounds * (1 + 1e-12))
        assert 0 < report.qp_count <= stepper.settings.qp_limit
        # Velocities are consistent with the displacements.
        assert np.abs(after.positions - before.positions - dt * after.velocities).max() < 1e-12 * height
    # The body moves down, and then up faster than the push-out of the floor alone could move it, so the muscles are
    # active.
    speeds = [body.centre_of_mass(s.velocities)[2] for s in states]
    assert min(speeds) < -0.2 and max(speeds) > 0.8
    assert max(np.abs(r.activations / stepper.muscles.bounds).max() for r in reports) > 0.05


def test_predictions_of_a_program_are_in_its_units() -> None:
    """Contact velocities are in sqrt(g H), forces in body weights, and activations within their bounds, as in the
    prediction."""
    stepper = muscular_block()
    body = stepper.body
    states, reports = run_hop(stepper, 3)
    memory = WarmStart.from_report(reports[-1])
    problem = StepProblem(body, states[-1], DT, stepper.settings.drag)
    prospect = stepper.predict(stepper.step_inputs(problem, reports[-1].contacts, memory))
    foreseen = stepper.planner.program(prospect, memory.activations, hop(body, 3)).predicted
    speeds = prospect.linearization.contacts.contact_velocities(prospect.velocities.ravel()).reshape(-1, 3)
    assert np.abs(speeds).max() > 1e-3 and prospect.forces[:, 0].sum() > 0.5 * body.weight
    np.testing.assert_allclose(foreseen.velocities, speeds / body.speed_unit, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(foreseen.forces, prospect.forces / body.weight, rtol=1e-12)
    shares = stepper.planner.synergies.mean(memory.activations / stepper.muscles.bounds)
    np.testing.assert_allclose(foreseen.activations, shares, rtol=1e-12)


def test_a_body_bobs_as_requested() -> None:
    """In half a period of a vertical oscillation with an amplitude of 2 % of the height, the error of the velocity is
    less than 5 % of its peak, and the change of the load reverses its sign in at most 15 % of the steps."""
    creature = coarse_creature(block_mesh(), forward=np.array([1.0, 0.0, 0.0]))
    stepper, body, state = creature.stepper, creature.stepper.body, creature.start
    memory, loads, misses = stepper.initial_memory(), [], []
    peak, rate = 0.02 * body.height * 6.0, 6.0
    for step in range(30):
        wanted = np.array([0.0, 0.0, -peak * np.sin(rate * DT * (step + 1))])
        spread = np.tile(wanted, (len(state.positions), 1))
        objectives = [
            centre_of_mass_velocity(body, wanted, 1000.0),
            AngularMomentumObjective(np.zeros(3), 1000.0),
            node_velocities(body, spread, 0.1),
        ]
        state, memory, reports = stepper.advance(state, memory, objectives, DT)
        assert all(report.converged for report in reports) and len(reports) == 1
        loads.append(reports[0].forces[:, 0].sum() / body.weight)
        misses.append(abs(body.centre_of_mass(state.velocities)[2] - wanted[2]) / peak)
        assert np.abs(memory.activations / stepper.muscles.bounds).max() <= 1.0
        assert reports[0].added_spin < 0.01
    assert max(misses[5:]) < 0.05
    changes = np.diff(loads[5:])
    reversals = (changes[1:] * changes[:-1] < 0.0) & (np.minimum(abs(changes[1:]), abs(changes[:-1])) > 0.02)
    assert reversals.mean() <= 0.15


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def test_device_factors_give_the_same_hop(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In 30 planned steps (10 on a CPU, where dense factors are slow), positions differ by less than 1e-8 H from those
    with sparse factors. The body has four contact points; with more points, rounding decides which of them carry the
    load.
    """
    steps, corners = 10 if device == "cpu" else 30, GRID[[0, 4, 20, 24]]
    dense_factors = pytest.importorskip("egs_warp.fem.tiled_cholesky")
    expected, _ = run_hop(muscular_block(feet=corners), steps)
    made: list[object] = []

    def dense(assembly: ElasticAssembly) -> object:
        made.append(dense_factors.TiledCholesky(assembly.upper_pattern, device=device))
        return made[-1]

    monkeypatch.setattr(ElasticAssembly, "new_solver", dense)
    # The kernels for GPUs are run on a CPU.
    monkeypatch.setattr("egs_warp.fem.elasticity.SimdElasticity", WarpElasticity)
    got, reports = run_hop(muscular_block(device, feet=corners), steps)
    assert len(made) == 2 and len(got) == len(expected) and max(len(one.forces) for one in reports) > 3
    for one, other in zip(got, expected, strict=True):
        assert np.abs(one.positions - other.positions).max() < 1e-8


def test_two_runs_are_bit_identical() -> None:
    """On the same device, equal inputs give bitwise equal positions, velocities, forces and activations."""
    runs = [run_hop(muscular_block(), 10) for _ in range(2)]
    for (states, reports), (others, twins) in [runs]:
        for a, b in zip(states, others, strict=True):
            assert a.positions.tobytes() == b.positions.tobytes() and a.velocities.tobytes() == b.velocities.tobytes()
        for r, s in zip(reports, twins, strict=True):
            assert r.forces.tobytes() == s.forces.tobytes() and r.activations.tobytes() == s.activations.tobytes()
            assert np.array_equal(r.contacts.points, s.contacts.points) and r.qp_count == s.qp_count


@pytest.mark.parametrize("solver", list(QpSolver))
@pytest.mark.parametrize(
    "feet",
    [
        np.column_stack([np.linspace(-0.2, 0.2, 7), np.zeros(7)]),
        np.repeat([[-0.2, -0.2], [0.2, -0.2], [0.0, 0.2]], 4, axis=0),
        np.zeros((1, 2)),
        np.random.default_rng(0).uniform(-0.2, 0.2, (40, 2)),
    ],
    ids=["line", "duplicates", "one point", "forty points"],
)
def test_degenerate_contact_sets_never_lose_a_frame(feet: np.ndarray, solver: QpSolver) -> None:
    """Eq. (9), Eq. (13): every step converges, all its QPs are feasible, and no point penetrates by more than 1 % of
    the height."""
    stepper = muscular_block(feet=feet, settings=LocomotionSettings(qp_solver=solver))
    _, reports = run_hop(stepper, 8)
    assert len(reports) == 8
    for report in reports:
        assert report.converged and report.qp_count >= 1 and report.qp_infeasible == 0
        assert np.isfinite(report.state.velocities).all() and np.isfinite(report.forces).all()
        assert report.min_gap > -0.01 * stepper.body.height
    assert any(report.contacts.count > 0 for report in reports)


@pytest.mark.parametrize("strategy", list(Strategy))
def test_the_stepper_runs_with_every_strategy(strategy: Strategy) -> None:
    """Eq. (12), Eq. (13): with every search, all steps converge, muscles are active, and the number of QPs is
    bounded."""
    settings = LocomotionSettings(strategy=strategy, qp_limit=6, qp_solver=QpSolver.DAQP)
    _, reports = run_hop(muscular_block(settings=settings), 6)
    assert all(report.converged for report in reports)
    assert max(np.abs(report.activations).max() for report in reports) > 0.0
    assert max(report.qp_count for report in reports) <= 6


class LateStepper(LocomotionStepper):
    """Stepper that reports every step longer than ``longest`` seconds as not converged."""

    longest = 0.0

    def step(self, state: BodyState, memory: WarmStart, objectives: Sequence[AnyObjective], dt: float) -> StepReport:
        return self._judged(super().step(state, memory, objectives, dt))

    def step_with_activations(
        self, state: BodyState, memory: WarmStart, activations: np.ndarray, dt: float
    ) -> StepReport:
        return self._judged(super().step_with_activations(state, memory, activations, dt))

    def _judged(self, report: StepReport) -> StepReport:
        return replace(report, converged=report.dt <= self.longest)


@pytest.mark.parametrize(("longest", "parts"), [(1.0, 1), (0.6, 2), (0.3, 4), (0.01, 16)])
def test_a_step_that_does_not_converge_is_subdivided(longest: float, parts: int) -> None:
    """The step is halved until it converges, at most four times; the parts add up to the step and use the activations
    planned for the whole step, and the last failure stays in the reports."""
    made = muscular_block()
    stepper = LateStepper(made.body, made.muscles, made.geometry, device="cpu")
    stepper.longest = longest * DT
    start = BodyState(made.body.mesh.nodes, np.zeros_like(made.body.mesh.nodes))
    end, _, reports = stepper.advance(start, stepper.initial_memory(), hop(made.body, 0), DT)
    assert len(reports) == parts
    assert sum(report.dt for report in reports) == pytest.approx(DT)
    assert end.time == pytest.approx(DT)
    assert [report.converged for report in reports] == [longest > 0.05] * parts
    with one_blas_thread():
        planned = made.step(start, made.initial_memory(), hop(made.body, 0), DT).activations
    assert np.abs(planned).max() > 0.0 and all((report.activations == planned).all() for report in reports)


@pytest.mark.parametrize("planned_well", [True, False])
def test_half_steps_use_the_better_activations(planned_well: bool) -> None:
    """The half steps of a step that does not converge use the planned or the previous activations, whichever give the
    lower objective."""
    made = muscular_block()
    start = BodyState(made.body.mesh.nodes, np.zeros_like(made.body.mesh.nodes))
    with one_blas_thread():
        good = made.step(start, made.initial_memory(), hop(made.body, 0), DT).activations
    assert np.abs(good).max() > 0.0
    planned, last = (good, -good) if planned_well else (-good, good)

    class PlannedStepper(LateStepper):
        longest = 0.6 * DT

        def step(
            self, state: BodyState, memory: WarmStart, objectives: Sequence[AnyObjective], dt: float
        ) -> StepReport:
            return replace(super().step(state, memory, objectives, dt), activations=planned)

    stepper = PlannedStepper(made.body, made.muscles, made.geometry, device="cpu")
    memory = replace(stepper.initial_memory(), activations=last)
    end, after, reports = stepper.advance(start, memory, hop(made.body, 0), DT)
    assert len(reports) == 2 and all((report.activations == good).all() for report in reports)
    assert (after.activations == good).all() and end is reports[-1].state


@pytest.mark.parametrize("infeasible", [0, 1])
def test_a_step_with_an_infeasible_qp_is_planned_about_the_solved_end(
    infeasible: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first plan has the opposite activations. Only if one of its QPs had no solution, a second plan is made, about
    the end that the previous activations cause."""
    stepper, plan, centres = muscular_block(), StepPlanner.plan, []
    start = BodyState(stepper.body.mesh.nodes, np.zeros_like(stepper.body.mesh.nodes))
    memory, wishes = stepper.initial_memory(), hop(stepper.body, 0)
    with one_blas_thread():
        good = stepper.step(start, memory, wishes, DT).activations
        solved = stepper.step_with_activations(start, memory, memory.activations, DT).state.velocities

        def first_is_poor(self: StepPlanner, predicted: PredictedStep, *rest: Any) -> Plan:
            centres.append(predicted)
            made = plan(self, predicted, *rest)
            poor = Plan(-made.activations, predicted.velocities, predicted.forces, made.qp_count, infeasible)
            return poor if len(centres) == 1 else made

        monkeypatch.setattr(StepPlanner, "plan", first_is_poor)
        monkeypatch.setattr(stepping, "REPLAN_FACTOR", np.inf)
        monkeypatch.setattr(stepping, "RESTART_COST", 0.0)
        report = stepper.step(start, memory, wishes, DT)
    assert len(centres) == 1 + infeasible and report.qp_infeasible == infeasible
    assert (report.activations @ good > 0.0) == (infeasible > 0)
    if infeasible:
        assert np.array_equal(centres[1].velocities, solved) and not centres[1].activations.any()


def test_flight_needs_no_qp_contacts_and_keeps_the_parabola() -> None:
    """Eq. (4): in the air there is no contact, and muscles do not move the centre of mass."""
    stepper = muscular_block()
    body = stepper.body
    state = BodyState(body.mesh.nodes + [0, 0, 1.0], np.tile([0.5, 0.0, 1.0], (len(body.mesh.nodes), 1)))
    memory, start = stepper.initial_memory(), body.centre_of_mass(state.positions)
    for i in range(6):
        state, memory, reports = stepper.advance(state, memory, hop(body, i), DT)
        assert all(r.contacts.count == 0 and r.forces.shape == (0, 3) for r in reports)
    discrete = start + 6 * DT * np.array([0.5, 0.0, 1.0]) + 0.5 * DT**2 * 6 * 7 * body.gravity
    assert np.abs(body.centre_of_mass(state.positions) - discrete).max() < 1e-6 * body.height
