"""Asynchronous rendering: a GPU renders images concurrently with other work."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import warp as wp

from egs_warp.launching import empty
from egs_warp.render.compositing import PendingImage


class AsyncRenderer:
    """Renderer of images of one size on a stream of its own: an image is submitted, and its result is fetched later. On
    a CPU, ``submit`` blocks until the image is finished."""

    def __init__(self, width: int, height: int, device: wp.Device) -> None:
        shape = (height, width, 3)
        self._levels = self._host = empty(shape, wp.uint8, device)
        self._stream: wp.Stream | None = None
        if device.is_cuda:
            self._stream, self._downloaded = wp.Stream(device), wp.Event(device)
            self._host = empty(shape, wp.uint8, "cpu", pinned=True)
        self._pending: PendingImage | None = None

    def stream_context(self) -> AbstractContextManager[Any]:
        """Return a context that queues work on the renderer's stream. The context does not synchronise with the
        caller's stream: all work that an image depends on must be queued on the renderer's stream, or must already be
        finished."""
        return nullcontext() if self._stream is None else wp.ScopedStream(self._stream, sync_enter=False)

    def submit(self, draw: Callable[[], PendingImage]) -> None:
        """Queue the image that ``draw`` returns, and its download. The previous result must have been fetched."""
        with self.stream_context():
            self._pending = draw()
            self._download(self._pending)

    def result(self) -> np.ndarray | None:
        """Wait for the submitted image; return it as (H, W, 3) uint8 in memory that the next image overwrites, or None
        if no image has been submitted."""
        pending, self._pending = self._pending, None
        if pending is None:
            return None
        with self.stream_context():
            finished = pending.result()
            if finished is not pending:
                self._download(finished)
        if self._stream is not None:
            wp.synchronize_event(self._downloaded)
        return self._host.numpy()

    def _download(self, pending: PendingImage) -> None:
        pending.image.quantise(self._levels)
        if self._stream is not None:
            wp.copy(self._host, self._levels)
            self._stream.record_event(self._downloaded)
