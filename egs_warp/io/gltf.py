"""Reading of glTF 2.0 with splats: KHR_gaussian_splatting as ratified, in one .glb, or in a .gltf with separate
buffers.

Splats may be compressed with KHR_gaussian_splatting_compression_spz_2 (a .spz in a buffer view). As glTF demands, files
that require an unsupported extension are rejected. See https://github.com/KhronosGroup/glTF/tree/main/extensions.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.affine import is_proper_similarity, transformed_colours, transformed_shapes
from egs_warp.io.gltf_nodes import INSTANCING, placements
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes
from egs_warp.io.paths import stays_inside
from egs_warp.io.raw import BAND_4, SH_COUNTS, RawCapture, bands_note, logits_from_opacities
from egs_warp.io.spz import decode_spz
from egs_warp.io.text import parse_json

EXTENSION = "KHR_gaussian_splatting"
_SPZ = (f"{EXTENSION}_compression_spz_2", f"{EXTENSION}_compression_spz")
"""Extensions for splats compressed as .spz: the name in the draft, and the name in earlier files."""
_SPZ_ALONE = "KHR_spz_gaussian_splats_compression"
"""Extension of a draft of 2025, which files of that time contain instead of ``EXTENSION``."""
MESH_REMEDY = "cover its surface with Gaussians (docs/guide/capture.md, From a mesh), or give a capture"
"""Remedy if the user has a mesh but no capture."""
_QUANTIZED = "KHR_mesh_quantization"
_READ = (EXTENSION, *_SPZ, _SPZ_ALONE, INSTANCING, _QUANTIZED)
_SURFACES = ("KHR_materials_", "EXT_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_")
"""Prefixes of the names of extensions that only change the appearance of meshes."""
_MAX_COPIES = 1 << 21
"""Maximum number of Gaussians that instances may add to those stored in the file."""
MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
"""Magic number of a .glb, and types of its two chunks."""
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_HALF_TURN = np.diag([-1.0, 1.0, -1.0])
"""Rotation by half a turn about y, from the axes of .spz (right, up, back) to left, up, front."""
_Y_UP = np.array([0.0, 1.0, 0.0])


def is_glb(data: bytes) -> bool:
    """Return True if ``data`` begins like a binary glTF file (.glb)."""
    return data[:4] == b"glTF"


def decode_glb(data: bytes, source: Path) -> RawCapture:
    """Decode a .glb. Raises ``UserError`` for a damaged file, and for a file without splats of a supported kind."""
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
    text = chunks.get(JSON_CHUNK, b"")
    if not text or len(text) > MAX_TEXT_BYTES:
        raise UserError(f"{source}: the .glb has no JSON chunk of at most {MAX_TEXT_BYTES} bytes; export it again")

    def read(number: int, uri: str | None) -> bytes | None:
        if uri is None:
            return chunks.get(BINARY_CHUNK, b"") if number == 0 else None
        return _buffer(uri, source)

    return _decode(text, source, read)


def check_required(tree: Mapping[str, Any], source: Path, supported: Collection[str], advice: str) -> None:
    """Raise ``UserError`` if a file requires extensions that are not ``supported`` and affect more than the appearance
    of meshes; the message ends with ``advice``."""
    required = tree.get("extensionsRequired", [])
    unknown = [name for name in required if name not in supported and not str(name).startswith(_SURFACES)]
    if unknown:
        raise UserError(
            f"{source}: it requires {', '.join(map(str, dict.fromkeys(unknown)))}, which is not supported; export it"
            f" without this extension, {advice}"
        )


def decode_gltf(text: bytes, source: Path) -> RawCapture:
    """Decode a .gltf with separate or embedded buffers. Raises ``UserError`` like ``decode_glb``."""

    def read(_: int, uri: str | None) -> bytes | None:
        return None if uri is None else _buffer(uri, source)

    return _decode(text, source, read)


def _buffer(uri: str, source: Path) -> bytes:
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise UserError(f"{source}: a buffer is not valid base64 ({error}); export it again") from error
    name = unquote(uri)
    if not stays_inside(name) or ":" in uri:
        raise UserError(f"{source}: it names {uri!r}, which lies outside its folder; export it again")
    return read_bytes(source.parent / name)


def _decode(text: bytes, source: Path, read: Callable[[int, str | None], bytes | None]) -> RawCapture:
    try:
        tree = parse_json(text.decode("utf-8"), source)
        return _Asset(source, tree, read).capture()
    # In an untrusted file, the JSON tree may deviate from glTF anywhere; all resulting errors are handled here.
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{source}: malformed glTF ({type(error).__name__}: {error}); export it again") from error


@dataclass(frozen=True)
class _Splats:
    """Splats of one primitive, in the axes of its mesh."""

    means: np.ndarray
    """(n, 3) float32, or float64 after a transform."""
    rotations: np.ndarray
    """(n, 4) float32, quaternions w x y z."""
    log_scales: np.ndarray
    """(n, 3) float32, logarithms of the standard deviations."""
    opacity_logits: np.ndarray
    """(n,) float32, logits of the opacities."""
    sh: np.ndarray
    """(n, K, 3) float32, SH coefficients, band 0 first."""
    antialiased: bool = False
    notes: tuple[str, ...] = ()

    def transformed(self, transform: np.ndarray) -> _Splats:
        """Return the splats after the affine ``transform`` (4, 4)."""
        matrix = transform[:3, :3]
        means = self.means.astype(np.float64) @ matrix.T + transform[:3, 3]
        finite = np.isfinite(self.rotations).all(axis=1) & np.isfinite(self.log_scales).all(axis=1)
        rotations, log_scales = self.rotations.copy(), self.log_scales.copy()
        rotations[finite], log_scales[finite] = transformed_shapes(rotations[finite], log_scales[finite], matrix)
        sh = transformed_colours(self.sh, matrix)
        return replace(self, means=means, rotations=rotations, log_scales=log_scales, sh=sh)


@dataclass(frozen=True)
class _Asset:
    source: Path
    tree: dict[str, Any]
    read: Callable[[int, str | None], bytes | None]
    """Function that returns the bytes of a buffer by its index and URI; None if the file does not contain it."""

    def capture(self) -> RawCapture:
        """Return all splats of the file. They are in the axes of their meshes if all meshes have the same transform and
        it is a similarity; otherwise they are in the axes of the scene."""
        check_required(self.tree, self.source, _READ, "or as .ply or .spz")
        meshes = self.tree.get("meshes", [])
        splats = [[p for p in mesh["primitives"] if _is_splats(p)] for mesh in meshes]
        if not any(splats):
            kind = f", only {len(meshes)} mesh{'es' * (len(meshes) > 1)}" if meshes else ""
            cure = MESH_REMEDY if meshes else "export it as splats, or as .ply"
            raise UserError(f"{self.source}: the glTF has no splats ({EXTENSION}){kind}; {cure}")
        placed = placements(self.tree, self.source, self._accessor, lambda mesh: bool(splats[mesh]))
        parts = {mesh: [self._primitive(p) for p in splats[mesh]] for mesh in {one.mesh for one in placed}}
        left_out = sum(1 for mesh, found in enumerate(splats) if found and mesh not in parts)
        notes = dict.fromkeys(note for found in parts.values() for part in found for note in part.notes)
        if left_out:
            unseen = f"{left_out} mesh{'es' * (left_out > 1)} of splats"
            notes[f"left out, without a node in the scene: {unseen}"] = None
        transforms = np.concatenate([one.transforms for one in placed])
        up, origin = _Y_UP, None
        is_shared = np.allclose(transforms, transforms[0], rtol=1e-14, atol=1e-14)
        if is_shared and is_proper_similarity(transforms[0, :3, :3]):
            if np.array_equal(transforms[0, :3, :3], np.eye(3)):
                origin = transforms[0, :3, 3] if transforms[0, :3, 3].any() else None
                if origin is not None:
                    text = ",".join(f"{x:.15g}" for x in origin)
                    notes[f"positions are relative to {text}, the translation of glTF's nodes"] = None
            elif not np.allclose(transforms[0], np.eye(4), atol=1e-6):
                notes["the transforms of glTF's nodes were ignored: the capture is in the axes of its mesh"] = None
                up = np.linalg.inv(transforms[0, :3, :3]) @ _Y_UP
            shown = [part for one in placed for _ in one.transforms for part in parts[one.mesh]]
            self._check_copies(shown, parts)
        else:
            self._check_copies([p for one in placed for _ in one.transforms for p in parts[one.mesh]], parts)
            notes["the transforms of glTF's nodes were applied: the capture is in the axes of the scene"] = None
            shown = [p.transformed(turn) for one in placed for turn in one.transforms for p in parts[one.mesh]]
        coefficients = min(part.sh.shape[1] for part in shown)
        if any(part.sh.shape[1] != coefficients for part in shown):
            notes["bands of colour that only some meshes have were left out"] = None
        return RawCapture(
            format="glTF (KHR_gaussian_splatting)",
            means=np.concatenate([part.means for part in shown]),
            rotations=np.concatenate([part.rotations for part in shown]),
            log_scales=np.concatenate([part.log_scales for part in shown]),
            opacity_logits=np.concatenate([part.opacity_logits for part in shown]),
            sh=np.concatenate([part.sh[:, :coefficients] for part in shown]),
            up=up / np.linalg.norm(up),
            antialiased=all(part.antialiased for part in shown),
            origin=origin,
            notes=tuple(notes),
        )

    def _check_copies(self, shown: list[_Splats], parts: dict[int, list[_Splats]]) -> None:
        count = sum(len(part.means) for part in shown)
        own = sum(len(part.means) for found in parts.values() for part in found)
        if count > own + _MAX_COPIES:
            raise UserError(
                f"{self.source}: its instances turn {own} Gaussians into {count}; at most {_MAX_COPIES} more are read;"
                " export fewer instances"
            )

    def _primitive(self, primitive: dict[str, Any]) -> _Splats:
        extensions = primitive["extensions"]
        extension = extensions.get(EXTENSION, {})
        nested = extension.get("extensions", {})
        if extension.get("kernel", "ellipse") != "ellipse":
            raise UserError(
                f"{self.source}: splats with the kernel {extension['kernel']!r} are not supported; export them with"
                " the kernel 'ellipse'"
            )
        if not str(extension.get("colorSpace", "srgb_rec709_display")).startswith("srgb"):
            raise UserError(
                f"{self.source}: splats in the colour space {extension['colorSpace']!r}; export"
                " them in srgb_rec709_display"
            )
        packed = next((nested[name] for name in _SPZ if name in nested), extensions.get(_SPZ_ALONE))
        extras = extension.get("extras")
        antialiased = isinstance(extras, dict) and extras.get("antialiased") is True
        if packed is not None:
            splats = self._packed(primitive, packed)
        else:
            others = [name for name in nested if "compression" in name]
            position = self.tree["accessors"][primitive["attributes"]["POSITION"]]
            if others and "bufferView" not in position:
                raise UserError(
                    f"{self.source}: splats packed by {others[0]} are not supported; export them unpacked, or as .spz"
                )
            splats = self._unpacked(primitive["attributes"])
        return replace(splats, antialiased=True) if antialiased else splats

    def _packed(self, primitive: dict[str, Any], packed: dict[str, Any]) -> _Splats:
        """Decode a .spz.

        Its axes are the axes of the mesh or, as the draft requires but few tools implement, the axes of the mesh
        rotated about y. The bounds of ``POSITION`` decide between the two.
        """
        view = self.tree["bufferViews"][packed["bufferView"]]
        start, size = view.get("byteOffset", 0), view["byteLength"]
        data = self._buffer_of(view)
        if min(start, size) < 0 or start + size > len(data):
            raise UserError(f"{self.source}: a packed buffer view extends beyond its buffer; copy or export it again")
        raw = decode_spz(data[start : start + size], self.source)
        splats = _Splats(
            *(raw.means, raw.rotations, raw.log_scales, raw.opacity_logits, raw.sh, raw.antialiased, raw.notes)
        )
        position: dict[str, Any] = {}
        if "attributes" in primitive:
            position = self.tree["accessors"][primitive["attributes"]["POSITION"]]
        if not len(raw.means) or "min" not in position or "max" not in position:
            return splats
        bounds = np.array([position["min"], position["max"]], float)
        if bounds.shape != (2, 3) or not np.isfinite(bounds).all():
            return splats
        stored = np.stack([raw.means.min(axis=0), raw.means.max(axis=0)])
        turned = np.sort(stored @ _HALF_TURN, axis=0)
        tolerance = 0.01 * np.ptp(stored, axis=0).max()
        if np.abs(turned - bounds).max() < tolerance < np.abs(stored - bounds).max():
            turn = np.eye(4)
            turn[:3, :3] = _HALF_TURN
            return splats.transformed(turn)
        return splats

    def _unpacked(self, attributes: dict[str, int]) -> _Splats:
        count = len(self._accessor(attributes["POSITION"]))

        def of(name: str, width: int = 3) -> np.ndarray:
            values = self._accessor(attributes[name])
            if values.shape != (count, width):
                rows, columns = values.shape
                raise UserError(
                    f"{self.source}: {name} is {rows} x {columns} numbers, not {count} x {width}; export it again"
                )
            return values

        opacity = of(f"{EXTENSION}:OPACITY", 1)[:, 0]
        scales = of(f"{EXTENSION}:SCALE").astype(np.float64)
        notes = []
        sh = [of(f"{EXTENSION}:SH_DEGREE_0_COEF_0")]
        for degree in (1, 2, 3, 4):
            names = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}" for k in range(2 * degree + 1)]
            present = sum(name in attributes for name in names)
            if degree == 4 and present:
                notes += bands_note(BAND_4)
            elif present < len(names):
                if present:
                    notes.append(f"SH bands from {degree} up left out: band {degree} is not complete")
                break
            elif degree < len(SH_COUNTS):
                sh += [of(name) for name in names]
        if (scales < 0.0).any():
            # In a review draft of the extension, scales were stored as logarithms.
            notes.append("scales are negative: read as logarithms")
            log_scales = scales
        else:
            with np.errstate(invalid="ignore"):
                log_scales = np.log(np.maximum(scales, np.finfo(np.float32).tiny))
        return _Splats(
            of("POSITION"),
            of(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]],
            log_scales.astype(np.float32),
            logits_from_opacities(opacity),
            np.stack(sh, axis=1),
            notes=tuple(notes),
        )

    def _accessor(self, number: int) -> np.ndarray:
        """Return the values (n, width) float32 of an accessor, unpacked according to the standard."""
        accessor = self.tree["accessors"][number]
        if "sparse" in accessor or "bufferView" not in accessor:
            kind = "sparse" if "sparse" in accessor else "without data"
            raise UserError(
                f"{self.source}: accessor {number} is {kind}, which is not supported; export all of its values"
            )
        view = self.tree["bufferViews"][accessor["bufferView"]]
        kind, width, count = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
        stride = view.get("byteStride", kind.itemsize * width)
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        data = self._buffer_of(view)
        end = start + (count - 1) * stride + kind.itemsize * width
        if min(start, count - 1) < 0 or stride < kind.itemsize * width or end > len(data):
            raise UserError(f"{self.source}: accessor {number} extends beyond its buffer; copy or export it again")
        values = np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))
        if kind.kind == "f":
            return values.astype(np.float32)
        if not accessor.get("normalized", False):
            if _QUANTIZED in self.tree.get("extensionsUsed", []):
                return values.astype(np.float32)
            raise UserError(f"{self.source}: accessor {number} has integers that are not normalized; export it again")
        return np.maximum(values / np.float32(np.iinfo(kind).max), -1.0).astype(np.float32)

    def _buffer_of(self, view: dict[str, Any]) -> bytes:
        number = view["buffer"]
        buffer = self.tree["buffers"][number]
        data = self.read(number, buffer.get("uri"))
        if data is None:
            packing = next((name for name in view.get("extensions", {}) if "compression" in name), None)
            reason = f"they are packed by {packing}, which is not supported" if packing else "it has no uri"
            raise UserError(f"{self.source}: the data of buffer {number} are missing: {reason}; export it unpacked")
        return data


def _is_splats(primitive: dict[str, Any]) -> bool:
    extensions = primitive.get("extensions", {})
    return EXTENSION in extensions or _SPZ_ALONE in extensions
