"""Convergence rule of Newton steps, which is the same on the host, in a loop on a GPU and for many worlds (Eq. 4,
8)."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from egs_warp.contact.coulomb import FAILURE_TOLERANCE
from egs_warp.contact.newton_convergence import NewtonProgress
from egs_warp.kernels.contact import newton_convergence as kernels
from egs_warp.precision import real

UNIT = 2.5
Trial = tuple[float, float, float]
"""Outcome of a trial: residual, violation of Coulomb's law in m/s, and number of penetrating points."""


def first(*, activation: float = 1e-3, coulomb: float = 1e-7, max_steps: int = 60) -> NewtonProgress:
    return NewtonProgress(1e-8, activation, coulomb, max_steps=max_steps)


def after(*residuals: float) -> NewtonProgress:
    progress = first()
    progress.begin(0.5)
    for residual in residuals:
        progress.judge(residual, 0.0)
    return progress


def run_loop(
    starts: list[NewtonProgress], trials: list[list[Trial]], device: str, *, enabled: int = 1
) -> tuple[list[int], np.ndarray]:
    """Run the loop's kernels on prescribed trials, each world until its loop condition is 0.

    Returns:
        The number of trials of each world, and the progress at the end (B, ROW_SIZE).
    """
    rows = np.stack([start.row for start in starts])
    rows[:, kernels.UNIT] = UNIT
    count = len(starts)
    progress, running = wp.array(rows, dtype=real, device=device), wp.zeros(count, dtype=int, device=device)
    wp.launch(
        kernels.begin_loop_kernel,
        count,
        inputs=[
            wp.full(count, enabled, dtype=int, device=device),
            wp.full(count, real(0.5 * UNIT), dtype=real, device=device),
        ],
        outputs=[progress, running],
        device=device,
    )
    made, rows = [0] * count, progress.numpy().copy()
    for number in range(max(map(len, trials))):
        before, is_running = rows, running.numpy() > 0
        values = np.array([each[min(number, len(each) - 1)] for each in trials])
        parts = [
            wp.array(part, dtype=real, device=device) for part in (UNIT * values[:, 0], values[:, 1], values[:, 2])
        ]
        wp.launch(
            kernels.judge_steps_kernel, count, inputs=[FAILURE_TOLERANCE, *parts], outputs=[progress, running],
            device=device,
        )  # fmt: skip
        rows = np.where(is_running[:, None], progress.numpy(), before)
        progress = wp.array(rows, dtype=real, device=device)
        running = wp.array(np.where(is_running, running.numpy(), 0), dtype=int, device=device)
        made = [n + bool(each) for n, each in zip(made, is_running, strict=True)]
    return made, rows


def plain(*residuals: float) -> list[Trial]:
    return [(residual, 0.0, 0.0) for residual in residuals]


@pytest.mark.parametrize(
    ("start", "trials", "made", "outcome"),
    [
        (first(), plain(0.1, 0.01, 1e-4, 1e-6, 1e-9, 1e-12), 5, kernels.ACCEPTED | kernels.ENDED | kernels.NEAR_END),
        # The first step may increase the residual; a later one must reduce it sufficiently.
        (first(), plain(3.0, 2.9, 0.1), 2, kernels.ACCEPTED | kernels.NEEDS_TANGENT),
        (first(), plain(3.0, 2.0, 0.1), 3, kernels.ACCEPTED),
        (first(), plain(0.1, np.nan, 0.1), 2, kernels.SHORTEN),
        (first(), plain(np.inf, 0.1), 1, kernels.SHORTEN),
        (first(), [(0.1, 0.0, 0.0), (0.01, 0.0, 3.0), (5e-4, 0.0, 2.0), (1e-5, 0.0, 0.0)], 3,
         kernels.ACCEPTED | kernels.NEAR_END),
        (first(), [(0.1, 0.0, 0.0), (5e-4, 0.0, 0.0), (1e-5, 0.0, 2.0), (1e-6, 0.0, 0.0)], 4, kernels.ACCEPTED),
        (first(activation=-1.0), [(0.1, 0.0, 0.0), (5e-4, 0.0, 2.0), (1e-5, 0.0, 0.0)], 3, kernels.ACCEPTED),
        (first(activation=-1.0), plain(0.1, 1e-9, 1e-12), 2, kernels.ACCEPTED | kernels.ENDED),
        (first(), [(0.1, 2.0 * FAILURE_TOLERANCE, 0.0), (0.01, 0.0, 0.0)], 1, kernels.REPEAT),
        (first(coulomb=0.1 * FAILURE_TOLERANCE), [(0.1, 0.5 * FAILURE_TOLERANCE, 0.0), (0.01, 0.0, 0.0)], 1,
         kernels.ACCEPTED | kernels.NEEDS_TANGENT),
        (first(max_steps=2), plain(0.1, 0.01, 1e-3, 1e-4), 2, kernels.ACCEPTED),
        (after(0.2, 0.1, 0.09), plain(0.06, 0.04, 1e-9), 3, kernels.ACCEPTED | kernels.ENDED | kernels.NEAR_END),
        (after(0.3, 0.02), plain(0.3, 1e-9), 1, kernels.SHORTEN),
    ],
)  # fmt: skip
def test_a_loop_makes_the_trials_that_do_not_need_the_host(
    start: NewtonProgress, trials: list[Trial], made: int, outcome: int, device: str
) -> None:
    found, rows = run_loop([start], [trials], device)
    assert found == [made] and int(rows[0, kernels.OUTCOME]) == outcome
    counted = made - bool(outcome & (kernels.SHORTEN | kernels.REPEAT))
    assert int(rows[0, kernels.STEPS]) == start.steps + counted


