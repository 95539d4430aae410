"""QP of a step with the activations as its only unknowns, under exact Coulomb contact, and the search over contact
modes (Eq. 9, 13).

Contact forces are a function of the activations that is affine in each region of fixed contact modes. ``search_modes``
solves one QP in each region that it visits; ``device_search`` runs the same search in one kernel. See
docs/concepts/locomotion.md#modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import get_lapack_funcs

from egs_warp.contact.coulomb import coulomb_forces, regularized
from egs_warp.kernels.locomotion import mode_region as kernels
from egs_warp.locomotion.solvers import QpSolver, quadratic_program

FREE, STICK, SLIDE = kernels.FREE, kernels.STICK, kernels.SLIDE
_getrf, _getrs = get_lapack_funcs(("getrf", "getrs"), dtype=np.float64)
_MIN_PIVOT = 1e-14
"""Minimum pivot of the equations for the contact forces, as a fraction of their largest pivot."""


@dataclass(frozen=True)
class CoulombProgram:
    """Problem min 1/2 x^T P x + q^T x + constant over x = (a, f), where f are the exact Coulomb forces for the
    activations a.

    Activations are fractions of their bounds, forces are in body weights (for each contact normal, then two tangential
    components), speeds in sqrt(g H). Contact velocities are ``rows`` x + ``offset``; their normal components include
    the velocity bias.
    """

    P: np.ndarray
    """(m + 3n, m + 3n) Hessian of the objective."""
    q: np.ndarray
    """(m + 3n,) linear term of the objective."""
    constant: float
    """Constant term of the objective."""
    rows: np.ndarray
    """(3n, m + 3n) derivative of the contact velocities with respect to x."""
    offset: np.ndarray
    """(3n,) contact velocities at x = 0."""
    friction: float
    """Coulomb coefficient mu."""
    lower: np.ndarray
    """(m,) lower bounds of the activations."""
    upper: np.ndarray
    """(m,) upper bounds of the activations."""

    @property
    def activation_count(self) -> int:
        """Number of activations m."""
        return len(self.lower)

    @property
    def contact_count(self) -> int:
        """Number of contacts n."""
        return len(self.offset) // 3

    def objective(self, x: np.ndarray) -> float:
        """Return the objective at ``x`` (m + 3n,), with the constant."""
        return float(0.5 * x @ self.P @ x + self.q @ x + self.constant)

    def contact_response(self, activations: np.ndarray, guess: np.ndarray) -> np.ndarray:
        """Return x = (a, f(a)), (m + 3n,), for ``activations`` a (m,). The Coulomb solve starts from the forces
        ``guess`` (n, 3)."""
        m, n = self.activation_count, self.contact_count
        operator = regularized(self.rows[:, m:], kernels.DELASSUS_REGULARIZATION)
        free = self.offset + self.rows[:, :m] @ activations
        forces, _ = coulomb_forces(operator, free, np.zeros(n), self.friction, guess)
        return np.concatenate([activations, forces.ravel()])


@dataclass(frozen=True)
class PredictedContact:
    """Predicted contact of a step (Eq. 12) in the units of the QP."""

    activations: np.ndarray
    """(M,) muscle activations, as fractions of their bounds."""
    forces: np.ndarray
    """(n, 3) contact forces in body weights: normal and two tangential components of each contact."""
    velocities: np.ndarray
    """(n, 3) in sqrt(g H), contact velocities at the predicted end."""


@dataclass(frozen=True)
class ContactModes:
    """Contact mode of each contact: free, stick, or slide in a direction."""

    kind: np.ndarray
    """(n,) ``FREE``, ``STICK`` or ``SLIDE``."""
    slip: np.ndarray
    """(n, 2) unit vectors, directions of motion of the sliding contacts."""

    @classmethod
    def of(cls, forces: np.ndarray, friction: float) -> ContactModes:
        """Return the modes of ``forces`` (n, 3), in body weights, that satisfy Coulomb's law."""
        tangential = np.linalg.norm(forces[:, 1:], axis=1)
        touching = forces[:, 0] > kernels.ZERO_FORCE
        sliding = touching & (tangential >= kernels.CONE_FRACTION * friction * forces[:, 0])
        kind = np.where(sliding, SLIDE, np.where(touching, STICK, FREE))
        return cls(kind, _unit(-forces[:, 1:]))


