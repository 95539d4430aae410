"""CUDA graphs of PyTorch and Warp operations that repeat on the same memory; on a CPU they run directly."""

from __future__ import annotations

import ctypes
import gc
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.launching import warp_stream

_MAX_GRAPHS = 64
"""Capacity of a ``GraphCache``. Each step size and each number of contacts needs separate graphs."""


class _Entered(threading.local):
    """Stack of the streams that this thread has entered: CUDA stream and context to exit."""

    def __init__(self) -> None:
        self.contexts: list[tuple[int | None, ExitStack]] = []


_entered = _Entered()


class GraphStream:
    """Stream that PyTorch and Warp share. On a GPU it is Warp's stream, so that the two need no synchronisation."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._stream: torch.cuda.Stream | None = None
        self._of_warp: wp.Stream | None = None
        if device.type == "cuda":
            self._of_warp = wp.get_device(str(device)).stream
            self._stream = wp.stream_to_torch(self._of_warp)
        self._others: list[torch.cuda.Stream] = []
        self._pool: Any = None
        self._first: torch.cuda.CUDAGraph | None = None

    def __enter__(self) -> None:
        """Make this stream PyTorch's current stream, and disable gradients, within the context."""
        key, entered = None if self._stream is None else self._stream.cuda_stream, _entered.contexts
        context = ExitStack()
        # Switching PyTorch's stream costs more than a small operation, so a nested entry does nothing.
        if not entered or entered[-1][0] != key:
            context.enter_context(torch.no_grad())
            if self._stream is not None:
                context.enter_context(torch.cuda.stream(self._stream))
        entered.append((key, context))

    def __exit__(self, *raised: Any) -> None:
        _entered.contexts.pop()[1].__exit__(*raised)

    def current(self) -> wp.Stream | None:
        """Return Warp's object for PyTorch's current stream: this one, or a branch of ``fork_join``; None on a CPU."""
        if self._stream is None:
            return None
        stream = torch.cuda.current_stream(self.device)
        return self._of_warp if stream.cuda_stream == self._stream.cuda_stream else warp_stream(stream)

    def wait(self) -> None:
        """Block until all queued work is done."""
        if self._stream is not None:
            self._stream.synchronize()

    def record_event(self, event: torch.cuda.Event | None) -> torch.cuda.Event | None:
        """Record ``event``, or a new event, after all work queued so far and return it; None on a CPU."""
        if self._stream is None:
            return None
        event = event or torch.cuda.Event()
        event.record(self._stream)
        return event

    def fork_join(self, works: Sequence[Callable[[], None]]) -> None:
        """Run PyTorch operations concurrently, each in a separate stream. Work that is queued later runs after them.

        The ``works`` must not access each other's memory.
        """
        if self._stream is None:
            for work in works:
                work()
            return
        while len(self._others) < len(works) - 1:
            self._others.append(torch.cuda.Stream(self.device))
        fork, *joins = (torch.cuda.Event() for _ in works)
        fork.record(self._stream)
        for work, other, end in zip(works[1:], self._others, joins, strict=False):
            other.wait_event(fork)
            with torch.cuda.stream(other):
                work()
            end.record(other)
        works[0]()
        for end in joins:
            self._stream.wait_event(end)

    def run_captured(self, work: Callable[[], None]) -> Callable[[], None]:
        """Return a function that runs ``work``, on a GPU as a CUDA graph.

        The first call runs ``work`` directly, so that compilation and setup are done before the second call captures
        it. ``work`` must not synchronise with the device.
        """
        return work if self._stream is None else _Graph(work, self)

    def run_while(self, work: Callable[[], None], going: torch.Tensor) -> Callable[[], None]:
        """Return a function that repeats ``work`` while ``going`` (1,) int32, which ``work`` updates, is not 0.

        On a GPU, once ``work`` has run directly, the repetition is a loop within a CUDA graph, launched asynchronously.
        """
        return _WhileGraph(work, self, going)

    def record(self, work: Callable[[], None], *, keep: bool = False) -> torch.cuda.CUDAGraph:
        """Capture the device operations of ``work`` in a graph without executing them.

        All graphs share one pool of temporary memory, because they run sequentially and leave no results in it. The
        first graph is retained, since the pool is released with its last graph. No other thread may use the device
        during a capture, as its operations would be captured too. Python's garbage collection is disabled during a
        capture, since freeing device memory would synchronise with the device.

        Args:
            work: operations to capture.
            keep: True to retain the raw graph, so that it can become part of another graph.
        """
        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()
        self.wait()
        graph = torch.cuda.CUDAGraph(keep_graph=keep)
        with _no_garbage():
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            try:
                work()
            finally:
                graph.capture_end()
        self._first = self._first or graph
        return graph

    def while_graph(self, graph: torch.cuda.CUDAGraph, going: torch.Tensor) -> Callable[[], object]:
        """Return a function that replays a graph recorded with ``keep`` while ``going`` (1,) int32 is not 0.

        The loop is a conditional graph node if the driver supports that; otherwise it runs on the host.
        """
        if not wp.is_conditional_graph_supported():
            return lambda: _repeat(graph.replay, going)
        stream = self._of_warp
        assert stream is not None
        within, condition = wp.Graph(stream.device), wp.from_torch(going)
        within.graph = ctypes.c_void_p(graph.raw_cuda_graph())
        with _no_garbage():
            wp.capture_begin(stream=stream)
            wp.capture_while(condition, within, stream=stream)
            loop = wp.capture_end(stream=stream)
        # PyTorch owns the raw graph and destroys it.
        within.graph = None
        return lambda: wp.capture_launch(loop, stream=stream)

    def pinned(self, count: int) -> torch.Tensor:
        """Return page-locked host memory (count,) of float64 zeros that a GPU can access directly.

        The memory is allocated by Warp and not by PyTorch. When PyTorch frees page-locked memory, it records an event
        on the stream; if Warp's stream has already been destroyed at exit, this would abort the program.
        """
        return wp.to_torch(wp.zeros(count, dtype=wp.float64, device="cpu", pinned=self._stream is not None))


