"""Every reader of external files, with a valid file and the requirements on the content that is read.

``tests/support/corruption.py`` derives inputs from them.
"""

from __future__ import annotations

import argparse
import base64
import gzip
import io
import json
import struct
import tempfile
import time
import zipfile
from collections.abc import Callable
from dataclasses import astuple, dataclass
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from PIL import Image

from egs_warp.commands.animate import add_parser
from egs_warp.commands.config import with_config
from egs_warp.commands.object_flag import read_mask
from egs_warp.contact.terrain import read_terrain
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import concatenate
from egs_warp.io import read_cameras, read_capture
from egs_warp.io.bundle import read_bundle
from egs_warp.io.cameras import PosedImage, read_points
from egs_warp.io.glb import write_glb
from egs_warp.io.limits import MAX_COORDINATE, MAX_SIDE
from egs_warp.io.onnx import read_onnx
from egs_warp.io.photos import read_mask_file, read_photo
from egs_warp.io.planes import read_planes
from egs_warp.io.ply import read_point_ply
from egs_warp.io.run_folder import MANIFEST, has_finished
from egs_warp.locomotion.replay import Replay
from egs_warp.motions.beats import read_beats
from egs_warp.motions.command import read_drive
from egs_warp.motions.keyframes import read_keyframes
from egs_warp.motions.route import read_path
from egs_warp.motions.script import motion
from egs_warp.muscles.files import read_muscles
from egs_warp.pipelines.shot import Shot
from egs_warp.training.checkpoint import Checkpoint
from egs_warp.version import __version__
from egs_warp.web.messages import read_message
from tests.support import onnx
from tests.support.bundles import bundle_bytes, text_of, with_text
from tests.support.captures import ARRAYS, good_bytes, small_cloud, spz_of_streams
from tests.support.finished_runs import arrays_as_json, draw_run, finished_run, npz_of_json
from tests.support.meshes import block_mesh
from tests.support.ply_variants import columns_of, ply_of, without
from tests.support.reconstruction import COLMAP_BIN
from tests.support.slides import slide

MAX_SECONDS = 2.0
"""Maximum time to read a small file, s."""


@dataclass(frozen=True)
class Reader:
    """A reader of one kind of file, with a valid file."""

    name: str
    file: str
    """File name of the input."""
    good: Callable[[], bytes]
    read: Callable[[Path], Any]
    """Read the file and assert the requirements on its content."""
    other_files: Callable[[], dict[str, bytes]] = dict
    """Other files of the folder, by name."""
    wrap: Callable[[bytes], bytes] = bytes
    """Conversion of an input to the file's bytes, for corruption inside a checksum."""
    json: bool = False
    """True if inputs are JSON trees."""


class BrokenPromiseError(AssertionError):
    """A reader returned neither a valid object nor a one-line error, or was too slow."""


def outcome(reader: Reader, folder: Path, data: bytes) -> str:
    """Read a file; return ``valid`` or ``refused``, or raise ``BrokenPromiseError``.

    A slow read is repeated, and only the second time counts, because the machine may have paused during the first.
    """
    path = folder / reader.file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(reader.wrap(data))
    first = _read(reader, path)
    if not first.slow:
        return first.result
    second = _read(reader, path)
    if second.slow:
        raise BrokenPromiseError(f"{reader.name}: {second}; {first} the first time")
    return second.result


@dataclass(frozen=True)
class _Reading:
    """Result of one reading of a file."""

    result: str
    took: float
    """Wall-clock time, s."""
    work: float
    """CPU time of all threads, s."""

    @property
    def slow(self) -> bool:
        """True if the read took too long: by CPU time, because the machine may be busy, or by a longer wall-clock time,
        because the read may block."""
        return self.work > MAX_SECONDS or self.took > 10.0 * MAX_SECONDS

    def __str__(self) -> str:
        return f"{self.work:.1f} s of work in {self.took:.1f} s"


