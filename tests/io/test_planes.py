"""``plane.json``: known keys are read, unknown keys are passed on, and damaged values are reported by name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.main_light import MainLight
from egs_warp.geometry.plane import Plane
from egs_warp.io.planes import HoleOutline, PlaneRecord, light_from_json, light_to_json, read_planes, write_planes
from tests.support.waves import wavy_ground

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), -0.25)
GROUND = wavy_ground(spacing=0.5)
HOLE = HoleOutline(np.array([1.0, 2.0, 0.25]), 0.5, (8, 6), (np.array([[1, 1], [4, 1], [4, 5]]),))
LIGHT = MainLight(np.array([0.0, 0.6, 0.8]), 5.0, 0.2, np.eye(4))


def test_known_values_are_read_back(tmp_path: Path) -> None:
    known = PlaneRecord(
        FLOOR, np.array([1.0, 2.0, 3.0]), 0.7, 0.01, 0.9, 120, 0.3, HOLE, GROUND, {"remark": ["a", 1]}, LIGHT
    )
    write_planes(tmp_path / "plane.json", [known, PlaneRecord(FLOOR)])
    full, bare = read_planes(tmp_path / "plane.json")
    assert full.to_json() == known.to_json() and full.pixels == 120 and full.others == {"remark": ["a", 1]}
    assert full.hole is not None and full.hole.texels == (8, 6) and np.array_equal(full.hole.outlines, HOLE.outlines)
    assert full.ground is not None and full.ground.ground_height(np.zeros(3)) == pytest.approx(
        GROUND.ground_height(np.zeros(3)), abs=1e-4
    )
    assert full.light is not None and np.array_equal(full.light.irradiance, LIGHT.irradiance)
    assert bare.to_json() == {"normal": [0.0, 0.0, 1.0], "offset": -0.25}


def test_new_values_replace_the_known_ones() -> None:
    before = PlaneRecord(FLOOR, noise=0.01, size=0.7, others={"remark": 1})
    now = PlaneRecord(Plane(np.array([0.0, 0.0, 1.0]), 0.0), size=0.8).merged_with(before)
    assert now.plane.offset == 0.0 and (now.noise, now.size, now.others) == (0.01, 0.8, {"remark": 1})


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"hole": {"texels": [8, 6]}}, "its hole is not valid; write the file again with egs-warp segment"),
        ({"hole": 3}, "its hole is not valid; write the file again with egs-warp segment"),
        ({"light": {"direction": [0, 0, 1]}}, "its light is damaged; write the file again with egs-warp segment"),
        (
            {"light": {"direction": [0, 0, 2], "half_angle": 5, "shade": 0.2, "irradiance": np.eye(4).tolist()}},
            "its light is damaged; write the file again with egs-warp segment",
        ),
        ({"ground": {"spacing": 1.0}}, "its ground is damaged; write the file again with egs-warp segment"),
        ({"ground": [1, 2]}, "its ground is damaged; write the file again with egs-warp segment"),
        (
            {"ground": {"axes": [[0] * 3] * 3, "origin": [0] * 3, "spacing": 1, "coefficients": [[0] * 4] * 4}},
            "its ground is damaged; write the file again with egs-warp segment",
        ),
        ({"noise": "low"}, "the properties of plane 0 are damaged; make it again"),
        ({"offset": 1e300}, "plane 0 lies 1e+300 units from the origin, the limit is 1e+12; make it again"),
        ({"centre": [1.0]}, "the properties of plane 0 are damaged; make it again"),
    ],
)
def test_damage_is_named(tmp_path: Path, facts: dict[str, object], message: str) -> None:
    path = tmp_path / "plane.json"
    path.write_text(json.dumps({"planes": [{"normal": [0, 0, 1], "offset": 0, **facts}]}))
    with pytest.raises(UserError) as error:
        read_planes(path)
    assert str(error.value) == f"{path}: {message}"


def test_plane_files_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "plane.json"
    planes = [FLOOR, Plane.from_coefficients(0.0, 1.0, 0.0, 2.0)]
    write_planes(path, [PlaneRecord(planes[0], noise=0.01), PlaneRecord(planes[1])])
    for one, other in zip((known.plane for known in read_planes(path)), planes, strict=True):
        np.testing.assert_allclose([*one.normal, one.offset], [*other.normal, other.offset])
    for text, message in (
        ("{", "not readable JSON"),
        ("[]", "it has no planes"),
        ('{"planes": [{"normal": [1, 2]}]}', "plane 0 needs normal"),
        ('{"planes": [{"normal": [0, 0, 0], "offset": 1}]}', "a normal that is not zero"),
        (f'{{"planes": [{{"normal": [0, 0, {401 * "1"}], "offset": 1}}]}}', "give four finite numbers"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=message):
            read_planes(path)


def test_every_main_light_can_be_read_again() -> None:
    """The limits of a light are the same in memory and in a file."""
    widest = replace(LIGHT, half_angle=89.0, shade=1.0)
    again = light_from_json(light_to_json(widest))
    assert (again.half_angle, again.shade) == (89.0, 1.0)
    for name, value, message in (
        ("half_angle", 90.0, "half_angle 90: give a number above 0, at most 89"),
        ("irradiance", -np.eye(4), "irradiance: its mean over all normals is not above 0"),
        ("irradiance", np.eye(4) + np.eye(4, k=1), "irradiance: it is not symmetric"),
    ):
        with pytest.raises(UserError, match=message):
            replace(LIGHT, **{name: value})
        entry = light_to_json(LIGHT) | {name: np.asarray(value).tolist()}
        with pytest.raises(ValueError, match="of the light is invalid"):
            light_from_json(entry)
