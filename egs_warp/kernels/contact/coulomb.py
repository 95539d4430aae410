"""Contact forces with Coulomb friction for given Delassus operators: sweeps, then Newton's method on projections.

Each problem has a block of threads to itself on a GPU, one thread on a CPU; what a thread is within its block is its
``lane``. All lanes take the same way: each does its share of what is wide, and all of what is short.
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
"""Before the first attempt, and before each further one."""
_ATTEMPTS = wp.constant(7)
_Rates = wp.types.vector(7, real)
_RATES = wp.constant(_Rates(1.0, 0.3, 3.0, 0.1, 10.0, 0.03, 30.0))
"""Of the attempts. Where the kinks of the projections keep the steps of one rate from making them smaller, whole steps
of another get on. Every second attempt takes another rate in each of its steps: what goes around in a circle at one
rate leaves it."""
_BOLD = wp.constant(12)
"""Whole steps of each attempt but the first."""
_HALVINGS = wp.constant(10)
_SWEPT = wp.constant(MAX_SWEPT_CONTACTS)
_LEAST = wp.constant(real(1e-5))
"""Pivots on the diagonal of the equations, whose entries are about 1, that are larger are taken without exchange."""
_LESS = wp.constant(real(1e-4))
"""Of a step's length: share by which it has to make the residual smaller."""
_SHORT, _SHORTER = wp.constant(real(1e-6)), wp.constant(real(1e-4))
"""Added to the diagonal of the equations of contacts that stick, whose entries are about 1: of the steps that redundant
contacts leave, a short one is taken, and rounding is not made large by those that they nearly leave. The second in the
``_CAREFUL`` first steps of all attempts but the first. Of 296 problems of jumps that 1e-9 and steps of one rate left at
1e-4 m/s, 1e-6 and another rate in each attempt leave 16; with the second, and other rates in each step of every second
attempt, 3 are left."""
_CAREFUL = wp.constant(6)
_POLISHES = wp.constant(2)
_FINEST = wp.constant(real(1e-10))
"""The same in the last steps: too small to be seen in the answer."""
_POLISHED = wp.constant(real(1e-2))
"""Of the tolerance: what is so near is left as it is."""


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
    """See ``speeds_of``."""
    ...


@wp.func
def speeds_of(contacts: Contacts, i: int, forces: wp.array[real]):
    """That ``forces`` (3n,) give contact ``i``, m/s."""
    return speeds_by(contacts.delassus, 3 * contacts.count, i, forces)


@wp.func
def projected_force(contacts: Contacts, i: int, forces: wp.array[real], velocity: Vec3):
    """The force that contact ``i``'s own normal and tangents ask for at its ``velocity``, m/s, shifted (Eq. 8, 9)."""
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
    """``sweeps`` rounds over all contacts, each of which takes the force that it asks for."""
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
            asked = projected_force(contacts, i, forces, velocity)
            for t in range(3):
                forces[n + t] = asked[t]


@wp.func
def projection_residual(contacts: Contacts, forces: wp.array[real], scale: real, length: real, newton: Newton):
    """Value f - projection of f - rate u at ``length`` of the step from ``forces``; its largest part and its norm, both
    in m/s."""
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
    most = real(0.0)
    square = real(0.0)
    for i in range(contacts.count):
        rate = rate_of(contacts, i, scale)
        for t in range(3):
            speed = newton.residual[3 * i + t] / rate
            most = wp.max(most, wp.abs(speed))
            square += speed * speed
    # A maximum passes over what is no number, a sum does not.
    if not square < real(wp.inf):
        most = real(wp.inf)
    return wp.vec2d(most, wp.sqrt(square))


@wp.func
def find_step(contacts: Contacts, forces: wp.array[real], scale: real, short: real, newton: Newton):
    """A Newton step from the values at ``forces``, and what it changes of the velocities."""
    solved = int(0)
    if is_gpu() == 1:
        solved = step_by_block(
            shared_memory(), contacts.delassus, contacts.friction, contacts.count, forces, newton.velocities,
            newton.residual, scale, short, _LEAST, newton.step, newton.velocity_change,
        )  # fmt: skip
        if solved == 0:
            solved = wide_step_by_block(
                shared_memory(), contacts.delassus, contacts.friction, contacts.count, forces, newton.velocities,
                newton.residual, scale, short, _LEAST, newton.step, newton.velocity_change, newton.matrix,
            )  # fmt: skip
    if solved == 0:
        unknowns = write_equations(contacts, forces, scale, short, newton)
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
    """Those at ``forces``; no step is left."""
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
    """``sweep`` by a block of threads. Of more contacts than ``sweep_by_block`` takes each is every lane's to work out,
    and each lane keeps the velocities of some rows up with it."""
    if is_gpu() == 0:
        sweep(contacts, sweeps, forces)
        return
    if contacts.count == 0:
        return
    if contacts.count <= _SWEPT:
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
            asked = projected_force(contacts, i, forces, velocity)
            change = asked - Vec3(forces[n], forces[n + 1], forces[n + 2])
            # All lanes have read what they change now.
            sync_block()
            for row in range(newton.lane, size, wp.block_dim()):
                newton.velocities[row] = newton.velocities[row] + (
                    contacts.delassus[row, n] * change[0]
                    + contacts.delassus[row, n + 1] * change[1]
                    + contacts.delassus[row, n + 2] * change[2]
                )
            if newton.lane == 0:
                for t in range(3):
                    forces[n + t] = asked[t]
            sync_block()


