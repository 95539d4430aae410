"""Multifrontal L D L^T factorisation of a sparse symmetric matrix, and solves with its factors, in vectors of four
numbers on a CPU.

The host code is in ``egs_warp.fem.multifrontal``.
"""

import warp as wp

from egs_warp.kernels.fem.products import PANEL, claim_next
from egs_warp.kernels.vectors import FRONT_ELIMINATION, on_cpu
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

PADDING = 16
"""Number of entries behind the end of an array that vector loads may read. Their values have no effect."""

_SIZES = f"""
    constexpr int PANEL = {PANEL};
"""


@wp.struct
class Fronts:
    """Supernodes (``egs_warp.fem.supernodes.Supernodes``) and the memory layout of their blocks."""

    first: wp.array[wp.int32]
    """(S,) first column of each supernode's block."""
    widths: wp.array[wp.int32]
    """(S,) number of columns of each block."""
    row_offsets: wp.array[wp.int32]
    """(S + 1,) offset of each front in ``rows``."""
    rows: wp.array[wp.int32]
    """Permuted rows of all fronts, ascending in each."""
    in_parent: wp.array[wp.int32]
    """Position of each of ``rows`` in the parent's front; only defined for rows below the block."""
    child_offsets: wp.array[wp.int32]
    """(S + 1,) offset of each supernode's children in ``children``."""
    children: wp.array[wp.int32]
    """Child supernodes, grouped by parent."""
    entry_offsets: wp.array[wp.int32]
    """(S + 1,) offset of each block's matrix entries in ``entries``."""
    entries: wp.array[wp.int32]
    """(nnz,) indices of the matrix entries, grouped by block."""
    entry_places: wp.array[wp.int32]
    """(nnz,) position of each of ``entries`` in its front."""
    factor_offsets: wp.array[wp.int32]
    """(S + 1,) offset of each block of L."""
    inverse_offsets: wp.array[wp.int32]
    """(S + 1,) offset of the inverses of each block's diagonal blocks."""
    update_offsets: wp.array[wp.int32]
    """(S,) offset of each front's update matrix on the stack."""
    permutation: wp.array[wp.int32]
    """(n,) position of each unknown in the order of elimination."""


@wp.struct
class MomentumProjection:
    """Momentum projection of solutions (``egs_warp.fem.momentum_projection``)."""

    enabled: wp.int32
    """0 disables the projection."""
    inertia_ratio: wp.array[real]
    """(1,) 1 + dt alpha."""
    rotation_modes: wp.array[real]
    """(3 n,) rigid rotations T, three numbers per unknown."""
    mode_momenta: wp.array[real]
    """(3 n,) M T."""
    rotation_response: wp.array[real]
    """(3 n,) solutions U for the right-hand sides M T."""
    inverse: wp.array[real]
    """(9,) inverse of inertia_ratio (M T)^T U, row by row."""


