"""Note about a capture that seems to be a scene instead of an object."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from egs_warp.assets import BuiltInObject, pawn, scene, stool
from egs_warp.commands.scene_hint import scene_notes
from egs_warp.io import read_capture

_UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("made", [pawn, stool])
def test_an_object_alone_gets_no_note(made: Callable[..., BuiltInObject]):
    assert scene_notes(made(gaussian_count=3000).cloud, _UP) == []


def test_an_object_on_its_ground_gets_a_note():
    (note,) = scene_notes(scene("pawn").whole()[0], _UP)
    assert "--object" in note


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "up", "is_scene"),
    [
        ("scenes/koala.ply", [0.0, -1.0, 0.0], True),
        ("scenes/playbot", [0.0, -1.0, 0.0], True),
        ("objects/plush_dog.ply", [0.0, -1.0, 0.0], False),
        ("objects/monkey.ply", [0.0, 1.0, 0.0], False),
    ],
)
def test_real_captures(data_dir: Path, name: str, up: list[float], is_scene: bool):
    notes = scene_notes(read_capture(data_dir / name).cloud, np.array(up))
    assert len(notes) == is_scene
