"""Coulomb solve for given Delassus operators: Gauss-Seidel sweeps, then semismooth Newton on the projection equations
(Eq. 8, 9).

Projecting the forces onto the cone of Coulomb's law gives equations P(f) = f - proj(f - rate u(f)) = 0, whose solutions
satisfy the law (Alart and Curnier). An attempt sweeps over the contacts, then takes Newton steps on P:
``projection_residual`` evaluates P, and ``find_step`` solves for the step. In the first attempt, the step is halved
until the norm of P decreases. Later attempts use full steps and other rates. A last attempt polishes the best forces.

A block of threads solves each problem on a GPU, one thread on a CPU; ``lane`` is the index of a thread in its block.
All lanes take the same branches. Long loops are split over the lanes; short computations are repeated by each lane.
"""

import warp as wp

from egs_warp.kernels.block import sync_block
from egs_warp.kernels.contact.coulomb_block import (
    BLOCK,
    MAX_SWEPT_CONTACTS,
    is_gpu,
    residual_by_block,
    shared_memory,
    speeds_by_block,
    sweep_by_block,
)
from egs_warp.kernels.contact.coulomb_equations import Contacts, Newton, rate_of, solve_equations, write_equations
from egs_warp.kernels.contact.coulomb_step import step_by_block
from egs_warp.kernels.contact.coulomb_wide_step import wide_step_by_block
from egs_warp.kernels.vectors import on_cpu
from egs_warp.precision import Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})

_FEW_SWEEPS, _MORE_SWEEPS = wp.constant(3), wp.constant(20)
"""Number of sweeps before the first attempt, and before each later one."""
_ATTEMPTS = wp.constant(7)
"""Maximum number of attempts before polishing."""
_Rates = wp.types.vector(7, real)
_RATES = wp.constant(_Rates(1.0, 0.3, 3.0, 0.1, 10.0, 0.03, 30.0))
"""Projection rate of each attempt, in units of the rate that ``rate_of`` computes for a scale of 1. If kinks of the
projection prevent steps with one rate from decreasing the residual, full steps with another rate make progress. Every
second attempt changes the rate in each step, which breaks cycles."""
_FULL_STEPS = wp.constant(12)
"""Number of full steps in each attempt except the first."""
_HALVINGS = wp.constant(10)
"""Maximum number of halvings of a step in the line search."""
_MAX_SWEPT = wp.constant(MAX_SWEPT_CONTACTS)
_MIN_PIVOT = wp.constant(real(1e-5))
"""Minimum pivot of the block elimination on a GPU, which exchanges no rows. The entries of the equations are of order
1."""
_MIN_DECREASE = wp.constant(real(1e-4))
"""Sufficient decrease in the line search: relative decrease of the residual norm per unit of step length."""
_REGULARIZATION, _STRONG_REGULARIZATION = wp.constant(real(1e-6)), wp.constant(real(1e-4))
"""Regularisation, which is added to the diagonal of the normal and sticking equations, whose entries are of order 1. It
selects a short step if contacts are redundant, and limits rounding errors if they are nearly redundant. The second
value is used in the first ``_STRONG_STEPS`` steps of all attempts except the first. Without the second value, and with
a constant rate in each attempt, 16 of 296 difficult problems from jumps stay unsolved instead of 3."""
_STRONG_STEPS = wp.constant(6)
"""Number of steps of an attempt that use the stronger regularisation."""
_POLISH_STEPS = wp.constant(2)
"""Number of polishing steps of the last attempt."""
_POLISH_REGULARIZATION = wp.constant(real(1e-10))
"""Regularisation in the polishing steps, too small to change the result."""
_POLISH_FRACTION = wp.constant(real(1e-2))
"""Polishing ends when the residual is below this fraction of the tolerance."""