@wp.func_native(
    on_cpu(
        FRONT_ELIMINATION
        + """
    double* const F = front.data;
    double* const T = F + front_size;
    int negative = 0;
    for (int s = 0; s < count; ++s) {
        const int begin = fronts.row_offsets.data[s], f = fronts.row_offsets.data[s + 1] - begin;
        const int w = fronts.widths.data[s], r = f - w, ld = (f + 7) & ~7, column = fronts.first.data[s];
        for (int i = 0; i < f * ld; ++i) F[i] = 0.0;
        for (int e = fronts.entry_offsets.data[s]; e < fronts.entry_offsets.data[s + 1]; ++e)
            F[fronts.entry_places.data[e]] = matrix.data[fronts.entries.data[e]];
        for (int c = fronts.child_offsets.data[s]; c < fronts.child_offsets.data[s + 1]; ++c) {
            const int child = fronts.children.data[c], end = fronts.row_offsets.data[child + 1];
            const int from = fronts.row_offsets.data[child] + fronts.widths.data[child], k = end - from;
            const int* to = fronts.in_parent.data + from;
            const double* U = stack.data + fronts.update_offsets.data[child];
            for (int a = 0; a < k; ++a, U += k) {
                double* const row = F + to[a] * ld;
                for (int b = 0; b <= a; ++b) row[to[b]] += U[b];
            }
        }
        const int pivots = eliminate_front(F, f, w, ld, T, min_pivot, inverses.data + fronts.inverse_offsets.data[s],
                                           reciprocals.data + column);
        if (pivots < 0) return -1;
        negative += pivots;
        double* const L = factor.data + fronts.factor_offsets.data[s];
        for (int i = 0; i < f; ++i)
            for (int j = 0; j < w; ++j) L[i * w + j] = F[i * ld + j];
        double* const U = stack.data + fronts.update_offsets.data[s];
        for (int a = 0; a < r; ++a)
            for (int b = 0; b <= a; ++b) U[a * r + b] = F[(w + a) * ld + w + b];
    }
    return negative;
""",
        elsewhere="return 0;",
    )
)
def factor_native(
    fronts: Fronts,
    count: wp.int32,
    matrix: wp.array[real],
    min_pivot: real,
    front: wp.array[real],
    front_size: wp.int32,
    stack: wp.array[real],
    factor: wp.array[real],
    inverses: wp.array[real],
    reciprocals: wp.array[real],
) -> wp.int32:
    """Compute the L D L^T factorisation of a sparse symmetric matrix.

    Args:
        fronts: the supernodes.
        count: number of supernodes S.
        matrix: (nnz,) upper entries.
        min_pivot: a pivot of this magnitude or smaller stops the factorisation.
        front: workspace for the largest front and, behind it, scratch memory.
        front_size: size of the largest front, in numbers.
        stack: workspace for update matrices.
        factor: output, blocks of L.
        inverses: output, inverses of the diagonal blocks of L.
        reciprocals: (n,) output, reciprocals of the pivots.

    Returns:
        The number of negative pivots, or -1 if a pivot is too small.
    """
    ...


