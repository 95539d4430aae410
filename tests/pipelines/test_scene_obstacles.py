"""Obstacles of a scene: ground with an edge, boxes beside it, and free space in a room."""

from __future__ import annotations

from functools import cache

import numpy as np

from egs_warp.contact.terrain import surface_above
from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.pipelines.locate_plane import LocatedPlane
from egs_warp.pipelines.prepare_objects import PreparedObjects
from egs_warp.pipelines.prepare_scene import PreparedScene
from egs_warp.pipelines.scene_obstacles import SceneObstacles, box_between, measure_obstacles
from egs_warp.segmentation.object_spec import Segmentation
from tests.support.scenes import blocks

FRAME = BodyFrame(np.eye(3), np.zeros(3), 1.0)
UP = np.array([0.0, 0.0, 1.0])


OBJECT = blocks(((-0.2, -0.2, 0.02), (0.2, 0.2, 1.0)))
TABLE = ((-1.2, -1.2, -0.04), (1.2, 1.2, 0.0))
BOX = ((0.6, -0.4, 0.0), (1.0, 0.4, 0.5))


@cache
def obstacles_of(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> SceneObstacles:
    none = np.zeros(1, bool)
    located = LocatedPlane(GROUND, None, np.array([0.0, 0.0, 0.5]), 1.0, Segmentation(none, none, none, 1.0), ())
    background = blocks(*boxes)
    scene = PreparedScene(OBJECT, background, background, GROUND, None, located, ())
    return measure_obstacles(PreparedObjects({"thing": scene}, {"thing": GROUND}, ()), FRAME, height=1.0)


def test_the_ground_of_a_table_ends_at_its_edge() -> None:
    found = obstacles_of(TABLE, BOX)
    assert found.ground is not None and found.notes[0].startswith("the ground ends beside the objects")
    on_table = np.array([[0.0, 0.0, 0.0], [1.1, 1.1, 0.0], [-1.1, 0.3, 0.0]])
    np.testing.assert_allclose(found.ground.ground_height(on_table), 0.0, atol=1e-9)
    beyond = np.array([[1.5, 0.0, 0.0], [0.0, -1.5, 0.0], [2.4, 2.4, 0.0], [9.0, 0.0, 0.0]])
    np.testing.assert_allclose(found.ground.ground_height(beyond), -2.0, atol=1e-9)


def test_what_stands_beside_the_object_is_solid_and_the_object_is_free() -> None:
    """The box is found down to the table, with its top accurate to 1.5 cells of 0.04 m, and nothing else is solid."""
    found = obstacles_of(TABLE, BOX)
    assert 1 <= len(found.solids) <= 3

    def top(x: float, y: float) -> float:
        return surface_above(found.solids, np.array([x, y, 0.0]), UP)

    for x, y in ((0.8, 0.0), (0.66, -0.34), (0.94, 0.34)):
        assert abs(top(x, y) - 0.5) <= 0.06
    for x, y in ((0.0, 0.0), (0.5, 0.0), (0.8, 0.5), (1.1, 0.0), (-0.8, -0.8)):
        assert top(x, y) == -np.inf
    inside = np.array([0.8, 0.0, 0.02])
    assert any(all(face.heights(inside) < 0.0 for face in solid.faces) for solid in found.solids)


def test_a_room_is_not_filled() -> None:
    """Walls and a ceiling enclose the object in every direction; the space between them stays free."""
    low, high = (-2.0, -2.0, -0.04), (2.0, 2.0, 1.3)
    found = obstacles_of((low, high))
    for point in ((0.8, 0.0, 0.5), (-1.5, 1.5, 0.9), (0.0, 0.0, 0.5)):
        at = np.array(point)
        assert not any(all(face.heights(at) < 0.0 for face in solid.faces) for solid in found.solids), point
    wall = np.array([2.0, 0.0, 0.5])
    assert any(all(face.heights(wall) < 0.01 for face in solid.faces) for solid in found.solids)


def test_level_ground_without_an_edge_is_a_plane() -> None:
    found = obstacles_of(((-3.2, -3.2, -0.04), (3.2, 3.2, 0.0)))
    assert found.ground is None and found.solids == ()
    assert found.notes == ("obstacles: none; nothing stands beside the objects",)


def test_given_solids_replace_the_measured_ones() -> None:
    """Solids are given in the frame of the capture. In a world of another scale they are scaled, and the ground is
    still the measured one."""
    none = np.zeros(1, bool)
    located = LocatedPlane(GROUND, None, np.array([0.0, 0.0, 0.5]), 1.0, Segmentation(none, none, none, 1.0), ())
    background = blocks(TABLE, BOX)
    scene = PreparedScene(OBJECT, background, background, GROUND, None, located, ())
    frame = BodyFrame(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3), 0.5)
    prepared = PreparedObjects({"thing": scene}, {"thing": GROUND}, ())
    box = box_between(np.array([0.6, -0.4, -1.0]), np.array([1.0, 0.4, 0.5]))
    found = measure_obstacles(prepared, frame, height=0.5, solids=(box,))
    assert len(found.solids) == 1 and len(found.notes) == 1
    assert found.ground is not None and found.ground.ground_height(np.array([0.9, 0.0, 0.0])) < -0.5
    assert surface_above(found.solids, np.array([0.0, -0.4, 0.0]), UP) == 0.25
    assert surface_above(found.solids, np.array([0.4, 0.0, 0.0]), UP) == -np.inf
