"""Imports, playback, renders and exports of the extension in Blender without a window.

``EGS_WARP_BPY`` names a Python that has Blender's module (``make test-blender``).
"""

from __future__ import annotations

import json
import os
import runpy
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from egs_warp.assets.pawn import pawn
from egs_warp.pipelines.animate import AnimateOptions, animate
from egs_warp.pipelines.bundle import export_bundle
from egs_warp.pipelines.creature import CreatureOptions
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.shot import resized
from egs_warp.render.rasteriser import render_gaussians
from tests.support.coarse import coarse_cages

ROOT = Path(__file__).parents[2]
FRAME = 30
PYTHON = os.environ.get("EGS_WARP_BPY", "")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not PYTHON, reason="set EGS_WARP_BPY; make test-blender does")]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    """Return a run whose body is in the air at ``FRAME``."""
    folder = tmp_path_factory.mktemp("blender") / "pawn"
    made = pawn(gaussian_count=3000)
    with coarse_cages(120):
        animate(made.cloud, folder, plane=made.plane, options=AnimateOptions(frames=32, size=64), quiet=True)
    return FinishedRun.read(folder)


@pytest.fixture(scope="module")
def extension(tmp_path_factory: pytest.TempPathFactory) -> Path:
    build = runpy.run_path(str(ROOT / ".ci" / "blender_extension.py"))["build"]
    return build(tmp_path_factory.mktemp("extension"))