@wp.func_native(
    on_cpu(
        _SIZES
        + """
    const double* const rhs = (const double*)right;
    double* const out = (double*)solution;
    double* const x = workspace.data + (long long)panel * (unknowns + 4) * PANEL;
    const int from = panel * PANEL, columns = count - from < PANEL ? count - from : PANEL;
    const int width = columns <= 8 ? 8 : 16;
    for (int i = 0; i < unknowns; ++i) {
        double* const row = x + fronts.permutation.data[i] * PANEL;
        const double* g = rhs + i * row_stride + from * column_stride;
        const double by = weights ? ((const double*)weights)[i] : 1.0;
        for (int q = 0; q < columns; ++q) row[q] = by * g[q * column_stride];
        for (int q = columns; q < width; ++q) row[q] = 0.0;
    }
    for (int s = 0; s < blocks; ++s) {
        const int begin = fronts.row_offsets.data[s], f = fronts.row_offsets.data[s + 1] - begin;
        const int w = fronts.widths.data[s], column = fronts.first.data[s];
        const int* const rows = fronts.rows.data + begin;
        const double* const L = factor.data + fronts.factor_offsets.data[s];
        const double* inverse = inverses.data + fronts.inverse_offsets.data[s];
        for (int b = 0; b < w; b += BLOCK, inverse += BLOCK * BLOCK) {
            const int nb = w - b < BLOCK ? w - b : BLOCK;
            for (int h = 0; h < width; h += 8) {
                double* const own = x + (column + b) * PANEL + h;
                bool any = false;
                for (int q = 0; q < nb && !any; ++q)
                    for (int c = 0; c < 8; ++c) any |= own[q * PANEL + c] != 0.0;
                // A block of zeros contributes nothing.
                if (!any) continue;
                for (int g = (nb - 1) & ~3; g >= 0; g -= 4) {
                    double sums[32] = {0.0};
                    const double* l = inverse + g * BLOCK;
                    take_off(sums, sums + 8, sums + 16, sums + 24, l, l + BLOCK, l + 2 * BLOCK, l + 3 * BLOCK, own,
                             PANEL, g + 4 < nb ? g + 4 : nb);
                    for (int q = 0; q < 4 && g + q < nb; ++q)
                        for (int c = 0; c < 8; ++c) own[(g + q) * PANEL + c] = -sums[8 * q + c];
                }
                int i = b + nb;
                for (; i + 4 <= f; i += 4) {
                    const double* l = L + i * w + b;
                    take_off(x + rows[i] * PANEL + h, x + rows[i + 1] * PANEL + h, x + rows[i + 2] * PANEL + h,
                             x + rows[i + 3] * PANEL + h, l, l + w, l + 2 * w, l + 3 * w, own, PANEL, nb);
                }
                for (; i < f; ++i) take_off_one(x + rows[i] * PANEL + h, L + i * w + b, own, PANEL, nb);
            }
        }
    }
    for (int i = 0; i < unknowns; ++i)
        for (int q = 0; q < width; ++q) x[i * PANEL + q] *= reciprocals.data[i];
    for (int s = blocks - 1; s >= 0; s -= 1) {
        const int begin = fronts.row_offsets.data[s], f = fronts.row_offsets.data[s + 1] - begin;
        const int w = fronts.widths.data[s], column = fronts.first.data[s];
        const int* const rows = fronts.rows.data + begin;
        const double* const L = factor.data + fronts.factor_offsets.data[s];
        for (int b = (w - 1) & ~(BLOCK - 1); b >= 0; b -= BLOCK) {
            const int nb = w - b < BLOCK ? w - b : BLOCK;
            const double* inverse = inverses.data + fronts.inverse_offsets.data[s] + b * BLOCK;
            for (int h = 0; h < width; h += 8) {
                double* const own = x + (column + b) * PANEL + h;
                for (int g = 0; g < nb; g += 4) {
                    double* const y = own + g * PANEL;
                    v4 a0 = *(v4*)y, a1 = *(v4*)(y + 4), b0 = *(v4*)(y + PANEL), b1 = *(v4*)(y + PANEL + 4);
                    v4 c0 = *(v4*)(y + 2 * PANEL), c1 = *(v4*)(y + 2 * PANEL + 4);
                    v4 d0 = *(v4*)(y + 3 * PANEL), d1 = *(v4*)(y + 3 * PANEL + 4);
                    const double* l = L + (b + nb) * w + b + g;
                    for (int i = b + nb; i < f; ++i, l += w) {
                        const double* const z = x + rows[i] * PANEL + h;
                        const v4 x0 = *(const v4*)z, x1 = *(const v4*)(z + 4);
                        a0 -= l[0] * x0; a1 -= l[0] * x1; b0 -= l[1] * x0; b1 -= l[1] * x1;
                        c0 -= l[2] * x0; c1 -= l[2] * x1; d0 -= l[3] * x0; d1 -= l[3] * x1;
                    }
                    *(v4*)y = a0; *(v4*)(y + 4) = a1;
                    if (g + 1 < nb) { *(v4*)(y + PANEL) = b0; *(v4*)(y + PANEL + 4) = b1; }
                    if (g + 2 < nb) { *(v4*)(y + 2 * PANEL) = c0; *(v4*)(y + 2 * PANEL + 4) = c1; }
                    if (g + 3 < nb) { *(v4*)(y + 3 * PANEL) = d0; *(v4*)(y + 3 * PANEL + 4) = d1; }
                }
                for (int g = 0; g < nb; g += 4) {
                    v4 a0 = 0.0, a1 = 0.0, b0 = 0.0, b1 = 0.0, c0 = 0.0, c1 = 0.0, d0 = 0.0, d1 = 0.0;
                    const double* l = inverse + g * BLOCK + g;
                    for (int i = g; i < nb; ++i, l += BLOCK) {
                        const double* const z = own + i * PANEL;
                        const v4 x0 = *(const v4*)z, x1 = *(const v4*)(z + 4);
                        a0 += l[0] * x0; a1 += l[0] * x1; b0 += l[1] * x0; b1 += l[1] * x1;
                        c0 += l[2] * x0; c1 += l[2] * x1; d0 += l[3] * x0; d1 += l[3] * x1;
                    }
                    double* const y = own + g * PANEL;
                    *(v4*)y = a0; *(v4*)(y + 4) = a1;
                    if (g + 1 < nb) { *(v4*)(y + PANEL) = b0; *(v4*)(y + PANEL + 4) = b1; }
                    if (g + 2 < nb) { *(v4*)(y + 2 * PANEL) = c0; *(v4*)(y + 2 * PANEL + 4) = c1; }
                    if (g + 3 < nb) { *(v4*)(y + 3 * PANEL) = d0; *(v4*)(y + 3 * PANEL + 4) = d1; }
                }
            }
        }
    }
    double missing[3][PANEL] = {{0.0}}, by[3][PANEL] = {{0.0}};
    if (projection.enabled) {
        for (int i = 0; i < unknowns; ++i) {
            const double* const row = x + fronts.permutation.data[i] * PANEL;
            const double* const g = rhs + i * row_stride + from * column_stride;
            for (int t = 0; t < 3; ++t) {
                const double turn = projection.rotation_modes.data[3 * i + t];
                const double momentum = projection.inertia_ratio.data[0] * projection.mode_momenta.data[3 * i + t];
                for (int q = 0; q < columns; ++q) missing[t][q] += turn * g[q * column_stride] - momentum * row[q];
            }
        }
        for (int t = 0; t < 3; ++t)
            for (int s = 0; s < 3; ++s)
                for (int q = 0; q < columns; ++q) by[t][q] += projection.inverse.data[3 * t + s] * missing[s][q];
    }
    for (int i = 0; i < unknowns; ++i) {
        const double* row = x + fronts.permutation.data[i] * PANEL;
        double* const to = out + (long long)i * solution_stride;
        const double* g = rhs + i * row_stride + from * column_stride;
        if (weights) {
            for (int q = 0; q < columns; ++q) to[q] = dt_now * g[q * column_stride] + dt_ahead * row[q];
        } else if (projection.enabled) {
            const double* const turned = projection.rotation_response.data + 3 * i;
            for (int q = 0; q < columns; ++q)
                to[q] = row[q] + (turned[0] * by[0][q] + turned[1] * by[1][q] + turned[2] * by[2][q]);
        } else {
            for (int q = 0; q < columns; ++q) to[q] = row[q];
        }
    }
"""
    )
)
def solve_panel_native(
    fronts: Fronts,
    blocks: wp.int32,
    unknowns: wp.int32,
    factor: wp.array[real],
    inverses: wp.array[real],
    reciprocals: wp.array[real],
    right: wp.uint64,
    row_stride: wp.int32,
    column_stride: wp.int32,
    count: wp.int32,
    weights: wp.uint64,
    dt_now: real,
    dt_ahead: real,
    projection: MomentumProjection,
    panel: wp.int32,
    workspace: wp.array[real],
    solution: wp.uint64,
    solution_stride: wp.int32,
) -> None:
    """Solve for one panel of right-hand sides B (n, count).

    Without weights, the result is S^-1 B, with the momentum projection if it is enabled. With weights w, the result is
    dt_now B + dt_ahead S^-1 diag(w) B.

    Args:
        fronts: the supernodes.
        blocks: number of supernodes.
        unknowns: n.
        factor: blocks of L.
        inverses: inverses of the diagonal blocks of L.
        reciprocals: (n,) reciprocals of the pivots.
        right: address of B, float64.
        row_stride: row stride of B, in float64 values.
        column_stride: column stride of B, in float64 values.
        count: number of columns of B.
        weights: address of w (n,), or 0.
        dt_now: factor of B, s.
        dt_ahead: factor of the solution, s.
        projection: momentum projection.
        panel: index of the panel.
        workspace: (panels, n + 4, ``PANEL``) scratch memory.
        solution: address of the panel's first column of the output.
        solution_stride: row stride of the output, in float64 values.
    """
    ...


