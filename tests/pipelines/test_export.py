"""Export of a run to files of other tools, checked by independent readers if these are available."""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from egs_warp.cli import main
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.installation import install_command
from egs_warp.io import read_capture
from egs_warp.io.run_folder import MANIFEST
from egs_warp.io.writing import WRITERS
from egs_warp.pipelines.export import export_splats
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.usd import export_usd


@pytest.fixture(scope="module")
def run(run_folder: Path) -> FinishedRun:
    return FinishedRun.read(run_folder)


def _in_capture(run: FinishedRun, frame: int) -> np.ndarray:
    """Return the means (n, 3) of the creature in the frame of the capture, by the formula of docs/guide/report.md."""
    t = run.trajectory
    means = run.deformer().deform(t.positions[run.steps[frame]]).cloud.means.numpy().astype(np.float64)
    return t.body_origin + (means / t.metres_per_unit) @ t.body_axes


@pytest.mark.parametrize(
    ("kind", "tolerance"), [("ply", 1e-5), ("splat", 1e-5), ("spz", 1e-3), ("spz4", 1e-3), ("sog", 2e-3)]
)
def test_splat_files_are_in_the_frame_of_the_capture(run: FinishedRun, tmp_path: Path, kind: str, tolerance: float):
    (path,) = export_splats(run, tmp_path, kind, frame=-1, quiet=True)
    assert path.name == f"frame0012{WRITERS[kind].ending}"
    means = read_capture(path).cloud.means.numpy()
    expected = _in_capture(run, 12)
    assert len(means) == len(expected)
    # The Gaussians are sorted, because some writers reorder them.
    distance, _ = KDTree(means).query(expected)
    assert distance.max() < tolerance