@wp.func_native(
    on_cpu(
        """
    const int n = 3 * i, stride = delassus.strides[0] / 8;
    const double *const g = (const double*)delassus.data + n * stride, *const f = forces.data;
    v4 a = 0.0, b = 0.0, c = 0.0;
    int k = 0;
    for (; k + 4 <= size; k += 4) {
        const v4 by = *(const v4*)(f + k);
        a += *(const v4*)(g + k) * by;
        b += *(const v4*)(g + stride + k) * by;
        c += *(const v4*)(g + 2 * stride + k) * by;
    }
    double normal = (a[0] + a[1]) + (a[2] + a[3]), first = (b[0] + b[1]) + (b[2] + b[3]);
    double second = (c[0] + c[1]) + (c[2] + c[3]);
    for (; k < size; ++k) {
        normal += g[k] * f[k];
        first += g[stride + k] * f[k];
        second += g[2 * stride + k] * f[k];
    }
    return wp::vec_t<3, double>(normal, first, second);
""",
        elsewhere="""
    const int n = 3 * i, stride = delassus.strides[0] / 8;
    const double *const g = (const double*)delassus.data + n * stride, *const f = forces.data;
    double normal = 0.0, first = 0.0, second = 0.0;
    for (int k = 0; k < size; ++k) {
        normal += g[k] * f[k];
        first += g[stride + k] * f[k];
        second += g[2 * stride + k] * f[k];
    }
    return wp::vec_t<3, double>(normal, first, second);
""",
    )
)
def speeds_by(delassus: wp.array2d[real], size: int, i: int, forces: wp.array[real]) -> Vec3:
    """Return G_i f, the velocity in m/s that ``forces`` f (size,) in newtons cause at contact ``i`` (native code of
    ``speeds_of``)."""
    ...


@wp.func
def speeds_of(contacts: Contacts, i: int, forces: wp.array[real]):
    """Return the velocity in m/s that ``forces`` (3n,) in newtons cause at contact ``i``."""
    return speeds_by(contacts.delassus, 3 * contacts.count, i, forces)


@wp.func
def projected_force(contacts: Contacts, i: int, forces: wp.array[real], velocity: Vec3):
    """Return the force of contact ``i`` in newtons after one projected Gauss-Seidel update (Eq. 8, 9).

    Args:
        contacts: the problem.
        i: index of the contact.
        forces: (3n,) newtons, current forces.
        velocity: m/s, velocity of the contact under these forces, including the normal bias.
    """
    n = 3 * i
    normal = wp.max(forces[n] - velocity[0] / contacts.delassus[n, n], real(0.0))
    change = normal - forces[n]
    stiffest = wp.max(contacts.delassus[n + 1, n + 1], contacts.delassus[n + 2, n + 2])
    first = forces[n + 1] - (velocity[1] + contacts.delassus[n + 1, n] * change) / stiffest
    second = forces[n + 2] - (velocity[2] + contacts.delassus[n + 2, n] * change) / stiffest
    length = wp.sqrt(first * first + second * second)
    share = real(1.0)
    if length > contacts.friction * normal:
        share = contacts.friction * normal / length
    return Vec3(normal, share * first, share * second)


@wp.func
def sweep(contacts: Contacts, sweeps: int, forces: wp.array[real]):
    """Perform ``sweeps`` Gauss-Seidel sweeps over the contacts, which replace the force of each contact in ``forces``
    (3n,) in turn by its ``projected_force``."""
    for _ in range(sweeps):
        for i in range(contacts.count):
            n = 3 * i
            speeds = speeds_of(contacts, i, forces)
            normal_speed = speeds[0] + contacts.free_velocity[n]
            velocity = Vec3(
                normal_speed + contacts.normal_bias[i],
                speeds[1] + contacts.free_velocity[n + 1],
                speeds[2] + contacts.free_velocity[n + 2],
            )
            force = projected_force(contacts, i, forces, velocity)
            for t in range(3):
                forces[n + t] = force[t]


