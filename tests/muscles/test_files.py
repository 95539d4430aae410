"""Muscles read from JSON files, and the plot of a body's muscles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.muscles.fibres import FibreKind
from egs_warp.muscles.files import read_muscles
from egs_warp.muscles.plot import plot_muscles
from tests.support.meshes import block_mesh

UP = np.array([0.0, 0.0, 1.0])
MESH = block_mesh(5, 5, 11)
"""Column of 0.4 x 0.4 x 1 m that stands on z = 0."""

STRAIGHT = {"name": "back", "kind": "longitudinal", "from": [0.1, 0, 0.1], "to": [0.1, 0, 0.9]}
HOOP = {"name": "belt", "kind": "circular", "centre": [0, 0, 0.5], "axis": [0, 0, 2], "radius": 0.12}
SPOKES = {"name": "spokes", "kind": "radial", "centre": [0, 0, 0.3], "axis": [0, 0, 1], "radius": 0.12, "count": 3}
FREE = {"name": "free", "kind": "polyline", "points": [[0.1, 0.1, 0.2], [0, 0, 0.5], [-0.1, 0.1, 0.8]]}


def write(folder: Path, content: Any) -> Path:
    path = folder / "muscles.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_every_kind_is_made_as_written(tmp_path: Path) -> None:
    path = write(tmp_path, {"fibres": [{**STRAIGHT, "segments": 3, "strength": 1.5}, HOOP, SPOKES, FREE]})
    muscles = read_muscles(path, MESH, body_weight=100.0)
    assert muscles.fibre_names == ("back", "belt", "spokes 1", "spokes 2", "spokes 3", "free")
    counts = np.bincount(muscles.fibre_from_segment).tolist()
    assert counts == [3, 8, 1, 1, 1, 2]
    assert muscles.fibre_kinds[1:3] == (FibreKind.CIRCULAR, FibreKind.RADIAL)
    np.testing.assert_allclose(muscles.max_forces[:3], 150.0)
    np.testing.assert_allclose(muscles.max_forces[3:], 200.0)
    np.testing.assert_allclose(muscles.rest_lengths[:3], 0.8 / 3, rtol=0.1)
    np.testing.assert_allclose(muscles.rest_lengths[11:14], 0.24, rtol=0.1)
    np.testing.assert_allclose(muscles.bounds, 0.3 * muscles.rest_lengths)
    hoop = muscles.segments[3:11]
    assert np.array_equal(hoop[:, 1], np.roll(hoop[:, 0], -1))


def test_stiffness_strain_units_groups_and_partners(tmp_path: Path) -> None:
    """Lengths are in units of the capture, a given stiffness is used unchanged, and a mirrored fibre is the
    partner of its original."""
    doubled = {**FREE, "points": (2.0 * np.array(FREE["points"])).tolist(), "mirror": True, "group": "sides"}
    content = {
        "max_strain": 0.2,
        "mirror_plane": {"point": [0, 0, 0], "normal": [0, 3, 0]},
        "fibres": [{**doubled, "stiffness": 50}, {**doubled, "name": "other", "mirror": False, "group": "one"}],
    }
    muscles = read_muscles(
        write(tmp_path, content), MESH, body_weight=100.0, frame=BodyFrame(np.eye(3), np.zeros(3), 0.5)
    )
    assert muscles.fibre_partners.tolist() == [1, 0, -1]
    assert muscles.fibre_groups.tolist() == [0, 0, 1]
    np.testing.assert_allclose(muscles.stiffness[:4], 50.0)
    np.testing.assert_allclose(muscles.bounds, 0.2 * muscles.rest_lengths)
    ends = muscles.end_points(MESH.nodes)[muscles.segments[:4, 0]]
    np.testing.assert_allclose(ends[:2] * [1, -1, 1], ends[2:], atol=0.02)
    np.testing.assert_allclose(ends[0], [0.1, 0.1, 0.2], atol=0.02)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not JSON at line 1"),
        ([], "the file contains no object"),
        ({}, 'no fibres; give a list "fibres"'),
        ({"fibres": []}, 'no fibres; give a list "fibres"'),
        (
            {"fibres": [STRAIGHT], "fibers": []},
            "\"fibers\" is not known here (did you mean 'fibres'?); use fibres, max_strain, mirror_plane",
        ),
        ({"fibres": [STRAIGHT], "max_strain": 1.5}, '"max_strain" is 1.5; give a number below 1'),
        ({"fibres": [STRAIGHT], "mirror_plane": 1}, '"mirror_plane" is 1; give an object with "point" and "normal"'),
        (
            {"fibres": [STRAIGHT], "mirror_plane": {"point": [0, 0, 0], "normal": [0, 0, 0]}},
            'mirror_plane: "normal" is zero; give a direction',
        ),
        ({"fibres": [3]}, "fibre 1 is not an object"),
        ({"fibres": [STRAIGHT, {"kind": "radial"}]}, 'fibre 2 has no name; give it a "name"'),
        ({"fibres": [{"name": "a", "kind": "round"}]}, 'fibre "a" has the kind "round"; give "kind" as one of'),
        ({"fibres": [{**STRAIGHT, "radius": 1}]}, 'fibre "back": "radius" is not known here'),
        ({"fibres": [{**STRAIGHT, "from": [0, 0]}]}, '"from" is [0, 0]; give three finite numbers'),
        ({"fibres": [{**STRAIGHT, "from": [0, 0, float("nan")]}]}, "give three finite numbers"),
        ({"fibres": [{**STRAIGHT, "from": [0, 0, 10**401]}]}, '"from" is [0, 0, Infinity]; give three finite numbers'),
        ({"fibres": [{**STRAIGHT, "strength": 10**401}]}, '"strength" is Infinity; give a number above 0'),
        ('{"fibres": ' + 5000 * "1" + "}", 'no fibres; give a list "fibres"'),
        ({"fibres": [{"name": "\ud800\n", "kind": 1}]}, 'fibre "\\ud800\\n" has the kind 1'),
        ({"fibres": [{**STRAIGHT, "segments": 0}]}, '"segments" is 0; give a whole number from 1 to 400'),
        ({"fibres": [{**STRAIGHT, "strength": -1}]}, '"strength" is -1; give a number above 0'),
        ({"fibres": [{**STRAIGHT, "strength": 1, "stiffness": 1}]}, 'both "strength" and "stiffness"'),
        ({"fibres": [{**STRAIGHT, "group": 7}]}, '"group" is 7; give a name in quotes'),
        ({"fibres": [{**STRAIGHT, "mirror": "x"}]}, '"mirror" is "x"; give true or false'),
        ({"fibres": [{**STRAIGHT, "mirror": True}]}, "is mirrored but the file has no plane"),
        ({"fibres": [STRAIGHT, STRAIGHT]}, 'fibre "back" occurs twice'),
        ({"fibres": [{**STRAIGHT, "to": [0, 0, 9]}]}, "the point [0, 0, 9] is 8 units away from the body"),
        ({"fibres": [{**STRAIGHT, "to": STRAIGHT["from"]}]}, "has two equal points in a row, ["),
        ({"fibres": [{**STRAIGHT, "segments": 400}, {**STRAIGHT, "name": "b"}]}, "404 segments in all"),
        (
            {"fibres": [{**FREE, "points": [[0, 0, 0.5]]}]},
            '"points" is [[0, 0, 0.5]]; give a list of at least two points',
        ),
        ({"fibres": [{**FREE, "points": [[0, 0, 0.5], "x"]}]}, 'point 2 is "x"; give three finite numbers'),
        ({"fibres": [{**HOOP, "segments": 2}]}, '"segments" is 2; give a whole number from 3'),
        ({"fibres": [{**HOOP, "radius": 0}]}, '"radius" is 0; give a number above 0'),
        ({"fibres": [{**SPOKES, "axis": [0, 0, 0]}]}, '"axis" is zero; give a direction'),
        ({"fibres": [{**SPOKES, "count": 1.5}]}, '"count" is 1.5; give a whole number'),
    ],
)
def test_each_malformed_entry_is_refused_in_one_line(tmp_path: Path, content: Any, message: str) -> None:
    path = write(tmp_path, content)
    with pytest.raises(UserError) as error:
        read_muscles(path, MESH, body_weight=1.0)
    assert message in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.json: no such file or folder"):
        read_muscles(tmp_path / "none.json", MESH, body_weight=1.0)
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match=r"binary\.json: not a text file"):
        read_muscles(tmp_path / "binary.json", MESH, body_weight=1.0)


def test_the_plot_shows_each_kind_in_its_colour(tmp_path: Path) -> None:
    """The plot has three views side by side. The colour of a kind of fibre appears if and only if the body has fibres
    of that kind."""
    red, green = np.array([60, 60, 210]), np.array([60, 160, 60])

    def seen(image: np.ndarray, colour: np.ndarray) -> int:
        return int((np.abs(image.astype(int) - colour).max(axis=2) < 6).sum())

    for fibres, expected in (([STRAIGHT], (True, False)), ([STRAIGHT, SPOKES], (True, True))):
        muscles = read_muscles(write(tmp_path, {"fibres": fibres}), MESH, body_weight=1.0)
        plot_muscles(MESH, muscles, tmp_path / "muscles.png", up=UP, front=np.array([1.0, 0.0, 0.0]))
        image = cv2.imread(str(tmp_path / "muscles.png"))
        assert image is not None
        assert image.shape[1] == 1920
        assert (seen(image, red) > 500, seen(image, green) > 500) == expected
    with pytest.raises(UserError, match=r"muscles\.png: its folder does not exist; create"):
        plot_muscles(MESH, muscles, tmp_path / "none" / "muscles.png", up=UP, front=np.array([1.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("front", "sides"), [((1, 0, 0), (0, -1)), ((-1, 0, 0), (0, 1)), ((0, 1, 0), (-1, 0)), ((0, -1, 0), (1, 0))]
)
def test_the_views_are_those_of_the_front(tmp_path: Path, front: tuple[int, ...], sides: tuple[int, int]) -> None:
    """In the views from the front and from the left, the fibre at x = 0.1 is in the middle, on the left or on the
    right, depending on the ``front``."""
    muscles = read_muscles(write(tmp_path, {"fibres": [STRAIGHT]}), MESH, body_weight=1.0)
    plot_muscles(MESH, muscles, tmp_path / "muscles.png", up=UP, front=np.array(front))
    image = cv2.imread(str(tmp_path / "muscles.png"))
    assert image is not None
    third = image.shape[1] // 3
    for view, side in enumerate(sides):
        # The legend below the views is cut off.
        panel = image[: int(0.85 * len(image)), view * third : (view + 1) * third].astype(int)
        grey = np.ptp(panel, axis=2).max(axis=0) < 40
        columns = ((panel.max(axis=2) < 240) & (panel.min(axis=2) > 150)).sum(axis=0) > 300
        # Columns of the body are wide, unlike the lines of the grid.
        body = np.flatnonzero(np.convolve(columns, np.ones(9), "same") > 8.0)
        fibre = np.flatnonzero(~grey).mean()
        middle, quarter = 0.5 * (body[0] + body[-1]), 0.25 * (body[-1] - body[0])
        assert fibre == pytest.approx(middle + side * quarter, abs=0.2 * quarter), view
