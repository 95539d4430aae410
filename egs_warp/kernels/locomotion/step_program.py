"""Kernels that pack the QP of a step for ``mode_search_kernel``, and unpack its result, on the device.

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
    """Write the mode and the slip direction that contact ``i`` has under a ``force`` that satisfies Coulomb's law.

    Args:
        packed: packed search input.
        kinds: offset of the modes in ``packed``.
        slips: offset of the slip directions in ``packed``.
        i: index of the contact.
        force: normal and two tangential components, in body weights.
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
    form: wp.array3d[real],
    speeds: wp.array3d[real],
    shifts: wp.array2d[real],
    bounds: wp.array3d[real],
    forces: wp.array2d[Vec3],
    # Out:
    packed_out: wp.array2d[real],
):
    """Pack the QP of each world, with m activations and n contacts; buffers have a capacity of K contacts.

    The launch dimensions are (B, m + 6K + 1, m + 3K + 1).

    Args:
        limit: maximum number of QPs that the search may solve.
        speed: sqrt(g H), m/s, the unit of velocity.
        weight: body weight, N, the unit of force.
        counts: (B,) number of contacts n.
        frictions: (B,) Coulomb coefficients.
        form: (B, m + 3K + 1, m + 3K + 1) quadratic form of the cost.
        speeds: (B, 3K, m + 3K + 1) m/s, contact velocities as affine functions of activations and forces.
        shifts: (B, K) m/s, normal bias of each contact.
        bounds: (B, 3, m) lower bounds, upper bounds and start of the activations.
        forces: (B, K) N, contact forces at the start.
        packed_out: (B, ...) packed search input.
    """
    world, row, column = wp.tid()
    m = bounds.shape[2]
    n = counts[world]
    size = m + 3 * n
    last = form.shape[1] - 1
    q = _HEADER + size * size
    rows = q + size
    offset = rows + 3 * n * size
    if row < last:
        if row < size:
            if column < size:
                packed_out[world, _HEADER + row * size + column] = form[world, row, column]
            elif column == last:
                packed_out[world, q + row] = form[world, row, last]
    elif row < last + speeds.shape[1]:
        k = row - last
        if k < 3 * n:
            if column < size:
                packed_out[world, rows + k * size + column] = speeds[world, k, column] / speed
            elif column == last:
                packed_out[world, offset + k] = speeds[world, k, last] / speed
                if k % 3 == 0:
                    packed_out[world, offset + k] = (speeds[world, k, last] + shifts[world, k / 3]) / speed
    else:
        begin = offset + 3 * n
        for part in range(3):
            if column < m:
                packed_out[world, begin + part * m + column] = bounds[world, part, column]
        kinds = begin + 3 * m
        if column < n:
            force = forces[world, column] / weight
            assemble_contact(packed_out[world], kinds, kinds + n, column, force, frictions[world])
        if column == last:
            packed_out[world, 0] = real(m)
            packed_out[world, 1] = real(n)
            packed_out[world, 2] = frictions[world]
            packed_out[world, 3] = real(0.5) * form[world, last, last]
            packed_out[world, 4] = real(limit)


@wp.kernel
def scatter_solution_kernel(
    # In:
    counts: wp.array[int],
    answer: wp.array2d[real],
    m: int,
    # Out:
    x_out: wp.array2d[real],
):
    """Expand the result of each world's search to the contact capacity K.

    The launch dimensions are (B, m + 3K + 1).

    Args:
        counts: (B,) number of contacts n.
        answer: (B, ...) packed search result.
        m: number of activations.
        x_out: (B, m + 3K + 1) activations and contact forces, with zeros for unused contacts and 1 as the last entry.
    """
    world, k = wp.tid()
    size = m + 3 * counts[world]
    last = x_out.shape[1] - 1
    value = real(0.0)
    if k < size:
        value = answer[world, _HEADER + k]
    elif k == last:
        value = real(1.0)
    x_out[world, k] = value


@wp.kernel
def accept_search_kernel(
    # In:
    counts: wp.array[int],
    answer: wp.array[real],
    restart_cost: real,
    # Out:
    settled_out: wp.array[int],
):
    """Write 1 to ``settled_out`` (1,) if no restart is needed after the search, and otherwise 0.

    No restart is needed if the search found a point and either its objective is below ``restart_cost``, or the step has
    no contacts and therefore only one region.

    Args:
        counts: (1,) number of contacts.
        answer: packed search result.
        restart_cost: objective below which no restart is needed.
        settled_out: (1,) output.
    """
    settled = int(0)
    if answer[0] == real(_OPTIMUM_FOUND) and answer[4] == real(1.0) and (counts[0] == 0 or answer[3] < restart_cost):
        settled = 1
    settled_out[0] = settled
