"""Contact forces for a given Delassus operator: block Gauss-Seidel sweeps compared with a slow reference, and solutions
for anisotropic tangential compliance. ``test_detection.py`` tests Coulomb's law itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from egs_warp.contact import coulomb, newton
from egs_warp.contact.coulomb import coulomb_forces, coulomb_forces_of_worlds
from egs_warp.kernels.contact.coulomb_equations import Contacts, Newton
from egs_warp.motions.script import motion
from egs_warp.pipelines.simulated_run import simulate
from tests.support.creatures import coarse_pawn, sagging
from tests.support.kernels import equations_kernel, sweeps_kernel

COUNT = 5


def problem(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a random contact problem: a Delassus operator (3n, 3n) in which alternately the first or the second
    tangent is nine times as compliant as the other; velocities (3n,), shifts (n,), and initial forces (n, 3)."""
    random = np.random.default_rng(seed)
    soft = np.where(np.arange(COUNT)[:, None] % 2, [1.0, 0.6, 1.8], [1.0, 1.8, 0.6])
    half = random.normal(size=(3 * COUNT, 3 * COUNT + 4)) * soft.reshape(-1, 1)
    start = np.abs(random.normal(size=(COUNT, 3)))
    return half @ half.T, random.normal(size=3 * COUNT), 0.1 * random.normal(size=COUNT), start


