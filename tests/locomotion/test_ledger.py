"""Energy balance, which closes to rounding unless one of its terms or a value of the file is wrong."""

from __future__ import annotations

import ast
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion import ledger as module
from egs_warp.locomotion.ledger import FLOWS, STORED, EnergyBalance, EnergyTotals, energy_balance
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.muscles.tension import MuscleEnergy, force_length_factor
from tests.support.slides import slide
from tests.support.stances import DT

CLOSES = 1e-6
"""Maximum residual of a step, in m g H."""
IDLE = {"spin_after", "push_out", "joints"}
"""Names of flows that are zero in the slide."""


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return slide(struck=True).trajectory()


@pytest.fixture(scope="module")
def books(trajectory: Trajectory) -> EnergyBalance:
    return energy_balance(trajectory)


def worst(books: EnergyBalance) -> float:
    return float(np.abs(books.residual).max())


def test_every_step_closes(books: EnergyBalance) -> None:
    assert len(books.residual) >= 24 and worst(books) < 1e-9


def test_each_flow_counts(books: EnergyBalance) -> None:
    """If any flow is changed by 10 %, the bound is violated; flows that do not occur in the slide are zero."""
    for flow in FLOWS:
        values = getattr(books, flow)
        if flow in IDLE:
            assert np.abs(values).max() < 1e-8 * books.energy_unit, flow
        else:
            assert worst(replace(books, **{flow: 1.1 * values})) > CLOSES, flow


@dataclass(frozen=True)
class PartlyInside(StepProblem):
    """Step problem that restores only a fraction ``share`` of the lost spin within the step."""

    share: float = 0.0

    def momentum_correction(self, internal_gradient: np.ndarray) -> np.ndarray:
        """Return the part (3,) of the momentum correction that acts within the step, rad/s."""
        return self.share * super().momentum_correction(internal_gradient)


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_spin_added_after_a_step_counts(trajectory: Trajectory, share: float) -> None:
    """A block spins in the air. Of the spin that implicit Euler loses, a part is restored within the step and the rest
    at its end."""
    body, positions = slide().stepper.body, trajectory.positions[0]
    state = BodyState(positions, np.cross([3.0, -2.0, 5.0], positions - body.centre_of_mass(positions)))
    problem = PartlyInside(body, state, DT, trajectory.drag, share)
    velocities, factors = problem.rigid_guess, MultifrontalLdl(body.assembly.upper_pattern)
    for _ in range(40):
        change = problem.tangent(factors, velocities, None).solve(problem.residual(velocities, None).ravel())
        velocities = velocities - change.reshape(velocities.shape)
    assert np.linalg.norm(problem.residual(velocities, None)) < 1e-11 * problem.residual_scale
    end = problem.end_positions(velocities)
    whole = StepProblem.momentum_correction(problem, problem.internal_gradient(velocities, None))
    added = np.linalg.solve(body.inertia(end), (1.0 - share) * problem.inertia @ whole)
    after = velocities + np.cross(added, end - body.centre_of_mass(end))
    step = one_step(trajectory, [positions, end], [state.velocities, after])
    books = energy_balance(step)
    assert worst(books) < 1e-9
    assert worst(replace(books, spin_after=1.1 * books.spin_after)) > CLOSES
    assert (np.abs(books.spin_inside).max() < 1e-9 * books.energy_unit) == (share == 0.0)


def one_step(
    trajectory: Trajectory, positions: list[np.ndarray], velocities: list[np.ndarray], activations: float = 0.0
) -> Trajectory:
    """Return the trajectory of one step in the air between two states, with all muscles at ``activations`` m."""
    of_others = [name for name in vars(trajectory) if name.startswith(("contact_", "kick_"))]
    nothing = {name: getattr(trajectory, name)[:0] for name in of_others}
    return replace(
        trajectory,
        **nothing,
        time=np.array([0.0, DT]),
        dt=np.array([DT]),
        positions=np.stack(positions),
        velocities=np.stack(velocities),
        activations=np.full_like(trajectory.activations[:1], activations),
    )