@dataclass(frozen=True)
class ModeRegionOptimum:
    """Optimum of the QP of one mode region."""

    x: np.ndarray
    """(m + 3n,) activations and contact forces (a, f), as in ``CoulombProgram``."""
    objective: float
    """Objective at ``x``."""
    contact: np.ndarray
    """(k,) contact of each active mode constraint with a significant multiplier."""
    transition: np.ndarray
    """(k,) transition that the contact makes beyond the constraint, as in ``ModeRegion``."""
    multiplier: np.ndarray
    """(k,) multiplier of the constraint, which is positive."""


@dataclass(frozen=True)
class ModeSearchResult:
    """Best point of a mode search."""

    x: np.ndarray | None
    """(m + 3n,) activations and contact forces (a, f); None if no QP had a solution."""
    objective: float
    """Objective at ``x``; infinite if ``x`` is None."""
    qp_count: int
    """Number of QPs that were solved."""
    infeasible: int
    """Number of QPs without a solution."""


def search_modes(
    program: CoulombProgram, start: np.ndarray, modes: ContactModes, *, qp_limit: int, solver: QpSolver | str
) -> ModeSearchResult:
    """Search over contact modes: solve the QP of a region, continue in the region beyond its active mode constraints,
    and repeat while the objective decreases.

    The optimum of a region lies on its boundary with the next region, so each QP has a feasible start. The search
    begins in the region in which the sliding contacts of ``modes`` stick, because a sliding foot resists in one
    direction only: from a region in which the feet slide apart, the search does not reach a push-off with all feet. If
    the first region has no solution, the search begins in the region of ``modes`` itself.

    Args:
        program: the QP of the step.
        start: (m + 3n,) point in the region of ``modes``.
        modes: modes in which the search begins.
        qp_limit: maximum number of QPs.
        solver: QP solver, see ``quadratic_program``.
    """
    best: ModeRegionOptimum | None = None
    single: ContactModes | None = None
    count = infeasible = 0
    sliding_modes, modes = modes, ContactModes(np.where(modes.kind == SLIDE, STICK, modes.kind), modes.slip)
    while count < qp_limit:
        count += 1
        solution = solve_mode_region(program, start, modes, solver, warm_start=best is not None)
        if solution is None:
            infeasible += 1
            if best is not None or infeasible > 1 or (sliding_modes.kind != SLIDE).all():
                break
            modes = sliding_modes
            continue
        if best is not None and solution.objective >= best.objective:
            # All transitions together raised the objective. The transition with the largest multiplier alone may still
            # lower it.
            if single is None or modes is single:
                break
            modes = single
            continue
        is_small_gain = best is not None and best.objective - solution.objective < kernels.MIN_GAIN_FRACTION * abs(
            best.objective
        )
        best, start = solution, solution.x
        if not len(solution.contact) or is_small_gain:
            break
        modes, single = _next_modes(program, modes, solution)
    return ModeSearchResult(best.x if best else None, best.objective if best else float("inf"), count, infeasible)


