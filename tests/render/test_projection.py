"""Projection by SIMD lanes on a CPU, compared with the kernel for one Gaussian."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.kernels.render.projection import project_kernel
from egs_warp.render.projection import project, view_from_camera


@pytest.mark.parametrize(("antialiased", "coefficients"), [(False, 1), (True, 16)])
def test_lanes_equal_the_kernel_for_one_gaussian(antialiased: bool, coefficients: int) -> None:
    """The number of Gaussians, 1003, is not a multiple of the number of lanes. Some Gaussians are faint, huge, behind
    the camera or beside it."""
    random, count = np.random.default_rng(4), 1003
    rotations = random.normal(size=(count, 4))
    rotations[5] = 0.0
    cloud = GaussianCloud.from_numpy(
        means=random.uniform(-4, 4, (count, 3)),
        rotations=rotations,
        log_scales=random.normal(-2.5, 1.5, (count, 3)),
        opacity_logits=random.normal(0.0, 6.0, count),
        sh=random.normal(0, 0.4, (count, coefficients, 3)),
        device="cpu",
    )
    eye, up = np.array([0.3, -0.4, -3.0]), np.array([0, -1.0, 0])
    view = view_from_camera(Camera.look_at(eye, np.zeros(3), up, width=131, height=77))
    lanes = project(cloud, view, antialiased=antialiased, threads=2)
    ellipse, colour_depth = (wp.zeros(count, dtype=wp.vec4, device="cpu") for _ in range(2))
    falloff, tiles = wp.zeros(count, dtype=wp.vec2, device="cpu"), wp.zeros(count, dtype=wp.int64, device="cpu")
    wp.launch(
        project_kernel,
        count,
        inputs=[0, view, int(antialiased), *(getattr(cloud, name) for name in ARRAYS)],
        outputs=[ellipse, falloff, colour_depth, tiles],
        device="cpu",
    )
    counts = np.diff(lanes.slot_end.numpy(), prepend=0)
    # The tile rows may differ where a rounding error moves the end of an ellipse across the centre of a pixel.
    assert (counts != tiles.numpy()).sum() <= 1
    shown = (counts > 0) & (tiles.numpy() > 0)
    assert 100 < shown.sum() < 700
    for name, expected in (("ellipse", ellipse), ("falloff", falloff), ("colour_depth", colour_depth)):
        got, expected = getattr(lanes, name).numpy()[shown], expected.numpy()[shown]
        np.testing.assert_allclose(got, expected, rtol=2e-5, atol=1e-5, err_msg=name)
