"""Dance on beats: take-offs and touch-downs, measured from the contact forces, are at the times of beats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from egs_warp.contact.terrain import Solid
from egs_warp.errors import ArgumentError, UserError
from egs_warp.fem.body import BodyState
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.beats import Span, even_beats, next_span, read_beats
from egs_warp.motions.dance import BEAT_TOLERANCE, MAX_HEIGHT, MIN_HEIGHT, MOVES, MOVES_WITHOUT_TWISTS, Dance
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget, height_of_flight, level_flight
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import Stance
from egs_warp.pipelines.report import verdict
from egs_warp.pipelines.simulated_run import simulate
from tests.support.live_sessions import coarse_pawn
from tests.support.runs import Run, coarse_block_run
from tests.support.stances import FLOOR, FORWARD


@pytest.fixture(scope="module")
def danced() -> Run:
    """Simulate a block that dances to five beats, of which the third comes too soon after the jump on the second."""
    return coarse_block_run("dance 100 0.5 5")


def flights(trajectory: Trajectory, least: float) -> list[tuple[float, float]]:
    """Return take-off and touch-down times, s, of all flights of at least ``least`` seconds: the ends of the last step
    with load before and of the first step with load after each flight."""
    load = np.bincount(
        trajectory.contact_step,
        np.einsum("ci,ci->c", trajectory.contact_force, trajectory.contact_normal),
        len(trajectory.dt),
    )
    weight = trajectory.node_mass.sum() * np.linalg.norm(trajectory.gravity)
    borne = np.flatnonzero(load > 1e-6 * weight) + 1
    left, met = trajectory.time[borne[:-1]], trajectory.time[borne[1:]]
    return [(a, b) for a, b in zip(left, met, strict=True) if b - a >= least]


def check_that_it_keeps_time(dance: Dance, trajectory: Trajectory) -> None:
    """Assert that every requested flight occurs, and begins and ends within ``BEAT_TOLERANCE`` of its target times."""
    reached = dance.outcome_record(trajectory, 0, -1)
    asked = np.array([event.asked for event in reached.events]).reshape(-1, 2)
    found = np.array(flights(trajectory, level_flight(0.5 * MIN_HEIGHT, 1.0, 9.81)))
    assert len(found) == len(asked) > 1
    # Times are rounded to complete steps, which are all that a motion receives, even if a step was divided into smaller
    # ones.
    step = trajectory.dt.max()
    found = step * np.column_stack([np.floor(found[:, 0] / step + 1e-6), np.ceil(found[:, 1] / step - 1e-6)])
    np.testing.assert_allclose([event.reached for event in reached.events], found.ravel(), atol=1e-9)
    assert np.abs(found - asked).max() <= BEAT_TOLERANCE
    assert reached.worst_error == pytest.approx(np.abs(found - asked).max())


def test_a_dance_keeps_time(danced: Run) -> None:
    dance = danced.sequence.done[0].motion
    assert isinstance(dance, Dance) and dance.is_at_rest
    check_that_it_keeps_time(dance, danced.trajectory)
    assert {round(event.asked, 9) for event in dance.outcome_record(danced.trajectory, 0, -1).events} == {
        0.5,
        1.1,
        2.3,
        2.9,
    }


def test_skipped_beats_are_reported(danced: Run) -> None:
    dance = danced.sequence.done[0].motion
    assert isinstance(dance, Dance)
    np.testing.assert_allclose(dance.outcome_record(danced.trajectory, 0, -1).skipped, [1.7])
    assert "1 of 5 beats skipped, too close to other beats or to the last one: 1.70 s" in dance.notes()
    assert any(note.startswith("4 take-offs and touch-downs, the worst ") for note in dance.notes())
    assert dance.outcome_record(danced.trajectory, 0, -1).after_end == () and "after the dance ended" not in str(
        dance.notes()
    )


def test_beats_after_the_end_of_the_dance_are_not_skipped_beats(place: Stance) -> None:
    """A run of one step ends before all beats; a beat that passed without a jump was skipped."""
    dance = Dance(place, (0.001, 0.5, 1.1, 1.7))
    state = BodyState(place.standing, np.zeros_like(place.standing), 0.0)
    dance.objectives(state, None, 0.01)
    trajectory: Any = SimpleNamespace()
    outcome = dance.outcome_record(trajectory, 0, -1)
    assert outcome.skipped == (0.001,) and outcome.after_end == (0.5, 1.1, 1.7)
    assert [note for note in dance.notes() if "beats" in note] == [
        "1 of 4 beats skipped, too close to other beats or to the last one: 0.00 s",
        "3 of 4 beats come after the dance ended (0.01 s after its start)",
    ]


def test_the_equations_hold_in_every_step(danced: Run) -> None:
    found = audit(danced.trajectory, newton_unconverged=sum(not report.converged for report in danced.reports))
    assert verdict(found).startswith("audit: passed")


@pytest.mark.slow
@pytest.mark.parametrize("beats", ["dance 90 1 14", "dance 120 0.6 14", "dance 50 1 5"])
def test_the_pawn_keeps_time_through_the_whole_dance(beats: str) -> None:
    """The dance consists of jumps, hops ahead and back, and twists; at 50 beats per minute, take-offs are half-way
    between beats."""
    done = simulate(coarse_pawn(), motion(beats))
    dance = done.sequence.done[0].motion
    assert isinstance(dance, Dance) and done.fallen is None
    check_that_it_keeps_time(dance, done.trajectory)


def test_flight_time_and_height_are_converted() -> None:
    """A flight takes T = sqrt(8 Z / g), where Z is the rise of the centre of mass above its height at take-off."""
    for height in (MIN_HEIGHT, 0.16, 0.3, MAX_HEIGHT):
        assert height_of_flight(level_flight(height, 1.0, 9.81), 1.0, 9.81) == pytest.approx(height)
    assert level_flight(0.5, 1.0, 9.81) == pytest.approx(np.sqrt(8.0 * 0.46 / 9.81))


def test_a_jump_predicts_its_take_off(place: Stance) -> None:
    """The take-off is at most two steps after the planned crouch and thrust, and the flight is that of a level jump.
    Both times depend on the height."""
    jump = Jump(place, JumpTarget(0.0, 0.4), skips_settling=True)
    assert jump.plan.flight_time == pytest.approx(level_flight(0.4, place.body.height, 9.81))
    lead = jump.plan.crouch_time + jump.plan.thrust_time
    assert lead <= jump.take_off_time(0.4) < lead + 2.0 * place.step
    assert jump.take_off_time(0.2) != jump.take_off_time(0.4)


def test_a_jump_without_a_supported_landing_stays_in_place(place: Stance) -> None:
    """On slippery ground, a jump back to the place of the dance is shortened to a place where the ground has ended."""
    place = replace(place, friction=0.05)
    dance = Dance(place, (2.0, 3.0))
    slid = replace(place.moved_to(place.standing - 0.6 * FORWARD), solids=(Solid((FLOOR, Plane(FORWARD, 0.3))),))
    jumps = [dance._jump(slid, landing, 0.12, turn=0.1) for landing in (MOVES[0], MOVES[3])]
    assert [jump.target for jump in jumps] == [JumpTarget(0.0, 0.12)] * 2 and jumps[1].target_heading > 0.0


@pytest.mark.parametrize("moves", [MOVES, MOVES_WITHOUT_TWISTS])
def test_a_dance_goes_to_all_sides_and_back(moves: Sequence[Any]) -> None:
    """Its moves are hops or twists to the left, to the right and ahead; a move back begins ahead of the start."""
    places = {(move.forward, move.left) for move in moves}
    assert {(0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (0.0, 0.0)} <= places
    (back,) = [k for k, move in enumerate(moves) if move.move == "hop back"]
    assert moves[back - 1].forward > moves[back].forward


def test_a_body_that_friction_does_not_allow_to_twist_only_hops(place: Stance) -> None:
    dances = [Dance(replace(place, friction=friction), (2.0, 3.0)) for friction in (0.8, 0.05)]
    assert [dance.plan_record().turn_degrees > 0.0 for dance in dances] == [True, False]
    assert [dance._moves for dance in dances] == [MOVES, MOVES_WITHOUT_TWISTS]


def span_of(beats: tuple[float, ...], after: float = 0.0, lead: float = 0.5) -> Span | None:
    return next_span(beats, after, earliest=lambda flight: after + lead, flights=(0.25, 0.7), easiest=0.45)


def test_a_jump_spans_two_beats() -> None:
    assert span_of((0.2, 0.6, 1.1, 1.6)) == Span(0.6, 1.1)
    assert span_of((0.2, 0.6, 1.1, 1.6), after=0.6) == Span(1.1, 1.6)
    assert span_of((0.2, 0.6, 1.1, 1.6), after=1.1) is None


def test_easier_jumps_are_preferred_to_hasty_ones() -> None:
    """With beats a sixth of a second apart, the dance uses every third one."""
    found = span_of(tuple(np.arange(1, 20) / 6.0))
    assert found is not None and found.flight == pytest.approx(0.5)


def test_a_distance_too_far_for_a_jump_is_divided() -> None:
    assert span_of((1.0, 2.0)) == Span(1.5, 2.0, 2)
    assert span_of((1.0, 3.0)) == Span(2.5, 3.0, 4)


def test_unreachable_beats_are_left_out() -> None:
    assert span_of((0.1, 0.4)) is None
    assert span_of((1.0,)) is None
    assert span_of((1.0, 60.0)) is None
    with pytest.raises(
        UserError, match=r"^dance: none of the 2 beats can be reached: the first take-off is possible after"
    ):
        coarse_block_run("dance 120 0 2")


def test_beats_are_read_from_the_first_column(tmp_path: Path) -> None:
    file = tmp_path / "beats.csv"
    file.write_text("time,label\n0.5,kick\n\n# bar\n1.25;snare\n2 hat\n")
    assert read_beats(file) == (0.5, 1.25, 2.0)
    assert even_beats(120.0, 0.25, 3) == (0.25, 0.75, 1.25)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "beats.csv: it has no beats; give one time in seconds per line"),
        ("time\n", "beats.csv: it has no beats; give one time in seconds per line"),
        ("1\nsoon\n", "beats.csv, line 2: 'soon': give the time of a beat in seconds, from 0 to 600"),
        ("-1\n", "line 1: '-1': give the time of a beat in seconds, from 0 to 600"),
        ("1\ninf\n", "line 2: 'inf': give the time of a beat in seconds, from 0 to 600"),
        ("1\n1\n", "line 2: '1': is not after the previous beat, 1; give beats in increasing order"),
        ("\n".join(str(k / 10) for k in range(1001)), "it has 1001 beats; give at most 1000"),
    ],
)
def test_a_bad_file_of_beats_is_a_one_line_error(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "beats.csv"
    file.write_text(text)
    with pytest.raises(UserError) as error:
        read_beats(file)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_beats_are_given_to_the_dances_of_a_script(tmp_path: Path) -> None:
    assert motion("dance", beats="120 0.5") == motion("dance 120 0.5")
    assert motion("dance 80, jump", beats="120").requests[0].asked["tempo"] == 80.0
    assert motion("dance", beats="b.csv") == motion("dance b.csv")
    file = tmp_path / "b.csv"
    file.write_text("1\n1.5\n")
    (part,) = motion(f"dance {file}").parts(1.0)
    assert part.asked == {"beats": 2.0, "duration": 1.5}
    assert motion(f"dance {file}").frames() == motion("dance 120 1 2").frames()


@pytest.mark.parametrize(
    ("text", "beats", "said"),
    [
        ("jump", "90", "beats: no motion of 'jump' takes beats; add a dance"),
        ("dance", " ", "beats: the value is empty; give a file of times in seconds or a tempo such as 90"),
        ("dance", "9999", "tempo 9999: give a number of beats a minute from 10 to 400"),
        ("dance", "90 nan", "first nan: give a number of seconds from 0 to 600"),
        ("dance b.csv 90", None, "tempo and the beats of b.csv are both given; give one of them"),
        ("dance 1 2 3 4", None, "'4' is one value too many; dance takes tempo, first, beats or a file of beats"),
    ],
)
def test_mistakes_are_one_line_errors(text: str, beats: str | None, said: str) -> None:
    with pytest.raises((UserError, ArgumentError)) as error:
        motion(text, beats=beats).frames()
    assert said in str(error.value) and "\n" not in str(error.value)