def test_worlds_are_judged_independently_and_as_on_the_host(device: str) -> None:
    """The residuals increase or decrease at random; the loops start from the progress of an unfinished iteration."""
    random = np.random.default_rng(0)
    starts, trials = [], []
    for _ in range(100):
        start = first(max_steps=int(random.integers(6, 20)))
        start.begin(0.45)
        for _ in range(random.integers(0, 5)):
            start.judge(float(random.uniform(0.3, 0.6)) if random.random() < 0.8 else np.nan, 0.0)
        starts.append(start)
        falls = (0.45 * random.lognormal(-0.4, 0.5, 12)).cumprod()
        trials.append([(float(size), 0.0, float(random.integers(0, 2))) for size in falls])
    made, rows = run_loop(starts, trials, device)
    for start, steps, count, row in zip(starts, trials, made, rows, strict=True):
        for residual, violation, _ in steps[:count]:
            start.judge(residual, violation)
        row[kernels.UNIT] = 1.0
        np.testing.assert_allclose(row, start.row, rtol=1e-14)
    assert len(set(made)) > 5


def test_a_line_search_halves_the_step_until_it_fails_twice() -> None:
    """If no acceptable point is found, the tangent is updated; if the tangent was already evaluated at the iterate, the
    step fails."""
    progress = after(0.1)
    lengths = [progress.length]
    progress.judge(0.2, 0.0)
    while progress.has(kernels.SHORTEN):
        lengths.append(progress.length)
        progress.judge(0.2, 0.0)
    np.testing.assert_allclose(lengths, 0.5 ** np.arange(len(lengths)))
    assert kernels.MIN_STEP_LENGTH < lengths[-1] <= 2.0 * kernels.MIN_STEP_LENGTH
    assert progress.has(kernels.NEEDS_TANGENT) and not progress.has(kernels.FAILED) and progress.steps == 2
    progress.renew_tangent()
    progress.judge(0.2, 0.0)
    while progress.has(kernels.SHORTEN):
        progress.judge(0.2, 0.0)
    assert progress.has(kernels.FAILED) and progress.length == 1.0


def test_a_shortened_step_is_accepted_but_does_not_end() -> None:
    progress = after(0.1)
    progress.judge(np.inf, 0.0)
    progress.judge(1e-12, 0.0)
    assert progress.has(kernels.ACCEPTED) and progress.has(kernels.NEEDS_TANGENT) and not progress.has(kernels.ENDED)


def test_more_than_three_violations_of_coulombs_law_fail() -> None:
    progress = first()
    progress.begin(0.5)
    failed = []
    for residual in (0.1, 0.01, 1e-3, 1e-4):
        progress.judge(residual, 1e-3)
        failed.append(progress.has(kernels.FAILED))
    assert failed == [False, False, False, True]


def test_a_search_does_not_continue_from_failures(device: str) -> None:
    made, rows = run_loop([first()], [plain(0.1)], device, enabled=0)
    assert made == [0] and rows[0, kernels.OUTCOME] == 0.0
