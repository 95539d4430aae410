"""Trajectory of a rigid block in flight, made without simulation."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.locomotion.trajectory import Trajectory
from tests.support.meshes import block_mesh
from tests.support.stances import DT

GRAVITY = np.array([0.0, 0.0, -9.81])


def rigid_flight() -> Trajectory:
    """Return the flight of a block that takes off with (1, 0, 2) m/s and rotates about the vertical.

    The centre of mass satisfies implicit Euler; the velocities do not include the rotation.
    """
    mesh = block_mesh()
    mass = mesh.lumped_masses(1000.0)
    steps = 20
    velocity = np.array([1.0, 0.0, 2.0]) + np.arange(steps + 1)[:, None] * DT * GRAVITY
    com = np.concatenate([np.zeros((1, 3)), DT * np.cumsum(velocity[1:], axis=0)])
    rest_com = mass @ mesh.nodes / mass.sum()
    rotations = Rotation.from_rotvec(np.outer(np.arange(steps + 1) * 0.03, [0, 0, 1]))
    arms = np.einsum("fij,nj->fni", rotations.as_matrix(), mesh.nodes - rest_com)
    return Trajectory(
        time=DT * np.arange(steps + 1),
        dt=np.full(steps, DT),
        positions=rest_com + com[:, None] + arms,
        velocities=velocity[:, None] + np.zeros_like(arms),
        rest_positions=mesh.nodes,
        unloaded_positions=mesh.nodes,
        tets=mesh.tets,
        node_mass=mass,
        gravity=GRAVITY,
        planes=np.array([[0.0, 0.0, 1.0, 0.0]]),
        solid_from_plane=np.zeros(1, np.int32),
        friction=0.8,
        drag=0.0,
        young_modulus=2e5,
        poisson_ratio=0.4,
        damping_time=0.01,
        height=1.0,
        contact_step=np.zeros(0, np.int32),
        contact_nodes=np.zeros((0, 4), np.int32),
        contact_weights=np.zeros((0, 4)),
        contact_plane=np.zeros(0, np.int32),
        contact_normal=np.zeros((0, 3)),
        contact_force=np.zeros((0, 3)),
        contact_gap=np.zeros(0),
        min_gap=com[:, 2].copy(),
        activations=np.zeros((steps, 2)),
        muscle_end_starts=np.arange(4, dtype=np.int32),
        muscle_end_nodes=np.arange(3, dtype=np.int32),
        muscle_end_weights=np.ones(3),
        muscle_segments=np.array([[0, 1], [1, 2]], np.int32),
        muscle_rest_lengths=np.linalg.norm(np.diff(mesh.nodes[:3], axis=0), axis=1),
        muscle_stiffness=np.full(2, 1e3),
    )
