"""Forces of the user: a push acts in one step, a pull acts until it is released, and both add up."""

from __future__ import annotations

import numpy as np

from egs_warp.pipelines.creature import initial_stance
from egs_warp.web.messages import Pull, PushOnce
from egs_warp.web.user_forces import UserForces
from tests.support.live_sessions import coarse_pawn

DT = 1.0 / 60.0


def test_a_push_and_a_pull_add_up_and_the_push_ends():
    creature = coarse_pawn()
    body, state, place = creature.body, creature.start, initial_stance(creature)
    node = int(np.argmax(body.mesh.nodes[:, 2]))
    target = (*state.positions[node, :2], float(state.positions[node, 2]) + 0.1)
    hand = UserForces()
    assert not hand.has_input and hand.kick(place, state, DT) is None
    hand.push(PushOnce((0.1, 0.0, 0.0)))
    assert hand.has_input and not hand.is_pulling
    pushed = hand.kick(place, state, DT)
    assert pushed is not None and not hand.has_input
    momentum = body.node_mass @ pushed / (body.mass * body.speed_unit)
    np.testing.assert_allclose(momentum, [0.1, 0.0, 0.0], atol=1e-9)
    hand.pull(body, Pull(node, target))
    pulled = hand.kick(place, state, DT)
    assert pulled is not None and hand.is_pulling
    hand.push(PushOnce((0.1, 0.0, 0.0)))
    both = hand.kick(place, state, DT)
    assert both is not None
    np.testing.assert_allclose(both, pushed + pulled, atol=1e-12)
    again = hand.kick(place, state, DT)
    assert again is not None
    np.testing.assert_array_equal(again, pulled)
    hand.release()
    assert hand.kick(place, state, DT) is None


def test_a_moving_pull_keeps_its_grip_and_dropping_clears_all():
    creature = coarse_pawn()
    body, place = creature.body, initial_stance(creature)
    hand = UserForces()
    hand.pull(body, Pull(3, (0.0, 0.0, 1.0)))
    grip = hand._spring
    hand.pull(body, Pull(3, (0.0, 0.1, 1.0)))
    assert hand._spring is grip
    hand.pull(body, Pull(4, (0.0, 0.1, 1.0)))
    assert hand._spring is not grip
    hand.push(PushOnce((0.1, 0.0, 0.0)))
    hand.clear()
    assert not hand.has_input and hand.kick(place, creature.start, DT) is None
    assert (hand.push_count, hand.dropped_count) == (0, 1)