def solve_relaxed(program: CoulombProgram, solver: QpSolver | str) -> tuple[np.ndarray, float] | None:
    """Solve the relaxed QP over activations and contact forces.

    Forces must lie in the friction cone, but complementarity is dropped, so a force may act at an open contact. The
    optimum is a lower bound on the objective in every mode region.

    Returns:
        The activations (m,) and the objective, or None without a solution.
    """
    m, n = program.activation_count, program.contact_count
    forces = np.hstack([np.zeros((3 * n, m)), np.eye(3 * n)])
    cone = [forces[::3]]
    for angle in 2.0 * np.pi * np.arange(kernels.CONE_FACES) / kernels.CONE_FACES:
        # The pyramid encloses the cone, because a lower bound must not exclude points of the cone.
        cone.append(program.friction * forces[::3] - np.cos(angle) * forces[1::3] - np.sin(angle) * forces[2::3])
    A = np.vstack([np.eye(m, m + 3 * n), *cone, program.rows[::3]])
    lower = np.concatenate([program.lower, np.zeros(n * (1 + kernels.CONE_FACES)), -program.offset[::3]])
    upper = np.concatenate([program.upper, np.full(len(lower) - m, np.inf)])
    P = regularized(program.P, kernels.DELASSUS_REGULARIZATION)
    relaxed = quadratic_program(P, program.q, A, solver=solver).solve(lower, upper)
    if not relaxed.usable:
        return None
    return np.clip(relaxed.x[:m], program.lower, program.upper), relaxed.objective + program.constant


@dataclass(frozen=True)
class FrictionDirections:
    """Directions that approximate the friction cone in a mode region."""

    sides: np.ndarray
    """(faces, 3), for each face of a pyramid, coefficients of mu f_n and of both tangential forces. The sum of the
    three terms is the distance of a sticking contact's force from the face, positive inside."""
    sector: float
    """Largest angle in radians between the slip of a sliding contact and the direction that its friction opposes."""

    @classmethod
    def pyramid(cls, directions: int, first: float, sector: float) -> FrictionDirections:
        """Return directions with a pyramid of ``directions`` faces inside the cone, of which the first is at the angle
        ``first`` in radians, and with the given ``sector``."""
        angles = [first + 2.0 * math.pi * face / directions for face in range(directions)]
        width = math.cos(math.pi / directions)
        return cls(np.array([(width, -math.cos(angle), -math.sin(angle)) for angle in angles]), sector)


CONE = FrictionDirections.pyramid(kernels.CONE_FACES, 0.0, kernels.SLIDE_SECTOR)
"""Approximation of the exact friction cone: the force of a sticking contact stays inside a pyramid, and a sliding
contact may slide in any direction."""


@dataclass(frozen=True)
class ModeRegion:
    """Reduced QP for one assignment of contact modes.

    With the modes fixed, contact forces are affine in the activations a, f = force_offset + force_slope a, so the cost
    is 1/2 a^T P a + q^T a + const. The assignment is valid where rows a + rows_offset >= 0.
    """

    force_offset: np.ndarray
    """(3n,) body weights, contact forces at a = 0."""
    force_slope: np.ndarray
    """(3n, m) body weights, derivative of the contact forces."""
    P: np.ndarray
    """(m, m) Hessian of the cost."""
    q: np.ndarray
    """(m,) linear term of the cost."""
    rows: np.ndarray
    """(m + k, m): m rows of the activations themselves, then k mode constraints."""
    rows_offset: np.ndarray
    """(m + k,) values of ``rows`` at a = 0."""
    contact: np.ndarray
    """(k,) contact of each mode constraint."""
    transitions: np.ndarray
    """(k,) transition that the contact makes if the constraint is violated: ``TO_FREE``, ``TO_SLIDE``,
    ``TO_OTHER_DIRECTION`` or ``TO_TOUCHING``."""

    @classmethod
    def of(cls, program: CoulombProgram, modes: ContactModes, friction: FrictionDirections = CONE) -> ModeRegion | None:
        """Return the region of ``modes``, or None if the equations of its contact forces are singular."""
        m, mu = program.activation_count, program.friction
        stick, slide, free = (np.flatnonzero(modes.kind == kind) for kind in (STICK, SLIDE, FREE))
        forces = forces_in_modes(program.rows, program.offset, mu, modes)
        if forces is None:
            return None
        # With x = (a, f(a)), products with the identity that maps a to itself are left out.
        slope, offset = forces[:, :m], forces[:, m]
        products = program.P[m:, m:] @ forces
        half = slope.T @ (program.P[m:, :m] + 0.5 * products[:, :m])
        vectors = forces.reshape(-1, 3, m + 1)
        # Speeds are needed only of the tangents of sliding contacts and of the normals of free ones.
        components = np.concatenate([(3 * slide[:, None] + [1, 2]).ravel(), 3 * free])
        speeds = program.rows[components, m:] @ forces
        speeds[:, :m] += program.rows[components, :m]
        speeds[:, m] += program.offset[components]
        slide_speeds = speeds[: 2 * len(slide)].reshape(-1, 2, m + 1)
        sides = friction.sides * [mu, 1.0, 1.0]
        slip, turned = modes.slip[slide], modes.slip[slide][:, ::-1] * [-1.0, 1.0]
        sine, cosine = math.sin(friction.sector), math.cos(friction.sector)
        edges = np.stack([sine * slip + cosine * turned, sine * slip - cosine * turned])
        rows = np.concatenate(
            [
                np.eye(m, m + 1),
                *(vectors[stick, 0], vectors[slide, 0]),
                np.tensordot(sides, vectors[stick], axes=(1, 1)).reshape(-1, m + 1),
                (edges[:, :, None] @ slide_speeds).reshape(-1, m + 1),
                speeds[2 * len(slide) :],
            ]
        )
        transitions = np.repeat(
            [kernels.TO_FREE, kernels.TO_SLIDE, kernels.TO_OTHER_DIRECTION, kernels.TO_TOUCHING],
            [len(stick) + len(slide), len(sides) * len(stick), 2 * len(slide), len(free)],
        )
        return cls(
            force_offset=offset,
            force_slope=slope,
            P=program.P[:m, :m] + (half + half.T),
            q=program.q[:m] + program.P[:m, m:] @ offset + slope.T @ (program.q[m:] + products[:, m]),
            rows=rows[:, :m],
            rows_offset=rows[:, m],
            contact=np.concatenate([stick, slide, np.tile(stick, len(sides)), slide, slide, free]),
            transitions=transitions,
        )


