"""Kernel that computes the start of a step in each world: lever arms, rotation modes, inverse inertia tensor and rigid
guess.

The first dimension of its launch is the world.
"""

import warp as wp

from egs_warp.kernels.block import sum_of_block, sync_block
from egs_warp.precision import Mat33, Vec3, real

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Number of threads for each world on a GPU."""


@wp.func
def block_sum(value: Vec3):
    """Return the sum of ``value`` over the threads of the block; synchronises the block."""
    first = sum_of_block(value[0])
    sync_block()
    second = sum_of_block(value[1])
    sync_block()
    third = sum_of_block(value[2])
    sync_block()
    return Vec3(first, second, third)


@wp.func
def rotation_displacement(rotation: Vec3, arm: Vec3):
    """Return the displacement of the lever arm ``arm`` (m) under the rotation vector ``rotation`` (rad), by Rodrigues'
    formula."""
    angle = wp.length(rotation)
    once = real(1.0)
    twice = real(0.5)
    if angle > real(1e-9):
        half = wp.sin(real(0.5) * angle) / angle
        once = wp.sin(angle) / angle
        twice = real(2.0) * half * half
    across = wp.cross(rotation, arm)
    return once * across + twice * wp.cross(rotation, across)


@wp.kernel
def step_start_kernel(
    # Model:
    dt: real,
    masses: wp.array[real],
    # In:
    positions: wp.array2d[Vec3],
    velocities: wp.array2d[Vec3],
    # Out:
    arms_out: wp.array2d[Vec3],
    modes_out: wp.array3d[real],
    inverse_inertia_out: wp.array[Mat33],
    guess_out: wp.array2d[Vec3],
):
    """Compute the quantities of ``StepProblem`` that depend on the start of the step. A block of threads computes each
    world; on a CPU, one thread.

    Args:
        dt: step size, s.
        masses: (N,) kg, lumped masses.
        positions: (B, N) m, at the start of the step.
        velocities: (B, N) m/s, at the start of the step.
        arms_out: (B, N) m, ``lever_arms``: positions relative to the centre of mass.
        modes_out: (B, 3N, 3) m, ``rotation_modes``.
        inverse_inertia_out: (B,) 1/(kg m^2), ``inverse_inertia``.
        guess_out: (B, N) m/s, ``rigid_guess``: velocities of the rigid motion with the momenta of the body.
    """
    world, lane = wp.tid()
    count = masses.shape[0]
    mass = real(0.0)
    weighted_position = Vec3()
    momentum = Vec3()
    for node in range(lane, count, wp.block_dim()):
        mass += masses[node]
        weighted_position += masses[node] * positions[world, node]
        momentum += masses[node] * velocities[world, node]
    mass = sum_of_block(mass)
    sync_block()
    centre = block_sum(weighted_position) / mass
    speed = block_sum(momentum) / mass
    squares = Vec3()
    products = Vec3()
    spin = Vec3()
    for node in range(lane, count, wp.block_dim()):
        arm = positions[world, node] - centre
        m = masses[node]
        arms_out[world, node] = arm
        for k in range(3):
            axis = Vec3()
            axis[k] = real(1.0)
            rotation = wp.cross(axis, arm)
            for i in range(3):
                modes_out[world, 3 * node + i, k] = rotation[i]
        squares += m * wp.cw_mul(arm, arm)
        products += m * Vec3(arm[0] * arm[1], arm[1] * arm[2], arm[2] * arm[0])
        spin += m * wp.cross(arm, velocities[world, node])
    squares = block_sum(squares)
    products = block_sum(products)
    spin = block_sum(spin)
    inverse_inertia = wp.inverse(
        wp.matrix_from_rows(
            Vec3(squares[1] + squares[2], -products[0], -products[2]),
            Vec3(-products[0], squares[2] + squares[0], -products[1]),
            Vec3(-products[2], -products[1], squares[0] + squares[1]),
        )
    )
    if lane == 0:
        inverse_inertia_out[world] = inverse_inertia
    rotation = dt * (inverse_inertia * spin)
    for node in range(lane, count, wp.block_dim()):
        guess_out[world, node] = speed + rotation_displacement(rotation, positions[world, node] - centre) / dt
