"""Shadow of the main light on a plane."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from egs_warp.assets.surface import SurfaceSamples, flat_gaussians
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.main_light import MainLight
from egs_warp.render.shadow import ShadowMap, shadow_blur_radius
from tests.support.lit_scenes import direction
from tests.support.scenes import FLOOR

HALF, LOW, HIGH = 0.3, 0.4, 0.9
"""Half width of a box over the ground, and heights of its bottom and top."""


def box() -> GaussianCloud:
    side = np.linspace(-1.0, 1.0, 25)
    u, v = (one.ravel() for one in np.meshgrid(side, side))
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            local = np.insert(np.column_stack([u, v]), axis, sign, axis=1)
            faces.append((local, np.tile(sign * np.eye(3)[axis], (len(local), 1))))
    points = np.concatenate([one for one, _ in faces]) * [HALF, HALF, 0.5 * (HIGH - LOW)]
    samples = SurfaceSamples(
        points + [0.0, 0.0, 0.5 * (LOW + HIGH)], np.concatenate([normals for _, normals in faces]), 0.03
    )
    return flat_gaussians(samples, np.zeros((len(points), 1, 3)), random=np.random.default_rng(0), device="cpu")


@pytest.mark.parametrize("lift", [0.0, 0.15])
def test_the_shadow_of_a_box_is_its_projection_along_the_light(lift: float) -> None:
    """The shadow is the box projected along the light, on the plane and on ground that is ``lift`` above it."""
    light = MainLight(direction(25.0, 50.0), 1.0, 0.5, np.eye(4))
    body = box()
    shadow_map = ShadowMap(
        FLOOR,
        centre=np.zeros(3),
        reach=2.0,
        device=body.device,
        blur_radius=shadow_blur_radius(body),
        height=HIGH,
        light=light,
    )
    side = np.linspace(-1.8, 1.8, 121)
    flat = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    points = np.column_stack([flat, np.full(len(flat), lift)])
    texels = wp.array(shadow_map.texels(points), dtype=wp.vec2, device=body.device)
    strength = wp.full(len(points), 1.0, dtype=wp.float32, device=body.device)
    found = shadow_map.cover(shadow_map.of(body), texels, strength).numpy()
    # The ray from a point of the ground meets the box if a part of it is inside all three slabs.
    slope = light.direction[:2] / light.direction[2]
    low, high = (LOW - lift, HIGH - lift)
    ends = np.sort(np.stack([(-HALF - flat) / slope, (HALF - flat) / slope]), axis=0)
    enter, leave = np.maximum(ends[0].max(axis=1), low), np.minimum(ends[1].min(axis=1), high)
    true = enter < leave
    mask = found > 0.5
    # The shadow is wider by about one standard deviation of the Gaussians.
    assert (mask & true).sum() / (mask | true).sum() > 0.85
    assert found.max() <= 1.0 and found[~true].mean() < 0.02


def test_the_penumbra_is_at_most_a_body_height_wide() -> None:
    """Two lights so wide that both blurs are limited cast the same shadow; a narrow one casts another."""
    body = box()
    narrow, wide, wider = (
        ShadowMap(
            FLOOR,
            centre=np.zeros(3),
            reach=2.0,
            device=body.device,
            height=HIGH,
            light=MainLight(direction(25.0, 50.0), half_angle, 0.5, np.eye(4)),
        )
        .of(body)
        .numpy()
        for half_angle in (5.0, 80.0, 89.0)
    )
    np.testing.assert_array_equal(wide, wider)
    assert np.abs(wide - narrow).max() > 0.1
