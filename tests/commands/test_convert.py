"""Conversion of captures: the reported losses are the losses that occur."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.cli import main
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io import Capture, read_capture, write_ply, write_spz
from egs_warp.io.conversion_loss import conversion_loss
from egs_warp.io.glb import write_glb
from egs_warp.io.sequence import numbered_captures
from egs_warp.io.writing import WRITERS, capture_stem
from egs_warp.pipelines.edit_capture import CaptureEdits, edit_capture, merge_captures
from tests.support.captures import assert_same_bits, make_cloud
from tests.support.ply_variants import columns_of, ply_of


@pytest.mark.parametrize("kind", WRITERS)
def test_a_capture_becomes_another(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "a.ply", make_cloud(400, 2))
    out = tmp_path / f"b{WRITERS[kind].ending}"
    assert main(["convert", str(tmp_path / "a.ply"), str(out), *(["--to", kind] if kind == "spz4" else [])]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"wrote {out} (")
    assert ("nothing is lost: every bit is the same" in said) == (kind == "ply")
    assert ("the SH degree falls from 2 to 0; colours no longer change" in said) == (kind == "splat")
    assert ("viewers take +y as up" in said) == (kind in ("spz", "spz4", "glb"))
    read = read_capture(out)
    assert read.cloud.count == 400
    if WRITERS[kind].ending == ".spz":
        assert read.format == f".spz version {4 if kind == 'spz4' else 3}"


def test_reported_losses_are_the_actual_ones(tmp_path: Path) -> None:
    """The report is correct for Gaussians in shuffled order with known changes, one of which is much larger than the
    others, and for missing Gaussians."""
    cloud = make_cloud(500, 1)
    order = np.random.default_rng(0).permutation(500)
    means = cloud.means.numpy() + np.array([0.003, 0.0, 0.0])
    means[7, 1] += 0.4
    changed = GaussianCloud.from_numpy(
        means,
        cloud.rotations.numpy(),
        cloud.log_scales.numpy() + np.log(1.02),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
    ).subset(order)
    write_ply(tmp_path / "a.ply", cloud)
    write_ply(tmp_path / "b.ply", changed)
    before, after = (read_capture(tmp_path / name, device="cpu") for name in ("a.ply", "b.ply"))
    (said,) = conversion_loss(before, after, order)
    assert "positions 0.018 (at most 0.4) units, of a size of 4" in said and "deviations 2 (at most 2) %" in said
    assert "opacities 0 (at most 0) of 255" in said and "higher bands 0 (at most 0)" in said
    rows = np.arange(2, 500)
    fewer = after.with_cloud(after.subset(rows), rows=rows)
    gone, _ = conversion_loss(before, fewer, order)
    assert gone == "2 of 500 Gaussians are gone"


@pytest.mark.parametrize("kind", WRITERS)
def test_each_gaussian_is_compared_with_itself(kind: str, tmp_path: Path) -> None:
    """The reported errors are those of corresponding Gaussians, also in formats that change the order. A comparison
    with the nearest Gaussian instead would hide a displacement of all Gaussians."""
    cloud = make_cloud(300)
    path = tmp_path / f"a{WRITERS[kind].ending}"
    order = WRITERS[kind](path, cloud)
    assert (order is None) == (kind not in ("compressed-ply", "sog"))
    order = np.arange(300) if order is None else order
    assert sorted(order) == list(range(300))
    read = read_capture(path, device="cpu").cloud.means.numpy()
    errors = np.linalg.norm(read.astype(float) - cloud.means.numpy()[order], axis=1)
    assert errors.max() < 0.01
    said = " ".join(conversion_loss(read_capture(path).with_cloud(cloud), read_capture(path), order))
    if errors.any():
        assert f"positions {np.sqrt(np.mean(errors**2)):.2g} (at most {errors.max():.2g}) units" in said


@pytest.mark.parametrize(
    ("size", "deviation", "error"),
    [
        (1e-4, 1e-6, None),
        (2e-3, 1e-4, 3e-4),
        (0.05, 1e-3, 3e-4),
        (1.0, 0.02, 3e-4),
        (1e6, 100.0, 3e-4),
        (1e6, 1e4, None),
    ],
)
def test_spz_of_any_size_keeps_its_shape_or_is_refused(
    size: float, deviation: float, error: float | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    random = np.random.default_rng(0)
    cloud = GaussianCloud.from_numpy(
        random.uniform(-0.5 * size, 0.5 * size, (200, 3)),
        random.normal(size=(200, 4)),
        np.full((200, 3), np.log(deviation)),
        np.zeros(200),
        np.zeros((200, 1, 3)),
    )
    write_ply(tmp_path / "a.ply", cloud)
    status = main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.spz")])
    if error is None:
        said = capsys.readouterr().err
        assert status == 2 and not (tmp_path / "a.spz").exists()
        factor = re.search(r"scale it by (\S+), or choose another format", said)
        assert factor is not None
        assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.spz"), "--scale", factor[1]]) == 0
        return
    assert status == 0
    read = read_capture(tmp_path / "a.spz", device="cpu").cloud
    assert np.abs(read.means.numpy() - cloud.means.numpy()).max() <= error * size
    np.testing.assert_allclose(read.log_scales.numpy(), cloud.log_scales.numpy(), atol=1 / 32 + 1e-6)


def test_offsets_are_kept_or_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The offset of a georeferenced capture is kept by .ply and .glb; its loss in .spz is reported."""
    place = np.array([431000.0, 5403000.0, 120.0])
    write_ply(tmp_path / "a.ply", make_cloud(100), origin=place)
    for name in ("b.ply", "b.glb", "b.spz"):
        assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / name)]) == 0
        said = capsys.readouterr()
        assert "nothing is lost" not in said.out and "positions are relative to 43" in said.err
        assert ("cannot be stored in this format; the file is relative to it" in said.out) == (name == "b.spz")
    first, *others = (read_capture(tmp_path / name, device="cpu") for name in ("a.ply", "b.ply", "b.glb"))
    assert first.origin is not None
    for capture in others:
        np.testing.assert_array_equal(capture.origin, first.origin)
        np.testing.assert_allclose(capture.cloud.means.numpy(), first.cloud.means.numpy(), rtol=0, atol=1e-7)
    # Moved back to the capture's own origin, positions do not need double precision.
    back = ",".join(str(-x) for x in first.origin)
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "c.ply"), f"--translate={back}"]) == 0
    assert read_capture(tmp_path / "c.ply", device="cpu").origin is None


