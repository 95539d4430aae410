"""Kernels of ``kernels.fem.elasticity`` for a CPU: one thread processes four tetrahedra per vector and sums in a fixed
order.

The host code is in ``egs_warp.fem.simd_elasticity``.
"""

import warp as wp

from egs_warp.kernels.fem.element_groups import ELEMENTS, Elements, MuscleSegments
from egs_warp.kernels.vectors import on_cpu
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    on_cpu(
        ELEMENTS
        + """
    for (int group = 0; group < groups; ++group) {
        M F, R;
        v4 six[6];
        load((const double*)positions.data, group, F, R);
        stretch_of(F, six);
        for (int k = 0; k < 6; ++k) *(v4*)(starts.data + (group * 6 + k) * LANES) = six[k];
    }
"""
    )
)
def starts_native(elements: Elements, positions: wp.array2d[real], starts: wp.array[real]):
    """Write the upper triangles of F^T F of all elements to ``starts`` (native code of ``starts_kernel``)."""
    ...


@wp.func_native(
    on_cpu(
        ELEMENTS
        + """
    const double mu = elements.mu, lam = elements.lam;
    double total = 0.0;
    for (int group = 0; group < groups; ++group) {
        M F, R, C, S;
        v4 six[6];
        load((const double*)positions.data, group, F, R);
        const v4 J = cofactors(F, C), log_j = log_of(J);
        stretch_of(F, six);
        v4 density = 0.5 * mu * (six[0] + six[3] + six[5] - 3.0) - mu * log_j + 0.5 * lam * log_j * log_j;
        if (dt > 0.0) {
            damping_stress(F, group, dt, S);
            for (int i = 0, k = 0; i < 3; ++i)
                for (int j = i; j < 3; ++j, ++k)
                    density += (i == j ? 0.25 : 0.5) * elements.damping_time * S.at[i][j]
                        * (six[k] - *(const v4*)(starts.data + (group * 6 + k) * LANES));
        }
        *(v4*)(determinants.data + group * LANES) = J;
        for (int lane = 0; lane < LANES; ++lane) {
            const double volume = elements.volumes.data[group * LANES + lane];
            if (volume > 0.0) total += J[lane] > 0.0 ? volume * density[lane] : __builtin_inf();
        }
    }
    return total;
""",
        elsewhere="return 0.0;",
    )
)
def energy_of(
    elements: Elements, positions: wp.array2d[real], starts: wp.array[real], dt: real, determinants: wp.array[real]
) -> real:
    """Return the total energy in joules and write det F of each element (native code of ``energy_kernel``)."""
    ...


