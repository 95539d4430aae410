"""Bodies to which a deep penetration in a world is attributed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from egs_warp.locomotion.world_audit import PairAudit, WorldAudit
from egs_warp.pipelines import animate_world
from egs_warp.pipelines.world_report import Penetration

NAMES = ("a", "b", "c")


def _found(
    monkeypatch: pytest.MonkeyPatch,
    pairs: Mapping[tuple[int, int], float],
    *,
    count: int = 3,
    depth_in_ground: float = 0.0,
) -> Mapping[str, Penetration]:
    """Return the penetrations of bodies that are 1 m tall, if only body ``a`` is too deep, by 3 cm at 0.1 s. ``pairs``
    are the penetrations of the audited pairs."""
    monkeypatch.setattr(
        animate_world,
        "ContactDetector",
        lambda geometry: SimpleNamespace(gaps=lambda positions: (np.array([-depth_in_ground]), np.array([0]))),
    )
    # The smallest gap of c is equal to that of a at the same time, but c touches another body.
    gaps = {"a": [0.0, -0.03], "b": [0.0, -0.005], "c": [0.0, -0.03]}
    bodies = {
        name: SimpleNamespace(
            trajectory=SimpleNamespace(
                height=1.0, min_gap=np.array(gaps[name]), time=np.array([0.0, 0.1]), positions=np.zeros((2, 1, 3))
            ),
            body=SimpleNamespace(geometry=None),
        )
        for name in NAMES[:count]
    }
    reports = {name: SimpleNamespace(audit=SimpleNamespace(penetration=0.03 * (name == "a"))) for name in bodies}
    zero: dict[str, Any] = {each.name: 0.0 for each in fields(PairAudit)}
    audits = tuple(PairAudit(**zero | {"bodies": pair, "penetration": depth}) for pair, depth in pairs.items())
    run: Any = SimpleNamespace(bodies=bodies)
    rows: Any = reports
    return animate_world._penetrations(run, rows, WorldAudit(0.0, 0.0, audits))


@pytest.mark.parametrize(
    ("pairs", "expected"),
    [
        ({(0, 1): 0.03, (0, 2): 0.01, (1, 2): 0.05}, ("a", "b")),
        ({(0, 0): 0.03, (0, 1): 0.01}, ("a",)),
        ({(0, 1): 0.0, (1, 2): 0.05}, ("a",)),
    ],
    ids=["deepest pair of the body", "itself", "no pair of the body is inside another"],
)
def test_the_other_body_is_that_of_the_deepest_pair(
    monkeypatch: pytest.MonkeyPatch, pairs: Mapping[tuple[int, int], float], expected: tuple[str, ...]
) -> None:
    assert _found(monkeypatch, pairs) == {"a": Penetration(expected, 0.1, 0.03)}


def test_a_penetration_of_the_ground_or_of_a_single_body_names_only_this_body(monkeypatch: pytest.MonkeyPatch) -> None:
    own = {"a": Penetration(("a",), 0.1, 0.03)}
    assert _found(monkeypatch, {(0, 1): 0.02}, depth_in_ground=0.03) == own
    assert _found(monkeypatch, {}, count=1) == own
