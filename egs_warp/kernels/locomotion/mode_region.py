"""QP of one assignment of contact modes with the activations as its only unknowns, as native CPU code with vectors of
four.

Host code: ``egs_warp/locomotion/contact_modes.py``.
"""

import math

import warp as wp

from egs_warp.kernels.vectors import ROW_ELIMINATION, on_cpu
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})

FREE, STICK, SLIDE = 0, 1, 2
"""Contact modes."""
TO_FREE, TO_SLIDE, TO_OTHER_DIRECTION, TO_TOUCHING = 0, 1, 2, 3
"""Mode transitions of a contact where a row that bounds the region becomes active."""
CONE_FACES = 8
"""Faces of the pyramid that replaces the friction cone of a sticking contact."""
SLIDE_SECTOR = math.radians(30.0)
"""Largest angle, rad, between the slip of a sliding contact and the direction that its friction opposes. A fixed
friction direction under a foot that slips elsewhere would propel the body unphysically."""
DELASSUS_REGULARIZATION = 1e-7
"""Diagonal shift of the Delassus operator, relative to the mean of its diagonal: more contacts than the cage can
resolve make it singular."""
ZERO_FORCE = 1e-9
"""Normal force, body weights, up to which a contact counts as open."""
CONE_FRACTION = 1.0 - 1e-6
"""Fraction of the cone's radius from which the contact counts as sliding."""
ZERO_SPEED = 1e-9
"""Tangential speed, in units of sqrt(g H), below which the slip has no direction."""
MIN_MULTIPLIER = 1e-3
"""Fraction of the objective that the multiplier of a mode constraint, in objective per unit of its row, must exceed for
the constraint to be worth crossing."""
MIN_GAIN_FRACTION = 5e-3
"""Smallest relative decrease of the objective for which the search continues in the next region."""
MAX_START_VIOLATION = 0.02
"""Amount by which the start may violate a row of its region."""
START_ROUNDING = 1e-6
"""Amount by which rows are relaxed, for a start that is the only point of its region, for example because contacts are
redundant."""
_NO_PIVOT = 1e-14


