"""What lies between a session and its page: nothing is told twice, nothing but old frames is lost."""

from __future__ import annotations

import threading
import time
from unittest.mock import patch

import numpy as np

from egs_warp.web.messages import Pause, Release
from egs_warp.web.packets import Frame
from egs_warp.web.post import Post


def _frame(index: int) -> Frame:
    none = np.zeros(0)
    return Frame(index, index / 60.0, np.zeros((4, 3)), none, np.zeros((0, 9)), none)


def _watched() -> Post:
    post = Post()
    post.watch(lambda: None, lambda: _frame(0))
    post.waiting()
    return post


def test_nobody_is_sent_anything_and_who_comes_begins_with_how_it_is():
    post, woken = Post(), []
    post.tell("lost")
    post.tell_state({"doing": "jump"})
    assert post.waiting() == [] and not post.watched
    post.watch(lambda: woken.append(True), lambda: _frame(7))
    (first,) = post.waiting()
    assert isinstance(first, Frame) and first.index == 7 and woken == [True] and post.watched
    post.unwatch()
    assert post.asked() == [Release()] and not post.watched
    post.tell("lost")
    assert post.waiting() == [] and woken == [True]


def test_a_state_is_told_when_it_is_new_or_who_watches_is():
    post = _watched()
    for state in ({"doing": "jump"}, {"doing": "jump"}, {"doing": "stand"}):
        post.tell_state(state)
    assert post.waiting() == [{"doing": "jump"}, {"doing": "stand"}]
    post.watch(lambda: None, lambda: _frame(1))
    post.tell_state({"doing": "stand"})
    assert post.waiting()[1:] == [{"doing": "stand"}]


def test_of_what_waits_the_oldest_frames_go_and_no_news():
    post = _watched()
    with patch("egs_warp.web.post._MOST_WAITING", 4):
        post.tell("first")
        for index in range(1, 6):
            post.send(_frame(index))
        post.tell("last")
    left = [one.index if isinstance(one, Frame) else one["text"] for one in post.waiting()]
    assert left == ["first", 4, 5, "last"]


def test_busy_ends_whatever_goes_wrong():
    post = _watched()
    try:
        with post.busy():
            raise ValueError
    except ValueError:
        pass
    assert post.waiting() == [{"type": "busy", "on": True}, {"type": "busy", "on": False}]


def test_a_session_that_is_held_wakes_when_asked_and_ends_when_stopped():
    post, turns = _watched(), []
    post.tell_state({"doing": "stand"})
    # Not held, nothing told or something asked: no waiting.
    assert post.await_turn(lambda: False, lambda: None)
    thread = threading.Thread(target=lambda: turns.append(post.await_turn(lambda: True, lambda: None)))
    thread.start()
    time.sleep(0.05)
    assert turns == []
    post.ask(Pause(True))
    thread.join(timeout=20)
    assert turns == [True] and post.asked() == [Pause(True)]
    post.stop()
    assert not post.await_turn(lambda: True, lambda: None)


def test_time_is_waited_for_unless_something_is_asked():
    post = Post()
    due = time.perf_counter() + 0.05
    post.await_time(lambda: due - time.perf_counter())
    assert time.perf_counter() >= due
    post.ask(Pause(False))
    post.await_time(lambda: 3600.0)
