"""Convergence test of the Newton loop with contact on a GPU (Eq. 4, 8); ``egs_warp/contact/newton_convergence.py`` has
the same test for the host.
"""

import warp as wp

from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

REFACTOR_RATIO = 0.7
"""The tangent is updated if a step leaves more than this fraction of the residual. The first step of a round is
exempt, because it creates the forces of new contacts. A new tangent takes as long as many steps.
"""
MIN_DECREASE = 1e-4
"""Sufficient decrease of a full step, as a fraction of the largest recent residual."""
RESIDUAL_WINDOW = 3
"""Number of recent residuals; a step must end below the largest of them."""
(
    STEPS,
    RESIDUAL,
    FIRST_RESIDUAL,
    TOLERANCE,
    ACTIVATION_RESIDUAL,
    COULOMB_TOLERANCE,
    MAX_STEPS,
    STEPS_TAKEN,
    RECENT_RESIDUALS,
) = range(9)
"""Indices into the packed state: steps so far, residual at the start of the next step, residual at the start of the
loop, the fields of ``ConvergenceState``, step limit, steps taken by this loop, and ``RESIDUAL_WINDOW`` recent
residuals, -1 where there is none.
"""
HEADER_SIZE = RECENT_RESIDUALS + RESIDUAL_WINDOW

_REFACTOR_RATIO, _MIN_DECREASE, _WINDOW = (
    wp.constant(real(REFACTOR_RATIO)),
    wp.constant(real(MIN_DECREASE)),
    wp.constant(RESIDUAL_WINDOW),
)
_STEPS, _RESIDUAL, _FIRST_RESIDUAL = wp.constant(STEPS), wp.constant(RESIDUAL), wp.constant(FIRST_RESIDUAL)
_TOLERANCE = wp.constant(TOLERANCE)
_ACTIVATION_RESIDUAL, _COULOMB_TOLERANCE, _MAX_STEPS = (
    wp.constant(ACTIVATION_RESIDUAL),
    wp.constant(COULOMB_TOLERANCE),
    wp.constant(MAX_STEPS),
)
_STEPS_TAKEN, _RECENT, _HEADER = wp.constant(STEPS_TAKEN), wp.constant(RECENT_RESIDUALS), wp.constant(HEADER_SIZE)


@wp.kernel
def init_convergence_kernel(
    # In:
    enabled: wp.array[int],
    sizes: wp.array[real],
    # In and out:
    state: wp.array[real],
    # Out:
    condition_out: wp.array[int],
):
    """Set the loop condition to ``enabled``. A negative residual in the packed ``state`` is replaced by
    ``sizes[0]``, the residual of the last trial.
    """
    if state[_RESIDUAL] < real(0.0):
        state[_RESIDUAL] = sizes[0]
    state[_FIRST_RESIDUAL] = state[_RESIDUAL]
    condition_out[0] = enabled[0]


@wp.kernel
def check_convergence_kernel(
    # In:
    sizes: wp.array[real],
    violation: wp.array[real],
    penetrating: wp.array[real],
    # In and out:
    state: wp.array[real],
    # Out:
    condition_out: wp.array[int],
):
    """Test whether the loop on the device may take another step without the host.

    The last step ended at the residual ``sizes[0]`` in N s. Its forces violate Coulomb's law by ``violation[0]`` m/s,
    and ``penetrating[0]`` points penetrate too far. The residual after each step is stored behind the header of
    ``state``.
    """
    size = sizes[0]
    before = state[_RESIDUAL]
    maximum = real(-1.0)
    for k in range(_WINDOW):
        maximum = wp.max(maximum, state[_RECENT + k])
    limit = wp.max((real(1.0) - _MIN_DECREASE) * maximum, state[_TOLERANCE])
    if maximum < real(0.0):
        limit = real(wp.inf)
    proceed = int(0)
    if size > state[_TOLERANCE] and size < limit and violation[0] <= state[_COULOMB_TOLERANCE]:
        proceed = 1
    if state[_STEPS] > real(0.0) and size > _REFACTOR_RATIO * before:
        proceed = 0
    if penetrating[0] > real(0.0) and before > state[_ACTIVATION_RESIDUAL] and size <= state[_ACTIVATION_RESIDUAL]:
        proceed = 0
    steps_taken = int(state[_STEPS_TAKEN])
    state[_HEADER + steps_taken] = size
    state[_STEPS_TAKEN] = real(steps_taken + 1)
    state[_STEPS] += real(1.0)
    if state[_STEPS] >= state[_MAX_STEPS]:
        proceed = 0
    for k in range(_WINDOW - 1):
        state[_RECENT + k] = state[_RECENT + k + 1]
    state[_RECENT + _WINDOW - 1] = size
    state[_RESIDUAL] = size
    condition_out[0] = proceed
