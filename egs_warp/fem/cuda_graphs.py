"""Work of torch and Warp that is done again and again on the same memory: on a GPU one graph, launched at once."""

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

_MOST = 64
"""Works of one kind that are kept: steps of other lengths and other numbers of contacts are others."""


class _Entered(threading.local):
    """Streams that this thread has entered, the last one last: which, and what is left with it."""

    def __init__(self) -> None:
        self.contexts: list[tuple[int | None, ExitStack]] = []


_entered = _Entered()


class GraphStream:
    """Where torch and Warp both work: on a GPU on Warp's stream, so that neither has to wait for the other."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._stream: Any = None
        self._of_warp: wp.Stream | None = None
        if device.type == "cuda":
            self._of_warp = wp.get_device(str(device)).stream
            self._stream = wp.stream_to_torch(self._of_warp)
        self._others: list[Any] = []
        self._pool: Any = None
        self._first: Any = None

    def __enter__(self) -> None:
        """From now on torch works there, and keeps no track of gradients."""
        key, entered = None if self._stream is None else self._stream.cuda_stream, _entered.contexts
        context = ExitStack()
        # Torch takes longer to turn to a stream than to begin some work there.
        if not entered or entered[-1][0] != key:
            context.enter_context(torch.no_grad())
            if self._stream is not None:
                context.enter_context(torch.cuda.stream(self._stream))
        entered.append((key, context))

    def __exit__(self, *raised: Any) -> None:
        _entered.contexts.pop()[1].__exit__(*raised)

    def current(self) -> wp.Stream | None:
        """Warp's name of the stream on which torch works: this one, or one of those that are ``at_once``."""
        if self._stream is None:
            return None
        stream = torch.cuda.current_stream(self.device)
        return self._of_warp if stream.cuda_stream == self._stream.cuda_stream else warp_stream(stream)

    def wait(self) -> None:
        """Until all is done that was begun."""
        if self._stream is not None:
            self._stream.synchronize()

    def record_event(self, event: Any) -> Any:
        """An event after all that was begun, for which somebody may wait: ``event``, or a new one."""
        if self._stream is None:
            return None
        event = event or torch.cuda.Event()
        event.record(self._stream)
        return event

    def fork_join(self, works: Sequence[Callable[[], None]]) -> None:
        """``works`` of torch, each of which leaves alone what the others touch; what is asked for next comes after all
        of them."""
        if self._stream is None:
            for work in works:
                work()
            return
        while len(self._others) < len(works) - 1:
            self._others.append(torch.cuda.Stream(self.device))
        begun, *ended = (torch.cuda.Event() for _ in works)
        begun.record(self._stream)
        for work, other, end in zip(works[1:], self._others, ended, strict=False):
            other.wait_event(begun)
            with torch.cuda.stream(other):
                work()
            end.record(other)
        works[0]()
        for end in ended:
            self._stream.wait_event(end)

    def run_captured(self, work: Callable[[], None]) -> Callable[[], None]:
        """``work``, which is run as it is the first time: nothing may be compiled or made while it is recorded, the
        second time. It must not wait for the device."""
        return work if self._stream is None else _Graph(work, self)

    def run_while(self, work: Callable[[], None], going: torch.Tensor) -> Callable[[], None]:
        """``work`` again and again while ``going`` (1,) int32 is not 0, as it says itself: on a GPU a loop within a
        graph, for which nobody waits, once ``work`` has run as it is."""
        return _WhileGraph(work, self, going)

    def record(self, work: Callable[[], None], *, keep: bool = False) -> torch.cuda.CUDAGraph:
        """What ``work`` asks of the device, none of which is done; a graph to ``keep`` can be part of another.

        What graphs make on their way lies in the same memory: they run one after the other, and leave nothing there.
        The first is kept, since with the last of them that memory would go. No other thread may work on the device
        meanwhile: what it begins would be recorded, too. Nor may Python look for garbage: what it found of the device's
        memory it would give back, which waits for all that goes on there.
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

    def while_graph(self, graph: torch.cuda.CUDAGraph, going: torch.Tensor) -> Callable[[], None]:
        """What was recorded to be kept, while ``going`` (1,) int32 is not 0: in a graph, if the driver knows loops."""
        if not wp.is_conditional_graph_supported():

            def replayed() -> None:
                _repeat(graph.replay, going)

            return replayed
        stream = self._of_warp
        assert stream is not None
        within, condition = wp.Graph(stream.device), wp.from_torch(going)
        within.graph = ctypes.c_void_p(graph.raw_cuda_graph())
        with _no_garbage():
            wp.capture_begin(stream=stream)
            wp.capture_while(condition, within, stream=stream)
            loop = wp.capture_end(stream=stream)
        # Torch's, who gives it back.
        within.graph = None
        return lambda: wp.capture_launch(loop, stream=stream)

    def pinned(self, count: int) -> torch.Tensor:
        """(count,) of zeros on the host, which a GPU reads and writes by itself. Warp's: torch would note, when its own
        go, where Warp's stream is then, which ends the program if that went before, as it may at the end."""
        return wp.to_torch(wp.zeros(count, dtype=wp.float64, device="cpu", pinned=self._stream is not None))