@wp.func_native(
    on_cpu(
        _SIZES
        + """
    const double* const rhs = (const double*)right;
    double* const out = (double*)solution;
    double* const x = workspace.data;
    auto sum_of = [](v4 v) { return (v[0] + v[1]) + (v[2] + v[3]); };
    for (int i = 0; i < unknowns; ++i) x[fronts.permutation.data[i]] = rhs[i * row_stride];
    for (int s = 0; s < blocks; ++s) {
        const int begin = fronts.row_offsets.data[s], f = fronts.row_offsets.data[s + 1] - begin;
        const int w = fronts.widths.data[s], column = fronts.first.data[s];
        const int* const rows = fronts.rows.data + begin;
        const double* const L = factor.data + fronts.factor_offsets.data[s];
        const double* inverse = inverses.data + fronts.inverse_offsets.data[s];
        for (int b = 0; b < w; b += BLOCK, inverse += BLOCK * BLOCK) {
            const int nb = w - b < BLOCK ? w - b : BLOCK, fours = (nb + 3) >> 2;
            double* const own = x + column + b;
            double copy[BLOCK] = {0.0};
            for (int j = 0; j < nb; ++j) copy[j] = own[j];
            for (int i = 0; i < nb; ++i) {
                v4 a = 0.0;
                for (int k = 0; k < fours; ++k) a += *(const v4*)(inverse + i * BLOCK + 4 * k) * *(v4*)(copy + 4 * k);
                own[i] = sum_of(a);
            }
            for (int j = 0; j < nb; ++j) copy[j] = own[j];
            // Numbers behind the end of a row are multiplied by zero.
            const double* l = L + (b + nb) * w + b;
            for (int i = b + nb; i < f; ++i, l += w) {
                v4 a = *(const v4*)l * *(v4*)copy;
                for (int k = 1; k < fours; ++k) a += *(const v4*)(l + 4 * k) * *(v4*)(copy + 4 * k);
                x[rows[i]] -= sum_of(a);
            }
        }
    }
    for (int i = 0; i < unknowns; ++i) x[i] *= reciprocals.data[i];
    for (int s = blocks - 1; s >= 0; s -= 1) {
        const int begin = fronts.row_offsets.data[s], f = fronts.row_offsets.data[s + 1] - begin;
        const int w = fronts.widths.data[s], column = fronts.first.data[s];
        const int* const rows = fronts.rows.data + begin;
        const double* const L = factor.data + fronts.factor_offsets.data[s];
        for (int b = (w - 1) & ~(BLOCK - 1); b >= 0; b -= BLOCK) {
            const int nb = w - b < BLOCK ? w - b : BLOCK, fours = (nb + 3) >> 2;
            const double* const inverse = inverses.data + fronts.inverse_offsets.data[s] + b * BLOCK;
            double* const own = x + column + b;
            v4 a[4] = {0.0, 0.0, 0.0, 0.0}, c[4] = {0.0, 0.0, 0.0, 0.0};
            const double* l = L + (b + nb) * w + b;
            for (int i = b + nb; i < f; ++i, l += w) {
                const double by = x[rows[i]];
                for (int k = 0; k < fours; ++k) a[k] += *(const v4*)(l + 4 * k) * by;
            }
            for (int i = 0; i < nb; ++i) {
                const double by = own[i] - a[i >> 2][i & 3];
                for (int k = 0; k < fours; ++k) c[k] += *(const v4*)(inverse + i * BLOCK + 4 * k) * by;
            }
            for (int i = 0; i < nb; ++i) own[i] = c[i >> 2][i & 3];
        }
    }
    for (int i = 0; i < unknowns; ++i) out[i] = x[fronts.permutation.data[i]];
"""
    )
)
def solve_vector_native(
    fronts: Fronts,
    blocks: wp.int32,
    unknowns: wp.int32,
    factor: wp.array[real],
    inverses: wp.array[real],
    reciprocals: wp.array[real],
    right: wp.uint64,
    row_stride: wp.int32,
    workspace: wp.array[real],
    solution: wp.uint64,
) -> None:
    """Solve for a single right-hand side (n,); arguments as in ``solve_panel_native``, with a contiguous
    ``solution``."""
    ...


