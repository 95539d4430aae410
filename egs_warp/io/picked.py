"""Picked objects on disk: ``picked.json``, which the page of ``egs-warp pick`` writes and other commands read."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError, did_you_mean
from egs_warp.geometry.frames import direction_of
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.atomic import atomic_write
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes
from egs_warp.io.planes import PlaneRecord
from egs_warp.io.text import decode_text, parse_json

VERSION = 1
"""Version of the file format."""
MAX_NAME_LENGTH = 60
"""Maximum number of characters in an object's name."""
_REMEDY = "pick the object again with egs-warp pick"


@dataclass(frozen=True)
class PickedObject:
    """An object of a capture that a user has picked, in the frame and units of the capture."""

    name: str
    gaussians: np.ndarray
    """(n,) bool, True for the object's Gaussians."""
    plane: PlaneRecord
    """Ground plane on which the object stands."""
    front: np.ndarray | None = None
    """(3,) direction in which the object faces; None to estimate it."""


@dataclass(frozen=True)
class PickedFile:
    """The objects of a ``picked.json``."""

    capture: str
    """Name of the capture, for messages."""
    objects: tuple[PickedObject, ...]
    """At least one object."""
    selected: int = 0
    """Index of the object that commands use unless a name is given."""

    def named(self, name: str | None, path: Path | str) -> PickedObject:
        """Return the object ``name``, or the selected one. Raises ``UserError``, which names ``path``, for an unknown
        name."""
        if name is None:
            return self.objects[self.selected]
        for one in self.objects:
            if one.name == name:
                return one
        names = [one.name for one in self.objects]
        raise UserError(f"{path}: it has no object {name!r}{did_you_mean(name, names)}; it has {', '.join(names)}")


def write_picked(path: Path | str, picked: PickedFile, cloud: GaussianCloud) -> None:
    """Write the picked objects of ``cloud``."""
    tree = {
        "version": VERSION,
        "capture": {"name": picked.capture, "gaussians": cloud.count, "sha256": _digest(cloud)},
        "selected": picked.selected,
        "objects": [_to_json(one) for one in picked.objects],
    }
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(tree, indent=1), encoding="utf-8")


def read_picked(path: Path | str, cloud: GaussianCloud) -> PickedFile:
    """Read the picked objects of ``cloud``.

    Raises ``UserError`` if the file is missing or damaged, and if it belongs to another capture.
    """
    path = Path(path)
    data = read_bytes(path, at_most=MAX_TEXT_BYTES, missing="make it with egs-warp pick")
    tree = parse_json(decode_text(data, path), path)
    if not isinstance(tree, dict) or not isinstance(tree.get("objects"), list) or "capture" not in tree:
        raise UserError(f"{path}: not a file of egs-warp pick: it has no capture and objects; {_REMEDY}")
    if tree.get("version") != VERSION:
        raise UserError(f"{path}: version {str(tree.get('version'))[:20]} is unknown; {_REMEDY}")
    capture, entries = tree["capture"], tree["objects"]
    if not isinstance(capture, dict) or not {"name", "gaussians", "sha256"} <= set(capture):
        raise UserError(f"{path}: its capture needs name, gaussians and sha256; {_REMEDY}")
    name = str(capture["name"])[:200]
    if capture["gaussians"] != cloud.count or capture["sha256"] != _digest(cloud):
        raise UserError(
            f"{path}: it belongs to another capture, {name} of {str(capture['gaussians'])[:20]} Gaussians, and this one"
            f" has {cloud.count}; give that capture, or {_REMEDY}"
        )
    if not entries:
        raise UserError(f"{path}: it has no objects; {_REMEDY}")
    objects = tuple(_from_json(entry, path, number, cloud.count) for number, entry in enumerate(entries, start=1))
    selected = tree.get("selected", 0)
    if isinstance(selected, bool) or not isinstance(selected, int) or not 0 <= selected < len(objects):
        raise UserError(f"{path}: selected must be a number from 0 to {len(objects) - 1}; correct it")
    return PickedFile(name, objects, selected)


def _to_json(one: PickedObject) -> dict[str, Any]:
    packed = base64.b64encode(zlib.compress(np.packbits(one.gaussians).tobytes())).decode()
    front = {} if one.front is None else {"front": one.front.tolist()}
    return {
        "name": one.name,
        "count": int(one.gaussians.sum()),
        "plane": one.plane.to_json(),
        **front,
        "gaussians": packed,
    }


def _from_json(entry: Any, path: Path, number: int, count: int) -> PickedObject:
    """Convert from JSON; inverse of ``_to_json``. Raises ``UserError`` for invalid data."""
    if not isinstance(entry, Mapping) or not {"name", "plane", "gaussians"} <= set(entry):
        raise UserError(f"{path}: object {number} needs name, plane and gaussians; {_REMEDY}")
    name = entry["name"]
    if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME_LENGTH:
        raise UserError(f"{path}: object {number} needs a name of 1 to {MAX_NAME_LENGTH} characters; correct it")
    size = -(-count // 8)
    try:
        # Limit the size of the result, because a few bytes can expand beyond the available memory.
        unpacker = zlib.decompressobj()
        packed = unpacker.decompress(base64.b64decode(entry["gaussians"], validate=True), size + 1)
    except (TypeError, ValueError, binascii.Error, zlib.error) as error:
        raise UserError(f"{path}: the Gaussians of {name!r} are damaged; {_REMEDY}") from error
    if len(packed) != size:
        raise UserError(f"{path}: the Gaussians of {name!r} are damaged: they are not {count} bits; {_REMEDY}")
    gaussians = np.unpackbits(np.frombuffer(packed, np.uint8), count=count).astype(bool)
    if not gaussians.any():
        raise UserError(f"{path}: {name!r} has no Gaussians; {_REMEDY}")
    front = None
    if entry.get("front") is not None:
        try:
            front = direction_of(np.array(entry["front"], dtype=float), "front")
            front = front / np.linalg.norm(front)
        except (TypeError, ValueError, OverflowError):
            raise UserError(f"{path}: the front of {name!r} must be three numbers, not all zero; correct it") from None
    return PickedObject(name, gaussians, PlaneRecord.from_json(entry["plane"], path, number), front)


def _digest(cloud: GaussianCloud) -> str:
    """Return the SHA-256 of the positions of the Gaussians."""
    return hashlib.sha256(np.ascontiguousarray(cloud.means.numpy()).tobytes()).hexdigest()
