"""Detection of stains that the shadow and the foot of an object leave on the floor."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.inpainting.stains import shaded, stain_around

SIDE = 240
ROWS, COLUMNS = np.indices((SIDE, SIDE))
AWAY = np.hypot(ROWS - SIDE / 2, COLUMNS - SIDE / 2)
HOLE = AWAY < 30


def weave() -> np.ndarray:
    """Return a cloth of fine threads."""
    threads = 0.5 + 0.1 * np.sin(ROWS) * np.sin(COLUMNS)
    return np.stack([threads, 0.8 * threads, threads], axis=-1)


def test_a_shadow_next_to_the_hole_is_the_only_stain():
    shadow = (np.abs(ROWS - SIDE / 2) < 20) & (COLUMNS > SIDE / 2) & (COLUMNS < SIDE / 2 + 55)
    found = stain_around(HOLE, ~HOLE, np.where(shadow[..., None], 0.5, 1.0) * weave())
    inner, outer = shadow & ~HOLE, (AWAY < 70) & (np.abs(ROWS - SIDE / 2) < 24) & (COLUMNS > SIDE / 2)
    assert found[inner].mean() > 0.9
    assert not found[~outer].any()
    assert not found[HOLE].any()


def test_a_stain_in_one_channel_counts():
    brown = (AWAY < 40)[..., None] & np.array([False, False, True])
    found = stain_around(HOLE, ~HOLE, np.where(brown, 0.3, 1.0) * weave())
    assert found[(AWAY > 31) & (AWAY < 38)].all()


def test_light_that_changes_slowly_is_no_stain():
    light = np.exp(-1.2 * COLUMNS / SIDE)[..., None]
    assert not stain_around(HOLE, ~HOLE, light * weave()).any()


@pytest.mark.parametrize("width", [8, 20])
def test_a_pattern_is_no_stain(width: int):
    board = ((ROWS // width + COLUMNS // width) % 2).astype(float)[..., None]
    assert not stain_around(HOLE, ~HOLE, 0.2 + 0.6 * board * np.ones(3)).any()


def test_the_darkest_squares_of_a_checked_cloth_are_no_stain():
    """A quarter of the cloth is dark, so that a robust estimate of the standard deviation is too small."""
    stripes = [(axis // 24) % 2 for axis in (ROWS, COLUMNS)]
    cloth = (1.0 - 0.3 * stripes[0] * stripes[1])[..., None] * weave()
    assert not stain_around(HOLE, ~HOLE, cloth).any()


def test_a_seam_that_continues_is_no_stain():
    """A seam between planks begins at the hole and continues beyond."""
    wide = np.indices((360, 360))
    hole = np.hypot(*(wide - 180)) < 50
    seam = (np.abs(wide[1] - 180) < 8) & (np.abs(wide[0] - 180) < 140)
    planks = (
        np.where(seam[..., None], 0.3, 1.0) * (0.5 + 0.1 * np.sin(wide[0]) * np.sin(wide[1]))[..., None] * np.ones(3)
    )
    assert not stain_around(hole, ~hole, planks).any()


def test_a_dark_place_apart_from_the_hole_stays():
    apart = np.hypot(ROWS - SIDE / 2, COLUMNS - SIDE / 2 - 55) < 10
    assert not stain_around(HOLE, ~HOLE, np.where(apart[..., None], 0.4, 1.0) * weave()).any()


def test_a_region_larger_than_twice_the_hole_is_another_floor():
    mat = AWAY < 75
    assert mat.sum() > 3.5 * HOLE.sum()
    assert not stain_around(HOLE, ~HOLE, np.where(mat[..., None], 0.5, 1.0) * weave()).any()


def test_no_floor_has_no_stain():
    assert not stain_around(HOLE, np.zeros_like(HOLE), weave()).any()


def test_a_faint_shadow_is_shade_and_a_seam_is_not():
    """The shadow is not a stain, but texels in it must not be copied."""
    shadow = (np.abs(ROWS - SIDE / 2) < 20) & (COLUMNS > SIDE / 2) & (COLUMNS < SIDE / 2 + 50)
    seam = np.abs(ROWS - 60) < 4
    floor = np.where(shadow[..., None], 0.84, 1.0) * np.where(seam[..., None], 0.7, 1.0) * weave()
    assert not stain_around(HOLE, ~HOLE, floor).any()
    found = shaded(HOLE, ~HOLE, floor)
    core = (np.abs(ROWS - SIDE / 2) < 14) & shadow & (COLUMNS < SIDE / 2 + 42) & ~HOLE
    assert found[core].mean() > 0.9
    assert not found[~(np.abs(ROWS - SIDE / 2) < 26)].any()
    assert not found[HOLE].any()
    assert not shaded(np.ones_like(HOLE), ~HOLE, floor).any()
