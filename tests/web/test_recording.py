"""Recordings: the packets of a finished run for the page."""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from egs_warp.cli import main
from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.errors import UserError
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io import write_ply
from egs_warp.web.page import PAGE, page_text
from egs_warp.web.recording import CURVES, Recording, body_curves
from tests.support.packets import read_packets
from tests.support.slides import slide, with_self_contact

needs_page = pytest.mark.skipif(not PAGE.is_file(), reason="the page is not built; make web builds it")


def test_the_written_layout_is_the_documented_one(run_folder: Path):
    recording = Recording.read(run_folder)
    facts, arrays, frames = read_packets(recording.bytes())
    t = recording.trajectory
    assert len(frames) == facts["frames"] == 13
    np.testing.assert_allclose([frame["time"] for frame in frames], np.arange(13) / 60.0, atol=1e-6)
    for frame in frames:
        step = recording.steps[frame["index"]]
        np.testing.assert_allclose(frame["positions"].reshape(-1, 3), t.positions[step], atol=1e-6)
        assert len(frame["activations"]) == t.activations.shape[1]
        force = frame["contacts"].reshape(-1, 9)[:, 6:].sum(axis=0)
        np.testing.assert_allclose(force, t.contact_force[t.contact_step == step - 1].sum(axis=0), atol=1e-3)
        assert len(frame["curves"]) == len(CURVES)
    np.testing.assert_array_equal(arrays["splats_means"], recording.creature.splats.means.numpy())
    # The plan of a jump is known from the first frame; its only foot is the sole on the ground.
    plan, centre = arrays["plan"], t.node_mass @ t.positions[0] / t.node_mass.sum()
    assert plan.shape == (13, 3)
    np.testing.assert_allclose(plan[0], centre, atol=1e-3 * t.height)
    up = -t.gravity / np.linalg.norm(t.gravity)
    heights = t.positions[0] @ up
    sole = arrays["foot_from_node"] == 0
    assert sole.sum() >= 3 and (arrays["foot_from_node"][~sole] == -1).all()
    assert heights[sole].max() < heights.min() + 0.03 * t.height
    assert facts["title"] == "pawn \u00b7 jump"


