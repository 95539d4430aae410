"""Container of bundles: its JSON text, its arrays, and the validation of files (docs/concepts/bundle.md)."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.bundle_arrays import PackedArray
from egs_warp.io.bundle_track import PARENTS, WEIGHT_STEP
from egs_warp.io.limits import MAX_COORDINATE, MAX_TEXT_BYTES, read_bytes
from egs_warp.io.planes import light_from_json
from egs_warp.io.text import load_json

ENDING = ".egs"
"""Ending of the names of bundles."""
MAGIC = b"EGSB"
"""First bytes of a bundle."""
VERSION = 2
"""Version of the format."""
HEAD = struct.Struct("<4sII")
"""Magic bytes, version, and length of the JSON text in bytes."""
BYTE_ZERO = 128
"""Byte that represents zero in arrays that a player does not decode: SH coefficients above band 0, and normals."""
_ROUNDING = 1.0 + 1e-3
"""Maximum ratio of a stated error to half a step; it is above 1, because steps are rounded to double precision."""
_INDICES = ("cage_tets", "surface", "tets", "carriers", "arm_tets", "order", "parents", "residuals")
"""Names of the arrays that contain integers."""


class Carrier(IntEnum):
    """Part of the cage that moves a Gaussian."""

    TET = 0
    """The affine map of one tetrahedron."""
    ARMS = 1
    """The deformed arms of the Gaussian's axes, whose ends are in several tetrahedra (Eq. 14)."""
    RIGID = 2
    """The rotation of one tetrahedron, for Gaussians far outside the cage."""


@dataclass(frozen=True)
class BundleFile:
    """JSON text and arrays of a bundle."""

    text: dict[str, Any]
    """The JSON text."""
    arrays: tuple[Mapping[str, PackedArray], ...]
    """Constant arrays of each body."""
    blocks: tuple[tuple[Mapping[str, PackedArray], ...], ...]
    """Arrays of the blocks of each body, in order; empty for a static body."""


def read_valid_file(path: Path) -> BundleFile:
    """Read a bundle. Raises ``UserError`` for the first of its ``findings``."""
    file, problems = _read(read_bytes(path))
    if problems or file is None:
        raise UserError(f"{path}: is not a valid bundle: {problems[0]}; export the run again")
    return file


def findings(path: Path) -> list[str]:
    """Return one line for each defect of a bundle; an empty list for a valid one.

    Raises ``UserError`` if the file cannot be read or is something else.
    """
    data = read_bytes(path)
    if path.suffix.lower() != ENDING and data[:4] != MAGIC:
        kind = f"a {path.suffix} file" if path.suffix else "a file of another kind"
        raise UserError(
            f"{path}: it is {kind}, not a bundle; give the {ENDING} file that egs-warp export made from a run"
        )
    return _read(data)[1]


def _read(data: bytes) -> tuple[BundleFile | None, list[str]]:
    """Return the content of a bundle, None if it cannot be read, and its defects."""
    if len(data) < HEAD.size or data[:4] != MAGIC:
        return None, [f"the file does not begin with {MAGIC.decode()}"]
    _, version, length = HEAD.unpack_from(data)
    if version != VERSION:
        return None, [f"version {version} of the format is not supported; this program reads version {VERSION}"]
    if length > min(len(data) - HEAD.size, MAX_TEXT_BYTES):
        return None, [f"the JSON text of {length} bytes is longer than the file or than {MAX_TEXT_BYTES} bytes"]
    try:
        text = load_json(data[HEAD.size : HEAD.size + length], parse_constant=_refuse_constant)
    except ValueError as error:
        return None, [f"the JSON text cannot be read ({error})"]
    problems = list(_schema_problems(text))
    if problems:
        return None, problems
    payload = memoryview(data)[HEAD.size + length :]
    if len(payload) != text["bytes"]:
        problems.append(f"the data have {len(payload)} bytes, but the JSON text states {text['bytes']}")
    problems += _order_problems(text)
    if "light" in text:
        try:
            light_from_json(text["light"])
        except ValueError as error:
            problems.append(str(error))
    end = 0
    stored: dict[str, PackedArray] = {}
    # Read the arrays in the order of the file, which is the order in which a player receives them.
    for place, entry in sorted(_entries(text), key=lambda item: item[1]["offset"]):
        if entry["offset"] < end:
            problems.append(f"{place}: its bytes overlap another array")
        end = entry["offset"] + entry["bytes"]
        try:
            stored[place] = PackedArray.from_file(entry, payload[entry["offset"] : end].tobytes())
        except ValueError as error:
            problems.append(f"{place}: {error}")
        else:
            problems += [f"{place}: {problem}" for problem in _number_problems(place, entry, stored[place])]
    if problems:
        return None, problems
    arrays, blocks = [], []
    for number, body in enumerate(text["bodies"]):
        place = f"bodies/{number}"
        arrays.append({name: stored[f"{place}/{name}"] for name in body["arrays"]})
        count = len(body.get("blocks", ()))
        names = [body["blocks"][k]["arrays"] for k in range(count)]
        blocks.append(tuple({n: stored[f"{place}/blocks/{k}/{n}"] for n in names[k]} for k in range(count)))
        problems += [f"{place}: {problem}" for problem in _body_problems(body, text["frames"], arrays[-1], blocks[-1])]
    return BundleFile(text, tuple(arrays), tuple(blocks)), problems


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number in JSON")


