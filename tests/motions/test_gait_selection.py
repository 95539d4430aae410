"""Selection of a gait: bodies whose standing feet cannot keep the balance of a swing, or that waddle slowly, move in
jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.motions.gait_selection import (
    MIN_PACE,
    MIN_STEP_RESERVE,
    jumping_reason,
    step_reserve,
    unstable_reason,
    walking_pace,
)
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import BodyMotion, Stance
from egs_warp.motions.skip import Skip, SkipTo
from egs_warp.motions.turn import Turn
from egs_warp.motions.walk import Walk
from egs_warp.motions.walk_plan import WalkControl
from egs_warp.motions.walk_posture import LEGGED_TIMING, MAX_PIVOT, ROCKING_TIMING
from tests.support.meshes import block_mesh, figure
from tests.support.stances import block_place

LEFT = np.array([0.0, 1.0, 0.0])
FIGURE = block_place(figure())
"""Figure whose feet, 0.2 m long, stand one ahead of the other: their middles are 0.2 m ahead of the centre of mass and
0.2 m behind it."""
ACROSS = FIGURE.with_forward(LEFT)
"""The same figure, whose feet stand side by side."""


def begun(text: str, place: Stance, *, retakes: int = 0) -> BodyMotion:
    script = motion(text)
    for _ in range(retakes):
        retake = script.retake(0)
        assert retake is not None
        script = retake[0]
    return script.parts(place.body.height)[0].begin(place)


def test_the_reserve_is_the_error_that_the_centre_of_pressure_corrects_in_a_swing() -> None:
    """x' = w (x - p): a displacement d of the centre of pressure, held during a swing of duration T, corrects
    d (1 - exp(-w T)). With the feet in line, the plan is at the inner edge of the foot, at 0.6 of its half length, and
    the limit at 0.8. With the feet side by side, the plan is in the middle of the foot."""
    com = FIGURE.body.centre_of_mass(FIGURE.standing)
    swing = LEGGED_TIMING.swing_time * FIGURE.body.time_unit
    corrected = 1.0 - np.exp(-np.sqrt(np.linalg.norm(FIGURE.body.gravity) / com[2]) * swing)
    control, half = WalkControl(), 0.1
    assert step_reserve(FIGURE) == pytest.approx((control.margin - control.planned_margin) * half * corrected)
    assert step_reserve(ACROSS) == pytest.approx(control.margin * half * corrected)
    assert step_reserve(FIGURE) < MIN_STEP_RESERVE * FIGURE.body.height < step_reserve(ACROSS)


def test_a_body_with_feet_in_line_moves_in_jumps() -> None:
    """The notes state the reason. The retake in short steps walks, and the retake in jumps has no such note."""
    reason = jumping_reason(FIGURE)
    assert reason is not None and "0.010 body heights" in reason and jumping_reason(ACROSS) is None
    for text, jumps in (("walk 0.5", Skip), ("walk to 0.4,0.3", SkipTo), ("turn 90", Turn)):
        moved = begun(text, FIGURE)
        assert isinstance(moved, jumps) and moved.notes()[0] == f"the body moves in jumps: {reason}"
        assert isinstance(begun(text, ACROSS), Walk) and isinstance(begun(text, FIGURE, retakes=1), Walk)
        retaken = begun(text, ACROSS, retakes=2)
        assert isinstance(retaken, jumps) and not any("in jumps" in note for note in retaken.notes())


def test_a_body_on_a_narrow_base_moves_in_jumps_but_turns_in_steps() -> None:
    """A block pivots alternately about its two sides, whose middles are ``width`` apart. Each pivot by an angle a moves
    its middle by a width / 2, within a swing and a double support."""
    narrow, wide = (block_place(block_mesh(size=(width, width, 1.0))) for width in (0.2, 0.4))
    period = ROCKING_TIMING.swing_time + ROCKING_TIMING.double_support_time
    for place, width in ((narrow, 0.2), (wide, 0.4)):
        assert walking_pace(place) == pytest.approx(0.5 * MAX_PIVOT * width / period)
    assert walking_pace(narrow) < MIN_PACE < walking_pace(wide)
    reason = jumping_reason(narrow)
    assert reason is not None and "waddle at only 0.030 sqrt(g H)" in reason
    assert unstable_reason(narrow) is None and jumping_reason(wide) is None
    assert jumping_reason(replace(wide, friction=0.05)) is None
    for text, jumps in (("walk 0.5", Skip), ("walk to 0.4,0.3", SkipTo)):
        moved = begun(text, narrow)
        assert isinstance(moved, jumps) and moved.notes()[0] == f"the body moves in jumps: {reason}"
        assert isinstance(begun(text, wide), Walk)
    assert isinstance(begun("turn 90", narrow), Walk)
