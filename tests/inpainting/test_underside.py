"""Closing of the underside of an object that was sunk into its ground: between the rims, in the colours of the rim, and
only where the underside is open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from egs_warp.geometry.gaussians import SH_BAND_0
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting import underside
from egs_warp.inpainting.new_floor import flat_gaussians
from egs_warp.inpainting.rectified import PlaneWindow
from egs_warp.inpainting.underside import with_underside
from tests.support.grounds import RADIUS, ball
from tests.support.waves import wavy_ground

SIZE = 1.7


@pytest.mark.parametrize("degree", [0, 2])
def test_a_ball_sunk_into_folds_is_closed(degree: int) -> None:
    """The ball is sunk into the ground by a fifth of its radius. All new Gaussians lie within the rim, laterally and in
    height, and cover the opening."""
    ground = wavy_ground(0.03, spacing=0.04)
    whole = ball(-0.2 * RADIUS)
    thing = whole.subset(ground.heights(whole.means.numpy()) > 0.005)
    sh = np.zeros((thing.count, (degree + 1) ** 2, 3), np.float32)
    sh[:, :1] = thing.sh.numpy()
    thing = replace(thing, sh=wp.array(sh, dtype=wp.vec3, device=thing.device))
    closed, count = with_underside(thing, ground, SIZE)
    assert count > 50 and closed.count == thing.count + count and closed.sh_degree == degree
    new = closed.means.numpy()[thing.count :].astype(np.float64)
    rim = thing.means.numpy()[ground.heights(thing.means.numpy()) < 0.05]
    radius = np.hypot(*rim[:, :2].T)
    assert np.hypot(*new[:, :2].T).max() < radius.max()
    assert rim[:, 2].min() - 0.01 < new[:, 2].min() and new[:, 2].max() < rim[:, 2].max() + 0.01
    spots = np.random.default_rng(0).uniform(-0.15, 0.15, (200, 2))
    nearest = np.linalg.norm(new[None, :, :2] - spots[:, None], axis=2).min(axis=1)
    assert nearest.max() < 0.03
    colour = closed.sh.numpy()[thing.count :, 0] * SH_BAND_0 + 0.5
    assert np.abs(colour - [0.8, 0.3, 0.2]).max() < 0.02


@pytest.mark.parametrize("sides", [(), (4,), (1, 1, 1)])
def test_an_underside_too_small_for_a_gaussian_stays_open(
    sides: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """If there are no unseen texels, or no complete block of them, nothing is added, and there is no error."""
    hole, known = np.zeros((2, 16, 16), bool)
    known[:] = True
    for number, side in enumerate(sides):
        hole[4 * number + 1 : 4 * number + 1 + side, 3] = True
    known &= ~hole
    window = PlaneWindow(Plane(np.array([0.0, 0.0, 1.0]), 0.0), np.zeros(3), 0.1, 16, 16)
    assert flat_gaussians(window, hole, known, np.zeros((16, 16, 3)), np.zeros((16, 16)), spacing=2) is None
    ground, object_cloud = wavy_ground(0.03, spacing=0.04), ball(-0.2 * RADIUS)
    monkeypatch.setattr(underside, "flat_gaussians", lambda *_, **__: None)
    assert with_underside(object_cloud, ground, SIZE) == (object_cloud, 0)


def test_a_closed_underside_is_unchanged() -> None:
    ground = wavy_ground(0.03, spacing=0.04).moved(np.array([0.0, 0.0, -0.06]))
    thing = ball()
    same, count = with_underside(thing, ground, SIZE)
    assert same is thing and count == 0


def test_a_coarse_object_gets_few_gaussians() -> None:
    """The number of new Gaussians is at most a fifth of the object's own, and they cover the same opening."""
    ground, whole = wavy_ground(0.03, spacing=0.04), ball(-0.2 * RADIUS)
    thing = whole.subset(ground.heights(whole.means.numpy()) > 0.005)
    fine, many = with_underside(thing, ground, SIZE)
    coarse, few = with_underside(thing.subset(np.arange(0, thing.count, 2)), ground, SIZE)
    assert 0 < few <= 0.2 * (coarse.count - few) < many
    reach = [np.ptp(one.means.numpy()[-count:], axis=0)[:2] for one, count in ((fine, many), (coarse, few))]
    np.testing.assert_allclose(reach[1], reach[0], atol=0.1)
