"""Mailbox of a session: no state is sent twice, and only old frames are dropped."""

from __future__ import annotations

import threading
import time
from unittest.mock import patch

import numpy as np

from egs_warp.web.mailbox import Mailbox
from egs_warp.web.messages import Pause, Release
from egs_warp.web.packets import Frame


def _frame(index: int) -> Frame:
    none = np.zeros(0)
    return Frame(index, index / 60.0, np.zeros((4, 3)), none, np.zeros((0, 9)), none)


def _watched() -> Mailbox:
    post = Mailbox()
    post.subscribe(lambda: None, lambda: _frame(0))
    post.take_news()
    return post


def test_nothing_is_sent_without_a_page_and_a_new_page_starts_with_the_state():
    post, woken = Mailbox(), []
    post.send_line("lost")
    post.send_state({"doing": "jump"})
    assert post.take_news() == [] and not post.watched
    post.subscribe(lambda: woken.append(True), lambda: _frame(7))
    (first,) = post.take_news()
    assert isinstance(first, Frame) and first.index == 7 and woken == [True] and post.watched
    post.unsubscribe()
    assert post.take_requests() == [Release()] and not post.watched
    post.send_line("lost")
    assert post.take_news() == [] and woken == [True]


def test_a_state_is_sent_when_it_or_its_receiver_is_new():
    post = _watched()
    for state in ({"doing": "jump"}, {"doing": "jump"}, {"doing": "stand"}):
        post.send_state(state)
    assert post.take_news() == [{"doing": "jump"}, {"doing": "stand"}]
    post.subscribe(lambda: None, lambda: _frame(1))
    post.send_state({"doing": "stand"})
    assert post.take_news()[1:] == [{"doing": "stand"}]


def test_only_the_oldest_pending_frames_are_dropped():
    post = _watched()
    with patch("egs_warp.web.mailbox._MAX_QUEUED_FRAMES", 4):
        post.send_line("first")
        for index in range(1, 6):
            post.send(_frame(index))
        post.send_line("last")
    left = [one.index if isinstance(one, Frame) else one["text"] for one in post.take_news()]
    assert left == ["first", 4, 5, "last"]


def test_busy_ends_after_an_error():
    post = _watched()
    try:
        with post.send_busy():
            raise ValueError
    except ValueError:
        pass
    assert post.take_news() == [{"type": "busy", "on": True}, {"type": "busy", "on": False}]


def test_a_suspended_session_wakes_on_a_request_and_ends_when_stopped():
    post, turns = _watched(), []
    post.send_state({"doing": "stand"})
    # A session that is not suspended, or has a pending request, does not block.
    assert post.wait_for_work(lambda: False, lambda: None)
    thread = threading.Thread(target=lambda: turns.append(post.wait_for_work(lambda: True, lambda: None)))
    thread.start()
    time.sleep(0.05)
    assert turns == []
    post.put_request(Pause(True))
    thread.join(timeout=20)
    assert turns == [True] and post.take_requests() == [Pause(True)]
    post.stop()
    assert not post.wait_for_work(lambda: True, lambda: None)


def test_the_loop_blocks_until_the_time_or_a_request():
    post = Mailbox()
    due = time.perf_counter() + 0.05
    post.wait_until(lambda: due - time.perf_counter())
    assert time.perf_counter() >= due
    post.put_request(Pause(False))
    post.wait_until(lambda: 3600.0)