class PinnedUpload:
    """Numbers that go to the device in one piece."""

    def __init__(self, stream: GraphStream, count: int) -> None:
        self.host, self._stream = stream.pinned(count), stream
        self._sent: Any = None
        self.device = torch.zeros(count, dtype=torch.float64, device=stream.device)

    def set(self, *parts: np.ndarray) -> None:
        """``parts`` one behind the other, zeros behind the last."""
        self.write(*parts)
        self.send()
        self.start_copy()

    def write(self, *parts: np.ndarray) -> None:
        """The same, for a graph to ``send``; what it has sent before must have gone, or be known to be ``sent``."""
        here, at = self.host.numpy(), 0
        self.wait()
        for part in parts:
            here[at : at + part.size] = part.ravel()
            at += part.size
        here[at:] = 0.0

    def start_copy(self) -> None:
        """It is on its way."""
        self._sent = self._stream.record_event(self._sent)

    def wait(self) -> None:
        """Until what is on its way has gone."""
        if self._sent is not None:
            self._sent.synchronize()

    def send(self) -> None:
        """What lies ``here`` now."""
        self.device.copy_(self.host, non_blocking=True)


class GraphCache:
    """Works by their keys, of which the last are kept."""

    def __init__(self, stream: GraphStream) -> None:
        self._stream = stream
        self._kept: OrderedDict[Hashable, Callable[[], None]] = OrderedDict()

    def run(self, key: Hashable, work: Callable[[], None]) -> None:
        """``work``, or what was recorded of that with the same ``key``."""
        if key not in self._kept:
            self._keep(key, self._stream.run_captured(work))
        self._kept.move_to_end(key)
        self._kept[key]()

    def repeat(self, key: Hashable, work: Callable[[], None], going: torch.Tensor) -> None:
        """The same again and again while ``going`` (1,) int32 is not 0."""
        if key not in self._kept:
            self._keep(key, self._stream.run_while(work, going))
        self._kept.move_to_end(key)
        self._kept[key]()

    def _keep(self, key: Hashable, work: Callable[[], None]) -> None:
        self._kept[key] = work
        while len(self._kept) > _MOST:
            self._kept.popitem(last=False)

    def forget(self) -> None:
        """All of them."""
        self._kept.clear()


class _Graph:
    """Work, and its graph once there is one."""

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
    """Work that is repeated, and the loop of its graph once there is one."""

    def __init__(self, work: Callable[[], None], stream: GraphStream, going: torch.Tensor) -> None:
        self._work, self._stream, self._going = work, stream, going
        self._warm = False
        self._graph: torch.cuda.CUDAGraph | None = None
        self._looped: Callable[[], None] | None = None

    def __call__(self) -> None:
        if self._looped is None and (self._going.device.type == "cpu" or not self._warm):
            self._warm = _repeat(self._work, self._going) > 0
            return
        if self._looped is None:
            self._graph = self._stream.record(self._work, keep=True)
            self._looped = self._stream.while_graph(self._graph, self._going)
        self._looped()


def _repeat(work: Callable[[], None], going: torch.Tensor) -> int:
    """How often ``work`` was done while ``going`` was not 0, at which the host looks each time."""
    count = 0
    while int(going) != 0:
        work()
        count += 1
    return count


@contextmanager
def _no_garbage() -> Iterator[None]:
    """Python looks for none meanwhile."""
    looks = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if looks:
            gc.enable()
