"""A step with contact: velocities and contact forces are sought together until both equations hold (Eq. 4, 8, 9)."""

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
MAX_ACTIVATION_ROUNDS = 6
PUSH_OUT_FRACTION = 0.2
"""Of the depth beyond the tolerance, a step."""
ACTIVATION_DEPTH = 0.6
"""Of the tolerance: points that would end deeper join at once."""
ACTIVATION_RESIDUAL = 1e-3
"""Residual over dt x weight below which a round that comes down to it looks for them, as at its end: by then it is
known well enough where that is."""
MAX_SINK = 0.3
"""Of the tolerance: by how much what is deep already may go deeper in a step; by next to nothing beyond the tolerance.
"""
MAX_CREEP = 0.02
COULOMB_TOLERANCE = 1e-6
"""Of dt g, which a step gives what falls: by how much less the forces of its end miss Coulomb's law."""
MAX_COULOMB_FAILURES = 3
"""Times that forces may miss it by more before the step is given up, to be done in halves."""


@dataclass(frozen=True)
class CoupledResult:
    """End of a step with contact."""

    velocities: np.ndarray
    """(N, 3) m/s."""
    contacts: ContactSet
    forces: np.ndarray
    """(n, 3) newtons on the body: normal and two tangents of each contact."""
    converged: bool
    residual: float
    """Norm of what the equation of motion misses, over dt x weight."""
    iterations: int
    factorization_count: int
    """Factorisations made on the way."""
    linearization: ContactLinearization
    """By the last of them: of the contacts of the end."""
    penetration: PenetrationCheck | None
    """At the end; None if nobody looked."""


@dataclass(frozen=True)
class CoupledSolver:
    """Newton's method on velocities and contact forces at once."""

    detector: ContactDetector
    points: ContactSelector
    push_out_cap: float
    """m/s."""
    penetration_tolerance: float
    """Metres: points that would end deeper join the set."""
    tolerance: float = 1e-8
    """Residual over dt x weight."""

    def normal_bias(self, contacts: ContactSet, dt: float) -> np.ndarray:
        """(n,) m/s, the constant of the normal measure of a step of ``dt`` seconds: nothing goes deeper, and
        what is deeper than the tolerance comes out gently."""
        return push_out_speeds(contacts.gaps, dt, self.push_out_cap, PUSH_OUT_FRACTION, self.penetration_tolerance)

    def convergence_state(self, problem: StepProblem, *, last: bool = False) -> ConvergenceState:
        """Of a round of the step, which in the ``last`` no points join."""
        answered = COULOMB_TOLERANCE * problem.residual_scale / problem.body.mass
        return ConvergenceState(self.tolerance, 0.0 if last else ACTIVATION_RESIDUAL, answered)

    def solve(
        self,
        response: ContactLinearization,
        tension: MuscleEnergy | None,
        *,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> CoupledResult:
        """The step from a start of ``velocities`` (N, 3), which invert no element, and ``forces`` (n, 3); ``response``
        is kept while it serves.
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
        """``contacts``, and points that would ``end`` too deep; None if none would."""
        seen, start = end.penetration, problem.state.positions
        if seen is not None and not seen.is_penetrating:
            return None
        if seen is not None and seen.deepest is not None:
            joining = seen.deepest[self.points.order_by_gap(seen.deepest[:, 0], seen.deepest[:, 1])]
            return self.detector.contact_set_at(
                np.concatenate([contacts.points, joining[:, 0].astype(int)]),
                start,
                np.concatenate([contacts.gaps, joining[:, 2]]),
                np.concatenate([contacts.faces, joining[:, 3].astype(np.int32)]),
            )
        gaps, _ = self.detector.gaps(problem.end_positions(end.velocities))
        depth = ACTIVATION_DEPTH * self.penetration_tolerance
        if gaps.min() >= -depth:
            return None
        start_gaps, _ = self.detector.gaps(start)
        # What is deep already is held where it is only once it would go deeper.
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
        """With the contacts of ``response``: where it ends, or where points are found that are to join them, and all of
        these; None in the ``last`` round."""
        problem, contacts = response.tangent.problem, response.contacts
        shift = self.normal_bias(contacts, problem.dt)
        friction = self.detector.geometry.friction
        course = self.convergence_state(problem, last=last)
        tangents, unanswered, fresh = 0, 0, False
        now = response.iterate_at(tension, velocities, forces)
        while course.steps < MAX_NEWTON_STEPS:
            stretch = now.newton_steps(shift, friction, course)
            now, trial, missed = stretch.base, stretch.trial, stretch.coulomb_violation
            course, fresh = course.after_steps(*stretch.accepted_residuals), fresh and not stretch.accepted_residuals
            obeys = missed <= course.coulomb_tolerance
            unanswered += not obeys
            length = 1.0
            while not (better := course.is_acceptable(trial.residual_norm, length)) and length > 2.0 * MIN_STEP_LENGTH:
                length *= 0.5
                trial = now.line_search_point(stretch.forces, length)
            if better:
                before, now = now, trial
                # After a whole step the contact velocities are those that were solved for, by linearity.
                obeys = obeys and length == 1.0
                ended = obeys and now.residual_norm <= course.tolerance
                slow = course.converges_slowly(now.residual_norm, before.residual_norm) or not obeys
                joins = (
                    not last
                    and obeys
                    and (ended or course.may_activate_contacts(now.residual_norm, before.residual_norm))
                )
                course = course.after_steps(now.residual_norm)
                if joins:
                    wider = self._with_penetrating_points(problem, contacts, now)
                    if wider is not None:
                        return _result(now, ended, course.steps, tangents), wider
                if ended:
                    return _result(now, True, course.steps, tangents), None
            else:
                course, slow = course.after_failed_step(), True
                if fresh:
                    break
            if unanswered > MAX_COULOMB_FAILURES:
                break
            fresh = False
            if slow:
                now = now.with_new_tangent()
                tangents, fresh = tangents + 1, True
        return _result(now, False, course.steps, tangents), None


def _result(end: NewtonIterate, converged: bool, iterations: int, tangents: int) -> CoupledResult:
    response = end.linearization
    return CoupledResult(
        *(end.velocities, response.contacts, end.forces, converged, end.residual_norm, iterations, tangents),
        *(response, end.penetration),
    )
