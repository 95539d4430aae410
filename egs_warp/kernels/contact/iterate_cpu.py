"""Kernels that evaluate a Newton iterate on a CPU, each with one thread: a trial, and the Newton step from it (Eq. 4,
8).

The host code is in ``egs_warp/contact/host_newton.py``; the kernels for a GPU are in ``iterate``. Arguments of type
uint64 are addresses of contiguous host arrays, whose shapes the docstrings state.
"""

import warp as wp

from egs_warp.kernels.fem.elasticity_cpu import gradient_native
from egs_warp.kernels.fem.element_groups import Elements, MuscleSegments
from egs_warp.kernels.fem.supernodal import Fronts, MomentumProjection, project_vector_native, solve_vector_native
from egs_warp.kernels.vectors import on_cpu
from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})


@wp.struct
class Step:
    """Data of a ``fem.StepProblem`` with N nodes at the start of the step."""

    positions: wp.array[real]
    """(3N,) m, positions."""
    ballistic_velocities: wp.array[real]
    """(3N,) m/s, velocities plus dt times gravity."""
    arms: wp.array[real]
    """(3N,) m, positions relative to the centre of mass."""
    inverse_inertia: wp.array[real]
    """(9,) 1/(kg m^2), inverse inertia tensor."""
    masses: wp.array[real]
    """(N,) kg, lumped masses."""


@wp.func_native(
    on_cpu("""
    const int unknowns = ends.shape[0] * 3;
    const double *const old = (const double*)base, *const free = (const double*)free_velocities;
    const double* const c = (const double*)columns;
    const double *const before = (const double*)forces, *const then = (const double*)target_forces;
    double *const v = (double*)velocities_out, *const f = (double*)forces_out, *const x = (double*)ends.data;
    for (int k = 0; k < width; ++k) f[k] = before[k] + length * (then[k] - before[k]);
    for (int i = 0; i < unknowns; ++i) {
        v[i] = old[i];
        if (length != 0.0) {
            v4 sums = 0.0;
            const double* const row = c + (long long)i * width;
            int k = 0;
            for (; k + 4 <= width; k += 4) sums += *(const v4*)(row + k) * *(const v4*)(then + k);
            double end = free[i] + ((sums[0] + sums[1]) + (sums[2] + sums[3]));
            for (; k < width; ++k) end += row[k] * then[k];
            v[i] += length * (end - old[i]);
        }
        x[i] = starts.data[i] + dt * v[i];
    }
""")
)
def advance_trial(
    starts: wp.array[real],
    dt: real,
    base: wp.uint64,
    free_velocities: wp.uint64,
    columns: wp.uint64,
    width: wp.int32,
    forces: wp.uint64,
    target_forces: wp.uint64,
    length: real,
    velocities_out: wp.uint64,
    ends: wp.array2d[real],
    forces_out: wp.uint64,
):
    """Move velocities and forces along a Newton step, and compute the end positions of the nodes.

    Args:
        starts: (3N,) m, nodes at the start of the time step.
        dt: step size, s.
        base: (3N,) m/s, velocities at the start of the Newton step.
        free_velocities: (3N,) m/s, after a full Newton step without contact forces.
        columns: (3N, width) m/s per newton, velocities that unit contact forces cause.
        width: number of force components, 3n for n contacts.
        forces: (width,) newtons, contact forces at the start of the Newton step.
        target_forces: (width,) newtons, contact forces after a full Newton step.
        length: fraction of the Newton step; ``free_velocities`` and ``columns`` are not read if it is 0.
        velocities_out: (3N,) m/s, output.
        ends: (N, 3) m, output: end positions.
        forces_out: (width,) newtons, output.
    """
    ...


