"""Recording of a run on disk: the parts of a killed run can be read, and those of a complete run give the same
trajectory as the records in memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.fem.body import BodyState
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.trajectory import SCHEMA, Trajectory
from tests.support.slides import slide


def same(a: Trajectory, b: Trajectory) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in a.__dataclass_fields__)


def test_parts_on_disk_equal_the_records_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("egs_warp.locomotion.recorder._MIN_STEPS_PER_PART", 7)
    run = slide()
    on_disk, in_memory = run.recorder(folder=lambda: tmp_path / "parts"), run.recorder()
    for report in run.reports[:6]:
        on_disk.add([report])
        in_memory.add([report])
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["start.npz"]
    for report in run.reports[6:16]:
        on_disk.add([report])
        in_memory.add([report])
    # This is the state on disk if the run is killed here.
    assert sorted(path.name for path in (tmp_path / "parts").iterdir()) == [
        "start.npz",
        "steps-000000.npz",
        "steps-000001.npz",
    ]
    left, whole = Trajectory.load(tmp_path / "parts"), run.trajectory()
    assert len(left.dt) == 14 and np.array_equal(left.positions, whole.positions[:15])
    assert left.contact_step.max() == 13
    for recorder in (on_disk, in_memory):
        recorder.add(run.reports[16:])
        assert same(recorder.trajectory(), whole)
    assert same(Trajectory.load(tmp_path / "parts"), whole)


def test_a_part_that_is_missing_or_of_another_schema_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("egs_warp.locomotion.recorder._MIN_STEPS_PER_PART", 7)
    run = slide()
    recorder = run.recorder(folder=lambda: tmp_path)
    for report in run.reports:
        recorder.add([report])
    (tmp_path / "steps-000000.npz").unlink()
    with pytest.raises(FileNotFoundError):
        Trajectory.load(tmp_path)
    np.savez(tmp_path / "steps-000000.npz", time=np.zeros(1))
    with pytest.raises(ValueError, match=f"its schema is 1, but this version reads schema {SCHEMA}"):
        Trajectory.load(tmp_path)


def test_all_that_acts_on_the_body_is_written_down() -> None:
    run = slide()
    frame = BodyFrame(np.eye(3)[[1, 2, 0]], np.array([1.0, 2.0, 3.0]), 4.0)
    recorder: Recorder = run.recorder(frame=frame)
    recorder.add(run.reports)
    t, muscles, body = recorder.trajectory(), run.stepper.muscles, run.stepper.body
    assert t.dt == pytest.approx(np.diff(t.time), rel=1e-12) and t.drag == 0.3
    assert (t.young_modulus, t.damping_time) == (body.young_modulus, body.assembly.material.damping_time)
    ends = [
        t.muscle_end_weights[first:last] @ t.rest_positions[t.muscle_end_nodes[first:last]]
        for first, last in zip(t.muscle_end_starts[:-1], t.muscle_end_starts[1:], strict=True)
    ]
    assert np.asarray(ends) == pytest.approx(muscles.end_points(body.mesh.nodes), abs=1e-12)
    first, second = np.asarray(ends)[t.muscle_segments].swapaxes(0, 1)
    assert np.linalg.norm(second - first, axis=1) == pytest.approx(t.muscle_rest_lengths)
    assert np.array_equal(t.muscle_stiffness, muscles.stiffness)
    assert (t.contact_plane == 0).all() and len(t.contact_plane) == len(t.contact_gap) > 0
    assert t.in_capture(np.array([1.0, 0.0, 0.0])) == pytest.approx([1.0, 2.25, 3.0])


def test_each_contact_names_its_plane_among_parallel_ones() -> None:
    """One half of a block stands above a step, so that two of the planes, floor and tread, have the same normal."""
    run = slide()
    body, flat = run.stepper.body, run.stepper.geometry
    step = (Plane(np.array([0.0, 0.0, 1.0]), -0.2), Plane(np.array([-1.0, 0.0, 0.0]), 0.05))
    planes = (*flat.planes, *step)
    points = (flat.tet_from_point, flat.weights)
    geometry = ContactGeometry(flat.mesh, planes, 0.8, *points, 0, 0.0, solid_from_plane=(0, 1, 1))
    detector = ContactDetector(geometry, device="cpu")
    positions = body.mesh.nodes - np.array([*body.mesh.nodes[:, :2].mean(axis=0), 0.0])
    positions[positions[:, 0] > 0.1] += [0.0, 0.0, 0.21]
    contacts = detector.contact_set(np.arange(len(flat.weights)), positions)
    _, nearest = detector.gaps(positions)
    assert {0, 1} <= set(nearest)
    start = BodyState(positions, np.zeros_like(positions))
    recorder = Recorder(body, run.stepper.muscles, geometry, start, 0.0, drag=0.0)
    forces = np.zeros((contacts.count, 3))
    recorder.add([replace(run.reports[0], contacts=contacts, forces=forces, end_gaps=contacts.gaps)])
    assert np.array_equal(recorder.trajectory().contact_plane, nearest)
