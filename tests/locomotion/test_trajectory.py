"""Measures and audit on trajectories made by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.locomotion.trajectory import Trajectory, audit, measure
from tests.support.meshes import block_mesh

DT = 1.0 / 60.0
GRAVITY = np.array([0.0, 0.0, -9.81])


@pytest.fixture
def flight() -> Trajectory:
    """A rigid block that takes off with (1, 0, 2) m/s and is posed turning about the vertical,
    by the implicit integrator's own rule.
    """
    mesh = block_mesh()
    mass = mesh.lumped_masses(1000.0)
    steps = 20
    velocity = np.array([1.0, 0.0, 2.0]) + np.arange(steps + 1)[:, None] * DT * GRAVITY
    com = np.concatenate([np.zeros((1, 3)), DT * np.cumsum(velocity[1:], axis=0)])
    rest_com = mass @ mesh.nodes / mass.sum()
    turns = Rotation.from_rotvec(np.outer(np.arange(steps + 1) * 0.03, [0, 0, 1]))
    arms = np.einsum("fij,nj->fni", turns.as_matrix(), mesh.nodes - rest_com)
    spin = np.zeros_like(arms)
    return Trajectory(
        time=DT * np.arange(steps + 1),
        positions=rest_com + com[:, None] + arms,
        velocities=velocity[:, None] + spin,
        rest_positions=mesh.nodes,
        tets=mesh.tets,
        node_mass=mass,
        gravity=GRAVITY,
        planes=np.array([[0.0, 0.0, 1.0, 0.0]]),
        solid_from_plane=np.zeros(1, np.int32),
        friction=0.8,
        drag=0.0,
        height=1.0,
        contact_step=np.zeros(0, np.int32),
        contact_nodes=np.zeros((0, 4), np.int32),
        contact_weights=np.zeros((0, 4)),
        contact_normal=np.zeros((0, 3)),
        contact_force=np.zeros((0, 3)),
        contact_gap=np.zeros(0),
        min_gap=com[:, 2].copy(),
        activations=np.zeros((steps, 2)),
    )


def test_ballistic_flight_passes_and_is_measured(flight: Trajectory) -> None:
    result = audit(flight)
    assert result.momentum_residual < 1e-10
    assert result.angular_momentum_residual < 1e-10
    assert result.penetration == result.cone_violation == result.complementarity_gap == 0.0
    assert result.inverted_elements == 0
    reached = measure(flight)
    com = flight.min_gap
    assert reached.distance == pytest.approx(20 * DT, rel=1e-12)
    assert reached.height == pytest.approx(com.max(), rel=1e-12)
    assert reached.heading_degrees == pytest.approx(np.degrees(0.6), rel=1e-9)
    assert reached.tilt_degrees == pytest.approx(0.0, abs=1e-5)
    assert reached.airborne_frames == pytest.approx(60 * (flight.time[com > 0][-1] - flight.time[1]))


def test_each_violation_is_seen(flight: Trajectory) -> None:
    """A known error in each quantity comes back as the number its definition says."""
    weight = flight.node_mass.sum() * 9.81
    kicked = flight.velocities.copy()
    kicked[7:] += [0.0, 0.01, 0.0]
    assert audit(replace(flight, velocities=kicked)).momentum_residual == pytest.approx(0.01 / DT / 9.81, rel=1e-9)
    com = np.einsum("n,fni->fi", flight.node_mass, flight.positions) / flight.node_mass.sum()
    turned = flight.velocities.copy()
    turned[7:] += np.cross([0.0, 0.02, 0.0], flight.positions[7:] - com[7:, None])
    arms = flight.positions[7] - com[7]
    spin = (flight.node_mass[:, None] * np.cross(arms, np.cross([0.0, 0.02, 0.0], arms))).sum(0)
    seen = audit(replace(flight, velocities=turned)).angular_momentum_residual
    assert seen == pytest.approx(np.linalg.norm(spin) / DT / weight, rel=0.05)
    pushed = replace(
        flight,
        contact_step=np.array([3], np.int32),
        contact_nodes=np.array([[0, 1, 2, 3]], np.int32),
        contact_weights=np.full((1, 4), 0.25),
        contact_normal=np.array([[0.0, 0.0, 1.0]]),
        contact_force=np.array([[weight, 0.0, weight]]),
        contact_gap=np.array([0.01]),
    )
    result = audit(pushed)
    assert result.cone_violation == pytest.approx(0.2)
    assert result.complementarity_gap == pytest.approx(0.01)
    assert result.momentum_residual == pytest.approx(np.sqrt(2.0))
    assert audit(replace(flight, min_gap=flight.min_gap - 0.03)).penetration == pytest.approx(0.03)
    flipped = flight.positions.copy()
    flipped[5] *= [1.0, 1.0, -1.0]
    assert audit(replace(flight, positions=flipped)).inverted_elements == len(flight.tets)


def test_tilt_is_the_angle_to_the_normal(flight: Trajectory) -> None:
    leaned = flight.positions.copy()
    leaned[-1] = leaned[-1] @ Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix().T
    assert measure(replace(flight, positions=leaned)).tilt_degrees == pytest.approx(np.degrees(0.3), rel=1e-9)


def test_saved_trajectory_comes_back_bit_for_bit(flight: Trajectory, tmp_path: Path) -> None:
    flight.save(tmp_path / "a.npz")
    flight.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    back = Trajectory.load(tmp_path / "a.npz")
    for name in flight.__dataclass_fields__:
        assert np.array_equal(getattr(back, name), getattr(flight, name)), name
