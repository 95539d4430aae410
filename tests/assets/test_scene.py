"""Built-in scenes: the floor has no holes, and the camera sees the object."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.assets import BUILT_IN_SCENES, SQUARE, scene
from egs_warp.errors import UserError

LONG = {"figurine", "snake"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in BUILT_IN_SCENES]
)
def test_scene(name: str) -> None:
    """The floor is complete, also under the object; the camera sees the object; object and background make up the
    scene."""
    made = scene(name)
    whole, is_object = made.whole()
    assert whole.count == made.object.count + made.background.count == len(is_object)
    assert np.array_equal(whole.means.numpy()[is_object], made.object.means.numpy())
    floor = made.background.means.numpy()
    floor = floor[np.abs(made.plane.heights(floor)) < 0.02][:, :2]
    standing = made.object.means.numpy()
    standing = standing[standing[:, 2] < 0.05][::25, :2]
    gaps = np.linalg.norm(standing[:, None] - floor[None], axis=2).min(axis=1)
    assert gaps.max() < 0.06
    camera = made.camera(width=200, height=200)
    seen = made.object.means.numpy() @ camera.rotation.T + camera.translation
    pixels = seen[:, :2] / seen[:, 2:] * camera.fx + 100.0
    assert np.all((pixels > 0) & (pixels < 200)) and seen[:, 2].min() > camera.near


def test_board_squares() -> None:
    """The pawn stands in the middle of a dark square; the next square along +x is light."""
    board = scene("pawn").background
    means, colour = board.means.numpy(), board.sh.numpy()[:, 0].mean(axis=1)

    def tone(x: float, y: float) -> float:
        return float(colour[np.all(np.abs(means[:, :2] - [x, y]) < 0.3 * SQUARE, axis=1)].mean())

    assert tone(0, 0) < tone(SQUARE, 0) - 0.3
    assert tone(0, SQUARE) > tone(0, 0) + 0.3
    assert tone(5 * SQUARE, 0) > tone(4 * SQUARE, 0) + 0.3


def test_unknown_scene() -> None:
    """The error message lists the available names."""
    with pytest.raises(UserError, match="scene 'castle' is unknown; give one of pawn, stool, figurine, snake"):
        scene("castle")
