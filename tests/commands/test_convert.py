"""Conversion of captures: exactly the reported losses occur."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from egs_warp.cli import main
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io import read_capture, write_ply, write_spz
from egs_warp.io.conversion_loss import conversion_loss
from egs_warp.io.sequence import numbered_captures
from egs_warp.io.writing import WRITERS
from tests.support.captures import assert_same_bits, make_cloud


@pytest.mark.parametrize("kind", WRITERS)
def test_a_capture_becomes_another(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "a.ply", make_cloud(400, 2))
    out = tmp_path / f"b{WRITERS[kind][0]}"
    assert main(["convert", str(tmp_path / "a.ply"), str(out), *(["--to", kind] if kind == "spz4" else [])]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"wrote {out} (")
    assert ("nothing is lost: every bit is the same" in said) == (kind == "ply")
    assert ("degree 2 are now of degree 0; colours no longer change" in said) == (kind == "splat")
    assert ("viewers take +y as up" in said) == (kind in ("spz", "spz4", "glb"))
    read = read_capture(out)
    assert read.cloud.count == 400
    if WRITERS[kind][0] == ".spz":
        assert read.format == f".spz version {4 if kind == 'spz4' else 3}"


def test_reported_losses_are_the_actual_ones(tmp_path: Path) -> None:
    """The changes are known, and the Gaussians are in a shuffled order."""
    cloud = make_cloud(500, 1)
    rng = np.random.default_rng(0)
    step = np.array([0.003, 0.0, 0.0])
    changed = GaussianCloud.from_numpy(
        cloud.means.numpy() + step,
        cloud.rotations.numpy(),
        cloud.log_scales.numpy() + np.log(1.02),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
    ).subset(rng.permutation(500)[:498])
    write_ply(tmp_path / "a.ply", cloud)
    write_ply(tmp_path / "b.ply", changed)
    gone, said = conversion_loss(read_capture(tmp_path / "a.ply"), read_capture(tmp_path / "b.ply"))
    assert gone == "2 of 500 Gaussians are gone"
    assert "positions 0.003 (at most 0.003) units" in said and "deviations by 2 (at most 2) %" in said
    assert "opacities 0 (at most 0) of 255" in said and "higher bands 0 (at most 0)" in said


def test_a_sequence_is_converted_in_the_order_of_its_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clouds = {number: make_cloud(30, seed=number) for number in (2, 10, 9)}
    for number, cloud in clouds.items():
        write_ply(tmp_path / f"frame{number}.ply", cloud)
    (tmp_path / "readme.txt").write_text("not a capture")
    assert [path.name for path in numbered_captures(tmp_path)] == ["frame2.ply", "frame9.ply", "frame10.ply"]
    assert main(["convert", str(tmp_path), str(tmp_path / "out"), "--to", "ply", "--degree", "0"]) == 0
    assert "frame2.ply to frame10.ply" in capsys.readouterr().out
    for number, cloud in clouds.items():
        assert_same_bits(read_capture(tmp_path / "out" / f"frame{number}.ply", device="cpu").cloud, cloud)


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "a.ply", make_cloud(3))
    (tmp_path / "two").mkdir()
    for name in ("a1.ply", "b1.ply"):
        write_ply(tmp_path / "two" / name, make_cloud(3))
    (tmp_path / "same").mkdir()
    for name in ("a1.ply", "a01.ply"):
        write_ply(tmp_path / "same" / name, make_cloud(3))
    before = (tmp_path / "a.ply").read_bytes()
    for flags, said in (
        (["a.ply", "b.xyz"], "b.xyz: give a name that ends in .compressed.ply, .ply, .spz, .sog, .splat, .glb"),
        (["a.ply", "a.ply"], "a.ply: is the input file; give another name"),
        (["a.ply", "no/b.ply"], "its folder does not exist"),
        (["none.ply", "b.ply"], "none.ply: no such file"),
        (["a.ply", "out", "--to", "spz4"], "out: give a name that ends in .spz"),
        (["a.ply", "b.ply", "--to", "compressed-ply"], "b.ply: give a name that ends in .compressed.ply"),
        (["a.ply", "b.compressed.ply", "--to", "ply"], "b.compressed.ply: give a name that ends in .ply"),
        (["no", "out", "--to", "ply"], "no: no such file or folder"),
        ([".", "out", "--to", "ply"], "it has no numbered captures such as frame0001.ply"),
        (["two", "out", "--to", "ply"], "it has two sequences (a0001.ply and b0001.ply)"),
        (["same", "out", "--to", "ply"], "two of its captures have the same number"),
        (["two", "two", "--to", "ply"], "it has two sequences"),
    ):
        paths = [str(tmp_path / part) for part in flags[:2]]
        assert main(["convert", *paths, *flags[2:]]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1, flags
    assert (tmp_path / "a.ply").read_bytes() == before


def test_omissions_of_the_reader_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_spz(tmp_path / "a.spz", make_cloud(50))
    assert main(["convert", str(tmp_path / "a.spz"), str(tmp_path / "b.ply")]) == 0
    assert re.search("the up direction is lost", capsys.readouterr().out)
