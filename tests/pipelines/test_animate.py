"""Files of a run of ``animate``, and failures of the machine, after which the simulation is kept and no file is partial
or from another run."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from dataclasses import replace as replaced
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from egs_warp.assets import BuiltInObject, pawn
from egs_warp.deformation.deformer import Deformer
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.run_folder import MANIFEST
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.script import motion
from egs_warp.pipelines.animate import AnimateOptions, animate
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.finished_run import PARTS, read_trajectory
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.report import Report, verdict
from egs_warp.pipelines.simulated_run import SimulatedRun, simulate
from tests.support.disk_faults import fail_once
from tests.support.slides import slide

FILES = ["cage.vtu", "creature.npz", "jump.mp4", MANIFEST, "plots.png", "report.json", "sheet.png", "trajectory.npz"]
OPTIONS = AnimateOptions(frames=2, size=32, creature=CreatureOptions(friction=0.6))


@cache
def thing() -> BuiltInObject:
    """Create a pawn of few Gaussians."""
    return pawn(gaussian_count=2000, device="cpu")


@pytest.fixture(scope="module")
def performance() -> SimulatedRun:
    """Simulate two frames of a jump of a coarse pawn."""
    creature = make_creature(thing().cloud, plane=thing().plane, options=CreatureOptions(friction=0.6, nodes=120))
    return simulate(creature, motion("jump"), frames=2)


@pytest.fixture
def run(performance: SimulatedRun, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Report]:
    """Return a function that calls ``animate`` with a finished simulation, so that nothing is simulated."""
    monkeypatch.setattr("egs_warp.pipelines.animate.make_checked_creature", lambda *_, **__: performance.creature)
    monkeypatch.setattr("egs_warp.pipelines.takes.simulate", lambda *_, **__: performance)

    def animated(out: Path, *, overwrite: bool = False) -> Report:
        return animate(thing().cloud, out, plane=thing().plane, options=OPTIONS, quiet=True, overwrite=overwrite)

    return animated


def finished(folder: Path) -> bool:
    return json.loads((folder / MANIFEST).read_text())["finished"]


def test_a_motion_that_the_shape_does_not_allow_is_refused_before_the_body_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pawn has no arm. The second of two motions, and a gesture on top of a motion, are refused, too."""

    def fail(*_: Any, **__: Any) -> None:
        raise AssertionError("the body is simulated")

    monkeypatch.setattr("egs_warp.pipelines.creature.settle", fail)
    monkeypatch.setattr("egs_warp.pipelines.creature.body_muscles", fail)
    for text in ("nod, wave", "walk 1 + wave at=0.5"):
        with pytest.raises(UserError, match=r"^wave: the body has no branch that is free"):
            animate(thing().cloud, tmp_path / "run", motion=text, plane=thing().plane, options=OPTIONS, quiet=True)
    assert not (tmp_path / "run").exists()


def test_a_run_contains_its_options_and_its_manifest(run: Callable[..., Report], tmp_path: Path) -> None:
    report = run(tmp_path)
    assert sorted(os.listdir(tmp_path)) == FILES and finished(tmp_path)
    asked = json.loads((tmp_path / "report.json").read_text())["asked"]
    assert asked["friction"] == 0.6 and asked["size"] == [32, 32] and asked["frames"] == 2 and asked["up"] is None
    assert asked["plane"] == pytest.approx([*thing().plane.normal, thing().plane.offset])
    assert verdict(report.audit) == "audit: passed" == report.summary().splitlines()[1]
    assert json.loads((tmp_path / "report.json").read_text())["film"] == report.film == "jump.mp4"
    energy = json.loads((tmp_path / "report.json").read_text())["energy"]
    assert energy["gained"] == pytest.approx(sum(energy["flows"].values()), abs=1e-9)
    assert energy["muscle_work"] >= energy["flows"]["muscles"] and energy["worst_residual"] < 1e-6


