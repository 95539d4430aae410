"""The shadow of the animated object: only where the floor is seen, and softly."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.render.backdrop import CapturedScene, ContactShadow
from tests.support.scenes import FLOOR, ball_on_floor


def test_the_shadow_falls_where_the_floor_is_seen() -> None:
    """Darker under the body, unchanged elsewhere and on what hides the floor; softer and paler from above."""
    cloud, truth = ball_on_floor()
    floor = cloud.subset(~truth)
    camera = Camera.look_at(np.array([0.0, -4.0, 2.5]), np.zeros(3), np.eye(3)[2], width=120, height=120)
    where = {"centre": np.zeros(3), "reach": 2.0}
    fields = ("rotations", "log_scales", "opacity_logits", "sh")

    def placed(source: GaussianCloud, means: np.ndarray) -> GaussianCloud:
        return GaussianCloud.from_numpy(means, *(getattr(source, name).numpy() for name in fields))

    ball = cloud.subset(truth)
    body = placed(ball, ball.means.numpy() * [1.0, 1.0, 0.1])
    bare = CapturedScene(floor, camera, FLOOR, **where, shadow=False).background(body, height=1.0)
    dark = CapturedScene(floor, camera, FLOOR, **where).background(body, height=1.0)
    shadow = ContactShadow(camera, FLOOR, **where)
    away = np.linalg.norm(shadow.flat, axis=-1)
    under, far = shadow.hit & (away < 0.2), shadow.hit & (away > 1.2)
    assert dark[under].mean() < 0.75 * bare[under].mean()
    np.testing.assert_array_equal(dark[far], bare[far])
    lifted = shadow.darkness(placed(body, body.means.numpy() + [0.0, 0.0, 0.4]), height=1.0)
    assert 0.0 < lifted.max() < shadow.darkness(body, height=1.0).max() <= 0.5
    # A wall in front of the floor takes no shadow.
    wall = placed(floor, floor.means.numpy()[:, [0, 2, 1]] + [0.0, -1.2, 1.0])
    plain, shaded = (
        CapturedScene(wall, camera, FLOOR, **where, shadow=one).background(body, height=1.0) for one in (False, True)
    )
    np.testing.assert_allclose(shaded, plain, atol=0.02)


def test_the_shadow_lies_on_an_uneven_floor_without_an_edge() -> None:
    """Half of a floor that stands 3 % of the reach above the fitted plane, as sheets do, bears nearly the same shadow;
    at a terrace too high for it the shadow ends, but not from one pixel to the next."""
    cloud, truth = ball_on_floor()
    camera = Camera.look_at(np.array([0.0, -4.0, 2.5]), np.zeros(3), np.eye(3)[2], width=120, height=120)
    fields = ("rotations", "log_scales", "opacity_logits", "sh")

    def placed(source: GaussianCloud, means: np.ndarray) -> GaussianCloud:
        return GaussianCloud.from_numpy(means, *(getattr(source, name).numpy() for name in fields))

    flat = cloud.subset(~truth)
    body = placed(cloud.subset(truth), cloud.subset(truth).means.numpy() * [1.0, 1.0, 0.1])
    darkness = []
    for step in (0.0, 0.06, 0.4):
        floor = placed(flat, flat.means.numpy() + np.outer(flat.means.numpy()[:, 0] > 0.0, [0.0, 0.0, step]))
        bare, dark = (
            CapturedScene(floor, camera, FLOOR, centre=np.zeros(3), reach=2.0, shadow=one).background(body, height=1.0)
            for one in (False, True)
        )
        darkness.append(1.0 - dark.mean(axis=2) / np.maximum(bare.mean(axis=2), 1e-3))
    even, uneven, terrace = darkness
    right = np.s_[:, 62:]
    assert uneven[right].sum() > 0.8 * even[right].sum()
    assert terrace[right].sum() < 0.3 * even[right].sum()
    assert np.abs(np.diff(terrace, axis=1)).max() < 1.5 * np.abs(np.diff(even, axis=1)).max()
