"""Skipping: a row of jumps, and the condition that starts the next one."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.motions.jump_plan import JumpPhase
from egs_warp.motions.skip import Skip
from tests.support.stances import DT, block_place


def test_jumps_are_short_and_turn_to_alternate_sides() -> None:
    place = block_place()
    skip = Skip(place, 0.9, 0.12)
    planned = skip.plan_record()
    assert (planned.jumps, planned.length) == (3.0, pytest.approx(0.3)) and planned.turn_degrees > 3.0
    headings = [skip.jumps[0].target_heading]
    forward = place.ground.axes[0]
    for number in (2, 3):
        jump = skip._next(place.moved_to(place.standing + (number - 1) * 0.3 * forward), place.standing, number)
        headings.append(jump.target_heading)
    assert np.allclose(np.degrees(headings), np.array([-1.0, 1.0, 0.0]) * planned.turn_degrees)
    assert Skip(place, 0.1, 0.12).plan_record().jumps == 2.0


def test_the_next_jump_starts_as_soon_as_the_body_is_balanced() -> None:
    """A landed body that stands still jumps again after a short contact; it ends at rest after the last jump."""
    place = block_place()
    skip = Skip(place, 0.5, 0.12)
    skip.jumps[0].phase = JumpPhase.LAND
    nodes, unit = place.standing + 0.25 * place.ground.axes[0], place.body.time_unit
    skip.objectives(BodyState(nodes, 0 * nodes, 0.2 * unit), None, DT)
    assert len(skip.jumps) == 1, "it has just landed"
    falling = np.zeros_like(nodes) + 3.0 * place.ground.axes[0]
    skip.objectives(BodyState(nodes, falling, 0.5 * unit), None, DT)
    assert len(skip.jumps) == 1, "it would fall forward"
    skip.objectives(BodyState(nodes, 0 * nodes, 0.6 * unit), None, DT)
    assert len(skip.jumps) == 2 and not skip.is_at_rest
    assert skip.jumps[1].target.distance == pytest.approx(0.25)
    assert skip.jumps[1].phase is JumpPhase.CROUCH
    skip.jumps[1].phase = JumpPhase.REST
    assert skip.is_at_rest
