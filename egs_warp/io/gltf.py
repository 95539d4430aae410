"""Reading of glTF 2.0 with splats: KHR_gaussian_splatting as ratified, in one .glb, or a .gltf with its buffers beside
it."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes
from egs_warp.io.raw import EXTREME_LOGIT, RawCapture
from egs_warp.io.text import parse_json

EXTENSION = "KHR_gaussian_splatting"
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_Y_UP = np.array([0.0, 1.0, 0.0])


def is_glb(data: bytes) -> bool:
    """Return True if ``data`` begins as a binary glTF."""
    return data[:4] == b"glTF"


def decode_glb(data: bytes, source: Path) -> RawCapture:
    """Decode a .glb. Raises ``UserError`` for a damaged one, or one without splats of a supported kind."""
    if len(data) < 20 or int.from_bytes(data[4:8], "little") != 2:
        raise UserError(f"{source}: not a .glb file of version 2, or truncated; export it again")
    chunks: dict[int, bytes] = {}
    place = 12
    while place + 8 <= len(data):
        size, kind = (int.from_bytes(data[place + k : place + k + 4], "little") for k in (0, 4))
        if place + 8 + size > len(data):
            raise UserError(f"{source}: truncated: a chunk of {size} bytes extends beyond the file; copy it again")
        chunks.setdefault(kind, data[place + 8 : place + 8 + size])
        place += 8 + size
    text = chunks.get(_JSON, b"")
    if not text or len(text) > MAX_TEXT_BYTES:
        raise UserError(f"{source}: .glb without a JSON chunk of at most {MAX_TEXT_BYTES} bytes; export it again")
    return _decode(text, source, lambda uri: chunks.get(_BINARY, b"") if uri is None else _buffer(uri, source))


def decode_gltf(text: bytes, source: Path) -> RawCapture:
    """Decode a .gltf with buffers beside it or embedded. Raises ``UserError`` as ``decode_glb``."""

    def read(uri: str | None) -> bytes:
        if uri is None:
            raise UserError(f"{source}: a buffer without a uri; export it again")
        return _buffer(uri, source)

    return _decode(text, source, read)


def _buffer(uri: str, source: Path) -> bytes:
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise UserError(f"{source}: a buffer is not valid base64 ({error}); export it again") from error
    name = PurePosixPath(unquote(uri))
    if name.is_absolute() or ".." in name.parts or ":" in uri or "\0" in str(name):
        raise UserError(f"{source}: it names {uri!r}, which lies outside its folder; export it again")
    return read_bytes(source.parent / name)


def _decode(text: bytes, source: Path, read: Callable[[str | None], bytes]) -> RawCapture:
    try:
        tree = parse_json(text.decode("utf-8"), source)
        return _Asset(source, tree, read).capture()
    # An untrusted tree may contain anything anywhere; all deviations from glTF end here.
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(
            f"{source}: not a glTF file with splats ({type(error).__name__}: {error}); export it again"
        ) from error


@dataclass(frozen=True)
class _Asset:
    source: Path
    tree: dict[str, Any]
    read: Callable[[str | None], bytes]

    def capture(self) -> RawCapture:
        """Return all splats of the file in the axes of their mesh."""
        primitives = [
            (number, primitive)
            for number, mesh in enumerate(self.tree.get("meshes", []))
            for primitive in mesh["primitives"]
            if EXTENSION in primitive.get("extensions", {})
        ]
        if not primitives:
            raise UserError(f"{self.source}: glTF without splats ({EXTENSION}); export it as splats, or as .ply")
        turns = [self._scene_transform(number) for number, _ in primitives]
        if any(not np.allclose(turn, turns[0], atol=1e-6) for turn in turns[1:]):
            raise UserError(
                f"{self.source}: its splats lie under different transforms; apply them, and export it again"
            )
        parts = [self._primitive(primitive) for _, primitive in primitives]
        notes, origin = [], None
        if np.array_equal(turns[0][:3, :3], np.eye(3)):
            origin = turns[0][:3, 3] if turns[0][:3, 3].any() else None
        elif not np.allclose(turns[0], np.eye(4), atol=1e-6):
            notes.append("the transforms of glTF's nodes were ignored: the capture is in the axes of its mesh")
        coefficients = min(part["sh"].shape[1] for part in parts)
        if any(part["sh"].shape[1] != coefficients for part in parts):
            notes.append("bands of colour that only some meshes have were left out")
        up = np.linalg.inv(turns[0][:3, :3]) @ _Y_UP
        return RawCapture(
            format="glTF (KHR_gaussian_splatting)",
            means=np.concatenate([part["means"] for part in parts]),
            rotations=np.concatenate([part["rotations"] for part in parts]),
            log_scales=np.concatenate([part["log_scales"] for part in parts]),
            opacity_logits=np.concatenate([part["opacity_logits"] for part in parts]),
            sh=np.concatenate([part["sh"][:, :coefficients] for part in parts]),
            up=up / np.linalg.norm(up),
            origin=origin,
            notes=tuple(notes),
        )

    def _primitive(self, primitive: dict[str, Any]) -> dict[str, np.ndarray]:
        extension = primitive["extensions"][EXTENSION]
        packed = [name for name in extension.get("extensions", {}) if "compression" in name]
        if packed:
            raise UserError(
                f"{self.source}: splats packed by {packed[0]} are not read; export them unpacked, or as .spz"
            )
        if extension.get("kernel", "ellipse") != "ellipse":
            raise UserError(
                f"{self.source}: splats of the kernel {extension['kernel']!r} are not read; export ellipses"
            )
        if not str(extension.get("colorSpace", "srgb_rec709_display")).startswith("srgb"):
            raise UserError(
                f"{self.source}: splats in the colour space {extension['colorSpace']!r}; export"
                " them in srgb_rec709_display"
            )
        attributes = primitive["attributes"]

        count = len(self._accessor(attributes["POSITION"]))

        def of(name: str, width: int = 3) -> np.ndarray:
            values = self._accessor(attributes[name])
            if values.shape != (count, width):
                rows, columns = values.shape
                raise UserError(
                    f"{self.source}: {name} is {rows} x {columns} numbers, not {count} x {width}; export it again"
                )
            return values

        opacity = of(f"{EXTENSION}:OPACITY", 1)[:, 0].astype(np.float64)
        scales = of(f"{EXTENSION}:SCALE").astype(np.float64)
        sh = [of(f"{EXTENSION}:SH_DEGREE_0_COEF_0")]
        for degree in (1, 2, 3):
            names = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}" for k in range(2 * degree + 1)]
            if not all(name in attributes for name in names):
                break
            sh += [of(name) for name in names]
        with np.errstate(divide="ignore", invalid="ignore"):
            logits = np.clip(np.log(opacity) - np.log1p(-opacity), -EXTREME_LOGIT, EXTREME_LOGIT)
            log_scales = np.log(np.maximum(scales, np.finfo(np.float32).tiny))
        return {
            "means": of("POSITION"),
            "rotations": of(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]],
            "log_scales": log_scales.astype(np.float32),
            "opacity_logits": logits.astype(np.float32),
            "sh": np.stack(sh, axis=1),
        }

    def _accessor(self, number: int) -> np.ndarray:
        """(n, width) float32, unpacked according to the standard."""
        accessor = self.tree["accessors"][number]
        view = self.tree["bufferViews"][accessor["bufferView"]]
        kind, width, count = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
        stride = view.get("byteStride", kind.itemsize * width)
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        data = self.read(self.tree["buffers"][view["buffer"]].get("uri"))
        end = start + (count - 1) * stride + kind.itemsize * width
        if "sparse" in accessor or min(start, count - 1) < 0 or stride < kind.itemsize * width or end > len(data):
            raise UserError(
                f"{self.source}: accessor {number} extends beyond its buffer, or is sparse; export it again"
            )
        values = np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))
        if kind.kind == "f":
            return values.astype(np.float32)
        if not accessor.get("normalized", False):
            raise UserError(f"{self.source}: accessor {number} has integers that are not normalized; export it again")
        return np.maximum(values / np.float32(np.iinfo(kind).max), -1.0).astype(np.float32)

    def _scene_transform(self, mesh: int) -> np.ndarray:
        """(4, 4) transform from the mesh to the scene, by the nodes above it."""
        nodes = self.tree.get("nodes", [])
        above = {child: number for number, node in enumerate(nodes) for child in node.get("children", [])}
        number = next((number for number, node in enumerate(nodes) if node.get("mesh") == mesh), None)
        turn = np.eye(4)
        for _ in range(len(nodes)):
            if number is None:
                break
            turn = _transform(nodes[number]) @ turn
            number = above.get(number)
        if not np.isfinite(turn).all() or abs(np.linalg.det(turn[:3, :3])) < 1e-12:
            raise UserError(f"{self.source}: a transform of its nodes is flat or not finite; export it again")
        return turn


def _transform(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix() @ np.diag(
        np.array(node.get("scale", [1, 1, 1]), float)
    )
    turn[:3, 3] = node.get("translation", [0, 0, 0])
    return turn
