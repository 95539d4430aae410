"""Live session: its thread, and its reaction to messages."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.creature import changed_creature
from egs_warp.pipelines.report import AUDIT_LIMITS
from egs_warp.web.messages import Pause, PlayScript, Step, read_message
from egs_warp.web.packets import Frame
from egs_warp.web.session import Session
from tests.support.live_sessions import SteppedSession, coarse_pawn, session_of


def _wait(session: Session, woken: threading.Event, seen: list, done: Callable[[], bool]) -> None:
    """Collect messages until ``done`` returns True."""
    end = time.monotonic() + 60.0
    while not done():
        assert time.monotonic() < end, [one for one in seen if not isinstance(one, Frame)]
        woken.wait(0.2)
        woken.clear()
        seen += session.take_news()


@pytest.mark.slow
def test_it_lives_in_its_thread_while_it_is_watched(tmp_path: Path):
    session = session_of(coarse_pawn(), tmp_path)
    woken, seen = threading.Event(), []
    session.start()
    time.sleep(0.1)
    assert session.take_news() == [] and session.state.time == 0.0
    try:
        session.subscribe(woken.set)
        _wait(session, woken, seen, lambda: any(isinstance(one, dict) for one in seen))
        assert isinstance(seen[0], Frame)
        message = read_message({"type": "motion", "text": "jump 0 0.1"}, height=1.0, node_count=1)
        assert isinstance(message, PlayScript)
        session.put_request(message)
        _wait(session, woken, seen, lambda: any(isinstance(one, dict) and one.get("doing") == "jump" for one in seen))
        # Without a page, the session is suspended; later it continues from the same state.
        session.unsubscribe()
        held = _still_seconds(session)
        session.subscribe(woken.set)
        seen = session.take_news()
        assert isinstance(seen[0], Frame) and seen[0].time == held
        rested = lambda: any(isinstance(one, dict) and one.get("resting") for one in seen)  # noqa: E731
        _wait(session, woken, seen, rested)
        assert [entry.name for entry in session.steering.records] == ["jump"]
        end = session.state.time
        assert end > held, "it went on to the end with nobody watching"
        time.sleep(0.2)
        assert session.state.time == end, "a body at rest is stepped"
    finally:
        session.stop()
    assert not [one for one in threading.enumerate() if one.name == "session"]
    times = [one.time for one in seen if isinstance(one, Frame)]
    assert np.diff(times).min() >= 0.0 and max(np.diff(times)) == pytest.approx(1.0 / 60.0)


def _still_seconds(session: Session) -> float:
    """Return the time, s, for which the state of the session stays the same after the current step, which may take time
    on a busy core."""
    for _ in range(30):
        before = session.state.time
        time.sleep(1.0)
        if session.state.time == before:
            return before
    raise AssertionError("it goes on with nobody watching")


def test_a_pause_suspends_it_and_a_step_is_one_step(tmp_path: Path):
    session = session_of(coarse_pawn(), tmp_path)
    woken, seen = threading.Event(), []
    session.put_request(Pause(True))
    session.start()
    try:
        session.subscribe(woken.set)
        _wait(session, woken, seen, lambda: any(isinstance(one, dict) and one.get("paused") for one in seen))
        assert session.state.time == 0.0
        for count in (1, 2, 3):
            session.put_request(Step())
            _wait(session, woken, seen, lambda: session.state.time > (count - 0.5) / 60.0)  # noqa: B023
        time.sleep(0.2)
        assert session.state.time == pytest.approx(3.0 / 60.0)
    finally:
        session.stop()


def test_it_is_no_faster_than_the_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    session = session_of(coarse_pawn(), tmp_path)
    made = SteppedSession(coarse_pawn(), tmp_path)
    made.step()
    result = (made.session.state, made.session._memory, [made.session.report])
    monkeypatch.setattr(type(session.creature.stepper), "advance", lambda *_: result)
    monkeypatch.setattr(Session, "resting", property(lambda _: False))
    woken, seen = threading.Event(), []
    session.start()
    try:
        began = time.monotonic()
        session.subscribe(woken.set)
        _wait(session, woken, seen, lambda: len([one for one in seen if isinstance(one, Frame)]) > 32)
        # The session may catch up on at most two late steps.
        assert time.monotonic() - began > 27 / 60.0
    finally:
        session.stop()


def test_frames_contain_the_solver_reports(tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path)
    played.step(3)
    frame, session = played.frames[-1], played.session
    report = session.report
    assert report is not None
    np.testing.assert_array_equal(frame.positions, session.state.positions)
    force = frame.contacts[:, 6:].sum(axis=0)
    assert force[2] == pytest.approx(session.creature.body.weight, rel=0.05)
    assert np.abs(frame.activations).max() <= 1.0 + 1e-9
    assert (frame.contacts[:, 5] == pytest.approx(1.0)) and np.abs(frame.contacts[:, 2]).max() < 0.02
    height, pressed, used, gap = frame.curves
    assert height == pytest.approx(0.37, abs=0.02) and pressed == pytest.approx(1.0, rel=0.05)
    assert 0.0 <= used <= 1.0 + 1e-6 and abs(gap) < 0.01


def test_friction_and_stiffness_change_under_it(tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path)
    played.step(2)
    before = played.session.state
    young = played.session.creature.body.young_modulus
    played.request("set", friction=0.3)
    assert played.session.creature.geometry.friction == 0.3
    assert played.session.creature.body.young_modulus == young
    played.request("set", sag=0.025)
    assert played.session.creature.body.young_modulus == pytest.approx(2.0 * young)
    assert played.session.state is before
    assert [news for news in played.news if news["type"] == "busy"] == 2 * [
        {"type": "busy", "on": True},
        {"type": "busy", "on": False},
    ]
    played.request("motion", text="jump 0 0.1")
    for _ in range(12):
        played.step()
        assert played.session.report is not None and played.session.report.converged
    assert played.session.steering.doing == "jump"
    assert played.session.state_message()["friction"] == 0.3 and played.session.state_message()["sag"] == 0.025
    # Repeating a request changes nothing.
    made = played.session.creature
    played.request("set", sag=0.025)
    assert played.session.creature is made


def test_a_changed_creature_equals_a_new_one():
    made = coarse_pawn()
    same = changed_creature(made, friction=made.geometry.friction, sag=0.05, muscles_file=None)
    np.testing.assert_allclose(same.start.positions, made.start.positions, atol=1e-12)
    assert same.body.young_modulus == made.body.young_modulus


def test_a_solver_that_fails_does_not_end_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    played = SteppedSession(coarse_pawn(), tmp_path)
    played.step(2)

    def fail(*_: object) -> None:
        raise FloatingPointError("no definite matrix")

    with monkeypatch.context() as broken:
        broken.setattr(type(played.session.creature.stepper), "advance", fail)
        played.step()
    assert played.messages == ["the solver failed; the creature is back at its start"]
    assert capsys.readouterr().err == "egs-warp: live: FloatingPointError: no definite matrix\n"
    np.testing.assert_array_equal(played.session.state.positions, played.session.creature.start.positions)
    played.step(2)
    assert len(played.messages) == 1


def test_a_page_that_does_not_read_loses_the_oldest_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("egs_warp.web.mailbox._MAX_QUEUED_FRAMES", 5)
    session = session_of(coarse_pawn(), tmp_path)
    session.subscribe(lambda: None)
    for _ in range(8):
        session.advance()
    times = [round(60.0 * one.time) for one in session.take_news() if isinstance(one, Frame)]
    assert times == [4, 5, 6, 7, 8]


@pytest.mark.slow
def test_a_push_acts_in_the_next_step_and_the_take_passes_the_audit(tmp_path: Path):
    """A push moves the centre of mass, and rotates the body if it hits the head; a body at rest does not fall."""
    played = SteppedSession(coarse_pawn(), tmp_path)
    session, body = played.session, played.session.creature.body
    played.until(lambda: session.resting)
    played.request("push", x=0.05, y=-0.1, z=0.0)
    assert not session.resting
    played.request("record", on=True)
    played.step()
    gained = body.centre_of_mass(session.state.velocities) / body.speed_unit
    # Friction has already reduced the momentum in one step, but the take records the whole push.
    assert 0.2 < gained[0] / 0.05 <= 1.0 and 0.2 < gained[1] / -0.1 <= 1.0
    played.step(4)
    spin = body.angular_momentum(session.state.positions, session.state.velocities)
    played.request("push", x=0.0, y=0.1, z=0.0, height=0.9)
    played.request("push", x=0.0, y=0.05, z=0.0, height=0.9)
    played.step()
    turned = body.angular_momentum(session.state.positions, session.state.velocities) - spin
    assert turned[0] < -0.02 * body.mass * body.speed_unit * body.height
    played.until(lambda: session.steering.idle and session.state.time > 1.0)
    assert session.steering.doing == "stand"
    played.request("record", on=False)
    path = tmp_path / "take-1"
    t, report = Trajectory.load(path / "trajectory.npz"), json.loads((path / "report.json").read_text())
    given = np.einsum("n,kni->ki", t.node_mass, t.kick_velocity) / (body.mass * body.speed_unit)
    assert t.kick_step.tolist() == [0, 5]
    np.testing.assert_allclose(given, [[0.05, -0.1, 0.0], [0.0, 0.15, 0.0]], atol=1e-9)
    assert {name for name, limit in AUDIT_LIMITS.items() if not report["audit"][name] <= limit} == set()
    assert report["notes"] == ["the user pulled or pushed the body; script.json does not repeat this"]


def test_a_pending_push_is_dropped_when_the_creature_is_reset(tmp_path: Path):
    played = SteppedSession(coarse_pawn(), tmp_path)
    played.request("push", x=0.3, y=0.0, z=0.0)
    played.request("stand")
    played.step()
    body = played.session.creature.body
    assert np.linalg.norm(body.centre_of_mass(played.session.state.velocities)) < 0.01 * body.speed_unit