@wp.func_native(
    on_cpu(
        """
    const int nodes_count = step.masses.shape[0];
    const double *const v = (const double*)velocities, *const f = (const double*)forces, *const in = gradient.data;
    const int* const node = (const int*)contact_nodes;
    const double *const weight = (const double*)contact_weights, *const axis = (const double*)contact_axes;
    const double *const r = step.arms.data, *const ballistic = step.ballistic_velocities.data;
    const double* const rate = step.inverse_inertia.data;
    double *const free = (double*)free_residual_out, *const total = (double*)residual.data;
    double torque[3] = {0.0, 0.0, 0.0}, spin[3];
    for (int i = 0; i < 3 * nodes_count; i += 3) {
        torque[0] += r[i + 1] * in[i + 2] - r[i + 2] * in[i + 1];
        torque[1] += r[i + 2] * in[i] - r[i] * in[i + 2];
        torque[2] += r[i] * in[i + 1] - r[i + 1] * in[i];
    }
    for (int t = 0; t < 3; ++t)
        spin[t] = dt * (rate[3 * t] * torque[0] + rate[3 * t + 1] * torque[1] + rate[3 * t + 2] * torque[2]);
    for (int n = 0, i = 0; n < nodes_count; ++n, i += 3) {
        const double turned[3] = {spin[1] * r[i + 2] - spin[2] * r[i + 1], spin[2] * r[i] - spin[0] * r[i + 2],
                                  spin[0] * r[i + 1] - spin[1] * r[i]};
        for (int t = 0; t < 3; ++t)
            total[i + t] = free[i + t] = step.masses.data[n] * (ratio * v[i + t] - ballistic[i + t] - turned[t])
                + dt * in[i + t];
    }
    for (int c = 0; c < contacts; ++c) {
        double push[3];
        for (int t = 0; t < 3; ++t)
            push[t] = dt * (axis[9 * c + t] * f[3 * c] + axis[9 * c + 3 + t] * f[3 * c + 1]
                + axis[9 * c + 6 + t] * f[3 * c + 2]);
        for (int k = 0; k < 4; ++k)
            for (int t = 0; t < 3; ++t) total[3 * node[4 * c + k] + t] -= weight[4 * c + k] * push[t];
    }
    double square = 0.0;
    for (int i = 0; i < 3 * nodes_count; ++i) square += total[i] * total[i];
    return __builtin_sqrt(square);
""",
        elsewhere="return 0.0;",
    )
)
def step_residual(
    step: Step,
    dt: real,
    ratio: real,
    contacts: wp.int32,
    contact_nodes: wp.uint64,
    contact_weights: wp.uint64,
    contact_axes: wp.uint64,
    gradient: wp.array2d[real],
    velocities: wp.uint64,
    forces: wp.uint64,
    free_residual_out: wp.uint64,
    residual: wp.array2d[real],
) -> real:
    """Compute the residual of the equation of motion (``ImplicitStep.residual``), without and with contact forces.

    Args:
        step: data of the step.
        dt: step size, s.
        ratio: 1 + dt alpha (``ImplicitStep.inertia_ratio``).
        contacts: number n of contacts.
        contact_nodes, contact_weights, contact_axes: (n, 4), (n, 4) and (n, 3, 3), as in ``ContactSet``.
        gradient: (N, 3) newtons, gradient of the internal energy.
        velocities: (3N,) m/s.
        forces: (3n,) newtons, contact forces.
        free_residual_out: (3N,) N s, output: residual without contact forces.
        residual: (N, 3) N s, output: residual with contact forces.

    Returns:
        The norm of the residual with contact forces, N s.
    """
    ...


@wp.func_native(
    on_cpu("""
    const int k = directions;
    const double *const u = (const double*)across, *const z = (const double*)through;
    const double* const small = (const double*)inverse;
    double *const x = (double*)solved, *const along = scratch.data, *const by = along + k;
    for (int j = 0; j < k; ++j) along[j] = 0.0;
    for (int i = 0; i < unknowns; ++i)
        for (int j = 0; j < k; ++j) along[j] += u[(long long)i * k + j] * x[i];
    for (int a = 0; a < k; ++a) {
        by[a] = 0.0;
        for (int j = 0; j < k; ++j) by[a] += small[a * k + j] * along[j];
    }
    for (int i = 0; i < unknowns; ++i) {
        double away = 0.0;
        for (int j = 0; j < k; ++j) away += z[(long long)i * k + j] * by[j];
        x[i] -= away;
    }
""")
)
def add_low_rank(
    unknowns: wp.int32,
    directions: wp.int32,
    across: wp.uint64,
    through: wp.uint64,
    inverse: wp.uint64,
    scratch: wp.array[real],
    solved: wp.uint64,
) -> None:
    """Correct a solution with the sparse factors for a low-rank term of the matrix, by the Woodbury formula (see
    ``MultifrontalLdl.add_low_rank``).

    Args:
        unknowns: 3N.
        directions: rank k of the term.
        across: (3N, k) U, the directions of the term.
        through: (3N, k) solutions with the sparse factors for the columns of U.
        inverse: (k, k) inverse of the capacitance matrix.
        scratch: (2k,) scratch memory.
        solved: (3N,) solution, corrected in place.
    """
    ...


@wp.func_native(
    on_cpu("""
    const double *const v = (const double*)velocities, *const w = (const double*)contact_weights;
    const double* const axis = (const double*)contact_axes;
    const int* const node = (const int*)contact_nodes;
    double *const x = (double*)solved, *const speeds = (double*)contact_velocities_out;
    for (int i = 0; i < unknowns; ++i) x[i] = v[i] - x[i];
    for (int c = 0; c < contacts; ++c) {
        double at[3] = {0.0, 0.0, 0.0};
        for (int k = 0; k < 4; ++k)
            for (int t = 0; t < 3; ++t) at[t] += w[4 * c + k] * x[3 * node[4 * c + k] + t];
        for (int a = 0; a < 3; ++a)
            speeds[3 * c + a] = axis[9 * c + 3 * a] * at[0] + axis[9 * c + 3 * a + 1] * at[1]
                + axis[9 * c + 3 * a + 2] * at[2];
    }
""")
)
def apply_update(
    unknowns: wp.int32,
    contacts: wp.int32,
    contact_nodes: wp.uint64,
    contact_weights: wp.uint64,
    contact_axes: wp.uint64,
    velocities: wp.uint64,
    solved: wp.uint64,
    contact_velocities_out: wp.uint64,
) -> None:
    """Subtract the solution of a Newton step from the velocities, and compute the contact velocities of the result.

    Args:
        unknowns: 3N.
        contacts: number n of contacts.
        contact_nodes, contact_weights, contact_axes: (n, 4), (n, 4) and (n, 3, 3), as in ``ContactSet``.
        velocities: (3N,) m/s, at the start of the Newton step.
        solved: (3N,) m/s, solution; overwritten with ``velocities`` - ``solved``.
        contact_velocities_out: (3n,) m/s, output.
    """
    ...


