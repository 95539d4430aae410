"""Rule that accepts, shortens and ends Newton steps on motion and contact, in any number of worlds (Eq. 4, 8)."""

import warp as wp

from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

REFACTOR_RATIO = 0.7
"""Fraction of the residual that a step may leave without an update of the tangent. The first step of a round is exempt,
because it creates the forces of new contacts. Computing a new tangent takes as long as many steps."""
MIN_DECREASE = 1e-4
"""Sufficient decrease of a full step, as a fraction of the largest recent residual."""
RESIDUAL_WINDOW = 3
"""Number of recent residuals; the residual after a step must be below the largest of them."""
MIN_STEP_LENGTH = 1e-3
"""Step length below which the line search fails, as a fraction of a Newton step."""
MAX_COULOMB_FAILURES = 3
"""Maximum number of Newton steps of a round whose forces may violate Coulomb's law by more than the tolerance. One more
such step ends the round without convergence."""
(
    STEPS,
    RESIDUAL,
    PREVIOUS_RESIDUAL,
    LENGTH,
    COULOMB_FAILURES,
    TANGENT_IS_CURRENT,
    OUTCOME,
    UNIT,
    TOLERANCE,
    ACTIVATION_RESIDUAL,
    COULOMB_TOLERANCE,
    MAX_STEPS,
    RECENT_RESIDUALS,
) = range(13)
"""Columns of the progress of a world, in this order:

* ``STEPS``: number of completed steps of the round;
* ``RESIDUAL``: residual at the start of the next step, -1 if it has not been downloaded to the host;
* ``PREVIOUS_RESIDUAL``: residual at the start of the last step;
* ``LENGTH``: fraction of the Newton step that the next trial takes;
* ``COULOMB_FAILURES``: number of steps whose forces violated Coulomb's law;
* ``TANGENT_IS_CURRENT``: 1 if the tangent was computed at the current velocities;
* ``OUTCOME``: outcome of the last trial;
* ``UNIT``: unit of the residuals of trials, by which they are divided before they are stored;
* ``TOLERANCE``, ``ACTIVATION_RESIDUAL``, ``COULOMB_TOLERANCE``: tolerances, see ``NewtonProgress``;
* ``MAX_STEPS``: number of steps at which a loop on a GPU returns to the host;
* ``RECENT_RESIDUALS``: the first of ``RESIDUAL_WINDOW`` columns of recent residuals, -1 if there are fewer.
"""
ROW_SIZE = RECENT_RESIDUALS + RESIDUAL_WINDOW
"""Number of columns of the progress."""
ACCEPTED, SHORTEN, NEEDS_TANGENT, ENDED, NEAR_END, FAILED, REPEAT = 1, 2, 4, 8, 16, 32, 64
"""Bits of an outcome. ``ACCEPTED``: the trial is the new iterate. ``SHORTEN``: try half the step length.
``NEEDS_TANGENT``: update the tangent before the next step. ``ENDED``: the equations hold to the tolerances.
``NEAR_END``: search for points that penetrate too far. ``FAILED``: end the round without convergence. ``REPEAT``: the
Coulomb solve failed numerically and must be repeated; the trial has not been judged."""

_REFACTOR_RATIO, _MIN_DECREASE = wp.constant(real(REFACTOR_RATIO)), wp.constant(real(MIN_DECREASE))
_MIN_LENGTH, _MAX_FAILURES = wp.constant(real(MIN_STEP_LENGTH)), wp.constant(real(MAX_COULOMB_FAILURES))


@wp.kernel
def begin_loop_kernel(
    # In:
    enabled: wp.array[int],
    sizes: wp.array[real],
    # In and out:
    progress: wp.array2d[real],
    # Out:
    running_out: wp.array[int],
):
    """Prepare the ``progress`` of each world for a loop of trials on the device.

    Clear the outcome, replace an unknown residual by that of the last trial, and set the condition of the loop.

    Args:
        enabled: (c,) 0 to skip the loop.
        sizes: (c,) residual norms of the last trials, before the division by the ``UNIT`` of the row.
        progress: (c, ``ROW_SIZE``) progress, updated.
        running_out: (c,) condition of the loop, equal to ``enabled``.
    """
    world = wp.tid()
    if progress[world, RESIDUAL] < real(0.0):
        progress[world, RESIDUAL] = sizes[world] / progress[world, UNIT]
    progress[world, PREVIOUS_RESIDUAL] = progress[world, RESIDUAL]
    progress[world, OUTCOME] = real(0.0)
    running_out[world] = enabled[world]


