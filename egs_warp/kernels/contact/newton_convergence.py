"""Convergence test of the Newton loop with contact (Eq. 4, 8); see ``egs_warp/contact/newton_convergence.py``."""

import warp as wp

from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

REFACTOR_RATIO = 0.7
"""A tangent is made anew where the residual falls by less than this factor, but in the first step of a round, in which
forces of contacts that are new come about. It takes as long as many steps by an old one."""
MIN_DECREASE = 1e-4
"""Of the residuals that a whole step must undercut: by so much."""
RESIDUAL_WINDOW = 3
"""Residuals of which the largest must be undercut."""
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
"""What is known of a round, one behind the other: its steps so far, the residual where the next begins and where the
first without a look began, the terms of ``Course``, the most steps, how many were taken without a look, and ``MEMORY``
residuals, -1 for those that are not there."""
HEADER_SIZE = RECENT_RESIDUALS + RESIDUAL_WINDOW

_SLOW, _LESS, _MEMORY = wp.constant(real(REFACTOR_RATIO)), wp.constant(real(MIN_DECREASE)), wp.constant(RESIDUAL_WINDOW)
_STEPS, _SIZE, _FIRST = wp.constant(STEPS), wp.constant(RESIDUAL), wp.constant(FIRST_RESIDUAL)
_TOLERANCE = wp.constant(TOLERANCE)
_JOINING, _ANSWERED, _MOST = wp.constant(ACTIVATION_RESIDUAL), wp.constant(COULOMB_TOLERANCE), wp.constant(MAX_STEPS)
_TAKEN, _RECENT, _HEADER = wp.constant(STEPS_TAKEN), wp.constant(RECENT_RESIDUALS), wp.constant(HEADER_SIZE)


@wp.kernel
def init_convergence_kernel(
    # In:
    enabled: wp.array[int],
    sizes: wp.array[real],
    # In and out:
    course: wp.array[real],
    # Out:
    going_out: wp.array[int],
):
    """The round whose course was told goes on, if all is as ``usual``, from the residual that was told, or, where that
    is less than 0, from the one of ``sizes[0]``."""
    if course[_SIZE] < real(0.0):
        course[_SIZE] = sizes[0]
    course[_FIRST] = course[_SIZE]
    going_out[0] = enabled[0]


@wp.kernel
def check_convergence_kernel(
    # In:
    sizes: wp.array[real],
    missed: wp.array[real],
    sinking: wp.array[real],
    # In and out:
    course: wp.array[real],
    # Out:
    going_out: wp.array[int],
):
    """A step has come to a residual of ``sizes[0]``, with forces that have ``missed`` their laws by so many m/s, and so
    many points are ``sinking``: whether the next is as plain. Behind the header of ``course`` are the residuals of all
    steps that were taken."""
    size = sizes[0]
    before = course[_SIZE]
    most = real(-1.0)
    for k in range(_MEMORY):
        most = wp.max(most, course[_RECENT + k])
    undercut = wp.max((real(1.0) - _LESS) * most, course[_TOLERANCE])
    if most < real(0.0):
        undercut = real(wp.inf)
    goes = int(0)
    if size > course[_TOLERANCE] and size < undercut and missed[0] <= course[_ANSWERED]:
        goes = 1
    if course[_STEPS] > real(0.0) and size > _SLOW * before:
        goes = 0
    if sinking[0] > real(0.0) and before > course[_JOINING] and size <= course[_JOINING]:
        goes = 0
    taken = int(course[_TAKEN])
    course[_HEADER + taken] = size
    course[_TAKEN] = real(taken + 1)
    course[_STEPS] += real(1.0)
    if course[_STEPS] >= course[_MOST]:
        goes = 0
    for k in range(_MEMORY - 1):
        course[_RECENT + k] = course[_RECENT + k + 1]
    course[_RECENT + _MEMORY - 1] = size
    course[_SIZE] = size
    going_out[0] = goes
