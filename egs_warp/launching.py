"""Device setup, kernel launches and array allocation.

On a CPU, Warp runs a launch on one thread but releases the interpreter lock, so launches over disjoint rows from
several threads run in parallel.
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
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
import warp as wp

from egs_warp.errors import ArgumentError, UserError, did_you_mean
from egs_warp.worker_threads import worker_threads

Shape: TypeAlias = int | tuple[int, ...]
T = TypeVar("T")
U = TypeVar("U")
Device: TypeAlias = wp.Device | str | None
"""A device or its name; None stands for Warp's current device."""

THREADS = "EGS_WARP_THREADS"
"""Environment variable with the maximum number of cores that the package uses."""
_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
_MIN_ROWS_PER_CHUNK = 2048
"""Minimum number of cheap rows per chunk; for smaller chunks, the cost of a launch (about 20 us) would not be
negligible."""

_ALIGNMENT = 256
"""Alignment of pooled arrays, bytes: a multiple of the width of a GPU's widest load."""

_LAST_CHUNKS_PER_THREAD = 24
"""Ratio of the rows per thread to the rows of the smallest chunk; it bounds the time for which threads are idle at the
end."""


def available_threads() -> int:
    """Return the number of processor cores that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    limit = os.environ.get(THREADS, "")
    return max(1, min(cores, int(limit)) if limit.isdecimal() else cores - _reserved)


_reserved = 0
"""Number of cores reserved for other processes."""


@contextmanager
def reserve_core() -> Iterator[None]:
    """Reserve a core for other processes within the context.

    This has no effect on a machine with one core, or if the environment variable ``THREADS`` is set.
    """
    global _reserved
    _reserved += 1
    try:
        yield
    finally:
        _reserved -= 1


# By default, Warp prints seven lines when it starts. A log level that the user sets, before or after this import, is
# respected.
if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING


def use_device(device: str) -> None:
    """Initialize Warp for ``device``. Programs call this function first.

    Raises:
        UserError: Warp has no such device, or cannot create its kernel cache.
    """
    try:
        with _without_driver_warning():
            wp.init()
    except OSError as error:
        place = error.filename or wp.config.kernel_cache_dir
        raise UserError(
            f"kernel cache {place}: cannot be created ({error.strerror}); set WARP_CACHE_PATH to a writable folder"
        ) from error
    if device not in (devices := [str(known) for known in wp.get_devices()]):
        near = did_you_mean(device, devices)
        raise ArgumentError("device", f"this machine has {', '.join(devices)}{near}; give one of these", value=device)


@cache
def start_on_cpu() -> None:
    """Initialize Warp without its warning about a missing GPU driver, which does not matter for arrays on a CPU."""
    with _without_driver_warning():
        wp.init()


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Suppress the warning about a missing GPU driver, which Warp's native code writes to stderr for every device. If a
    GPU was requested, ``use_device`` raises an error instead."""
    with ExitStack() as files:
        try:
            captured = files.enter_context(tempfile.TemporaryFile())
            stderr = os.dup(2)
        except OSError:
            yield
            return
        files.callback(os.close, stderr)
        os.dup2(captured.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            captured.seek(0)
            # A full disk or a closed stream is not an error of the device.
            with suppress(OSError):
                os.write(2, b"".join(line for line in captured if _NO_DRIVER not in line))


def kernels_are_compiled() -> bool:
    """Return True if Warp's cache contains kernels of this package. Call ``use_device`` first."""
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
    """Run ``kernel`` over rows 0 .. ``row_count`` - 1, on a CPU with several threads.

    The kernel's first parameter must be ``first_row: wp.int32`` and its row ``first_row + wp.tid()``. Each row may
    write only its own outputs, so that the result does not depend on the distribution of rows.

    Args:
        kernel: the Warp kernel.
        row_count: number of rows.
        inputs: inputs after ``first_row``.
        outputs: outputs.
        device: device of the launch.
        threads: number of threads on a CPU; default: the available cores.
        work: (row_count,) expected cost of each row in any unit, for expensive rows; None if all rows are equally
            cheap.
    """
    if not device.is_cpu:
        launch_cached(kernel, row_count, inputs=[0, *inputs], outputs=outputs, device=device)
        return
    threads = threads or available_threads()
    edges = _chunk_edges(row_count, threads, work)
    if threads == 1 or len(edges) < 3:
        wp.launch(kernel, dim=row_count, inputs=[0, *inputs], outputs=list(outputs), device=device)
        return
    # Each thread that launches a module that is not loaded yet would compile it.
    kernel.module.load(device, block_dim=1)
    chunks = iter(list(pairwise(edges)))

    def launch_chunks() -> None:
        launch: Any = None
        # Each idle thread takes the next chunk. The arguments are packed only once for each thread.
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
        # No chunks are left for tasks that have not started, so ``wait`` cancels them.
        for task in tasks:
            task.wait()
    for task in tasks:
        task.result()


class _LaunchCache(threading.local):
    """Launch commands that the current thread has recorded, which are repeated with new arguments."""

    def __init__(self) -> None:
        self.launches: dict[tuple[Any, str], tuple[Any, int | tuple[int, ...], list[Any]]] = {}


_launch_cache = _LaunchCache()


def launch_cached(
    kernel: Any, dim: int | tuple[int, ...], *, inputs: Sequence[Any], outputs: Sequence[Any], device: wp.Device
) -> None:
    """Launch a kernel at a third of the cost of ``wp.launch``; for kernels that are launched many times a second.

    Each thread records its first launch; later launches replace only the arguments that have changed, without a check
    of their types. A struct or vector that is the same object as before may have new contents.
    """
    launches = _launch_cache.launches
    command, command_dim, arguments = launches.get((kernel, device.alias), (None, -1, []))
    if command is None:
        command = wp.launch(kernel, dim, inputs=list(inputs), outputs=list(outputs), device=device, record_cmd=True)
        # Warp returns None for an empty launch.
        if command is None:
            return
        # Release the arguments that the recorded launch holds in addition to the packed ones.
        command.fwd_args = None  # pyright: ignore[reportAttributeAccessIssue]  # guessed from a list
        arguments = [_UNKNOWN] * (len(inputs) + len(outputs))
        launches[kernel, device.alias] = command, dim, arguments
    else:
        if dim != command_dim:
            command.set_dim(dim)
            launches[kernel, device.alias] = command, dim, arguments
        for i, value in enumerate((*inputs, *outputs)):
            last = arguments[i]
            if last is value:
                continue
            if isinstance(value, wp.array):
                # Use a weak reference, so that the cache does not keep the memory of the array allocated.
                if type(last) is not weakref.ref or last() is not value:
                    command.set_param_at_index_from_ctype(i, value.__ctype__())
                    arguments[i] = weakref.ref(value)
            elif isinstance(value, (int, float)):  # A union takes longer.
                if type(last) is not type(value) or last != value:
                    command.set_param_at_index_from_ctype(i, value)
                    arguments[i] = value
            else:
                command.set_param_at_index(i, value)
                arguments[i] = value
    if command.bounds.size > 0:
        command.launch()


def lanes_on(device: wp.Device) -> int:
    """Return the number of threads that compute a row together: 32 (a warp) on a GPU, one on a CPU."""
    return 1 if device.is_cpu else 32


_UNKNOWN = object()
"""Marker of an argument that has not been set."""


def _chunk_edges(row_count: int, threads: int, work: np.ndarray | None) -> list[int]:
    """Return the boundaries of the chunks. The cost of the chunks decreases towards the end, so that all threads finish
    at about the same time."""
    min_share = 0.0 if work is not None else _MIN_ROWS_PER_CHUNK / max(row_count, 1)
    min_share = max(min_share, 1.0 / (_LAST_CHUNKS_PER_THREAD * threads))
    shares, total = [], 0.0
    while threads > 1 and total + min_share < 1.0:
        total += max((1.0 - total) / (2 * threads), min_share)
        shares.append(total)
    if work is None:
        inner = np.array(shares) * row_count
    else:
        cumulative = np.concatenate([[0.0], np.cumsum(np.asarray(work, dtype=np.float64) + 1e-3)])
        inner = np.searchsorted(cumulative, np.array(shares) * cumulative[-1])
    return np.unique(np.concatenate([[0], inner, [row_count]]).astype(int)).tolist()


def thread_local_cache(max_entries: int) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Return a decorator that caches a function's results, in an LRU cache of ``max_entries`` for each thread.

    Threads do not share a cache, because the cached objects are writable buffers.
    """

    def decorate(make: Callable[..., T]) -> Callable[..., T]:
        local = threading.local()

        def cached(*arguments: Any) -> T:
            if not hasattr(local, "make"):
                local.make = lru_cache(maxsize=max_entries)(make)
            return local.make(*arguments)

        return cached

    return decorate


def run_concurrently(first: Callable[[], T], second: Callable[[], U]) -> tuple[T, U]:
    """Run both functions, ``second`` in a worker thread if one is idle, and return their results."""
    if available_threads() == 1:
        return first(), second()
    task = worker_threads().begin(second)
    try:
        return first(), task.result()
    except BaseException:
        # Wait, because after an error the caller may reuse the memory of ``second``.
        task.wait()
        raise


@cache
def warp_stream(stream: Any) -> wp.Stream:
    """Return Warp's wrapper of a PyTorch ``stream``, cached forever.

    PyTorch has few streams and never frees them. When a wrapper is deleted, Warp frees its resources of the stream,
    even if another wrapper of the stream exists.
    """
    return wp.stream_from_torch(stream)


def device_of(array: wp.array) -> wp.Device:
    """Return the device of ``array``. Its type in Warp includes None, which occurs only for arrays in annotations."""
    device: Any = array.device
    return device


def empty(shape: Shape, dtype: Any, device: Device, *, pinned: bool = False) -> wp.array:
    """Return an uninitialized array; ``pinned`` makes host memory page-locked.

    This function exists because Warp's stub accepts only Python's ``float`` as ``dtype``.
    """
    return wp.empty(shape, dtype=dtype, device=device, pinned=pinned)


def shared_zeros(shape: Shape) -> tuple[np.ndarray, wp.array]:
    """Return float64 zeros on the host as a NumPy array and a Warp array that share their memory."""
    values = np.zeros(shape)
    return values, wp.array(values, dtype=wp.float64, device="cpu", copy=False)


def empty_pooled(device: Device, *specs: tuple[Shape, Any]) -> list[wp.array]:
    """Return uninitialized arrays that share one allocation; ``specs`` contains the shape and type of each.

    An allocation on a GPU is expensive compared to rendering a small image. The next call with the same ``specs`` on
    the same stream therefore reuses arrays without remaining references. Allocate arrays of equal lifetime together:
    the memory is freed with the last of them.
    """
    device = wp.get_device(device)
    cache = _free_list.entries
    key = (device.alias, device.stream.cuda_stream if device.is_cuda else None, specs)
    groups = cache.get(key, [])
    for arrays in groups:
        if _max_references(arrays) == _UNREFERENCED:
            cache.move_to_end(key)
            return list(arrays)
    starts, total = [], 0
    for shape, dtype in specs:
        starts.append(total)
        count = shape if isinstance(shape, int) else math.prod(shape)
        total += -(-count * wp.types.type_size_in_bytes(dtype) // _ALIGNMENT) * _ALIGNMENT
    if device.is_cuda:
        _raise_release_threshold(device.alias)
    # The allocation is two-dimensional, because the length of a dimension must be below 2^31.
    memory = empty((max(total // _ALIGNMENT, 1), _ALIGNMENT), wp.uint8, device)
    arrays = []
    for (shape, dtype), start in zip(specs, starts, strict=True):
        assert memory.ptr is not None
        array = wp.array(ptr=memory.ptr + start, dtype=dtype, shape=shape, device=memory.device)
        array._ref = memory
        arrays.append(array)
    if 0 < total <= _MAX_POOLED_BYTES:
        cache[key] = [*groups[1 - _MAX_POOLED_GROUPS :], arrays]
        cache.move_to_end(key)
        while len(cache) > _MAX_POOLED_KEYS:
            cache.popitem(last=False)
    return list(arrays)


@cache
def _raise_release_threshold(alias: str) -> None:
    """Make Warp's memory pool retain some free memory.

    By default, CUDA releases all free memory at every synchronization. Mapping it again takes as long as rendering a
    small scene.
    """
    device = wp.get_device(alias)
    threshold = device.total_memory // _RETAINED_MEMORY_DIVISOR
    if device.is_mempool_enabled and wp.get_mempool_release_threshold(device) < threshold:
        wp.set_mempool_release_threshold(device, threshold)


_RETAINED_MEMORY_DIVISOR = 32
"""Divisor of the total memory of a GPU; the pool retains the resulting number of bytes."""


def _max_references(arrays: list[wp.array]) -> int:
    return max(map(sys.getrefcount, arrays))


_UNREFERENCED = max(map(sys.getrefcount, [object()]))
"""Result of ``_max_references`` for arrays to which only the list refers."""
_MAX_POOLED_BYTES, _MAX_POOLED_KEYS, _MAX_POOLED_GROUPS = 2**25, 16, 4
"""Maximum size of a reusable allocation, bytes; maximum number of different specifications; and maximum number of
allocations per specification."""


class _FreeList(threading.local):
    """Allocations of ``empty_pooled`` that the current thread can reuse, least recently used first."""

    def __init__(self) -> None:
        self.entries: OrderedDict[Any, list[list[wp.array]]] = OrderedDict()


_free_list = _FreeList()


def round_up(count: int, step: int) -> int:
    """Return the smallest positive multiple of ``step`` that is not less than ``count``."""
    return -(-max(count, 1) // step) * step


def grow_capacity(count: int) -> int:
    """Round ``count`` up by at most a quarter, so that similar counts use arrays of one size."""
    step = 1 << max(count.bit_length() - 3, 0)
    return -(-max(count, 1) // step) * step


def copy_into(target: wp.array, values: np.ndarray) -> None:
    """Copy ``values`` into ``target``, which has the same shape and type; on a CPU, NumPy copies them, which is
    faster."""
    if device_of(target).is_cpu:
        np.copyto(target.numpy(), values)
    else:
        target.assign(np.ascontiguousarray(values, dtype=np.float64))


class PinnedMirror:
    """Page-locked host copy of an ``array`` for frequent transfers, which are faster than ``array.numpy`` and
    ``array.assign``.

    For an array on a CPU, the copy is the array itself.
    """

    def __init__(self, array: wp.array) -> None:
        self.array, self._device, self._host = array, device_of(array), array
        if not self._device.is_cpu:
            self._host = wp.zeros(array.shape, array.dtype, "cpu", pinned=True)
        self._values = self._host.numpy()
        self._sent: wp.Event | None = None

    def put(self, values: np.ndarray) -> None:
        """Upload ``values``, which have the size of the array. Nothing else may write to the array."""
        values = values.reshape(self._values.shape)
        if self._sent is not None:
            if np.array_equal(values, self._values):
                return
            # The previous upload may still be in flight.
            wp.synchronize_event(self._sent)
        np.copyto(self._values, values)
        if not self._device.is_cpu:
            wp.copy(self.array, self._host)
            self._sent = wp.get_stream(self._device).record_event(self._sent)

    def get(self) -> np.ndarray:
        """Download the array and return a copy."""
        return self.get_all(self)[0]

    @staticmethod
    def get_all(*mirrors: PinnedMirror) -> list[np.ndarray]:
        """Download the arrays of ``mirrors`` on one device with one synchronization and return copies."""
        device = mirrors[0]._device
        if not device.is_cpu:
            for mirror in mirrors:
                wp.copy(mirror._host, mirror.array)
            wp.synchronize_stream(device)
        return [mirror._values.copy() for mirror in mirrors]


def zeros(shape: Shape, dtype: Any, device: Device) -> wp.array:
    """Return an array of zeros."""
    return wp.zeros(shape, dtype=dtype, device=device)