@wp.func
def projection_residual(contacts: Contacts, forces: wp.array[real], scale: real, length: real, newton: Newton):
    """Evaluate P at ``forces`` plus the fraction ``length`` of the Newton step, and store it in ``newton.residual``.

    Args:
        contacts: the problem.
        forces: (3n,) newtons, forces at the start of the step.
        scale: scale of the projection rates (``rate_of``).
        length: fraction of the Newton step.
        newton: workspace, with the velocities at ``forces``, the step and its velocity change.

    Returns:
        Largest magnitude and Euclidean norm of P, divided by the projection rates, m/s. The first is infinite if any
        component is not finite.
    """
    if is_gpu() == 1:
        return residual_by_block(
            contacts.delassus, contacts.friction, contacts.count, forces, newton.velocities, newton.step,
            newton.velocity_change, scale, length, newton.residual,
        )  # fmt: skip
    for i in range(contacts.count):
        n = 3 * i
        rate = rate_of(contacts, i, scale)
        normal = forces[n] + length * newton.step[n]
        trial = normal - rate * (newton.velocities[n] + length * newton.velocity_change[n])
        newton.residual[n] = normal - wp.max(trial, real(0.0))
        radius = contacts.friction * wp.max(normal, real(0.0))
        f1 = forces[n + 1] + length * newton.step[n + 1]
        f2 = forces[n + 2] + length * newton.step[n + 2]
        first = f1 - rate * (newton.velocities[n + 1] + length * newton.velocity_change[n + 1])
        second = f2 - rate * (newton.velocities[n + 2] + length * newton.velocity_change[n + 2])
        pull = wp.sqrt(first * first + second * second)
        share = real(1.0)
        if pull > radius:
            share = radius / pull
        newton.residual[n + 1] = f1 - share * first
        newton.residual[n + 2] = f2 - share * second
    maximum = real(0.0)
    square = real(0.0)
    for i in range(contacts.count):
        rate = rate_of(contacts, i, scale)
        for t in range(3):
            speed = newton.residual[3 * i + t] / rate
            maximum = wp.max(maximum, wp.abs(speed))
            square += speed * speed
    # The maximum ignores NaN; the sum of squares does not.
    if not square < real(wp.inf):
        maximum = real(wp.inf)
    return wp.vec2d(maximum, wp.sqrt(square))


@wp.func
def find_step(contacts: Contacts, forces: wp.array[real], scale: real, regularization: real, newton: Newton):
    """Compute the Newton step at ``forces``, and the velocity change that it causes, into ``newton``.

    On a GPU the block routines are tried first, for up to 120 and then for up to 256 unknowns; if they fail, the
    elimination with row exchanges is used.

    Args:
        contacts: the problem.
        forces: (3n,) newtons, forces at the start of the step.
        scale: scale of the projection rates (``rate_of``).
        regularization: added to the diagonal of the equations (``write_equations``).
        newton: workspace, with the velocities and the residual at ``forces``.
    """
    solved = int(0)
    if is_gpu() == 1:
        solved = step_by_block(
            shared_memory(), contacts.delassus, contacts.friction, contacts.count, forces, newton.velocities,
            newton.residual, scale, regularization, _MIN_PIVOT, newton.step, newton.velocity_change,
        )  # fmt: skip
        if solved == 0:
            solved = wide_step_by_block(
                shared_memory(), contacts.delassus, contacts.friction, contacts.count, forces, newton.velocities,
                newton.residual, scale, regularization, _MIN_PIVOT, newton.step, newton.velocity_change, newton.matrix,
            )  # fmt: skip
    if solved == 0:
        unknowns = write_equations(contacts, forces, scale, regularization, newton)
        solve_equations(unknowns, newton)
    if is_gpu() == 1:
        speeds_by_block(contacts.delassus, 3 * contacts.count, newton.step, newton.velocity_change)
        return
    for i in range(contacts.count):
        speeds = speeds_of(contacts, i, newton.step)
        for t in range(3):
            newton.velocity_change[3 * i + t] = speeds[t]


@wp.func
def find_velocities(contacts: Contacts, forces: wp.array[real], newton: Newton):
    """Compute the contact velocities under ``forces`` (3n,) newtons, including the normal bias, and set the Newton step
    to zero."""
    if is_gpu() == 1:
        speeds_by_block(contacts.delassus, 3 * contacts.count, forces, newton.velocities)
    for i in range(newton.lane, contacts.count, wp.block_dim()):
        n = 3 * i
        if is_gpu() == 1:
            speeds = Vec3(newton.velocities[n], newton.velocities[n + 1], newton.velocities[n + 2])
        else:
            speeds = speeds_of(contacts, i, forces)
        for t in range(3):
            newton.velocities[n + t] = speeds[t] + contacts.free_velocity[n + t]
            newton.step[n + t] = real(0.0)
            newton.velocity_change[n + t] = real(0.0)
        newton.velocities[n] = newton.velocities[n] + contacts.normal_bias[i]
    sync_block()


