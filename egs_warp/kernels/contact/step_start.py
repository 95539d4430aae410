"""Where a step starts: the body's arms, its rigid turns, and the rigid motion to solve the step from."""

import warp as wp

from egs_warp.kernels.block import sum_of_block, sync_block
from egs_warp.precision import Mat33, Vec3, real

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Threads on a GPU."""


@wp.func
def sums_of_block(value: Vec3):
    """Of the threads' vectors."""
    first = sum_of_block(value[0])
    sync_block()
    second = sum_of_block(value[1])
    sync_block()
    third = sum_of_block(value[2])
    sync_block()
    return Vec3(first, second, third)


@wp.func
def turned_by(turn: Vec3, arm: Vec3):
    """How far ``arm`` goes in the rotation by the vector ``turn``, radians (Rodrigues)."""
    angle = wp.length(turn)
    once = real(1.0)
    twice = real(0.5)
    if angle > real(1e-9):
        half = wp.sin(real(0.5) * angle) / angle
        once = wp.sin(angle) / angle
        twice = real(2.0) * half * half
    across = wp.cross(turn, arm)
    return once * across + twice * wp.cross(turn, across)


@wp.kernel
def step_start_kernel(
    # Model:
    dt: real,
    masses: wp.array[real],
    # In:
    positions: wp.array[Vec3],
    velocities: wp.array[Vec3],
    # Out:
    arms_out: wp.array[Vec3],
    turns_out: wp.array2d[real],
    rates_out: wp.array[Mat33],
    start_out: wp.array[Vec3],
):
    """Of a step of ``dt`` seconds ``StepProblem.arms``, ``turns`` (3N, 3), ``turning_rates`` (1,) and ``start``, by one
    block of threads, one thread on a CPU."""
    lane = wp.tid()
    count = masses.shape[0]
    mass = real(0.0)
    place = Vec3()
    momentum = Vec3()
    for node in range(lane, count, wp.block_dim()):
        mass += masses[node]
        place += masses[node] * positions[node]
        momentum += masses[node] * velocities[node]
    mass = sum_of_block(mass)
    sync_block()
    centre = sums_of_block(place) / mass
    speed = sums_of_block(momentum) / mass
    squares = Vec3()
    products = Vec3()
    spin = Vec3()
    for node in range(lane, count, wp.block_dim()):
        arm = positions[node] - centre
        m = masses[node]
        arms_out[node] = arm
        for k in range(3):
            axis = Vec3()
            axis[k] = real(1.0)
            turn = wp.cross(axis, arm)
            for i in range(3):
                turns_out[3 * node + i, k] = turn[i]
        squares += m * wp.cw_mul(arm, arm)
        products += m * Vec3(arm[0] * arm[1], arm[1] * arm[2], arm[2] * arm[0])
        spin += m * wp.cross(arm, velocities[node])
    squares = sums_of_block(squares)
    products = sums_of_block(products)
    spin = sums_of_block(spin)
    rates = wp.inverse(
        wp.matrix_from_rows(
            Vec3(squares[1] + squares[2], -products[0], -products[2]),
            Vec3(-products[0], squares[2] + squares[0], -products[1]),
            Vec3(-products[2], -products[1], squares[0] + squares[1]),
        )
    )
    if lane == 0:
        rates_out[0] = rates
    turn = dt * (rates * spin)
    for node in range(lane, count, wp.block_dim()):
        start_out[node] = speed + turned_by(turn, positions[node] - centre) / dt