def test_a_frame_is_as_small_as_documented(run_folder: Path):
    recording = Recording.read(run_folder)
    nodes, segments = len(recording.trajectory.rest_positions), recording.trajectory.activations.shape[1]
    for frame in recording.frames():
        expected = 32 + 12 * nodes + -(-segments // 4) * 4 + 36 * len(frame.contacts) + 4 * len(CURVES)
        assert len(frame.packet()) == expected


def test_the_creature_file_equals_the_video(run_folder: Path):
    """An embedding that is computed from the splats of the file and the rest cage of the trajectory gives the means of
    the video."""
    recording = Recording.read(run_folder)
    t, made = recording.trajectory, recording.creature
    deformer = Deformer(made.splats, embed_gaussians(made.splats, TetMesh(t.rest_positions, t.tets)))
    carried = deformer.deform(t.positions[-1]).cloud.means.numpy()
    assert np.isfinite(carried).all()
    drawn = json.loads((run_folder / "report.json").read_text())["gaussians"]["out"]
    assert made.splats.count == drawn
    np.testing.assert_allclose(made.muscle_ends @ np.ones(len(t.rest_positions)), 1.0, atol=1e-9)


def test_curves_are_those_of_the_audit(run_folder: Path):
    recording = Recording.read(run_folder)
    audit = json.loads((run_folder / "report.json").read_text())["audit"]
    names = [name for name, _, _ in CURVES]
    values = np.array([frame.curves for frame in recording.frames()])
    assert values[:, names.index("residual")].max() <= audit["momentum_residual"] + 1e-12
    assert -values[:, names.index("gap")].min() <= audit["penetration"] * (1 + 1e-9)
    assert values[:, names.index("friction")].max() <= 1.0 + 1e-6
    # The body stands and begins to crouch, so none of the curves is zero.
    assert -values[:, names.index("gap")].min() == pytest.approx(audit["penetration"])
    assert values[:, names.index("friction")].max() > 0.2
    assert values[0, names.index("force")] == pytest.approx(1.0, abs=0.2)
    assert np.ptp(values[:, names.index("height")]) < 0.1 < values[0, names.index("height")]


def test_the_momentum_curve_includes_pushes():
    struck = slide(struck=True).trajectory()
    assert body_curves(struck)[:, [name for name, _, _ in CURVES].index("residual")].max() < 1e-8


def test_self_contact_is_no_load_on_the_ground():
    t = slide().trajectory()
    np.testing.assert_allclose(body_curves(with_self_contact(t)), body_curves(t), rtol=1e-9, atol=1e-9)


@needs_page
def test_an_exported_page_contains_its_runs_and_fetches_nothing(run_folder: Path, tmp_path: Path):
    first, second = tmp_path / "a.html", tmp_path / "b.html"
    for path in (first, second):
        assert main(["view", str(run_folder), str(run_folder), "--export", str(path)]) == 0
    assert first.read_bytes() == second.read_bytes()
    text = first.read_text()
    carried = re.findall(r'<script type="application/octet-stream" data-run="\d">([^<]*)</script>', text)
    assert len(carried) == 2
    assert gzip.decompress(base64.b64decode(carried[0])) == Recording.read(run_folder).bytes()
    assert not re.search(r'<(?:script|link|img)[^>]+(?:src|href)="(?!data:)', text)


@needs_page
def test_a_scene_behind_it_travels_too(run_folder: Path, tmp_path: Path):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    bare = Recording.read(folder)
    write_ply(folder / "background.ply", bare.creature.splats)
    _, arrays, _ = read_packets(Recording.read(folder).bytes())
    t = bare.trajectory
    expected = t.metres_per_unit * ((bare.creature.splats.means.numpy() - t.body_origin) @ t.body_axes.T)
    np.testing.assert_allclose(arrays["scene_means"], expected, atol=1e-5)


def _shorten(path: Path, *names: str, end: int) -> None:
    """Truncate the arrays ``names`` of a file at row ``end``, so that each is valid but the file is inconsistent."""
    with np.load(path) as file:
        arrays = dict(file)
    arrays |= {name: arrays[name][:end] for name in names}
    np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]


_MUSCLES = ("muscle_segments", "muscle_bounds", "fibre_from_segment")


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: shutil.rmtree(folder), "no such folder; give the one that egs-warp animate wrote"),
        (lambda folder: (folder / "trajectory.npz").unlink(), "trajectory.npz: is missing; give the folder"),
        (lambda folder: (folder / "trajectory.npz").write_bytes(b"PK\x03\x04 no zip"), "is not a valid trajectory"),
        (lambda folder: (folder / "creature.npz").unlink(), "creature.npz: is missing; run egs-warp animate again"),
        (lambda folder: np.savez(folder / "creature.npz", means=np.zeros((2, 3))), "creature.npz: cannot be read"),
        (
            lambda folder: _shorten(folder / "creature.npz", *_MUSCLES, end=-1),
            "its muscles differ from those of trajectory.npz",
        ),
        (lambda folder: _shorten(folder / "creature.npz", "foot_from_node", end=0), "foot_from_node has shape"),
        (
            lambda folder: _shorten(folder / "trajectory.npz", "tets", end=0),
            "is not a valid trajectory (its arrays have inconsistent shapes",
        ),
        (lambda folder: (folder / "report.json").write_text("[]"), "report.json: is not a report"),
    ],
)
def test_a_folder_without_a_run_is_a_one_line_error(
    run_folder: Path, tmp_path: Path, spoil: Callable[[Path], object], said: str, capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    spoil(folder)
    with pytest.raises(UserError, match=re.escape(said)):
        Recording.read(folder)
    assert main(["view", str(folder), "--export", str(tmp_path / "page.html")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "page.html").exists()


def test_three_runs_are_one_too_many(run_folder: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["view", *[str(run_folder)] * 3]) == 2
    assert "only two runs can be shown" in capsys.readouterr().err


def test_a_missing_page_build_is_reported_with_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("egs_warp.web.page.PAGE", tmp_path / "page.html")
    with pytest.raises(UserError, match=r"page.html: the page is not built; run make web in the source tree"):
        page_text()
