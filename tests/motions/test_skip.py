"""Skipping: a row of jumps, and the condition that starts the next one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.contact.terrain import Solid
from egs_warp.fem.body import BodyState
from egs_warp.geometry.plane import Plane
from egs_warp.motions.jump_plan import JumpPhase, JumpTarget
from egs_warp.motions.sequence import TargetError
from egs_warp.motions.skip import Skip, SkipTo
from egs_warp.motions.turn import Turn
from tests.support.stances import DT, FLOOR, FORWARD, block_place, moved


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


def test_a_jump_without_a_supported_landing_stays_in_place() -> None:
    """On slippery ground, a jump of 0.6 m is shortened to 0.4 m, where the ground has ended. The body jumps on the
    spot, and a message says so; if it is the first jump, the skip is refused."""
    place = replace(block_place(), friction=0.05)
    skip = Skip(place, 0.6, 0.12)
    edge = replace(place, solids=(Solid((FLOOR, Plane(FORWARD, -0.3))),))
    skip.jumps.append(skip._next(edge, place.standing, 2))
    assert skip.jumps[1].target == JumpTarget(0.0, 0.12)
    assert "planned 0.00 instead of 0.60 body heights ahead: the ground does not support the body" in skip.notes()[0]
    with pytest.raises(TargetError, match="the ground ends"):
        skip._next(edge, place.standing - 0.3 * FORWARD, 1)


def test_a_skip_to_a_point_first_turns_to_face_it() -> None:
    """The body turns to the left by atan(0.4 / 0.3) and skips from the place where it has turned. A body that faces the
    point skips at once."""
    place = block_place()
    skip = SkipTo(place, np.array([0.3, 0.4]), 0.1)
    (turn,) = skip.parts
    assert isinstance(turn, Turn) and turn._remaining_turn == pytest.approx(np.arctan2(0.4, 0.3))
    angle = turn._remaining_turn
    turn.jumps[-1].phase = JumpPhase.REST
    # The frame of this jump is not rotated, because the jump has not landed.
    turn._remaining_turn = turn.jumps[-1].target_heading + angle
    nodes = moved(place, angle, np.array([0.1, 0.0, 0.0]))
    skip.objectives(BodyState(nodes, 0 * nodes, 1.0), None, DT)
    row = skip.parts[-1]
    assert isinstance(row, Skip) and not skip.is_at_rest
    assert row.plan_record().jumps * row.plan_record().length == pytest.approx(np.hypot(0.2, 0.4))
    assert row.jumps[0].ground.axes[0] @ [0.2, 0.4, 0.0] == pytest.approx(np.hypot(0.2, 0.4))
    row.jumps[-1].phase = JumpPhase.REST
    row._count = 1
    assert skip.is_at_rest
    assert isinstance(SkipTo(place, np.array([0.5, 0.0]), 0.1).parts[0], Skip)
