"""Removal of the captured shadow from the ground, and from nothing else."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.gaussians import SH_BAND_0
from egs_warp.lighting.estimate import estimate_light
from egs_warp.lighting.remaining_shadow import without_shadow
from tests.support.lit_scenes import direction, in_shadow, lit_ball, lit_floor
from tests.support.scenes import FLOOR


def test_the_captured_shadow_is_lightened_to_the_brightness_around_it() -> None:
    """The shadow of the ball is mostly gone, the lit floor keeps its bits, and a floor without shadow is unchanged."""
    truth = direction(200.0, 45.0)
    ball, floor = lit_ball(truth), lit_floor(truth)
    light = estimate_light(ball, floor, FLOOR).light
    assert light is not None
    before, after = (
        0.5 + SH_BAND_0 * one.sh.numpy()[:, 0, 0] for one in (floor, without_shadow(floor, ball, FLOOR, light))
    )
    points = floor.means.numpy()
    shadow = in_shadow(points, truth) & (np.linalg.norm(points[:, :2], axis=1) > 0.5)
    far = np.linalg.norm(points[:, :2] + truth[:2], axis=1) > 1.2
    lit = before[far & ~shadow].mean()
    assert lit - before[shadow].mean() > 4.0 * abs(lit - after[shadow].mean())
    assert np.abs(after - before)[far & ~shadow].max() < 0.01
    clean = lit_floor(truth, key=0.0)
    changed = np.abs(without_shadow(clean, ball, FLOOR, light).sh.numpy() - clean.sh.numpy())
    assert changed.max() < 0.01