@pytest.mark.parametrize("place", [(1.0, 2.0, 3.0), (5403000.5, 431000.25, 7.1)])
def test_an_offset_that_is_read_as_another_one_is_no_loss(
    place: tuple[float, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A .ply stores positions that include the offset. The reader separates a rounded offset again if single precision
    does not suffice for the positions; absolute positions stay the same."""
    write_glb(tmp_path / "a.glb", make_cloud(100), origin=np.array(place))
    assert main(["convert", str(tmp_path / "a.glb"), str(tmp_path / "b.ply")]) == 0
    said = capsys.readouterr()
    assert "positions are relative to" in said.err and "has no place" not in said.out
    error = re.search(r"positions \S+ \(at most (\S+)\) units", said.out)
    assert error is not None and 0.0 < float(error[1]) < 1e-6
    a, b = (read_capture(tmp_path / name, device="cpu") for name in ("a.glb", "b.ply"))
    assert (a.origin is not None) and (b.origin is None) == (place[0] == 1.0)
    there = b.means.numpy() + (0.0 if b.origin is None else b.origin)
    np.testing.assert_allclose(there, a.means.numpy() + a.origin, rtol=0, atol=1e-6)


def test_captures_are_turned_cut_and_merged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = make_cloud(60, 1)
    write_ply(tmp_path / "a.ply", cloud)
    write_ply(tmp_path / "b.ply", make_cloud(40, seed=2))
    means = cloud.means.numpy().astype(float)

    def convert(*flags: str, sources: tuple[str, ...] = ("a.ply",)) -> GaussianCloud:
        paths = [str(tmp_path / name) for name in (*sources, "out.ply")]
        assert main(["convert", *paths, *flags]) == 0
        return read_capture(tmp_path / "out.ply", device="cpu").cloud

    for flags, expected in (
        (["--up=-y"], means * [1, -1, -1]),
        (["--up", "z"], means[:, [0, 2, 1]] * [1, 1, -1]),
        (["--scale", "3"], 3.0 * means),
        (["--rotate", "0,0,90", "--translate=1,2,3"], means[:, [1, 0, 2]] * [-1, 1, 1] + [1, 2, 3]),
        (["--rotate", "90,0,90"], means[:, [2, 0, 1]]),
        (["--up=-y", "--scale", "2", "--translate", "0,0,1"], 2.0 * means * [1, -1, -1] + [0, 0, 1]),
    ):
        np.testing.assert_allclose(convert(*flags).means.numpy(), expected, atol=1e-5, err_msg=str(flags))
    inside = np.all(np.abs(means) <= 1.0, axis=1)
    np.testing.assert_array_equal(convert("--box=-1,-1,-1,1,1,1").means.numpy(), means[inside].astype(np.float32))
    assert f"box: {60 - inside.sum()} of 60 Gaussians left out" in capsys.readouterr().out
    merged = convert(sources=("a.ply", "b.ply"))
    assert merged.count == 100 and merged.sh_degree == 1 and not merged.sh.numpy()[60:, 1:].any()
    # Colours rotate with the Gaussians: a rotation and its inverse restore them.
    convert("--rotate", "30,-50,70")
    turn = Rotation.from_euler("xyz", [30, -50, 70], degrees=True).inv().as_euler("xyz", degrees=True)
    (tmp_path / "out.ply").rename(tmp_path / "turned.ply")
    back = convert("--rotate=" + ",".join(map(str, turn)), sources=("turned.ply",))
    np.testing.assert_allclose(back.sh.numpy(), cloud.sh.numpy(), atol=1e-5)
    np.testing.assert_allclose(back.means.numpy(), means, atol=1e-5)


def test_floaters_are_dropped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(0)
    means = np.concatenate([random.uniform(-0.5, 0.5, (2000, 3)), [[4.0, 0.0, 0.0], [0.0, -3.0, 1.0]]])
    cloud = GaussianCloud.from_numpy(
        means, np.tile([1.0, 0, 0, 0], (2002, 1)), np.full((2002, 3), -3.5), np.ones(2002), np.zeros((2002, 1, 3))
    )
    write_ply(tmp_path / "a.ply", cloud)
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--drop-floaters"]) == 0
    assert "floaters: 2 of 2002 Gaussians left out" in capsys.readouterr().out
    np.testing.assert_array_equal(read_capture(tmp_path / "b.ply").cloud.means.numpy(), cloud.means.numpy()[:2000])


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


def test_names_of_a_sequence_may_contain_dots(tmp_path: Path) -> None:
    clouds = [make_cloud(30, seed=number) for number in range(2)]
    for number, cloud in enumerate(clouds):
        write_ply(tmp_path / f"my.scan_{number}.ply", cloud)
        # macOS writes such files into archives and onto foreign disks.
        (tmp_path / f"._my.scan_{number}.ply").write_bytes(b"\0\5\x16\7")
    assert main(["convert", str(tmp_path), str(tmp_path / "out"), "--to", "splat"]) == 0
    for number, cloud in enumerate(clouds):
        read = read_capture(tmp_path / "out" / f"my.scan_{number}.splat", device="cpu").cloud
        np.testing.assert_array_equal(read.means.numpy(), cloud.means.numpy())


@pytest.mark.parametrize(
    ("name", "stem"),
    [("cat.v2.ply", "cat.v2"), ("a.b.COMPRESSED.PLY", "a.b"), ("a.spz", "a"), ("a.b.txt", "a.b"), ("cat", "cat")],
)
def test_the_stem_of_a_capture(name: str, stem: str) -> None:
    assert capture_stem(Path(name)) == stem


def test_each_note_of_a_sequence_is_printed_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = columns_of(make_cloud(8))
    for number, bad in enumerate((None, 3, 5, 5)):
        x = columns["x"].copy()
        if bad is not None:
            x[bad] = np.nan
        (tmp_path / f"frame{number}.ply").write_bytes(ply_of(columns | {"x": x}))
    assert main(["convert", str(tmp_path), str(tmp_path / "out"), "--to", "ply"]) == 0
    said = capsys.readouterr().err.splitlines()
    note = "left out 1 Gaussians that have a value that is not finite (x of number {})"
    assert [line for line in said if "left out" in line] == [
        f"egs-warp: {tmp_path}/frame1.ply: {note.format(3)}",
        f"egs-warp: {tmp_path}/frame2.ply: {note.format(5)} (and 1 more of the files)",
    ]


def _capture(path: Path, *comments: str) -> Capture:
    path.write_bytes(ply_of(columns_of(make_cloud(5)), comments=comments))
    return read_capture(path, device="cpu")


BRUSH = ("Exported from Brush", "Vertical axis: y")


@pytest.mark.parametrize(
    ("comments", "edits", "up", "vertical_axis"),
    [
        (("Vertical axis: z",), {}, (0, 0, 1), None),
        (("Vertical axis: z",), {"rotation": (90, 0, 0)}, (0, -1, 0), None),
        (("Vertical axis: z",), {"up": (0, -1, 0)}, (0, 1, 0), None),
        (("Vertical axis: z",), {"up": (0, -1, 0), "rotation": (0, 0, 90)}, (-1, 0, 0), None),
        ((), {"up": (0, 0, 2), "rotation": (90, 0, 0)}, (0, 0, 1), None),
        ((), {"rotation": (90, 0, 0)}, None, None),
        (BRUSH, {"scale": 2.0}, None, 1),
        (BRUSH, {"rotation": (0, 0, 90)}, None, 0),
        (BRUSH, {"rotation": (30, 0, 0)}, None, None),
        (BRUSH, {"up": (0, -1, 0)}, (0, 1, 0), None),
    ],
)
def test_up_turns_with_the_capture(
    comments: tuple[str, ...],
    edits: dict[str, Any],
    up: tuple[float, ...] | None,
    vertical_axis: int | None,
    tmp_path: Path,
) -> None:
    """If an up direction is given, it is rotated to +y first; then the given rotation is applied."""
    values: dict[str, Any] = {name: np.array(value) if name != "scale" else value for name, value in edits.items()}
    chosen = CaptureEdits(**values)
    capture = _capture(tmp_path / "a.ply", *comments)
    edited, _ = edit_capture(capture, chosen)
    assert edited.vertical_axis == vertical_axis
    if up is None or edited.up is None:
        assert up is edited.up
        return
    np.testing.assert_allclose(edited.up, up, atol=1e-12)
    before = capture.up if chosen.up is None else chosen.up
    assert before is not None
    axes = chosen.frame().axes
    np.testing.assert_allclose(axes @ (before / np.linalg.norm(before)), up, atol=1e-12)
    np.testing.assert_allclose(edited.means.numpy(), capture.means.numpy() @ axes.T, atol=1e-6)


def test_merged_captures_have_a_vertical_axis_if_all_have_it(tmp_path: Path) -> None:
    a, b = _capture(tmp_path / "a.ply", *BRUSH), _capture(tmp_path / "b.ply", *BRUSH)
    assert merge_captures([a, b]).vertical_axis == 1
    for other in (_capture(tmp_path / "c.ply"), _capture(tmp_path / "d.ply", "Vertical axis: y")):
        merged = merge_captures([a, other])
        assert (merged.up, merged.vertical_axis) == (None, None)
        assert "the captures have different up directions" in merged.notes[-1]


def test_the_name_of_a_vertical_axis_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _capture(tmp_path / "a.ply", *BRUSH)
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply")]) == 0
    assert "the name of the vertical axis is lost" in capsys.readouterr().out


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
        (["same", "out", "--to", "ply"], "a01.ply and a1.ply have the same number"),
        (["two", "two", "--to", "ply"], "it has two sequences"),
        (["a.ply", "b.ply", "--scale", "0"], "--scale 0.0: give a positive number"),
        (["a.ply", "b.ply", "--count", "0"], "--count 0: give a number of at least 1"),
        (["a.ply", "b.ply", "--rotate", "1,2"], "--rotate 1,2: give 3 numbers, separated by commas"),
        (["a.ply", "b.ply", "--box", "7,7,7,8,8,8"], "--box: none of the 3 Gaussians lies in it; they extend from"),
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