@wp.func
def advance(contacts: Contacts, forces: wp.array[real], length: real, newton: Newton):
    """Go ``length`` of the step; no step is left."""
    for k in range(newton.lane, 3 * contacts.count, wp.block_dim()):
        forces[k] = forces[k] + length * newton.step[k]
        newton.velocities[k] = newton.velocities[k] + length * newton.velocity_change[k]
        newton.step[k] = real(0.0)
        newton.velocity_change[k] = real(0.0)
    sync_block()


@wp.func
def copy_vector(contacts: Contacts, source: wp.array[real], target: wp.array[real], newton: Newton):
    """``target`` is ``source`` (3n,) then."""
    for k in range(newton.lane, 3 * contacts.count, wp.block_dim()):
        target[k] = source[k]
    sync_block()


@wp.func
def find_forces(contacts: Contacts, tolerance: real, iterations: int, forces: wp.array[real], newton: Newton):
    """Of one problem, see ``coulomb_kernel``; its residual."""
    least = real(wp.inf)
    copy_vector(contacts, forces, newton.best_forces, newton)
    for attempt in range(_ATTEMPTS + 1):
        # The last one begins at the best, once they are near enough, and takes them to rounding: in the same loop, so
        # that a GPU has the code of a step once.
        polishes = least < tolerance
        if attempt == _ATTEMPTS and not polishes:
            copy_vector(contacts, newton.best_forces, forces, newton)
            break
        scale = real(1.0)
        short = _FINEST
        steps = _POLISHES
        if polishes:
            copy_vector(contacts, newton.best_forces, forces, newton)
        else:
            scale = _RATES[attempt]
            sweeps = _MORE_SWEEPS
            steps = _BOLD
            if attempt == 0:
                sweeps = _FEW_SWEEPS
                steps = iterations
            sweep_cooperative(contacts, sweeps, forces, newton)
        find_velocities(contacts, forces, newton)
        for number in range(steps):
            if not polishes:
                short = _SHORT
                if attempt > 0 and number < _CAREFUL:
                    short = _SHORTER
                if attempt % 2 == 1:
                    scale = _RATES[(attempt + number) % _ATTEMPTS]
            size = projection_residual(contacts, forces, scale, real(0.0), newton)
            near = tolerance
            if polishes:
                near = _POLISHED * tolerance
                least = size[0]
            elif size[0] < least:
                least = size[0]
                copy_vector(contacts, forces, newton.best_forces, newton)
            if size[0] < near:
                break
            find_step(contacts, forces, scale, short, newton)
            length = real(1.0)
            if polishes or attempt == 0:
                found = int(0)
                halvings = int(0)
                while found == 0 and halvings < _HALVINGS:
                    trial = projection_residual(contacts, forces, scale, length, newton)
                    halvings += 1
                    if polishes:
                        halvings = _HALVINGS
                        if trial[0] < tolerance:
                            found = 1
                            least = trial[0]
                    elif trial[1] < (real(1.0) - _LESS * length) * size[1]:
                        found = 1
                    else:
                        length *= real(0.5)
                if found == 0:
                    break
            advance(contacts, forces, length, newton)
        if polishes:
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
    return least


@wp.kernel(launch_bounds=BLOCK)
def coulomb_kernel(
    # In:
    counts: wp.array[int],
    delassus: wp.array3d[real],
    free: wp.array2d[real],
    shifts: wp.array2d[real],
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
    """Of each problem ``Contacts`` and ``Newton``, whose vectors and indices lie in ``vectors`` (B, 5, 3n) and
    ``indices`` (B, 2, 3n): sweeps, then semismooth Newton on the projection equations of Alart and Curnier, the step
    halved until it makes them smaller; where that gets stuck, more sweeps and whole steps at other rates. ``forces``
    are the best that were met, within the cone; ``residuals_out`` is how far from the equations they are, m/s, and
    infinite where nothing is a number."""
    problem, lane = wp.tid()
    contacts = Contacts()
    contacts.count = counts[problem]
    contacts.delassus = delassus[problem]
    contacts.free_velocity = free[problem]
    contacts.normal_bias = shifts[problem]
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


@wp.kernel
def sweeps_kernel(
    contacts: Contacts,
    sweeps: int,
    # In and out:
    forces: wp.array[real],
):
    """The sweeps alone, in one thread."""
    sweep(contacts, sweeps, forces)
