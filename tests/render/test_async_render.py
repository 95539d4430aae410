"""Asynchronous rendering, compared with blocking renders."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import warp as wp

from egs_warp.assets import pawn
from egs_warp.geometry.camera import Camera
from egs_warp.render import compositing
from egs_warp.render.async_render import AsyncRenderer
from egs_warp.render.rasteriser import enqueue_image, render_gaussians


def test_asynchronous_renders_equal_blocking_ones(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The results equal those of blocking renders, in the order of submission, also if the guessed capacity was too
    small. If no image was submitted, there is no result."""
    cloud = pawn(gaussian_count=3000, device=device).cloud
    eyes = np.array([[1.0, -3.0, 1.0], [-2.0, -1.0, 2.0], [0.0, 3.0, 0.5]])
    cameras = [Camera.look_at(eye, np.array([0.0, 0.0, 0.5]), np.eye(3)[2], width=67, height=45) for eye in eyes]
    expected = [render_gaussians(cloud, camera).colour_srgb8() for camera in cameras]
    assert len({picture.tobytes() for picture in expected}) == len(eyes)
    renderer = AsyncRenderer(67, 45, cloud.device)
    wp.synchronize()
    assert renderer.result() is None
    for camera, picture in zip(cameras[:2], expected, strict=False):
        renderer.submit(partial(enqueue_image, cloud, camera))
        np.testing.assert_array_equal(renderer.result(), picture)
    pending: list[compositing.PendingImage] = []

    def empty() -> compositing.PendingImage:
        """Queue an image and clear it, as if its guessed capacity had been too small."""
        pending.append(enqueue_image(cloud, cameras[2]))
        pending[-1].image.colour.zero_()
        return pending[-1]

    monkeypatch.setattr(compositing, "lists_fit", lambda lists, projected: False)
    renderer.submit(empty)
    np.testing.assert_array_equal(renderer.result(), expected[2])
    assert renderer.result() is None
