"""Muscles that act alike act together."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import make_body
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.synergies import find_synergies
from egs_warp.muscles.muscle_set import automatic_muscles
from tests.support.meshes import block_mesh


def test_alike_are_grouped_and_few_are_left_alone() -> None:
    floor = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    body = make_body(block_mesh(), floor, device="cpu")
    muscles = automatic_muscles(body.mesh, floor.normal, body_weight=body.weight, height=body.height)
    count = muscles.segment_count
    random = np.random.default_rng(1)
    kinds = random.standard_normal((3 * len(body.node_mass), 5))
    group = np.arange(count) % 5
    effects = kinds[:, group] * random.uniform(0.5, 2.0, count) + 1e-3 * random.standard_normal((len(kinds), count))
    found = find_synergies(muscles, effects, body.node_mass, most=5)
    assert found.count == 5
    assert all(len(np.unique(found.group_from_muscle[group == g])) == 1 for g in range(5))
    values = random.standard_normal(count)
    expected = [values[found.group_from_muscle == g].mean() for g in range(5)]
    assert np.allclose(found.mean(values), expected)
    assert np.array_equal(found.members @ np.arange(5.0), found.group_from_muscle)
    alone = find_synergies(muscles, effects, body.node_mass, most=count)
    assert alone.count == count and np.array_equal(alone.group_from_muscle, np.arange(count))
