"""Test kernels, each of which calls single device functions."""

import warp as wp

from egs_warp.kernels.block import sync_block
from egs_warp.kernels.contact.coulomb import sweep
from egs_warp.kernels.contact.coulomb_equations import Contacts, Newton, solve_equations
from egs_warp.kernels.deformation.decomposition import align_signs, column, match_columns, rotation_part
from egs_warp.kernels.locomotion import block_algebra as algebra
from egs_warp.kernels.locomotion.active_set import ActiveSet, UnitConstraints, find_optimum
from egs_warp.kernels.locomotion.block_elimination import eliminate, inverse_cholesky
from egs_warp.kernels.locomotion.mode_search import BLOCK
from egs_warp.kernels.locomotion.splitting import Splitting, iterate
from egs_warp.precision import real


@wp.kernel
def sweeps_kernel(contacts: Contacts, sweeps: int, forces: wp.array[real]):
    sweep(contacts, sweeps, forces)


@wp.kernel
def equations_kernel(unknowns: int, newton: Newton):
    solve_equations(unknowns, newton)


@wp.kernel
def rotation_parts_kernel(maps: wp.array[wp.mat33], rotations_out: wp.array[wp.mat33]):
    m = maps[wp.tid()]
    rotations_out[wp.tid()] = rotation_part(column(m, 0), column(m, 1), column(m, 2))


@wp.kernel
def orders_kernel(frames: wp.array[wp.mat33], carried: wp.array[wp.mat33], out: wp.array[wp.vec3i]):
    out[wp.tid()] = match_columns(frames[wp.tid()], carried[wp.tid()])


@wp.kernel
def signed_kernel(
    frames: wp.array[wp.mat33], orders: wp.array[wp.vec3i], carried: wp.array[wp.mat33], out: wp.array[wp.mat33]
):
    i = wp.tid()
    out[i] = align_signs(frames[i], orders[i], carried[i])


@wp.kernel(launch_bounds=BLOCK)
def algebra_kernel(
    unknowns: int,
    columns: int,
    matrix: wp.array2d[real],
    symmetric: wp.array2d[real],
    root: wp.array2d[real],
    product: wp.array2d[real],
    turned: wp.array2d[real],
    marks: wp.array[int],
    indices: wp.array[int],
    counts: wp.array[int],
    parts: wp.array2d[int],
    shares: wp.array2d[real],
    lengths: wp.array[real],
    across: wp.array[real],
):
    """Call each function of the dense algebra of a block once."""
    for e in range(algebra.lane_of_block(), unknowns * unknowns, wp.block_dim()):
        product[e / unknowns, e % unknowns] = real(0.0)
        turned[e / unknowns, e % unknowns] = real(0.0)
    sync_block()
    algebra.gemm_add(product, matrix, symmetric, unknowns, unknowns, unknowns, 0)
    algebra.gemm_add(turned, matrix, symmetric, unknowns, unknowns, unknowns, 1)
    counts[0] = inverse_cholesky(symmetric, unknowns, root)
    counts[1] = eliminate(matrix, unknowns, columns, real(1e-12))
    counts[2] = algebra.compact_indices(marks, columns, unknowns, indices)
    mine = real(algebra.lane_of_block() % 7)
    counts[3] = int(algebra.argmax_of_block(mine, algebra.lane_of_block())[1])
    algebra.normalize_rows(matrix, columns, parts, shares, unknowns, lengths)
    algebra.multiply_transposed(product, unknowns, unknowns, lengths, across)


@wp.kernel(launch_bounds=BLOCK)
def iterate_kernel(
    rows: UnitConstraints, holding: ActiveSet, splitting: Splitting, guessed: wp.array[int], ended: wp.array[int]
):
    """Run OSQP's iterations, store the guessed side of each constraint in ``guessed``, and search for the optimum from
    this guess."""
    iterate(rows, holding, splitting)
    for row in range(algebra.lane_of_block(), rows.count, wp.block_dim()):
        guessed[row] = holding.side[row]
    sync_block()
    ended[0] = find_optimum(rows, holding)
