"""Skinned mesh of a run, evaluated by the rules of glTF 2.0."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.cli import main
from egs_warp.deformation.embedding import embed_points
from egs_warp.pipelines.finished_run import FinishedRun


class _Skin:
    """Reader of one skinned mesh with one animation."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        length = int.from_bytes(data[12:16], "little")
        self.text: dict[str, Any] = json.loads(data[20 : 20 + length])
        self._binary = data[28 + length :]

    def array(self, number: int) -> np.ndarray:
        entry = self.text["accessors"][number]
        view = self.text["bufferViews"][entry["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[entry["type"]]
        dtype = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[entry["componentType"]]
        values = np.frombuffer(self._binary, dtype, entry["count"] * width, view["byteOffset"])
        return values.reshape(entry["count"], width)

    def vertices(self, key: int) -> np.ndarray:
        """Return the skinned vertices of the scene at a key frame."""
        (animation,), (skin,) = self.text["animations"], self.text["skins"]
        local = {}
        for channel in animation["channels"]:
            values = self.array(animation["samplers"][channel["sampler"]]["output"])[key].astype(float)
            local[channel["target"]["node"], channel["target"]["path"]] = values
        body = np.eye(4)
        body[:3, :3] = Rotation.from_quat(local[1, "rotation"]).as_matrix()
        body[:3, 3] = local[1, "translation"]
        matrices = np.tile(np.eye(4), (len(skin["joints"]), 1, 1))
        matrices[:, :3, 3] = [local[node, "translation"] for node in skin["joints"]]
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        matrices = body @ matrices @ inverse
        attributes = self.text["meshes"][0]["primitives"][0]["attributes"]
        points, joints, weights = (self.array(attributes[name]) for name in ("POSITION", "JOINTS_0", "WEIGHTS_0"))
        blended = np.einsum("vj,vjab->vab", weights, matrices[joints])
        return np.einsum("vab,vb->va", blended, np.c_[points, np.ones(len(points))])[:, :3]


def _upright(points: np.ndarray) -> np.ndarray:
    return points[..., [0, 2, 1]] * [1.0, 1.0, -1.0]


@pytest.fixture(scope="module")
def run(run_folder: Path) -> FinishedRun:
    return FinishedRun.read(run_folder)


def test_the_surface_of_the_cage_moves_as_in_the_run(run: FinishedRun, run_folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    assert main(["export", str(run_folder), "--to", "skin", "--out", str(path), "--every", "4"]) == 0
    skin = _Skin(path)
    used: np.ndarray = np.unique(run.mesh.boundary_faces().ravel())
    times = skin.array(skin.text["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, np.arange(0, 13, 4) / 60.0, rtol=1e-6)
    for key, frame in ((0, 0), (3, 12)):
        np.testing.assert_allclose(
            skin.vertices(key), _upright(run.trajectory.positions[run.steps[frame]][used]), atol=1e-6
        )
    triangles = skin.array(skin.text["meshes"][0]["primitives"][0]["indices"]).reshape(-1, 3)
    corners = skin.vertices(0)[triangles]
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    assert volume > 0.0  # The triangles are oriented outwards.
    material = skin.text["materials"][skin.text["meshes"][0]["primitives"][0]["material"]]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0.0


def test_a_mesh_in_the_frame_of_the_capture_moves_with_the_cage(
    run: FinishedRun, run_folder: Path, tmp_path: Path
) -> None:
    t = run.trajectory
    inside = t.rest_positions[t.tets].mean(axis=1)[:4]
    far = t.rest_positions.max(axis=0) + [0.0, 0.0, 0.3]
    points = t.in_capture(np.r_[inside, far[None]])
    lines = [*(f"v {x} {y} {z}" for x, y, z in points.tolist()), "f 1 2 3 4", "f 1 2 5"]
    (tmp_path / "object.obj").write_text("\n".join(lines))
    path = tmp_path / "a.glb"
    flags = ["--to", "skin", "--out", str(path), "--mesh", str(tmp_path / "object.obj"), "--every", "12"]
    assert main(["export", str(run_folder), *flags]) == 0
    skin = _Skin(path)
    assert skin.text["accessors"][skin.text["meshes"][0]["primitives"][0]["indices"]]["count"] == 9
    moved = t.positions[run.steps[12]]
    embedding = embed_points(run.mesh, inside, device="cpu")
    expected = np.einsum("pc,pci->pi", embedding.weights.numpy(), moved[embedding.nodes.numpy().astype(np.int64)])
    np.testing.assert_allclose(skin.vertices(1)[:4], _upright(expected), atol=1e-6)
    shift = skin.vertices(1)[4] - skin.vertices(0)[4]
    assert np.linalg.norm(shift) < 1.5 * np.linalg.norm(moved - t.positions[0], axis=1).max()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--to", "skin", "--out", "a.gltf"], "a.gltf: give a name that ends in .glb"),
        (["--to", "skin", "--out", "a.glb", "--frame", "2"], "--frame: a skin contains all frames"),
        (["--to", "usd", "--out", "a.usdc", "--mesh", "a.obj"], "--mesh: only a skin moves a mesh"),
        (["--to", "skin", "--out", "a.glb", "--mesh", "a.fbx"], "--mesh a.fbx: give a file of triangles, one of .obj"),
        (["--to", "skin", "--out", "a.glb", "--mesh", "text.obj"], "text.obj: cannot be read as a mesh of triangles"),
    ],
)
def test_bad_input_is_one_line(
    flags: list[str],
    said: str,
    run_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.obj").write_text("v 1 2 three\n")
    assert main(["export", str(run_folder), *flags]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
