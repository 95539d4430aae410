"""Synergies: groups of muscles with similar effects, which share an activation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.fem.body import BodyState, make_body
from egs_warp.fem.step_problem import StepProblem
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion import stepper as module
from egs_warp.locomotion.synergies import find_synergies
from egs_warp.muscles.muscle_set import automatic_muscles
from egs_warp.muscles.tension import MuscleEnergy
from tests.support.creatures import coarse_creature
from tests.support.meshes import block_mesh
from tests.support.stances import FORWARD


def test_similar_muscles_are_grouped_and_small_sets_are_not() -> None:
    floor = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    body = make_body(block_mesh(), floor, device="cpu")
    muscles = automatic_muscles(body.mesh, floor.normal, body_weight=body.weight, height=body.height)
    count = muscles.segment_count
    random = np.random.default_rng(1)
    kinds = random.standard_normal((3 * len(body.node_mass), 5))
    group = np.arange(count) % 5
    effects = kinds[:, group] * random.uniform(0.5, 2.0, count) + 1e-3 * random.standard_normal((len(kinds), count))
    found = find_synergies(muscles, effects, body.node_mass, max_count=5)
    assert found.count == 5
    assert all(len(np.unique(found.group_from_muscle[group == g])) == 1 for g in range(5))
    values = random.standard_normal(count)
    expected = [values[found.group_from_muscle == g].mean() for g in range(5)]
    assert np.allclose(found.mean(values), expected)
    assert np.array_equal(found.members @ np.arange(5.0), found.group_from_muscle)
    # The maximum number of groups is 0.32 times the number of nodes, limited to 80 to 120.
    for nodes, most in ((100, 80), (250, 80), (300, 96), (2000, 120)):
        many = replace(muscles, segments=np.tile(muscles.segments, (1 + 150 // count, 1)))
        made = random.standard_normal((3 * nodes, many.segment_count))
        assert find_synergies(many, made, np.ones(nodes)).count == most
    alone = find_synergies(muscles, effects, body.node_mass, max_count=count)
    assert alone.count == count and np.array_equal(alone.group_from_muscle, np.arange(count))


def test_muscles_are_grouped_by_their_effect_in_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """The effect of a muscle is its velocity change in a step of sqrt(H / g) / 19. The impulse of this change, by
    central differences of the equation of the step, is parallel to the impulse of the muscle."""
    given = []
    monkeypatch.setattr(module, "find_synergies", lambda *rest: given.append(rest) or find_synergies(*rest))
    stepper = coarse_creature(block_mesh(), forward=FORWARD, settle_first=False).stepper
    ((muscles, effects, _),) = given
    body = stepper.body
    rest = BodyState(body.mesh.nodes, np.zeros_like(body.mesh.nodes))
    problem, still = StepProblem(body, rest, body.time_unit / 19.0), rest.velocities
    alone = problem.residual(still, None)
    for k in range(0, muscles.segment_count, 7):
        along = effects[:, k].reshape(still.shape) * (1e-4 * body.speed_unit / np.abs(effects[:, k]).max())
        impulse = problem.residual(along, None) - problem.residual(-along, None)
        pull = np.eye(muscles.segment_count)[k] * muscles.bounds
        pulled = alone - problem.residual(still, MuscleEnergy.of(muscles, pull))
        cosine = (impulse * pulled).sum() / np.linalg.norm(impulse) / np.linalg.norm(pulled)
        assert cosine == pytest.approx(1.0, abs=1e-5)
