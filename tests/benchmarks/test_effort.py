"""Measures of the benchmark ``effort.py``: load per step, number of steps before lift-off, and reversals of the
load."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from tests.support.scripts import BENCHMARKS, module_of
from tests.support.slides import slide


@pytest.fixture
def effort(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return module_of("effort")


def test_reversals_are_the_smaller_of_two_opposite_changes(effort: ModuleType) -> None:
    loads = np.array([1.0, 1.2, 0.9, 0.8, 0.85, 0.85, 1.0])
    np.testing.assert_allclose(effort.reversals(loads), [0.2, 0.0, 0.05, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("loads", "steps"),
    [([1, 0, 1, 2, 0, 0, 0, 0, 3, 1], 4), ([1, 0, 0, 1], 4), ([0, 0, 0, 1], 0), ([2, 1, 0, 0, 0], 2), ([], 0)],
)
def test_lift_off_is_where_the_longest_flight_begins(effort: ModuleType, loads: list[int], steps: int) -> None:
    assert effort.before_lift_off(np.array(loads, float)) == steps


def test_load_is_the_ground_force(effort: ModuleType) -> None:
    """Load, gravity and drag together account for the change of upward momentum in every step."""
    trajectory = slide().trajectory()
    t, mass = trajectory, trajectory.node_mass
    up = -t.gravity / np.linalg.norm(t.gravity)
    moving = (t.positions[1:] - t.positions[:-1]) / t.dt[:, None, None]
    gained = (mass @ (moving - t.velocities[:-1]) @ up) / t.dt + t.drag * (mass @ moving @ up)
    weight = mass.sum() * np.linalg.norm(t.gravity)
    np.testing.assert_allclose(effort.load(t), gained / weight + 1.0, atol=1e-6)


def test_aims_need_every_body(effort: ModuleType) -> None:
    row = {"motion": "jump", "work": 1.0, "peak_deformation": 0.1, "reversed": 0.1, "largest_reversal": 0.2}
    rows = [{"body": body, "energy_residual": 1e-9, **row} for body in effort.BODIES]
    assert set(effort.summary(rows)["aims"].values()) == {True}
    assert effort.summary(rows[1:])["aims"]["work"] is None
    for name, value, aim in [
        ("work", 1.6, "work"),
        ("peak_deformation", 0.26, "internal_energy"),
        ("reversed", 0.16, "chatter"),
        ("largest_reversal", 0.31, "chatter"),
        ("energy_residual", 2e-6, "ledger_closes"),
    ]:
        worse = [*rows[:-1], {**rows[-1], name: value}]
        assert [key for key, met in effort.summary(worse)["aims"].items() if not met] == [aim]