def forces_in_modes(rows: np.ndarray, offset: np.ndarray, friction: float, modes: ContactModes) -> np.ndarray | None:
    """Return the contact forces (3n, m + 1) as an affine function of m other unknowns, with the constant in the last
    column. These forces keep sticking contacts at rest and sliding contacts closed.

    Args:
        rows: (3n, m + 3n) derivative of the contact velocities with respect to the m other unknowns and the forces.
        offset: (3n,) contact velocities if all unknowns are zero.
        friction: Coulomb coefficient.
        modes: modes of the n contacts.

    Returns:
        The forces, or None if their equations are singular.
    """
    n, m = len(rows) // 3, rows.shape[1] - len(rows)
    stick, slide = np.flatnonzero(modes.kind == STICK), np.flatnonzero(modes.kind == SLIDE)
    held = np.concatenate([(3 * stick[:, None] + np.arange(3)).ravel(), 3 * slide])
    forces = np.zeros((3 * n, m + 1))
    if len(held) == 0:
        return forces
    # Each solved force component keeps one velocity at zero. The friction of a sliding contact is proportional to its
    # normal force.
    ratios, tangents = -friction * modes.slip[slide], 3 * slide[:, None] + [1, 2]
    held_rows = rows[held]
    operator = held_rows[:, m + held]
    operator[:, 3 * len(stick) :] += (held_rows[:, m + tangents] * ratios).sum(axis=2)
    diagonal = operator.diagonal()
    operator[np.diag_indices_from(operator)] += kernels.DELASSUS_REGULARIZATION * np.abs(diagonal).mean()
    factor, pivots, _ = _getrf(operator)
    sizes = np.abs(factor.diagonal())
    if not sizes.min() > _MIN_PIVOT * sizes.max():
        return None
    solved, _ = _getrs(factor, pivots, np.column_stack([held_rows[:, :m], offset[held]]))
    forces[held] = -solved
    forces[tangents] = ratios[:, :, None] * forces[3 * slide][:, None]
    return forces


