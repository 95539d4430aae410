"""Benchmark bodies: captures, objects segmented from scenes, and Gaussians sampled on textured meshes."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from egs_warp.assets import figurine, pawn, stool
from egs_warp.assets.object import shade_gaussians
from egs_warp.assets.surface import SurfaceSamples
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io import read_capture
from egs_warp.pipelines.prepare_scene import SceneOptions, prepare_scene
from egs_warp.segmentation.base_plane import find_base_plane
from egs_warp.segmentation.clearance import StraddlingPolicy
from egs_warp.segmentation.object_spec import ObjectSpec
from harness import data_folder

_GAUSSIANS = 20000
"""Number of Gaussians sampled on a mesh."""


@dataclass(frozen=True)
class Body:
    """A capture and its support plane, in scene units."""

    name: str
    cloud: GaussianCloud
    plane: Plane
    origin: str
    """Source of the Gaussians, as text for the table."""


@dataclass(frozen=True)
class _Textured:
    """A triangle mesh with textures."""

    vertices: np.ndarray
    """(V, 3) float64, z up, of height 1, standing on z = 0."""
    faces: np.ndarray
    """(F, 3) int32, triangles as indices of vertices."""
    places: np.ndarray
    """(F, 3, 2) texture coordinates of each corner, with v pointing up."""
    pictures: tuple[np.ndarray, ...]
    """Textures, (H, W, 3) uint8 each."""
    picture_of_face: np.ndarray
    """(F,) index into ``pictures``."""


def _standing(vertices: np.ndarray) -> np.ndarray:
    """Rotate vertices from y up to z up, scale them to height 1 and put them on z = 0."""
    rotated = vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    low, high = rotated.min(axis=0), rotated.max(axis=0)
    return (rotated - [*(0.5 * (low + high)[:2]), low[2]]) / (high[2] - low[2])


def _picture(source: Path | bytes) -> np.ndarray:
    with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source) as opened:
        return np.asarray(opened.convert("RGB"))


def _obj(path: Path, picture_of_material: dict[str, str]) -> _Textured:
    """Read a Wavefront OBJ file.

    Args:
        path: the OBJ file.
        picture_of_material: texture file of each material, relative to the folder of ``path``; "" is the key of faces
            without a material.
    """
    vertices: list[list[float]] = []
    texture: list[list[float]] = []
    faces: list[list[int]] = []
    places: list[list[int]] = []
    of_face: list[int] = []
    names, current = list(picture_of_material), ""
    for line in path.read_text().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["vt"]:
            texture.append([float(word) for word in words[1:3]])
        elif words[:1] == ["usemtl"] and words[1] in picture_of_material:
            current = words[1]
        elif words[:1] == ["f"]:
            corners = [[int(part) - 1 for part in word.split("/")[:2]] for word in words[1:]]
            for k in range(1, len(corners) - 1):
                fan = (corners[0], corners[k], corners[k + 1])
                faces.append([corner[0] for corner in fan])
                places.append([corner[1] for corner in fan])
                of_face.append(names.index(current))
    pictures = tuple(_picture(path.parent / file) for file in picture_of_material.values())
    return _Textured(
        _standing(np.array(vertices)),
        np.array(faces, np.int32),
        np.array(texture)[np.array(places)],
        pictures,
        np.array(of_face),
    )


def _plain_obj(path: Path) -> _Textured:
    """Read a Wavefront OBJ file of triangles without textures, as light grey."""
    lines = [line.split() for line in path.read_text().splitlines()]
    vertices = np.array([words[1:4] for words in lines if words[:1] == ["v"]], np.float64)
    corners = [[int(part.split("/")[0]) - 1 for part in words[1:4]] for words in lines if words[:1] == ["f"]]
    count = len(corners)
    grey = np.full((1, 1, 3), 200, np.uint8)
    return _Textured(
        _standing(vertices), np.array(corners, np.int32), np.zeros((count, 3, 2)), (grey,), np.zeros(count, int)
    )


def _glb(path: Path) -> _Textured:
    """Read the only mesh of a binary glTF file whose nodes have no rotation, with its first texture."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    gltf, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    (primitive,) = gltf["meshes"][0]["primitives"]

    def view(index: int) -> tuple[bytes, int]:
        one = gltf["bufferViews"][index]
        start = one.get("byteOffset", 0)
        return binary[start : start + one["byteLength"]], one.get("byteStride", 0)

    def floats(index: int, width: int) -> np.ndarray:
        accessor = gltf["accessors"][index]
        raw, stride = view(accessor["bufferView"])
        shape, strides = (accessor["count"], width), (stride or 4 * width, 4)
        return np.ndarray(shape, "<f4", raw, accessor.get("byteOffset", 0), strides).astype(np.float64)

    faces = np.frombuffer(view(gltf["accessors"][primitive["indices"]]["bufferView"])[0], "<u4").reshape(-1, 3)
    texture = floats(primitive["attributes"]["TEXCOORD_0"], 2) * [1.0, -1.0] + [0.0, 1.0]
    picture = _picture(view(gltf["images"][0]["bufferView"])[0])
    vertices = _standing(floats(primitive["attributes"]["POSITION"], 3))
    return _Textured(vertices, faces.astype(np.int32), texture[faces], (picture,), np.zeros(len(faces), int))


