"""State of rest of a body on its ground, and the unloaded shape that takes the captured shape at rest under gravity."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.body_support import StepperAmongBodies
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.locomotion.threads import one_blas_thread

SETTLING_STEP, SETTLING_STEPS = 0.25, 12
"""Step size in sqrt(H / g), and maximum number of steps, for a body that comes to rest on its ground."""
SHAPE_TOLERANCE = 1e-3
"""Maximum displacement of a node of the resting body from the captured shape, in body heights."""

_MAX_CORRECTIONS = 12
"""Maximum number of corrections of the unloaded shape."""
_ANDERSON_DEPTH = 4
"""Number of iterates from which the next one is extrapolated."""


def settle(stepper: LocomotionStepper | StepperAmongBodies, start: np.ndarray | None = None) -> BodyState:
    """Let the body come to rest on what is below it by long contact steps without muscles, each of which starts with
    zero velocity.

    If the body collapses, its fall is not computed to the end: the loop ends once a node moves by more than 0.2 H in
    one step, or the centre of mass has moved by more than 0.1 H in total.

    Args:
        stepper: stepper of the body.
        start: (N, 3) m, nodes at the start; None starts from the captured shape.
    """
    body = stepper.body
    start = body.mesh.nodes if start is None else start
    state = BodyState(start.copy(), np.zeros_like(start))
    dt = SETTLING_STEP * body.time_unit
    memory = stepper.initial_memory()
    for _ in range(SETTLING_STEPS):
        with one_blas_thread():
            result = stepper.passive_step(state, memory, dt)
        max_displacement = dt * float(np.abs(result.velocities).max())
        state = BodyState(state.positions + dt * result.velocities, np.zeros_like(state.positions))
        memory = replace(memory, points=result.contacts.points, forces=result.forces)
        centre_displacement = body.centre_of_mass(state.positions) - body.centre_of_mass(start)
        if has_settled(body, max_displacement, np.linalg.norm(centre_displacement)):
            break
    return state


def has_settled(body: SoftBody, max_displacement: Any, centre_displacement: Any) -> Any:
    """Return True if a body is at rest or collapses.

    Args:
        body: the body.
        max_displacement: m, largest displacement of a node along an axis in the last step, a number or an array.
        centre_displacement: m, total displacement of the centre of mass, a number or an array.
    """
    return (
        (max_displacement > 0.2 * body.height)
        | (centre_displacement > 0.1 * body.height)
        | (max_displacement < 2e-4 * body.height)
    )


def settle_as_captured(stepper: LocomotionStepper, state: BodyState) -> tuple[LocomotionStepper, BodyState, float]:
    """Find the unloaded shape that takes the captured shape at rest on the ground, so that the body does not sag.

    The method is a fixed-point iteration (Sellier, "An iterative method for the inverse elasto-static problem", Journal
    of Fluids and Structures 27, 2011): the unloaded shape X becomes X - R^T u, where u are the displacements of the
    resting nodes from the captured shape and R is the best-fit rotation. Masses, material and muscles stay the same;
    muscles have their rest lengths in the captured shape. A rigid displacement, as when a body rocks onto its third
    foot, is not an error of the shape, but the iteration continues as long as the total displacement decreases.

    Args:
        stepper: stepper of the body, whose unloaded shape is still the captured shape.
        state: its state at rest (``settle``).

    Returns:
        A stepper of the body with its unloaded shape, its state at rest, and the largest displacement of a node from
        the captured shape after the best-fit rigid motion, in body heights. The displacement exceeds
        ``SHAPE_TOLERANCE`` if the iteration did not converge.
    """
    correction, error, displacement = _displacements(stepper.body, state)
    best = (stepper, state, error)
    best_displacement = displacement
    unloaded: list[np.ndarray] = []
    corrections: list[np.ndarray] = []
    for _ in range(_MAX_CORRECTIONS):
        if displacement <= SHAPE_TOLERANCE:
            break
        unloaded.append(stepper.body.assembly.mesh.nodes)
        corrections.append(correction)
        nodes = _anderson_iterate(unloaded[-_ANDERSON_DEPTH:], corrections[-_ANDERSON_DEPTH:])
        if not (TetMesh(nodes, stepper.body.mesh.tets).volumes() > 0.0).all():
            break
        stepper = stepper.with_unloaded_shape(nodes)
        state = settle(stepper)
        correction, error, displacement = _displacements(stepper.body, state)
        if displacement < best_displacement:
            best, best_displacement = (stepper, state, error), displacement
        elif best[2] <= SHAPE_TOLERANCE:
            break
    return best


def _displacements(body: SoftBody, state: BodyState) -> tuple[np.ndarray, float, float]:
    """Return the displacement of the nodes from the captured shape.

    Returns:
        (N, 3) m, displacement after the best-fit rigid motion, in axes of the captured shape; the maximum length of
        these displacements; and the maximum displacement including the rigid motion, both in body heights.
    """
    captured, end = body.mesh.nodes, state.positions
    rotation = body.best_fit_rotation(end)
    moved = (end - body.centre_of_mass(end)) @ rotation - (captured - body.centre_of_mass(captured))
    total = np.linalg.norm(end - captured, axis=1).max()
    return moved, float(np.linalg.norm(moved, axis=1).max() / body.height), float(total / body.height)


def _anderson_iterate(points: list[np.ndarray], residuals: list[np.ndarray]) -> np.ndarray:
    """Return the next iterate of x <- x - r(x) with Anderson acceleration (Walker and Ni, "Anderson acceleration for
    fixed-point iterations", SIAM Journal on Numerical Analysis 49, 2011); ``points`` and ``residuals`` are the latest
    iterates and their residuals (N, 3), in chronological order."""
    x, r = points[-1], residuals[-1]
    if len(points) == 1:
        return x - r
    moves = np.stack([(b - a).ravel() for a, b in pairwise(points)], axis=1)
    changes = np.stack([(b - a).ravel() for a, b in pairwise(residuals)], axis=1)
    shares = np.linalg.lstsq(changes, r.ravel(), rcond=None)[0]
    return x - r - ((moves - changes) @ shares).reshape(x.shape)
