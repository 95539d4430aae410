"""Kernels that pack the QP of a step for ``mode_search_kernel`` and unpack its result, on the device.

The host code is in ``egs_warp/locomotion/device_plan.py``. ``mode_search_kernel`` documents the packed layout.
"""

import warp as wp

from egs_warp.kernels.locomotion.active_set import OPTIMUM_FOUND
from egs_warp.kernels.locomotion.mode_region import CONE_FRACTION, FREE, SLIDE, STICK, ZERO_FORCE
from egs_warp.kernels.locomotion.mode_search import HEADER_SIZE, normalized
from egs_warp.precision import Vec3, real

wp.set_module_options({"enable_backward": False})

_HEADER, _OPTIMUM_FOUND = wp.constant(HEADER_SIZE), wp.constant(int(OPTIMUM_FOUND))
_FREE, _STICK, _SLIDE = wp.constant(FREE), wp.constant(STICK), wp.constant(SLIDE)
_ZERO_FORCE, _CONE_FRACTION = wp.constant(real(ZERO_FORCE)), wp.constant(real(CONE_FRACTION))


@wp.func
def assemble_contact(packed: wp.array[real], kinds: int, slips: int, i: int, force: Vec3, friction: real):
    """Write the mode and slip direction of contact ``i`` under its ``force``, which satisfies Coulomb's law.

    Args:
        packed: packed search input.
        kinds: offset of the modes in ``packed``.
        slips: offset of the slip directions in ``packed``.
        i: the contact.
        force: normal and two tangential components, body weights.
        friction: Coulomb coefficient.
    """
    tangential = wp.sqrt(force[1] * force[1] + force[2] * force[2])
    kind = _FREE
    if force[0] > _ZERO_FORCE:
        kind = _STICK
        if tangential >= _CONE_FRACTION * friction * force[0]:
            kind = _SLIDE
    slip_direction = normalized(-force[1], -force[2])
    packed[kinds + i] = real(kind)
    packed[slips + 2 * i] = slip_direction[0]
    packed[slips + 2 * i + 1] = slip_direction[1]


@wp.kernel
def assemble_qp_kernel(
    # Model:
    limit: int,
    speed: real,
    weight: real,
    # In:
    counts: wp.array[int],
    frictions: wp.array[real],
    form: wp.array2d[real],
    speeds: wp.array2d[real],
    shifts: wp.array[real],
    bounds: wp.array2d[real],
    forces: wp.array[Vec3],
    # Out:
    packed_out: wp.array[real],
):
    """Pack the QP of m activations and n contacts; buffers have a capacity of K contacts.

    Launch with (m + 6K + 1, m + 3K + 1) threads.

    Args:
        limit: maximum number of QPs that the search may solve.
        speed: sqrt(g H), m/s, the unit of velocity.
        weight: body weight, N, the unit of force.
        counts: (1,) number of contacts n.
        frictions: (1,) Coulomb coefficient.
        form: (m + 3K + 1, m + 3K + 1) quadratic form of the cost.
        speeds: (3K, m + 3K + 1) m/s, contact velocities as affine functions.
        shifts: (K,) m/s, normal bias of each contact.
        bounds: (3, m) lower bounds, upper bounds and start of the activations.
        forces: (K,) N, contact forces at the start.
        packed_out: packed search input.
    """
    row, column = wp.tid()
    m = bounds.shape[1]
    n = counts[0]
    size = m + 3 * n
    last = form.shape[0] - 1
    q = _HEADER + size * size
    rows = q + size
    offset = rows + 3 * n * size
    if row < last:
        if row < size:
            if column < size:
                packed_out[_HEADER + row * size + column] = form[row, column]
            elif column == last:
                packed_out[q + row] = form[row, last]
    elif row < last + speeds.shape[0]:
        k = row - last
        if k < 3 * n:
            if column < size:
                packed_out[rows + k * size + column] = speeds[k, column] / speed
            elif column == last:
                packed_out[offset + k] = speeds[k, last] / speed
                if k % 3 == 0:
                    packed_out[offset + k] = (speeds[k, last] + shifts[k / 3]) / speed
    else:
        begin = offset + 3 * n
        for part in range(3):
            if column < m:
                packed_out[begin + part * m + column] = bounds[part, column]
        kinds = begin + 3 * m
        if column < n:
            assemble_contact(packed_out, kinds, kinds + n, column, forces[column] / weight, frictions[0])
        if column == last:
            packed_out[0] = real(m)
            packed_out[1] = real(n)
            packed_out[2] = frictions[0]
            packed_out[3] = real(0.5) * form[last, last]
            packed_out[4] = real(limit)


@wp.kernel
def scatter_solution_kernel(
    # In:
    counts: wp.array[int],
    answer: wp.array[real],
    m: int,
    # Out:
    x_out: wp.array[real],
):
    """Expand the point of the search result to the contact capacity K.

    Args:
        counts: (1,) number of contacts n.
        answer: packed search result.
        m: number of activations.
        x_out: (m + 3K + 1,) the point, with zeros for unused contacts and 1 as the last entry.
    """
    k = wp.tid()
    size = m + 3 * counts[0]
    last = x_out.shape[0] - 1
    value = real(0.0)
    if k < size:
        value = answer[_HEADER + k]
    elif k == last:
        value = real(1.0)
    x_out[k] = value


@wp.kernel
def accept_search_kernel(
    # In:
    counts: wp.array[int],
    answer: wp.array[real],
    restart_cost: real,
    # Out:
    settled_out: wp.array[int],
):
    """Write 1 to ``settled_out`` if no restart is needed after the search, and otherwise 0.

    No restart is needed if the search found a point and its objective is below ``restart_cost``, or if the step has no
    contacts, so that there is no other region.
    """
    settled = int(0)
    if answer[0] == real(_OPTIMUM_FOUND) and answer[4] == real(1.0) and (counts[0] == 0 or answer[3] < restart_cost):
        settled = 1
    settled_out[0] = settled
