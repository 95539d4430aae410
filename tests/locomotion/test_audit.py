"""Audit of runs: each measure is within its bound in correct runs, and exceeds it after a deliberate error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.locomotion import audit as module
from egs_warp.locomotion.audit import audit, end_stretch
from egs_warp.locomotion.trajectory import Trajectory
from tests.support.flights import rigid_flight
from tests.support.slides import slide
from tests.support.stances import DT
from tests.support.waves import wavy_ground


@pytest.fixture
def flight() -> Trajectory:
    return rigid_flight()


def test_ballistic_flight_passes(flight: Trajectory) -> None:
    result = audit(flight)
    assert result.momentum_residual < 1e-10
    assert result.angular_momentum_residual < 1e-10
    assert result.penetration == result.cone_violation == result.complementarity_gap == 0.0
    assert result.inverted_elements == 0


def test_each_violation_is_measured(flight: Trajectory) -> None:
    """A known error in each quantity gives the value that its definition predicts."""
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
        contact_plane=np.zeros(1, np.int32),
        contact_normal=np.array([[0.0, 0.0, 1.0]]),
        contact_force=np.array([[weight, 0.0, weight]]),
        contact_gap=np.array([0.01]),
    )
    result = audit(pushed)
    assert result.cone_violation == pytest.approx(0.2)
    # The four nodes move down with the block in the air.
    end = flight.positions[4, :4, 2].mean()
    assert result.complementarity_gap == pytest.approx(end)
    assert result.momentum_residual == pytest.approx(np.sqrt(2.0))
    assert audit(replace(flight, min_gap=flight.min_gap - 0.03)).penetration == pytest.approx(0.03)
    flipped = flight.positions.copy()
    flipped[5] *= [1.0, 1.0, -1.0]
    assert audit(replace(flight, positions=flipped)).inverted_elements == len(flight.tets)
    for factor in (3.0, 1.0 / 3.0):
        stretched = flight.positions.copy()
        stretched[-1] *= [1.0, factor, 1.0]
        assert audit(replace(flight, positions=stretched)).end_stretch == pytest.approx(3.0)
    assert audit(flight).end_stretch == pytest.approx(1.0), "a rigid rotation"
    for value in (0.0, np.nan):
        collapsed = flight.positions.copy()
        collapsed[-1, :, 1] = value
        assert end_stretch(replace(flight, positions=collapsed)) > 1e9


def test_a_run_that_slides_passes() -> None:
    result = audit(slide().trajectory())
    assert result.momentum_residual < 1e-8 and result.angular_momentum_residual < 1e-8
    assert result.energy_residual < 1e-9
    assert result.cone_violation < 1e-9 and result.friction_gap < 1e-7 and result.complementarity_gap < 1e-7
    assert result.contact_velocity < 1e-12
    assert result.newton_unconverged == result.inverted_elements == 0 and result.penetration < 5e-3


def test_contacts_with_other_bodies_are_external_forces() -> None:
    """The balances of momentum and energy contain the forces of these contacts. Their slip and gap are unknown, so
    ``friction_gap`` and ``complementarity_gap`` omit them."""
    t = slide().trajectory()
    others = replace(t, contact_plane=np.full_like(t.contact_plane, -3))
    sliding_on_ground, pushed = audit(t), audit(others)
    assert pushed.momentum_residual == sliding_on_ground.momentum_residual
    assert pushed.energy_residual == sliding_on_ground.energy_residual
    assert pushed.friction_gap == pushed.complementarity_gap == 0.0


def test_a_missing_misplaced_or_late_push_is_detected() -> None:
    """The body is pushed by a blow on one side and by wind. If the blow is distributed over all nodes instead, the
    linear momentum is still correct, but angular momentum and energy are not."""
    struck = slide(struck=True).trajectory()
    held = audit(struck)
    assert held.momentum_residual < 1e-8 and held.angular_momentum_residual < 1e-8 and held.energy_residual < 1e-9
    assert held.friction_gap < 1e-7 and held.complementarity_gap < 1e-7 and held.contact_velocity < 1e-12
    later = struck.kick_step != 8
    missed = audit(replace(struck, kick_step=struck.kick_step[later], kick_velocity=struck.kick_velocity[later]))
    assert min(missed.momentum_residual, missed.angular_momentum_residual, missed.energy_residual) > 1e-3
    mean = np.einsum("n,kni->ki", struck.node_mass, struck.kick_velocity) / struck.node_mass.sum()
    even = np.broadcast_to(mean[:, None], struck.kick_velocity.shape)
    elsewhere = audit(replace(struck, kick_velocity=even))
    assert elsewhere.momentum_residual < 1e-8
    assert min(elsewhere.angular_momentum_residual, elsewhere.energy_residual) > 1e-3
    late = audit(replace(struck, kick_step=struck.kick_step + (struck.kick_step == 8)))
    assert min(late.momentum_residual, late.angular_momentum_residual, late.energy_residual) > 1e-3


def sliding(t: Trajectory) -> np.ndarray:
    """Return the five contacts whose friction dissipates the most energy."""
    way = np.diff(t.positions, axis=0)[t.contact_step[:, None], t.contact_nodes]
    moved = np.einsum("cw,cwi->ci", t.contact_weights, way)
    level = t.contact_force * [1.0, 1.0, 0.0]
    return np.argsort(np.einsum("ci,ci->c", level, moved))[:5]


def test_friction_not_opposite_to_the_slip_is_detected() -> None:
    """Friction is reversed, rotated by a right angle, or halved, which stays within the cone."""
    t = slide().trajectory()
    for turn in (np.diag([-1.0, -1.0, 1.0]), np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.diag([0.5, 0.5, 1.0])):
        forces = t.contact_force.copy()
        forces[sliding(t)] = forces[sliding(t)] @ turn.T
        wrong = audit(replace(t, contact_force=forces))
        assert wrong.friction_gap > 1e-5 and wrong.cone_violation < 1e-12


def test_a_contact_force_across_a_gap_is_detected() -> None:
    """Here, all contacts are lifted off their plane by 1 mm."""
    t = slide().trajectory()
    normal = (t.contact_force * t.contact_normal).sum(axis=1)
    lifted = replace(t, planes=t.planes - [0.0, 0.0, 0.0, -1e-3])
    weight = t.node_mass.sum() * 9.81
    assert audit(lifted).complementarity_gap == pytest.approx(normal.max() * 1e-3 / weight, rel=0.01)


def test_wrong_contact_velocities_are_detected() -> None:
    """Here, the velocities of one step have a lateral error of 1 mm/s."""
    t = slide().trajectory()
    velocities = t.velocities.copy()
    velocities[t.contact_step[0] + 1] += [0.0, 1e-3, 0.0]
    assert audit(replace(t, velocities=velocities)).contact_velocity == pytest.approx(1e-3 / np.sqrt(9.81), rel=1e-6)
    # Velocities of points without load are not audited.
    forces = np.where((t.contact_step == t.contact_step[0])[:, None], 0.0, t.contact_force)
    assert audit(replace(t, velocities=velocities, contact_force=forces)).contact_velocity < 1e-12


def test_lost_momenta_are_detected_under_contact_and_drag() -> None:
    """The errors are contact forces that are 1 % too large, twice the drag, and a spin of 0.01 rad/s without a
    torque."""
    t = slide().trajectory()
    assert audit(replace(t, contact_force=1.01 * t.contact_force)).momentum_residual > 1e-3
    assert audit(replace(t, drag=2.0 * t.drag)).momentum_residual > 1e-3
    arms = t.positions[-1] - t.node_mass @ t.positions[-1] / t.node_mass.sum()
    spun = np.concatenate([t.velocities[:-1], t.velocities[-1:] + np.cross([0.0, 0.0, 0.01], arms)])
    found = audit(replace(t, velocities=spun))
    assert found.angular_momentum_residual > 1e-4 and found.momentum_residual < 1e-8


def test_uneven_ground_equals_the_height_field(flight: Trajectory) -> None:
    """On waves, the heights and normals that the audit computes with SciPy's splines equal those of the height field to
    1e-6."""
    field = wavy_ground(0.05)
    t = replace(
        flight,
        ground_axes=field.axes,
        ground_origin=field.origin,
        ground_spacing=field.spacing,
        ground_coefficients=field.coefficients,
    )
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (200, 3))
    lift, normals = module._ground(t, points)
    np.testing.assert_allclose(lift, field.ground_height(points), atol=1e-9)
    np.testing.assert_allclose(normals, field.frames(points)[:, 0], atol=1e-6)
    assert np.ptp(normals[:, 0]) > 0.3 and np.ptp(normals[:, 1]) > 0.2
