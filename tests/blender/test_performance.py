"""Reading of runs and bundles by the Blender extension, whose module is imported from its zip and needs only NumPy."""

from __future__ import annotations

import gc
import importlib
import runpy
import shutil
import sys
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from egs_warp.pipelines.bundle import export_bundle
from egs_warp.pipelines.finished_run import FinishedRun

ROOT = Path(__file__).parents[2]
BUILD = runpy.run_path(str(ROOT / ".ci" / "blender_extension.py"))["build"]


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    """Import the module ``performance`` from the zip, without the package's ``__init__``, which needs Blender."""
    folder = tmp_path_factory.mktemp("zip")
    with zipfile.ZipFile(BUILD(folder)) as archive:
        archive.extractall(folder / "unpacked_extension")
    (folder / "unpacked_extension" / "__init__.py").unlink()
    sys.path.insert(0, str(folder))
    yield importlib.import_module("unpacked_extension.performance")
    sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def run(run_folder: Path) -> FinishedRun:
    return FinishedRun.read(run_folder)


def test_the_zip_is_reproducible_and_complete(tmp_path: Path) -> None:
    first, second = BUILD(tmp_path / "a"), BUILD(tmp_path / "b")
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        assert {"__init__.py", "blender_manifest.toml", "read_bundle.py", "LICENSE"} <= set(archive.namelist())


@pytest.mark.parametrize("file", ["", "trajectory.npz", "creature.npz"])
def test_a_run_is_read_from_its_folder_or_a_file_in_it(
    file: str, reader: ModuleType, run: FinishedRun, run_folder: Path
) -> None:
    performance = reader.read_performance(run_folder / file)
    assert performance.frame_count == len(run.steps) and performance.name == run_folder.name
    step = run.steps[9]
    np.testing.assert_array_equal(performance.nodes(9), run.trajectory.positions[step])
    np.testing.assert_array_equal(performance.activations(9), run.activations(step))
    between = 0.5 * (performance.nodes(9) + performance.nodes(10))
    np.testing.assert_allclose(performance.nodes(9.5), between, atol=1e-12)
    points = run.trajectory.rest_positions[:3]
    np.testing.assert_allclose(performance.muscles.in_capture(points), run.capture_frame.points(points), atol=1e-12)
    weight = run.trajectory.node_mass.sum() * np.linalg.norm(run.trajectory.gravity)
    places, forces = performance.forces(9)
    expected_places, _, expected_forces = run.contacts(step)
    assert len(places) > 0
    np.testing.assert_allclose(places, expected_places, atol=1e-9)
    np.testing.assert_allclose(forces * weight, expected_forces, atol=1e-9)


def test_the_splats_of_a_run_are_those_of_the_deformer(reader: ModuleType, run: FinishedRun, run_folder: Path) -> None:
    means, _, _ = reader.read_performance(run_folder).splats(12)
    cloud = run.deformer().deform(run.trajectory.positions[run.steps[12]]).cloud
    np.testing.assert_allclose(means, cloud.means.numpy(), atol=2e-6)


def test_a_bundle_has_the_motion_alone(reader: ModuleType, run: FinishedRun, tmp_path: Path) -> None:
    export_bundle(run, tmp_path / "jump.egs", every=2)
    performance = reader.read_performance(tmp_path / "jump.egs")
    assert (performance.name, performance.fps, performance.frame_count) == ("jump", 30.0, 7)
    assert performance.muscles is performance.contacts is performance.camera is None
    assert performance.height == run.trajectory.height
    np.testing.assert_allclose(performance.nodes(3), run.trajectory.positions[run.steps[6]], atol=1e-4)
    assert performance.clamped(-1.0) == 0.0 and performance.clamped(99.0) == 6.0


def test_problems_are_one_line(reader: ModuleType, run_folder: Path, tmp_path: Path) -> None:
    def problem(path: Path) -> str:
        with pytest.raises(reader.ReadError) as error:
            reader.read_performance(path)
        assert "\n" not in str(error.value)
        return str(error.value)

    assert "trajectory.npz: is missing; choose the folder of a finished run" in problem(tmp_path)
    assert "none.egs: cannot be read" in problem(tmp_path / "none.egs")
    (tmp_path / "other.egs").write_bytes(b"ply\nformat ascii 1.0\n")
    assert "other.egs: cannot be read (" in problem(tmp_path / "other.egs")
    (tmp_path / "cut.egs").write_bytes(b"EGSB\2\0\0\0\x02\0\0\0{}")
    assert "cut.egs: cannot be read (no array 'bodies'); choose a bundle" in problem(tmp_path / "cut.egs")
    shutil.copy(run_folder / "trajectory.npz", tmp_path)
    with np.load(run_folder / "creature.npz") as data:
        np.savez(tmp_path / "creature.npz", **{name: data[name] for name in data if name != "carriers"})
    assert "creature.npz: was written by an earlier version; write a bundle" in problem(tmp_path)
    (tmp_path / "creature.npz").write_bytes(b"PK\x03\x04 cut off")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert "creature.npz: cannot be read" in problem(tmp_path)
        gc.collect()
    assert not [warning for warning in caught if warning.category is ResourceWarning]
