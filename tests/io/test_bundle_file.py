"""Errors in bundles: ``egs-warp validate`` and the reader report each problem in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.io.bundle import read_bundle, write_bundle
from egs_warp.io.bundle_arrays import PackedArray
from egs_warp.io.bundle_track import TrackPredictor
from tests.support.bundles import bundle_bytes, small_bundle, text_of, with_text


def _lines(data: bytes, folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, list[str]]:
    """Return the exit status of ``validate`` for a file with these bytes, and the lines that it prints."""
    path = folder / "a.egs"
    path.write_bytes(data)
    status = main(["validate", str(path)])
    said = capsys.readouterr()
    lines = (said.out + said.err).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines) and (said.out == "") == (status != 0)
    return status, [line.removeprefix(f"{path}: ") for line in lines]


def test_a_valid_bundle_is_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, (line,) = _lines(bundle_bytes(), tmp_path, capsys)
    assert status == 0
    assert line.startswith(
        "valid, version 2, 130 frames, 0.0 MB; block: 7 Gaussians, 8 nodes with an error of at most "
    )
    assert line.endswith("; scene: 7 Gaussians, static")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "the file does not begin with EGSB"),
        (b"PK\3\4" + bytes(60), "the file does not begin with EGSB"),
        (b"EGSB\1\0\0\0" + bytes(8), "version 1 of the format is not supported; this program reads version 2"),
        (b"EGSB\2\0\0\0\xff\0\0\0{}", "the JSON text of 255 bytes is longer than the file"),
        (b"EGSB\2\0\0\0\5\0\0\0hello", "the JSON text cannot be read"),
        (bundle_bytes()[:-1], "the data have "),
        (bundle_bytes() + b"x", "the data have "),
    ],
)
def test_a_file_of_another_kind_or_length_is_refused(
    data: bytes, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, lines = _lines(data, tmp_path, capsys)
    assert status == 2 and lines[0].startswith(said)
    with pytest.raises(UserError, match=r"is not a valid bundle: .*; export the run again"):
        read_bundle(tmp_path / "a.egs")


def test_another_kind_of_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "jump.mp4"
    film.write_bytes(b"\0\0\0\x20ftypisom")
    assert main(["validate", str(film)]) == 2
    expected = "it is a .mp4 file, not a bundle; give the .egs file that egs-warp export made from a run\n"
    assert capsys.readouterr().err == f"egs-warp: {film}: {expected}"


def _arrays(text: dict[str, Any]) -> dict[str, Any]:
    return text["bodies"][0]["arrays"]


def _block(text: dict[str, Any]) -> dict[str, Any]:
    return text["bodies"][0]["blocks"][1]


def _light(**changes: Any) -> dict[str, Any]:
    flat = [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]
    return {"direction": [0, 0, 1], "half_angle": 5, "shade": 0.2, "irradiance": flat, **changes}


def _double(entry: dict[str, Any]) -> None:
    entry["step"] = [0.1 * step for step in entry["step"]]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda t: t.pop("rate"), "the JSON text: 'rate' is a required property"),
        (lambda t: t.update(frames=2.0), "frames: 2.0 is not of type 'integer'"),
        (lambda t: _arrays(t).pop("bands"), "bodies/0/arrays: 'bands' is a required property"),
        (lambda t: _arrays(t)["means"].pop("error"), "bodies/0/arrays/means: 'error' is a dependency of 'step'"),
        (lambda t: _arrays(t)["means"].update(type="int8"), "bodies/0/arrays/means/type: 'int8' is not one of"),
        (lambda t: _arrays(t)["means"].update(shape=[7, 4]), "bodies/0/means: its bytes do not inflate to the 56"),
        (lambda t: _arrays(t)["means"].update(shape=[70000, 3]), "bodies/0/means: "),
        (lambda t: _arrays(t)["means"].update(lower=[0, 0]), "bodies/0/means: lower and step have 2 and 3 values"),
        (lambda t: _double(_arrays(t)["means"]), "bodies/0/means: the error "),
        (lambda t: _arrays(t)["tets"].update(lower=[0], step=[1], error=0), "bodies/0/tets: it holds whole numbers"),
        (lambda t: _arrays(t)["tets"].update(offset=0), "bodies/0/tets: its bytes overlap"),
        (
            lambda t: [_arrays(t)["bands"].pop(k) for k in ("lower", "step", "error")],
            "bodies/0: bands are not uint8 with",
        ),
        (lambda t: _arrays(t)["bands"].update(lower=[0] * 3), "bodies/0: lower of bands is not -128 steps"),
        (lambda t: t.update(light={"direction": [0, 0, 1]}), "light: 'half_angle' is a required property"),
        (
            lambda t: t.update(light=_light(direction=[0, 0, 2])),
            "the direction, angle, shade or irradiance of the light",
        ),
        (lambda t: t.update(light=_light(shade=1)), "light/shade: 1 is greater than or equal to the maximum of 1"),
        (lambda t: _arrays(t).update(normals=_arrays(t)["means"]), "bodies/0/normals: its bytes overlap"),
        (
            lambda t: t["bodies"][0]["level_set"].update(counts=[4, 4, 5]),
            "bodies/0: level_set has shape [60], not [80]",
        ),
        (lambda t: _arrays(t).pop("level_set"), "bodies/0/arrays: 'level_set' is a required property"),
        (lambda t: t["bodies"].reverse(), "the arrays are not in order: those of all bodies, then the first blocks"),
        (lambda t: t["bodies"][1].update(count=6), "bodies/1: means has shape [7, 3], not [6, 3]"),
        (lambda t: _block(t).update(arrays={}), "bodies/0/blocks/1/arrays: 'residuals' is a required property"),
        (lambda t: _block(t).update(frames=59), "bodies/0: blocks/1: residuals has shape [1440], not [1416]"),
        (lambda t: _arrays(t)["weights"].update(step=[0.01]), "bodies/0: lower of weights is not -128 steps"),
        (lambda t: t["bodies"][0].pop("node_step"), "bodies/0: 'node_step' is a dependency of 'blocks'"),
        (lambda t: _block(t).update(first=59), "bodies/0: blocks/1: begins at frame 59, not 60"),
        (lambda t: t.update(frames=131), "bodies/0: its blocks have 130 frames, but the bundle has 131"),
        (lambda t: t["bodies"][0].update(node_error=1e-3), "bodies/0: node_error 0.001 is larger than"),
    ],
)
def test_each_kind_of_damage_is_named(
    damage: Callable[[dict[str, Any]], object], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = text_of(bundle_bytes())
    damage(text)
    status, lines = _lines(with_text(json.dumps(text).encode()), tmp_path, capsys)
    assert status == 2 and any(line.startswith(said) for line in lines), lines


@pytest.mark.parametrize("name", ["cage_tets", "surface", "tets", "carriers", "arm_tets"])
def test_an_index_beyond_the_cage_is_found(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = small_bundle()
    body = made.bodies[0]
    assert body.cage is not None
    values = getattr(body.cage, name).copy()
    values.flat[0] = 200
    write_bundle(tmp_path / "b.egs", replace(made, bodies=(replace(body, cage=replace(body.cage, **{name: values})),)))
    status, lines = _lines((tmp_path / "b.egs").read_bytes(), tmp_path, capsys)
    assert status == 2 and any(line.startswith(f"bodies/0: {name} has the index 200") for line in lines), lines


@pytest.mark.parametrize(
    ("name", "position", "said"),
    [
        ("order", 0, "order does not contain each node exactly once"),
        ("parents", 3, "parents has a position that is not before its own"),
        ("weights", 0, "the weights of the first position are not 0"),
    ],
)
def test_a_wrong_predictor_is_found(
    name: str,
    position: int,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arrays_of = TrackPredictor.arrays

    def damaged(predictor: TrackPredictor) -> dict[str, PackedArray]:
        arrays = arrays_of(predictor)
        arrays[name].stored[position] = 7
        return arrays

    monkeypatch.setattr(TrackPredictor, "arrays", damaged)
    write_bundle(tmp_path / "b.egs", small_bundle())
    status, lines = _lines((tmp_path / "b.egs").read_bytes(), tmp_path, capsys)
    assert status == 2 and lines == [f"bodies/0: {said}"]


def test_all_findings_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = text_of(bundle_bytes())
    text["frames"] = 131
    text["bodies"][1]["count"] = 6
    status, lines = _lines(with_text(json.dumps(text).encode()), tmp_path, capsys)
    # There is one line for the number of frames, and one for each of the six arrays of the static body's splats.
    assert status == 2 and len(lines) == 7


def test_a_missing_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", str(tmp_path / "none.egs")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