def _read(reader: Reader, path: Path) -> _Reading:
    began, worked = time.perf_counter(), time.process_time()
    try:
        with np.errstate(all="ignore"):
            reader.read(path)
        result = "valid"
    except UserError as error:
        if "\n" in str(error):
            raise BrokenPromiseError(f"{reader.name}: more than one line: {error}") from error
        result = "refused"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        raise BrokenPromiseError(f"{reader.name}: {type(error).__name__}: {error}") from error
    return _Reading(result, time.perf_counter() - began, time.process_time() - worked)


def prepare(reader: Reader, folder: Path) -> None:
    """Write the other files of the input's folder."""
    for name, data in reader.other_files().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


# Requirements on the content --------------------------------------------------------------------------------------


def _capture(path: Path) -> None:
    cloud = read_capture(path, device="cpu").cloud
    values = {name: getattr(cloud, name).numpy() for name in ARRAYS}
    assert all(np.isfinite(array).all() for array in values.values())
    assert (np.abs(values["means"]) <= 2e4 * MAX_COORDINATE).all() and (np.abs(values["sh"]) <= 1e3).all()
    assert values["log_scales"].min() >= -100.0 and values["log_scales"].max() < 40.0
    assert np.allclose(np.linalg.norm(values["rotations"], axis=1), 1.0, atol=1e-5)


def _bundle(path: Path) -> None:
    bundle = read_bundle(path)
    for body in bundle.bodies:
        assert np.isfinite(body.splats.means.numpy()).all()
        if body.cage is not None:
            assert np.isfinite(body.cage.nodes).all() and len(body.cage.nodes) == bundle.frames


def _cameras(path: Path) -> list[PosedImage]:
    images = read_cameras(path)
    for one in images:
        camera = one.camera
        assert 1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.translation, *camera.rotation.ravel()]
        assert np.isfinite(numbers).all() and min(camera.fx, camera.fy) > 0
    return images


def _photos(path: Path) -> None:
    """Read the cameras and their undistorted photos."""
    for one in _cameras(path):
        if one.image is not None:
            photo = read_photo(one, max_side=20)
            assert photo.colour.shape == (photo.camera.height, photo.camera.width, 3)
            assert np.isfinite(photo.colour).all()
            assert photo.alpha is None or 0.0 <= photo.alpha.min() <= photo.alpha.max() <= 1.0


def _colmap(path: Path) -> None:
    _cameras(path.parent)
    points = read_points(path.parent)
    assert points is None or np.isfinite([points.positions, points.colours]).all()


def _mask(path: Path) -> None:
    mask = read_mask_file(path)
    assert mask.ndim == 2 and mask.dtype == np.float32 and 0.0 <= mask.min() <= mask.max() <= 1.0


def _points(path: Path) -> None:
    positions, colours = read_point_ply(path)
    assert np.isfinite(positions).all() and np.isfinite(colours).all()


def _planes(path: Path) -> None:
    for known in read_planes(path):
        assert np.isclose(np.linalg.norm(known.plane.normal), 1.0) and np.isfinite(known.plane.offset)
        assert known.hole is None or (np.isfinite(known.hole.centre).all() and max(known.hole.texels) <= 8192)


def _terrain(path: Path) -> None:
    for solid in read_terrain(path):
        assert all(np.isfinite([*face.normal, face.offset]).all() for face in solid.faces)


def _muscles(path: Path) -> None:
    muscles = read_muscles(path, block_mesh(), body_weight=10.0)
    assert np.isfinite(muscles.stiffness).all() and muscles.segment_count <= 400


def _script(path: Path) -> None:
    assert 1 <= motion(str(path)).frames() < 10**6


def _line(path: Path) -> None:
    assert 1 <= motion(path.read_bytes().decode("latin-1")).frames() < 10**6


def _keys(path: Path) -> None:
    for key in read_keyframes(path):
        assert np.isfinite([key.time, *key.value, key.weight]).all()


def _camera_path(path: Path) -> None:
    Shot(str(path)).check()