@wp.func_native(
    on_cpu(
        ELEMENTS
        + """
    const double mu = elements.mu, lam = elements.lam, *const x = (const double*)positions.data;
    double* const out = (double*)gradient.data;
    for (int k = 0; k < 3 * gradient.shape[0]; ++k) out[k] = 0.0;
    for (int group = 0; group < groups; ++group) {
        M F, R, C, S;
        load(x, group, F, R);
        const v4 J = cofactors(F, C), b = (lam * log_of(J) - mu) / J;
        const v4 volume = *(const v4*)(elements.volumes.data + group * LANES);
        if (dt > 0.0) damping_stress(F, group, dt, S);
        v4 h[4][3];
        for (int i = 0; i < 3; ++i) {
            v4 P[3];
            for (int j = 0; j < 3; ++j) {
                P[j] = mu * F.at[i][j] + b * C.at[i][j];
                if (dt > 0.0)
                    P[j] += elements.damping_time
                        * (F.at[i][0] * S.at[0][j] + F.at[i][1] * S.at[1][j] + F.at[i][2] * S.at[2][j]);
            }
            for (int a = 1; a < 4; ++a)
                h[a][i] = volume * (P[0] * R.at[a - 1][0] + P[1] * R.at[a - 1][1] + P[2] * R.at[a - 1][2]);
            h[0][i] = -(h[1][i] + h[2][i] + h[3][i]);
        }
        const int* const corner = elements.corners.data + group * 4 * LANES;
        for (int lane = 0; lane < LANES; ++lane)
            for (int a = 0; a < 4; ++a)
                for (int i = 0; i < 3; ++i) out[3 * corner[4 * lane + a] + i] += h[a][i][lane];
    }
    for (int s = 0; s < lines.tensions.shape[0]; ++s) {
        const int from = lines.offsets.data[s], to = lines.offsets.data[s + 1];
        double line[3] = {0.0, 0.0, 0.0};
        for (int slot = from; slot < to; ++slot)
            for (int i = 0; i < 3; ++i) line[i] += lines.weights.data[slot] * x[3 * lines.nodes.data[slot] + i];
        double length = __builtin_sqrt(line[0] * line[0] + line[1] * line[1] + line[2] * line[2]);
        length = length > 1e-300 ? length : 1e-300;
        const double range = lines.length_full_force - lines.length_zero_force;
        double along = (length / lines.rest_lengths.data[s] - lines.length_zero_force) / range;
        along = along > 0.0 ? (along < 1.0 ? along : 1.0) : 0.0;
        const double pull = lines.tensions.data[s] * along * along * (3.0 - 2.0 * along) / length;
        for (int slot = from; slot < to; ++slot)
            for (int i = 0; i < 3; ++i)
                out[3 * lines.nodes.data[slot] + i] += lines.weights.data[slot] * pull * line[i];
    }
"""
    )
)
def gradient_native(
    elements: Elements,
    lines: MuscleSegments,
    positions: wp.array2d[real],
    starts: wp.array[real],
    dt: real,
    gradient: wp.array2d[real],
):
    """Write the nodal gradient of elasticity, damping and muscles (native code of ``gradient_kernel``)."""
    ...


_HESSIANS = """
    // Index of block (a, b), 1 <= a <= b, among the six stored blocks of a group.
    auto at_of = [](int a, int b) { return a == 1 ? b - 1 : a + b - 1; };
    // Damping term of a block, from F F^T and F g_a; rotation_term is nonzero only in the true derivative.
    auto add_damping = [&](v4* block, const M& FF, const v4* fa, const v4* fb, v4 along, v4 rotation_term, double dt) {
        #pragma clang fp contract(fast)
        const double beta = elements.damping_time, by = beta / dt;
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                block[3 * i + k] += by * elements.mu * (along * FF.at[i][k] + fb[i] * fa[k])
                    + by * elements.lam * fa[i] * fb[k] + (i == k ? beta * rotation_term : v4(0.0));
    };
    auto scatter = [&](int group, const v4 (*block)[9]) {
        v4 all[78];
        const v4 volume = factor * *(const v4*)(elements.volumes.data + group * LANES);
        auto of = [&](int a, int b, int i, int k) {
            return a <= b ? block[at_of(a, b)][3 * i + k] : block[at_of(b, a)][3 * k + i];
        };
        v4 row[3][9], *to = all;
        for (int a = 1; a < 4; ++a)
            for (int q = 0; q < 9; ++q) row[a - 1][q] = -(of(a, 1, q / 3, q % 3) + of(a, 2, q / 3, q % 3)
                                                         + of(a, 3, q / 3, q % 3));
        for (int i = 0; i < 3; ++i)
            for (int k = i; k < 3; ++k)
                *to++ = -volume * (row[0][3 * i + k] + row[1][3 * i + k] + row[2][3 * i + k]);
        for (int a = 0; a < 3; ++a)
            for (int i = 0; i < 3; ++i)
                for (int k = 0; k < 3; ++k) *to++ = volume * row[a][3 * k + i];
        for (int a = 1; a < 4; ++a)
            for (int b = a; b < 4; ++b)
                for (int i = 0; i < 3; ++i)
                    for (int k = a == b ? i : 0; k < 3; ++k) *to++ = volume * block[at_of(a, b)][3 * i + k];
        for (int lane = 0; lane < LANES; ++lane) {
            const int* const place = elements.entries.data + (group * LANES + lane) * 78;
            for (int q = 0; q < 78; ++q) entries.data[place[q]] += all[q][lane];
        }
    };
    auto square_of = [](const M& F, M& FF) {
        #pragma clang fp contract(fast)
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                FF.at[i][k] = F.at[i][0] * F.at[k][0] + F.at[i][1] * F.at[k][1] + F.at[i][2] * F.at[k][2];
    };
    auto times = [](const M& A, const v4* x, v4* y) {
        #pragma clang fp contract(fast)
        for (int i = 0; i < 3; ++i) y[i] = A.at[i][0] * x[0] + A.at[i][1] * x[1] + A.at[i][2] * x[2];
    };
    auto dot = [](const v4* x, const v4* y) { return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; };
    for (int k = 0; k < entries.shape[0]; ++k) entries.data[k] = 0.0;
"""


