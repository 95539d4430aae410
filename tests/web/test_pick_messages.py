"""Messages of the page of ``egs-warp pick``."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from egs_warp.web.pick_messages import (
    AddObject,
    Mark,
    MovePlane,
    RenameObject,
    RunAnimate,
    RunLive,
    SelectObject,
    TurnFront,
    Undo,
    read_pick_message,
)

MARK: dict[str, Any] = {
    "type": "mark",
    "inside": True,
    "eye": [4, 0, 1],
    "target": [0, 0, 0.5],
    "fov": 30,
    "width": 640,
    "height": 480,
    "pixels": [[320, 240], [10.5, 20]],
}


def test_a_mark_has_the_camera_of_the_page():
    mark = read_pick_message(MARK)
    assert isinstance(mark, Mark) and mark.inside and mark.pixels == ((320.0, 240.0), (10.5, 20.0))
    assert (mark.camera.width, mark.camera.height) == (640, 480)
    assert mark.camera.centre == pytest.approx([4.0, 0.0, 1.0])
    ahead = np.array([-4.0, 0.0, -0.5])
    assert mark.camera.rotation[2] == pytest.approx(ahead / np.linalg.norm(ahead))
    assert 2.0 * np.degrees(np.arctan(240.0 / mark.camera.fy)) == pytest.approx(30.0)


def test_pixels_at_the_edge_are_moved_into_the_picture():
    mark = read_pick_message({**MARK, "pixels": [[640, -1]]})
    assert isinstance(mark, Mark)
    ((u, v),) = mark.pixels
    assert 639.0 < u < 640.0 and v == 0.0


def test_the_other_messages_become_records():
    plane = read_pick_message({"type": "plane", "normal": [0, 0, 2], "offset": -1})
    assert isinstance(plane, MovePlane)
    assert plane.plane.normal == pytest.approx([0.0, 0.0, 1.0]) and plane.plane.offset == -0.5
    front = read_pick_message({"type": "front", "direction": [0, 3, 4]})
    assert isinstance(front, TurnFront) and front.direction == pytest.approx([0.0, 0.6, 0.8])
    assert read_pick_message({"type": "select", "index": 3}) == SelectObject(3)
    assert read_pick_message({"type": "rename", "name": " toy "}) == RenameObject("toy")
    assert read_pick_message({"type": "add"}) == AddObject()
    assert (read_pick_message({"type": "undo"}), read_pick_message({"type": "redo"})) == (Undo(), Undo(redo=True))
    assert read_pick_message({"type": "animate", "motion": "hop x3, twist 90"}) == RunAnimate("hop x3, twist 90")
    assert read_pick_message({"type": "live"}) == RunLive()


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ({"type": "drop"}, "type 'drop' is unknown; known types are mark"),
        ({"type": "save", "path": "/etc/passwd"}, "save has no field 'path'"),
        ({**MARK, "inside": 1}, "inside: give true or false"),
        ({**MARK, "eye": [0, 0]}, "eye: give three numbers"),
        ({**MARK, "eye": [0, 0, float("nan")]}, "eye: give a number from"),
        ({**MARK, "eye": [0, 0, 3]}, "target: give a point that is not straight above or below the eye"),
        ({**MARK, "fov": 0}, "fov: give a number from 1 to 170"),
        ({**MARK, "width": 100000}, "width: give a number from 1 to 8192"),
        ({**MARK, "pixels": []}, "pixels: give 1 to 24 pairs of numbers"),
        ({**MARK, "pixels": [[1, 2]] * 25}, "pixels: give 1 to 24 pairs of numbers"),
        ({**MARK, "pixels": [[1]]}, "pixels: give pairs of numbers"),
        ({**MARK, "pixels": [[1, True]]}, "pixels: give a number"),
        ({"type": "plane", "normal": [0, 0, 0], "offset": 0}, "normal: give three numbers, not all zero"),
        ({"type": "plane", "normal": [0, 0, 1]}, "offset: give a number"),
        ({"type": "front", "direction": [0, 0, 0]}, "direction: give three numbers, not all zero"),
        ({"type": "select", "index": 20}, "index: give a number from 0 to 19"),
        ({"type": "rename", "name": " "}, "name: give 1 to 60 printable characters"),
        ({"type": "rename", "name": "a\nb"}, "name: give 1 to 60 printable characters"),
        ({"type": "animate", "motion": "script.json"}, "text: give motions by name and number"),
        ({"type": "animate"}, "text: give motions"),
    ],
)
def test_an_invalid_message_is_explained(message: dict[str, Any], text: str):
    with pytest.raises(ValueError, match=text):
        read_pick_message(message)
