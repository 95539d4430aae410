"""Validation of trajectory files: a file is read only if its arrays are consistent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.locomotion.trajectory_validation import check_trajectory
from tests.support.flights import rigid_flight
from tests.support.slides import slide


@pytest.mark.parametrize("made", [rigid_flight, lambda: slide(struck=True).trajectory()], ids=["flight", "slide"])
def test_simulated_trajectories_are_consistent(made: Any) -> None:
    check_trajectory(made())


def _spoilt(name: str, value: float, row: int = -1) -> Any:
    def change(t: Trajectory) -> Trajectory:
        array = np.array(getattr(t, name))
        array.reshape(-1)[row] = value
        return replace(t, **{name: array})

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_spoilt("tets", 10_000), "tets has an index out of range"),
        (_spoilt("contact_step", -1), "contact_step has an index out of range"),
        (_spoilt("muscle_segments", 10_000), "muscle_segments has an index out of range"),
        (lambda t: _spoilt("muscle_segments", len(t.muscle_end_starts) - 1)(t), "muscle_segments has an index"),
        (_spoilt("muscle_end_starts", 1, 0), "muscle_end_starts has an index out of range"),
        (_spoilt("positions", np.nan), "positions has values that are too large or not finite"),
        (_spoilt("velocities", 1e300), "velocities has values that are too large or not finite"),
        (_spoilt("node_mass", 0.0), "node_mass is not positive"),
        (_spoilt("time", 0.0), "time does not increase"),
        (_spoilt("time", 1e9), "spans more than a day"),
        (_spoilt("body_axes", 2.0), "body_axes are not orthonormal"),
        (_spoilt("front", 0.5), "front is not a unit vector along the ground"),
        (lambda t: replace(t, height=np.inf), "height has values that are too large or not finite"),
        (lambda t: replace(t, gravity=np.zeros(3)), "gravity is zero"),
        (lambda t: replace(t, rest_positions=0.0 * t.rest_positions), "tets have no positive volume"),
        (lambda t: replace(t, dt=t.dt[:-1]), "activations has shape"),
        (lambda t: replace(t, positions=t.positions[:, :-1]), "velocities has shape"),
        (lambda t: replace(t, planes=t.planes[:, :3]), "planes has shape"),
        (lambda t: replace(t, kick_velocity=t.kick_velocity[:, :, :2]), "kick_velocity has shape"),
        (lambda t: replace(t, kick_velocity=np.zeros((0, 0, 3))), "kick_velocity has shape"),
        (lambda t: replace(t, kick_step=t.kick_step[:0]), "kick_velocity has shape"),
        (lambda t: replace(t, planned_com=np.zeros((2, 3))), "its arrays have inconsistent shapes"),
    ],
)
def test_inconsistent_trajectories_are_reported(change: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        check_trajectory(change(slide(struck=True).trajectory()))
