"""From where a step's program is made to where it is searched, and from the answer to the point that was found.

See ``egs_warp/locomotion/device_plan.py``; numbers are told as ``search_kernel`` reads them.
"""

import warp as wp

from egs_warp.kernels.locomotion.active_set import FOUND
from egs_warp.kernels.locomotion.mode_region import CONE_FRACTION, FREE, SLIDE, STICK, ZERO_FORCE
from egs_warp.kernels.locomotion.mode_search import HEADER_SIZE, normalized
from egs_warp.precision import Vec3, real

wp.set_module_options({"enable_backward": False})

_HEADER, _FOUND = wp.constant(HEADER_SIZE), wp.constant(int(FOUND))
_FREE, _STICK, _SLIDE = wp.constant(FREE), wp.constant(STICK), wp.constant(SLIDE)
_NOTHING, _NEARLY = wp.constant(real(ZERO_FORCE)), wp.constant(real(CONE_FRACTION))


@wp.func
def assemble_contact(told: wp.array[real], kinds: int, slips: int, i: int, force: Vec3, friction: real):
    """How contact ``i`` moves under its ``force``, body weights, which obeys Coulomb's law."""
    pull = wp.sqrt(force[1] * force[1] + force[2] * force[2])
    kind = _FREE
    if force[0] > _NOTHING:
        kind = _STICK
        if pull >= _NEARLY * friction * force[0]:
            kind = _SLIDE
    way = normalized(-force[1], -force[2])
    told[kinds + i] = real(kind)
    told[slips + 2 * i] = way[0]
    told[slips + 2 * i + 1] = way[1]


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
    told_out: wp.array[real],
):
    """The program of m activations and n contacts, of the K for which there are places: the cost's ``form``
    (m + 3K + 1, m + 3K + 1), ``speeds`` (3K, m + 3K + 1) m/s of the contacts, ``shifts`` (K,) m/s, ``bounds`` (3, m) of
    the activations and their start, and ``forces`` (K,) newtons that contact answers there. ``speed`` is sqrt(g H) m/s,
    ``weight`` newtons, ``limit`` the most programs; (m + 6K + 1, m + 3K + 1) threads."""
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
                told_out[_HEADER + row * size + column] = form[row, column]
            elif column == last:
                told_out[q + row] = form[row, last]
    elif row < last + speeds.shape[0]:
        k = row - last
        if k < 3 * n:
            if column < size:
                told_out[rows + k * size + column] = speeds[k, column] / speed
            elif column == last:
                told_out[offset + k] = speeds[k, last] / speed
                if k % 3 == 0:
                    told_out[offset + k] = (speeds[k, last] + shifts[k / 3]) / speed
    else:
        begin = offset + 3 * n
        for part in range(3):
            if column < m:
                told_out[begin + part * m + column] = bounds[part, column]
        kinds = begin + 3 * m
        if column < n:
            assemble_contact(told_out, kinds, kinds + n, column, forces[column] / weight, frictions[0])
        if column == last:
            told_out[0] = real(m)
            told_out[1] = real(n)
            told_out[2] = frictions[0]
            told_out[3] = real(0.5) * form[last, last]
            told_out[4] = real(limit)


@wp.kernel
def scatter_solution_kernel(
    # In:
    counts: wp.array[int],
    answer: wp.array[real],
    m: int,
    # Out:
    x_out: wp.array[real],
):
    """The point of the ``answer`` in ``x_out`` (m + 3K + 1,): zero where no contact is, 1 behind all."""
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
    costly: real,
    # Out:
    settled_out: wp.array[int],
):
    """1 if the ``answer`` is a point that costs so little that no other is sought, else 0; one that is in no contact
    has no other."""
    settled = int(0)
    if answer[0] == real(_FOUND) and answer[4] == real(1.0) and (counts[0] == 0 or answer[3] < costly):
        settled = 1
    settled_out[0] = settled
