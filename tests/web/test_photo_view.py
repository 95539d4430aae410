"""Views of the page of ``egs-warp pick`` from the positions of photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import concatenate
from egs_warp.web.photo_view import view_of_object, view_of_photo
from egs_warp.web.pick_session import PickSession
from tests.support.clicking import balls
from tests.support.picking import events_until, picking
from tests.support.scenes import round_ones

UP = np.array([0.0, 0.0, 1.0])
MIDDLE = np.array([0.8, 0.0, 0.5])
"""Middle of the right ball, whose diameter is 1."""


def _photo(eye: tuple[float, float, float], target: np.ndarray = MIDDLE) -> Camera:
    return Camera.look_at(np.array(eye), target, UP, width=300, height=200, vertical_fov_degrees=40.0)


def test_the_view_is_from_the_nearest_photo_that_shows_the_object_unhidden():
    """A wall hides the ball from the nearest photo, and the second nearest photo cuts it off. The picture shows the
    ball in its middle, across 0.6 of it."""
    y, z = np.meshgrid(np.linspace(-2.0, 2.0, 80), np.linspace(-1.0, 3.0, 80))
    wall = round_ones(np.stack([np.full(y.size, 2.4), y.ravel(), z.ravel()], axis=1), 0.05)
    scene = balls((-0.6, 0.9), between=1.6)
    cloud, mask = concatenate(scene, wall), np.zeros(scene.count + wall.count, bool)
    mask[1500:3000] = True
    hidden, cut_off = _photo((3.0, 0.0, 0.8)), _photo((0.8, -2.4, 0.9), MIDDLE + [1.3, 0.0, 0.0])
    shown, far = _photo((0.6, -3.0, 1.2)), _photo((0.0, 5.0, 1.0))
    view = view_of_object(cloud, mask, [hidden, cut_off, far, shown])
    assert view is not None
    np.testing.assert_allclose(view["position"], shown.centre, atol=1e-9)
    ahead = MIDDLE - shown.centre
    assert view["forward"] @ ahead / np.linalg.norm(ahead) > 0.999
    half = np.tan(np.radians(0.5 * view["fov"])) * view["distance"]
    assert 0.5 / half == np.clip(0.5 / half, 0.54, 0.66)
    assert view_of_object(cloud, np.zeros(cloud.count, bool), [shown]) is None
    assert view_of_object(cloud, mask, [_photo((0.8, -3.0, 0.5), np.array([0.8, -9.0, 0.5]))]) is None


def test_the_first_view_is_from_the_photo_nearest_to_what_all_photos_show():
    eyes = ((3.0, 0.0, 1.0), (0.0, -2.0, 1.0), (-3.0, 0.5, 1.0), (0.5, 4.0, 2.0))
    view = view_of_photo([_photo(eye) for eye in eyes])
    assert view is not None
    np.testing.assert_allclose(view["position"], eyes[1], atol=1e-9)
    np.testing.assert_allclose(np.array(eyes[1]) + view["distance"] * np.array(view["forward"]), MIDDLE, atol=1e-6)
    assert view_of_photo([]) is None


def test_a_session_with_cameras_sends_the_view_of_its_proposal(tmp_path: Path):
    bare, _ = picking(balls((-0.6, 0.9), between=1.6), tmp_path / "picked.json")
    angles = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    ring = [_photo((0.8 + 3.0 * np.cos(a), 3.0 * np.sin(a), 1.6)) for a in angles]
    session = PickSession(replace(bare.source, cameras=ring))
    session.subscribe(lambda: None)
    session.start()
    try:
        events = events_until(session, lambda latest: "pick" in latest)
    finally:
        session.stop()
    assert session.state.pick.mask[1500:3000].mean() > 0.9
    eyes = [session.source.frame.camera(one).centre for one in ring]
    assert min(np.linalg.norm(events["view"]["camera"]["position"] - eye) for eye in eyes) < 1e-9