def padded(count: int) -> int:
    """Round ``count`` up to a multiple of eight columns."""
    return -(-count // 8) * 8


def scratch_size(activations: int, contacts: int) -> int:
    """Return the maximum size of the scratch memory of a region, in float64 numbers."""
    wide, touches = padded(activations + 1), 3 * contacts
    row_count = activations + touches
    return (touches + 5) * wide + max(
        (touches + 1) * (padded(touches) + wide), row_count * wide + (row_count + activations) * (touches + 1)
    )


@wp.func_native(
    on_cpu(
        ROW_ELIMINATION
        + f"""
    constexpr int FREE = {FREE}, STICK = {STICK}, SLIDE = {SLIDE};
    constexpr double SINGULAR = {DELASSUS_REGULARIZATION}, NO_PIVOT = {_NO_PIVOT};
"""
        + """
    const int m = activations, n = contacts, N = m + 3 * n, wide = (m + 8) & ~7, plain = (m + 7) & ~7;
    const double *const P = (const double*)cost, *const q = (const double*)slope_of_cost;
    const double *const W = (const double*)rows, *const w = (const double*)offset;
    const int* const kinds = (const int*)kind;
    const double *const slips = (const double*)slip, *const faces = (const double*)sides;
    double* free_scratch = scratch.data;
    auto take = [&](int count) { double* const block = free_scratch; free_scratch += count; return block; };
    int *const held = numbers.data, *const touching = held + 3 * n, *const pivots = touching + 3 * n;
    int *const place = pivots + 3 * n, holds = 0, touches = 0;
    for (int i = 0; i < n; ++i) {
        place[i] = touches;
        for (int t = 0; t < 3 && kinds[i] != FREE; ++t) touching[touches++] = 3 * i + t;
        for (int t = 0; t < 3 && (kinds[i] == STICK || (kinds[i] == SLIDE && t == 0)); ++t) held[holds++] = 3 * i + t;
    }
    // Forces: (held rows) (f) = -(held velocities without forces); the last column is the constant.
    double* const S = take((touches + 1) * wide);
    {
        const int right = (holds + 7) & ~7, stride = right + wide;
        double* const M = take((holds + 1) * stride);
        double mean = 0.0;
        for (int a = 0; a < holds; ++a) {
            double *const row = M + a * stride;
            const double* const from = W + held[a] * N;
            for (int b = 0; b < holds; ++b) {
                const int f = held[b], i = f / 3;
                row[b] = from[m + f];
                if (kinds[i] == SLIDE)
                    row[b] -= friction * (from[m + f + 1] * slips[2 * i] + from[m + f + 2] * slips[2 * i + 1]);
            }
            for (int b = holds; b < right; ++b) row[b] = 0.0;
            for (int c = 0; c < m; ++c) row[right + c] = -from[c];
            row[right + m] = -w[held[a]];
            for (int c = m + 1; c < wide; ++c) row[right + c] = 0.0;
            mean += __builtin_fabs(row[a]) / holds;
        }
        for (int a = 0; a < holds; ++a) M[a * stride + a] += SINGULAR * mean;
        if (eliminate_rows(M, stride, holds, stride, NO_PIVOT, pivots) < holds) return 0;
        for (int i = (holds - 1) & ~3; holds > 0 && i >= 0; i -= 4) {
            const int some = holds - i < 4 ? holds - i : 4;
            double* const x = M + i * stride + right;
            if (some == 4)
                take_off_all(x, stride, 4, M + i * stride + i + 4, stride, x + 4 * stride, stride, wide, holds - i - 4);
            for (int p = some - 1; p >= 0; p -= 1) {
                const double* const row = M + (i + p) * stride + i;
                for (int o = p + 1; o < some; ++o)
                    for (int c = 0; c < wide; c += 4)
                        *(v4*)(x + p * stride + c) -= row[o] * *(const v4*)(x + o * stride + c);
                const double by = 1.0 / row[p];
                for (int c = 0; c < wide; c += 4) *(v4*)(x + p * stride + c) *= by;
            }
        }
        for (int a = 0; a < holds; ++a) {
            const int i = held[a] / 3, t = held[a] % 3;
            double* const to = S + (place[i] + t) * wide;
            const double* const from = M + a * stride + right;
            for (int c = 0; c < wide; ++c) to[c] = from[c];
            for (int s = 0; s < 2 && kinds[i] == SLIDE; ++s)
                for (int c = 0; c < wide; ++c) to[(s + 1) * wide + c] = -friction * slips[2 * i + s] * from[c];
        }
        free_scratch = M;
    }
    double *const f = (double*)forces, *const f0 = (double*)forces_offset;
    for (int k = 0; k < 3 * n; ++k) {
        f0[k] = 0.0;
        for (int c = 0; c < plain; ++c) f[k * plain + c] = 0.0;
    }
    for (int g = 0; g < touches; ++g) {
        f0[touching[g]] = S[g * wide + m];
        for (int c = 0; c < m; ++c) f[touching[g] * plain + c] = S[g * wide + c];
    }
    // x = (0, offset) + (1, S) a: the rows of P x that are needed, then x^T P x.
    double* const X = take((m + touches) * wide);
    {
        double *const L = take((m + touches) * (touches + 1)), *const down = take(m * (touches + 1));
        for (int i = 0; i < m + touches; ++i) {
            const double* const from = P + (i < m ? i : m + touching[i - m]) * N;
            for (int c = 0; c < m; ++c) X[i * wide + c] = from[c];
            for (int c = m; c < wide; ++c) X[i * wide + c] = 0.0;
            for (int g = 0; g < touches; ++g) L[i * touches + g] = -from[m + touching[g]];
        }
        take_off_all(X, wide, m + touches, L, touches, S, wide, wide, touches);
        for (int i = 0; i < m; ++i)
            for (int g = 0; g < touches; ++g) down[i * touches + g] = -S[g * wide + i];
        take_off_all(X, wide, m, down, touches, X + m * wide, wide, wide, touches);
        free_scratch = L;
    }
    double *const Q = (double*)region_cost, *const s = (double*)region_slope;
    for (int i = 0; i < m; ++i) {
        s[i] = q[i] + X[i * wide + m];
        for (int k = 0; k <= i; ++k) Q[i * plain + k] = Q[k * plain + i] = 0.5 * (X[i * wide + k] + X[k * wide + i]);
        for (int k = m; k < plain; ++k) Q[i * plain + k] = 0.0;
    }
    for (int g = 0; g < touches; ++g)
        for (int i = 0; i < m; ++i) s[i] += S[g * wide + i] * q[m + touching[g]];
    // Bounds of the region: normal forces, cone faces, slip sectors, normal velocities of free contacts.
    double *A = (double*)bounds, *b = (double*)bounds_offset;
    auto write = [&](double by, const double* from) {
        for (int c = 0; c < m; ++c) A[c] += by * from[c];
        *b += by * from[m];
    };
    auto next = [&]() { A += plain; ++b; };
    for (int k = 0; k < total * plain; ++k) A[k] = 0.0;
    for (int k = 0; k < total; ++k) b[k] = 0.0;
    for (int i = 0; i < m; ++i, next()) A[i] = 1.0;
    for (int mode = STICK; mode <= SLIDE; ++mode)
        for (int i = 0; i < n; ++i)
            if (kinds[i] == mode) { write(1.0, S + place[i] * wide); next(); }
    for (int face = 0; face < face_count; ++face)
        for (int i = 0; i < n; ++i)
            if (kinds[i] == STICK) {
                const double* const from = S + place[i] * wide;
                const double* const side = faces + 3 * face;
                write(friction * side[0], from);
                write(side[1], from + wide);
                write(side[2], from + 2 * wide);
                next();
            }
    double *const V = X, *const L = V + 4 * wide;
    auto speeds = [&](int first, int count) {
        for (int t = 0; t < count; ++t) {
            const double* const from = W + (first + t) * N;
            for (int c = 0; c < m; ++c) V[t * wide + c] = from[c];
            V[t * wide + m] = w[first + t];
            for (int c = m + 1; c < wide; ++c) V[t * wide + c] = 0.0;
            for (int g = 0; g < touches; ++g) L[t * touches + g] = -from[m + touching[g]];
        }
        take_off_all(V, wide, count, L, touches, S, wide, wide, touches);
    };
    for (int side = 1; side >= -1; side -= 2)
        for (int i = 0; i < n; ++i)
            if (kinds[i] == SLIDE) {
                const double d0 = slips[2 * i], d1 = slips[2 * i + 1];
                speeds(3 * i + 1, 2);
                write(sector_sine * d0 - side * sector_cosine * d1, V);
                write(sector_sine * d1 + side * sector_cosine * d0, V + wide);
                next();
            }
    for (int i = 0; i < n; ++i)
        if (kinds[i] == FREE) { speeds(3 * i, 1); write(1.0, V); next(); }
    return 1;
""",
        elsewhere="return 0;",
    )
)
def mode_region_native(
    activations: wp.int32,
    contacts: wp.int32,
    friction: real,
    cost: wp.uint64,
    slope_of_cost: wp.uint64,
    rows: wp.uint64,
    offset: wp.uint64,
    kind: wp.uint64,
    slip: wp.uint64,
    sides: wp.uint64,
    face_count: wp.int32,
    sector_sine: real,
    sector_cosine: real,
    numbers: wp.array[wp.int32],
    scratch: wp.array[real],
    total: wp.int32,
    forces: wp.uint64,
    forces_offset: wp.uint64,
    region_cost: wp.uint64,
    region_slope: wp.uint64,
    bounds: wp.uint64,
    bounds_offset: wp.uint64,
) -> wp.int32:
    """Compute a mode region as described at ``mode_region_kernel``; return 1, or 0 if the forces cannot be solved
    for."""
    ...


@wp.kernel
def mode_region_kernel(
    # In:
    activations: wp.int32,
    contacts: wp.int32,
    friction: real,
    cost: wp.uint64,
    slope_of_cost: wp.uint64,
    rows: wp.uint64,
    offset: wp.uint64,
    kind: wp.uint64,
    slip: wp.uint64,
    sides: wp.uint64,
    face_count: wp.int32,
    sector_sine: real,
    sector_cosine: real,
    numbers: wp.array[wp.int32],
    scratch: wp.array[real],
    total: wp.int32,
    # Out:
    forces: wp.uint64,
    forces_offset: wp.uint64,
    region_cost: wp.uint64,
    region_slope: wp.uint64,
    bounds: wp.uint64,
    bounds_offset: wp.uint64,
    is_solvable: wp.array[wp.int32],
) -> None:
    """Reduce a ``CoulombProgram`` to the region of one assignment of contact modes, with one thread.

    Array arguments are addresses. Matrices over activations have rows of ``padded(m)`` numbers. The rows of ``bounds``
    are the m activations, then quantities that are nonnegative in the region, in this order: normal forces of sticking,
    then of sliding contacts; distances to each cone face of sticking contacts; slip of sliding contacts against one,
    then the other edge of their sector; normal velocities of free contacts.

    Args:
        activations: number m.
        contacts: number n.
        friction: friction coefficient.
        cost, slope_of_cost: P (m + 3n, m + 3n) and q (m + 3n,).
        rows, offset: (3n, m + 3n) and (3n,), affine map to the contact velocities.
        kind: (n,) int32 mode of each contact.
        slip: (n, 2) slip direction of sliding contacts.
        sides: (face_count, 3) faces of the pyramid of sticking contacts, see ``FrictionDirections.sides``.
        face_count: number of faces.
        sector_sine, sector_cosine: sine and cosine of half the sector of a sliding contact's slip.
        numbers: (10n,) int32 scratch.
        scratch: (``scratch_size``,) scratch.
        total: number of rows of ``bounds``.
        forces, forces_offset: (3n, m) and (3n,), contact response.
        region_cost, region_slope: (m, m) and (m,), quadratic cost of the activations.
        bounds, bounds_offset: (total, m) and (total,).
        is_solvable: (1,) 1, or 0 if the forces cannot be solved for.
    """
    is_solvable[0] = mode_region_native(
        activations, contacts, friction, cost, slope_of_cost, rows, offset, kind, slip, sides, face_count, sector_sine,
        sector_cosine, numbers, scratch, total, forces, forces_offset, region_cost, region_slope, bounds, bounds_offset,
    )  # fmt: skip