@wp.func_native(
    on_cpu("""
    const double* const rhs = (const double*)right;
    double *const x = (double*)solution, missing[3] = {0.0, 0.0, 0.0}, by[3] = {0.0, 0.0, 0.0};
    if (!projection.enabled) return;
    for (int i = 0; i < unknowns; ++i)
        for (int t = 0; t < 3; ++t)
            missing[t] += projection.rotation_modes.data[3 * i + t] * rhs[i * row_stride]
                - projection.inertia_ratio.data[0] * projection.mode_momenta.data[3 * i + t] * x[i];
    for (int t = 0; t < 9; ++t) by[t / 3] += projection.inverse.data[t] * missing[t % 3];
    for (int i = 0; i < unknowns; ++i)
        for (int t = 0; t < 3; ++t) x[i] += projection.rotation_response.data[3 * i + t] * by[t];
""")
)
def project_vector_native(
    unknowns: wp.int32, projection: MomentumProjection, right: wp.uint64, row_stride: wp.int32, solution: wp.uint64
) -> None:
    """Apply the momentum ``projection``, if it is enabled, to the ``solution`` (n,) for the right-hand side ``right``
    (n,)."""
    ...


@wp.kernel
def factor_kernel(
    fronts: Fronts,
    count: wp.int32,
    matrix: wp.array[real],
    min_pivot: real,
    front: wp.array[real],
    front_size: wp.int32,
    stack: wp.array[real],
    factor: wp.array[real],
    inverses: wp.array[real],
    reciprocals: wp.array[real],
    negative: wp.array[wp.int32],
) -> None:
    """Factor the matrix with ``factor_native``, and store its return value in ``negative`` (1,)."""
    negative[0] = factor_native(
        fronts, count, matrix, min_pivot, front, front_size, stack, factor, inverses, reciprocals
    )


