"""Bundle of a run, which the example that needs only NumPy reads in agreement with the deformer."""

from __future__ import annotations

import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.cli import main
from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.geometry.gaussians import GaussianCloud, with_degree
from egs_warp.geometry.main_light import MainLight, irradiance_form, mean_irradiance
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.bundle import BundleBody, read_bundle
from egs_warp.io.bundle_file import Carrier
from egs_warp.io.planes import light_from_json
from egs_warp.kernels.deformation.cage_maps import RIGID
from egs_warp.lighting.surface_normals import surface_normals
from egs_warp.pipelines.bundle import export_bundle
from egs_warp.pipelines.finished_run import FinishedRun

_DIRECTION = np.array([0.48, 0.64, 0.6])
LIGHT = MainLight(_DIRECTION, 5.0, 0.5, irradiance_form(0.3, 0.0, np.array([0.0, 0.0, 1.0]), 1.0, _DIRECTION))
READER = Path(__file__).parents[2] / "examples" / "read_bundle.py"


@pytest.fixture(scope="module")
def run(run_folder: Path) -> FinishedRun:
    return FinishedRun.read(run_folder)


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()


def _covariances(cloud: GaussianCloud) -> np.ndarray:
    factors = _matrices(cloud.rotations.numpy()) * np.exp(cloud.log_scales.numpy())[:, None, :]
    return factors @ factors.transpose(0, 2, 1)


def _deformer_of(body: BundleBody) -> Deformer:
    """Return a deformer of the body with the embedding that is stored in the file."""
    cage, splats = body.cage, body.splats
    assert cage is not None
    deformer = Deformer(splats, embed_gaussians(splats, TetMesh(cage.rest_nodes, cage.cage_tets)))
    rows = cage.carriers == Carrier.ARMS
    deviations = np.exp(splats.log_scales.numpy()[rows])
    ends, shares, bulges = np.zeros((6, len(rows)), np.int32), np.ones((6, len(rows))), np.zeros((3, len(rows)))
    ends[:, rows] = cage.arm_tets.T
    shares[:, rows] = np.where(cage.arm_lengths > 0, -cage.arm_lengths * np.tile(deviations, 2), cage.arm_shares).T
    shares[0, cage.carriers == Carrier.RIGID] = float(RIGID)
    bulges[:, rows] = (cage.arm_bulges * deviations).T
    codes = np.where(cage.carriers == Carrier.TET, cage.tets, -1 - cage.tets)
    deformer.plan.mean_tets = wp.array(codes, dtype=wp.int32)
    deformer.plan.end_tets = wp.array(ends, dtype=wp.int32)
    deformer.plan.inside_fractions = wp.array(shares, dtype=wp.float32)
    deformer.plan.smoothing_lengths = wp.array(bulges, dtype=wp.float32)
    return deformer


def test_the_reader_agrees_with_the_deformer(run: FinishedRun, tmp_path: Path) -> None:
    """Nodes are displaced at random, so that many splats extend across tetrahedra with different deformation.

    The reader agrees with a deformer of the file's content to single precision, and with that of the run to the errors
    stated in the file.
    """
    rng = np.random.default_rng(2)
    t = run.trajectory
    t.positions[run.steps[9]] += 0.02 * rng.normal(size=t.rest_positions.shape)
    export_bundle(run, tmp_path / "a.egs", every=3)
    bundle = runpy.run_path(str(READER))["Bundle"](str(tmp_path / "a.egs"))
    assert bundle.nodes.shape == (5, *t.rest_positions.shape) and bundle.text["rate"] == 20.0
    assert np.count_nonzero(bundle.arrays["carriers"] == Carrier.ARMS) > 100
    read, original = _deformer_of(read_bundle(tmp_path / "a.egs").bodies[0]), run.deformer()
    for index, frame in ((0, 0), (3, 9), (4, 12)):
        moved = t.positions[run.steps[frame]]
        assert np.linalg.norm(bundle.nodes[index] - moved, axis=1).max() <= bundle.body["node_error"] < 2e-5 * t.height
        means, covariances, turns = bundle.frame(index)
        for deformed, bounds in (
            (read.deform(bundle.nodes[index]), (2e-6, 1e-4, 1e-3)),
            (original.deform(moved), (4e-5, 1e-2, 3e-3)),
        ):
            assert np.abs(means - deformed.cloud.means.numpy()).max() < bounds[0]
            expected = _covariances(deformed.cloud)
            size = np.linalg.norm(expected, axis=(1, 2))
            assert (np.linalg.norm(covariances - expected, axis=(1, 2)) / size).max() < bounds[1]
            assert np.abs(turns - _matrices(deformed.rotations.numpy())).max() < bounds[2]


def test_the_reader_needs_only_numpy_and_the_frame_is_the_capture_s(
    run: FinishedRun, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.egs"
    flags = ["--degree", "0", "--licence", "CC0-1.0"]
    assert main(["export", str(run_folder), "--to", "bundle", "--out", str(path), *flags]) == 0
    assert f"wrote {path}" in capsys.readouterr().out
    code = f"import sys, runpy; sys.argv = ['x', {str(path)!r}]; runpy.run_path({str(READER)!r}, run_name='__main__')\n"
    code += "assert not {'warp', 'scipy', 'egs_warp'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert f"{run.creature.splats.count} splats, 13 frames at 60 a second" in done.stdout
    assert len(READER.read_text().splitlines()) <= 80
    read = read_bundle(path)
    assert read.bodies[0].splats.sh_degree == 0 and read.facts["licence"] == "CC0-1.0"
    np.testing.assert_array_equal(read.facts["capture"]["axes"], run.trajectory.body_axes)


def test_the_scene_of_a_run_is_a_static_body(run: FinishedRun, tmp_path: Path) -> None:
    scene = with_degree(run.creature.splats, 0)
    export_bundle(replace(run, scene=scene), tmp_path / "a.egs", every=12)
    creature, background = read_bundle(tmp_path / "a.egs").bodies
    assert creature.cage is not None and background.cage is None
    assert background.name == "scene" and background.splats.count == scene.count


def test_the_light_of_a_run_is_in_the_bundle(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file contains the light and, to half a quantisation step, the normals; without a light, it contains
    neither."""
    lit = replace(run, creature=replace(run.creature, light=LIGHT))
    export_bundle(lit, tmp_path / "a.egs", every=12)
    assert main(["validate", str(tmp_path / "a.egs")]) == 0
    bundle = read_bundle(tmp_path / "a.egs")
    light, normals = light_from_json(bundle.facts["light"]), bundle.bodies[0].normals
    assert normals is not None
    assert np.abs(normals - surface_normals(lit.deformer().rest)).max() < 0.51 / 127.0
    assert mean_irradiance(light) == pytest.approx(1.0)
    np.testing.assert_allclose(light.irradiance * mean_irradiance(LIGHT), LIGHT.irradiance, atol=1e-12)
    export_bundle(run, tmp_path / "b.egs", every=12)
    plain = read_bundle(tmp_path / "b.egs")
    assert "light" not in plain.facts and plain.bodies[0].normals is None


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--to", "bundle", "--out", "a.zip"], "a.zip: give a name that ends in .egs"),
        (["--to", "bundle", "--out", "a.egs", "--frame", "2"], "--frame: a bundle contains all frames"),
        (["--to", "bundle", "--out", "a.egs", "--every", "0"], "--every 0: give a whole number of at least 1"),
        (["--to", "ply", "--out", "a", "--licence", "CC0-1.0"], "--licence: only a bundle states a licence"),
    ],
)
def test_bad_input_is_one_line(
    flags: list[str], said: str, run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(run_folder), *flags]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
