"""Pictures that are made beside what else goes on."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import warp as wp

from egs_warp.assets import pawn
from egs_warp.geometry.camera import Camera
from egs_warp.render import compositing
from egs_warp.render.ahead import PicturesAhead
from egs_warp.render.rasteriser import begin_image, render_gaussians


def test_what_is_taken_is_what_is_drawn_at_once(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other, the last of them with too little room at first; nothing where nothing was begun."""
    cloud = pawn(gaussian_count=3000, device=device).cloud
    eyes = np.array([[1.0, -3.0, 1.0], [-2.0, -1.0, 2.0], [0.0, 3.0, 0.5]])
    cameras = [Camera.look_at(eye, np.array([0.0, 0.0, 0.5]), np.eye(3)[2], width=67, height=45) for eye in eyes]
    expected = [render_gaussians(cloud, camera).colour_srgb8() for camera in cameras]
    assert len({picture.tobytes() for picture in expected}) == len(eyes)
    ahead = PicturesAhead(67, 45, cloud.device)
    wp.synchronize()
    assert ahead.take() is None
    for camera, picture in zip(cameras[:2], expected, strict=False):
        ahead.begin(partial(begin_image, cloud, camera))
        np.testing.assert_array_equal(ahead.take(), picture)
    begun: list[compositing.BegunImage] = []

    def empty() -> compositing.BegunImage:
        """Lists that are empty, as they are where there was no room."""
        begun.append(begin_image(cloud, cameras[2]))
        begun[-1].image.colour.zero_()
        return begun[-1]

    monkeypatch.setattr(compositing, "lists_fit", lambda lists, projected: False)
    ahead.begin(empty)
    np.testing.assert_array_equal(ahead.take(), expected[2])
    assert ahead.take() is None
