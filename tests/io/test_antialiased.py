"""Antialiasing flag of a capture, which every file format that can store it preserves and which the renderer uses."""

from __future__ import annotations

import gzip
import json
import pickle
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.deformation.rigid import to_body_frame
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud, concatenate, with_degree
from egs_warp.io import read_capture, write_spz
from egs_warp.io.writing import WRITERS
from egs_warp.pipelines.render_data import RenderData
from egs_warp.render import render_gaussians
from egs_warp.web.recording import Recording
from tests.support.captures import make_cloud
from tests.support.finished_runs import finished_run
from tests.support.slides import slide

CLOUD = replace(make_cloud(40, 1), antialiased=True)
CAMERA = Camera.look_at(np.array([7.0, 1.0, 2.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), width=48, height=40)


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_that_can_state_it_does(kind: str, tmp_path: Path) -> None:
    write = WRITERS[kind]
    for cloud in (CLOUD, make_cloud(40, 1)):
        path = tmp_path / f"a{write.ending}"
        write(path, cloud)
        assert read_capture(path, device="cpu").antialiased is (cloud.antialiased and kind != "splat")


@pytest.mark.parametrize("version", [2, 3, 4])
def test_the_flag_of_every_version_of_spz(version: int, tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", CLOUD, version=version)
    data = (tmp_path / "a.spz").read_bytes()
    assert (data if version == 4 else gzip.decompress(data))[14] == 1
    assert read_capture(tmp_path / "a.spz", device="cpu").antialiased


def test_the_flag_of_spz_version_1(tmp_path: Path) -> None:
    body = struct.pack("<IIIBBBB", 0x5053474E, 1, 1, 0, 12, 1, 0) + struct.pack("<3e", 1.5, -2.0, 0.25) + bytes(10)
    (tmp_path / "a.spz").write_bytes(gzip.compress(body))
    assert read_capture(tmp_path / "a.spz", device="cpu").antialiased


@pytest.mark.parametrize(
    ("entries", "expected"),
    [({"antialias": True}, True), ({"model": "antialiased"}, True), ({"model": "2dgs"}, False), ({"model": 3}, False)],
)
def test_entries_of_sog(entries: dict[str, object], expected: bool, tmp_path: Path) -> None:
    WRITERS["sog"](tmp_path / "a.sog", replace(CLOUD, antialiased=False))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "a")
    meta = json.loads((tmp_path / "a" / "meta.json").read_text())
    (tmp_path / "a" / "meta.json").write_text(json.dumps(meta | entries))
    assert read_capture(tmp_path / "a", device="cpu").antialiased is expected


def test_it_is_drawn_so_unless_told_otherwise() -> None:
    plain = replace(CLOUD, antialiased=False)
    drawn = render_gaussians(CLOUD, CAMERA).colour.numpy()
    without = render_gaussians(plain, CAMERA).colour.numpy()
    np.testing.assert_array_equal(drawn, render_gaussians(plain, CAMERA, antialiased=True).colour.numpy())
    np.testing.assert_array_equal(render_gaussians(CLOUD, CAMERA, antialiased=False).colour.numpy(), without)
    assert np.abs(drawn - without).max() > 0.05


def test_it_survives_what_is_done_with_a_cloud() -> None:
    frame = BodyFrame(np.eye(3)[[1, 2, 0]], np.ones(3), 2.0)
    for cloud in (
        CLOUD.subset(np.arange(3)),
        CLOUD.scaled(2.0),
        with_degree(CLOUD, 0),
        concatenate(CLOUD, CLOUD),
        pickle.loads(pickle.dumps(CLOUD)),
        to_body_frame(CLOUD, frame),
    ):
        assert cloud.antialiased
    assert not concatenate(CLOUD, make_cloud(40, 1)).antialiased


def test_it_is_in_the_files_of_a_run_and_in_its_page(tmp_path: Path) -> None:
    for name, data in finished_run().items():
        (tmp_path / name).write_bytes(data)
    plain = Recording.read(tmp_path)
    assert not plain.creature.splats.antialiased and b'"antialiased": false' in plain.bytes()[:100_000]
    slid = slide(struck=True)
    RenderData.of(replace(plain.creature.splats, antialiased=True), CAMERA, slid.stepper.muscles).save(
        tmp_path / "creature.npz"
    )
    run = Recording.read(tmp_path)
    assert run.creature.splats.antialiased and b'"antialiased": true' in run.bytes()[:100_000]
    cloud: GaussianCloud = run.deformer().deform(run.trajectory.positions[0]).cloud
    assert cloud.antialiased
