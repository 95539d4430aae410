"""The single-file bundle of a run, read by the example that needs only NumPy, agrees with the deformer."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.cli import main
from egs_warp.pipelines.bundle import export_bundle
from egs_warp.pipelines.finished_run import FinishedRun

READER = Path(__file__).parents[2] / "examples" / "read_bundle.py"


@pytest.fixture(scope="module")
def run(run_folder: Path) -> FinishedRun:
    return FinishedRun.read(run_folder)


def test_the_reader_agrees_with_the_deformer(run: FinishedRun, tmp_path: Path) -> None:
    """Nodes are displaced at random, so that many splats extend across tetrahedra with different deformation."""
    rng = np.random.default_rng(2)
    t = run.trajectory
    t.positions[run.steps[9]] += 0.02 * rng.normal(size=t.rest_positions.shape)
    export_bundle(run, tmp_path / "a.npz", every=3)
    bundle = runpy.run_path(str(READER))["Bundle"](str(tmp_path / "a.npz"))
    assert bundle.arrays["nodes"].shape == (5, *t.rest_positions.shape) and float(bundle.arrays["fps"]) == 20.0
    assert len(bundle.arrays["arm_rows"]) > 100
    deformer = run.deformer()
    for index, frame in ((0, 0), (3, 9), (4, 12)):
        means, covariances, turns = bundle.frame(index)
        deformed = deformer.deform(t.positions[run.steps[frame]])
        cloud = deformed.cloud
        np.testing.assert_allclose(means, cloud.means.numpy(), atol=2e-6)
        rotations = Rotation.from_quat(cloud.rotations.numpy()[:, [1, 2, 3, 0]]).as_matrix()
        factors = rotations * np.exp(cloud.log_scales.numpy())[:, None, :]
        expected = factors @ factors.transpose(0, 2, 1)
        size = np.linalg.norm(expected, axis=(1, 2))
        assert (np.linalg.norm(covariances - expected, axis=(1, 2)) / size).max() < 1e-4
        made = Rotation.from_quat(deformed.rotations.numpy()[:, [1, 2, 3, 0]]).as_matrix()
        assert np.abs(turns - made).max() < 1e-3


def test_the_reader_needs_only_numpy_and_the_frame_is_the_capture_s(
    run: FinishedRun, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.npz"
    assert main(["export", str(run_folder), "--to", "bundle", "--out", str(path), "--degree", "0"]) == 0
    assert f"wrote {path}" in capsys.readouterr().out
    code = f"import sys, runpy; sys.argv = ['x', {str(path)!r}]; runpy.run_path({str(READER)!r}, run_name='__main__')\n"
    code += "assert not {'warp', 'scipy', 'egs_warp'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert f"{run.creature.splats.count} splats, 13 frames at 60 a second" in done.stdout
    assert len(READER.read_text().splitlines()) <= 60
    with np.load(path) as data:
        assert data["sh"].shape[1] == 1
        np.testing.assert_array_equal(data["body_axes"], run.trajectory.body_axes)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--out", "a.zip"], "a.zip: give a name that ends in .npz"),
        (["--out", "a.npz", "--frame", "2"], "--frame: a bundle contains all frames"),
        (["--out", "a.npz", "--every", "0"], "--every 0: give a whole number of at least 1"),
    ],
)
def test_bad_input_is_one_line(
    flags: list[str], said: str, run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(run_folder), "--to", "bundle", *flags]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
