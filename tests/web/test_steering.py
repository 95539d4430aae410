"""Steering of a live creature: queue of motions, driving, navigation and styles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.motions.command import Drive
from egs_warp.motions.drive import LiveDrive
from egs_warp.motions.jump import Jump
from egs_warp.motions.script import motion
from egs_warp.motions.stance import sole_shares
from egs_warp.motions.style import PRESETS, Style
from egs_warp.pipelines.creature import initial_stance
from egs_warp.web.messages import STYLE_NAMES
from egs_warp.web.steering import ARRIVAL_DISTANCE, MAX_HEADING_ERROR, MotionScheduler, PointNavigation
from tests.support.creatures import coarse_creature
from tests.support.live_sessions import SteppedSession, coarse_pawn
from tests.support.meshes import stool


def test_a_new_request_replaces_the_queued_one(tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path)
    played.request("motion", text="jump 0 0.1, hop")
    played.step()
    assert (played.session.steering.doing, played.session.steering.queued) == ("jump", "hop")
    played.request("motion", text="twist 20 0 0.1")
    assert played.session.steering.queued == "twist"
    played.until(lambda: played.session.steering.doing == "twist")
    assert [entry.name for entry in played.session.steering.records] == ["jump", "twist"]
    played.request("motion", text="hop")
    assert played.session.steering.queued == "hop"
    played.request("cancel")
    played.step()
    assert (played.session.steering.doing, played.session.steering.queued) == ("twist", None)
    assert [entry.name for entry in played.session.steering.records] == ["jump", "twist"]


def test_a_drive_lasts_until_another_request(tmp_path: Path):
    """A drive command is queued after the current motion and lasts until another command or motion replaces it."""
    played = SteppedSession(coarse_pawn(), tmp_path)
    steering = played.session.steering
    played.request("drive", forward=0.1)
    assert steering.queued == "drive" and not steering.idle
    played.step(2)
    driven = steering._active.motion
    assert steering.doing == "drive" and steering.queued is None and isinstance(driven, LiveDrive)
    assert driven.command == Drive(0.1) and steering.drive_starts == [0.0] and steering.records == []
    played.request("drive", turn=0.1)
    played.step()
    assert driven.command == Drive(turn=0.1) and steering._active.motion is driven
    played.request("motion", text="jump 0 0.1")
    played.step()
    assert driven.command.is_zero and (steering.doing, steering.queued) == ("drive", "jump")


@pytest.mark.slow
def test_a_driven_body_stands_after_a_zero_command(tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path)
    played.request("drive", forward=0.1)
    played.step(60)
    played.request("drive")
    played.until_idle()
    assert played.session.steering.doing == "stand" and played.messages == []


def test_a_style_applies_to_later_motions(tmp_path: Path):
    """The active jump keeps its style; the new style applies to later jumps, also after the creature is rebuilt."""
    played = SteppedSession(coarse_pawn(), tmp_path)
    session = played.session
    played.request("motion", text="jump 0 0.1, jump 0 0.1")
    played.step()
    usual = session.steering._active.motion
    assert isinstance(usual, Jump)
    # The page sends only the factors, so a session keeps the overlap of its body.
    factors = {name: PRESETS["heavy"][name] for name in STYLE_NAMES}
    played.request("style", **factors)
    played.step()
    assert session.steering._active.motion is usual and session.state_message()["style"] == factors
    played.request("stand")
    played.request("set", friction=0.5)
    played.request("motion", text="jump 0 0.1, walk 0.1")
    played.step()
    heavy = session.steering._active.motion
    assert isinstance(heavy, Jump)
    assert heavy.plan.crouch_depth == pytest.approx(factors["anticipation"] * usual.plan.crouch_depth, rel=0.3)
    assert heavy.plan.crouch_time > factors["timing"] * usual.plan.crouch_time
    assert heavy.plan.landing_rate == pytest.approx(usual.plan.landing_rate / factors["squash"])
    assert [request.style for request in session.steering.requests] == [None, Style(**factors)]


def test_a_motion_that_the_body_cannot_do_is_reported(tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path)
    played.request("motion", text="walk to 9,9 0.01, jump")
    played.step()
    assert played.messages == ["walk: the path takes more than 400 steps; choose a shorter one"]
    assert played.session.steering.idle or played.session.steering.doing == "stand"
    assert played.session.steering.records == []


def test_navigation_turns_first_and_then_jumps_towards_its_goal():
    creature = coarse_pawn()
    place = initial_stance(creature)
    feet = sole_shares(place.body, place.ground, place.standing) @ place.standing
    ahead, left = place.ground.axes[:2]

    def leg(way: np.ndarray):
        return PointNavigation((feet + way)[:2], walks=False).next_part(place)

    aside = leg(1.0 * left)
    assert aside is not None and aside.request.name == "twist"
    assert aside.request.asked["heading_degrees"] == pytest.approx(90.0, abs=0.1)
    slant = np.radians(MAX_HEADING_ERROR - 1.0)
    straight = leg(np.cos(slant) * ahead + np.sin(slant) * left)
    assert straight is not None and straight.request.name == "jump"
    assert straight.request.asked["distance"] == pytest.approx(0.5, abs=1e-3)
    assert leg(0.9 * ARRIVAL_DISTANCE * left) is None
    # For a point this near, the body does not turn first.
    near = leg(0.2 * left)
    assert near is not None and near.request.name == "jump"


def test_navigation_without_progress_is_abandoned():
    place = initial_stance(coarse_pawn())
    journey = PointNavigation(np.array([3.0, 0.0]), walks=False)
    with pytest.raises(UserError, match="go: the body gets no nearer to it than"):
        for _ in range(10):
            journey.next_part(place)


def test_a_body_with_feet_walks_there():
    """The body walks straight to the point, ahead and sideways at once; a single walk has a limited length."""
    place = coarse_creature(
        stool(), forward=np.array([0.9, 0.3, 0.0]), sag=0.01, strength=20.0, settle_first=False
    ).place
    steering = MotionScheduler(place, print)
    assert steering.walks
    feet, height = sole_shares(place.body, place.ground, place.standing) @ place.standing, place.body.height
    way = height * (0.3 * place.ground.axes[0] - 0.4 * place.ground.axes[1])
    leg = PointNavigation((feet + way)[:2], walks=True).next_part(place)
    assert leg is not None and leg.request.name == "walk to"
    assert (leg.request.asked["ahead"], leg.request.asked["left"]) == (pytest.approx(0.3), pytest.approx(-0.4))
    leg = PointNavigation((feet + 4.0 * way)[:2], walks=True).next_part(place)
    assert leg is not None and leg.request.asked["ahead"] == pytest.approx(0.8 * 0.6)
    assert PointNavigation((feet + 0.2 * way)[:2], walks=True).next_part(place) is None
    steering.perform(motion("walk 0.1"))
    assert steering.queued == "walk"


@pytest.mark.slow
def test_a_click_sets_the_goal(tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path)
    body = played.session.creature.body
    place = played.session.steering.place
    feet = sole_shares(place.body, place.ground, place.standing)
    start = feet @ played.session.state.positions
    goal = start + 0.16 * place.ground.axes[0]
    played.request("go", x=goal[0], y=goal[1])
    played.until_idle(max_steps=900)
    end = feet @ played.session.state.positions
    assert np.linalg.norm((end - goal)[:2]) < ARRIVAL_DISTANCE * body.height
    assert played.session.steering.goal is None
    assert {entry.name for entry in played.session.steering.records} == {"walk to"}
