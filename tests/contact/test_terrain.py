"""Solids beside the ground: where their tops are, and every mistake of a terrain file named in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.assets import pawn
from egs_warp.contact.terrain import Solid, read_terrain, step, surface_above
from egs_warp.errors import UserError
from egs_warp.geometry.plane import Plane
from egs_warp.pipelines.creature import make_creature

UP = np.array([0.0, 0.0, 1.0])
FLOOR = Plane(UP, 0.0)


def test_tops_of_a_step_a_ramp_a_wall_and_a_box() -> None:
    stair = step(FLOOR, np.array([0.5, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]), 0.2)
    ramp = Solid((Plane.from_coefficients(-np.tan(np.radians(10.0)), 0.0, 1.0, 0.0),))
    wall = Solid((Plane.from_coefficients(0.0, -1.0, 0.0, 1.0),))
    box = Solid((*stair.faces, Plane.from_coefficients(1.0, 0.0, 0.0, -2.0)))
    at = np.array([0.7, 0.3, 0.1])
    assert stair.top(at, UP) == pytest.approx(0.1)
    assert stair.top(at - [0.3, 0.0, 0.0], UP) == -np.inf
    assert ramp.top(at, UP) == pytest.approx(0.7 * np.tan(np.radians(10.0)) - 0.1)
    assert wall.top(at, UP) == -np.inf
    assert box.top(at, UP) == pytest.approx(0.1) and box.top(at + [2.0, 0.0, 0.0], UP) == -np.inf
    assert surface_above((Solid((FLOOR,)), stair, ramp, wall), at, UP) == pytest.approx(0.1)
    assert surface_above((), at, UP) == -np.inf
    assert stair.scaled(2.0).top(2.0 * at, UP) == pytest.approx(0.2)


def test_a_terrain_file(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    path.write_text("[[[0, 0, 2, -0.4], [-1, 0, 0, 0.5]], [[0, 1, 0, 3]]]")
    stair, wall = read_terrain(path)
    assert stair.faces[0].offset == -0.2 and len(stair.faces) == 2 and len(wall.faces) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "not JSON"),
        ("{}", "give a list of solids, each a list of faces [nx, ny, nz, d]"),
        ("[[]]", "solid 1: give a list of faces, each four numbers [nx, ny, nz, d]"),
        ("[[[0, 0, 1]]]", "solid 1: give a list of faces, each four numbers [nx, ny, nz, d]"),
        ('[[[0, 0, 1, "a"]]]', "solid 1: give a list of faces, each four numbers [nx, ny, nz, d]"),
        ("[[[0, 0, 1, 0]], [[0, 0, 0, 1]]]", "solid 2: plane 0,0,0,1: give four finite numbers"),
        (f"[[[0, 0, 1, {401 * '1'}]]]", "solid 1: plane 0,0,1,inf: give four finite numbers"),
        (f"[[[0, 0, 1, {5000 * '1'}]]]", "solid 1: plane 0,0,1,inf: give four finite numbers"),
        ("[[[1e300, 1e300, 1, 0]]]", "solid 1: plane 1e+300,1e+300,1,0: give four finite numbers"),
        (str([[[0, 0, 1, 0]]] * 65), "65 faces; at most 64 are handled"),
    ],
)
def test_mistakes_of_a_terrain_file(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "t.json"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        read_terrain(path)
    assert str(error.value).startswith(str(path)) and message in str(error.value) and "\n" not in str(error.value)


def test_a_slope_that_nothing_stands_on_is_refused() -> None:
    thing = pawn(device="cpu")
    with pytest.raises(UserError) as error:
        make_creature(thing.cloud, plane=thing.plane, gravity_up=np.array([1.0, 0.0, 0.5]))
    assert str(error.value) == (
        "gravity_up 1,0,0.5: that makes the ground a slope of 63 degrees; give a direction at most 45 degrees from"
        " the ground's normal 0,0,1"
    )


def test_a_solid_that_holds_the_body_is_named(tmp_path: Path) -> None:
    """The second floor's normal points down into the body."""
    thing = pawn(device="cpu")
    path = tmp_path / "t.json"
    path.write_text("[[[0, 1, 0, 9]], [[0, 0, 1, -3]]]")
    with pytest.raises(UserError) as error:
        make_creature(thing.cloud, plane=thing.plane, solids=read_terrain(path))
    assert str(error.value) == (
        "solids: the body is inside number 2; inside is where n.x + d < 0 for every face [nx, ny, nz, d]:"
        " turn the signs of a face, or move the solid"
    )
