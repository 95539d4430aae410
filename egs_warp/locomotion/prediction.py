"""Prediction of the end of a step with given activations (Eq. 12), for one body or an island."""

from __future__ import annotations

from typing import Any

import numpy as np

from egs_warp.contact.newton import ContactLinearization, ContactLinearizer
from egs_warp.locomotion.linear_step import PREDICTION_ITERATIONS, SolveInputs


def predict_end(
    linearizer: ContactLinearizer, factors: Any, start: SolveInputs, tension: Any
) -> tuple[ContactLinearization, np.ndarray, np.ndarray]:
    """Predict the end of a step.

    The prediction starts from a rigid motion of each body. One Newton step with the previous contact forces gives the
    velocities at which the tangent is factored; the plan uses this tangent. Then ``PREDICTION_ITERATIONS`` Newton steps
    solve for velocities and Coulomb forces. If one of these steps would invert an element, its velocities are discarded
    and the prediction ends.

    Args:
        linearizer: builder of contact linearisations.
        factors: linear solver of the body, or those of the bodies of the island.
        start: inputs of the step.
        tension: muscle energy of the body, or of each body of the island.

    Returns:
        The contact linearisation at the predicted end, the end velocities (N, 3) m/s, and the contact forces (n, 3) N.
    """
    problem, contacts, velocities = start.problem, start.contacts, start.problem.rigid_guess
    # The tangent omits the stiffness of the muscles, which does not improve the prediction; only the solve uses it.
    tangent = problem.tangent(factors, velocities, None)
    newton_velocities = linearizer.predict_velocities(tangent, contacts, tension, velocities, start.forces)
    if newton_velocities is not None:
        velocities = newton_velocities
        tangent = problem.tangent(factors, velocities, None)
    response = linearizer(tangent, contacts)
    iterate, forces = response.iterate_at(tension, velocities, start.forces), start.forces
    for _ in range(PREDICTION_ITERATIONS):
        newton_result = iterate.newton_steps(start.normal_bias, start.friction)
        forces = newton_result.forces
        if not np.isfinite(newton_result.trial.residual_norm):
            break
        iterate = newton_result.trial
    return response, iterate.velocities, forces
