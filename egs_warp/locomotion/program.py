"""The condensed problem of one step (Eq. 13): its cost, its rows and the linear response behind both.

See docs/concepts/locomotion.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from egs_warp.contact.detection import ContactSet, push_out_speeds, tangent_directions
from egs_warp.fem.implicit_step import ImplicitStep
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.complementarity import ContactLayout
from egs_warp.locomotion.objectives import Objective, SpinObjective
from egs_warp.muscles.tension import MuscleTension


@dataclass(frozen=True)
class ContactProgram:
    """min 1/2 y^T P y + q^T y + constant over y = (a, f_n, f_t, lambda), subject to the pairs of Eq. (9).

    Rows A y + offset are ``ContactLayout``'s; only their bounds depend on the contact states. Units: activations in
    their bounds, forces in body weights, speeds in sqrt(g H).
    """

    layout: ContactLayout
    friction: float
    P: np.ndarray
    """(variables, variables)."""
    q: np.ndarray
    """(variables,)."""
    constant: float
    """Makes the objective the sum of weighted squares that was asked for: never negative."""
    A: np.ndarray
    """(rows, variables)."""
    offset: np.ndarray
    """(rows,)."""
    reachable: tuple[np.ndarray, np.ndarray] | None = None
    """Two (M,): bounds of the activations, if not -1 and 1."""

    def bounds(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of A y for contact states (n,)."""
        lower, upper = self.layout.bounds(states)
        if self.reachable is not None:
            lower[: self.layout.activations], upper[: self.layout.activations] = self.reachable
        return lower - self.offset, upper - self.offset

    def pairs(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(pairs,) x and w of Eq. (9) at ``y``."""
        rows = self.A @ y + self.offset
        return rows[self.layout.activations : self.layout.variables], rows[self.layout.variables :]

    def objective(self, y: np.ndarray) -> float:
        """Value at ``y``."""
        return float(0.5 * y @ self.P @ y + self.q @ y + self.constant)

    def contact_forces(self, y: np.ndarray) -> np.ndarray:
        """(n, 3) body weights: normal and two tangents."""
        layout = self.layout
        tangent = y[layout.tangent].reshape(layout.contacts, layout.directions) @ tangent_directions(layout.directions)
        return np.column_stack([np.maximum(y[layout.normal], 0.0), tangent])


@dataclass(frozen=True)
class LinearResponse:
    """v = base + response y, linearised at the prediction (docs/concepts/locomotion.md)."""

    base: np.ndarray
    """(3N,) m/s without muscles and contact."""
    response: np.ndarray
    """(3N, variables)."""


@dataclass(frozen=True)
class CostScales:
    """What the cost is measured in."""

    speed: float
    """sqrt(g H), m/s."""
    activation: np.ndarray
    """(M,) weights of a^2, a in its bounds."""
    activation_change: np.ndarray
    """(M,) weights of the squared change of a since the last step."""


def linear_response(
    step: ImplicitStep,
    actuation: np.ndarray,
    contacts: ContactSet,
    velocities: np.ndarray,
    layout: ContactLayout,
    tension: MuscleTension,
) -> LinearResponse:
    """(S + dt^2 K_a) v = M v0 + dt (f + A a + W^T f_c) around p + dt ``velocities`` (N, 3).

    ``actuation`` (3N, M): newtons at full activation, in the directions at p + dt ``velocities``; K_a is the stiffness
    of the muscles at the last step's ``tension``.
    """
    body, dt = step.body, step.dt
    solve = step.tangent(velocities, tension)
    residual = step.gradient(velocities, body.node_mass[:, None] * body.gravity)
    weights = body.weight * contacts.frame.T.toarray()
    sources = np.hstack([dt * actuation, dt * weights, residual.reshape(-1, 1)])
    solved = solve(sources)
    base, solved = velocities.ravel() - solved[:, -1], solved[:, :-1]
    contact = solved[:, layout.activations :].reshape(len(base), contacts.count, 3)
    tangent = np.einsum("vnt,dt->vnd", contact[:, :, 1:], tangent_directions(layout.directions))
    response = np.concatenate(
        [
            solved[:, : layout.activations],
            contact[:, :, 0],
            tangent.reshape(len(base), layout.contacts * layout.directions),
            np.zeros((len(base), contacts.count)),
        ],
        axis=1,
    )
    return LinearResponse(base, response)


def contact_program(
    step: ImplicitStep,
    linear: LinearResponse,
    contacts: ContactSet,
    layout: ContactLayout,
    objectives: Sequence[Objective | SpinObjective],
    previous: np.ndarray,
    *,
    friction: float,
    push_out_cap: float,
    scales: CostScales,
) -> ContactProgram:
    """The problem of one step; ``previous`` (M,) activations in their bounds, ``push_out_cap`` m/s."""
    moments = _moment_rows(step, contacts, layout)
    shift = push_out_speeds(contacts.gaps, step.dt, push_out_cap)
    return program_of(
        step, linear, contacts.frame, shift, moments, layout, objectives, previous, friction=friction, scales=scales
    )


def program_of(
    step: ImplicitStep | StepProblem,
    linear: LinearResponse,
    frame: sparse.csr_matrix,
    shift: np.ndarray,
    moments: np.ndarray,
    layout: ContactLayout,
    objectives: Sequence[Objective | SpinObjective],
    previous: np.ndarray,
    *,
    friction: float,
    scales: CostScales,
) -> ContactProgram:
    """The problem of one step for contacts whose velocities are ``frame`` (3n, 3N) v and whose normal measure has the
    constant ``shift`` (n,) m/s; ``moments`` (3, variables) is the change of angular momentum that each unknown
    makes.
    """
    P, q, constant = _quadratic_cost(step, linear, moments, objectives, layout, previous, scales)
    A, offset = contact_rows(linear, frame, shift, layout, friction, scales.speed)
    return ContactProgram(layout, friction, P, q, constant, A, offset)


def _moment_rows(step: ImplicitStep, contacts: ContactSet, layout: ContactLayout) -> np.ndarray:
    """(3, variables) change of angular momentum over the step, arms at its start, for each unknown."""
    positions = step.state.positions
    points = np.einsum("nw,nwi->ni", contacts.weights, positions[contacts.nodes])
    arms = points - step.body.centre_of_mass(positions)
    torques = step.dt * step.body.weight * np.cross(arms[:, None, :], contacts.axes)
    rows = np.zeros((3, layout.variables))
    rows[:, layout.normal] = torques[:, 0].T
    tangent = np.einsum("nti,dt->ndi", torques[:, 1:], tangent_directions(layout.directions))
    rows[:, layout.tangent] = tangent.reshape(layout.contacts * layout.directions, 3).T
    return rows


def _quadratic_cost(
    step: ImplicitStep | StepProblem,
    linear: LinearResponse,
    moments: np.ndarray,
    objectives: Sequence[Objective | SpinObjective],
    layout: ContactLayout,
    previous: np.ndarray,
    scales: CostScales,
) -> tuple[np.ndarray, np.ndarray, float]:
    body, state = step.body, step.state
    P = 1e-7 * np.eye(layout.variables)
    q = np.zeros(layout.variables)
    constant = float(scales.activation_change @ previous**2)
    for objective in objectives:
        if isinstance(objective, SpinObjective):
            gyration = np.sqrt(0.5 * np.trace(body.inertia(state.positions)) / body.mass)
            unit = body.mass * gyration * scales.speed
            rows = moments / unit
            gap = (body.angular_momentum(state.positions, state.velocities) - objective.target) / unit
        else:
            rows = (objective.rows @ linear.response) / scales.speed
            gap = (objective.rows @ linear.base - objective.target) / scales.speed
        P += 2.0 * objective.weight * rows.T @ rows
        q += 2.0 * objective.weight * rows.T @ gap
        constant += objective.weight * float(gap @ gap)
    m = np.arange(layout.activations)
    P[m, m] += 2.0 * (scales.activation + scales.activation_change)
    q[m] -= 2.0 * scales.activation_change * previous
    return P, q, constant


def contact_rows(
    linear: LinearResponse,
    frame: sparse.csr_matrix | np.ndarray,
    shift: np.ndarray,
    layout: ContactLayout,
    friction: float,
    speed_scale: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows A y + offset of ``ContactLayout``: y itself, then c, D^T u' + E lambda and mu f_n - E^T f_t (Eq. 9).

    ``shift`` (n,) m/s is the constant of the normal measure c.
    """
    n, nd = layout.contacts, layout.directions
    speed = (frame @ linear.response).reshape(n, 3, layout.variables) / speed_scale
    base = (frame @ linear.base).reshape(n, 3) / speed_scale
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
