"""CUDA graphs: replays with the current contents of the memory, loops, the cache, stream contexts and forks."""

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


def test_captured_work_reads_the_current_input(device: str) -> None:
    stream = GraphStream(torch.device(device))
    upload, readback = PinnedUpload(stream, 4), stream.pinned(4)
    runs = []

    def work() -> None:
        runs.append(len(runs))
        readback.copy_((upload.device @ upload.device) * upload.device, non_blocking=True)

    again = stream.run_captured(work)
    for number in range(5):
        with stream:
            upload.set(np.array([1.0, number]), np.array([2.0]))
            again()
            stream.wait()
        expected = np.array([1.0, number, 2.0, 0.0]) * (5.0 + number**2)
        np.testing.assert_array_equal(readback.numpy(), expected)
    # On a GPU, the Python function runs once directly and once for the capture.
    assert len(runs) == (5 if device == "cpu" else 2)


@pytest.mark.parametrize("loops", [True, False])
def test_repeated_work_runs_while_its_flag_is_set(device: str, monkeypatch: pytest.MonkeyPatch, loops: bool) -> None:
    """The work repeats while its flag is nonzero, and never if it is 0 at the start; each loop reads new input. This
    holds with and without support for conditional graphs."""
    if not loops:
        monkeypatch.setattr(wp, "is_conditional_graph_supported", lambda: False)
    stream = GraphStream(torch.device(device))
    upload, readback = PinnedUpload(stream, 2), stream.pinned(2)
    going, sums = torch.zeros(1, dtype=torch.int32, device=device), torch.zeros(2, dtype=torch.float64, device=device)
    works, runs = GraphCache(stream), []

    def work() -> None:
        runs.append(len(runs))
        # This operation allocates temporary memory.
        sums.add_(torch.stack([torch.ones_like(upload.device[0]), upload.device[0]]))
        going.copy_(sums[:1] < upload.device[1])

    for number, steps in enumerate([0, 3, 1, 5, 0, 2]):
        with stream:
            upload.set(np.array([number + 0.5, steps]))
            sums.zero_()
            going.fill_(steps > 0)
            works.repeat("steps", work, going)
            readback.copy_(sums, non_blocking=True)
            stream.wait()
        np.testing.assert_array_equal(readback.numpy(), [steps, steps * (number + 0.5)])
    # On a GPU, the Python function runs in the three repetitions of the first loop, which is executed directly, and
    # once for the capture.
    assert len(runs) == (11 if device == "cpu" else 4)


def test_the_cache_keeps_the_most_recent_graphs(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With more keys than the capacity, evicted operations run directly again, with the current arguments."""
    monkeypatch.setattr(cuda_graphs, "_MAX_GRAPHS", 3)
    stream = GraphStream(torch.device(device))
    upload, readback = PinnedUpload(stream, 1), stream.pinned(1)
    works = GraphCache(stream)

    def run(factor: float, value: float) -> float:
        def work() -> None:
            readback.copy_(factor * upload.device, non_blocking=True)

        with stream:
            upload.set(np.array([value]))
            works.run(factor, work)
            stream.wait()
        return float(readback[0])

    for turn in range(4):
        for factor in (1.0, 2.0, 3.0, 4.0, 4.0, 4.0):
            assert run(factor, turn + 0.5) == factor * (turn + 0.5)
    assert list(works._graphs) == [2.0, 3.0, 4.0]
    works.forget()
    assert run(2.0, 1.0) == 2.0 and len(works._graphs) == 1


def test_garbage_collection_is_disabled_during_a_capture(device: str) -> None:
    """Freeing device memory during a capture would synchronise with the device and break the capture."""
    stream, enabled = GraphStream(torch.device(device)), []
    again = stream.run_captured(lambda: enabled.append(gc.isenabled()))
    for _ in range(3):
        with stream:
            again()
    assert gc.isenabled() and enabled == ([True] * 3 if device == "cpu" else [True, False])


def test_nested_entries_of_a_stream_end_with_the_first(device: str) -> None:
    """Nested contexts, also those of another object for the same stream, end with the outermost one. A context belongs
    to one thread. Gradients are disabled within it, and enabled before and after it."""
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


def test_later_work_follows_all_branches_of_a_fork(device: str) -> None:
    """Branches start after the work before the fork, both if it is executed directly and if it is captured. They
    compute the sums of long rows that this work fills."""
    stream, count = GraphStream(torch.device(device)), 1 << 20
    upload, rows = PinnedUpload(stream, 1), torch.zeros((4, count), dtype=torch.float64, device=device)
    sums, readback = torch.zeros(4, dtype=torch.float64, device=device), stream.pinned(1)

    def add_up(place: int) -> None:
        sums[place] = (place + 1) * rows[place].sum()

    def work() -> None:
        rows.copy_(upload.device.expand_as(rows))
        stream.fork_join([partial(add_up, place) for place in range(4)])
        readback.copy_(sums.sum()[None], non_blocking=True)

    again = stream.run_captured(work)
    for value in range(1, 6):
        with stream:
            upload.set(np.array([float(value)]))
            again()
            stream.wait()
        assert float(readback[0]) == 10.0 * count * value


_ENDS = """
import numpy as np, torch
from egs_warp.fem.cuda_graphs import GraphStream, PinnedUpload

stream = GraphStream(torch.device("{device}"))
upload = PinnedUpload(stream, 8)
with stream:
    upload.set(np.arange(8.0))
    again = stream.run_captured(upload.send)
    for _ in range(3):
        again()
    stream.wait()
values = upload.host.numpy()
assert float(upload.device.sum()) == 28.0
del upload, stream, again
"""


def test_a_program_exits_while_it_holds_pinned_memory(device: str) -> None:
    """A NumPy view of page-locked memory outlives the objects of Warp and PyTorch until the process exits."""
    done = subprocess.run([sys.executable, "-c", _ENDS.format(device=device)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