class _Flags(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(message)


def _config(path: Path) -> None:
    add_parser(commands := _Flags().add_subparsers())
    assert f"--config={path}" in with_config(["--config", str(path)], commands.choices["animate"])


def _photo(path: Path) -> None:
    photo = read_photo(
        PosedImage("a", Camera(24, 16, 30.0, 30.0, 12.0, 8.0, np.eye(3), np.zeros(3)), path), max_side=20
    )
    assert photo.colour.shape == (photo.camera.height, photo.camera.width, 3)


# Good files -------------------------------------------------------------------------------------------------------


def _text_ply() -> bytes:
    data = good_bytes("a.ply")
    end = data.index(b"end_header\n") + 11
    rows = np.frombuffer(data[end:], "<f4").reshape(small_cloud().count, -1)
    header = data[:end].replace(b"binary_little_endian", b"ascii")
    return header + "\n".join(" ".join(f"{value:.6g}" for value in row) for row in rows).encode() + b"\n"


def _point_ply() -> bytes:
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += b"property float x\nproperty float y\nproperty float z\n"
    header += b"property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    return header + struct.pack("<3f3B", 1, 2, 3, 255, 0, 128) * 2


@cache
def _sog() -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(good_bytes("a.sog"))) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _picture(kind: str, mode: str) -> bytes:
    data = io.BytesIO()
    pixels = np.arange(16 * 24 * len(mode), dtype=np.uint8).reshape(16, 24, -1)
    Image.fromarray(pixels.squeeze(), mode).save(data, kind)
    return data.getvalue()


def _lod_meta() -> bytes:
    leaves = [{"bound": {"min": [0, 0, 0]}, "lods": {"0": {"file": 0, "offset": k, "count": 1}}} for k in range(3)]
    return _json({"lodLevels": 2, "filenames": ["0_0/meta.json"], "tree": {"children": leaves}})


def _json(tree: Any) -> bytes:
    return json.dumps(tree).encode()


_POSE = {"position": [0.0, 1.0, 2.0], "rotation": np.eye(3).tolist()}
_INRIA = [{"id": 0, "img_name": "a", "width": 24, "height": 16, "fx": 30.0, "fy": 30.0, **_POSE}]
_TRANSFORMS = {
    **{"w": 24, "h": 16, "fl_x": 30.0, "cx": 12.0, "k1": 0.1, "p1": 0.0, "camera_model": "OPENCV"},
    "frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}],
}
_PLANES = {
    "planes": [
        {
            **{"normal": [0, 0, 1], "offset": 0.5, "centre": [0, 0, 0], "size": 1.0, "pixels": 300, "mine": "text"},
            "hole": {"centre": [0, 0, 0], "texel": 0.1, "texels": [20, 20], "outlines": [[[1, 1], [5, 1], [5, 5]]]},
        }
    ]
}
_MUSCLES = {
    "max_strain": 0.2,
    "mirror_plane": {"point": [0, 0, 0], "normal": [1, 0, 0]},
    "fibres": [
        {
            "name": "a",
            "kind": "longitudinal",
            "from": [0.1, 0, 0.1],
            "to": [0.1, 0, 0.8],
            "segments": 3,
            "mirror": True,
        },
        {"name": "b", "kind": "circular", "centre": [0, 0, 0.5], "axis": [0, 0, 1], "radius": 0.1, "strength": 1.0},
        {"name": "c", "kind": "radial", "centre": [0, 0, 0.4], "axis": [0, 0, 1], "radius": 0.1, "stiffness": 5.0},
        {"name": "d", "kind": "polyline", "points": [[0, 0, 0.2], [0, 0.1, 0.4], [0, 0, 0.6]], "group": "g"},
    ],
}
_SCRIPT = [{"motion": "hop", "repeat": 2, "distance": 0.5}, {"motion": "twist", "heading_degrees": 90}]
_KEYS = [{"time": 0.5, "part": "head", "quantity": "position", "value": [0, 0, -0.1], "weight": 2.0}]
_LOOK = {"eye": [4, 3, 1.0], "target": [0.5, 0, 0.5]}
_CSV = b"time,part,quantity,x,y,z,weight\n0.5,head,position,0,0,-0.1,1\n1.0,head,position,0,0,0.1,\n"
_PATH = {"keys": [{"time": 0.0, "eye": [3, -4, 1.5], "target": [0, 0, 0.5], "fov": 30}, {"time": 1, **_LOOK}]}
_CONFIG = b"# egs-warp\ncapture: a.ply\nmotion: hop x3, twist 180\nfriction: 0.4\nno-shadow: true\nup: -y\nframes: 9\n"
_COLMAP = {
    "cameras.txt": b"# cameras\n1 OPENCV 24 16 30 30 12 8 0.1 0 0 0\n",
    "images.txt": b"# images\n1 1 0 0 0 0 0 2 1 a.png\n1.0 2.0 -1 3.0 4.0 1\n",
    "points3D.txt": b"1 0.5 0.5 2 255 128 0 0.3 1 0\n2 1 1 3 0 0 0 0.1 1 1\n",
}


