"""Pictures that are made beside what else goes on."""

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


def test_what_is_taken_is_what_is_drawn_at_once(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other, the last of them with too little room at first; nothing where nothing was begun."""
    cloud = pawn(gaussian_count=3000, device=device).cloud
    eyes = np.array([[1.0, -3.0, 1.0], [-2.0, -1.0, 2.0], [0.0, 3.0, 0.5]])
    cameras = [Camera.look_at(eye, np.array([0.0, 0.0, 0.5]), np.eye(3)[2], width=67, height=45) for eye in eyes]
    expected = [render_gaussians(cloud, camera).colour_srgb8() for camera in cameras]
    assert len({picture.tobytes() for picture in expected}) == len(eyes)
    ahead = AsyncRenderer(67, 45, cloud.device)
    wp.synchronize()
    assert ahead.result() is None
    for camera, picture in zip(cameras[:2], expected, strict=False):
        ahead.submit(partial(enqueue_image, cloud, camera))
        np.testing.assert_array_equal(ahead.result(), picture)
    begun: list[compositing.PendingImage] = []

    def empty() -> compositing.PendingImage:
        """Lists that are empty, as they are where there was no room."""
        begun.append(enqueue_image(cloud, cameras[2]))
        begun[-1].image.colour.zero_()
        return begun[-1]

    monkeypatch.setattr(compositing, "lists_fit", lambda lists, projected: False)
    ahead.submit(empty)
    np.testing.assert_array_equal(ahead.result(), expected[2])
    assert ahead.result() is None
