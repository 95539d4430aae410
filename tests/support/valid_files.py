"""A valid file of each format that the readers of ``tests/support/readers.py`` accept, as bytes."""

from __future__ import annotations

import base64
import gzip
import io
import json
import struct
import tempfile
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from egs_warp.geometry.gaussians import concatenate
from egs_warp.io.glb import write_glb
from tests.support import onnx
from tests.support.captures import good_bytes, small_cloud, spz_of_streams
from tests.support.ply_variants import columns_of, ply_of, without


def text_ply() -> bytes:
    data = good_bytes("a.ply")
    end = data.index(b"end_header\n") + 11
    rows = np.frombuffer(data[end:], "<f4").reshape(small_cloud().count, -1)
    header = data[:end].replace(b"binary_little_endian", b"ascii")
    return header + "\n".join(" ".join(f"{value:.6g}" for value in row) for row in rows).encode() + b"\n"


def point_ply() -> bytes:
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += b"property float x\nproperty float y\nproperty float z\n"
    header += b"property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    return header + struct.pack("<3f3B", 1, 2, 3, 255, 0, 128) * 2


@cache
def sog() -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(good_bytes("a.sog"))) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def picture(kind: str, mode: str) -> bytes:
    data = io.BytesIO()
    pixels = np.arange(16 * 24 * len(mode), dtype=np.uint8).reshape(16, 24, -1)
    Image.fromarray(pixels.squeeze(), mode).save(data, kind)
    return data.getvalue()


def lod_meta() -> bytes:
    leaves = [{"bound": {"min": [0, 0, 0]}, "lods": {"0": {"file": 0, "offset": k, "count": 1}}} for k in range(3)]
    return json_bytes({"lodLevels": 2, "filenames": ["0_0/meta.json"], "tree": {"children": leaves}})


def json_bytes(tree: Any) -> bytes:
    return json.dumps(tree).encode()


