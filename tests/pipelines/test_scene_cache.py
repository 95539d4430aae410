"""Cache of prepared scenes, which is keyed by content, limited in size, and ignored if it is damaged or cannot be
written."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.commands.scene_input import SceneInput
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.inpainting.inpainters import OnnxInpainter, OpenCvInpainter
from egs_warp.io.posed_images import PosedImage
from egs_warp.pipelines import scene_cache
from egs_warp.pipelines.prepare_scene import PreparedScene, SceneOptions, prepare_scene
from egs_warp.pipelines.scene_cache import cache_folder, read_scene, scene_key, write_scene
from egs_warp.segmentation.clearance import StraddlingPolicy
from egs_warp.segmentation.object_spec import ObjectSpec
from tests.support.scenes import FLOOR, ball_on_floor

OPTIONS = SceneOptions(clearing=StraddlingPolicy.SPLIT, flat=True, inpaint=False)
SPEC = ObjectSpec(point=np.array([0.0, -0.5, 0.5]))


@pytest.fixture(scope="module")
def cloud() -> GaussianCloud:
    return ball_on_floor()[0]


@pytest.fixture(scope="module")
def scene(cloud: GaussianCloud) -> PreparedScene:
    return prepare_scene(cloud, SPEC, plane=FLOOR, options=OPTIONS)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(scene_cache.CACHE, str(tmp_path / "cache"))
    found = cache_folder()
    assert found is not None
    return found


def bits(cloud: GaussianCloud) -> list[bytes]:
    return [getattr(cloud, name).numpy().tobytes() for name in ARRAYS]


def test_a_second_motion_reads_the_scene(
    cloud: GaussianCloud,
    scene: PreparedScene,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The cached scene is bitwise equal to the prepared one; for another object, the scene is prepared again."""
    calls: list[ObjectSpec] = []

    def prepared(_: GaussianCloud, spec: ObjectSpec, **__: object) -> PreparedScene:
        calls.append(spec)
        return scene

    monkeypatch.setattr("egs_warp.pipelines.prepare_scene.prepare_scene", prepared)
    given = SceneInput(cloud, [], SPEC, None, FLOOR, ())
    given.prepared(OPTIONS)
    assert "prepared scene" not in capsys.readouterr().err
    again = given.prepared(OPTIONS)
    assert len(calls) == 1
    assert f"egs-warp: reading the prepared scene from {folder}" in capsys.readouterr().err
    for name in ("object", "background", "background_with_hole"):
        assert bits(getattr(again, name)) == bits(getattr(scene, name)), name
    assert again.notes == scene.notes and again.plane.offset == scene.plane.offset
    np.testing.assert_array_equal(again.located.segmentation.object_mask, scene.located.segmentation.object_mask)
    replace(given, spec=ObjectSpec(point=np.array([0.0, -0.4, 0.5]))).prepared(OPTIONS)
    assert len(calls) == 2


def test_the_key_depends_on_the_content(cloud: GaussianCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photo, network = tmp_path / "photo.png", tmp_path / "lama.onnx"
    photo.write_bytes(b"a")
    network.write_bytes(b"a")
    camera = Camera.look_at(np.array([3.0, 0.0, 1.0]), np.zeros(3), np.eye(3)[2], width=8, height=8)

    def key(cloud: GaussianCloud = cloud, options: SceneOptions = OPTIONS, up: np.ndarray | None = None) -> str:
        posed = [PosedImage("photo.png", camera, photo)]
        return scene_key(cloud, SPEC, posed=posed, up=up, plane=FLOOR, options=options)

    means = cloud.means.numpy().copy()
    means[7, 1] = np.nextafter(means[7, 1], np.float32(9.0))
    moved = GaussianCloud.from_numpy(means, *(getattr(cloud, name).numpy() for name in ARRAYS[1:]))
    onnx = replace(OPTIONS, inpainter=OnnxInpainter(network))
    variants: list[Callable[[], object]] = [
        key,
        lambda: key(moved),
        lambda: key(up=np.eye(3)[2]),
        lambda: key(options=replace(OPTIONS, inpainter=OpenCvInpainter())),
        lambda: key(options=onnx),
        lambda: network.write_bytes(b"b") and key(options=onnx),
        lambda: photo.write_bytes(b"b") and key(),
        lambda: monkeypatch.setattr(scene_cache, "_source_digest", lambda: "another program") or key(),
    ]
    keys = [variant() for variant in variants]
    assert len(set(keys)) == len(keys)
    assert key() == keys[-1]


def test_the_oldest_scenes_make_room(scene: PreparedScene, folder: Path) -> None:
    for number in range(scene_cache.MAX_SCENES):
        assert write_scene(f"{number}", scene) is None
        os.utime(folder / f"{number}.pickle", (number, number))
    # Reading a scene counts as its use, so scene 1 is now the least recently used one.
    assert read_scene("0") is not None
    write_scene("new", scene)
    left = {f"{number}" for number in range(scene_cache.MAX_SCENES) if number != 1}
    assert {path.stem for path in folder.glob("*")} == {"new", *left}


def test_a_damaged_cache_is_as_good_as_none(
    scene: PreparedScene, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert read_scene("key") is None
    write_scene("key", scene)
    path = folder / "key.pickle"
    path.write_bytes(path.read_bytes()[:1000])
    assert read_scene("key") is None
    path.write_bytes(pickle.dumps("something else"))
    assert read_scene("key") is None
    monkeypatch.setenv(scene_cache.CACHE, str(path))
    note = write_scene("key", scene)
    assert note is not None and note.endswith("EGS_WARP_CACHE sets another folder")
    monkeypatch.setenv(scene_cache.CACHE, "")
    assert cache_folder() is None and write_scene("key", scene) is None and read_scene("key") is None
