"""Newton's method on the velocities and contact forces of one step, until both equations hold (Eq. 4, 8, 9).

A step is solved in rounds with a fixed contact set (``CoupledSolver._round``). A Newton step solves Coulomb's law for
the contact forces, moves velocities and forces to the solution, and shortens the step while the residual is too large.
Points that would end too deep are added to the set, and the next round begins. The iterates come from ``newton`` (host)
or ``device_newton`` (GPU).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from egs_warp.contact.contact_set import ContactSet, push_out_speeds
from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.newton import ContactLinearization, NewtonIterate, PenetrationCheck
from egs_warp.contact.newton_convergence import MAX_NEWTON_STEPS, NewtonProgress
from egs_warp.contact.selection import ACTIVATION_DEPTH, ContactSelector
from egs_warp.fem.implicit_step import ImplicitStep
from egs_warp.fem.step_problem import StepProblem
from egs_warp.kernels.contact.newton_convergence import ACCEPTED, ENDED, FAILED, NEAR_END, NEEDS_TANGENT, SHORTEN
from egs_warp.muscles.tension import MuscleEnergy

MAX_ACTIVATION_ROUNDS = 6
"""Maximum number of rounds of a step. Points may be added to the contact set after each round except the last."""
PUSH_OUT_FRACTION = 0.2
"""Fraction of the depth beyond the tolerance that a step pushes a point out."""
ACTIVATION_RESIDUAL = 1e-3
"""Residual divided by dt x weight. When a round first falls below it, the end of the step is accurate enough to add the
points that would be too deep there. They are also added at the end of the round.
"""
COULOMB_TOLERANCE = 1e-6
"""Violation of Coulomb's law at the end of a step, as a fraction of dt g, the speed that free fall gains in a step."""


@dataclass(frozen=True)
class CoupledResult:
    """Result of a step with contact."""

    velocities: np.ndarray
    """(N, 3) m/s."""
    contacts: ContactSet
    forces: np.ndarray
    """(n, 3) newtons on the body: normal and two tangential components for each contact."""
    converged: bool
    residual: float
    """Norm of the residual of the equation of motion, divided by dt x weight."""
    iterations: int
    factorization_count: int
    """Number of factorisations computed in the solve."""
    linearization: ContactLinearization
    """The last linearisation, with the contacts at the end."""
    penetration: PenetrationCheck | None
    """Penetration test at the end; None if it was not evaluated."""


@dataclass(frozen=True)
class NewtonOptions:
    """Tolerances of Newton's method on velocities and contact forces, in one world or in many, and the objects that
    detect and select contacts.
    """

    detector: ContactDetector
    points: ContactSelector
    push_out_cap: float
    """Maximum push-out speed, m/s."""
    penetration_tolerance: float
    """Metres. Points that would end deeper than ``ACTIVATION_DEPTH`` of it are added to the contact set."""
    tolerance: float = 1e-8
    """Residual divided by dt x weight at which the solve ends."""

    def normal_bias(self, contacts: ContactSet, dt: float) -> Any:
        """Return the velocity bias added to each contact's normal velocity.

        It forbids further penetration during the step and pushes contacts that are deeper than
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

    def progress(self, problem: ImplicitStep, *, last: bool = False) -> NewtonProgress:
        """Return the progress at the start of a round. In the ``last`` round no points are added."""
        coulomb_tolerance = COULOMB_TOLERANCE * problem.residual_scale / problem.body.mass
        return NewtonProgress(self.tolerance, -1.0 if last else ACTIVATION_RESIDUAL, coulomb_tolerance)


@dataclass(frozen=True)
class CoupledSolver(NewtonOptions):
    """Newton's method on velocities and contact forces of one world."""

    def solve(
        self,
        response: ContactLinearization,
        tension: MuscleEnergy | None,
        *,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> CoupledResult:
        """Solve the step with Newton's method and return its end.

        Args:
            response: linearisation with the initial contacts, reused while it converges well.
            tension: muscle energy of the step, or None.
            velocities: (N, 3) m/s, initial velocities, which must not invert an element.
            forces: (n, 3) newtons, initial forces.
        """
        iterations = tangents = 0
        for number in range(MAX_ACTIVATION_ROUNDS):
            result, wider = self._round(response, tension, velocities, forces, last=number == MAX_ACTIVATION_ROUNDS - 1)
            response = result.linearization
            iterations, tangents = iterations + result.iterations, tangents + result.factorization_count
            velocities, forces = result.velocities, result.forces
            if wider is None:
                break
            forces = np.vstack([forces, np.zeros((wider.count - len(forces), 3))])
            response = response.with_added_contacts(wider)
        return replace(result, iterations=iterations, factorization_count=tangents)

    def _with_penetrating_points(
        self, problem: StepProblem, contacts: ContactSet, end: NewtonIterate
    ) -> ContactSet | None:
        """Return ``contacts`` and the points that would be too deep at ``end``; None if there are none."""
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

    def _round(
        self,
        response: ContactLinearization,
        tension: MuscleEnergy | None,
        velocities: np.ndarray,
        forces: np.ndarray,
        *,
        last: bool,
    ) -> tuple[CoupledResult, ContactSet | None]:
        """Run Newton's method with the contacts of ``response``.

        Returns:
            The end of the round, and the extended contact set if penetrating points were found; None otherwise and in
                the ``last`` round.
        """
        problem, contacts = response.tangent.problem, response.contacts
        normal_bias = self.normal_bias(contacts, problem.dt)
        friction, progress, tangents = self.detector.geometry.friction, self.progress(problem, last=last), 0
        iterate = response.iterate_at(tension, velocities, forces)
        while progress.steps < MAX_NEWTON_STEPS:
            steps = iterate.newton_steps(normal_bias, friction, progress)
            iterate, trial = steps.base, steps.trial
            while progress.has(SHORTEN):
                trial = iterate.line_search_point(steps.forces, progress.length)
                progress.judge(trial.residual_norm, steps.coulomb_violation)
            if progress.has(ACCEPTED):
                iterate, ended = trial, progress.has(ENDED)
                wider = self._with_penetrating_points(problem, contacts, trial) if progress.has(NEAR_END) else None
                if ended or wider is not None:
                    return _result(trial, ended, progress.steps, tangents), wider
            if progress.has(FAILED):
                break
            if progress.has(NEEDS_TANGENT):
                iterate = iterate.with_new_tangent()
                tangents += 1
                progress.renew_tangent()
        return _result(iterate, False, progress.steps, tangents), None


def _result(end: NewtonIterate, converged: bool, iterations: int, tangents: int) -> CoupledResult:
    response = end.linearization
    return CoupledResult(
        *(end.velocities, response.contacts, end.forces, converged, end.residual_norm, iterations, tangents),
        *(response, end.penetration),
    )