def blender(*arguments: str | Path, home: Path) -> str:
    """Run Blender's Python with Blender's settings in the folder ``home``; return the output."""
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(home)}
    environment.pop("PYTHONPATH", None)
    command = [PYTHON, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=home, timeout=600)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def session(run: FinishedRun, extension: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of results of one session with the run."""
    out = tmp_path_factory.mktemp("session")
    script = ROOT / "tests" / "support" / "blender_session.py"
    printed = blender(script, extension, run.folder / "trajectory.npz", out, str(FRAME), home=out)
    assert "Error" not in printed and "Warning: 'PlaybackPanel'" not in printed
    return out


@pytest.fixture(scope="module")
def results(session: Path) -> dict[str, Any]:
    return json.loads((session / "results.json").read_text())


def check_splats(path: Path, run: FinishedRun, *, shape: float, opacity: float, colour: float) -> None:
    """Compare 1,000 Gaussians of ``FRAME`` with the program's own deformer: means to 1e-4 body heights, covariances
    relative to their size, opacities (0 to 1) and the coefficients of band 0."""
    cloud = run.deformer().deform(run.trajectory.positions[run.steps[FRAME]]).cloud
    chosen = np.random.default_rng(1).choice(cloud.count, 1000, replace=False)
    with np.load(path) as splats:
        means = splats["positions"].reshape(-1, 3)[chosen]
        np.testing.assert_allclose(means, cloud.means.numpy()[chosen], atol=1e-4 * run.trajectory.height)
        shapes = []
        for rotations, log_scales in (
            (cloud.rotations.numpy(), cloud.log_scales.numpy()),
            (
                np.stack([splats[f"rot_{part}"] for part in range(4)], axis=1),
                np.stack([splats[f"scale_{axis}"] for axis in range(3)], axis=1),
            ),
        ):
            axes = Rotation.from_quat(rotations[chosen][:, [1, 2, 3, 0]]).as_matrix()
            factors = axes * np.exp(log_scales[chosen].astype(float))[:, None, :]
            shapes.append(factors @ factors.transpose(0, 2, 1))
        size = np.linalg.norm(shapes[0], axis=(1, 2))
        assert (np.linalg.norm(shapes[1] - shapes[0], axis=(1, 2)) / size).max() < shape
        opacities = 1.0 / (1.0 + np.exp(-splats["opacity"].astype(float)))
        np.testing.assert_allclose(opacities, cloud.opacities(), atol=opacity)
        colours = np.stack([splats[f"f_dc_{channel}"] for channel in range(3)], axis=1)
        np.testing.assert_allclose(colours, cloud.sh.numpy()[:, 0], atol=colour)


def test_the_extension_is_valid(extension: Path, tmp_path: Path) -> None:
    code = "import bpy, pathlib; print(pathlib.Path(bpy.utils.resource_path('LOCAL')))"
    place = blender("-c", code, home=tmp_path).splitlines()[-1]
    tool = Path(place) / "scripts" / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    assert "Success parsing TOML" in blender(tool, "validate", extension, home=tmp_path)


def test_splats_follow_the_run(session: Path, results: dict[str, Any], run: FinishedRun) -> None:
    assert results["range"] == [0, len(run.steps) - 1] and results["rate"] == 60
    check_splats(session / "splats.npz", run, shape=1e-3, opacity=1e-6, colour=0.0)


def test_overlays_follow_the_run(results: dict[str, Any], run: FinishedRun) -> None:
    t, step = run.trajectory, run.steps[FRAME]
    np.testing.assert_allclose(results["cage"], t.positions[step], atol=1e-6)
    np.testing.assert_allclose(results["muscles"], run.creature.muscle_ends @ t.positions[step], atol=1e-6)
    centre = np.average(t.positions[step], axis=0, weights=t.node_mass)
    np.testing.assert_allclose(results["com"], centre, atol=1e-6)
    points, _, force = run.contacts(step)
    tips = points + 0.5 * t.height * force / (t.node_mass.sum() * np.linalg.norm(t.gravity))
    np.testing.assert_allclose(np.reshape(results["forces"], (-1, 3)), np.concatenate([points, tips]), atol=1e-6)


def test_a_saved_scene_plays_on(results: dict[str, Any], run: FinishedRun) -> None:
    np.testing.assert_allclose(results["reopened cage at 0"], run.trajectory.positions[0], atol=1e-6)


def test_the_picture_is_that_of_the_film(session: Path, run: FinishedRun) -> None:
    """Cycles and our renderer show the same silhouette and, where the body is opaque, the same mean colour.

    The images are not equal, because our renderer makes each splat at least a pixel wide, and higher bands of the
    colour are not imported.
    """
    cloud = run.deformer().deform(run.trajectory.positions[run.steps[FRAME]]).cloud
    image = render_gaussians(cloud, resized(run.creature.camera, 96, 96), background=(0.0, 0.0, 0.0))
    expected, alpha = image.colour_srgb8().astype(float), image.alpha.numpy()
    made = np.asarray(Image.open(session / "picture.png").convert("RGBA"), float)
    covered, shown = alpha > 0.5, made[..., 3] > 127.5
    assert covered.sum() > 300
    assert (covered & shown).sum() / (covered | shown).sum() > 0.9
    opaque = (alpha > 0.99) & (made[..., 3] > 250)
    assert np.abs(made[opaque][:, :3].mean(axis=0) - expected[opaque].mean(axis=0)).max() < 10.0


def test_edited_muscles_and_cage_run(session: Path, results: dict[str, Any], run: FinishedRun, tmp_path: Path) -> None:
    """A new run accepts the edited cage, which is 1.05 times as wide, and the edited muscles, of which one was removed,
    one moved and one added."""
    assert results["export"] == results["export of the cage"] == ["FINISHED"]
    path = session / "muscles.json"
    fibres = json.loads(path.read_text())["fibres"]
    before = run.creature.fibre_names
    assert [fibre["name"] for fibre in fibres] == [*before[1:], "drawn"] and fibres[-1]["strength"] == 3.0
    made = pawn(gaussian_count=3000)
    creature = CreatureOptions(muscles_file=path, cage_file=session / "cage.mesh")
    options = AnimateOptions(frames=2, size=64, creature=creature)
    animate(made.cloud, tmp_path / "out", plane=made.plane, options=options, quiet=True)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    wide = FinishedRun.read(tmp_path / "out").trajectory.rest_positions
    np.testing.assert_allclose(wide, run.trajectory.rest_positions * [1.05, 1.0, 1.0], atol=1e-5)
    assert report["muscles"]["fibres"] == len(fibres)
    frame = run.capture_frame
    rest = run.creature.muscle_ends @ run.trajectory.rest_positions
    second = run.creature.muscle_segments[run.creature.fibre_from_segment == 1][0, 0]
    moved = frame.points(rest[second] + [0.0, 0.0, 0.01])
    np.testing.assert_allclose(fibres[0]["points"][0], moved, atol=2e-6)


def test_a_bundle_shows_the_same_splats(run: FinishedRun, extension: Path, tmp_path: Path) -> None:
    bundle = tmp_path / "jump.egs"
    export_bundle(run, bundle)
    script = ROOT / "tests" / "support" / "blender_session.py"
    blender(script, extension, bundle, tmp_path, str(FRAME), home=tmp_path)
    # Tolerances for rounding by half a step, which are 1/256 for each log scale and 1/1024 rad for the rotations.
    check_splats(tmp_path / "splats.npz", run, shape=0.02, opacity=0.003, colour=0.004)
    results = json.loads((tmp_path / "results.json").read_text())
    assert "muscles" not in results and len(results["cage"]) == len(run.trajectory.rest_positions)