def test_a_preview_is_small_and_keeps_all_gaussians_for_later(
    performance: SimulatedRun, run: Callable[..., Report], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("egs_warp.pipelines.animate.PREVIEW_GAUSSIANS", 100)
    monkeypatch.setattr("egs_warp.pipelines.animate.PREVIEW_SIZE", 24)
    drawn: list[int] = []

    def deformer(rest: GaussianCloud, *rest_of: Any) -> Deformer:
        drawn.append(rest.count)
        return Deformer(rest, *rest_of)

    monkeypatch.setattr("egs_warp.pipelines.film.Deformer", deformer)
    notes: list[str] = []
    preview = replaced(OPTIONS, preview=True)
    report = animate(thing().cloud, tmp_path, plane=thing().plane, options=preview, quiet=True, show_note=notes.append)
    data = RenderData.load(tmp_path / "creature.npz", node_count=len(performance.creature.cage.mesh.nodes))
    # A deformer of all Gaussians is created only once, for the embedding that creature.npz stores.
    assert drawn == [data.splats.count, 100] and data.splats.count >= thing().cloud.count
    assert (data.camera.width, data.camera.height) == (24, 24)
    assert notes[-1] == report.notes[-1]
    assert notes[-1].startswith(f"preview: 100 of {data.splats.count} Gaussians at 24x24 pixels; egs-warp render draws")
    assert report.asked["preview"] is True and report.asked["size"] == [24, 24]
    assert (report.gaussians.split, report.gaussians.drawn) == (data.splats.count, 100)


def test_a_film_that_fails_leaves_the_simulation(
    run: Callable[..., Report], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object, **__: object) -> None:
        raise UserError("film: cannot")

    monkeypatch.setattr("egs_warp.pipelines.animate.draw_film", failing)
    with pytest.raises(UserError, match="film: cannot"):
        run(tmp_path)
    assert len(Trajectory.load(tmp_path / "trajectory.npz").time) >= 2
    assert not finished(tmp_path)


def test_a_run_that_is_cut_off_leaves_its_steps(
    run: Callable[..., Report], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The simulated steps of an interrupted run can be read from its parts; the next run moves them aside."""
    monkeypatch.setattr("egs_warp.locomotion.recorder._MIN_STEPS_PER_PART", 7)
    slid = slide()

    def interrupted(*_: object, parts: Callable[[], Path], **__: object) -> None:
        recorder = slid.recorder(folder=parts)
        for report in slid.reports[:16]:
            recorder.add([report])
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("egs_warp.pipelines.takes.simulate", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path)
    assert not finished(tmp_path) and sorted(os.listdir(tmp_path)) == [MANIFEST, PARTS]
    assert np.array_equal(read_trajectory(tmp_path / PARTS).positions, slid.trajectory().positions[:15])
    with pytest.raises(UserError, match=r"the run was interrupted; egs-warp resume .* continues it \(its finished"):
        read_trajectory(tmp_path / "trajectory.npz")
    run(tmp_path, overwrite=True)
    assert sorted(os.listdir(tmp_path)) == sorted([*FILES, "earlier-1"])
    assert len(read_trajectory(tmp_path / "earlier-1" / PARTS).dt) == 14


def test_an_error_in_the_preparation_keeps_the_earlier_run(
    run: Callable[..., Report], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This holds even if the new run has a background, because the background is stored only with the results."""

    def failing(*_: object, **__: object) -> None:
        raise UserError("plane: nothing is above it")

    given: dict[str, Any] = {"plane": thing().plane, "background": thing().cloud, "options": OPTIONS, "quiet": True}
    run(tmp_path)
    monkeypatch.setattr("egs_warp.pipelines.animate.make_checked_creature", failing)
    with pytest.raises(UserError, match="plane: nothing is above it"):
        animate(thing().cloud, tmp_path, overwrite=True, **given)
    assert finished(tmp_path) and sorted(os.listdir(tmp_path)) == FILES


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_film_from_straight_above_or_below(performance: SimulatedRun, side: float) -> None:
    """The camera looks along the normal of the plane, and the facing direction of the body is up in the image."""
    up = thing().plane.normal
    camera = performance.camera(64, side * up)
    np.testing.assert_allclose(camera.rotation[2], [0.0, 0.0, -side], atol=1e-9)
    assert performance.place.ground.axes[0] @ -camera.rotation[1] > 0.999


def test_of_several_views_the_nearest_to_the_default_is_filmed(performance: SimulatedRun) -> None:
    """The camera selects the one of seven view directions that is nearest to the default view."""
    first, second = thing().plane.tangents()
    around = 2.0 * np.pi * (np.arange(7)[:, None] + 0.3) / 7
    ways = np.cos(around) * first + np.sin(around) * second + 0.5 * thing().plane.normal
    usual = performance.camera(64).rotation[2][:2]
    each = [performance.camera(64, way).rotation[2] for way in ways]
    best = int(np.argmax([looking[:2] @ usual for looking in each]))
    np.testing.assert_allclose(performance.camera(64, ways).rotation[2], each[best], atol=1e-9)


def test_a_missing_ffmpeg_is_reported_first(
    run: Callable[..., Report], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/nowhere/ffmpeg")
    with pytest.raises(UserError, match="no ffmpeg"):
        run(tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_disk_that_is_full_at_any_file(
    run: Callable[..., Report], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each opening and each renaming of a file fails once in turn. The error is one line, no temporary file is left,
    and the run does not count as finished. In every fourth case, the next run moves the failed one aside. Plotting is
    replaced by a stub to save time.
    """
    monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: Path(path).write_bytes(b"plots"))
    failures = 0
    for number in range(100):
        folder = tmp_path / str(number)
        with monkeypatch.context() as patch:
            failed = fail_once(patch, number, errno.ENOSPC)
            try:
                run(folder)
            except UserError as error:
                assert "cannot be written (No space left on device)" in str(error)
                failures += 1
        if not failed:
            break
        # A new folder that contains no file is removed.
        names = os.listdir(folder) if folder.exists() else []
        assert not [name for name in names if name.startswith(".egs-")]
        assert MANIFEST not in names or not finished(folder)
        if number % 4 == 0:
            run(folder, overwrite=True)
            assert finished(folder) and set(FILES) <= set(os.listdir(folder))
    # There are seven files and the manifest, which is written before each of them and at the end; each write opens and
    # renames a file.
    assert failures == number == 30


def test_a_verdict_names_the_violated_limits(run: Callable[..., Report], tmp_path: Path) -> None:
    audit = run(tmp_path).audit
    said = verdict(replaced(audit, penetration=0.02, momentum_residual=float("nan"), inverted_elements=3))
    expected = "momentum_residual nan times its limit, penetration 2.0 times its limit, inverted_elements 3, not 0"
    assert said == f"audit: FAILED: {expected}"
