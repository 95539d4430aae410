"""Minimal writer of ONNX files, whose format is described in https://onnx.ai/onnx/repo-docs/IR.html."""

from __future__ import annotations

import struct
from collections.abc import Sequence


def model(nodes: Sequence[bytes], tensors: Sequence[bytes], inputs: Sequence[bytes], outputs: Sequence[bytes]) -> bytes:
    """Return a file with one graph and operator set 13."""
    graph = _all(1, nodes) + _field(2, "graph") + _all(5, tensors) + _all(11, inputs) + _all(12, outputs)
    return _field(1, 8) + _field(7, graph) + _field(8, _field(1, "") + _field(2, 13))


def node(operation: str, inputs: Sequence[str], outputs: Sequence[str]) -> bytes:
    """Return the graph node of one operation."""
    return _all(1, inputs) + _all(2, outputs) + _field(4, operation)


def tensor(name: str, shape: Sequence[int], values: Sequence[float], *, external: str | None = None) -> bytes:
    """Return a constant that is stored in the message itself or in the file ``external``."""
    numbers = _field(9, struct.pack(f"<{len(values)}f", *values))
    if external is not None:
        numbers = _field(13, _field(1, "location") + _field(2, external)) + _field(14, 1)
    return _all(1, shape) + _field(2, 1) + _field(8, name) + numbers


def integers(name: str, values: Sequence[int]) -> bytes:
    """Return an integer constant such as a shape or axes."""
    return _all(1, [len(values)]) + _field(2, 7) + _field(8, name) + _field(9, struct.pack(f"<{len(values)}q", *values))


def value(name: str, shape: Sequence[int | str]) -> bytes:
    """Return an input or an output. Dimensions that are given as names are dynamic."""
    sides = b"".join(_field(1, _field(2 if isinstance(side, str) else 1, side)) for side in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, 1) + _field(2, sides)))


def _all(number: int, values: Sequence[bytes] | Sequence[str] | Sequence[int]) -> bytes:
    return b"".join(_field(number, value) for value in values)


def _field(number: int, value: bytes | str | int) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])
