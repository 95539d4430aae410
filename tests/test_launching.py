"""Launches and memory: partition of rows among threads, repeated launches, pooled arrays, caches and mirrors."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

from egs_warp.launching import (
    THREADS,
    PinnedMirror,
    available_threads,
    empty_pooled,
    grow_capacity,
    launch_cached,
    launch_rows,
    reserve_core,
    run_concurrently,
    thread_local_cache,
)


@wp.kernel
def scaled_kernel(
    first: wp.int32,
    # In:
    values: wp.array[wp.float32],
    factor: wp.float32,
    offset: wp.vec3,
    extra: wp.array[wp.float32],
    # Out:
    result_out: wp.array[wp.vec3],
):
    i = wp.tid() + first
    more = wp.float32(0.0)
    if extra.shape[0] > 0:
        more = extra[i]
    result_out[i] = offset + wp.vec3(1.0, 1.0, 1.0) * (values[i] * factor + more)  # pyright: ignore[reportIndexIssue]


def expected(values: np.ndarray, factor: float, offset: tuple, extra: np.ndarray | None) -> np.ndarray:
    line = values * factor + (0 if extra is None else extra)
    return np.asarray(offset) + line[:, None]


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.parametrize("count", [0, 1, 7, 20_011])
def test_every_row_runs_once(device: str, threads: int, heavy: bool, count: int) -> None:
    random = np.random.default_rng(count)
    values = random.normal(size=count)
    array = wp.array(values, dtype=wp.float32, device=device)
    result = wp.full(count, 7.0, dtype=wp.vec3, device=device)
    launch_rows(
        scaled_kernel,
        count,
        inputs=[array, 2.0, wp.vec3(1.0, 2.0, 3.0), None],
        outputs=[result],
        device=wp.get_device(device),
        threads=threads,
        work=random.uniform(0, 1, count) if heavy else None,
    )
    np.testing.assert_allclose(result.numpy().reshape(-1, 3), expected(values, 2.0, (1, 2, 3), None), atol=1e-5)


def test_a_cached_launch_takes_its_new_arguments(device: str) -> None:
    """Sizes, arrays, empty arrays, numbers and vectors change between launches, in two threads at the same time."""
    target = wp.get_device(device)

    def run(seed: int) -> None:
        random = np.random.default_rng(seed)
        for _ in range(30):
            count = int(random.integers(0, 40))
            values, extra = random.normal(size=count), random.normal(size=count) if random.random() < 0.5 else None
            factor, offset = float(random.normal()), tuple(random.normal(size=3))
            result = wp.zeros(max(count, 1), dtype=wp.vec3, device=target)
            launch_cached(
                scaled_kernel,
                count,
                inputs=[
                    *(0, wp.array(values, dtype=wp.float32, device=target), factor, wp.vec3(*offset)),
                    None if extra is None else wp.array(extra, dtype=wp.float32, device=target),
                ],
                outputs=[result],
                device=target,
            )
            np.testing.assert_allclose(result.numpy()[:count], expected(values, factor, offset, extra), atol=1e-5)

    launch_cached(
        scaled_kernel,
        1,
        inputs=[0, wp.zeros(1, dtype=wp.float32, device=target), 1.0, wp.vec3(), None],
        outputs=[wp.zeros(1, dtype=wp.vec3, device=target)],
        device=target,
    )
    # Warp switches to another stream for a copy; concurrent copies in two threads may leave it on that stream.
    stream = target.stream if target.is_cuda else None
    with wp.ScopedStream(stream, sync_enter=False), ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(run, seed) for seed in (1, 2)]:
            done.result()


def test_arrays_in_one_piece_of_memory_do_not_touch_and_keep_it(device: str) -> None:
    wanted = [(7, wp.vec3), ((3, 5), wp.float32), (0, wp.vec4), (1, wp.int64), ((2, 2), wp.vec4)]
    pieces = empty_pooled(device, *wanted)
    for number, (piece, (shape, dtype)) in enumerate(zip(pieces, wanted, strict=True)):
        assert piece.shape == (shape if isinstance(shape, tuple) else (shape,))
        assert piece.dtype is dtype and piece.is_contiguous and (piece.ptr or 0) % 16 == 0
        piece.fill_(number + 1)
    one = pieces[1]
    del pieces, piece
    # The memory of all arrays of the pool is freed only when this last one is released.
    others = [wp.full(64, 9.0, dtype=wp.float32, device=device) for _ in range(50)]
    assert len(others) == 50 and (one.numpy() == 2).all()


def test_released_arrays_are_reused(device: str) -> None:
    wanted = [(11, wp.vec3), (4, wp.float32)]
    first = empty_pooled(device, *wanted)
    places = [piece.ptr for piece in first]
    assert empty_pooled(device, *wanted)[0].ptr not in places
    view = first[1].numpy() if device == "cpu" else pytest.importorskip("torch").as_tensor(first[1], device="cuda")
    del first
    # A view by another library also keeps the memory allocated.
    assert empty_pooled(device, *wanted)[0].ptr not in places
    del view
    second, third = empty_pooled(device, *wanted), empty_pooled(device, *wanted)
    assert places in ([piece.ptr for piece in pieces] for pieces in (second, third))
    assert second[0].ptr != third[0].ptr


def test_capacities_are_few_and_not_much_larger() -> None:
    sizes = [grow_capacity(count) for count in range(1, 100_000)]
    assert all(count <= size <= max(1.25 * count, count + 1) for count, size in enumerate(sizes, 1))
    assert len(set(sizes)) < 100


@pytest.mark.parametrize(("told", "most"), [("1", 1), ("0", 1), ("100000", None), ("", None), ("two", None)])
def test_the_environment_may_limit_the_threads(told: str, most: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of threads is at least one, and at most the number that is available."""
    monkeypatch.delenv(THREADS, raising=False)
    there = available_threads()
    monkeypatch.setenv(THREADS, told)
    assert available_threads() == (most or there)