@wp.func
def sweep_cooperative(contacts: Contacts, sweeps: int, forces: wp.array[real], newton: Newton):
    """Perform Gauss-Seidel sweeps like ``sweep``, on a GPU with a block of threads.

    If there are more contacts than ``sweep_by_block`` supports, all lanes compute the same forces, and each lane
    updates the velocities of some rows.
    """
    if is_gpu() == 0:
        sweep(contacts, sweeps, forces)
        return
    if contacts.count == 0:
        return
    if contacts.count <= _MAX_SWEPT:
        sweep_by_block(
            shared_memory(), contacts.delassus, contacts.free_velocity, contacts.normal_bias, contacts.friction,
            contacts.count, sweeps, forces,
        )  # fmt: skip
        return
    find_velocities(contacts, forces, newton)
    size = 3 * contacts.count
    for _ in range(sweeps):
        for i in range(contacts.count):
            n = 3 * i
            velocity = Vec3(newton.velocities[n], newton.velocities[n + 1], newton.velocities[n + 2])
            force = projected_force(contacts, i, forces, velocity)
            change = force - Vec3(forces[n], forces[n + 1], forces[n + 2])
            # All lanes must have read the forces and velocities before any lane changes them.
            sync_block()
            for row in range(newton.lane, size, wp.block_dim()):
                newton.velocities[row] = newton.velocities[row] + (
                    contacts.delassus[row, n] * change[0]
                    + contacts.delassus[row, n + 1] * change[1]
                    + contacts.delassus[row, n + 2] * change[2]
                )
            if newton.lane == 0:
                for t in range(3):
                    forces[n + t] = force[t]
            sync_block()


@wp.func
def advance(contacts: Contacts, forces: wp.array[real], length: real, newton: Newton):
    """Move ``forces`` (3n,) and the contact velocities by the fraction ``length`` of the Newton step, then set the step
    to zero."""
    for k in range(newton.lane, 3 * contacts.count, wp.block_dim()):
        forces[k] = forces[k] + length * newton.step[k]
        newton.velocities[k] = newton.velocities[k] + length * newton.velocity_change[k]
        newton.step[k] = real(0.0)
        newton.velocity_change[k] = real(0.0)
    sync_block()


@wp.func
def copy_vector(contacts: Contacts, source: wp.array[real], target: wp.array[real], newton: Newton):
    """Copy ``source`` (3n,) to ``target``."""
    for k in range(newton.lane, 3 * contacts.count, wp.block_dim()):
        target[k] = source[k]
    sync_block()