def solve_mode_region(
    program: CoulombProgram,
    start: np.ndarray,
    modes: ContactModes,
    solver: QpSolver | str,
    *,
    friction: FrictionDirections = CONE,
    max_violation: float = kernels.MAX_START_VIOLATION,
    warm_start: bool = False,
) -> ModeRegionOptimum | None:
    """Solve the QP of the activations in the region of ``modes``.

    If ``start`` violates a mode constraint, the optimum may violate it by the same amount, but at most by
    ``max_violation``.

    Args:
        program: the QP of the step.
        start: (m + 3n,) point from which the solver starts.
        modes: modes of the region.
        solver: QP solver, see ``quadratic_program``.
        friction: directions that approximate the friction cone.
        max_violation: maximum tolerated violation, a force in body weights or a speed in sqrt(g H).
        warm_start: True if another region of the step has been solved; operator splitting is then skipped
            (``SplittingProgram``).

    Returns:
        The optimum, or None without a solution.
    """
    m, region = program.activation_count, ModeRegion.of(program, modes, friction)
    if region is None:
        return None
    b = region.rows_offset[m:]
    lower = np.minimum(-b, np.maximum(region.rows[m:] @ start[:m], -b - max_violation)) - kernels.START_ROUNDING
    optimum = quadratic_program(region.P, region.q, region.rows, solver=solver).solve(
        np.concatenate([program.lower, lower]),
        np.concatenate([program.upper, np.full(len(lower), np.inf)]),
        start[:m],
        skip_splitting=warm_start,
    )
    if not optimum.usable:
        return None
    a = np.clip(optimum.x, program.lower, program.upper)
    x = np.concatenate([a, region.force_offset + region.force_slope @ a])
    objective = program.objective(x)
    multipliers = -optimum.multipliers[m:]
    active = np.flatnonzero(multipliers > kernels.MIN_MULTIPLIER * max(abs(objective), 1e-9))
    return ModeRegionOptimum(x, objective, region.contact[active], region.transitions[active], multipliers[active])


def _next_modes(
    program: CoulombProgram, modes: ContactModes, optimum: ModeRegionOptimum
) -> tuple[ContactModes, ContactModes | None]:
    """Return two sets of modes: those beyond all active constraints of ``optimum``, which lies in the region of
    ``modes``, and those beyond the constraint with the largest multiplier alone. The second is None if only one
    constraint is active."""
    neighbours = _NextModes(program, modes, optimum.x)
    constraints = optimum.contact, optimum.transition, optimum.multiplier
    after_all = neighbours.after_transitions(*constraints)
    if len(optimum.contact) == 1:
        return after_all, None
    strongest = [int(np.argmax(optimum.multiplier))]
    return after_all, neighbours.after_transitions(*(each[strongest] for each in constraints))


class _NextModes:
    """Modes of the regions next to the optimum ``x`` in the region of ``modes``."""

    def __init__(self, program: CoulombProgram, modes: ContactModes, x: np.ndarray) -> None:
        self._modes = modes
        tangents = (program.rows @ x + program.offset).reshape(-1, 3)[:, 1:]
        self._against, self._along = _unit(-x[program.activation_count :].reshape(-1, 3)[:, 1:]), _unit(tangents)
        self._moving = np.linalg.norm(tangents, axis=1) > kernels.ZERO_SPEED

    def after_transitions(self, contacts: np.ndarray, transitions: np.ndarray, multipliers: np.ndarray) -> ContactModes:
        """Return the modes after ``contacts`` make their ``transitions``. If a contact has several transitions, the one
        with the largest of ``multipliers`` is used."""
        kind, slip = self._modes.kind.copy(), self._modes.slip.copy()
        for index in np.argsort(multipliers, kind="stable"):
            i = contacts[index]
            if transitions[index] == kernels.TO_FREE:
                kind[i] = FREE
            elif transitions[index] == kernels.TO_SLIDE:
                kind[i], slip[i] = SLIDE, self._against[i]
            elif self._moving[i]:
                kind[i], slip[i] = SLIDE, self._along[i]
            else:
                kind[i] = STICK
        return ContactModes(kind, slip)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), [1.0, 0.0])
