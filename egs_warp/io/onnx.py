"""Checks of ONNX files before they are loaded.

Public description: https://onnx.ai/onnx/repo-docs/IR.html and ``onnx.proto``. An ONNX file contains numbers and a graph
of known operations, but no code. Files whose tensors are stored in other files are rejected.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from egs_warp.errors import UserError
from egs_warp.io.limits import read_bytes

MAX_NETWORK_BYTES = 2 << 30
"""Maximum size of a file in bytes, which is the limit of protocol buffers."""
_MAX_DEPTH = 32
"""Maximum nesting depth of graphs in attributes of graphs."""
# For each kind of message, the numbers and kinds of the fields that may contain tensors, directly or nested.
_MESSAGES = {
    "Model": {7: "Graph", 20: "Training", 25: "Function"},
    "Graph": {1: "Node", 5: "Tensor", 11: "Input", 15: "SparseTensor"},
    "Training": {1: "Graph", 2: "Graph"},
    "Function": {7: "Node", 11: "Attribute"},
    "Node": {5: "Attribute"},
    "Attribute": {5: "Tensor", 6: "Graph", 10: "Tensor", 11: "Graph", 22: "SparseTensor", 23: "SparseTensor"},
    "SparseTensor": {1: "Tensor", 2: "Tensor"},
}
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14
"""Numbers of the fields of a tensor that state the location of its data outside the file."""


@dataclass(frozen=True)
class OnnxFile:
    """Inputs and bytes of a network that contains no code and refers to no other file."""

    data: bytes
    inputs: tuple[str, ...]
    """Names of the inputs, without constants."""


def read_onnx(path: Path) -> OnnxFile:
    """Read an ONNX file. Raises ``UserError`` if it is not ONNX or if its tensors are in other files."""
    data = read_bytes(path, at_most=MAX_NETWORK_BYTES)
    walk = _Walk(path)
    try:
        walk.message(memoryview(data), "Model", 0)
    except (IndexError, UnicodeDecodeError):
        raise UserError(f"{path}: not an ONNX file; export the network as ONNX") from None
    inputs = tuple(name for name in walk.inputs if name not in walk.constants)
    if not inputs:
        raise UserError(f"{path}: not an ONNX file of a network with inputs; export the network as ONNX")
    return OnnxFile(data, inputs)


class _Walk:
    """Traversal of all tensors of a file. Malformed data raise ``IndexError``."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.inputs: list[str] = []
        self.constants: set[str] = set()

    def message(self, data: memoryview, kind: str, depth: int) -> None:
        if depth > _MAX_DEPTH:
            raise UserError(f"{self._path}: its graphs are nested too deeply; export the network again")
        for number, value in _fields(data):
            if kind == "Tensor":
                if number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value != 0):
                    raise UserError(
                        f"{self._path}: some of its numbers are in other files, which are not read; "
                        "export the network into one file"
                    )
                if number == 8 and depth == 2:
                    self.constants.add(_text(value))
            elif kind == "Input":
                if number == 1 and depth == 2:
                    self.inputs.append(_text(value))
            elif number in _MESSAGES[kind]:
                if isinstance(value, int):
                    raise IndexError
                self.message(value, _MESSAGES[kind][number], depth + 1)


def _text(value: memoryview | int) -> str:
    if isinstance(value, int):
        raise IndexError
    return bytes(value).decode()


def _fields(data: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """Yield number and value of each field of a protocol buffer; values of fixed width are bytes."""
    place = 0
    while place < len(data):
        key, place = _varint(data, place)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, place = _varint(data, place)
            yield number, value
            continue
        if wire == 2:
            size, place = _varint(data, place)
        elif wire in (1, 5):
            size = 8 if wire == 1 else 4
        else:
            raise IndexError
        if place + size > len(data):
            raise IndexError
        yield number, data[place : place + size]
        place += size


def _varint(data: memoryview, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[place]
        place += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, place
    raise IndexError
