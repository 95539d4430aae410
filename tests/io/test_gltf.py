"""glTF with splats: round trips, and variants that the standard allows."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.io import read_capture
from egs_warp.io.glb import write_glb
from tests.support.captures import make_cloud

PREFIX = "KHR_gaussian_splatting"


def _parts(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def _glb(tree: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    words = [0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A]
    return np.array(words, "<u4").tobytes() + text + np.array([len(binary), 0x004E4942], "<u4").tobytes() + binary


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_written_files_are_read_back(degree: int, tmp_path: Path) -> None:
    cloud = make_cloud(300, degree)
    write_glb(tmp_path / "a.glb", cloud)
    capture = read_capture(tmp_path / "a.glb", device="cpu")
    read = capture.cloud
    for name in ("means", "rotations", "sh"):
        np.testing.assert_array_equal(getattr(read, name).numpy(), getattr(cloud, name).numpy())
    np.testing.assert_allclose(read.log_scales.numpy(), cloud.log_scales.numpy(), atol=1e-6)
    np.testing.assert_allclose(read.opacities(), cloud.opacities(), atol=1e-6)
    np.testing.assert_array_equal(capture.up, [0.0, 1.0, 0.0])
    assert capture.notes == ()


def test_a_gltf_with_an_embedded_or_external_buffer(tmp_path: Path) -> None:
    cloud = make_cloud(50)
    write_glb(tmp_path / "a.glb", cloud)
    tree, binary = _parts(tmp_path / "a.glb")
    (tmp_path / "the buffer.bin").write_bytes(binary)
    inside = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    for uri in (inside, "the%20buffer.bin"):
        tree["buffers"][0]["uri"] = uri
        (tmp_path / "a.gltf").write_text(json.dumps(tree))
        read = read_capture(tmp_path / "a.gltf", device="cpu").cloud
        np.testing.assert_array_equal(read.means.numpy(), cloud.means.numpy())
    tree["buffers"][0]["uri"] = "../the buffer.bin"
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    with pytest.raises(UserError, match="which lies outside its folder"):
        read_capture(tmp_path / "a.gltf")


def test_small_numbers_and_strides(tmp_path: Path) -> None:
    """Rotations as normalized int16, opacities as normalized uint8 with three bytes between them."""
    cloud = make_cloud(40)
    write_glb(tmp_path / "a.glb", cloud)
    tree, binary = _parts(tmp_path / "a.glb")
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    turns = np.rint(cloud.rotations.numpy()[:, [1, 2, 3, 0]] * 32767).astype("<i2")
    opacities = np.zeros((40, 4), np.uint8)
    opacities[:, 0] = np.rint(255 * cloud.opacities())
    for name, kind, values, stride in (("ROTATION", 5122, turns, None), ("OPACITY", 5121, opacities, 4)):
        accessor = tree["accessors"][attributes[f"{PREFIX}:{name}"]]
        accessor |= {"componentType": kind, "normalized": True, "bufferView": len(tree["bufferViews"])}
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes}
        tree["bufferViews"].append(view | ({"byteStride": stride} if stride else {}))
        binary += values.tobytes()
    (tmp_path / "b.glb").write_bytes(_glb(tree, binary))
    read = read_capture(tmp_path / "b.glb", device="cpu").cloud
    np.testing.assert_allclose(read.rotations.numpy(), cloud.rotations.numpy(), atol=1e-4)
    np.testing.assert_allclose(read.opacities(), cloud.opacities(), atol=0.5 / 255 + 1e-6)


def test_a_rotated_node_declares_the_up_direction(tmp_path: Path) -> None:
    """A mesh with z up, under a node that rotates it to y up, as exporters write it."""
    write_glb(tmp_path / "a.glb", make_cloud(20))
    tree, binary = _parts(tmp_path / "a.glb")
    tree["nodes"] = [{"mesh": 0}, {"children": [0], "rotation": [-(0.5**0.5), 0, 0, 0.5**0.5], "scale": [2, 2, 2]}]
    (tmp_path / "b.glb").write_bytes(_glb(tree, binary))
    capture = read_capture(tmp_path / "b.glb", device="cpu")
    assert capture.up is not None
    np.testing.assert_allclose(capture.up, [0.0, 0.0, 1.0], atol=1e-12)
    assert capture.notes == ("the transforms of glTF's nodes were ignored: the capture is in the axes of its mesh",)


def _changed(tree: dict[str, Any], case: str) -> None:
    primitive = tree["meshes"][0]["primitives"][0]
    if case == "a mesh":
        del primitive["extensions"]
    elif case == "packed":
        primitive["extensions"][PREFIX]["extensions"] = {f"{PREFIX}_compression_spz_2": {}}
    elif case == "linear":
        primitive["extensions"][PREFIX]["colorSpace"] = "lin_rec709_display"
    elif case == "long":
        tree["accessors"][0]["count"] = 10**12
    elif case == "negative":
        tree["accessors"][0]["count"] = -4
    elif case == "no scales":
        del primitive["attributes"][f"{PREFIX}:SCALE"]
    elif case == "flat":
        tree["nodes"][0]["scale"] = [0, 0, 0]
    elif case == "nonsense":
        tree["meshes"] = 3


@pytest.mark.parametrize(
    ("case", "said"),
    [
        ("a mesh", "glTF without splats (KHR_gaussian_splatting)"),
        ("packed", "packed by KHR_gaussian_splatting_compression_spz_2 are not read"),
        ("linear", "the colour space 'lin_rec709_display'"),
        ("long", "accessor 0 extends beyond its buffer"),
        ("negative", "accessor 0 extends beyond its buffer"),
        ("no scales", "not a glTF file with splats (KeyError"),
        ("flat", "a transform of its nodes is flat"),
        ("nonsense", "not a glTF file with splats (TypeError"),
    ],
)
def test_unreadable_files_are_one_line_errors(case: str, said: str, tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", make_cloud(10))
    tree, binary = _parts(tmp_path / "a.glb")
    _changed(tree, case)
    (tmp_path / "b.glb").write_bytes(_glb(tree, binary))
    with pytest.raises(UserError, match=re.escape(said)) as caught:
        read_capture(tmp_path / "b.glb")
    assert "\n" not in str(caught.value)


def test_every_truncation_is_one_line(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", make_cloud(3))
    data = (tmp_path / "a.glb").read_bytes()
    for length in range(1, len(data), 37):
        (tmp_path / "b.glb").write_bytes(data[:length])
        with pytest.raises(UserError):
            read_capture(tmp_path / "b.glb")