_LENSES = {
    "PINHOLE": "nan 30 12 8",
    "SIMPLE_DIVISION": "30 12 8 -0.1",
    "DIVISION": "30 31 12 8 0.2",
    "EUCM": "30 30 12 8 0.5 1.1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "30 30 12 8 0.1 0 0 0 0 0 0.01 0 0 0.01 0 0",
    "FULL_OPENCV": "30 30 12 8 0.1 0 0.01 0 0 0.2 0 0",
}
"""COLMAP's camera models with lenses, and their parameters; no photo uses the first one."""
_REALITY_SCAN = (
    b"#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    b"a.png,1.5,-2,0.25,30,85,-1,35,0.001,-0.002,0.1,0,0,0,0.01,0\n"
)
_REALITY_SCAN_COMMAS = (
    b"\xef\xbb\xbf#name;x;y;z;heading;pitch;roll;f;px;py;k1;k2;k3;k4;t1;t2\r\n"
    b'"a.png";1,5;-2;0,25;30;85;-1;35;0;0;0,1;0;0;0;0;0\r\n'
)
_METASHAPE = b"""<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk><sensors>
<sensor id="0" type="frame">
<calibration type="frame" class="adjusted"><resolution width="24" height="16"/><f>30</f><cx>0.5</cx><b1>0.1</b1>
<k1>0.1</k1><p1>0.01</p1></calibration></sensor></sensors><components><component id="0"><transform><rotation>1 0 0
0 0 -1 0 1 0</rotation><translation>1 2 3</translation><scale>0.5</scale></transform></component></components><cameras>
<camera id="0" sensor_id="0" component_id="0" label="a"><transform>1 0 0 0 0 1 0 0 0 0 1 2 0 0 0 1</transform></camera>
</cameras></chunk></document>"""


_OLD_METASHAPE = b"""<document version="1.2.0"><chunk><sensors><sensor id="0" type="fisheye"><resolution width="24"
height="16"/><calibration type="fisheye" class="adjusted"><resolution width="24" height="16"/><fx>30</fx><fy>31</fy>
<cx>12</cx><cy>8</cy><k1>0.1</k1><p1>0.01</p1></calibration></sensor></sensors><cameras>
<camera id="0" sensor_id="0" label="a.png"><transform>1 0 0 0 0 1 0 0 0 0 1 2 0 0 0 1</transform></camera>
<camera id="1" sensor_id="0" label="b.png"></camera></cameras></chunk></document>"""


def _adjacent_photo() -> dict[str, bytes]:
    return {"a.png": _picture("PNG", "RGB"), "masks/a.png": _picture("PNG", "L")}


def _colmap_of_lenses() -> dict[str, bytes]:
    used = range(1, len(_LENSES))
    cameras = "\ufeff" + "".join(f"{k} {name} 24 16 {numbers}\n" for k, (name, numbers) in enumerate(_LENSES.items()))
    images = "".join(f"{k} 1 0 0 0 0 0 2 {k} {k}.png\n" for k in used)
    photos = dict.fromkeys((f"{k}.png" for k in used), _picture("PNG", "RGB"))
    return {"cameras.txt": cameras.encode(), "images.txt": images.encode()} | photos


