"""Matching of photos of a scene to the colours of its capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egs_warp.commands.scene_input import SceneInput
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.cameras import write_cameras
from egs_warp.render import render_gaussians
from egs_warp.segmentation.clearance import StraddlingOptions, StraddlingPolicy, clear_plane, plane_extents
from tests.support.scenes import FLOOR, ball_on_floor


def test_photos_of_the_cameras_clear_the_plane(tmp_path: Path) -> None:
    """Eq. (21): the loss decreases with photos of the whole scene as views. A photo whose size differs from its
    camera's is refused."""
    pytest.importorskip("torch")
    from egs_warp.io import read_cameras
    from egs_warp.training.photo_colours import in_colours_of, photographs_in_colours_of

    cloud, truth = ball_on_floor()
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 0.9, count=6, size=96)
    write_cameras(tmp_path / "cameras.json", cameras, [f"photo{k}.png" for k in range(6)])
    posed = read_cameras(tmp_path / "cameras.json")
    images = tmp_path / "images"
    images.mkdir()
    for one in posed[:5]:
        picture = render_gaussians(cloud, one.camera, background=(0.0, 0.0, 0.0)).colour_srgb8()
        Image.fromarray(picture[:50] if one is posed[4] else picture).save(images / one.name)
    given = SceneInput(cloud, read_cameras(tmp_path / "cameras.json"), None, None, None, ())
    photographs = photographs_in_colours_of(given.cloud, given.posed)
    assert len(photographs) == 4
    assert photographs[0].image.shape == (96, 96, 3)
    expected = render_gaussians(cloud, posed[0].camera, background=(0.0, 0.0, 0.0)).colour.numpy()
    np.testing.assert_allclose(photographs[0].image, np.clip(expected, 0.0, 1.0), atol=1.0 / 255)
    # The photo has a third of the exposure, warmer light, and another object in the foreground.
    expected = np.clip(expected, 0.0, 1.0)
    toned = expected * [0.4, 0.33, 0.25] + 0.02
    toned[70:80, 40:60] = 1.0
    matched = in_colours_of(expected, toned, expected.max(axis=2) > 0.1)
    np.testing.assert_allclose(matched[:70], expected[:70], atol=1.0 / 255)
    thing = cloud.subset(truth & (cloud.means.numpy()[:, 2] > 0.0))
    tuned = clear_plane(
        thing,
        FLOOR,
        StraddlingPolicy.FINETUNE,
        views=photographs,
        surroundings=cloud.subset(~truth),
        options=StraddlingOptions(iterations=60, subdivisions=0, weight=3.0),
    )

    def crossing(one: GaussianCloud) -> float:
        heights, reach = plane_extents(one, FLOOR)
        return float(np.maximum(reach - np.abs(heights), 0.0).sum())

    assert thing.count - 10 <= tuned.count <= thing.count
    assert crossing(tuned) < 0.6 * crossing(thing)


def test_a_photo_is_reduced_in_blocks_of_whole_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first 96 pixels of a photo of 97 pixels are reduced to a third. If all 97 pixels were resized, the image
    would be shifted at its edge."""
    pytest.importorskip("torch")
    from egs_warp.io import read_cameras
    from egs_warp.training import photo_colours

    monkeypatch.setattr(photo_colours, "_PHOTO_SIDE", 40)
    monkeypatch.setattr(photo_colours, "in_colours_of", lambda reference, photo, shared: photo)
    cloud, _ = ball_on_floor()
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 0.9, count=1, size=97)
    write_cameras(tmp_path / "cameras.json", cameras, ["photo.png"])
    (tmp_path / "images").mkdir()
    picture = np.random.default_rng(0).integers(0, 256, (97, 97, 3)).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "images" / "photo.png")
    (view,) = photo_colours.photographs_in_colours_of(cloud, read_cameras(tmp_path / "cameras.json"))
    assert (view.camera.width, view.camera.height) == (32, 32)
    blocks = picture[:96, :96].reshape(32, 3, 32, 3, 3).mean(axis=(1, 3)) / 255.0
    np.testing.assert_allclose(view.image, blocks, atol=0.51 / 255)