@wp.func
def judge_step(progress: wp.array2d[real], world: int, size: real, violation: real, failure_tolerance: real) -> int:
    """Judge the last trial of ``world``, update its row of ``progress``, and return the outcome.

    Args:
        progress: (c, ``ROW_SIZE``) progress.
        world: index of the world.
        size: residual of the trial, divided by the ``UNIT`` of the row.
        violation: m/s, violation of Coulomb's law by the forces of the trial.
        failure_tolerance: violation in m/s above which the Coulomb solve has failed numerically.
    """
    before = progress[world, RESIDUAL]
    progress[world, PREVIOUS_RESIDUAL] = before
    if violation > failure_tolerance:
        return REPEAT
    length = progress[world, LENGTH]
    tolerance = progress[world, TOLERANCE]
    maximum = real(-1.0)
    for k in range(RESIDUAL_WINDOW):
        maximum = wp.max(maximum, progress[world, RECENT_RESIDUALS + k])
    # The acceptance test is not monotone, because the forces change at once when contacts open, close or begin to
    # slide.
    limit = wp.max((real(1.0) - _MIN_DECREASE * length) * maximum, tolerance)
    if maximum < real(0.0):
        limit = real(wp.inf)
    is_accepted = wp.isfinite(size) and size < limit
    if not is_accepted and length > real(2.0) * _MIN_LENGTH:
        progress[world, LENGTH] = real(0.5) * length
        return SHORTEN
    progress[world, LENGTH] = real(1.0)
    is_first = progress[world, STEPS] == real(0.0)
    progress[world, STEPS] += real(1.0)
    is_violated = violation > progress[world, COULOMB_TOLERANCE]
    if is_violated:
        progress[world, COULOMB_FAILURES] += real(1.0)
    was_current = progress[world, TANGENT_IS_CURRENT] > real(0.0)
    progress[world, TANGENT_IS_CURRENT] = real(0.0)
    outcome = int(0)
    if progress[world, COULOMB_FAILURES] > _MAX_FAILURES:
        outcome |= FAILED
    if not is_accepted:
        outcome |= NEEDS_TANGENT
        if was_current:
            outcome |= FAILED
        return outcome
    outcome |= ACCEPTED
    for k in range(RESIDUAL_WINDOW - 1):
        progress[world, RECENT_RESIDUALS + k] = progress[world, RECENT_RESIDUALS + k + 1]
    progress[world, RECENT_RESIDUALS + RESIDUAL_WINDOW - 1] = size
    progress[world, RESIDUAL] = size
    # After a full step the contact velocities are, by linearity, those of the Coulomb solve, so they satisfy the law.
    is_consistent = length == real(1.0) and not is_violated
    if not is_consistent or (not is_first and size > _REFACTOR_RATIO * before):
        outcome |= NEEDS_TANGENT
    if is_consistent:
        is_end = size <= tolerance
        activation = progress[world, ACTIVATION_RESIDUAL]
        if is_end:
            outcome |= ENDED
        if activation >= real(0.0) and (is_end or (before > activation and size <= activation)):
            outcome |= NEAR_END
    return outcome


@wp.kernel
def judge_steps_kernel(
    # Model:
    failure_tolerance: real,
    # In:
    sizes: wp.array[real],
    violations: wp.array[real],
    penetrating: wp.array[real],
    # In and out:
    progress: wp.array2d[real],
    # Out:
    running_out: wp.array[int],
):
    """Judge the last trial of each world, and decide whether a loop on the device may continue without the host.

    Args:
        failure_tolerance: violation in m/s above which the Coulomb solve has failed numerically.
        sizes: (c,) residual norms of the trials, before the division by the ``UNIT`` of the row.
        violations: (c,) m/s, violations of Coulomb's law by the forces of the trials.
        penetrating: (c,) number of points that penetrate too far.
        progress: (c, ``ROW_SIZE``) progress, updated.
        running_out: (c,) 1 if the loop may continue, else 0.
    """
    world = wp.tid()
    outcome = judge_step(progress, world, sizes[world] / progress[world, UNIT], violations[world], failure_tolerance)
    progress[world, OUTCOME] = real(outcome)
    is_plain = outcome == ACCEPTED or (outcome == (ACCEPTED | NEAR_END) and penetrating[world] == real(0.0))
    running_out[world] = int(0)
    if is_plain and progress[world, STEPS] < progress[world, MAX_STEPS]:
        running_out[world] = int(1)
