"""Rows shared out between threads, and launches made again with other arguments."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

from egs_warp.launching import launch_again, launch_rows


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


def test_a_launch_made_again_takes_its_new_arguments(device: str) -> None:
    """Sizes, arrays, empty arrays, numbers and vectors all change between launches, in two threads at once."""
    target = wp.get_device(device)

    def run(seed: int) -> None:
        random = np.random.default_rng(seed)
        for _ in range(30):
            count = int(random.integers(0, 40))
            values, extra = random.normal(size=count), random.normal(size=count) if random.random() < 0.5 else None
            factor, offset = float(random.normal()), tuple(random.normal(size=3))
            result = wp.zeros(max(count, 1), dtype=wp.vec3, device=target)
            launch_again(
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

    launch_again(
        scaled_kernel,
        1,
        inputs=[0, wp.zeros(1, dtype=wp.float32, device=target), 1.0, wp.vec3(), None],
        outputs=[wp.zeros(1, dtype=wp.vec3, device=target)],
        device=target,
    )
    with ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(run, seed) for seed in (1, 2)]:
            done.result()
