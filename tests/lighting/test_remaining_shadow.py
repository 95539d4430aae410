"""Removal of the captured shadow from the ground, and from nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
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


def test_lightening_keeps_the_hue() -> None:
    """No channel of pale blue ground exceeds white, where it would be clipped alone."""
    truth = direction(200.0, 45.0)
    ball, floor = lit_ball(truth), lit_floor(truth, albedo=0.95)
    light = estimate_light(ball, floor, FLOOR).light
    assert light is not None
    colours = (0.5 + SH_BAND_0 * floor.sh.numpy()[:, 0]) * [0.8, 0.87, 1.03]
    blue = _with_colours(floor, colours)
    after = 0.5 + SH_BAND_0 * without_shadow(blue, ball, FLOOR, light).sh.numpy()[:, 0]
    gain = after / colours
    assert gain[in_shadow(floor.means.numpy(), truth)].mean() > 1.1
    assert np.abs(gain - gain[:, :1]).max() < 1e-3
    assert after.max() < 1.0 + 1e-6


def test_lit_ground_inside_the_shadow_is_not_lightened() -> None:
    """Inpainted ground, which has no shadow, keeps its brightness in the cells that it shares with the captured
    shadow."""
    truth = direction(200.0, 45.0)
    ball, floor = lit_ball(truth), lit_floor(truth)
    light = estimate_light(ball, floor, FLOOR).light
    assert light is not None
    shadow = in_shadow(floor.means.numpy(), truth)
    inpainted = shadow & (np.arange(floor.count) % 2 == 0)
    colours = 0.5 + SH_BAND_0 * floor.sh.numpy()[:, 0]
    colours[inpainted] = colours[~shadow].mean(axis=0)
    mixed = _with_colours(floor, colours)
    gain = (0.5 + SH_BAND_0 * without_shadow(mixed, ball, FLOOR, light).sh.numpy()[:, 0]) / colours
    assert np.median(gain[shadow & ~inpainted]) > 1.08
    assert np.abs(gain[inpainted] - 1.0).max() < 0.01


def _with_colours(floor: GaussianCloud, colours: np.ndarray) -> GaussianCloud:
    sh = ((colours - 0.5) / SH_BAND_0).astype(np.float32)[:, None]
    return replace(floor, sh=wp.array(sh, dtype=wp.vec3, device=floor.device))