POSE = {"position": [0.0, 1.0, 2.0], "rotation": np.eye(3).tolist()}
INRIA = [{"id": 0, "img_name": "a", "width": 24, "height": 16, "fx": 30.0, "fy": 30.0, **POSE}]
TRANSFORMS = {
    **{"w": 24, "h": 16, "fl_x": 30.0, "cx": 12.0, "k1": 0.1, "p1": 0.0, "camera_model": "OPENCV"},
    "frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}],
}
PLANES = {
    "planes": [
        {
            **{"normal": [0, 0, 1], "offset": 0.5, "centre": [0, 0, 0], "size": 1.0, "pixels": 300, "mine": "text"},
            "hole": {"centre": [0, 0, 0], "texel": 0.1, "texels": [20, 20], "outlines": [[[1, 1], [5, 1], [5, 5]]]},
        }
    ]
}
MUSCLES = {
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
SCRIPT = [{"motion": "hop", "repeat": 2, "distance": 0.5}, {"motion": "twist", "heading_degrees": 90}]
KEYS = [{"time": 0.5, "part": "head", "quantity": "position", "value": [0, 0, -0.1], "weight": 2.0}]
LOOK = {"eye": [4, 3, 1.0], "target": [0.5, 0, 0.5]}
CSV = b"time,part,quantity,x,y,z,weight\n0.5,head,position,0,0,-0.1,1\n1.0,head,position,0,0,0.1,\n"
PATH = {"keys": [{"time": 0.0, "eye": [3, -4, 1.5], "target": [0, 0, 0.5], "fov": 30}, {"time": 1, **LOOK}]}
CONFIG = b"# egs-warp\ncapture: a.ply\nmotion: hop x3, twist 180\nfriction: 0.4\nno-shadow: true\nup: -y\nframes: 9\n"
COLMAP = {
    "cameras.txt": b"# cameras\n1 OPENCV 24 16 30 30 12 8 0.1 0 0 0\n",
    "images.txt": b"# images\n1 1 0 0 0 0 0 2 1 a.png\n1.0 2.0 -1 3.0 4.0 1\n",
    "points3D.txt": b"1 0.5 0.5 2 255 128 0 0.3 1 0\n2 1 1 3 0 0 0 0.1 1 1\n",
}


LENSES = {
    "PINHOLE": "nan 30 12 8",
    "SIMPLE_DIVISION": "30 12 8 -0.1",
    "DIVISION": "30 31 12 8 0.2",
    "EUCM": "30 30 12 8 0.5 1.1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "30 30 12 8 0.1 0 0 0 0 0 0.01 0 0 0.01 0 0",
    "FULL_OPENCV": "30 30 12 8 0.1 0 0.01 0 0 0.2 0 0",
}
"""Camera parameters by COLMAP camera model; no photo uses the first model."""
REALITY_SCAN = (
    b"#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    b"a.png,1.5,-2,0.25,30,85,-1,35,0.001,-0.002,0.1,0,0,0,0.01,0\n"
)
REALITY_SCAN_COMMAS = (
    b"\xef\xbb\xbf#name;x;y;z;heading;pitch;roll;f;px;py;k1;k2;k3;k4;t1;t2\r\n"
    b'"a.png";1,5;-2;0,25;30;85;-1;35;0;0;0,1;0;0;0;0;0\r\n'
)
METASHAPE = b"""<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk><sensors>
<sensor id="0" type="frame">
<calibration type="frame" class="adjusted"><resolution width="24" height="16"/><f>30</f><cx>0.5</cx><b1>0.1</b1>
<k1>0.1</k1><p1>0.01</p1></calibration></sensor></sensors><components><component id="0"><transform><rotation>1 0 0
0 0 -1 0 1 0</rotation><translation>1 2 3</translation><scale>0.5</scale></transform></component></components><cameras>
<camera id="0" sensor_id="0" component_id="0" label="a"><transform>1 0 0 0 0 1 0 0 0 0 1 2 0 0 0 1</transform></camera>
</cameras></chunk></document>"""


OLD_METASHAPE = b"""<document version="1.2.0"><chunk><sensors><sensor id="0" type="fisheye"><resolution width="24"
height="16"/><calibration type="fisheye" class="adjusted"><resolution width="24" height="16"/><fx>30</fx><fy>31</fy>
<cx>12</cx><cy>8</cy><k1>0.1</k1><p1>0.01</p1></calibration></sensor></sensors><cameras>
<camera id="0" sensor_id="0" label="a.png"><transform>1 0 0 0 0 1 0 0 0 0 1 2 0 0 0 1</transform></camera>
<camera id="1" sensor_id="0" label="b.png"></camera></cameras></chunk></document>"""


def adjacent_photo() -> dict[str, bytes]:
    return {"a.png": picture("PNG", "RGB"), "masks/a.png": picture("PNG", "L")}


def colmap_of_lenses() -> dict[str, bytes]:
    used = range(1, len(LENSES))
    cameras = "\ufeff" + "".join(f"{k} {name} 24 16 {numbers}\n" for k, (name, numbers) in enumerate(LENSES.items()))
    images = "".join(f"{k} 1 0 0 0 0 0 2 {k} {k}.png\n" for k in used)
    photos = dict.fromkeys((f"{k}.png" for k in used), picture("PNG", "RGB"))
    return {"cameras.txt": cameras.encode(), "images.txt": images.encode()} | photos


SIZELESS = {
    **{"camera_angle_x": 0.7, "camera_model": "EUCM", "alpha": 0.5, "beta": 1.1},
    "frames": [{"file_path": ".\\a.jpg", "mask_path": "masks\\a.png", "transform_matrix": np.eye(4)[:3].tolist()}],
}


def network() -> bytes:
    names = ["batch", "height", "width"]
    value = onnx.value("image", [names[0], 3, *names[1:]])
    constant = onnx.tensor("c", [1], [1.0])
    return onnx.model(
        [onnx.node("Mul", ["image", "mask"], ["out"])], [constant], [value, onnx.value("mask", [1])], [value]
    )


def zip_with_meta(meta: bytes) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, content in (sog() | {"meta.json": meta}).items():
            archive.writestr(name, content)
    return data.getvalue()


def glb() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_glb(Path(folder) / "a.glb", small_cloud())
        return (Path(folder) / "a.glb").read_bytes()


def gltf() -> bytes:
    return gltf_of(glb())


def gltf_of(data: bytes) -> bytes:
    size = int.from_bytes(data[12:16], "little")
    tree, binary = json.loads(data[20 : 20 + size]), data[28 + size :]
    tree["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    return json_bytes(tree)


def packed_glb() -> bytes:
    """Return a .glb with an embedded .spz in two nodes; the second node is mirrored and has two instances."""
    data = glb()
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
    text = json_bytes(tree)
    text += b" " * (-len(text) % 4)
    words = [0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A]
    return np.array(words, "<u4").tobytes() + text + np.array([len(binary), 0x004E4942], "<u4").tobytes() + binary


def quantized_gltf() -> bytes:
    """Return a .gltf with integer attributes, a node with a matrix, two nodes of one mesh, and a second scene."""
    tree = json.loads(gltf())
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
    return json_bytes(tree)


def packed_gltf() -> bytes:
    return gltf_of(packed_glb())


def ply_variant() -> bytes:
    """Return a big-endian .ply of flat Gaussians in half precision, with colours in bytes, and header tags."""
    columns = without(columns_of(small_cloud()), "scale_2", "f_")
    colours = dict.fromkeys(("red", "green", "blue"), np.arange(small_cloud().count))
    return ply_of(
        columns | colours,
        comments=["SplatRenderMode: mip", "Vertical axis: 0 -3 4"],
        kinds=dict.fromkeys(columns, "f2") | dict.fromkeys(colours, "u1"),
        layout="binary_big_endian",
    )


def georeferenced_ply() -> bytes:
    """Return a .ply with positions in double precision far from the origin and with the comments of Postshot and
    Brush."""
    columns = columns_of(small_cloud())
    places = zip("xyz", (431000.0, 5403000.0, 120.0), strict=True)
    columns |= {name: columns[name].astype(float) + place for name, place in places}
    comments = ["antialiased 1", "Exported from Brush", "Vertical axis: y"]
    return ply_of(columns, comments=comments, kinds=dict.fromkeys("xyz", "f8"), newline="\r\n")


def activated_ply() -> bytes:
    """Return a text .ply with activated scales and opacities, and SH of degree 4."""
    cloud = concatenate(*[small_cloud()] * 3)
    columns = without(columns_of(cloud), "f_rest")
    columns |= {name: np.exp(values) for name, values in columns.items() if name.startswith("scale")}
    columns |= {f"f_rest_{k}": np.zeros(cloud.count) for k in range(72)} | {"opacity": cloud.opacities()}
    return ply_of(columns, layout="ascii")


def streamed_spz() -> bytes:
    return spz_of_streams(gzip.decompress(good_bytes("a.spz")), 7, 9)