@pytest.mark.parametrize(
    ("cores", "told", "used"), [(4, "", 3), (2, "", 1), (1, "", 1), (4, "4", 4), (4, "2", 2), (4, "9", 4)]
)
def test_a_core_is_reserved(cores: int, told: str, used: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within the block, one core is reserved if there are several and the environment sets no number of threads; nested
    blocks reserve more."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(cores)), raising=False)
    monkeypatch.setenv(THREADS, told)
    before = available_threads()
    with pytest.raises(ValueError, match=r"^over$"), reserve_core():
        assert available_threads() == used
        with reserve_core():
            assert available_threads() == (used if told else max(1, cores - 2))
        assert available_threads() == used
        raise ValueError("over")
    assert available_threads() == before


@pytest.mark.parametrize("told", ["1", ""])
def test_concurrent_tasks_on_one_thread_run_in_sequence(told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(THREADS, told)
    used = run_concurrently(threading.get_ident, lambda: (threading.get_ident(), 7))
    assert used[0] == threading.get_ident() and used[1][1] == 7
    assert told == "" or used[1][0] == used[0]


def test_an_error_waits_for_the_concurrent_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error is raised after the concurrent task has ended, so that the data of both tasks can be reused."""
    monkeypatch.setenv(THREADS, "2")
    begun, ended = threading.Event(), threading.Event()

    def first() -> None:
        assert begun.wait(10.0)
        raise ValueError("over")

    def second() -> None:
        begun.set()
        time.sleep(0.05)
        ended.set()

    with pytest.raises(ValueError, match="over"):
        run_concurrently(first, second)
    assert ended.is_set()


def test_each_thread_has_its_own_cache() -> None:
    """Each thread has its own cache, which keeps the most recent results by their arguments."""
    make = thread_local_cache(2)(lambda *given: [*given])
    first = make(1, 2)
    assert first == [1, 2] and make(1, 2) is first and make(2, 1) is not first
    assert make(3) == [3] and make(1, 2) is not first
    own, others = make(1, 2), []
    thread = threading.Thread(target=lambda: others.append(make(1, 2)))
    thread.start()
    thread.join()
    assert others == [own] and others[0] is not own and make(1, 2) is own


def test_mirrors_transfer_the_current_values(device: str) -> None:
    """The values that are transferred are correct, whether they are unchanged, NaN, or changed on the device since the
    last read-back."""
    arrays = [wp.zeros(3, dtype=wp.float64, device=device) for _ in range(2)]
    one, other = mirrors = [PinnedMirror(array) for array in arrays]
    for values in ([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [0.0, np.nan, 3.0], [0.0, np.nan, 3.0], [0.0, 0.0, 0.0]):
        one.put(np.array(values))
        np.testing.assert_array_equal(arrays[0].numpy(), values)
        arrays[1].fill_(values[0] + 7.0)
        got = PinnedMirror.get_all(*mirrors)
        np.testing.assert_array_equal(got[0], values)
        np.testing.assert_array_equal(got[1], 3 * [values[0] + 7.0])
        np.testing.assert_array_equal(other.get(), got[1])
