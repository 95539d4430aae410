"""Note about a capture that seems to be a scene instead of an object."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from egs_warp.assets import BuiltInObject, figurine, pawn, scene, snake, stool
from egs_warp.commands.scene_hint import scene_notes
from egs_warp.io import read_capture
from tests.support.scenes import lying

_UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("made", [pawn, stool, figurine, snake])
def test_an_object_alone_gets_no_note(made: Callable[..., BuiltInObject]):
    assert scene_notes(made(gaussian_count=3000).cloud, _UP) == []


@pytest.mark.parametrize("name", ["pawn", "stool"])
def test_an_object_on_its_ground_gets_a_note(name: str):
    """The high part of the scene of the stool is nearly as wide as its ground."""
    (note,) = scene_notes(scene(name).whole()[0], _UP)
    assert note.startswith("the capture seems to be a scene: ") and "--object" in note


@pytest.mark.parametrize(("side", "is_scene"), [(1.3, False), (2.0, True)])
def test_the_ground_of_a_scene_is_larger_than_what_stands_on_it(side: float, is_scene: bool):
    """A cube of side 1 stands on a square plate. The part of the plate around it has 0.41 or 0.75 of the area; a plate
    that is a fifth of the height thick is a foot and not ground."""
    grid = np.linspace(-0.5, 0.5, 30)
    cube = np.stack(np.meshgrid(grid, grid, grid + 0.5), axis=-1).reshape(-1, 3)
    wide = side * np.linspace(-0.5, 0.5, 60)
    notes = []
    for thickness in (0.02, 0.2):
        plate = np.stack(np.meshgrid(wide, wide, np.linspace(0.0, thickness, 5)), axis=-1).reshape(-1, 3)
        notes.append(scene_notes(lying(np.concatenate([cube, plate])), _UP))
    assert [len(each) for each in notes] == [is_scene, 0]


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "up", "is_scene"),
    [
        ("scenes/koala.ply", [0.0, -1.0, 0.0], True),
        ("scenes/playbot", [0.0, -1.0, 0.0], True),
        ("scenes/fox.ply", [0.0, 0.0, 1.0], True),
        ("objects/robot.spz", [0.0, 1.0, 0.0], False),
        ("objects/plush_dog.ply", [0.0, -1.0, 0.0], False),
        ("objects/monkey.ply", [0.0, 1.0, 0.0], False),
    ],
)
def test_real_captures(data_dir: Path, name: str, up: list[float], is_scene: bool):
    notes = scene_notes(read_capture(data_dir / name).cloud, np.array(up))
    assert len(notes) == is_scene