@wp.func_native(
    on_cpu(
        ELEMENTS
        + _HESSIANS
        + """
    const double mu = elements.mu, lam = elements.lam;
    for (int group = 0; group < groups; ++group) {
        M F, R, C, S, FF;
        v4 block[6][9], h[3][3], f[3][3], g[3][3];
        load((const double*)positions.data, group, F, R);
        const v4 J = cofactors(F, C), cross = mu - lam * log_of(J), inverse = 1.0 / J;
        if (dt > 0.0) damping_stress(F, group, dt, S);
        square_of(F, FF);
        for (int a = 0; a < 3; ++a) {
            times(C, R.at[a], h[a]);
            times(F, R.at[a], f[a]);
            for (int i = 0; i < 3; ++i) h[a][i] *= inverse;
            if (dt > 0.0) times(S, R.at[a], g[a]);
        }
        for (int a = 0; a < 3; ++a)
            for (int b = a; b < 3; ++b) {
                v4* const to = block[at_of(a + 1, b + 1)];
                const v4 along = dot(R.at[a], R.at[b]);
                for (int i = 0; i < 3; ++i)
                    for (int k = 0; k < 3; ++k)
                        to[3 * i + k] = cross * h[b][i] * h[a][k] + lam * h[a][i] * h[b][k]
                            + (i == k ? mu * along : v4(0.0));
                if (dt > 0.0) add_damping(to, FF, f[a], f[b], along, dot(R.at[a], g[b]), dt);
            }
        scatter(group, block);
    }
"""
    )
)
def hessian_native(
    elements: Elements,
    positions: wp.array2d[real],
    starts: wp.array[real],
    dt: real,
    factor: real,
    entries: wp.array[real],
):
    """Write ``factor`` times the upper entries of the Hessian (native code of ``hessian_kernel``)."""
    ...


