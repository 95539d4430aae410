"""Kernels that evaluate a trial of Newton's method on steps with contact, with one thread for each node or contact of
each world (Eq. 4, 8).

The host code is in ``egs_warp/contact/trial.py``; ``device_newton_workspace.py`` launches the first and the last
kernel. On the host, ``contact/newton.py`` evaluates trials with NumPy.
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
    """Copy an iterate into the base slot.

    Args:
        slot: (1,) 1 to copy ``trial``, 2 to copy ``start``, 0 to leave the base unchanged.
        trial, start: packed iterates.
        base_out: packed iterate, the base.
    """
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
    """Move the velocities of each world along its Newton step, and compute the end positions of the nodes.

    The full step ends at ``free_velocities`` + ``force_velocities``. For a length of 0 neither is read, so they need
    not be finite.

    Args:
        starts: (B, N) m, nodes at the start of the time step.
        dt: step size, s.
        lengths: (B,) fraction of the Newton step.
        velocities: (B, N) m/s, at the start of the Newton step.
        free_velocities: (B, N) m/s, after a full Newton step without contact forces.
        force_velocities: (B, N) m/s, change of the velocities by the contact forces.
        velocities_out: (B, N) m/s, velocities of the trial.
        ends_out: (B, N) m, end positions of the trial.
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
    """Move the contact forces of each world along its Newton step.

    Args:
        lengths: (B,) fraction of the Newton step.
        forces: (B, K) newtons, at the start of the Newton step.
        target_forces: (B, K) newtons, after a full Newton step.
        forces_out: (B, K) newtons, contact forces of the trial.
    """
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
    """Compute the residual of the equation of motion in all worlds (``ImplicitStep.residual``).

    Args:
        masses: (N,) kg, lumped masses.
        gravity: m/s^2.
        ratio: 1 + dt alpha (``ImplicitStep.inertia_ratio``).
        dt: step size, s.
        arms: (B, N) m, positions relative to the centre of mass at the start of the step.
        inverse_inertia: (B,) 1/(kg m^2), inverse inertia tensors.
        old_velocities: (B, N) m/s, at the start of the step.
        counts, nodes, weights, axes: the contacts, as in ``contact_jacobian_kernel``.
        torque: (B,) N m, torque of ``internal`` about the centre of mass.
        internal: (B, N) newtons, gradient of the internal energy: minus the internal forces.
        velocities: (B, N) m/s, of the trial.
        forces: (B, K) newtons, contact forces of the trial.
        free_out: (B, N) N s, residual without contact forces.
        rest_out: (B, N) N s, residual with contact forces.
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
    """Compute the velocities after a full Newton step without contact forces, in one world.

    Args:
        rotation_response: (3N, 3) factor of the momentum projection (``MomentumProjection``).
        velocities: (N,) m/s, at the start of the Newton step.
        solved: (N,) m/s, the inverse tangent times the residual, without the momentum projection.
        rotation: (3,) coefficients of the projection, which adds ``rotation_response`` times these to ``solved``.
        free_velocities_out: (N,) m/s, output.
    """
    node = wp.tid()
    correction = Vec3(real(0.0))
    for i in range(3):
        for k in range(3):
            correction[i] += rotation_response[3 * node + i, k] * rotation[k]
    free_velocities_out[node] = velocities[node] - solved[node] - correction
