"""glTF with splats: round trips, and variants that the standard allows."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io import Capture, read_capture, write_spz
from egs_warp.io.glb import write_glb
from tests.support.captures import assert_same_bits, make_cloud

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
    """The rotations are normalized int16, the opacities normalized uint8 with three bytes between them."""
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
    """Exporters write splats with z up under a node that rotates them to y up; the capture that is read has z up."""
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
        primitive["extensions"][PREFIX]["extensions"] = {f"{PREFIX}_compression_sog": {}}
        del tree["accessors"][primitive["attributes"]["POSITION"]]["bufferView"]
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
        ("a mesh", "the glTF has no splats (KHR_gaussian_splatting)"),
        ("packed", "packed by KHR_gaussian_splatting_compression_sog are not supported"),
        ("linear", "the colour space 'lin_rec709_display'"),
        ("long", "accessor 0 extends beyond its buffer"),
        ("negative", "accessor 0 extends beyond its buffer"),
        ("no scales", "malformed glTF (KeyError"),
        ("flat", "the transform of a node is singular"),
        ("nonsense", "malformed glTF (TypeError"),
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


# Nodes, instances and required extensions -----------------------------------------------------------------------------


def _with_nodes(folder: Path, cloud: GaussianCloud, nodes: list[dict[str, Any]], **more: Any) -> Capture:
    """Write ``cloud`` as mesh 0 of a file with ``nodes``, of which those without a parent form the scene, and read
    it."""
    write_glb(folder / "a.glb", cloud)
    tree, binary = _parts(folder / "a.glb")
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [number for number in range(len(nodes)) if number not in children]
    tree |= {"nodes": nodes, "scenes": [{"nodes": roots}]} | more
    (folder / "b.glb").write_bytes(_glb(tree, binary))
    return read_capture(folder / "b.glb", device="cpu")


def _covariances(cloud: GaussianCloud) -> np.ndarray:
    axes = Rotation.from_quat(cloud.rotations.numpy()[:, [1, 2, 3, 0]].astype(float)).as_matrix()
    axes = axes * np.exp(cloud.log_scales.numpy().astype(float))[:, None]
    return axes @ axes.transpose(0, 2, 1)


def _colours(cloud: GaussianCloud, directions: np.ndarray) -> np.ndarray:
    """Return the colours (n, 3), without the constant term, of each Gaussian seen along its own direction (n, 3)."""
    x, y, z = directions.T
    basis = [np.full(len(x), 0.2820948), -0.4886025 * y, 0.4886025 * z, -0.4886025 * x]
    basis += [1.0925484 * x * y, -1.0925484 * y * z, 0.3153916 * (2 * z * z - x * x - y * y)]
    basis += [-1.0925484 * x * z, 0.5462742 * (x * x - y * y), -0.5900436 * y * (3 * x * x - y * y)]
    basis += [2.8906114 * x * y * z, -0.4570458 * y * (4 * z * z - x * x - y * y)]
    basis += [0.3731763 * z * (2 * z * z - 3 * x * x - 3 * y * y), -0.4570458 * x * (4 * z * z - x * x - y * y)]
    basis += [1.4453057 * z * (x * x - y * y), -0.5900436 * x * (x * x - 3 * y * y)]
    return np.einsum("nk,nkc->nc", np.stack(basis, axis=1)[:, : cloud.sh.shape[1]], cloud.sh.numpy())


def test_two_nodes_of_one_mesh(tmp_path: Path) -> None:
    cloud = make_cloud(30, 1)
    read = _with_nodes(tmp_path, cloud, [{"mesh": 0}, {"mesh": 0, "translation": [2, 0, 0]}])
    assert read.cloud.count == 60
    np.testing.assert_array_equal(read.cloud.means.numpy()[:30], cloud.means.numpy())
    np.testing.assert_allclose(read.cloud.means.numpy()[30:], cloud.means.numpy() + [2, 0, 0], atol=1e-6)
    np.testing.assert_allclose(read.cloud.sh.numpy()[30:], cloud.sh.numpy(), atol=1e-6)
    assert read.notes[0] == "the transforms of glTF's nodes were applied: the capture is in the axes of the scene"
    np.testing.assert_array_equal(read.up, [0, 1, 0])


def test_nodes_near_each_other_and_far_from_the_origin_are_two(tmp_path: Path) -> None:
    nodes = [{"mesh": 0, "translation": [x, 0, 0]} for x in (5403000.0, 5403000.25)]
    means = _with_nodes(tmp_path, make_cloud(30), nodes).cloud.means.numpy()
    np.testing.assert_allclose(means[30:] - means[:30], np.tile([0.25, 0, 0], (30, 1)), atol=1e-6)


def _euler(*degrees: float) -> Rotation:
    return Rotation.from_euler("xyz", degrees, degrees=True)


@pytest.mark.parametrize(
    ("rotation", "scale"),
    [
        (_euler(0, 0, 0), (-1, 1, 1)),
        (_euler(30, -50, 70), (2, 2, -2)),
        (_euler(10, 20, 30), (-1, -1, -1)),
        (_euler(30, -50, 70), (3, 3, 3)),
        (_euler(30, -50, 70), (1, 2, 0.5)),
        (_euler(30, -50, 70), (1, -2, 0.5)),
    ],
)
def test_turned_mirrored_and_stretched_nodes(rotation: Rotation, scale: tuple[float, ...], tmp_path: Path) -> None:
    """Covariances become M Sigma M^T. With the orthogonal factor Q of M, the colour seen along Q d equals the
    original colour seen along d."""
    cloud = make_cloud(40, 3)
    second = {"mesh": 0, "rotation": rotation.as_quat().tolist(), "scale": scale, "translation": [1, 2, 3]}
    read = _with_nodes(tmp_path, cloud, [{"mesh": 0}, second]).cloud.subset(np.arange(40, 80))
    matrix = rotation.as_matrix() @ np.diag(np.array(scale, float))
    np.testing.assert_allclose(read.means.numpy(), cloud.means.numpy() @ matrix.T + [1, 2, 3], atol=1e-5)
    expected = matrix @ _covariances(cloud) @ matrix.T
    np.testing.assert_allclose(_covariances(read), expected, atol=3e-6 * np.abs(expected).max())
    directions = np.random.default_rng(3).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    first, _, last = np.linalg.svd(matrix)
    seen = _colours(read, directions @ (first @ last).T)
    np.testing.assert_allclose(seen, _colours(cloud, directions), atol=2e-5)
    np.testing.assert_allclose(read.opacities(), cloud.opacities(), atol=1e-6)


@pytest.mark.parametrize("scale", [(-1, 1, 1), (1, 2, 1)])
def test_one_mirrored_or_stretched_node_is_applied(scale: tuple[float, ...], tmp_path: Path) -> None:
    """The transform of a single node is applied if the capture would otherwise be mirrored or have another shape."""
    cloud = make_cloud(20)
    read = _with_nodes(tmp_path, cloud, [{"mesh": 0, "scale": scale}])
    np.testing.assert_allclose(read.cloud.means.numpy(), cloud.means.numpy() * scale, atol=1e-6)


def test_flat_gaussians_stay_flat_when_they_are_stretched(tmp_path: Path) -> None:
    cloud = make_cloud(20)
    log_scales = cloud.log_scales.numpy().copy()
    log_scales[:, 1] = -60.0
    flat = GaussianCloud.from_numpy(
        *(cloud.means.numpy(), cloud.rotations.numpy(), log_scales, cloud.opacity_logits.numpy(), cloud.sh.numpy()),
        device="cpu",
    )
    read = _with_nodes(tmp_path, flat, [{"mesh": 0, "scale": [1, 2, 0.5]}]).cloud.log_scales.numpy()
    assert (read.min(axis=1) < read.max(axis=1) - 20.0).all()


@pytest.mark.parametrize("required", [False, True])
def test_instances(required: bool, tmp_path: Path) -> None:
    cloud = make_cloud(10)
    write_glb(tmp_path / "a.glb", cloud)
    tree, binary = _parts(tmp_path / "a.glb")
    offsets = np.array([[0, 0, 0], [3, 0, 0], [0, 0, 5]], "<f4")
    turns = np.rint(32767 * np.array([[0, 0, 0, 1], [0, 0, 1, 0], [1, 0, 0, 0]])).astype("<i2")
    attributes = {}
    for name, kind, values, width in (("TRANSLATION", 5126, offsets, "VEC3"), ("ROTATION", 5122, turns, "VEC4")):
        attributes[name] = len(tree["accessors"])
        tree["accessors"].append(
            {"bufferView": len(tree["bufferViews"]), "componentType": kind, "count": 3, "type": width}
            | ({"normalized": True} if kind == 5122 else {})
        )
        tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes})
        binary += values.tobytes()
    tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    tree["extensionsUsed"].append("EXT_mesh_gpu_instancing")
    if required:
        tree["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    (tmp_path / "b.glb").write_bytes(_glb(tree, binary))
    read = read_capture(tmp_path / "b.glb", device="cpu").cloud.means.numpy().reshape(3, 10, 3)
    means = cloud.means.numpy()
    np.testing.assert_allclose(read[0], means, atol=1e-6)
    np.testing.assert_allclose(read[1], means * [-1, -1, 1] + [3, 0, 0], atol=1e-5)
    np.testing.assert_allclose(read[2], means * [1, -1, -1] + [0, 0, 5], atol=1e-5)


def test_only_the_scene_that_is_shown_is_read(tmp_path: Path) -> None:
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [9, 0, 0]}, {"mesh": 0, "translation": [9, 9, 0]}]
    read = _with_nodes(tmp_path, make_cloud(10), nodes, scenes=[{"nodes": [1]}, {"nodes": [0, 2]}], scene=1)
    assert read.cloud.count == 20
    none = _with_nodes(tmp_path, make_cloud(10), nodes, scenes=[{"nodes": []}], scene=0)
    assert none.cloud.count == 30


def test_too_many_instances(tmp_path: Path) -> None:
    nodes = [{"mesh": 0, "translation": [k, 0, 0]} for k in range(600)]
    with pytest.raises(UserError, match="its instances turn 5000 Gaussians into 3000000; at most 2097152 more"):
        _with_nodes(tmp_path, make_cloud(5000), nodes)


@pytest.mark.parametrize(
    ("required", "message"),
    [
        (["EXT_not_known_to_anyone"], "it requires EXT_not_known_to_anyone, which is not supported"),
        (["KHR_gaussian_splatting", "A", "B", "A"], "it requires A, B, which is not supported"),
        (["EXT_meshopt_compression"], "it requires EXT_meshopt_compression, which is not supported"),
        (["KHR_gaussian_splatting", "KHR_materials_unlit", "KHR_mesh_quantization"], None),
    ],
)
def test_required_extensions(required: list[str], message: str | None, tmp_path: Path) -> None:
    if message is None:
        assert _with_nodes(tmp_path, make_cloud(10), [{"mesh": 0}], extensionsRequired=required).cloud.count == 10
        return
    with pytest.raises(UserError, match=re.escape(message)):
        _with_nodes(tmp_path, make_cloud(10), [{"mesh": 0}], extensionsRequired=required)


def test_a_buffer_without_data_is_not_that_of_the_file(tmp_path: Path) -> None:
    """The fallback buffers of EXT_meshopt_compression have no data. The file uses the extension without listing it as
    required."""
    write_glb(tmp_path / "a.glb", make_cloud(10))
    tree, binary = _parts(tmp_path / "a.glb")
    tree["buffers"].append({"byteLength": len(binary), "extensions": {"EXT_meshopt_compression": {"fallback": True}}})
    for view in tree["bufferViews"]:
        view |= {"buffer": 1, "extensions": {"EXT_meshopt_compression": {"buffer": 0}}}
    (tmp_path / "b.glb").write_bytes(_glb(tree, binary))
    with pytest.raises(UserError, match="packed by EXT_meshopt_compression, which is not supported"):
        read_capture(tmp_path / "b.glb")


def test_instances_without_attributes(tmp_path: Path) -> None:
    node = {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {}}}}
    with pytest.raises(UserError, match=r"malformed glTF \(ValueError: EXT_mesh_gpu_instancing has attributes of"):
        _with_nodes(tmp_path, make_cloud(5), [node])


def test_nodes_that_form_no_tree(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="its nodes are not a tree: node 2 has two parents"):
        _with_nodes(tmp_path, make_cloud(5), [{"children": [2]}, {"children": [2]}, {"mesh": 0}])


# Splats packed as .spz, and other variants
# -----------------------------------------------------------------------------------


def _packed(
    folder: Path, cloud: GaussianCloud, *, version: int = 2, turned: bool = False, bounds: bool = True
) -> tuple[dict[str, Any], bytes]:
    """Return the glTF tree and the buffer of ``cloud`` packed as .spz; the accessors have no data."""
    write_glb(folder / "a.glb", cloud)
    write_spz(folder / "a.spz", cloud, version=version)
    tree, _ = _parts(folder / "a.glb")
    binary = (folder / "a.spz").read_bytes()
    name = f"{PREFIX}_compression_spz_2"
    tree["extensionsRequired"] = [PREFIX, name]
    for accessor in tree["accessors"]:
        del accessor["bufferView"]
    position = tree["accessors"][0]
    if turned:
        low, high = np.array([position["min"], position["max"]]) * [-1, 1, -1]
        position |= {"min": np.minimum(low, high).tolist(), "max": np.maximum(low, high).tolist()}
    if not bounds:
        del position["min"], position["max"]
    tree["bufferViews"] = [{"buffer": 0, "byteLength": len(binary)}]
    tree["meshes"][0]["primitives"][0]["extensions"][PREFIX]["extensions"] = {name: {"bufferView": 0}}
    return tree, binary + bytes(-len(binary) % 4)


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("bounds", [False, True])
def test_packed_by_spz(version: int, bounds: bool, tmp_path: Path) -> None:
    cloud = replace(make_cloud(50, 2), antialiased=True)
    (tmp_path / "b.glb").write_bytes(_glb(*_packed(tmp_path, cloud, version=version, bounds=bounds)))
    capture = read_capture(tmp_path / "b.glb", device="cpu")
    assert_same_bits(capture.cloud, read_capture(tmp_path / "a.spz", device="cpu").cloud)
    assert capture.antialiased
    np.testing.assert_array_equal(capture.up, [0, 1, 0])


def test_packed_by_spz_in_its_own_axes(tmp_path: Path) -> None:
    """According to the draft of the extension, the axes of the .spz data (right, up, back) are read as left, up and
    front."""
    cloud = make_cloud(50, 2)
    (tmp_path / "b.glb").write_bytes(_glb(*_packed(tmp_path, cloud, turned=True)))
    read = read_capture(tmp_path / "b.glb", device="cpu").cloud
    stored = read_capture(tmp_path / "a.spz", device="cpu").cloud
    half_turn = np.diag([-1.0, 1.0, -1.0])
    np.testing.assert_allclose(read.means.numpy(), stored.means.numpy() @ half_turn, atol=1e-6)
    np.testing.assert_allclose(_covariances(read), half_turn @ _covariances(stored) @ half_turn, atol=1e-6)
    directions = np.tile([0.48, 0.6, 0.64], (50, 1))
    np.testing.assert_allclose(_colours(read, directions @ half_turn), _colours(stored, directions), atol=1e-5)


def test_packed_by_spz_of_the_earlier_draft(tmp_path: Path) -> None:
    tree, binary = _packed(tmp_path, make_cloud(50))
    tree["extensionsRequired"] = ["KHR_spz_gaussian_splats_compression"]
    tree["meshes"][0]["primitives"][0]["extensions"] = {"KHR_spz_gaussian_splats_compression": {"bufferView": 0}}
    (tmp_path / "b.glb").write_bytes(_glb(tree, binary))
    assert read_capture(tmp_path / "b.glb", device="cpu").cloud.count == 50


def test_damaged_packing_is_one_line(tmp_path: Path) -> None:
    tree, binary = _packed(tmp_path, make_cloud(50))
    for data, said in ((binary[:200], "extends beyond its buffer"), (b"?" * len(binary), "no .spz inside")):
        (tmp_path / "b.glb").write_bytes(_glb(tree, data))
        with pytest.raises(UserError, match=said):
            read_capture(tmp_path / "b.glb")


def test_scales_of_the_review_draft(tmp_path: Path) -> None:
    """In files of the review draft, scales are logarithms."""
    cloud = make_cloud(20)
    write_glb(tmp_path / "a.glb", cloud)
    tree, binary = _parts(tmp_path / "a.glb")
    view = tree["bufferViews"][tree["meshes"][0]["primitives"][0]["attributes"][f"{PREFIX}:SCALE"]]
    start = view["byteOffset"]
    logs = cloud.log_scales.numpy().tobytes()
    (tmp_path / "b.glb").write_bytes(_glb(tree, binary[:start] + logs + binary[start + len(logs) :]))
    capture = read_capture(tmp_path / "b.glb", device="cpu")
    np.testing.assert_array_equal(capture.cloud.log_scales.numpy(), cloud.log_scales.numpy())
    assert capture.notes == ("scales are negative: read as logarithms",)


@pytest.mark.parametrize(
    ("names", "degree", "note"),
    [
        ([f"SH_DEGREE_4_COEF_{k}" for k in range(9)], 3, "SH band 4 left out (degrees 0 to 3 are rendered)"),
        (["-SH_DEGREE_2_COEF_3"], 1, "SH bands from 2 up left out: band 2 is not complete"),
    ],
)
def test_bands(names: list[str], degree: int, note: str, tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", make_cloud(10, 3))
    tree, binary = _parts(tmp_path / "a.glb")
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    for name in names:
        if name.startswith("-"):
            del attributes[f"{PREFIX}:{name[1:]}"]
        else:
            attributes[f"{PREFIX}:{name}"] = attributes[f"{PREFIX}:SH_DEGREE_3_COEF_0"]
    (tmp_path / "b.glb").write_bytes(_glb(tree, binary))
    capture = read_capture(tmp_path / "b.glb", device="cpu")
    assert (capture.cloud.sh_degree, capture.notes) == (degree, (note,))