@pytest.mark.parametrize("height", [0.65, 0.5, 0.32])
def test_muscles_that_lose_their_tension_count(trajectory: Trajectory, height: float) -> None:
    """A block is compressed so that muscle segments become shorter than 0.7 or 0.3 of their rest length, between which
    the tension depends on the length."""
    stepper = slide().stepper
    body, muscles = stepper.body, stepper.muscles
    positions = body.mesh.nodes * [1.0, 1.0, height] + [0.0, 0.0, 1.0]
    state = BodyState(positions, np.array([0.2, 0.1, 1.5 * (1.0 - height)]) * -body.mesh.nodes)
    tension = MuscleEnergy.of(muscles, np.full(muscles.segment_count, 0.02))
    problem = StepProblem(body, state, DT, trajectory.drag)
    velocities, factors = problem.rigid_guess, MultifrontalLdl(body.assembly.upper_pattern)
    for _ in range(40):
        change = problem.tangent(factors, velocities, tension).solve(problem.residual(velocities, tension).ravel())
        velocities = velocities - change.reshape(velocities.shape)
    assert np.linalg.norm(problem.residual(velocities, tension)) < 1e-10 * problem.residual_scale
    end = problem.end_positions(velocities)
    lengths = np.stack([muscles.lengths(positions), muscles.lengths(end)]) / muscles.rest_lengths
    assert (((lengths > 0.3) & (lengths < 0.7)).any(axis=0) & (np.ptp(lengths, axis=0) > 0.01)).any()
    books = energy_balance(one_step(trajectory, [positions, end], [state.velocities, velocities], 0.02))
    assert worst(books) < 1e-9
    for flow in ("muscles", "lost_muscle"):
        assert worst(replace(books, **{flow: 1.1 * getattr(books, flow)})) > CLOSES, flow


def test_the_work_of_a_push_is_the_kinetic_energy_that_it_adds(trajectory: Trajectory, books: EnergyBalance) -> None:
    """The work is the sum of m |v0 + k|^2 / 2 - m |v0|^2 / 2 over the nodes, for a blow on one side and wind at
    once."""
    assert trajectory.kick_step.tolist() == list(range(8, 24)) and (books.pushes[:8] == 0.0).all()
    mass, before = trajectory.node_mass, trajectory.velocities[8]
    after = before + trajectory.kick_velocity[0]
    gained = 0.5 * mass @ (after**2).sum(axis=1) - 0.5 * mass @ (before**2).sum(axis=1)
    assert books.pushes[8] == pytest.approx(gained, rel=1e-10)


def test_totals_of_a_run_close(books: EnergyBalance) -> None:
    """In units of m g H, the change of energy is the sum of all flows; peaks are the maxima over all states."""
    sums = EnergyTotals.of(books)
    assert sums.unit_joules == books.energy_unit and set(sums.flows) == set(FLOWS)
    assert sums.change == pytest.approx(sum(sums.flows.values()), abs=1e-8)
    assert abs(sums.change) > 1e-3
    for peak, energies in (
        (sums.peak_elastic, books.elastic),
        (sums.peak_deformation, books.kinetic_deformation),
        (sums.muscle_work, [books.muscle_work.sum()]),
    ):
        assert peak * books.energy_unit == pytest.approx(max(energies)) and peak > 1e-6
    assert sums.worst_residual == books.max_residual < 1e-9


def test_each_stored_energy_counts(books: EnergyBalance) -> None:
    for energy in STORED:
        assert worst(replace(books, **{energy: 1.01 * getattr(books, energy)})) > CLOSES, energy


@pytest.mark.parametrize(
    "number",
    [
        "young_modulus",
        "poisson_ratio",
        "damping_time",
        "drag",
        "gravity",
        "node_mass",
        "muscle_stiffness",
        "activations",
        "contact_force",
        "kick_velocity",
        "dt",
    ],
)
def test_an_error_in_any_stored_value_is_detected(trajectory: Trajectory, number: str) -> None:
    """In each case, one value is increased by 1 %."""
    wrong = replace(trajectory, **{number: 1.01 * getattr(trajectory, number)})
    assert worst(energy_balance(wrong)) > CLOSES


def test_inconsistent_velocities_are_detected(trajectory: Trajectory) -> None:
    """An added expansion at 0.1 / s has no momentum; the balance does not count it as added spin and fails to close."""
    velocities = trajectory.velocities.copy()
    middle = trajectory.positions[10] - trajectory.node_mass @ trajectory.positions[10] / trajectory.node_mass.sum()
    velocities[10] += 0.1 * middle
    assert worst(energy_balance(replace(trajectory, velocities=velocities))) > CLOSES


