"""Block Gauss-Seidel sweeps of contact forces with Coulomb friction."""

import warp as wp

from egs_warp.precision import real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def gauss_seidel_kernel(
    # Model:
    delassus: wp.array2d[real],
    free_velocities: wp.array[real],
    shifts: wp.array[real],
    friction: real,
    sweeps: int,
    # In and out:
    forces: wp.array[real],
):
    """``sweeps`` rounds over all contacts in one thread: each takes the force that its own normal and tangents ask for
    (Eq. 8, 9).
    """
    count = shifts.shape[0]
    for _ in range(sweeps):
        for i in range(count):
            n = 3 * i
            normal_speed = free_velocities[n]
            first_speed = free_velocities[n + 1]
            second_speed = free_velocities[n + 2]
            for k in range(3 * count):
                f = forces[k]
                normal_speed += delassus[n, k] * f
                first_speed += delassus[n + 1, k] * f
                second_speed += delassus[n + 2, k] * f
            normal = wp.max(forces[n] - (normal_speed + shifts[i]) / delassus[n, n], real(0.0))
            change = normal - forces[n]
            stiffest = wp.max(delassus[n + 1, n + 1], delassus[n + 2, n + 2])
            first = forces[n + 1] - (first_speed + delassus[n + 1, n] * change) / stiffest
            second = forces[n + 2] - (second_speed + delassus[n + 2, n] * change) / stiffest
            length = wp.sqrt(first * first + second * second)
            share = real(1.0)
            if length > friction * normal:
                share = friction * normal / length
            forces[n] = normal
            forces[n + 1] = share * first
            forces[n + 2] = share * second
