"""Step of an island compared with a slow reference with dense matrices."""

from __future__ import annotations

import numpy as np

from egs_warp.contact.pair_contact import PairBody
from egs_warp.fem.body import BodyState
from tests.support.props import RunningWorld, box_body
from tests.support.reference_world import ReferenceWorld

DT = 1 / 120
TOLERANCE = 1e-6
"""Maximum difference of the positions, in heights of the prop. Both solvers stop at a small violation of Coulomb's law.
The reference stops at 1e-5 m/s, which moves a point by 3e-7 heights in a step. With friction that is 1 % too large, the
positions differ by 6e-5 heights.
"""


def test_a_landing_with_friction_equals_the_reference() -> None:
    bodies = [box_body((0.5, 0.5, 0.4), soft=True), box_body((0.3, 0.3, 0.3))]
    world = RunningWorld(bodies, [(0.0, 0.0, 0.0), (0.03, 0.02, 0.402)], [(0.0, 0.0, 0.0), (0.2, 0.1, -0.3)])
    contact = [
        PairBody(b.stepper.geometry, b.stepper.selector, b.level_set, b.rest_positions) for b in world.stepper.bodies
    ]
    states = [BodyState(state.positions, state.velocities) for state in world.states]
    reference = ReferenceWorld(world.bodies, contact, states, 0.5)
    for _ in range(20):
        world.advance(DT)
        reference.advance(DT)
        assert world.reports[0][-1].contacts.count > 20 and reference.residual < 1e-9
        for state, expected in zip(world.states, reference.states, strict=True):
            assert np.abs(state.positions - expected.positions).max() < TOLERANCE * 0.3