@wp.kernel
def solve_kernel(
    counters: wp.array[wp.int32],
    fronts: Fronts,
    blocks: wp.int32,
    unknowns: wp.int32,
    factor: wp.array[real],
    inverses: wp.array[real],
    reciprocals: wp.array[real],
    right: wp.uint64,
    row_stride: wp.int32,
    column_stride: wp.int32,
    count: wp.int32,
    projection: MomentumProjection,
    workspace: wp.array[real],
    solution: wp.uint64,
) -> None:
    """Solve for all right-hand sides: take panels from counter 0 and call ``solve_panel_native`` for each of them.

    A single right-hand side is solved by ``solve_vector_native``. Several launches may share the work.

    Args:
        counters: shared counters, of which the first is the next panel.
        fronts, blocks, unknowns, factor, inverses, reciprocals: factors of S (``solve_panel_native``).
        right, row_stride, column_stride, count: address, strides and number of the right-hand sides.
        projection: momentum projection of the solutions.
        workspace: scratch memory of ``solve_panel_native``.
        solution: address of the output (n, count), float64.
    """
    if count == 1:
        solve_vector_native(
            fronts, blocks, unknowns, factor, inverses, reciprocals, right, row_stride, workspace, solution
        )
        project_vector_native(unknowns, projection, right, row_stride, solution)
        return
    panel = claim_next(counters, 0)
    while PANEL * panel < count:
        solve_panel_native(
            fronts, blocks, unknowns, factor, inverses, reciprocals, right, row_stride, column_stride, count,
            wp.uint64(0), real(0.0), real(1.0), projection, panel, workspace,
            solution + wp.uint64(8 * PANEL * panel), count,
        )  # fmt: skip
        panel = claim_next(counters, 0)