def _sample_gaussians(mesh: _Textured, seed: int) -> GaussianCloud:
    """Sample flat Gaussians uniformly by area, coloured by the texture under the lights of the built-in scenes.

    The Gaussians are not trained.
    """
    random = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(normals, axis=1)
    steps = (np.arange(_GAUSSIANS) + random.uniform(size=_GAUSSIANS)) / _GAUSSIANS
    face = np.minimum(np.searchsorted(np.cumsum(areas), areas.sum() * steps), len(areas) - 1)
    u = random.uniform(size=(_GAUSSIANS, 2))
    u = np.where(u.sum(axis=1, keepdims=True) > 1.0, 1.0 - u, u)
    shares = np.column_stack([1.0 - u.sum(axis=1), u])
    place = np.einsum("nk,nki->ni", shares, mesh.places[face]) % 1.0
    albedo = np.zeros((_GAUSSIANS, 3))
    for index, picture in enumerate(mesh.pictures):
        mine = mesh.picture_of_face[face] == index
        column = (place[mine, 0] * (picture.shape[1] - 1)).astype(int)
        row = ((1.0 - place[mine, 1]) * (picture.shape[0] - 1)).astype(int)
        albedo[mine] = (picture[row, column] / 255.0) ** 2.2
    samples = SurfaceSamples(
        np.einsum("nk,nki->ni", shares, corners[face]),
        normals[face] / np.maximum(2.0 * areas[face, None], 1e-300),
        float(np.sqrt(areas.sum() / _GAUSSIANS)),
    )
    gloss = np.zeros(_GAUSSIANS)
    return shade_gaussians(samples, mesh.vertices, mesh.faces, albedo, gloss, random=random, device="cpu")


def _mesh(read: Callable[[], _Textured]) -> Callable[[str], Body]:
    def read_body(name: str) -> Body:
        return Body(
            name, _sample_gaussians(read(), seed=0), Plane(np.array([0.0, 0.0, 1.0]), 0.0), "Gaussians laid on a mesh"
        )

    return read_body


def _capture(file: str, up: tuple[float, float, float]) -> Callable[[str], Body]:
    def read_body(name: str) -> Body:
        cloud = read_capture(data_folder() / file, device="cpu").cloud
        return Body(name, cloud, find_base_plane(cloud, np.array(up)), file)

    return read_body


def _of_scene(file: str, on_it: tuple[float, float, float], plane: Plane | None = None) -> Callable[[str], Body]:
    def read_body(name: str) -> Body:
        cloud = read_capture(data_folder() / file, device="cpu").cloud
        options = SceneOptions(clearing=StraddlingPolicy.SPLIT, inpaint=False)
        scene = prepare_scene(cloud, ObjectSpec(point=np.array(on_it)), plane=plane, options=options)
        return Body(name, scene.object, scene.plane, f"{file}, cut out")

    return read_body


def _playbot(name: str) -> Body:
    """Read the robot without its tile. The robot hovers above the tile, so the support plane is the plane of its own
    base."""
    cloud = read_capture(data_folder() / "scenes" / "playbot", device="cpu").cloud
    tile = Plane(np.array([0.0, -1.0, 0.0]), -0.019)
    above = cloud.subset(tile.heights(cloud.means.numpy()) > 0.13)
    return Body(name, above, find_base_plane(above, tile.normal), "scenes/playbot, above its tile")


def _built_in(make: Callable[..., object]) -> Callable[[str], Body]:
    def read_body(name: str) -> Body:
        scene = make(device="cpu")
        return Body(name, scene.cloud, scene.plane, "built in")  # pyright: ignore[reportAttributeAccessIssue]

    return read_body


def _meshes() -> Path:
    return data_folder() / "meshes"


_CUSHIONS = {"M_Armchair_Cushions": "armchair_cushions.jpg", "M_Armchair_Legs": "armchair_legs.jpg"}
_MAKERS: dict[str, Callable[[str], Body]] = {
    "plush dog": _capture("objects/plush_dog.ply", (0.0, -1.0, 0.0)),
    "monkey": _capture("objects/monkey.ply", (0.0, 1.0, 0.0)),
    "robot": _capture("objects/robot.spz", (0.0, 1.0, 0.0)),
    "koala": _of_scene("scenes/koala.ply", (0.1, -0.7, 0.15)),
    "fox": _of_scene("scenes/fox.ply", (0.0, 0.0, 2.0), Plane.from_coefficients(-0.03, -0.03, 0.999, -1.6)),
    "narcissus": _of_scene("scenes/narcissus.sog", (0.0, -0.8, 0.0)),
    "playbot": _playbot,
    "armchair": _mesh(
        lambda: _obj(
            _meshes() / "armchair" / "armchair.obj",
            {material: f"textures/{file}" for material, file in _CUSHIONS.items()},
        )
    ),
    "cat": _mesh(lambda: _glb(_meshes() / "cat" / "cat.glb")),
    "spot": _mesh(lambda: _obj(_meshes() / "spot" / "spot_triangulated.obj", {"": "spot_texture.png"})),
    "cow": _mesh(lambda: _plain_obj(_meshes() / "cow" / "cow.obj")),
    "cheburashka": _mesh(lambda: _plain_obj(_meshes() / "cheburashka" / "cheburashka.obj")),
    "figurine": _built_in(figurine),
    "pawn": _built_in(pawn),
    "stool": _built_in(stool),
}
NAMES = tuple(_MAKERS)


def body(name: str) -> Body:
    """Read or build the body ``name``, one of ``NAMES``.

    Raises:
        OSError: its file is missing.
        UserError: its file cannot be read.
    """
    return _MAKERS[name](name)
