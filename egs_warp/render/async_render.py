"""Pictures that a GPU makes beside what else it does."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import warp as wp

from egs_warp.launching import empty
from egs_warp.render.compositing import PendingImage


class AsyncRenderer:
    """Pictures of one size, each begun and taken later, on a stream of their own; a CPU makes each as it is begun."""

    def __init__(self, width: int, height: int, device: wp.Device) -> None:
        shape = (height, width, 3)
        self._levels = self._here = empty(shape, wp.uint8, device)
        self._stream: wp.Stream | None = None
        if device.is_cuda:
            self._stream, self._sent = wp.Stream(device), wp.Event(device)
            self._here = empty(shape, wp.uint8, "cpu", pinned=True)
        self._begun: PendingImage | None = None

    def stream_context(self) -> AbstractContextManager[Any]:
        """A context of what goes on their stream, which waits for nothing: what pictures are made of is made there, or
        is there already."""
        return nullcontext() if self._stream is None else wp.ScopedStream(self._stream, sync_enter=False)

    def submit(self, draw: Callable[[], PendingImage]) -> None:
        """What ``draw`` begins; the one before has been taken."""
        with self.stream_context():
            self._begun = draw()
            self._send(self._begun)

    def result(self) -> np.ndarray | None:
        """(H, W, 3) uint8 of what was begun, in memory that the next one overwrites; None if nothing was."""
        begun, self._begun = self._begun, None
        if begun is None:
            return None
        with self.stream_context():
            settled = begun.result()
            if settled is not begun:
                self._send(settled)
        if self._stream is not None:
            wp.synchronize_event(self._sent)
        return self._here.numpy()

    def _send(self, begun: PendingImage) -> None:
        begun.image.quantise(self._levels)
        if self._stream is not None:
            wp.copy(self._here, self._levels)
            self._stream.record_event(self._sent)