@pytest.mark.parametrize("kind", ["ply", "compressed-ply", "spz4", "glb"])
def test_a_single_frame_may_be_a_file(run: FinishedRun, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / f"one{WRITERS[kind].ending}"
    assert main(["export", str(run.folder), "--to", kind, "--frame", "4", "--out", str(file)]) == 0
    assert file.is_file() and [path.name for path in tmp_path.iterdir()] == [file.name]
    assert capsys.readouterr().out.startswith(f"wrote {file} (")
    assert read_capture(file).cloud.count == run.creature.splats.count


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--out", "all.ply"], "--out all.ply: several frames are written; give a folder, or a single frame"),
        (["--out", "a.spz", "--frame", "4"], "a.spz: give a name that ends in .ply"),
        (["--out", "a.plly", "--frame", "4"], "a.plly: give a name that ends in .ply (did you mean '.ply'?)"),
        (
            ["--to", "compressed-ply", "--out", "a.compressed-ply", "--frame", "4"],
            "a.compressed-ply: give a name that ends in .compressed.ply",
        ),
        (["--to", "glb", "--out", "all.glb"], "--to skin writes the whole motion as one .glb, in which a mesh moves"),
    ],
)
def test_a_file_has_the_ending_of_its_kind_and_one_frame(
    run: FinishedRun,
    tmp_path: Path,
    flags: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(run.folder), "--to", "ply", *flags]) == 2
    assert message in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_an_interrupted_run_is_resumed_and_not_exported(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """An interrupted run is refused even if only its film is missing."""
    folder = tmp_path / "run"
    shutil.copytree(run.folder, folder)
    manifest = json.loads((folder / MANIFEST).read_text()) if (folder / MANIFEST).is_file() else {"files": {}}
    manifest |= {"command": "animate", "finished": False, "files": {"trajectory.npz": None}}
    (folder / MANIFEST).write_text(json.dumps(manifest))
    (folder / "run.yaml").write_text("capture: a.ply\n")
    for line in ("render {run} --out a.mp4", "export {run} --to ply --out a", "view {run} --export a.html"):
        assert main(line.format(run=folder).split()) == 2
        error = capsys.readouterr().err
        assert f"if it was interrupted, egs-warp resume {folder} continues it" in error or "make web" in error


def test_a_sequence_is_numbered_at_sixty_hertz(run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    flags = ["export", str(run.folder), "--to", "compressed-ply", "--out", str(tmp_path / "out"), "--every", "4"]
    assert main(flags) == 0
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [f"frame{k:04d}.compressed.ply" for k in (0, 4, 8, 12)]
    printed, files = capsys.readouterr(), list((tmp_path / "out").iterdir())
    assert "frame0000.compressed.ply to frame0012.compressed.ply" in printed.out
    size = sum(path.stat().st_size for path in files) / 1e6
    assert f"egs-warp: the frames take about {size:.0f} MB; --every and --degree reduce the size" in printed.err
    assert read_capture(tmp_path / "out" / names[0]).cloud.count == run.creature.splats.count
    # The same frames may be overwritten; an export of other frames, which would be mixed with them, is refused.
    (tmp_path / "out" / "frames.compressed.ply").write_text("not one of them")
    assert main(flags) == 0
    capsys.readouterr()
    assert main([*flags[:-1], "2"]) == 2, "would overwrite the frames of the other export"
    assert "it has other frames (frame0008.compressed.ply, ...)" in capsys.readouterr().err
    # As after an interrupted export.
    (tmp_path / "out" / names[-1]).unlink()
    assert main(flags) == 0
    capsys.readouterr()
    assert main([*flags[:-1], "6"]) == 2
    error = capsys.readouterr().err
    assert (
        "out: it has other frames (frame0004.compressed.ply, ...); choose another folder" in error
        and error.count("\n") == 1
    )
    assert len(export_splats(run, tmp_path / "out", "compressed-ply", frame=5, quiet=True)) == 1


def _glb(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """Read a .glb file according to the glTF 2.0 standard."""
    data = path.read_bytes()
    magic, version, length, size, kind = np.frombuffer(data, "<u4", 5)
    assert (magic, version, length, kind) == (0x46546C67, 2, len(data), 0x4E4F534A) and size % 4 == 0
    said = json.loads(data[20 : 20 + size])
    binary, name = np.frombuffer(data, "<u4", 2, 20 + int(size))
    assert name == 0x004E4942 and binary == said["buffers"][0]["byteLength"] == len(data) - 28 - size
    arrays = {}
    for attribute, k in said["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = said["accessors"][k]
        view = said["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start = 28 + int(size) + view["byteOffset"]
        arrays[attribute] = np.frombuffer(data, "<f4", accessor["count"] * width, start).reshape(-1, width)
        assert view["byteLength"] == arrays[attribute].nbytes
    return said, arrays


def test_gltf_has_the_splats_in_metres_with_y_up(run: FinishedRun, tmp_path: Path):
    (path,) = export_splats(run, tmp_path, "glb", frame=6, quiet=True)
    said, arrays = _glb(path)
    primitive = said["meshes"][0]["primitives"][0]
    assert said["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] == "srgb_rec709_display"
    cloud = run.deformer().deform(run.trajectory.positions[run.steps[6]]).cloud
    x, y, z = cloud.means.numpy().T
    np.testing.assert_allclose(arrays["POSITION"], np.stack([x, z, -y], axis=1), atol=1e-6)
    np.testing.assert_allclose(said["accessors"][0]["max"], arrays["POSITION"].max(axis=0))
    prefix = "KHR_gaussian_splatting:"
    np.testing.assert_allclose(arrays[f"{prefix}SCALE"], np.exp(cloud.log_scales.numpy()), rtol=1e-5)
    np.testing.assert_allclose(arrays[f"{prefix}OPACITY"][:, 0], cloud.opacities(), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(arrays[f"{prefix}ROTATION"], axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(_covariances(arrays, prefix), _turned_covariances(cloud), atol=1e-8)
    assert f"{prefix}SH_DEGREE_3_COEF_6" in arrays and f"{prefix}SH_DEGREE_3_COEF_7" not in arrays


def _factors(quaternions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    factors = Rotation.from_quat(quaternions).as_matrix() * scales[:, None, :]
    return factors @ factors.transpose(0, 2, 1)


def _covariances(arrays: dict[str, np.ndarray], prefix: str) -> np.ndarray:
    return _factors(arrays[f"{prefix}ROTATION"], arrays[f"{prefix}SCALE"])


def _turned_covariances(cloud: GaussianCloud) -> np.ndarray:
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return turn @ _factors(cloud.rotations.numpy()[:, [1, 2, 3, 0]], np.exp(cloud.log_scales.numpy())) @ turn.T


@pytest.mark.parametrize("degree", [None, 0])
def test_usd_is_read_back_by_openusd_with_the_right_samples(run: FinishedRun, tmp_path: Path, degree: int | None):
    Usd, UsdGeom, UsdVol = map(pytest.importorskip, ("pxr.Usd", "pxr.UsdGeom", "pxr.UsdVol"))
    path = tmp_path / "run.usdc"
    announced: list[int] = []
    export_usd(run, path, every=4, degree=degree, quiet=True, announce=announced.append)
    (size,) = announced
    assert 0.7 * path.stat().st_size < size < path.stat().st_size
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (60.0, 0.0, 12.0)
    assert str(stage.GetDefaultPrim().GetPath()) == "/creature"
    splats = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/creature/splats")
    deformer, t = run.deformer(), run.trajectory
    count, kept = run.creature.splats.count, 3 if degree is None else degree
    assert splats.GetPositionsAttr().GetTimeSamples() == [0.0, 4.0, 8.0, 12.0]
    for code in (0.0, 8.0, 12.0):
        positions = t.positions[run.steps[int(code)]]
        cloud = deformer.deform(positions).cloud
        np.testing.assert_array_equal(np.array(splats.GetPositionsAttr().Get(code)), cloud.means.numpy())
        np.testing.assert_allclose(np.array(splats.GetScalesAttr().Get(code)), np.exp(cloud.log_scales.numpy()))
        first = splats.GetOrientationsAttr().Get(code)[0]
        np.testing.assert_array_equal([first.real, *first.imaginary], cloud.rotations.numpy()[0])
        colours = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(code))
        np.testing.assert_array_equal(colours.reshape(count, -1, 3), cloud.sh.numpy()[:, : (kept + 1) ** 2])
        cage = UsdGeom.Mesh.Get(stage, "/creature/cage")
        np.testing.assert_allclose(np.array(cage.GetPointsAttr().Get(code)), positions, atol=1e-6)
        forces = np.array(UsdGeom.BasisCurves.Get(stage, "/creature/forces").GetPointsAttr().Get(code))
        assert len(forces) == 2 * len(run.contacts(run.steps[int(code)])[0])
        muscles = UsdGeom.BasisCurves.Get(stage, "/creature/muscles")
        ends = np.array(muscles.GetPointsAttr().Get(code)).reshape(-1, 2, 3)
        expected = (run.creature.muscle_ends @ positions)[run.creature.muscle_segments]
        np.testing.assert_allclose(ends, expected, atol=1e-6)
        said = UsdGeom.PrimvarsAPI(muscles).GetPrimvar("activation").Get(code)
        np.testing.assert_allclose(np.array(said), run.activations(run.steps[int(code)]), atol=1e-6)
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == kept
    np.testing.assert_allclose(np.array(splats.GetOpacitiesAttr().Get()), run.creature.splats.opacities(), atol=1e-6)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--to", "ply", "--frame", "13"], "--frame 13: the run has 13 frames; give 0 to 12, or -1 for the last"),
        (["--to", "ply", "--every", "0"], "--every 0: give a whole number of at least 1"),
        (["--to", "usd", "--frame", "1"], "--frame: a USD stage contains all frames"),
        (["--to", "usd"], "give a name that ends in .usdc or .usda"),
    ],
)
def test_bad_input_is_one_line(
    run_folder: Path, tmp_path: Path, flags: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["export", str(run_folder), "--out", str(tmp_path / "out"), *flags]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_frames_are_not_put_among_the_files_of_a_run(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    before = sorted(run_folder.iterdir())
    for command in (["export", str(run_folder), "--to", "ply"], ["render", str(run_folder), "--size", "32"]):
        assert main([*command, "--out", str(run_folder)]) == 2
        message = f"{run_folder}: it is the folder of a run, and the frames would be mixed with its files"
        assert message in capsys.readouterr().err
    assert sorted(run_folder.iterdir()) == before


def test_nvidias_validator_for_splats_finds_nothing(run: FinishedRun, tmp_path: Path):
    """NVIDIA's validator checks rule VG.035 of the Omniverse asset requirements and reports no issue."""
    validator = pytest.importorskip("omni.asset_validator")
    path = tmp_path / "run.usdc"
    export_usd(run, path, every=6, quiet=True)
    engine = validator.ValidationEngine(init_rules=False)
    engine.enable_rule(validator.GaussianSplatSchemaChecker)
    assert list(engine.validate(str(path)).issues()) == []


def test_a_scene_is_exported_to_usd(run: FinishedRun, tmp_path: Path):
    Usd, UsdVol = map(pytest.importorskip, ("pxr.Usd", "pxr.UsdVol"))
    with_scene = replace(run, scene=run.creature.splats)
    export_usd(with_scene, tmp_path / "run.usdc", every=12, degree=0, quiet=True)
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    scene = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/creature/scene")
    np.testing.assert_array_equal(np.array(scene.GetPositionsAttr().Get()), run.creature.splats.means.numpy())


def test_without_usd_core_one_line_says_what_to_install(
    run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("pxr", "pxr.Sdf"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UserError, match=rf"usd-core is not installed; {re.escape(install_command('usd'))}$"):
        export_usd(run, tmp_path / "run.usdc", quiet=True)