def swept_twin(
    delassus: np.ndarray, free: np.ndarray, shift: np.ndarray, friction: float, start: np.ndarray, sweeps: int
) -> np.ndarray:
    """Return the forces (n, 3) after block Gauss-Seidel sweeps: for each contact the normal force that stops the
    approach, then the tangential force, projected onto the cone."""
    f = start.ravel().copy()
    for _ in range(sweeps):
        for n in range(0, 3 * COUNT, 3):
            u = free[n : n + 3] + delassus[n : n + 3] @ f
            change = max(f[n] - (u[0] + shift[n // 3]) / delassus[n, n], 0.0) - f[n]
            softest = max(delassus[n + 1, n + 1], delassus[n + 2, n + 2])
            pull = f[n + 1 : n + 3] - (u[1:] + delassus[n + 1 : n + 3, n] * change) / softest
            f[n] += change
            f[n + 1 : n + 3] = pull * min(1.0, friction * f[n] / max(np.linalg.norm(pull), 1e-300))
    return f.reshape(-1, 3)


@pytest.mark.parametrize("sweeps", [1, 3])
@pytest.mark.parametrize("friction", [0.0, 0.4, 5.0])
def test_sweeps_equal_their_twin(friction: float, sweeps: int) -> None:
    """Eq. (8), (9): the forces equal those of the reference to rounding, for separating, sticking and sliding
    contacts."""
    kinds = set()
    for seed in range(60):
        delassus, free, shift, start = problem(seed)
        forces = wp.array(start.ravel(), dtype=wp.float64, device="cpu")
        given = Contacts()
        given.count, given.friction = len(shift), friction
        arrays = (wp.array(each, dtype=wp.float64, device="cpu") for each in (delassus, free, shift))
        given.delassus, given.free_velocity, given.normal_bias = arrays
        wp.launch(sweeps_kernel, dim=1, inputs=[given, sweeps, forces], device="cpu")
        got = forces.numpy().reshape(-1, 3)
        expected = swept_twin(delassus, free, shift, friction, start, sweeps)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max()))
        slack = friction * got[:, 0] - np.linalg.norm(got[:, 1:], axis=1)
        kinds |= set(np.where(got[:, 0] == 0.0, "free", np.where(slack > 1e-9, "stick", "slide")).tolist())
    assert kinds == {"free", "slide"} | ({"stick"} if friction else set())


@pytest.mark.parametrize("links", [0, 1, 7])
def test_equations_of_hardly_coupled_bodies_are_solved(links: int) -> None:
    """The elimination skips blocks of zeros: the step solves the equations of three bodies whose contacts are coupled
    through the last ``links`` rows and columns only."""
    random, sizes = np.random.default_rng(links), (21, 37, 18)
    unknowns, matrix = sum(sizes) + links, np.zeros((sum(sizes) + links,) * 2)
    for first, size in zip(np.cumsum((0, *sizes)), sizes, strict=False):
        matrix[first : first + size, first : first + size] = random.normal(size=(size, size))
    matrix[sum(sizes) :] = random.normal(size=(links, unknowns))
    matrix[:, sum(sizes) :] = random.normal(size=(unknowns, links))
    right = random.normal(size=unknowns)
    padded = np.zeros((unknowns, (unknowns + 4) // 4 * 4))
    padded[:, :unknowns], padded[:, unknowns] = matrix, right
    workspace = Newton()
    workspace.matrix = wp.array(padded.reshape(unknowns, -1, 4), dtype=wp.vec4d, device="cpu")
    workspace.unknowns = wp.array(np.arange(unknowns), dtype=int, device="cpu")
    workspace.pivots, workspace.step = (wp.zeros(unknowns, dtype=kind, device="cpu") for kind in (int, wp.float64))
    wp.launch(equations_kernel, dim=1, inputs=[unknowns, workspace], device="cpu")
    expected = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(workspace.step.numpy(), expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("friction", [0.0, 0.4, 1.5])
def test_solutions_obey_coulombs_law_for_different_tangents(friction: float) -> None:
    """Eq. (8), (9): for any initial forces, complementarity holds to 1e-9, forces are within the friction cone, and
    friction is opposite to the slip."""
    for seed in range(6):
        delassus, free, shift, start = problem(seed)
        forces, size = coulomb_forces(delassus, free, shift, friction, start)
        speed = (free + delassus @ forces.ravel()).reshape(-1, 3)
        normal = speed[:, 0] + shift
        assert size < 1e-9 and forces[:, 0].min() >= 0.0 and normal.min() > -1e-9
        assert np.abs(forces[:, 0] * normal).max() < 1e-8
        pull, slip = np.linalg.norm(forces[:, 1:], axis=1), np.linalg.norm(speed[:, 1:], axis=1)
        assert (pull <= friction * forces[:, 0] * (1.0 + 1e-9) + 1e-12).all()
        sliding = slip > 1e-6
        np.testing.assert_allclose(pull[sliding], friction * forces[sliding, 0], atol=1e-8)
        along = (forces[:, 1:] * speed[:, 1:]).sum(axis=1)
        np.testing.assert_allclose(along[sliding], -(pull * slip)[sliding], atol=1e-7)


def test_nan_problems_return_the_initial_forces() -> None:
    """If the problem contains a NaN, the residual is infinite and the initial normal forces are returned."""
    delassus, free, shift, start = problem(0)
    free[4] = np.nan
    forces, size = coulomb_forces(delassus, free, shift, 0.5, start)
    assert size == np.inf and np.array_equal(forces[:, 0], start[:, 0])


def test_batched_problems_have_the_bits_of_single_ones() -> None:
    """The result depends neither on the capacity of the arrays nor on the contents of their padding."""
    counts, room, frictions = [5, 3, 0], 7, np.array([0.4, 1.5, 0.8])
    random = np.random.default_rng(3)
    delassus, free = random.normal(size=(3, 3 * room, 3 * room)), random.normal(size=(3, 3 * room))
    shifts, starts = random.normal(size=(3, room)), random.normal(size=(3, room, 3))
    alone = []
    for world, count in enumerate(counts):
        given = problem(world)
        part = (given[0][: 3 * count, : 3 * count], given[1][: 3 * count], given[2][:count], given[3][:count])
        delassus[world, : 3 * count, : 3 * count], free[world, : 3 * count] = part[:2]
        shifts[world, :count], starts[world, :count] = part[2:]
        alone.append(coulomb_forces(*part[:3], frictions[world], part[3]))
    together = (torch.from_numpy(each) for each in (delassus, free, shifts, frictions, starts))
    forces, missed = coulomb_forces_of_worlds(torch.tensor(counts, dtype=torch.int32), *together)
    for world, count in enumerate(counts):
        assert np.array_equal(forces[world, :count].numpy(), alone[world][0])
        assert float(missed[world]) == alone[world][1]
        assert np.array_equal(forces[world, count:].numpy(), starts[world, count:])


def test_batched_problems_at_the_iteration_limit_have_the_bits_of_single_ones() -> None:
    """For 20 sticking points with 30 degrees of freedom, some problems are not solved within the iteration limit. Even
    the results of these problems in a batch are bitwise equal to those of single solves."""
    count, friction, problems = 20, 1.5, []
    for seed in range(40):
        random = np.random.default_rng(seed)
        half = random.normal(size=(3 * count, 30))
        free, shift = random.normal(size=3 * count), 0.1 * random.normal(size=count)
        start = np.abs(random.normal(size=(count, 3)))
        problems.append((half @ half.T + 1e-7 * np.eye(3 * count), free, shift, start))
    delassus, free, shifts, starts = (torch.from_numpy(np.stack(each)) for each in zip(*problems, strict=True))
    counts, frictions = torch.full((40,), count, dtype=torch.int32), torch.full((40,), friction, dtype=torch.float64)
    forces, missed = coulomb_forces_of_worlds(counts, delassus, free, shifts, frictions, starts)
    alone = [coulomb_forces(matrix, u, shift, friction, start) for matrix, u, shift, start in problems]
    assert np.array_equal(forces.numpy(), np.stack([one for one, _ in alone]))
    assert missed.tolist() == [size for _, size in alone] and 5 < (missed > 1e-9).sum() < 35


@pytest.mark.cuda
@pytest.mark.parametrize("friction", [0.0, 0.4, 5.0])
def test_a_thread_block_finds_the_forces_of_a_single_thread(friction: float) -> None:
    """Compare a thread block with a single thread, for full and partial groups of contacts and for numbers of unknowns
    that do and do not fit into one pass."""
    counts, room = [1, 4, 5, 6, 11, 33, 40, 45, 64, 65, 70], 70
    random = np.random.default_rng(1)
    delassus, free = np.zeros((len(counts), 3 * room, 3 * room)), random.normal(size=(len(counts), 3 * room))
    shifts, starts = 0.1 * random.normal(size=(len(counts), room)), np.abs(random.normal(size=(len(counts), room, 3)))
    for world, count in enumerate(counts):
        half = random.normal(size=(3 * count, 3 * count + 4))
        delassus[world, : 3 * count, : 3 * count] = half @ half.T
    frictions = np.full(len(counts), friction)
    given = [torch.from_numpy(each) for each in (delassus, free, shifts, frictions, starts)]
    numbers = torch.tensor(counts, dtype=torch.int32)
    one, _ = coulomb_forces_of_worlds(numbers, *given)
    block, missed = coulomb_forces_of_worlds(numbers.cuda(), *(each.cuda() for each in given))
    assert float(missed.max()) < 1e-9
    np.testing.assert_allclose(block.cpu().numpy(), one.numpy(), rtol=0, atol=1e-9 * float(one.abs().max()))


@pytest.mark.cuda
@pytest.mark.parametrize("friction", [0.0, 0.4, 5.0])
def test_a_thread_block_finds_the_forces_of_many_loaded_contacts(friction: float) -> None:
    """The numbers of unknowns exceed the capacity of one pass. They result in full and partial passes and tiles, more
    unknowns than all passes hold, and more contacts than one block sweeps."""
    counts, room = [41, 42, 43, 50, 53, 62, 64, 65, 80, 85, 86, 100, 130], 130
    random = np.random.default_rng(4)
    delassus, free = np.zeros((len(counts), 3 * room, 3 * room)), random.normal(size=(len(counts), 3 * room))
    free[:, ::3] -= 3.0
    shifts, starts = 0.1 * random.normal(size=(len(counts), room)), np.abs(random.normal(size=(len(counts), room, 3)))
    for world, count in enumerate(counts):
        half = random.normal(size=(3 * count, 12 * count))
        delassus[world, : 3 * count, : 3 * count] = half @ half.T / (12 * count)
    frictions = np.full(len(counts), friction)
    given = [torch.from_numpy(each) for each in (delassus, free, shifts, frictions, starts)]
    numbers = torch.tensor(counts, dtype=torch.int32)
    one, _ = coulomb_forces_of_worlds(numbers, *given)
    block, missed = coulomb_forces_of_worlds(numbers.cuda(), *(each.cuda() for each in given))
    assert float(missed.max()) < 1e-12
    for world, count in enumerate(counts):
        expected, got = one[world, :count].numpy(), block[world, :count].cpu().numpy()
        assert (expected[:, 0] > 0.0).mean() > 0.9
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_many_points_under_a_soft_base_are_solved_from_rest() -> None:
    """25 points with 12 degrees of freedom, regularised as in a step, are under normal, tangential and rotational load.
    The equations hold, and the sum of all forces is bounded."""
    random = np.random.default_rng(2)
    place = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 5), np.linspace(-1.0, 1.0, 5)), axis=-1).reshape(-1, 2)
    corners = np.stack([(1 - place[:, 0]) * (1 - place[:, 1]), (1 + place[:, 0]) * (1 - place[:, 1])], axis=1)
    corners = 0.25 * np.hstack([corners, np.stack([(1 - place[:, 0]), (1 + place[:, 0])], axis=1) * (1 + place[:, 1:])])
    rows = np.kron(corners, np.eye(3))
    half = random.normal(size=(12, 12))
    delassus = rows @ (half @ half.T + np.eye(12)) @ rows.T
    delassus[np.diag_indices_from(delassus)] += 1e-7 * delassus.diagonal().mean()
    for _ in range(40):
        free = rows @ (random.normal(size=12) + np.tile([-1.0, 0.3, 0.0], 4))
        forces, size = coulomb_forces(delassus, free, np.zeros(25), 0.5, np.zeros((25, 3)))
        assert size < 1e-10 and np.abs(forces).sum() < 1e3


def test_earlier_problems_do_not_change_the_result() -> None:
    """The solver reuses its workspace: after a problem with NaN, and after one that used all attempts, results are
    bitwise equal to earlier ones."""
    delassus, free, shift, start = problem(1)
    expected, missed = coulomb_forces(delassus, free, shift, 0.4, start)
    assert missed < 1e-10 and np.abs(expected).max() > 0.1
    for other in (np.full_like(delassus, np.nan), np.zeros_like(delassus), -delassus):
        coulomb_forces(other, free, shift, 0.7, start)
        got, again = coulomb_forces(delassus, free, shift, 0.4, start)
        assert np.array_equal(got, expected) and again == missed


def test_more_points_than_nodes_are_solved_by_continuation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The problems come from the first step of a jump on 32 points of a coarse foot. The Newton kernel alone does
    not converge from the current forces; continuation from compliant contacts does, also for many worlds.
    """
    creature = sagging(coarse_pawn())
    first = simulate(creature, motion("jump"), frames=2).simulation.reports[0]
    problems: list[tuple[Any, ...]] = []

    def recorded(*given: Any) -> tuple[np.ndarray, float]:
        problems.append(given)
        return coulomb_forces(*given)

    monkeypatch.setattr(newton, "coulomb_forces", recorded)
    stepper = creature.stepper
    report = stepper.step_with_activations(creature.start, stepper.initial_memory(), first.activations, first.dt)
    assert report.converged and len(problems) > 1
    monkeypatch.setattr(coulomb, "REGULARIZATION_STEPS", ())
    alone = [coulomb_forces(*given)[1] for given in problems]
    monkeypatch.undo()
    together = [coulomb_forces(*given) for given in problems]
    assert max(alone) > 1e-5 and max(missed for _, missed in together) < 1e-12
    delassus, free, shift, friction, start = (np.stack(each) for each in zip(*problems, strict=True))
    many, missed = coulomb_forces_of_worlds(
        torch.full((len(start),), start.shape[1], dtype=torch.int32),
        *(torch.from_numpy(each) for each in (delassus, free, shift, friction, start)),
    )
    assert float(missed.max()) < 1e-12
    for world, (forces, _) in enumerate(together):
        np.testing.assert_allclose(delassus[world] @ (many[world].numpy() - forces).ravel(), 0.0, atol=1e-9)
