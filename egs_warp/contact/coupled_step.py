"""Newton's method on the velocities and contact forces of one step, until both equations hold (Eq. 4, 8, 9).

A step is solved in rounds with a fixed contact set (``CoupledSolver._round``). A Newton step solves Coulomb's law for
the contact forces, moves velocities and forces to the solution, and shortens the step while the residual is too large.
Points that would end too deep are added to the set, and the next round begins. The iterates come from ``newton`` (host)
or ``device_newton`` (GPU).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.contact.detection import ContactDetector, ContactSet, push_out_speeds
from egs_warp.contact.newton import ContactLinearization, NewtonIterate, PenetrationCheck
from egs_warp.contact.newton_convergence import MAX_NEWTON_STEPS, ConvergenceState
from egs_warp.contact.selection import ContactSelector
from egs_warp.fem.step_problem import StepProblem
from egs_warp.muscles.tension import MuscleEnergy

MIN_STEP_LENGTH = 1e-3
"""Step length below which the line search fails, as a fraction of a Newton step."""
MAX_ACTIVATION_ROUNDS = 6
"""Maximum number of rounds of a step. Points may be added to the contact set after each round except the last."""
PUSH_OUT_FRACTION = 0.2
"""Fraction of the depth beyond the tolerance that a step pushes a point out."""
ACTIVATION_DEPTH = 0.6
"""Depth beyond which a point is added to the contact set if it would end there, as a fraction of the penetration
tolerance.
"""
ACTIVATION_RESIDUAL = 1e-3
"""Residual divided by dt x weight. When a round first falls below it, the end of the step is accurate enough to add the
points that would be too deep there. They are also added at the end of the round.
"""
MAX_SINK = 0.3
"""Fraction of the penetration tolerance by which a point that is already deep may sink in a step without being added.
"""
MAX_CREEP = 0.02
"""``MAX_SINK`` for a point that would end deeper than the penetration tolerance itself."""
COULOMB_TOLERANCE = 1e-6
"""Violation of Coulomb's law at the end of a step, as a fraction of dt g, the speed that free fall gains in a step."""
MAX_COULOMB_FAILURES = 3
"""Maximum number of Newton steps of a round whose forces violate Coulomb's law by more than ``COULOMB_TOLERANCE``. With
more, the solve fails and the step is halved.
"""


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
class CoupledSolver:
    """Newton's method on velocities and contact forces together."""

    detector: ContactDetector
    points: ContactSelector
    push_out_cap: float
    """Maximum push-out speed, m/s."""
    penetration_tolerance: float
    """Metres. Points that would end deeper than ``ACTIVATION_DEPTH`` of it are added to the contact set."""
    tolerance: float = 1e-8
    """Residual divided by dt x weight at which the solve ends."""

    def normal_bias(self, contacts: ContactSet, dt: float) -> np.ndarray:
        """Return the velocity bias added to each contact's normal velocity.

        It forbids further penetration during the step and pushes contacts that are deeper than
        ``penetration_tolerance`` out at a limited speed.

        Args:
            contacts: n active contacts.
            dt: step size, s.

        Returns:
            (n,) m/s.
        """
        return push_out_speeds(contacts.gaps, dt, self.push_out_cap, PUSH_OUT_FRACTION, self.penetration_tolerance)

    def convergence_state(self, problem: StepProblem, *, last: bool = False) -> ConvergenceState:
        """Return the state of the Newton loop at the start of a round. In the ``last`` round no points are added."""
        coulomb_tolerance = COULOMB_TOLERANCE * problem.residual_scale / problem.body.mass
        return ConvergenceState(self.tolerance, 0.0 if last else ACTIVATION_RESIDUAL, coulomb_tolerance)

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
            deepest = check.deepest[self.points.order_by_gap(check.deepest[:, 0], check.deepest[:, 1])]
            return self.detector.contact_set_at(
                np.concatenate([contacts.points, deepest[:, 0].astype(int)]),
                start,
                np.concatenate([contacts.gaps, deepest[:, 2]]),
                np.concatenate([contacts.faces, deepest[:, 3].astype(np.int32)]),
            )
        gaps, _ = self.detector.gaps(problem.end_positions(end.velocities))
        depth = ACTIVATION_DEPTH * self.penetration_tolerance
        if gaps.min() >= -depth:
            return None
        start_gaps, _ = self.detector.gaps(start)
        # A point that is already deep is added only if it would sink further.
        allowed = np.where(gaps < -self.penetration_tolerance, MAX_CREEP, MAX_SINK) * self.penetration_tolerance
        added = self.points.find_deeper(contacts.points, np.where(gaps < start_gaps - allowed, gaps, 0.0), depth)
        if len(added) == 0:
            return None
        return self.detector.contact_set(np.concatenate([contacts.points, added]), start)

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
        friction = self.detector.geometry.friction
        convergence = self.convergence_state(problem, last=last)
        tangents, coulomb_failures, tangent_is_current = 0, 0, False
        iterate = response.iterate_at(tension, velocities, forces)
        while convergence.steps < MAX_NEWTON_STEPS:
            steps = iterate.newton_steps(normal_bias, friction, convergence)
            iterate, trial, violation = steps.base, steps.trial, steps.coulomb_violation
            convergence, tangent_is_current = (
                convergence.after_steps(*steps.accepted_residuals),
                tangent_is_current and not steps.accepted_residuals,
            )
            satisfies_coulomb = violation <= convergence.coulomb_tolerance
            coulomb_failures += not satisfies_coulomb
            length = 1.0
            while (
                not (better := convergence.is_acceptable(trial.residual_norm, length))
                and length > 2.0 * MIN_STEP_LENGTH
            ):
                length *= 0.5
                trial = iterate.line_search_point(steps.forces, length)
            if better:
                before, iterate = iterate, trial
                # By linearity, the contact velocities after a full step are those of the Coulomb solve.
                satisfies_coulomb = satisfies_coulomb and length == 1.0
                ended = satisfies_coulomb and iterate.residual_norm <= convergence.tolerance
                slow = (
                    convergence.converges_slowly(iterate.residual_norm, before.residual_norm) or not satisfies_coulomb
                )
                activates = (
                    not last
                    and satisfies_coulomb
                    and (ended or convergence.may_activate_contacts(iterate.residual_norm, before.residual_norm))
                )
                convergence = convergence.after_steps(iterate.residual_norm)
                if activates:
                    wider = self._with_penetrating_points(problem, contacts, iterate)
                    if wider is not None:
                        return _result(iterate, ended, convergence.steps, tangents), wider
                if ended:
                    return _result(iterate, True, convergence.steps, tangents), None
            else:
                convergence, slow = convergence.after_failed_step(), True
                if tangent_is_current:
                    break
            if coulomb_failures > MAX_COULOMB_FAILURES:
                break
            tangent_is_current = False
            if slow:
                iterate = iterate.with_new_tangent()
                tangents, tangent_is_current = tangents + 1, True
        return _result(iterate, False, convergence.steps, tangents), None


def _result(end: NewtonIterate, converged: bool, iterations: int, tangents: int) -> CoupledResult:
    response = end.linearization
    return CoupledResult(
        *(end.velocities, response.contacts, end.forces, converged, end.residual_norm, iterations, tangents),
        *(response, end.penetration),
    )
