"""Arrays of a bundle: quantised or plain numbers, stored as deflated byte planes (docs/concepts/bundle.md)."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

TYPES = {name: np.dtype(name).newbyteorder("<") for name in ("uint8", "uint16", "uint32", "float32")}
"""Stored types by their names in the file; little-endian."""
_METHODS = (
    (zlib.Z_DEFAULT_STRATEGY, 8),
    (zlib.Z_DEFAULT_STRATEGY, 5),
    (zlib.Z_FILTERED, 6),
    (zlib.Z_RLE, 3),
    (zlib.Z_HUFFMAN_ONLY, 5),
)
"""Pairs of zlib strategy and memory level; each array is deflated with the pair that gives the fewest bytes. For byte
planes that resemble noise, the best pair has no string matches and a low memory level, at which the Huffman codes are
renewed often."""
_MAX_RATIO = 1032
"""Maximum ratio of inflated to deflated bytes that RFC 1951 allows."""


@dataclass(frozen=True)
class PackedArray:
    """Numbers as a bundle stores them: ``lower + step * stored``, or ``stored`` without a step."""

    stored: np.ndarray
    """(n, ...) stored numbers, of one of ``TYPES``."""
    lower: np.ndarray | None = None
    """(m,) float64, values of the stored number 0 along the last axis, or (1,) for all; None without quantisation."""
    step: np.ndarray | None = None
    """(m,) float64, quantisation steps along the last axis, or (1,) for all; None without quantisation."""
    error: float | None = None
    """Maximum absolute rounding error; None without quantisation."""

    @property
    def numbers(self) -> np.ndarray:
        """Return the values (n, ...), float64 if they are quantised."""
        if self.lower is None or self.step is None:
            return self.stored
        return self.lower + self.step * self.stored

    def data(self) -> bytes:
        """Return the deflated byte planes: byte b of component c of all items, for c and then b."""
        stored = self.stored
        width = stored.dtype.itemsize * math.prod(stored.shape[1:])
        planes = np.ascontiguousarray(stored).view(np.uint8).reshape(len(stored), width).T
        return _deflated(np.ascontiguousarray(planes).tobytes())

    def entry(self, offset: int, size: int) -> dict[str, Any]:
        """Return the JSON object that describes this array, whose ``size`` bytes begin at ``offset`` of the data."""
        entry: dict[str, Any] = {
            "type": self.stored.dtype.name,
            "shape": list(self.stored.shape),
            "offset": offset,
            "bytes": size,
        }
        if self.lower is not None and self.step is not None:
            entry |= {"lower": self.lower.tolist(), "step": self.step.tolist(), "error": self.error}
        return entry

    @classmethod
    def from_file(cls, entry: dict[str, Any], data: bytes) -> PackedArray:
        """Read the array that a JSON ``entry`` describes from the bytes of ``data``.

        Raises ``ValueError`` if ``data`` does not contain such an array.
        """
        dtype, shape = TYPES[entry["type"]], entry["shape"]
        width = dtype.itemsize * math.prod(shape[1:])
        size = width * shape[0]
        # Check the size before allocating memory.
        if size > _MAX_RATIO * len(data):
            raise ValueError(f"{len(data)} bytes cannot hold an array of shape {shape}")
        try:
            inflater = zlib.decompressobj()
            planes = inflater.decompress(data, size + 1)
        except zlib.error as error:
            raise ValueError(f"its bytes cannot be inflated ({error})") from error
        if len(planes) != size or not inflater.eof:
            raise ValueError(f"its bytes do not inflate to the {size} bytes of an array of shape {shape}")
        rows = np.frombuffer(planes, np.uint8).reshape(width, shape[0]).T
        stored = np.ascontiguousarray(rows).view(dtype).reshape(shape)
        if "step" not in entry:
            return cls(stored)
        lower, step = (np.array(entry[name], np.float64) for name in ("lower", "step"))
        return cls(stored, lower, step, entry["error"])


def _deflated(data: bytes) -> bytes:
    """Return ``data`` in the shortest zlib stream of ``_METHODS``."""

    def stream(strategy: int, memory: int) -> bytes:
        deflater = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS, memory, strategy)
        return deflater.compress(data) + deflater.flush()

    return min((stream(*method) for method in _METHODS), key=len)


def quantised(
    values: np.ndarray, dtype: type, *, step: np.ndarray | float | None = None, lower: np.ndarray | float | None = None
) -> PackedArray:
    """Round ``values`` (n, ...) to whole numbers of steps.

    Args:
        values: finite numbers.
        dtype: ``np.uint8`` or ``np.uint16``.
        step: Step, or steps along the last axis. None, and steps with which ``dtype`` would overflow, are replaced by
            the smallest step that covers the values.
        lower: Value of the number 0, or values along the last axis; None uses the minimum.
    """
    rows = values.astype(np.float64)
    axes = tuple(range(rows.ndim - 1)) if rows.ndim > 1 else None
    low = np.atleast_1d(rows.min(axis=axes) if lower is None else np.asarray(lower, np.float64))
    smallest = np.atleast_1d(rows.max(axis=axes, initial=-np.inf) - low) / np.iinfo(dtype).max
    chosen = smallest if step is None else np.maximum(np.atleast_1d(np.asarray(step, np.float64)), smallest)
    # If all values are equal, any step is valid.
    chosen = np.where(chosen > 0.0, chosen, 1.0)
    stored = np.rint((rows - low) / chosen).astype(dtype)
    return PackedArray(stored, low, chosen, float(np.abs(low + chosen * stored - rows).max(initial=0.0)))


def indices(values: np.ndarray) -> PackedArray:
    """Pack non-negative integers in 16 or 32 bits."""
    return PackedArray(values.astype(np.uint16 if values.max(initial=0) <= 0xFFFF else np.uint32))