@wp.func_native(
    on_cpu(
        ELEMENTS
        + _HESSIANS
        + """
    const double mu = elements.mu, lam = elements.lam;
    auto larger = [](v4 x) { return x > 0.0 ? x : v4(0.0); };
    // Eigenvectors (columns of a rotation) of symmetric matrices by Jacobi rotations, which make m diagonal, in as many
    // sweeps as the slowest matrix of the group needs.
    auto principal_axes = [&](M& m, M& axes) {
        #pragma clang fp contract(fast)
        for (int k = 0; k < 9; ++k) axes.at[k / 3][k % 3] = k % 4 == 0 ? 1.0 : 0.0;
        const v4 trace = m.at[0][0] + m.at[1][1] + m.at[2][2], limit = tolerance * trace * trace;
        for (int sweep = 0; sweep < max_sweeps; ++sweep) {
            const v4 off_diagonal = m.at[0][1] * m.at[0][1] + m.at[0][2] * m.at[0][2] + m.at[1][2] * m.at[1][2];
            const auto more = off_diagonal > limit;
            if (!(more[0] | more[1] | more[2] | more[3])) break;
            for (int r = 0; r < 3; ++r) {
                const int p = (r + 1) % 3, q = (r + 2) % 3;
                const v4 between = m.at[p][q];
                const auto any = between != 0.0;
                const v4 half = (m.at[q][q] - m.at[p][p]) / (2.0 * (any ? between : v4(1.0)));
                const v4 size = 1.0 / (__builtin_elementwise_abs(half) + root(half * half + 1.0));
                const v4 tangent = any ? (half < 0.0 ? -size : size) : v4(0.0);
                const v4 c = 1.0 / root(tangent * tangent + 1.0), s = tangent * c;
                m.at[p][p] -= tangent * between;
                m.at[q][q] += tangent * between;
                m.at[p][q] = m.at[q][p] = 0.0;
                const v4 first = m.at[r][p], second = m.at[r][q];
                m.at[r][p] = m.at[p][r] = c * first - s * second;
                m.at[r][q] = m.at[q][r] = s * first + c * second;
                for (int i = 0; i < 3; ++i) {
                    const v4 one = axes.at[i][p], other = axes.at[i][q];
                    axes.at[i][p] = c * one - s * other;
                    axes.at[i][q] = s * one + c * other;
                }
            }
        }
    };
    for (int group = 0; group < groups; ++group) {
        M F, R, C, FF, T, V, U, K, Q, direct, swapped;
        v4 block[6][9], six[6], s[3], f[3][3], g[3][3];
        load((const double*)positions.data, group, F, R);
        const v4 pressure = lam * log_of(cofactors(F, C)) - mu;
        stretch_of(F, six);
        for (int i = 0, k = 0; i < 3; ++i)
            for (int j = i; j < 3; ++j, ++k) T.at[i][j] = T.at[j][i] = six[k];
        principal_axes(T, V);
        for (int i = 0; i < 3; ++i) s[i] = root(T.at[i][i]);
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                U.at[i][k] = (F.at[i][0] * V.at[0][k] + F.at[i][1] * V.at[1][k] + F.at[i][2] * V.at[2][k]) / s[k];
        for (int i = 0; i < 3; ++i) {
            K.at[i][i] = mu + (lam - pressure) / (s[i] * s[i]);
            for (int k = i + 1; k < 3; ++k) {
                const v4 inverse = 1.0 / (s[i] * s[k]);
                const v4 twist = larger(mu + pressure * inverse), flip = larger(mu - pressure * inverse);
                K.at[i][k] = K.at[k][i] = lam * inverse;
                direct.at[i][k] = direct.at[k][i] = 0.5 * (twist + flip);
                swapped.at[i][k] = swapped.at[k][i] = 0.5 * (flip - twist);
            }
        }
        principal_axes(K, Q);
        M scaling;
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) {
                scaling.at[i][k] = 0.0;
                for (int j = 0; j < 3; ++j) scaling.at[i][k] += larger(K.at[j][j]) * Q.at[i][j] * Q.at[k][j];
            }
        square_of(F, FF);
        for (int a = 0; a < 3; ++a) {
            times(F, R.at[a], f[a]);
            for (int i = 0; i < 3; ++i)
                g[a][i] = V.at[0][i] * R.at[a][0] + V.at[1][i] * R.at[a][1] + V.at[2][i] * R.at[a][2];
        }
        for (int a = 0; a < 3; ++a)
            for (int b = a; b < 3; ++b) {
                M B;
                v4* const to = block[at_of(a + 1, b + 1)];
                for (int i = 0; i < 3; ++i) {
                    B.at[i][i] = scaling.at[i][i] * g[a][i] * g[b][i];
                    for (int k = 0; k < 3; ++k)
                        if (i != k) {
                            B.at[i][i] += direct.at[i][k] * g[a][k] * g[b][k];
                            B.at[i][k] = scaling.at[i][k] * g[a][i] * g[b][k] + swapped.at[i][k] * g[a][k] * g[b][i];
                        }
                }
                for (int i = 0; i < 3; ++i) {
                    v4 left[3];
                    for (int k = 0; k < 3; ++k)
                        left[k] = U.at[i][0] * B.at[0][k] + U.at[i][1] * B.at[1][k] + U.at[i][2] * B.at[2][k];
                    for (int k = 0; k < 3; ++k) to[3 * i + k] = dot(left, U.at[k]);
                }
                if (dt > 0.0) add_damping(to, FF, f[a], f[b], dot(R.at[a], R.at[b]), v4(0.0), dt);
            }
        scatter(group, block);
    }
"""
    )
)
def projected_hessian_native(
    elements: Elements,
    positions: wp.array2d[real],
    starts: wp.array[real],
    dt: real,
    factor: real,
    tolerance: real,
    max_sweeps: wp.int32,
    entries: wp.array[real],
):
    """Write ``factor`` times the upper entries of the projected Hessian (native code of ``hessian_kernel``)."""
    ...


