"""Factors L D L^T of a sparse matrix by fronts, and solutions with them: dense arithmetic in vectors of four, on a CPU.

See ``egs_warp/fem/multifrontal.py``.
"""

import warp as wp

from egs_warp.kernels.fem.products import (
    PANEL,
    STRIP,
    Rows,
    address_of,
    claimed,
    finish_moves,
    strip_of_products,
    wait_for,
    write_form,
)
from egs_warp.kernels.vectors import FRONT_ELIMINATION, on_cpu
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

PADDING = 16
"""Numbers behind an array that may be read, not used."""

_SIZES = f"""
    constexpr int PANEL = {PANEL};
"""


@wp.struct
class Fronts:
    """What ``Supernodes`` says, and where the numbers of each block lie."""

    first: wp.array[wp.int32]
    widths: wp.array[wp.int32]
    row_offsets: wp.array[wp.int32]
    rows: wp.array[wp.int32]
    in_parent: wp.array[wp.int32]
    """Along ``rows``: the place of each row below in the parent's front."""
    child_offsets: wp.array[wp.int32]
    children: wp.array[wp.int32]
    entry_offsets: wp.array[wp.int32]
    entries: wp.array[wp.int32]
    """Of each block those of the matrix in its columns, ..."""
    entry_places: wp.array[wp.int32]
    """... and their places in its front."""
    factor_offsets: wp.array[wp.int32]
    inverse_offsets: wp.array[wp.int32]
    update_offsets: wp.array[wp.int32]
    """On the stack of what is still to be added to a parent."""
    place: wp.array[wp.int32]
    """The permuted place of each row."""


@wp.struct
class MomentumProjection:
    """Angular momentum that a solution keeps, see ``fem.linear_solver.Kept``; nothing where it is not ``there``."""

    enabled: wp.int32
    inertia_ratio: wp.array[real]
    """(1,)."""
    rotation_modes: wp.array[real]
    mode_momenta: wp.array[real]
    rotation_response: wp.array[real]
    """(3n,), three numbers for each unknown."""
    inverse: wp.array[real]
    """(9,)."""


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
        const int pivots = eliminate_front(F, f, w, ld, T, least, inverses.data + fronts.inverse_offsets.data[s],
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
    least: real,
    front: wp.array[real],
    front_size: wp.int32,
    stack: wp.array[real],
    factor: wp.array[real],
    inverses: wp.array[real],
    reciprocals: wp.array[real],
) -> wp.int32:
    """How many pivots are negative, or -1 where one is as small as ``least``."""
    ...