@wp.kernel
def trial_kernel(
    # Model:
    elements: Elements,
    lines: MuscleSegments,
    step: Step,
    starts: wp.array[real],
    dt: real,
    ratio: real,
    contacts: wp.int32,
    contact_nodes: wp.uint64,
    contact_weights: wp.uint64,
    contact_axes: wp.uint64,
    columns: wp.uint64,
    # In:
    base: wp.uint64,
    free_velocities: wp.uint64,
    forces: wp.uint64,
    target_forces: wp.uint64,
    length: real,
    # Out:
    ends: wp.array2d[real],
    gradient: wp.array2d[real],
    residual_out: wp.array2d[real],
    velocities_out: wp.uint64,
    forces_out: wp.uint64,
    free_residual_out: wp.uint64,
    norm_out: wp.array[real],
):
    """Evaluate a trial: run ``advance_trial``, compute the gradient of the internal energy, and run ``step_residual``.

    If ``length`` is 0, ``free_velocities`` and ``columns`` are not read.

    Args:
        elements, lines: mesh and muscle segments (``gradient_native``).
        step, dt, ratio, contacts, contact_nodes, contact_weights, contact_axes: the step (``step_residual``).
        starts: F^T F of the elements at the start of the step (``elasticity_cpu.starts_kernel``).
        columns: velocities that unit contact forces cause (``advance_trial``).
        base, free_velocities, forces, target_forces, length: Newton step and its fraction (``advance_trial``).
        ends: (N, 3) m, output: end positions.
        gradient: (N, 3) newtons, output: gradient of the internal energy.
        residual_out, free_residual_out: residual with and without contact forces (``step_residual``).
        velocities_out, forces_out: velocities and forces of the trial (``advance_trial``).
        norm_out: (1,) N s, norm of the residual with contact forces.
    """
    advance_trial(
        step.positions, dt, base, free_velocities, columns, 3 * contacts, forces, target_forces, length,
        velocities_out, ends, forces_out,
    )  # fmt: skip
    gradient_native(elements, lines, ends, starts, dt, gradient)
    norm_out[0] = step_residual(
        step, dt, ratio, contacts, contact_nodes, contact_weights, contact_axes, gradient, velocities_out, forces_out,
        free_residual_out, residual_out,
    )  # fmt: skip


@wp.kernel
def newton_kernel(
    # Model:
    fronts: Fronts,
    blocks: wp.int32,
    unknowns: wp.int32,
    factor: wp.array[real],
    inverses: wp.array[real],
    reciprocals: wp.array[real],
    projection: MomentumProjection,
    directions: wp.int32,
    across: wp.uint64,
    through: wp.uint64,
    inverse: wp.uint64,
    contacts: wp.int32,
    contact_nodes: wp.uint64,
    contact_weights: wp.uint64,
    contact_axes: wp.uint64,
    # In:
    right_side: wp.uint64,
    velocities: wp.uint64,
    # Out:
    scratch: wp.array[real],
    free_velocities_out: wp.uint64,
    contact_velocities_out: wp.uint64,
):
    """Compute the velocities after a full Newton step without contact forces, and the resulting contact velocities.

    Args:
        fronts, blocks, unknowns, factor, inverses, reciprocals: factors of the tangent (``solve_vector_native``).
        projection: momentum projection of the solution.
        directions, across, through, inverse: low-rank term of the tangent (``add_low_rank``).
        contacts: number n of contacts.
        contact_nodes, contact_weights, contact_axes: (n, 4), (n, 4) and (n, 3, 3), as in ``ContactSet``.
        right_side: (3N,) N s, residual without contact forces.
        velocities: (3N,) m/s, at the start of the Newton step.
        scratch: scratch memory.
        free_velocities_out: (3N,) m/s, output.
        contact_velocities_out: (3n,) m/s, output.
    """
    solve_vector_native(
        fronts, blocks, unknowns, factor, inverses, reciprocals, right_side, 1, scratch, free_velocities_out
    )
    if directions > 0:
        add_low_rank(unknowns, directions, across, through, inverse, scratch, free_velocities_out)
    project_vector_native(unknowns, projection, right_side, 1, free_velocities_out)
    apply_update(
        unknowns,
        contacts,
        contact_nodes,
        contact_weights,
        contact_axes,
        velocities,
        free_velocities_out,
        contact_velocities_out,
    )
