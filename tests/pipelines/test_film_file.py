"""Frames of a contact sheet: spread over time and motion, so that a body at rest takes few cells."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.pipelines.film_file import SHEET_FRAMES, sheet_frames


def _moved(*speeds: float) -> np.ndarray:
    """Return positions (F, 1, 3) of a point that moves along x by the ``speeds`` from state to state."""
    positions = np.zeros((len(speeds) + 1, 1, 3))
    positions[1:, 0, 0] = np.cumsum(speeds)
    return positions


def test_a_body_at_rest_takes_few_cells() -> None:
    """A third of the time at rest takes a sixth of the intervals; without motion, the frames are even in time."""
    moving = sheet_frames(_moved(*[1.0] * 80, *[0.0] * 40), np.arange(121))
    assert moving[0] == 0 and moving[-1] == 120 and (np.diff(moving) > 0).all()
    assert np.count_nonzero(moving > 80) == 2
    still = sheet_frames(_moved(*[0.0] * 110), np.arange(111))
    np.testing.assert_array_equal(still, np.arange(0, 111, 10))


@pytest.mark.parametrize("count", [1, 2, 5, SHEET_FRAMES, SHEET_FRAMES + 1, 40])
def test_no_frame_is_shown_twice(count: int) -> None:
    """Also if the whole motion takes place between two frames."""
    speeds = np.zeros(2 * count)
    speeds[count // 2] = 1.0
    frames = sheet_frames(_moved(*speeds), 2 * np.arange(count))
    assert len(frames) == len(set(frames)) == min(count, SHEET_FRAMES)
    assert frames.min() >= 0 and frames.max() <= count - 1
