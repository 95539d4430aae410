"""The corrector: one full nonlinear implicit step whose contact forces obey Eq. (9) with exact Coulomb friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.contact.detection import ContactDetector, ContactSet, push_out_speeds
from egs_warp.fem.implicit_step import ImplicitStep, NewtonStatus
from egs_warp.muscles.tension import MuscleTension

_PATIENCE = 12
"""Corrections after which they are taken to go round in circles."""


@dataclass(frozen=True)
class ContactStepResult:
    """End of a step with contact."""

    velocities: np.ndarray
    """(N, 3) m/s."""
    contacts: ContactSet
    forces: np.ndarray
    """(n, 3) newtons on the body: normal and two tangents of each contact."""
    converged: bool
    status: NewtonStatus

    @property
    def nodal_forces(self) -> np.ndarray:
        """(N, 3) newtons."""
        return (self.contacts.frame.T @ self.forces.ravel()).reshape(self.velocities.shape)


def contact_step(
    step: ImplicitStep,
    detector: ContactDetector,
    points: np.ndarray,
    force: np.ndarray,
    *,
    start_velocities: np.ndarray,
    start_forces: np.ndarray,
    push_out_cap: float,
    penetration_tolerance: float,
    tension: MuscleTension | None = None,
    outer_limit: int = 40,
    round_limit: int = 6,
) -> ContactStepResult:
    """Minimise Phi under ``force`` (N, 3), the muscles' ``tension`` and the contact forces of ``points`` (n,), found
    with it.

    The forces are corrected with the Delassus operator of the current tangent until the end velocity obeys contact and
    friction; points of the body that would end deeper than ``penetration_tolerance`` metres join the set.
    ``start_forces`` (n, 3) newtons.
    """
    body, dt = step.body, step.dt
    scale = np.sqrt(float(np.linalg.norm(body.gravity)) * body.height)
    velocities, forces = start_velocities, start_forces
    status = NewtonStatus.CONVERGED
    for round_number in range(round_limit):
        contacts = detector.contact_set(points, step.state.positions)
        shift = push_out_speeds(contacts.gaps, dt, push_out_cap)
        delassus = np.zeros((0, 0))
        converged, last, share = False, np.inf, 1.0
        for iteration in range(outer_limit):
            nodal = (contacts.frame.T @ forces.ravel()).reshape(force.shape)
            result = step.minimise(force + nodal, velocities, tension=tension)
            status, velocities = result.status, result.velocities
            if status is not NewtonStatus.CONVERGED:
                return ContactStepResult(velocities, contacts, forces, False, status)
            if contacts.count == 0:
                converged = True
                break
            circling = iteration >= _PATIENCE
            if iteration % 4 == 0 or circling:  # the tangent changes little between corrections that shrink
                solve = step.tangent(velocities, tension)
                delassus = dt * (contacts.frame @ solve(contacts.frame.T.toarray()))
                delassus = 0.5 * (delassus + np.transpose(delassus))
                # More points than the cage can resolve leave it singular; this moves no velocity by more than 1e-7.
                delassus[np.diag_indices_from(delassus)] += 1e-7 * delassus.diagonal().mean()
            speed = contacts.frame @ velocities.ravel()
            corrected, _ = coulomb_forces(
                delassus, speed - delassus @ forces.ravel(), shift, detector.geometry.friction, forces
            )
            change = float(np.abs(delassus @ (corrected - forces).ravel()).max())
            if change < 1e-6 * scale:
                converged = True
                break
            # Corrections that do not shrink go round in circles; a part of one leads out.
            if circling:
                share = max(0.5 * share, 0.125) if change > 0.5 * last else min(2.0 * share, 1.0)
            forces = forces + share * (corrected - forces)
            last = change
        gaps, _ = detector.gaps(step.end_positions(velocities))
        deep = np.setdiff1d(np.flatnonzero(gaps < -penetration_tolerance), points)
        if not converged or len(deep) == 0 or round_number == round_limit - 1:
            return ContactStepResult(velocities, contacts, forces, converged, status)
        deep = deep[np.argsort(gaps[deep], kind="stable")]
        _, first = np.unique(detector.geometry.tet_from_point[deep], return_index=True)
        added = deep[np.sort(first)][:16]
        points = np.concatenate([points, added])
        forces = np.vstack([forces, np.zeros((len(added), 3))])
    raise AssertionError("the last round returns")
