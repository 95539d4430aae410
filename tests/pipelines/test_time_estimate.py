"""Estimate of the number of frames of a simulation, for the progress bar: within a factor of two."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.locomotion.rollout import REST_FRAMES
from egs_warp.motions.script import motion
from egs_warp.pipelines.simulated_run import simulate
from tests.support.live_sessions import coarse_pawn

NEAR = 20
"""Number of frames at the end for which the estimate is not tested."""


def _estimates(text: str, frames: int | None = None) -> np.ndarray:
    """Return the numbers of finished and of expected frames (n, 2) after each frame of a simulation."""
    estimates: list[tuple[int, int]] = []
    simulate(
        coarse_pawn(), motion(text), frames=frames, progress=lambda done, expected: estimates.append((done, expected))
    )
    assert [done for done, _ in estimates] == list(range(1, len(estimates) + 1))
    return np.array(estimates)


@pytest.mark.slow
@pytest.mark.parametrize("text", ["jump", "hop x2 0.4 0.2", "twist 60", "twist 180", "walk 0.2", "jump 0 0.1, turn 30"])
def test_the_estimate_is_within_a_factor_of_two(text: str) -> None:
    """The estimate of the remaining frames is within a factor of two, except for the last ``NEAR`` frames. A twist
    decides only in the air whether it needs another jump."""
    done, expected = _estimates(text).T
    count = len(done)
    far = done < count - NEAR
    ratio = (expected - done)[far] / (count - done)[far]
    assert ratio.min() >= 0.5 and ratio.max() <= 2.0
    # In the last frames, in which the body is at rest, the expected number of frames is the actual one.
    assert (expected[-REST_FRAMES:] == count).all()
    # The estimate is better than the maximum number of frames.
    assert motion(text).frames() > 1.2 * count


def test_requested_frames_are_the_estimate() -> None:
    """With 4 requested frames, 3 are expected to be simulated, because the first one shows the body at rest."""
    np.testing.assert_array_equal(_estimates("jump", frames=4)[:, 1], 3)
