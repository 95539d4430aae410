"""Newton's method on the velocities and contact forces of one step (Eq. 4, 8, 9).

The method ends when both the equation of motion and Coulomb's law hold. A step is solved in rounds, each with a fixed
contact set (``newton_round``). Points that would be too deep at the end of a round are added to the set for the next
round. The iterates come from ``newton`` (host) or ``device_newton`` (GPU).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic

import numpy as np

from egs_warp.contact.contact_set import ContactSet, push_out_speeds
from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.newton import (
    ContactLinearization,
    NewtonIterate,
    NewtonStepResult,
    PenetrationCheck,
    StepEquation,
    TensionT,
)
from egs_warp.contact.newton_convergence import MAX_NEWTON_STEPS, NewtonProgress
from egs_warp.contact.newton_round import run_round
from egs_warp.contact.selection import ACTIVATION_DEPTH, ContactSelector
from egs_warp.fem.implicit_step import ImplicitStep
from egs_warp.kernels.contact.newton_convergence import ACCEPTED, ENDED

MAX_ACTIVATION_ROUNDS = 6
"""Maximum number of rounds of a step. Points may be added to the contact set after each round except the last."""
PUSH_OUT_FRACTION = 0.2
"""Fraction of the depth beyond the penetration tolerance that a step removes."""
ACTIVATION_RESIDUAL = 1e-3
"""Residual, divided by dt x weight, below which the end of the step is known accurately enough to search for points
that would be too deep at the end. The search is done when the residual of a round first falls below this value, and
again at the end of the round."""
COULOMB_TOLERANCE = 1e-6
"""Tolerated violation of Coulomb's law at the end of a step, as a fraction of dt g, the speed that free fall gains in a
step."""


@dataclass(frozen=True)
class CoupledResult(Generic[TensionT]):
    """Result of a step with contact."""

    velocities: np.ndarray
    """(N, 3) m/s, at the end of the step."""
    contacts: ContactSet
    forces: np.ndarray
    """(n, 3) newtons on the body: normal and two tangential components for each contact."""
    converged: bool
    residual: float
    """Norm of the residual of the equation of motion, divided by dt x weight."""
    iterations: int
    factorization_count: int
    """Number of factorisations computed in the solve."""
    linearization: ContactLinearization[TensionT]
    """Last linearisation, with the contacts at the end of the step."""
    penetration: PenetrationCheck | None
    """Penetration test at the end of the step; None if it was not evaluated."""


@dataclass(frozen=True)
class NewtonOptions:
    """Tolerances of Newton's method on velocities and contact forces, in one world or in many, and the objects that
    detect and select contacts."""

    detector: ContactDetector
    points: ContactSelector
    push_out_cap: float
    """Maximum push-out speed, m/s."""
    penetration_tolerance: float
    """Tolerated penetration, m. Points that would end the step deeper than the fraction ``ACTIVATION_DEPTH`` of it are
    added to the contact set."""
    tolerance: float = 1e-8
    """Residual divided by dt x weight at which the solve ends."""

    def normal_bias(self, contacts: ContactSet, dt: float) -> Any:
        """Return the velocity bias added to each contact's normal velocity.

        The bias forbids further penetration during the step. It pushes contacts that are deeper than
        ``penetration_tolerance`` out at a limited speed.

        Args:
            contacts: active contacts.
            dt: step size, s.

        Returns:
            (n,) m/s, or (B, K) with zeros as padding.
        """
        tolerance = self.penetration_tolerance
        speeds = push_out_speeds(contacts.gaps, dt, self.push_out_cap, PUSH_OUT_FRACTION, tolerance)
        return speeds if contacts.counts is None else speeds * contacts.valid

    def progress(self, problem: ImplicitStep | StepEquation[Any], *, last: bool = False) -> NewtonProgress:
        """Return the progress at the start of a round. In the ``last`` round no points are added."""
        coulomb_tolerance = COULOMB_TOLERANCE * problem.free_fall_speed
        return NewtonProgress(self.tolerance, -1.0 if last else ACTIVATION_RESIDUAL, coulomb_tolerance)


@dataclass(frozen=True)
class CoupledSolver(NewtonOptions):
    """Newton's method on velocities and contact forces of one world."""

    @property
    def friction(self) -> float:
        """Coulomb coefficient."""
        return self.detector.geometry.friction

    def solve(
        self,
        response: ContactLinearization[TensionT],
        tension: TensionT,
        *,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> CoupledResult[TensionT]:
        """Solve the step with Newton's method and return its end.

        Args:
            response: linearisation with the initial contacts, reused while it converges well.
            tension: muscle energies of the step.
            velocities: (N, 3) m/s, initial velocities, which must not invert an element.
            forces: (n, 3) newtons, initial forces.
        """
        iterations = tangents = 0
        for number in range(MAX_ACTIVATION_ROUNDS):
            last = number == MAX_ACTIVATION_ROUNDS - 1
            newton = _OneRound(self, response.iterate_at(tension, velocities, forces), last=last)
            run_round(newton)
            iterate, contacts = newton.iterate, newton.added_contacts
            response = iterate.linearization
            iterations, tangents = iterations + newton.progress.steps, tangents + newton.factorization_count
            velocities, forces = iterate.velocities, iterate.forces
            if newton.converged and not last:
                contacts = self.with_penetrating_points(iterate)
            if contacts is None:
                break
            forces = np.vstack([forces, np.zeros((contacts.count - len(forces), 3))])
            response = response.with_added_contacts(contacts)
        return CoupledResult(
            *(iterate.velocities, iterate.linearization.contacts, iterate.forces, newton.converged),
            *(iterate.residual_norm, iterations, tangents, iterate.linearization, iterate.penetration),
        )

    def with_penetrating_points(self, end: NewtonIterate[Any]) -> ContactSet | None:
        """Return the contacts of ``end``, extended by the points that are too deep at ``end``; None if no point is."""
        problem, contacts = end.linearization.tangent.problem, end.linearization.contacts
        check, start = end.penetration, problem.state.positions
        if check is not None and not check.is_penetrating:
            return None
        if check is not None and check.deepest is not None:
            return contacts.concatenate(check.deepest)
        gaps, _ = self.detector.gaps(problem.end_positions(end.velocities))
        if gaps.min() >= -ACTIVATION_DEPTH * self.penetration_tolerance:
            return None
        start_gaps, _ = self.detector.gaps(start)
        added = self.points.find_penetrating(contacts.points, gaps, start_gaps, self.penetration_tolerance)
        if len(added) == 0:
            return None
        return contacts.concatenate(self.detector.contact_set(added, start))


_WORLD = (0,)
"""Set of the only world."""


class _OneRound(Generic[TensionT]):
    """Implementation of ``NewtonWorlds`` for one world; a set of worlds is ``_WORLD`` or empty."""

    def __init__(self, solver: CoupledSolver, start: NewtonIterate[TensionT], *, last: bool) -> None:
        """Start a round at the iterate ``start``; the ``last`` round adds no points."""
        response, self._solver, self._is_active = start.linearization, solver, True
        self.iterate, self._steps = start, NewtonStepResult(start, start.forces, 0.0, start)
        self.factorization_count, self.converged = 0, False
        self.added_contacts: ContactSet | None = None
        self.progress = solver.progress(response.tangent.problem, last=last)
        self._normal_bias = solver.normal_bias(response.contacts, response.tangent.problem.dt)

    def running(self) -> tuple[int, ...]:
        return _WORLD if self._is_active and self.progress.steps < MAX_NEWTON_STEPS else ()

    def active(self, bits: int) -> tuple[int, ...]:
        return _WORLD if self._is_active and self.progress.has(bits) else ()

    def take_step(self, worlds: tuple[int, ...]) -> None:
        """Take a full Newton step and judge its trial. A GPU takes further steps until one of them needs a decision of
        the host; all but the last are accepted."""
        self._steps = self.iterate.newton_steps(self._normal_bias, self._solver.friction, self.progress)
        self._accept(self._steps.trial)

    def halve_step(self, worlds: tuple[int, ...]) -> None:
        trial = self._steps.base.line_search_point(self._steps.forces, self.progress.length)
        self.progress.judge(trial.residual_norm, self._steps.coulomb_violation)
        self._accept(trial)

    def _accept(self, trial: NewtonIterate[TensionT]) -> None:
        self.iterate = trial if self.progress.has(ACCEPTED) else self._steps.base

    def stop(self, bits: int) -> None:
        self._is_active, self.converged = not self.progress.has(bits), self.progress.has(ENDED)

    def check_penetration(self, worlds: tuple[int, ...]) -> None:
        self.added_contacts = self._solver.with_penetrating_points(self.iterate)
        self._is_active = self.added_contacts is None

    def renew_tangent(self, worlds: tuple[int, ...]) -> None:
        self.iterate = self.iterate.with_new_tangent()
        self.factorization_count += 1
        self.progress.renew_tangent()