class PinnedUpload:
    """Page-locked buffer ``host`` and tensor ``device`` (count,) of float64 values that are uploaded together."""

    def __init__(self, stream: GraphStream, count: int) -> None:
        self.host, self._stream = stream.pinned(count), stream
        self._copied: torch.cuda.Event | None = None
        self.device = torch.zeros(count, dtype=torch.float64, device=stream.device)

    def set(self, *parts: np.ndarray) -> None:
        """Upload the concatenated ``parts``, padded with zeros, asynchronously."""
        self.write(*parts)
        self.send()
        self.start_copy()

    def write(self, *parts: np.ndarray) -> None:
        """Write the concatenated ``parts``, padded with zeros, to the host buffer. A graph then calls ``send``.

        The call blocks until the previous copy, marked by ``start_copy``, has finished.
        """
        host, at = self.host.numpy(), 0
        self.wait()
        for part in parts:
            host[at : at + part.size] = part.ravel()
            at += part.size
        host[at:] = 0.0

    def start_copy(self) -> None:
        """Mark a copy as queued: ``write`` and ``wait`` block until it has finished."""
        self._copied = self._stream.record_event(self._copied)

    def wait(self) -> None:
        """Block until the last marked copy has finished."""
        if self._copied is not None:
            self._copied.synchronize()

    def send(self) -> None:
        """Queue the copy of the host buffer to the device."""
        self.device.copy_(self.host, non_blocking=True)


class GraphCache:
    """Cache of captured operations by key; evicts the least recently used."""

    def __init__(self, stream: GraphStream) -> None:
        self._stream = stream
        self._graphs: OrderedDict[Hashable, Callable[[], None]] = OrderedDict()

    def run(self, key: Hashable, work: Callable[[], None]) -> None:
        """Run ``work``, or the graph that was captured from it under the same ``key``."""
        self._run(key, lambda: self._stream.run_captured(work))

    def repeat(self, key: Hashable, work: Callable[[], None], going: torch.Tensor) -> None:
        """Repeat ``work``, or the graph captured under ``key``, while ``going`` (1,) int32 is not 0 (``run_while``)."""
        self._run(key, lambda: self._stream.run_while(work, going))

    def _run(self, key: Hashable, make: Callable[[], Callable[[], None]]) -> None:
        if key not in self._graphs:
            self._graphs[key] = make()
            while len(self._graphs) > _MAX_GRAPHS:
                self._graphs.popitem(last=False)
        self._graphs.move_to_end(key)
        self._graphs[key]()

    def forget(self) -> None:
        """Remove all entries."""
        self._graphs.clear()


class _Graph:
    """Operations that run directly at the first call and as a graph afterwards."""

    def __init__(self, work: Callable[[], None], stream: GraphStream) -> None:
        self._work, self._stream, self._warm = work, stream, False
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        if not self._warm:
            self._warm = True
            self._work()
            return
        if self._graph is None:
            self._graph = self._stream.record(self._work)
        self._graph.replay()


class _WhileGraph:
    """Operations that repeat while a flag is set: directly at first, then as a loop within a graph."""

    def __init__(self, work: Callable[[], None], stream: GraphStream, going: torch.Tensor) -> None:
        self._work, self._stream, self._going = work, stream, going
        self._warm = False
        self._graph: torch.cuda.CUDAGraph | None = None
        self._loop: Callable[[], object] | None = None

    def __call__(self) -> None:
        if self._loop is None and (self._going.device.type == "cpu" or not self._warm):
            self._warm = _repeat(self._work, self._going) > 0
            return
        if self._loop is None:
            self._graph = self._stream.record(self._work, keep=True)
            self._loop = self._stream.while_graph(self._graph, self._going)
        self._loop()


def _repeat(work: Callable[[], None], going: torch.Tensor) -> int:
    """Run ``work`` while ``going`` is not 0, with a synchronisation each time, and return the number of runs."""
    count = 0
    while int(going) != 0:
        work()
        count += 1
    return count


@contextmanager
def _no_garbage() -> Iterator[None]:
    """Disable Python's garbage collection within the context."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