def _schema_problems(text: Any) -> Iterator[str]:
    for error in _validator().iter_errors(text):
        yield f"{'/'.join(map(str, error.absolute_path)) or 'the JSON text'}: {error.message[:200]}"


@cache
def _validator() -> Any:
    # Imported here because the import is slow and only bundles need it.
    from jsonschema import Draft202012Validator, validators

    # In JSON Schema, 2.0 is also an integer.
    whole = Draft202012Validator.TYPE_CHECKER.redefine("integer", lambda _, value: type(value) is int)
    schema = json.loads(resources.files("egs_warp.io").joinpath("bundle.schema.json").read_text("utf-8"))
    return validators.extend(Draft202012Validator, type_checker=whole)(schema)


def _entries(text: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the location in the JSON text (for messages) and the JSON object of every array."""
    for number, body in enumerate(text["bodies"]):
        yield from ((f"bodies/{number}/{name}", entry) for name, entry in body["arrays"].items())
        for k, block in enumerate(body.get("blocks", ())):
            yield from ((f"bodies/{number}/blocks/{k}/{name}", entry) for name, entry in block["arrays"].items())


def _order_problems(text: dict[str, Any]) -> Iterator[str]:
    """Yield a line if a player would not receive the arrays in the order in which it needs them."""
    bodies = text["bodies"]
    groups = [body["arrays"] for body in bodies]
    for k in range(max(len(body.get("blocks", ())) for body in bodies)):
        groups += [body["blocks"][k]["arrays"] for body in bodies if len(body.get("blocks", ())) > k]
    offsets = [[entry["offset"] for entry in group.values()] for group in groups]
    if any(max(before) >= min(after) for before, after in zip(offsets, offsets[1:], strict=False)):
        yield "the arrays are not in order: those of all bodies, then the first blocks of all bodies, and so on"


def _number_problems(place: str, entry: dict[str, Any], array: PackedArray) -> Iterator[str]:
    """Yield the defects in the values of one array."""
    if array.lower is None or array.step is None or array.error is None:
        if array.stored.dtype.kind == "f" and not np.isfinite(array.stored).all():
            yield "it has a value that is not finite"
        return
    if place.rpartition("/")[2] in _INDICES:
        yield "it holds whole numbers, but has a step"
    if array.stored.dtype.kind == "f":
        yield "it has a step, but its type is float32"
    widths = {1, entry["shape"][-1]} if len(entry["shape"]) > 1 else {1}
    if len(array.lower) not in widths or len(array.step) not in widths:
        yield f"lower and step have {len(array.lower)} and {len(array.step)} values for a last axis of {max(widths)}"
    elif max(np.abs(array.lower).max(), np.abs(array.step).max() * np.iinfo(np.uint32).max) > MAX_COORDINATE:
        yield f"its values exceed {MAX_COORDINATE:g}"
    if array.error > 0.5 * _ROUNDING * array.step.max():
        yield f"the error {array.error:.3g} is larger than half a step, {0.5 * array.step.max():.3g}"


def _body_problems(
    body: dict[str, Any],
    frames: int,
    arrays: Mapping[str, PackedArray],
    blocks: tuple[Mapping[str, PackedArray], ...],
) -> Iterator[str]:
    """Yield the inconsistencies between the arrays of one body."""
    count = body["count"]
    expected: dict[str, tuple[int, ...]] = {"means": (count, 3), "rotations": (count, 3), "log_scales": (count, 3)}
    expected |= {"opacities": (count,), "colours": (count, 3)}
    if body["degree"] > 0:
        expected["bands"] = (count, 3, (body["degree"] + 1) ** 2 - 1)
    if "normals" in arrays:
        expected["normals"] = (count, 3)
    if "blocks" in body:
        nodes, tets = (len(arrays[name].stored) for name in ("rest_nodes", "cage_tets"))
        arms = int(np.count_nonzero(arrays["carriers"].stored == Carrier.ARMS))
        expected |= {"rest_nodes": (nodes, 3), "cage_tets": (tets, 4), "surface": (len(arrays["surface"].stored), 3)}
        expected |= {"tets": (count,), "carriers": (count,), "arm_bulges": (arms, 3)}
        expected |= {name: (arms, 6) for name in ("arm_tets", "arm_shares", "arm_lengths")}
        if "level_set" in body:
            expected["level_set"] = (math.prod(body["level_set"]["counts"]),)
        expected |= {"order": (nodes,), "parents": (nodes, PARENTS), "weights": (nodes, PARENTS)}
    wrong = [name for name, shape in expected.items() if arrays[name].stored.shape != shape]
    yield from (f"{name} has shape {list(arrays[name].stored.shape)}, not {list(expected[name])}" for name in wrong)
    for name in {"bands", "normals", "weights"} & expected.keys() if not wrong else ():
        array = arrays[name]
        if array.stored.dtype != np.uint8 or array.step is None or array.lower is None:
            yield f"{name} are not uint8 with a step"
        elif not np.allclose(array.lower, -BYTE_ZERO * array.step, rtol=1e-6):
            yield f"lower of {name} is not {-BYTE_ZERO} steps"
    if wrong or "blocks" not in body:
        return
    limits = {"cage_tets": nodes, "surface": nodes, "tets": tets, "carriers": len(Carrier)}
    for name, limit in limits.items():
        if arrays[name].stored.max(initial=0) >= limit:
            yield f"{name} has the index {arrays[name].stored.max()}, but there are {limit}"
    ends = arrays["arm_tets"].stored
    own = arrays["tets"].stored[arrays["carriers"].stored == Carrier.ARMS, None].astype(ends.dtype)
    if (ends + own).max(initial=0) >= tets:
        yield f"arm_tets has the index {(ends + own).max()}, but there are {tets} tetrahedra"
    if not np.array_equal(np.sort(arrays["order"].stored), np.arange(nodes)):
        yield "order does not contain each node exactly once"
    if (arrays["parents"].stored >= np.maximum(np.arange(nodes), 1)[:, None]).any():
        yield "parents has a position that is not before its own"
    if not np.all(arrays["weights"].step == WEIGHT_STEP):
        yield f"the step of weights is not {WEIGHT_STEP:g}"
    if arrays["weights"].numbers[:1].any():
        yield "the weights of the first position are not 0"
    yield from _track_problems(body, frames, nodes, blocks)


def _track_problems(
    body: dict[str, Any], frames: int, nodes: int, blocks: tuple[Mapping[str, PackedArray], ...]
) -> Iterator[str]:
    """Yield the defects in the blocks of a body of ``nodes`` nodes."""
    first = 0
    for number, (facts, block) in enumerate(zip(body["blocks"], blocks, strict=True)):
        place = f"blocks/{number}"
        if facts["first"] != first:
            yield f"{place}: begins at frame {facts['first']}, not {first}"
        first += facts["frames"]
        shape = (facts["frames"] * nodes * 3,)
        if block["residuals"].stored.shape != shape:
            yield f"{place}: residuals has shape {list(block['residuals'].stored.shape)}, not {list(shape)}"
    if first != frames:
        yield f"its blocks have {first} frames, but the bundle has {frames}"
    # The error is at most half a step along each of the three axes.
    bound = 0.5 * math.sqrt(3.0) * body["node_step"]
    if body["node_error"] > _ROUNDING * bound:
        yield f"node_error {body['node_error']:.3g} is larger than the step of the nodes allows, {bound:.3g}"
