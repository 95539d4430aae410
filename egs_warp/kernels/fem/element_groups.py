"""Tetrahedra in groups of four for the SIMD kernels of ``elasticity_cpu``: structs, and C++ functions that process a
group.

The host code is in ``egs_warp.fem.simd_elasticity``.
"""

import warp as wp

from egs_warp.precision import real

LANES = 4
"""Number of tetrahedra in a group; the last group is filled with tetrahedra of zero volume."""
PAIRS = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))
"""Corner pairs of the blocks of an element in the upper triangle, in the order of ``Elements.entries``."""

ELEMENTS = """
    constexpr int LANES = 4;
    struct M { v4 at[3][3]; };
    auto root = [](v4 x) { return __builtin_elementwise_sqrt(x); };
    auto log_of = [](v4 x) { return v4{wp::log(x[0]), wp::log(x[1]), wp::log(x[2]), wp::log(x[3])}; };
    const int groups = elements.volumes.shape[0] / LANES;
    // Deformation gradients F of a group, and shape gradients R of all corners but the first.
    auto load = [&](const double* x, int group, M& F, M& R) {
        #pragma clang fp contract(fast)
        const double* const rest = elements.rests.data + group * 9 * LANES;
        const int* const corner = elements.corners.data + group * 4 * LANES;
        M E;
        for (int i = 0; i < 3; ++i) {
            v4 first, other[3];
            for (int lane = 0; lane < LANES; ++lane) {
                first[lane] = x[3 * corner[4 * lane] + i];
                for (int k = 0; k < 3; ++k) other[k][lane] = x[3 * corner[4 * lane + k + 1] + i];
            }
            for (int k = 0; k < 3; ++k) E.at[i][k] = other[k] - first;
        }
        for (int k = 0; k < 9; ++k) R.at[k / 3][k % 3] = *(const v4*)(rest + k * LANES);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                F.at[i][j] = E.at[i][0] * R.at[0][j] + E.at[i][1] * R.at[1][j] + E.at[i][2] * R.at[2][j];
    };
    // Cofactors C; returns the determinant.
    auto cofactors = [](const M& F, M& C) {
        #pragma clang fp contract(fast)
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const int p = (i + 1) % 3, q = (i + 2) % 3, r = (j + 1) % 3, s = (j + 2) % 3;
                C.at[i][j] = F.at[p][r] * F.at[q][s] - F.at[p][s] * F.at[q][r];
            }
        return F.at[0][0] * C.at[0][0] + F.at[0][1] * C.at[0][1] + F.at[0][2] * C.at[0][2];
    };
    // F^T F: the six entries of its upper triangle.
    auto stretch_of = [](const M& F, v4* six) {
        #pragma clang fp contract(fast)
        for (int i = 0, k = 0; i < 3; ++i)
            for (int j = i; j < 3; ++j, ++k)
                six[k] = F.at[0][i] * F.at[0][j] + F.at[1][i] * F.at[1][j] + F.at[2][i] * F.at[2][j];
    };
    // Damping stress; dt must not be 0.
    auto damping_stress = [&](const M& F, int group, double dt, M& S) {
        #pragma clang fp contract(fast)
        const double *const start = starts.data + group * 6 * LANES, half = 0.5 / dt;
        v4 rate[6];
        stretch_of(F, rate);
        for (int k = 0; k < 6; ++k) rate[k] = (rate[k] - *(const v4*)(start + k * LANES)) * half;
        const v4 trace_term = elements.lam * (rate[0] + rate[3] + rate[5]);
        for (int i = 0, k = 0; i < 3; ++i)
            for (int j = i; j < 3; ++j, ++k)
                S.at[i][j] = S.at[j][i] = 2.0 * elements.mu * rate[k] + (i == j ? trace_term : v4(0.0));
    };
"""
"""C++ functions for a group of tetrahedra: deformation gradients, cofactors and damping stress."""


@wp.struct
class Elements:
    """Mesh in groups of ``LANES`` tetrahedra; T is padded to a multiple of ``LANES``."""

    corners: wp.array[wp.int32]
    """(T, 4) nodes of each tetrahedron, flat."""
    rests: wp.array[real]
    """(T / 4, 9, 4) 1/m, inverse edge matrices at rest, row by row, flat."""
    volumes: wp.array[real]
    """(T,) m^3, volumes at rest; 0 for padding."""
    entries: wp.array[wp.int32]
    """(T, 78) matrix entries of each tetrahedron, for the blocks ``PAIRS`` in order, row by row; blocks (a, a) have
    only their upper triangles."""
    mu: real
    """Shear modulus mu of Eq. (5), Pa."""
    lam: real
    """Lame's first parameter lambda of Eq. (5), Pa."""
    damping_time: real
    """Rayleigh coefficient beta, s."""


@wp.struct
class MuscleSegments:
    """Data of M >= 0 muscle segments (``elasticity.segment_forces_kernel``) of one world."""

    offsets: wp.array[wp.int32]
    """(M + 1,) offset of each segment in ``nodes`` and ``weights``."""
    nodes: wp.array[wp.int32]
    """Nodes of each segment, segment by segment."""
    weights: wp.array[real]
    """Weights of ``nodes``. The segment vector is the weighted sum of the positions of its nodes."""
    rest_lengths: wp.array[real]
    """(M,) m, rest lengths."""
    tensions: wp.array[real]
    """(M,) N, tensions."""
    length_zero_force: real
    """Relative length at and below which a segment exerts no force."""
    length_full_force: real
    """Relative length at and above which a segment exerts its full tension."""
