"""Measurement of bodies that are displaced, rotated and set in motion as a whole."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from egs_warp.environments.measurement import measure
from egs_warp.locomotion.batch_state import BatchState
from tests.support.creatures import coarse_pawn


def test_a_rigid_motion_is_measured() -> None:
    body = coarse_pawn().body
    nodes, turn = body.mesh.nodes, Rotation.from_rotvec([0.3, -0.2, 1.1])
    centre = body.centre_of_mass(nodes)
    shift, spin = np.array([0.1, 0.2, -0.3]) * body.height, np.array([0.5, -1.0, 2.0]) / body.time_unit
    moved = turn.apply(nodes - centre) + centre + shift
    speed = np.array([0.4, 0.0, 0.1]) * body.speed_unit
    velocities = speed + np.cross(spin, moved - centre - shift)
    forces = np.array([[[0.25, 0.1, 0.0], [0.5, 0.0, 0.0]], [[0.0] * 3] * 2]) * body.weight
    values = np.stack([moved, nodes]), np.stack([velocities, np.zeros_like(nodes)]), np.zeros(2), np.zeros((2, 2), int)
    state = BatchState(
        torch.arange(2),
        *map(torch.from_numpy, (*values, np.array([2, 0]), forces, np.array([[1.0, 3.0], [0.0, 0.0]]))),
    )
    found = measure(body, torch.from_numpy(nodes), state, torch.tensor([[0.5], [0.5]], dtype=torch.float64))
    for mine, expected in (
        (found.displacement, [[0.1, 0.2, -0.3], [0.0] * 3]),
        (found.velocity, [[0.4, 0.0, 0.1], [0.0] * 3]),
        (found.angular_velocity, [[0.5, -1.0, 2.0], [0.0] * 3]),
        (found.rotation, [turn.as_matrix(), np.eye(3)]),
        (found.load, [0.75, 0.0]),
        (found.activations, [[2.0], [0.0]]),
    ):
        np.testing.assert_allclose(mine, expected, rtol=0, atol=1e-12)
    assert found.vectors.shape == (2, 20) and found.vectors.dtype == np.float32