@wp.func
def find_forces(contacts: Contacts, tolerance: real, iterations: int, forces: wp.array[real], newton: Newton):
    """Solve one problem as described in ``coulomb_kernel``, and return its residual in m/s."""
    best_residual = real(wp.inf)
    copy_vector(contacts, forces, newton.best_forces, newton)
    for attempt in range(_ATTEMPTS + 1):
        # The last attempt polishes the best forces, if their residual is below the tolerance. It shares the loop with
        # the other attempts, so that the GPU code contains the step only once.
        is_polishing = best_residual < tolerance
        if attempt == _ATTEMPTS and not is_polishing:
            copy_vector(contacts, newton.best_forces, forces, newton)
            break
        scale = real(1.0)
        regularization = _POLISH_REGULARIZATION
        steps = _POLISH_STEPS
        if is_polishing:
            copy_vector(contacts, newton.best_forces, forces, newton)
        else:
            scale = _RATES[attempt]
            sweeps = _MORE_SWEEPS
            steps = _FULL_STEPS
            if attempt == 0:
                sweeps = _FEW_SWEEPS
                steps = iterations
            sweep_cooperative(contacts, sweeps, forces, newton)
        find_velocities(contacts, forces, newton)
        for number in range(steps):
            if not is_polishing:
                regularization = _REGULARIZATION
                if attempt > 0 and number < _STRONG_STEPS:
                    regularization = _STRONG_REGULARIZATION
                if attempt % 2 == 1:
                    scale = _RATES[(attempt + number) % _ATTEMPTS]
            residual = projection_residual(contacts, forces, scale, real(0.0), newton)
            threshold = tolerance
            if is_polishing:
                threshold = _POLISH_FRACTION * tolerance
                best_residual = residual[0]
            elif residual[0] < best_residual:
                best_residual = residual[0]
                copy_vector(contacts, forces, newton.best_forces, newton)
            if residual[0] < threshold:
                break
            find_step(contacts, forces, scale, regularization, newton)
            length = real(1.0)
            if is_polishing or attempt == 0:
                is_accepted = int(0)
                halvings = int(0)
                while is_accepted == 0 and halvings < _HALVINGS:
                    trial = projection_residual(contacts, forces, scale, length, newton)
                    halvings += 1
                    if is_polishing:
                        halvings = _HALVINGS
                        if trial[0] < tolerance:
                            is_accepted = 1
                            best_residual = trial[0]
                    elif trial[1] < (real(1.0) - _MIN_DECREASE * length) * residual[1]:
                        is_accepted = 1
                    else:
                        length *= real(0.5)
                if is_accepted == 0:
                    break
            advance(contacts, forces, length, newton)
        if is_polishing:
            break
    for i in range(newton.lane, contacts.count, wp.block_dim()):
        n = 3 * i
        normal = wp.max(forces[n], real(0.0))
        pull = wp.sqrt(forces[n + 1] * forces[n + 1] + forces[n + 2] * forces[n + 2])
        share = real(1.0)
        if pull > contacts.friction * normal:
            share = contacts.friction * normal / pull
        forces[n] = normal
        forces[n + 1] = share * forces[n + 1]
        forces[n + 2] = share * forces[n + 2]
    return best_residual


@wp.kernel(launch_bounds=BLOCK)
def coulomb_kernel(
    # In:
    counts: wp.array[int],
    delassus: wp.array3d[real],
    free_velocity: wp.array2d[real],
    normal_bias: wp.array2d[real],
    frictions: wp.array[real],
    tolerance: real,
    iterations: int,
    # In and out:
    forces: wp.array2d[real],
    vectors: wp.array3d[real],
    indices: wp.array3d[int],
    matrices: wp.array3d[Vec4],
    # Out:
    residuals_out: wp.array[real],
):
    """Solve each problem for its contact forces; one block of threads per problem.

    Args:
        counts: (B,) number n of contacts of each problem. Arrays may have capacity for more contacts.
        delassus: (B, 3n, 3n) m/(N s), Delassus operators.
        free_velocity: (B, 3n) m/s, contact velocities without contact forces.
        normal_bias: (B, n) m/s, bias that is added to the normal velocities.
        frictions: (B,) Coulomb coefficients.
        tolerance: m/s, residual at which a solve ends.
        iterations: maximum number of Newton steps of the first attempt.
        forces: (B, 3n) newtons, initial forces on entry; on return, the best forces found, projected onto the cone.
        vectors, indices, matrices: (B, 5, 3n), (B, 2, 3n) and (B, 3n, >= (3n + 1) / 4), workspace of ``Newton``.
        residuals_out: (B,) m/s, residuals of the best forces; infinite for problems without finite forces.
    """
    problem, lane = wp.tid()
    contacts = Contacts()
    contacts.count = counts[problem]
    contacts.delassus = delassus[problem]
    contacts.free_velocity = free_velocity[problem]
    contacts.normal_bias = normal_bias[problem]
    contacts.friction = frictions[problem]
    newton = Newton()
    newton.lane = lane
    newton.velocities = vectors[problem, 0]
    newton.residual = vectors[problem, 1]
    newton.step = vectors[problem, 2]
    newton.velocity_change = vectors[problem, 3]
    newton.best_forces = vectors[problem, 4]
    newton.unknowns = indices[problem, 0]
    newton.pivots = indices[problem, 1]
    newton.matrix = matrices[problem]
    residuals_out[problem] = find_forces(contacts, tolerance, iterations, forces[problem], newton)