def test_signs_are_those_of_physics(books: EnergyBalance) -> None:
    """Damping, drag, friction, contact and the inertia loss of implicit Euler do not add energy beyond the residual of
    the contact solver."""
    for flow in ("damping", "drag", "friction", "contact", "lost_inertia"):
        assert (getattr(books, flow) <= 1e-8 * books.energy_unit).all(), flow
    assert (books.push_out >= 0.0).all() and (books.muscle_work >= books.muscles - 1e-12 * books.energy_unit).all()


def test_stored_energies_are_those_of_the_body(trajectory: Trajectory, books: EnergyBalance) -> None:
    """The stored energies equal the solver's own sum, which the energy balance does not use."""
    body = slide().stepper.body
    theirs = [body.mechanical_energy(x, v) for x, v in zip(trajectory.positions, trajectory.velocities, strict=True)]
    assert books.stored == pytest.approx(theirs, rel=1e-10)


@pytest.mark.parametrize("crushed", [0.5, 0.02, 1e-4])
def test_the_loss_of_a_step_is_exact_for_crushed_elements(crushed: float) -> None:
    """The loss is Psi(F0) - Psi(F1) + P(F1) : (F1 - F0), with energy and stress of one element written out (Eq. 5),
    even if the straight path between the two states would invert the element."""
    mu, lam = 3.0, 7.0
    element = module._Elements(np.zeros((1, 4), int), np.eye(3)[None], np.ones(1), mu, lam, 0.0)
    turn = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    before, after = np.diag([1.1, 0.9, 1.0]), np.diag([1.0, 1.0, crushed])

    def energy(F: np.ndarray) -> float:
        log_j = np.log(np.linalg.det(F))
        return 0.5 * mu * ((F * F).sum() - 3.0) - mu * log_j + 0.5 * lam * log_j**2

    for start in (before, turn @ before):
        log_j = np.log(np.linalg.det(after))
        stress = mu * after + (lam * log_j - mu) * np.linalg.inv(after).T
        expected = energy(start) - energy(after) + (stress * (after - start)).sum()
        change = (after - start)[None]
        got = element._remainder(change, np.linalg.inv(after)[None] @ change, np.array([log_j]))
        assert got[0] == pytest.approx(expected, rel=1e-9)


def test_the_energy_balance_shares_no_code_with_the_solver() -> None:
    """The modules of the energy balance import only NumPy, SciPy and the trajectory, not the code of bodies, muscles or
    contact."""
    for path in (Path(module.__file__), Path(module.__file__).with_name("audit.py")):
        own = {"egs_warp.locomotion.trajectory", "egs_warp.locomotion.ledger", "egs_warp.short_repr"}
        assert imported(path) <= {"numpy", "scipy"} | own
    rooms = {name.split(".")[1] for name in imported(Path(module.__file__).with_name("trajectory.py")) if "." in name}
    assert rooms <= {"checked_calls", "geometry", "io", "short_repr"}


def imported(path: Path) -> set[str]:
    """Return the imported modules that are not in the standard library."""
    nodes = ast.walk(ast.parse(path.read_text()))
    names = {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    nodes = ast.walk(ast.parse(path.read_text()))
    names |= {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return {name for name in names if name.split(".")[0] in ("numpy", "scipy", "warp", "egs_warp")}


def test_the_work_of_a_shortened_muscle_is_an_integral() -> None:
    """The closed form in the energy balance equals the result of the midpoint rule, for lengths from zero to 1.2 rest
    lengths."""
    count, rest = 4800, 0.5
    lengths = 1.2 * rest * np.arange(count + 1) / count
    middles = 0.5 * (lengths[1:] + lengths[:-1]) / rest
    summed = np.append(0.0, np.cumsum(force_length_factor(middles)[0] * np.diff(lengths)))
    muscles = module._Muscles(*[np.zeros(0)] * 5, rest_lengths=np.full(count + 1, rest))
    np.testing.assert_allclose(muscles._pulled(lengths), summed, atol=1e-7)
