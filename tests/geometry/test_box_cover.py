"""Covers of occupied cells by boxes."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from egs_warp.geometry.box_cover import cover_with_boxes


def painted(shape: tuple[int, int, int], boxes: np.ndarray) -> np.ndarray:
    cells = np.zeros(shape, bool)
    for low, high in boxes:
        cells[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    return cells


def test_boxes_of_an_angle_overlap_at_the_corner() -> None:
    """An L of two bars: each box runs the whole length of its bar, so no face lies inside the solid."""
    occupied = np.zeros((20, 20, 6), bool)
    occupied[:, :4] = occupied[:4, :] = True
    cover = cover_with_boxes(occupied, max_boxes=8)
    assert cover.share == 1.0 and len(cover.boxes) == 2
    assert {tuple(each) for each in (cover.boxes[:, 1] - cover.boxes[:, 0]).tolist()} == {(20, 4, 6), (4, 20, 6)}
    assert np.array_equal(painted(occupied.shape, cover.boxes), occupied)


def test_the_number_of_boxes_is_limited_and_the_share_is_reported() -> None:
    occupied = np.zeros((30, 3, 3), bool)
    occupied[::6] = occupied[1::6] = True
    cover = cover_with_boxes(occupied, max_boxes=2)
    assert len(cover.boxes) == 2 and cover.share == 0.4
    assert cover_with_boxes(np.zeros((3, 3, 3), bool), max_boxes=2).share == 1.0


corners = st.tuples(*[st.integers(0, 9)] * 3)


@given(st.lists(st.tuples(corners, corners), min_size=1, max_size=4))
def test_a_union_of_boxes_is_covered_and_little_else(given_boxes: list[tuple[tuple[int, ...], ...]]) -> None:
    boxes = np.array([(np.minimum(a, b), np.maximum(a, b) + 3) for a, b in given_boxes])
    occupied = painted((13, 13, 13), boxes)
    cover = cover_with_boxes(occupied, max_boxes=30)
    covered = painted(occupied.shape, cover.boxes)
    assert cover.share == (covered & occupied).sum() / occupied.sum() >= 0.9
    assert (covered & ~occupied).sum() <= 0.25 * occupied.sum()
