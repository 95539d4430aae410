"""Measures of hand-made trajectories, and round trips of trajectories through a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.locomotion.trajectory import Trajectory, measure
from tests.support.flights import rigid_flight
from tests.support.stances import DT


@pytest.fixture
def flight() -> Trajectory:
    return rigid_flight()


def test_ballistic_flight_is_measured(flight: Trajectory) -> None:
    reached = measure(flight)
    com = flight.min_gap
    assert reached.distance == pytest.approx(20 * DT, rel=1e-12)
    assert reached.height == pytest.approx(com.max(), rel=1e-12)
    assert reached.heading_degrees == pytest.approx(np.degrees(0.6), rel=1e-9)
    assert reached.tilt_degrees == pytest.approx(0.0, abs=1e-5)
    assert reached.airborne_frames == pytest.approx(60 * (flight.time[com > 0][-1] - flight.time[1]))


def test_distance_and_height_are_measured_from_the_standing_body(flight: Trajectory) -> None:
    """A body that starts 0.1 m lower and 0.2 m behind its standing place rises by 0.1 m less and moves 0.2 m less."""
    usual = measure(flight)
    along = flight.positions[-1].mean(axis=0) - flight.positions[0].mean(axis=0)
    up = -flight.gravity / np.linalg.norm(flight.gravity)
    along -= (along @ up) * up
    com = flight.node_mass @ flight.positions[0] / flight.node_mass.sum()
    reached = measure(flight, standing_com=com + 0.1 * up + 0.2 * along / np.linalg.norm(along))
    assert usual.height - reached.height == pytest.approx(0.1 / flight.height)
    assert usual.distance - reached.distance == pytest.approx(0.2 / flight.height)


def test_a_part_of_a_trajectory_is_measured_separately(flight: Trajectory) -> None:
    """Measures from the third to the tenth state, all in the air, equal those of a trajectory with only these
    states."""
    cut = replace(
        flight,
        **{name: getattr(flight, name)[3:11] for name in ("time", "positions", "velocities", "min_gap")},
    )
    part = measure(flight, first=3, last=10)
    alone = measure(cut)
    for name in part.__dataclass_fields__:
        assert getattr(part, name) == pytest.approx(getattr(alone, name), rel=1e-12, abs=1e-12), name
    assert part.airborne_frames == pytest.approx(60.0 * 7 * DT)


def test_measures_do_not_depend_on_the_up_axis(flight: Trajectory) -> None:
    """If the whole world is rotated, distance, height, heading, tilt and time in the air stay the same."""
    expected = measure(flight)
    for vector in ([0.5 * np.pi, 0.0, 0.0], [0.0, 0.5 * np.pi, 0.0], [0.4, -1.1, 0.7]):
        turn = Rotation.from_rotvec(vector).as_matrix()
        names = ("positions", "velocities", "rest_positions", "gravity")
        turned = replace(flight, **{name: getattr(flight, name) @ turn.T for name in names})
        found = measure(turned)
        for name in expected.__dataclass_fields__:
            assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-9, abs=1e-5), name


def test_tilt_is_the_angle_to_the_normal(flight: Trajectory) -> None:
    leaned = flight.positions.copy()
    leaned[-1] = leaned[-1] @ Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix().T
    assert measure(replace(flight, positions=leaned)).tilt_degrees == pytest.approx(np.degrees(0.3), rel=1e-9)


def test_a_saved_trajectory_is_read_back_bitwise(flight: Trajectory, tmp_path: Path) -> None:
    flight.save(tmp_path / "a.npz")
    flight.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    back = Trajectory.load(tmp_path / "a.npz")
    for name in flight.__dataclass_fields__:
        assert np.array_equal(getattr(back, name), getattr(flight, name)), name
