"""New arrays, and launches of a kernel over many independent rows: at once on a GPU, with every core on a CPU.

On a CPU, Warp runs one launch on one thread but releases the interpreter lock while it runs, so launches over disjoint
rows from several threads run side by side.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
import warp as wp

from egs_warp.errors import ArgumentError, UserError
from egs_warp.worker_threads import worker_threads

Shape: TypeAlias = int | tuple[int, ...]
T = TypeVar("T")
U = TypeVar("U")
Device: TypeAlias = wp.Device | str | None
"""A device or its name; None is Warp's current one."""

THREADS = "EGS_WARP_THREADS"
"""In the environment: how many cores the package may use at most, where that is less than there are."""
_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
_MIN_ROWS_PER_CHUNK = 2048
"""Below this many light rows a launch's own cost (about 20 us) is no longer small against its work."""

_ALIGNMENT = 256
"""Bytes: what the widest loads of a GPU ask for."""

_LAST_CHUNKS_PER_THREAD = 24
"""The smallest chunk is this part of a thread's share: what one thread may wait for the other at the end."""


def available_threads() -> int:
    """Number of processor cores that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    most = os.environ.get(THREADS, "")
    return max(1, min(cores, int(most)) if most.isdecimal() else cores - _left)


_left = 0
"""Cores that are left to others."""


@contextmanager
def reserve_core() -> Iterator[None]:
    """While it lasts, all threads of this process leave a core to whoever else computes here, where there is more than
    one and the environment does not say how many to use."""
    global _left
    _left += 1
    try:
        yield
    finally:
        _left -= 1


def use_device(device: str) -> None:
    """Called first by programs: raises ``UserError`` where Warp sees no such device or has no place for its kernels,
    and leaves Warp only its warnings."""
    wp.config.log_level = wp.LOG_WARNING
    try:
        with _without_driver_warning() if device == "cpu" else nullcontext():
            wp.init()
    except OSError as error:
        place = error.filename or wp.config.kernel_cache_dir
        raise UserError(
            f"kernel cache {place}: cannot be made ({error.strerror}); set WARP_CACHE_PATH to a folder that can be"
            " written"
        ) from error
    if device not in (devices := [str(known) for known in wp.get_devices()]):
        raise ArgumentError("device", f"this machine has {', '.join(devices)}", value=device)


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Warp's native code warns those, too, who ask for no GPU that there is no driver, past Python's own streams."""
    with ExitStack() as files:
        try:
            said = files.enter_context(tempfile.TemporaryFile())
            kept = os.dup(2)
        except OSError:
            yield
            return
        files.callback(os.close, kept)
        os.dup2(said.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            said.seek(0)
            # A stream that is full or closed is not about the device.
            with suppress(OSError):
                os.write(2, b"".join(line for line in said if _NO_DRIVER not in line))


def kernels_are_compiled() -> bool:
    """Whether some of this package's kernels lie in Warp's cache; call ``use_device`` before."""
    return any(Path(wp.config.kernel_cache_dir or ".").glob("wp_egs_warp.*"))


def launch_rows(
    kernel: Any,
    row_count: int,
    *,
    inputs: Sequence[object],
    outputs: Sequence[object],
    device: wp.Device,
    threads: int | None = None,
    work: np.ndarray | None = None,
) -> None:
    """Run ``kernel`` over rows 0 .. ``row_count`` - 1.

    The kernel's first parameter must be ``first_row: wp.int32`` and its row ``first_row + wp.tid()``; each row may
    write only what belongs to it, so that the result does not depend on how rows are shared out. ``inputs`` and
    ``outputs`` are the remaining parameters. ``threads`` (a CPU only) defaults to the available cores. ``work``
    (row_count,) is the expected effort of heavy rows, any unit; without it rows are light and alike.
    """
    if not device.is_cpu:
        launch_cached(kernel, row_count, inputs=[0, *inputs], outputs=outputs, device=device)
        return
    threads = threads or available_threads()
    edges = _chunk_edges(row_count, threads, work)
    if threads == 1 or len(edges) < 3:
        wp.launch(kernel, dim=row_count, inputs=[0, *inputs], outputs=list(outputs), device=device)
        return
    # Compiling is not safe from several threads at once.
    kernel.module.load(device, block_dim=1)
    chunks = iter(list(pairwise(edges)))

    def launch_chunks() -> None:
        launch: Any = None
        # Whoever is free takes the next chunk, and packs the arguments only once.
        for first, last in chunks:
            if launch is None:
                arguments = {"inputs": [first, *inputs], "outputs": list(outputs), "device": device}
                launch = wp.launch(kernel, dim=last - first, record_cmd=True, **arguments)
            else:
                launch.set_dim(last - first)
                launch.set_param_at_index_from_ctype(0, first)
            launch.launch()

    tasks = [worker_threads().begin(launch_chunks) for _ in range(min(threads, len(edges) - 1) - 1)]
    try:
        launch_chunks()
    finally:
        # Who has not begun would find nothing left to do.
        for task in tasks:
            task.wait()
    for task in tasks:
        task.result()


class _Recorded(threading.local):
    """Launches that this thread has made, for it to change and make again."""

    def __init__(self) -> None:
        self.launches: dict[tuple[Any, str], tuple[Any, int | tuple[int, int], list[Any]]] = {}


_recorded = _Recorded()


def launch_cached(
    kernel: Any, dim: int | tuple[int, int], *, inputs: Sequence[Any], outputs: Sequence[Any], device: wp.Device
) -> None:
    """``wp.launch`` at a third of its cost, for kernels that run many times a second.

    The first launch of a thread is kept; the next ones only put in those arguments that are others than last time,
    whose types are not checked again. A struct or vector that is the same object as last time may have other contents.
    """
    launches = _recorded.launches
    kept, kept_dim, held = launches.get((kernel, device.alias), (None, -1, []))
    if kept is None:
        kept = wp.launch(kernel, dim, inputs=list(inputs), outputs=list(outputs), device=device, record_cmd=True)
        # None where there is nothing to do.
        if kept is None:
            return
        # What the launch keeps alive besides its packed arguments.
        kept.fwd_args = None  # pyright: ignore[reportAttributeAccessIssue]  # guessed from a list
        held = [_UNKNOWN] * (len(inputs) + len(outputs))
        launches[kernel, device.alias] = kept, dim, held
    else:
        if dim != kept_dim:
            kept.set_dim(dim)
            launches[kernel, device.alias] = kept, dim, held
        for i, value in enumerate((*inputs, *outputs)):
            last = held[i]
            if isinstance(value, wp.array):
                # Held weakly: the array itself would keep its memory.
                if type(last) is not weakref.ref or last() is not value:
                    kept.set_param_at_index_from_ctype(i, value.__ctype__())
                    held[i] = weakref.ref(value)
            elif isinstance(value, int | float):
                if type(last) is not type(value) or last != value:
                    kept.set_param_at_index_from_ctype(i, value)
                    held[i] = value
            elif last is not value:
                kept.set_param_at_index(i, value)
                held[i] = value
    if kept.bounds.size > 0:
        kept.launch()


def lanes_on(device: wp.Device) -> int:
    """Threads that work out a row together: those of a GPU's warp, one on a CPU."""
    return 1 if device.is_cpu else 32


_UNKNOWN = object()
"""Stands for an argument that was never put in."""


def _chunk_edges(row_count: int, threads: int, work: np.ndarray | None) -> list[int]:
    """Where chunks begin and end, whose effort shrinks towards the last:
    all threads then finish at about the same time.
    """
    least = 0.0 if work is not None else _MIN_ROWS_PER_CHUNK / max(row_count, 1)
    least = max(least, 1.0 / (_LAST_CHUNKS_PER_THREAD * threads))
    shares, taken = [], 0.0
    while threads > 1 and taken + least < 1.0:
        taken += max((1.0 - taken) / (2 * threads), least)
        shares.append(taken)
    if work is None:
        inner = np.array(shares) * row_count
    else:
        done = np.concatenate([[0.0], np.cumsum(np.asarray(work, dtype=np.float64) + 1e-3)])
        inner = np.searchsorted(done, np.array(shares) * done[-1])
    return np.unique(np.concatenate([[0], inner, [row_count]]).astype(int)).tolist()


def thread_local_cache(most: int) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """A decorator: what was made for the last ``most`` different arguments is kept, by each thread for itself, as
    memory must be that is written to."""

    def decorated(make: Callable[..., T]) -> Callable[..., T]:
        own = threading.local()

        def kept(*arguments: Any) -> T:
            if not hasattr(own, "made"):
                own.made = lru_cache(maxsize=most)(make)
            return own.made(*arguments)

        return kept

    return decorated


def run_concurrently(first: Callable[[], T], second: Callable[[], U]) -> tuple[T, U]:
    """Both results; ``second`` runs in another thread where one is free."""
    if available_threads() == 1:
        return first(), second()
    task = worker_threads().begin(second)
    try:
        return first(), task.result()
    except BaseException:
        # What it works with may be used again at once.
        task.wait()
        raise


@cache
def warp_stream(stream: Any) -> wp.Stream:
    """Warp's name of a ``stream`` of torch, which has few and keeps them, kept, too: with a name goes what Warp holds
    for that stream, whoever else has a name of it."""
    return wp.stream_from_torch(stream)


def device_of(array: wp.array) -> wp.Device:
    """Where ``array`` is. Warp's own type leaves room for none, which only annotations have."""
    device: Any = array.device
    return device


def empty(shape: Shape, dtype: Any, device: Device, *, pinned: bool = False) -> wp.array:
    """Array of undefined contents; ``pinned`` is page-locked, on a CPU. Warp's own stub admits only Python's ``float``
    as a type.
    """
    return wp.empty(shape, dtype=dtype, device=device, pinned=pinned)


def empty_pooled(device: Device, *wanted: tuple[Shape, Any]) -> list[wp.array]:
    """Arrays of undefined contents in one piece of memory, each given by its shape and type.

    An allocation on a GPU costs several times a look into it, and small pictures wait for both: arrays that nobody
    holds any more are given again, as they are, to the next who wants the same on the same stream. Put together what
    lives equally long: the memory goes when the last of the arrays does.
    """
    device = wp.get_device(device)
    kept = _spare.kept
    key = (device.alias, device.stream.cuda_stream if device.is_cuda else None, wanted)
    made = kept.get(key, [])
    for pieces in made:
        if _holders(pieces) == _NO_HOLDER:
            kept.move_to_end(key)
            return list(pieces)
    starts, total = [], 0
    for shape, dtype in wanted:
        starts.append(total)
        count = shape if isinstance(shape, int) else math.prod(shape)
        total += -(-count * wp.types.type_size_in_bytes(dtype) // _ALIGNMENT) * _ALIGNMENT
    if device.is_cuda:
        _keep_memory(device.alias)
    # In rows, for no side of an array may have 2^31 entries.
    memory = empty((max(total // _ALIGNMENT, 1), _ALIGNMENT), wp.uint8, device)
    pieces = []
    for (shape, dtype), start in zip(wanted, starts, strict=True):
        assert memory.ptr is not None
        piece = wp.array(ptr=memory.ptr + start, dtype=dtype, shape=shape, device=memory.device)
        piece._ref = memory
        pieces.append(piece)
    if 0 < total <= _POOLED_BYTES:
        kept[key] = [*made[1 - _POOLED_ALIKE :], pieces]
        kept.move_to_end(key)
        while len(kept) > _POOLED_KINDS:
            kept.popitem(last=False)
    return list(pieces)


@cache
def _keep_memory(alias: str) -> None:
    """Let Warp keep some of the memory that is free: by CUDA's default a GPU gives all of it back whenever anyone waits
    for it, and to have it mapped again takes as long as a picture of a small scene."""
    device = wp.get_device(alias)
    share = device.total_memory // _KEPT_SHARE
    if device.is_mempool_enabled and wp.get_mempool_release_threshold(device) < share:
        wp.set_mempool_release_threshold(device, share)


_KEPT_SHARE = 32
"""The part of a GPU's memory that is kept is one in so many."""


def _holders(pieces: list[wp.array]) -> int:
    return max(map(sys.getrefcount, pieces))


_NO_HOLDER = max(map(sys.getrefcount, [object()]))
"""References to what only one list holds, counted as ``_holders`` does."""
_POOLED_BYTES, _POOLED_KINDS, _POOLED_ALIKE = 2**25, 16, 4
"""Largest piece that is kept for the next who wants it, and how many of different kinds and of one kind are."""


class _FreeList(threading.local):
    """What this thread made by ``empty_together``, oldest first."""

    def __init__(self) -> None:
        self.kept: OrderedDict[Any, list[list[wp.array]]] = OrderedDict()


_spare = _FreeList()


def round_up(count: int, step: int) -> int:
    """The least multiple of ``step`` that is at least ``count``, and 1."""
    return -(-max(count, 1) // step) * step


def grow_capacity(count: int) -> int:
    """At least ``count``, at most a quarter more: counts that differ a little then ask for arrays of one size."""
    step = 1 << max(count.bit_length() - 3, 0)
    return -(-max(count, 1) // step) * step


def copy_into(target: wp.array, values: np.ndarray) -> None:
    """Copy ``values`` of the same shape and kind into ``target``; on a CPU without Warp's own way, which takes longer
    than a small copy."""
    if device_of(target).is_cpu:
        np.copyto(target.numpy(), values)
    else:
        target.assign(np.ascontiguousarray(values, dtype=np.float64))


class PinnedMirror:
    """Numbers of an ``array`` on the host, which come and go many times a second: by memory that a GPU reads and writes
    itself, in a fraction of the time that Warp's own ways take; on a CPU the array has no other."""

    def __init__(self, array: wp.array) -> None:
        self._array, self._device, self._here = array, device_of(array), array
        if not self._device.is_cpu:
            self._here = wp.zeros(array.shape, array.dtype, "cpu", pinned=True)
        self._values = self._here.numpy()
        self._sent: wp.Event | None = None

    def put(self, values: np.ndarray) -> None:
        """Into the array, of the same shape, which nobody else writes to."""
        if self._sent is not None:
            if np.array_equal(values, self._values):
                return
            # What was told before may still be on its way.
            wp.synchronize_event(self._sent)
        np.copyto(self._values, values)
        if not self._device.is_cpu:
            wp.copy(self._array, self._here)
            self._sent = wp.get_stream(self._device).record_event(self._sent)

    def get(self) -> np.ndarray:
        """From the array, a copy."""
        return self.get_all(self)[0]

    @staticmethod
    def get_all(*mirrors: PinnedMirror) -> list[np.ndarray]:
        """From the arrays of ``mirrors`` on one device, copies."""
        device = mirrors[0]._device
        if not device.is_cpu:
            for mirror in mirrors:
                wp.copy(mirror._here, mirror._array)
            wp.synchronize_stream(device)
        return [mirror._values.copy() for mirror in mirrors]


def zeros(shape: Shape, dtype: Any, device: Device) -> wp.array:
    """Array of zeros."""
    return wp.zeros(shape, dtype=dtype, device=device)