_SIZELESS = {
    **{"camera_angle_x": 0.7, "camera_model": "EUCM", "alpha": 0.5, "beta": 1.1},
    "frames": [{"file_path": ".\\a.jpg", "mask_path": "masks\\a.png", "transform_matrix": np.eye(4)[:3].tolist()}],
}


def _network() -> bytes:
    names = ["batch", "height", "width"]
    value = onnx.value("image", [names[0], 3, *names[1:]])
    constant = onnx.tensor("c", [1], [1.0])
    return onnx.model(
        [onnx.node("Mul", ["image", "mask"], ["out"])], [constant], [value, onnx.value("mask", [1])], [value]
    )


def _zip_with_meta(meta: bytes) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, content in (_sog() | {"meta.json": meta}).items():
            archive.writestr(name, content)
    return data.getvalue()


def _glb() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_glb(Path(folder) / "a.glb", small_cloud())
        return (Path(folder) / "a.glb").read_bytes()


def _gltf() -> bytes:
    return _gltf_of(_glb())


def _gltf_of(data: bytes) -> bytes:
    size = int.from_bytes(data[12:16], "little")
    tree, binary = json.loads(data[20 : 20 + size]), data[28 + size :]
    tree["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    return _json(tree)


def _packed_glb() -> bytes:
    """Return a .glb that contains a .spz, shown by two nodes; the second one is mirrored and has two instances."""
    data = _glb()
    size = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + size])
    packed = gzip.decompress(good_bytes("a.spz"))
    offsets = np.array([[0, 0, 0], [3, 1, 0]], "<f4").tobytes()
    binary = packed + bytes(-len(packed) % 4) + offsets
    for accessor in tree["accessors"]:
        del accessor["bufferView"]
    tree["accessors"].append({"bufferView": 1, "componentType": 5126, "count": 2, "type": "VEC3"})
    views = [{"buffer": 0, "byteLength": len(packed)}]
    views.append({"buffer": 0, "byteOffset": len(binary) - len(offsets), "byteLength": len(offsets)})
    tree |= {"bufferViews": views, "buffers": [{"byteLength": len(binary)}], "scenes": [{"nodes": [0, 1]}]}
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": len(tree["accessors"]) - 1}}}
    tree["nodes"] = [{"mesh": 0}, {"mesh": 0, "scale": [-1, 2, 1], "extensions": instances}]
    splatting = tree["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    splatting["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    tree["extensionsRequired"] = ["KHR_gaussian_splatting", "EXT_mesh_gpu_instancing"]
    text = _json(tree)
    text += b" " * (-len(text) % 4)
    words = [0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A]
    return np.array(words, "<u4").tobytes() + text + np.array([len(binary), 0x004E4942], "<u4").tobytes() + binary


def _quantized_gltf() -> bytes:
    """Return a .gltf with integer attributes, a node with a matrix, two nodes of one mesh, and a second scene."""
    tree = json.loads(_gltf())
    whole = np.round(np.clip(small_cloud().means.numpy(), -3.0, 3.0) * 1000.0).astype("<i2")
    turns = np.round(small_cloud().rotations.numpy()[:, [1, 2, 3, 0]] * 32767.0).astype("<i2")
    data = np.pad(whole, ((0, 0), (0, 1))).tobytes() + turns.tobytes()
    names = tree["meshes"][0]["primitives"][0]["attributes"]
    for name, start, kind in (("POSITION", 0, "VEC3"), ("KHR_gaussian_splatting:ROTATION", len(data) // 2, "VEC4")):
        view = {"buffer": 1, "byteOffset": start, "byteLength": len(data) // 2, "byteStride": 8}
        tree["accessors"][names[name]] |= {"bufferView": len(tree["bufferViews"]), "componentType": 5122, "type": kind}
        tree["bufferViews"].append(view)
    tree["accessors"][names["KHR_gaussian_splatting:ROTATION"]]["normalized"] = True
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    tree["buffers"].append({"byteLength": len(data), "uri": uri})
    matrix = np.diag([0.001, 0.001, 0.002, 1.0]).ravel().tolist()
    tree["nodes"] = [{"matrix": matrix, "children": [1]}, {"mesh": 0}, {"mesh": 0}]
    tree |= {"scenes": [{"nodes": [2]}, {"nodes": [0, 2]}], "scene": 1, "extensionsUsed": ["KHR_mesh_quantization"]}
    return _json(tree)


def _packed_gltf() -> bytes:
    return _gltf_of(_packed_glb())


def _ply_variant() -> bytes:
    """Return a big-endian .ply of flat Gaussians in half precision, with colours in bytes, and header tags."""
    columns = without(columns_of(small_cloud()), "scale_2", "f_")
    colours = dict.fromkeys(("red", "green", "blue"), np.arange(small_cloud().count))
    return ply_of(
        columns | colours,
        comments=["SplatRenderMode: mip", "Vertical axis: 0 -3 4"],
        kinds=dict.fromkeys(columns, "f2") | dict.fromkeys(colours, "u1"),
        layout="binary_big_endian",
    )


def _georeferenced_ply() -> bytes:
    """Return a .ply with positions in double precision far from the origin, and the comments of Postshot and Brush."""
    columns = columns_of(small_cloud())
    places = zip("xyz", (431000.0, 5403000.0, 120.0), strict=True)
    columns |= {name: columns[name].astype(float) + place for name, place in places}
    comments = ["antialiased 1", "Exported from Brush", "Vertical axis: y"]
    return ply_of(columns, comments=comments, kinds=dict.fromkeys("xyz", "f8"), newline="\r\n")


def _activated_ply() -> bytes:
    """Return a text .ply with activated scales and opacities, and SH of degree 4."""
    cloud = concatenate(*[small_cloud()] * 3)
    columns = without(columns_of(cloud), "f_rest")
    columns |= {name: np.exp(values) for name, values in columns.items() if name.startswith("scale")}
    columns |= {f"f_rest_{k}": np.zeros(cloud.count) for k in range(72)} | {"opacity": cloud.opacities()}
    return ply_of(columns, layout="ascii")


def _spz_of_streams() -> bytes:
    return spz_of_streams(gzip.decompress(good_bytes("a.spz")), 7, 9)


@cache
def _record() -> dict[str, bytes]:
    """Return the files of a recorder after eight steps, by name."""
    slid = slide()
    with tempfile.TemporaryDirectory() as folder:
        recorder = slid.recorder(folder=lambda: Path(folder))
        for report in slid.reports[:8]:
            recorder.add([report])
        recorder.trajectory()
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def _replayed(path: Path) -> None:
    slid = slide()
    replay = Replay(path.parent, slid.recorder().start, slid.stepper.detector)
    reports = [report for _ in slid.reports for report in replay.step(0)]
    assert len(reports) == 8 and all(np.isfinite(report.state.positions).all() for report in reports)


def _beats(path: Path) -> None:
    beats = read_beats(path)
    assert beats and np.isfinite(beats).all() and (np.diff(beats) > 0.0).all()


def _path(path: Path) -> None:
    assert np.isfinite(read_path(path)).all()


def _drive(path: Path) -> None:
    plan = read_drive(path)
    assert 0.0 <= plan.seconds < 1e5 and np.isfinite(astuple(plan.at(plan.seconds))).all()


_MESSAGES = [
    *({"type": "motion", "text": "hop x3, twist 90"}, {"type": "go", "x": 0.5, "y": -0.2}),
    *({"type": "drive", "forward": 0.3, "turn": 0.5}, {"type": "pull", "node": 3, "x": 0.1, "y": 0.0, "z": 0.2}),
    *({"type": "push", "x": 0.1, "y": 0.0, "z": 0.0, "height": 0.8}, {"type": "set", "friction": 0.5, "sag": 0.03}),
    *({"type": "pause", "on": True}, {"type": "cancel"}, {"type": "record", "on": False}),
]


def _messages(path: Path) -> None:
    """Read messages in the way of the server of ``live``; an invalid one gives a one-line error."""
    try:
        tree = json.loads(path.read_bytes())
        for message in tree if isinstance(tree, list) else [tree]:
            if not isinstance(message, dict):
                raise ValueError("not an object")
            read_message(message, height=1.0, node_count=50)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(str(error)[:200].replace("\n", " ")) from None


_MANIFEST = {
    **{"schema": 1, "version": __version__, "command": "animate", "finished": False},
    "files": {"run.yaml": None, "a/b.ply": {"bytes": 3, "sha256": "0" * 64}},
}


def _manifest(path: Path) -> None:
    (path.parent / "run.yaml").touch()
    assert has_finished(path.parent) in (True, False)


@cache
def _training() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = Checkpoint(Path(folder) / "a.training.npz")
        checkpoint.begin("digest")
        checkpoint.write({"step": 3, "losses": np.arange(3.0), "queue": [1, 2], "order": {"state": 2**100}})
        return checkpoint.path.read_bytes()


def _trained(path: Path) -> None:
    state = Checkpoint(path, resume=True).begin("digest")
    assert state is not None and state["losses"].shape == (3,)


_NPZ = ("trajectory.npz", "creature.npz")
READERS: tuple[Reader, ...] = (
    Reader("ply", "a.ply", lambda: good_bytes("a.ply"), _capture),
    Reader("text ply", "a.ply", _text_ply, _capture),
    Reader("compressed ply", "a.ply", lambda: good_bytes("b.ply"), _capture),
    Reader("spz", "a.spz", lambda: good_bytes("a.spz"), _capture),
    Reader("spz inside gzip", "a.spz", lambda: gzip.decompress(good_bytes("a.spz")), _capture, wrap=gzip.compress),
    Reader("spz of streams", "a.spz", _spz_of_streams, _capture),
    Reader("glb", "a.glb", _glb, _capture),
    Reader("gltf", "a.gltf", _gltf, _capture, json=True),
    Reader("packed glb", "a.glb", _packed_glb, _capture),
    Reader("packed gltf", "a.gltf", _packed_gltf, _capture, json=True),
    Reader("ply of other tools", "a.ply", _ply_variant, _capture),
    Reader("quantized gltf", "a.gltf", _quantized_gltf, _capture, json=True),
    Reader("activated ply", "a.ply", _activated_ply, _capture),
    Reader("georeferenced ply", "a.ply", _georeferenced_ply, _capture),
    Reader("splat", "a.splat", lambda: good_bytes("a.splat"), _capture),
    Reader("sog", "a.sog", lambda: good_bytes("a.sog"), _capture),
    Reader("sog meta", "a.sog", lambda: _sog()["meta.json"], _capture, wrap=_zip_with_meta, json=True),
    Reader(
        "sog picture", "means_u.webp", lambda: _sog()["means_u.webp"], lambda p: _capture(p.parent), other_files=_sog
    ),
    Reader(
        **{"name": "lod-meta", "file": "lod-meta.json", "good": _lod_meta, "read": _capture, "json": True},
        other_files=lambda: {f"0_0/{name}": data for name, data in _sog().items()},
    ),
    Reader("bundle", "a.egs", bundle_bytes, _bundle),
    Reader("bundle text", "a.egs", lambda: _json(text_of(bundle_bytes())), _bundle, wrap=with_text, json=True),
    Reader("cameras.json", "cameras.json", lambda: _json(_INRIA), _cameras, json=True),
    Reader("transforms.json", "transforms.json", lambda: _json(_TRANSFORMS), _cameras, json=True),
    *(Reader(f"colmap {name}", name, lambda name=name: _COLMAP[name], _colmap, lambda: _COLMAP) for name in _COLMAP),
    *(
        Reader(f"colmap {name}", name, lambda name=name: COLMAP_BIN[name], _colmap, lambda: COLMAP_BIN)
        for name in COLMAP_BIN
    ),
    Reader(
        "transforms.json without sizes",
        "transforms.json",
        lambda: _json(_SIZELESS),
        _photos,
        _adjacent_photo,
        json=True,
    ),
    Reader(
        "colmap lenses",
        "cameras.txt",
        lambda: _colmap_of_lenses()["cameras.txt"],
        lambda p: _photos(p.parent),
        _colmap_of_lenses,
    ),
    Reader("reality scan", "cameras.csv", lambda: _REALITY_SCAN, _photos, _adjacent_photo),
    Reader("reality scan with commas", "cameras.csv", lambda: _REALITY_SCAN_COMMAS, _photos, _adjacent_photo),
    Reader("metashape", "cameras.xml", lambda: _METASHAPE, _photos, _adjacent_photo),
    Reader("old metashape", "cameras.xml", lambda: _OLD_METASHAPE, _photos, _adjacent_photo),
    Reader("mask of a photo", "mask.png", lambda: _picture("PNG", "RGBA"), _mask),
    Reader("point ply", "input.ply", _point_ply, _points),
    Reader("plane.json", "plane.json", lambda: _json(_PLANES), _planes, json=True),
    Reader("terrain", "terrain.json", lambda: _json([[[0, 0, 1, -0.1], [-1, 0, 0, 0.5]]]), _terrain, json=True),
    Reader("muscles", "muscles.json", lambda: _json(_MUSCLES), _muscles, json=True),
    Reader("script", "script.json", lambda: _json(_SCRIPT), _script, json=True),
    Reader("motion line", "line.txt", lambda: b"hop x3, twist 180, walk to 1,0.5, walk 2, jump 0.5 height=0.3", _line),
    Reader("key frames", "keys.json", lambda: _json(_KEYS), _keys, json=True),
    Reader("key frames csv", "keys.csv", lambda: _CSV, _keys),
    Reader("camera path", "path.json", lambda: _json(_PATH), _camera_path, json=True),
    Reader("run.yaml", "run.yaml", lambda: _CONFIG, _config),
    Reader("recorded start", "start.npz", lambda: _record()["start.npz"], _replayed, other_files=_record),
    Reader("recorded steps", "steps-000000.npz", lambda: _record()["steps-000000.npz"], _replayed, other_files=_record),
    Reader("mask", "mask.png", lambda: _picture("PNG", "L"), read_mask),
    Reader("photo png", "a.png", lambda: _picture("PNG", "RGB"), _photo),
    Reader("photo jpeg", "a.jpg", lambda: _picture("JPEG", "RGB"), _photo),
    Reader("onnx", "a.onnx", _network, read_onnx),
    Reader("beats", "beats.csv", lambda: b"beat\n0.5\n1.0\n1.5\n", _beats),
    Reader("way", "way.csv", lambda: b"ahead,left\n0.2,0\n0.5,0.1\n0.9,-0.2\n", _path),
    Reader("drive", "drive.csv", lambda: b"time,forward,sideways,turn\n0,0.3,0,0\n2,0.1,0.1,0.5\n4,0,0,0\n", _drive),
    Reader("message of the page", "message.json", lambda: _json(_MESSAGES), _messages, json=True),
    Reader("manifest", MANIFEST, lambda: _json(_MANIFEST), _manifest, json=True),
    Reader("training to go on with", "a.training.npz", _training, _trained),
    *(Reader(f"run: {name}", name, lambda name=name: finished_run()[name], draw_run, finished_run) for name in _NPZ),
    *(
        Reader(
            **{"name": f"arrays of {name}", "file": name, "good": lambda name=name: arrays_as_json(name)},
            **{"read": draw_run, "other_files": finished_run, "wrap": npz_of_json, "json": True},
        )
        for name in _NPZ
    ),
    Reader("report of a run", "report.json", lambda: finished_run()["report.json"], draw_run, finished_run, json=True),
)
