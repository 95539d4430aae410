"""Styles: each factor changes a jump of a coarse block as documented, and a factor of 1 changes nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import ArgumentError, UserError
from egs_warp.locomotion.audit import audit
from egs_warp.motions.dance import Dance
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpPlan, JumpTarget, plan_jump
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence, Stance
from egs_warp.motions.style import PRESETS, Style, read_style
from egs_warp.pipelines.report import verdict
from tests.support.creatures import coarse_creature
from tests.support.meshes import box_mesh
from tests.support.runs import roll_out
from tests.support.stances import FORWARD


@dataclass(frozen=True)
class Jumped:
    """Heights of the centre of mass (m) and times (s) of a simulated jump."""

    depth: float
    """Depth of the crouch, m."""
    lowest: float
    """Time of the lowest point of the crouch, s."""
    take_off: float
    apex: float
    """Maximum rise above the standing height, m."""
    dip: float
    """Maximum descent below the standing height after touch-down, m."""
    rebound: float
    """Maximum rise above the standing height after this descent, m."""
    heights: tuple[float, ...]


@cache
def jumped(style: str | None) -> Jumped:
    """Simulate a jump of a block on the spot, by 0.2 body heights, in this ``style``, and assert the audit."""
    made = coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.0)), forward=FORWARD)
    place = made.place if style is None else replace(made.place, style=read_style(style))
    sequence = MotionSequence(place, motion("jump 0 0.2").parts(place.body.height))
    t = roll_out(*(made.stepper, made.start, sequence), frames=180, finished=lambda: sequence.is_finished).trajectory
    assert sequence.is_finished and verdict(audit(t)).startswith("audit: passed")
    height = np.array([place.body.centre_of_mass(x)[2] for x in t.positions])
    rise = height - height[0]
    borne = np.unique(t.contact_step[t.contact_force[:, 2] > 1e-3]) + 1
    flight = int(np.argmax(np.diff(borne)))
    left, met = borne[flight], borne[flight + 1]
    lowest = int(rise[:left].argmin())
    times = float(t.time[lowest]), float(t.time[left])
    dip = met + int(rise[met:].argmin())
    return Jumped(-rise[lowest], *times, rise.max(), -rise[dip], rise[dip:].max(), tuple(height.tolist()))


@pytest.mark.slow
def test_the_usual_style_changes_no_bit() -> None:
    assert jumped(None).heights == jumped("anticipation=1 squash=1 bounce=1 timing=1 overlap=0").heights


@pytest.mark.slow
@pytest.mark.parametrize("name", ["anticipation", "timing"])
def test_anticipation_and_timing_lengthen_a_crouch(name: str) -> None:
    """The duration of the crouch is scaled by the factor, to the precision of a step, and the take-off is earlier or
    later accordingly."""
    short, usual, long = jumped(f"{name}=0.7"), jumped(None), jumped(f"{name}=1.4")
    crouches = np.array([short.lowest, usual.lowest, long.lowest]) - 0.1  # the body settles before the crouch
    np.testing.assert_allclose(crouches / crouches[1], [0.7, 1.0, 1.4], atol=0.06)
    assert short.take_off < usual.take_off < long.take_off
    np.testing.assert_allclose([short.apex, long.apex], usual.apex, atol=0.01)


@pytest.mark.slow
def test_anticipation_deepens_a_crouch() -> None:
    short, usual, deep = jumped("anticipation=0.7"), jumped(None), jumped("anticipation=1.4")
    assert short.depth < 0.85 * usual.depth and deep.depth > 1.2 * usual.depth


@pytest.mark.slow
def test_timing_makes_a_thrust_soft() -> None:
    """The mean acceleration is divided by the factor, so the duration of a thrust to the same upward speed is
    multiplied by it."""
    usual, *others = (planned(Style(timing=timing)) for timing in (1.0, 0.7, 1.4))
    np.testing.assert_allclose([other.thrust_time / usual.thrust_time for other in others], [0.7, 1.4], rtol=1e-6)
    assert others[0].speed_up == others[1].speed_up == usual.speed_up
    assert jumped("timing=1.4").take_off - jumped("timing=1.4").lowest > jumped(None).take_off - jumped(None).lowest


@pytest.mark.slow
def test_a_bouncing_landing_rises_above_the_standing_height() -> None:
    usual, bouncing = jumped("squash=1.5"), jumped("squash=1.5 bounce=1.6")
    assert usual.rebound < 0.002 and bouncing.rebound > 0.005
    assert bouncing.apex == usual.apex


@pytest.mark.slow
def test_squash_lets_a_landing_give_way() -> None:
    hard, usual, soft = jumped("squash=0.5"), jumped(None), jumped("squash=2")
    assert hard.dip < usual.dip < soft.dip and soft.dip > 1.2 * usual.dip
    assert hard.take_off == usual.take_off == soft.take_off


@pytest.mark.slow
def test_the_presets_differ_visibly() -> None:
    """A heavy jump crouches deeper and longer than a light one; only a rubbery one rebounds."""
    light, heavy, rubbery = (jumped(name) for name in ("light", "heavy", "rubbery"))
    assert heavy.depth > 4.0 * light.depth and heavy.take_off > 3.0 * light.take_off
    assert heavy.dip > 2.5 * light.dip and rubbery.dip > 1.3 * heavy.dip
    assert rubbery.rebound > 0.03 and max(light.rebound, heavy.rebound) < 0.003
    np.testing.assert_allclose([light.apex, heavy.apex, rubbery.apex], 0.197, atol=0.005)


def planned(style: Style) -> JumpPlan:
    """Plan a jump with very short steps, at a height for which the depth of the crouch is within its limits."""
    return plan_jump(
        JumpTarget(0.0, 0.3),
        height=1.0,
        com_height=0.5,
        support_ahead=0.2,
        gravity=9.81,
        step=1e-9,
        lean=0.0,
        style=style,
    )


def test_a_dance_uses_the_crouch_time_of_its_style(place: Stance) -> None:
    usual, quick = (Dance(replace(place, style=style), (1.0, 1.5)) for style in (Style(), Style(timing=0.5)))
    assert quick.expected_time == usual.expected_time
    with pytest.raises(UserError, match="the first take-off is possible after"):
        Dance(place, (0.35, 0.8))
    assert Dance(replace(place, style=Style(timing=0.5)), (0.35, 0.8)).plan_record().beats == 2.0


def test_a_jump_of_a_script_may_have_its_own_style(place: Stance, tmp_path: Path) -> None:
    """The style of a jump takes precedence over the style of the run, which applies to the other jumps."""
    (tmp_path / "s.json").write_text(
        '[{"motion": "jump", "repeat": 2, "style": "squash=2"}, {"motion": "jump"},'
        ' {"motion": "jump", "style": "light"}]'
    )
    light, run = Style(**PRESETS["light"]), replace(place, style=Style(squash=0.5))
    begun = [part.begin(run) for part in motion(str(tmp_path / "s.json")).parts(place.body.height)]
    rates = [one.plan.landing_rate for one in begun if isinstance(one, Jump)]
    usual = motion("jump").parts(place.body.height)[0].begin(place)
    assert isinstance(usual, Jump) and len(rates) == 4
    expected = [1 / 2.0, 1 / 2.0, 1 / 0.5, 1 / light.squash]
    np.testing.assert_allclose(np.array(rates) / usual.plan.landing_rate, expected)


def test_presets_can_be_changed() -> None:
    assert read_style("heavy, squash=1.1") == Style(**{**PRESETS["heavy"], "squash": 1.1})
    for name, values in PRESETS.items():
        assert read_style(name) == Style(**values)
        assert str(Style(**values)) == name
    assert "overlap" not in str(Style(squash=1.3))
    mine = Style(anticipation=0.1 + 0.7, timing=1 / 1.5)
    assert read_style(str(mine)) == mine and read_style(str(Style())) == Style()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "style: the text is empty; give one of light, heavy, rubbery, or numbers such as anticipation=1.3 for"),
        ("floppy", "style: unknown word 'floppy'; give one of light, heavy, rubbery, or numbers"),
        ("squash=1 heavy", "style: unknown word 'heavy'; give one of"),
        ("wobble=2", "style: unknown word 'wobble=2'; give one of"),
        ("squash=3", "style: squash 3: give a number of times the usual from 0.5 to 2"),
        ("timing=fast", "style: timing fast: give a number of times the usual from 0.5 to 2"),
        ("timing=nan", "style: timing nan: give a number of times the usual from 0.5 to 2"),
        ("overlap=0.6", "style: overlap 0.6: give a number of lengths of the part from 0 to 0.5"),
    ],
)
def test_a_bad_style_is_a_one_line_error(text: str, said: str) -> None:
    with pytest.raises(UserError) as error:
        motion("jump").style(text)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_a_style_without_a_jump_is_refused() -> None:
    with pytest.raises(ArgumentError, match=r"^style: no motion of 'walk' jumps; these have a style: jump, .*backflip"):
        motion("walk").style("heavy")
    assert motion("walk").style(None) == Style()
    with pytest.raises(ArgumentError, match=r"^squash 9: give a number from 0.5 to 2$"):
        Style(squash=9)
