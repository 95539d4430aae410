"""Note about a capture that seems to be a scene instead of an object."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from egs_warp.assets import BuiltInObject, figurine, pawn, scene, snake, stool
from egs_warp.commands.scene_hint import scene_notes
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud, concatenate
from egs_warp.io import read_capture
from tests.support.scenes import lying

_UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("made", [pawn, stool, figurine, snake])
def test_an_object_alone_gets_no_note(made: Callable[..., BuiltInObject]):
    assert scene_notes(made(gaussian_count=3000).cloud, _UP) == []


@pytest.mark.parametrize(
    "name", ["pawn", pytest.param("stool", marks=pytest.mark.slow), pytest.param("figurine", marks=pytest.mark.slow)]
)
def test_an_object_on_its_ground_gets_a_note(name: str):
    """The high part of the scene of the stool is nearly as wide as its ground. Under the figurine, a cloth hangs from
    the table, far below its top."""
    (note,) = scene_notes(scene(name).whole()[0], _UP)
    assert note.startswith("the capture seems to be a scene: ") and "--object" in note


def _plate(side: float, low: float, high: float, *, count: int = 60) -> np.ndarray:
    """Return points of a square plate whose top is level."""
    wide = side * np.linspace(-0.5, 0.5, count)
    return np.stack(np.meshgrid(wide, wide, np.linspace(low, high, 5)), axis=-1).reshape(-1, 3)


def _box(size: tuple[float, float, float], centre: tuple[float, float] = (0.0, 0.0), *, count: int = 30) -> np.ndarray:
    """Return points in a box on the plane z = 0."""
    x, y, z = (length * np.linspace(-0.5, 0.5, count) for length in size)
    points = np.stack(np.meshgrid(x, y, z + 0.5 * size[2]), axis=-1).reshape(-1, 3)
    return points + [*centre, 0.0]


@pytest.mark.parametrize(("side", "is_scene"), [(1.1, False), (1.3, True), (2.0, True)])
@pytest.mark.parametrize("thickness", [0.02, 0.2])
def test_a_plate_is_ground_if_it_is_wide(side: float, thickness: float, is_scene: bool):
    """A cube of side 1 stands on a square plate, of whose area 0.17, 0.41 or 0.75 lies around the cube."""
    cloud = lying(np.concatenate([_box((1.0, 1.0, 1.0)), _plate(side, -thickness, 0.0)]))
    assert len(scene_notes(cloud, _UP)) == is_scene


def test_a_table_top_may_consist_of_few_gaussians():
    """The plate has 0.9 % of the Gaussians, which are 9 times as wide as those of the cube."""
    cube, plate = lying(_box((1.0, 1.0, 1.0), count=40)), lying(_plate(2.0, 0.0, 0.0, count=11))
    wide = [getattr(plate, name).numpy() + (np.log(9.0) if name == "log_scales" else 0.0) for name in ARRAYS]
    assert len(scene_notes(concatenate(cube, GaussianCloud.from_numpy(*wide)), _UP)) == 1


@pytest.mark.parametrize(("back", "is_scene"), [(-0.45, False), (0.0, True)])
def test_a_seat_with_a_back_is_no_scene(back: float, is_scene: bool):
    """A board on a seat with four legs: at the edge of the seat, it is the back of a chair."""
    legs = [_box((0.1, 0.1, 0.5), (x, y), count=8) - [0.0, 0.0, 0.5] for x in (-0.4, 0.4) for y in (-0.4, 0.4)]
    board = _box((0.8, 0.1, 0.7), (0.0, back))
    assert len(scene_notes(lying(np.concatenate([*legs, _plate(1.0, -0.05, 0.0), board])), _UP)) == is_scene


def test_uneven_ground_is_ground():
    """A cube of side 1 stands between folds of cloth that are up to 0.14 high."""
    cloth = _plate(1.8, 0.0, 0.0)
    cloth[:, 2] = 0.07 * (1.0 + np.sin(9.0 * cloth[:, 0]) * np.sin(7.0 * cloth[:, 1]))
    assert len(scene_notes(lying(np.concatenate([_box((1.0, 1.0, 1.0)), cloth])), _UP)) == 1


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "up", "is_scene"),
    [
        ("scenes/koala.ply", [0.0, -1.0, 0.0], True),
        ("scenes/playbot", [0.0, -1.0, 0.0], True),
        ("scenes/fox.ply", [0.0, 0.0, 1.0], True),
        ("scenes/narcissus.sog", [0.0, -1.0, 0.0], True),
        ("objects/robot.spz", [0.0, 1.0, 0.0], False),
        ("objects/plush_dog.ply", [0.0, -1.0, 0.0], False),
        ("objects/monkey.ply", [0.0, 1.0, 0.0], False),
    ],
)
def test_real_captures(data_dir: Path, name: str, up: list[float], is_scene: bool):
    notes = scene_notes(read_capture(data_dir / name).cloud, np.array(up))
    assert len(notes) == is_scene


@pytest.mark.data
@pytest.mark.parametrize(("reach", "is_scene"), [(0.6, False), (1.2, True)])
def test_a_toy_on_a_piece_of_its_table(data_dir: Path, reach: float, is_scene: bool):
    """Around the koala, which is 1.2 wide, the table is cut off at a distance from its centre."""
    cloud = read_capture(data_dir / "scenes/koala.ply").cloud
    away = cloud.means.numpy()[:, [0, 2]] - [0.1, 0.15]
    notes = scene_notes(cloud.subset(np.linalg.norm(away, axis=1) < reach), np.array([0.0, -1.0, 0.0]))
    assert len(notes) == is_scene
