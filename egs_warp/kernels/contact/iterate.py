"""Kernels that evaluate a trial of Newton's method on steps with contact, with one thread for each node or contact of
each world (Eq. 4, 8).

The host code is in ``egs_warp/contact/trial.py``; ``device_newton_workspace.py`` launches the first and the last
kernel. ``iterate_cpu`` contains the kernels for a CPU.
"""

import warp as wp

from egs_warp.kernels.contact.contacts import nodal_force
from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def select_base_kernel(
    # In:
    slot: wp.array[real],
    trial: wp.array[real],
    start: wp.array[real],
    # Out:
    base_out: wp.array[real],
):
    """Overwrite the base with ``trial`` if ``slot`` is 1, or with ``start`` if it is 2; do nothing if it is 0."""
    i = wp.tid()
    if slot[0] == real(1.0):
        base_out[i] = trial[i]
    elif slot[0] == real(2.0):
        base_out[i] = start[i]


@wp.kernel
def trial_kernel(
    # Model:
    starts: wp.array2d[Vec3],
    dt: real,
    # In:
    lengths: wp.array[real],
    velocities: wp.array2d[Vec3],
    free_velocities: wp.array2d[Vec3],
    force_velocities: wp.array2d[Vec3],
    # Out:
    velocities_out: wp.array2d[Vec3],
    ends_out: wp.array2d[Vec3],
):
    """Move the velocities of each world along a Newton step by the fraction in ``lengths``, and compute the end
    positions of the nodes.

    The full step ends at ``free_velocities``, without contact forces, plus ``force_velocities``, the effect of the
    contact forces. At length 0 both are ignored and need not be finite.
    """
    world, node = wp.tid()
    length = lengths[world]
    velocity = velocities[world, node]
    if length != real(0.0):
        end = free_velocities[world, node] + force_velocities[world, node]
        velocity += length * (end - velocity)
    velocities_out[world, node] = velocity
    ends_out[world, node] = starts[world, node] + dt * velocity


@wp.kernel
def trial_forces_kernel(
    # In:
    lengths: wp.array[real],
    forces: wp.array2d[Vec3],
    target_forces: wp.array2d[Vec3],
    # Out:
    forces_out: wp.array2d[Vec3],
):
    """Move the contact ``forces`` of each world towards ``target_forces`` by the fraction in ``lengths``."""
    world, contact = wp.tid()
    length = lengths[world]
    force = forces[world, contact]
    if length != real(0.0):
        force += length * (target_forces[world, contact] - force)
    forces_out[world, contact] = force


@wp.kernel
def residual_kernel(
    # Model:
    masses: wp.array[real],
    gravity: Vec3,
    ratio: real,
    dt: real,
    arms: wp.array2d[Vec3],
    inverse_inertia: wp.array[Mat33],
    old_velocities: wp.array2d[Vec3],
    counts: wp.array[int],
    nodes: wp.array2d[wp.vec4i],
    weights: wp.array2d[Vec4],
    axes: wp.array2d[Mat33],
    # In:
    torque: wp.array[Vec3],
    internal: wp.array2d[Vec3],
    velocities: wp.array2d[Vec3],
    forces: wp.array2d[Vec3],
    # Out:
    free_out: wp.array2d[Vec3],
    rest_out: wp.array2d[Vec3],
):
    """Compute the residual of all worlds in N s (``ImplicitStep.residual``), without and with contact forces.

    ``internal`` is the internal gradient in newtons, minus the internal forces; ``torque`` is its torque in N m.
    """
    world, node = wp.tid()
    spin = dt * (inverse_inertia[world] * torque[world])
    change = ratio * velocities[world, node] - old_velocities[world, node] - dt * gravity
    free = masses[node] * (change - wp.cross(spin, arms[world, node])) + dt * internal[world, node]
    free_out[world, node] = free
    rest_out[world, node] = free - dt * nodal_force(counts, nodes, weights, axes, forces, world, node)


@wp.kernel
def free_velocity_kernel(
    # Model:
    rotation_response: wp.array2d[real],
    # In:
    velocities: wp.array[Vec3],
    solved: wp.array[Vec3],
    rotation: wp.array[real],
    # Out:
    free_velocities_out: wp.array[Vec3],
):
    """Compute the velocities after a Newton step without contact forces. The momentum projection adds
    ``rotation_response`` (3N, 3) times ``rotation`` to ``solved``.
    """
    node = wp.tid()
    correction = Vec3(real(0.0))
    for i in range(3):
        for k in range(3):
            correction[i] += rotation_response[3 * node + i, k] * rotation[k]
    free_velocities_out[node] = velocities[node] - solved[node] - correction
