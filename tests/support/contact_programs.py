"""Small random contact programs, with few enough contact states to try all of them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from benchmarks.contact_states.complementarity import SEPARATE, ContactLayout
from benchmarks.contact_states.pyramid_program import PyramidProgram
from egs_warp.locomotion.contact_modes import CoulombProgram
from egs_warp.locomotion.solvers import QpSolver, quadratic_program

FRICTION = 0.8


@dataclass(frozen=True)
class SmallProblem:
    """One contact problem with the Coulomb cone and with a friction pyramid; the weight and the unit of speed are 1."""

    coulomb: CoulombProgram
    pyramid: PyramidProgram
    shift: np.ndarray

    def velocities(self, y: np.ndarray) -> np.ndarray:
        """Return the contact velocities (n, 3), normal component first, at the solution ``y``."""
        velocities = (self.coulomb.rows @ self.pyramid.forces_of(y) + self.coulomb.offset).reshape(-1, 3)
        velocities[:, 0] -= self.shift
        return velocities


def small_problem(
    seed: int,
    *,
    contacts: int = 2,
    activations: int = 3,
    directions: int = 4,
    freedoms: int = 8,
    frame: np.ndarray | None = None,
) -> SmallProblem:
    """Build a problem with v = base + R a + J^T f, a random J whose normals have a common component, and a random
    target velocity.

    ``frame`` replaces J.
    """
    rng = np.random.default_rng(seed)
    if frame is None:
        frame = rng.standard_normal((3 * contacts, freedoms))
        frame[0::3, 0] = 2.0
    freedoms = frame.shape[1]
    base = rng.standard_normal(freedoms) - 1.5 * np.eye(freedoms)[0]
    response = np.hstack([rng.standard_normal((freedoms, activations)), frame.T])
    shift = rng.uniform(-0.1, 0.3, contacts)
    target = rng.standard_normal((4, freedoms))
    rows, gap = target @ response, target @ base - rng.standard_normal(4)
    P = 2.0 * rows.T @ rows
    m = np.arange(activations)
    P[m, m] += 1e-3
    offset = frame @ base
    offset[::3] += shift
    coulomb = CoulombProgram(
        *(P, 2.0 * rows.T @ gap, float(gap @ gap), frame @ response, offset, FRICTION),
        *(-np.ones(activations), np.ones(activations)),
    )
    return SmallProblem(coulomb, PyramidProgram.of(coulomb, directions), shift)


def all_states(layout: ContactLayout) -> list[np.ndarray]:
    """Return every combination of the contact states separate, static, slide k and slide between k and k + 1."""
    choices = range(SEPARATE, 2 * layout.directions)
    return [np.array(states) for states in itertools.product(choices, repeat=layout.contacts)]


def optimum_of_each(program: PyramidProgram) -> dict[tuple[int, ...], tuple[float, np.ndarray]]:
    """Return the objective and the solution y of every feasible combination of contact states."""
    qp = quadratic_program(program.P, program.q, program.A, solver=QpSolver.DAQP)
    optima = {}
    for states in all_states(program.layout):
        solution = qp.solve(*program.bounds(states))
        if solution.usable:
            optima[tuple(states)] = (program.objective(solution.x), solution.x)
    return optima
