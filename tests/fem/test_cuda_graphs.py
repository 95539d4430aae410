"""What is recorded does again what it did, with what lies in its memory then."""

from __future__ import annotations

import gc
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
import warp as wp

from egs_warp.fem import cuda_graphs
from egs_warp.fem.cuda_graphs import GraphCache, GraphStream, PinnedUpload


def test_recorded_work_reads_what_is_told_each_time(device: str) -> None:
    stream = GraphStream(torch.device(device))
    told, here = PinnedUpload(stream, 4), stream.pinned(4)
    runs = []

    def work() -> None:
        runs.append(len(runs))
        here.copy_((told.device @ told.device) * told.device, non_blocking=True)

    again = stream.run_captured(work)
    for number in range(5):
        with stream:
            told.set(np.array([1.0, number]), np.array([2.0]))
            again()
            stream.wait()
        expected = np.array([1.0, number, 2.0, 0.0]) * (5.0 + number**2)
        np.testing.assert_array_equal(here.numpy(), expected)
    # A GPU has it run once, and once to record it.
    assert len(runs) == (5 if device == "cpu" else 2)


@pytest.mark.parametrize("loops", [True, False])
def test_repeated_work_goes_on_while_it_says_so(device: str, monkeypatch: pytest.MonkeyPatch, loops: bool) -> None:
    """From what is told each time, not at all where it says so before; with a driver that knows loops, and with one
    that does not."""
    if not loops:
        monkeypatch.setattr(wp, "is_conditional_graph_supported", lambda: False)
    stream = GraphStream(torch.device(device))
    told, here = PinnedUpload(stream, 2), stream.pinned(2)
    going, sums = torch.zeros(1, dtype=torch.int32, device=device), torch.zeros(2, dtype=torch.float64, device=device)
    works, runs = GraphCache(stream), []

    def work() -> None:
        runs.append(len(runs))
        # With what is made on the way.
        sums.add_(torch.stack([torch.ones_like(told.device[0]), told.device[0]]))
        going.copy_(sums[:1] < told.device[1])

    for number, steps in enumerate([0, 3, 1, 5, 0, 2]):
        with stream:
            told.set(np.array([number + 0.5, steps]))
            sums.zero_()
            going.fill_(steps > 0)
            works.repeat("steps", work, going)
            here.copy_(sums, non_blocking=True)
            stream.wait()
        np.testing.assert_array_equal(here.numpy(), [steps, steps * (number + 0.5)])
    # A GPU has it run three times the first time that there is anything to do, and once to record it.
    assert len(runs) == (11 if device == "cpu" else 4)


def test_the_last_works_are_kept_by_their_keys(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """More of them than are kept, again and again; what is forgotten is run anew, with what it is then."""
    monkeypatch.setattr(cuda_graphs, "_MOST", 3)
    stream = GraphStream(torch.device(device))
    told, here = PinnedUpload(stream, 1), stream.pinned(1)
    works = GraphCache(stream)

    def run(factor: float, value: float) -> float:
        def work() -> None:
            here.copy_(factor * told.device, non_blocking=True)

        with stream:
            told.set(np.array([value]))
            works.run(factor, work)
            stream.wait()
        return float(here[0])

    for turn in range(4):
        for factor in (1.0, 2.0, 3.0, 4.0, 4.0, 4.0):
            assert run(factor, turn + 0.5) == factor * (turn + 0.5)
    assert list(works._kept) == [2.0, 3.0, 4.0]
    works.forget()
    assert run(2.0, 1.0) == 2.0 and len(works._kept) == 1


def test_nobody_looks_for_garbage_while_work_is_recorded(device: str) -> None:
    """What is found would be given back to the device, which waits for what goes on there."""
    stream, looks = GraphStream(torch.device(device)), []
    again = stream.run_captured(lambda: looks.append(gc.isenabled()))
    for _ in range(3):
        with stream:
            again()
    assert gc.isenabled() and looks == ([True] * 3 if device == "cpu" else [True, False])


def test_a_stream_that_is_entered_again_is_left_with_the_first(device: str) -> None:
    """By another who works there too, and in a thread of its own; gradients are kept track of before and after."""
    one, other = GraphStream(torch.device(device)), GraphStream(torch.device(device))
    outside = torch.cuda.current_stream() if device != "cpu" else None
    with one:
        within = torch.cuda.current_stream() if device != "cpu" else None
        with pytest.raises(ValueError, match="within"), other, one:
            assert not torch.is_grad_enabled()
            raise ValueError("within")
        with ThreadPoolExecutor(1) as threads:
            assert threads.submit(torch.is_grad_enabled).result()
        assert not torch.is_grad_enabled()
        assert device == "cpu" or torch.cuda.current_stream() == within
    assert torch.is_grad_enabled()
    assert device == "cpu" or torch.cuda.current_stream() == outside


def test_works_at_once_are_over_before_what_comes_next(device: str) -> None:
    """And begin after what came before, run as they are and recorded: sums of long rows that the one before has
    filled."""
    stream, count = GraphStream(torch.device(device)), 1 << 20
    told, rows = PinnedUpload(stream, 1), torch.zeros((4, count), dtype=torch.float64, device=device)
    sums, here = torch.zeros(4, dtype=torch.float64, device=device), stream.pinned(1)

    def add_up(place: int) -> None:
        sums[place] = (place + 1) * rows[place].sum()

    def work() -> None:
        rows.copy_(told.device.expand_as(rows))
        stream.fork_join([partial(add_up, place) for place in range(4)])
        here.copy_(sums.sum()[None], non_blocking=True)

    again = stream.run_captured(work)
    for value in range(1, 6):
        with stream:
            told.set(np.array([float(value)]))
            again()
            stream.wait()
        assert float(here[0]) == 10.0 * count * value


_ENDS = """
import numpy as np, torch
from egs_warp.fem.cuda_graphs import GraphStream, PinnedUpload

stream = GraphStream(torch.device("{device}"))
told = PinnedUpload(stream, 8)
with stream:
    told.take(np.arange(8.0))
    again = stream.recorded(told.send)
    for _ in range(3):
        again()
    stream.wait()
kept = told.here.numpy()
assert float(told.there.sum()) == 28.0
del told, stream, again
"""


def test_a_program_ends_with_what_it_still_holds(device: str) -> None:
    """A view of page-locked memory that goes when Warp and torch do."""
    done = subprocess.run([sys.executable, "-c", _ENDS.format(device=device)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