@wp.func_native(
    on_cpu(
        _SIZES
        + """
    const double* const given = (const double*)right;
    double* const found = (double*)solution;
    double* const x = room.data + (long long)panel * (unknowns + 4) * PANEL;
    const int from = panel * PANEL, columns = count - from < PANEL ? count - from : PANEL;
    const int width = columns <= 8 ? 8 : 16;
    for (int i = 0; i < unknowns; ++i) {
        double* const row = x + fronts.place.data[i] * PANEL;
        const double* g = given + i * row_stride + from * column_stride;
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
                // Where nothing is given, nothing comes of it.
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
    if (kept.enabled) {
        for (int i = 0; i < unknowns; ++i) {
            const double* const row = x + fronts.place.data[i] * PANEL;
            const double* const g = given + i * row_stride + from * column_stride;
            for (int t = 0; t < 3; ++t) {
                const double turn = kept.rotation_modes.data[3 * i + t];
                const double momentum = kept.inertia_ratio.data[0] * kept.mode_momenta.data[3 * i + t];
                for (int q = 0; q < columns; ++q) missing[t][q] += turn * g[q * column_stride] - momentum * row[q];
            }
        }
        for (int t = 0; t < 3; ++t)
            for (int s = 0; s < 3; ++s)
                for (int q = 0; q < columns; ++q) by[t][q] += kept.inverse.data[3 * t + s] * missing[s][q];
    }
    for (int i = 0; i < unknowns; ++i) {
        const double* row = x + fronts.place.data[i] * PANEL;
        double* const to = found + (long long)i * solution_stride;
        const double* g = given + i * row_stride + from * column_stride;
        if (weights) {
            for (int q = 0; q < columns; ++q) to[q] = near_share * g[q * column_stride] + far_share * row[q];
        } else if (kept.enabled) {
            const double* const turned = kept.rotation_response.data + 3 * i;
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
    near_share: real,
    far_share: real,
    kept: MomentumProjection,
    panel: wp.int32,
    room: wp.array[real],
    solution: wp.uint64,
    solution_stride: wp.int32,
) -> None:
    """A panel of ``count`` right-hand sides; ``right`` and ``solution``, which is the panel's own, are addresses of
    numbers, the first with its strides in them, the second row by row. With ``weights`` of rows, another address or 0,
    ``near_share`` of what is given and ``far_share`` of the solution with what is given by weight; else what is
    ``kept``."""
    ...


@wp.func_native(
    on_cpu(
        _SIZES
        + """
    const double* const given = (const double*)right;
    double* const found = (double*)solution;
    double* const x = room.data;
    auto sum_of = [](v4 v) { return (v[0] + v[1]) + (v[2] + v[3]); };
    for (int i = 0; i < unknowns; ++i) x[fronts.place.data[i]] = given[i * row_stride];
    for (int s = 0; s < blocks; ++s) {
        const int begin = fronts.row_offsets.data[s], f = fronts.row_offsets.data[s + 1] - begin;
        const int w = fronts.widths.data[s], column = fronts.first.data[s];
        const int* const rows = fronts.rows.data + begin;
        const double* const L = factor.data + fronts.factor_offsets.data[s];
        const double* inverse = inverses.data + fronts.inverse_offsets.data[s];
        for (int b = 0; b < w; b += BLOCK, inverse += BLOCK * BLOCK) {
            const int nb = w - b < BLOCK ? w - b : BLOCK, fours = (nb + 3) >> 2;
            double* const own = x + column + b;
            double kept[BLOCK] = {0.0};
            for (int j = 0; j < nb; ++j) kept[j] = own[j];
            for (int i = 0; i < nb; ++i) {
                v4 a = 0.0;
                for (int k = 0; k < fours; ++k) a += *(const v4*)(inverse + i * BLOCK + 4 * k) * *(v4*)(kept + 4 * k);
                own[i] = sum_of(a);
            }
            for (int j = 0; j < nb; ++j) kept[j] = own[j];
            // What is behind a row's end is multiplied by zero.
            const double* l = L + (b + nb) * w + b;
            for (int i = b + nb; i < f; ++i, l += w) {
                v4 a = *(const v4*)l * *(v4*)kept;
                for (int k = 1; k < fours; ++k) a += *(const v4*)(l + 4 * k) * *(v4*)(kept + 4 * k);
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
    double missing[3] = {0.0, 0.0, 0.0}, by[3] = {0.0, 0.0, 0.0};
    for (int i = 0; i < unknowns; ++i) {
        found[i] = x[fronts.place.data[i]];
        for (int t = 0; t < 3 && kept.enabled; ++t)
            missing[t] += kept.rotation_modes.data[3 * i + t] * given[i * row_stride]
                - kept.inertia_ratio.data[0] * kept.mode_momenta.data[3 * i + t] * found[i];
    }
    for (int t = 0; t < 9 && kept.enabled; ++t) by[t / 3] += kept.inverse.data[t] * missing[t % 3];
    for (int i = 0; i < unknowns && kept.enabled; ++i)
        for (int t = 0; t < 3; ++t) found[i] += kept.rotation_response.data[3 * i + t] * by[t];
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
    kept: MomentumProjection,
    room: wp.array[real],
    solution: wp.uint64,
) -> None:
    """The same of one right-hand side alone."""
    ...


@wp.kernel
def factor_kernel(
    fronts: Fronts,
    count: wp.int32,
    matrix: wp.array[real],
    least: real,
    front: wp.array[real],
    front_size: wp.int32,
    stack: wp.array[real],
    factor: wp.array[real],
    inverses: wp.array[real],
    reciprocals: wp.array[real],
    negative: wp.array[wp.int32],
) -> None:
    """See ``factored``."""
    negative[0] = factor_native(fronts, count, matrix, least, front, front_size, stack, factor, inverses, reciprocals)


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
    kept: MomentumProjection,
    room: wp.array[real],
    solution: wp.uint64,
) -> None:
    """Panel after panel as ``counters`` (1,) give them out, see ``solved_panel``."""
    if count == 1:
        solve_vector_native(
            fronts, blocks, unknowns, factor, inverses, reciprocals, right, row_stride, kept, room, solution
        )
        return
    panel = claimed(counters, 0)
    while PANEL * panel < count:
        solve_panel_native(
            fronts, blocks, unknowns, factor, inverses, reciprocals, right, row_stride, column_stride, count,
            wp.uint64(0), real(0.0), real(1.0), kept, panel, room, solution + wp.uint64(8 * PANEL * panel), count,
        )  # fmt: skip
        panel = claimed(counters, 0)


@wp.kernel
def effort_panel_kernel(
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
    weights: wp.uint64,
    near_share: real,
    far_share: real,
    away: wp.array[real],
    slope: wp.array[real],
    matrix: Rows,
    room: wp.array[real],
    # Out:
    moves: wp.array3d[real],
    products: wp.array3d[real],
    along: wp.array2d[real],
    form: wp.array2d[real],
) -> None:
    """The ``moves`` (panels, n, ``PANEL``) of each panel, see ``solved_panel``, from the last of which ``away`` is
    taken; their ``products`` with a ``matrix``, what they are ``along`` the ``slope`` (panels, ``PANEL``), and when all
    panels are there their ``form`` X^T Y. ``counters`` (3,): panels and pairs of them that are given out, and panels
    that are done."""
    panels = moves.shape[0]
    panel = claimed(counters, 0)
    while panel < panels:
        mine = address_of(moves[panel])
        solve_panel_native(
            fronts, blocks, unknowns, factor, inverses, reciprocals, right, row_stride, column_stride, count, weights,
            near_share, far_share, MomentumProjection(), panel, room, mine, PANEL,
        )  # fmt: skip
        finish_moves(count - PANEL * panel, away, slope, moves[panel], along[panel])
        for strip in range(PANEL // STRIP):
            strip_of_products(
                unknowns, matrix.offsets, matrix.indices, matrix.heads, matrix.values, mine, PANEL, strip,
                address_of(products[panel]),
            )  # fmt: skip
        claimed(counters, 2)
        panel = claimed(counters, 0)
    wait_for(counters, 2, panels)
    pair = claimed(counters, 1)
    while pair < panels * panels:
        first = pair / panels
        second = pair % panels
        if first <= second:
            write_form(first, second, moves[first], products[second], form)
        pair = claimed(counters, 1)
