"""A trial of Newton's method on a step with contact, a thread for each node or contact (Eq. 4, 8)."""

import warp as wp

from egs_warp.precision import Mat33, Vec3, Vec4, real

wp.set_module_options({"enable_backward": False})


@wp.kernel
def select_base_kernel(
    # In:
    told: wp.array[real],
    trial: wp.array[real],
    begun: wp.array[real],
    # Out:
    base_out: wp.array[real],
):
    """The base stays, becomes the ``trial`` (1), or what was ``begun`` (2), as is told."""
    i = wp.tid()
    if told[0] == real(1.0):
        base_out[i] = trial[i]
    elif told[0] == real(2.0):
        base_out[i] = begun[i]


@wp.kernel
def invert_momentum_matrix_kernel(
    # In:
    ratio: real,
    momenta: wp.array[Mat33],
    # Out:
    held_out: wp.array[Mat33],
):
    """Inverse of ``ratio`` times the angular momenta (1,) of what three of them bring about."""
    held_out[0] = wp.inverse(ratio * momenta[0])


@wp.kernel
def trial_kernel(
    # Model:
    starts: wp.array[Vec3],
    dt: real,
    # In:
    lengths: wp.array[real],
    velocities: wp.array[Vec3],
    loose: wp.array[Vec3],
    pushed: wp.array[Vec3],
    # Out:
    velocities_out: wp.array[Vec3],
    ends_out: wp.array[Vec3],
):
    """``lengths[0]`` of the way to the end of a Newton step, which moves at ``loose`` without contact forces and is
    ``pushed`` by them; where the nodes are then, from ``starts`` on. Of a way of which nothing is gone the end need be
    no number."""
    node = wp.tid()
    velocity = velocities[node]
    if lengths[0] != real(0.0):
        end = loose[node] + pushed[node]
        velocity = velocities[node] + lengths[0] * (end - velocities[node])
    velocities_out[node] = velocity
    ends_out[node] = starts[node] + dt * velocity


@wp.kernel
def trial_forces_kernel(
    # In:
    lengths: wp.array[real],
    forces: wp.array[Vec3],
    wanted: wp.array[Vec3],
    # Out:
    forces_out: wp.array[Vec3],
):
    """``lengths[0]`` of the way from ``forces`` to those that are ``wanted``."""
    contact = wp.tid()
    force = forces[contact]
    if lengths[0] != real(0.0):
        force = forces[contact] + lengths[0] * (wanted[contact] - forces[contact])
    forces_out[contact] = force


@wp.kernel
def residual_kernel(
    # Model:
    masses: wp.array[real],
    gravity: Vec3,
    ratio: real,
    dt: real,
    arms: wp.array[Vec3],
    turning_rates: wp.array[Mat33],
    old_velocities: wp.array[Vec3],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[Vec4],
    axes: wp.array[Mat33],
    # In:
    torque: wp.array[Vec3],
    internal: wp.array[Vec3],
    velocities: wp.array[Vec3],
    forces: wp.array[Vec3],
    # Out:
    free_out: wp.array[Vec3],
    rest_out: wp.array[Vec3],
):
    """``StepProblem.residual``, without contact forces and with them, N s; ``torque`` N m of what is ``internal``,
    newtons of the other sign; contacts that are not there weigh nothing."""
    node = wp.tid()
    spin = dt * (turning_rates[0] * torque[0])
    change = ratio * velocities[node] - old_velocities[node] - dt * gravity - wp.cross(spin, arms[node])
    free = masses[node] * change + dt * internal[node]
    push = Vec3(real(0.0))
    for contact in range(nodes.shape[0]):
        corners = nodes[contact]
        for corner in range(4):
            if corners[corner] == node:
                push += weights[contact][corner] * (wp.transpose(axes[contact]) * forces[contact])
    free_out[node] = free
    rest_out[node] = free - dt * push


@wp.kernel
def free_velocity_kernel(
    # Model:
    turned: wp.array2d[real],
    # In:
    velocities: wp.array[Vec3],
    solved: wp.array[Vec3],
    turn: wp.array[real],
    # Out:
    loose_out: wp.array[Vec3],
):
    """Where a Newton step without contact forces ends: ``solved`` lacks so much of a ``turn``, in the ``turned``
    columns."""
    node = wp.tid()
    lacking = Vec3(real(0.0))
    for i in range(3):
        for k in range(3):
            lacking[i] += turned[3 * node + i, k] * turn[k]
    loose_out[node] = velocities[node] - solved[node] - lacking