@wp.kernel
def starts_kernel(elements: Elements, positions: wp.array2d[real], starts_out: wp.array[real]) -> None:
    """Compute F^T F of all elements, from which the damping measures strain.

    Args:
        elements: the mesh.
        positions: (N, 3) m, nodes at the start of the step.
        starts_out: (T / 4, 6, 4) upper triangles, flat.
    """
    starts_native(elements, positions, starts_out)


@wp.kernel
def energy_kernel(
    # Model:
    elements: Elements,
    # In:
    positions: wp.array2d[real],
    starts: wp.array[real],
    dt: real,
    # Out:
    energy_out: wp.array[real],
    determinants_out: wp.array[real],
) -> None:
    """Compute the total energy and det F of each element, as ``element_energies_kernel`` does.

    Args:
        elements: the mesh.
        positions: (N, 3) m, nodes at the end of the step.
        starts: result of ``starts_kernel`` at the start of the step.
        dt: step size, s; 0 leaves out the damping.
        energy_out: (1,) J, sum over the elements.
        determinants_out: (T,) det F.
    """
    energy_out[0] = energy_of(elements, positions, starts, dt, determinants_out)


@wp.kernel
def gradient_kernel(
    # Model:
    elements: Elements,
    lines: MuscleSegments,
    # In:
    positions: wp.array2d[real],
    starts: wp.array[real],
    dt: real,
    # Out:
    gradient_out: wp.array2d[real],
) -> None:
    """Compute the nodal gradient of elasticity, damping and muscles: the sums of ``element_gradients_kernel`` and
    ``segment_forces_kernel``.

    Args:
        elements: the mesh.
        lines: the muscle segments.
        positions, starts, dt: as in ``energy_kernel``.
        gradient_out: (N, 3) newtons.
    """
    gradient_native(elements, lines, positions, starts, dt, gradient_out)


@wp.kernel
def hessian_kernel(
    # Model:
    elements: Elements,
    # In:
    positions: wp.array2d[real],
    starts: wp.array[real],
    dt: real,
    factor: real,
    projected: wp.int32,
    tolerance: real,
    max_sweeps: wp.int32,
    # Out:
    entries_out: wp.array[real],
) -> None:
    """Compute ``factor`` times the upper entries of the assembled element Hessians.

    Args:
        elements: the mesh.
        positions, starts, dt: as in ``energy_kernel``.
        factor: factor of the result.
        projected: 0 for the Hessians of ``element_hessians_kernel``, otherwise those of
            ``element_projected_hessians_kernel``.
        tolerance, max_sweeps: limits of the Jacobi iteration of the projection.
        entries_out: (nnz,) upper entries.
    """
    if projected != 0:
        projected_hessian_native(elements, positions, starts, dt, factor, tolerance, max_sweeps, entries_out)
    else:
        hessian_native(elements, positions, starts, dt, factor, entries_out)
