"""The bytes that the page reads, from a file or from a socket alike: one header, then a packet for each frame.

All numbers are little-endian. A header is the 8 bytes ``EGSPAGE1``, the uint32 length of a JSON text, that text in
UTF-8, zeros up to a multiple of 8, then the arrays that the text lists. Where frames follow in the same file, each
comes after its uint32 length. ``Frame.packet`` writes a frame; ``client/src/packets.ts`` reads all of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

MAGIC = b"EGSPAGE1"


def header(facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Facts (JSON) and arrays of float32, int32 or uint8, each at a multiple of 8 bytes after the text."""
    listed, pieces, start = {}, [], 0
    for name, values in arrays.items():
        data = np.ascontiguousarray(values).tobytes()
        listed[name] = {"type": str(values.dtype), "shape": list(values.shape), "start": start}
        pieces.append(data + bytes(-len(data) % 8))
        start += len(pieces[-1])
    text = json.dumps({**facts, "arrays": listed, "bytes": start}).encode()
    head = MAGIC + np.uint32(len(text)).tobytes() + text
    return head + bytes(-len(head) % 8) + b"".join(pieces)


@dataclass(frozen=True)
class Frame:
    """What the page is told of one moment; metres and newtons, in the frame of the body."""

    index: int
    time: float
    """Seconds."""
    positions: np.ndarray
    """(N, 3) nodes of the cage."""
    activations: np.ndarray
    """(M,) -1 to 1, of the most that each segment can do."""
    contacts: np.ndarray
    """(C, 9): point, unit normal, force on the body."""
    curves: np.ndarray
    """(K,) in the order of the header's ``curves``."""

    def packet(self) -> bytes:
        """32 + 12 N + M (to a multiple of 4) + 36 C + 4 K bytes."""
        counts = (len(self.positions), len(self.activations), len(self.contacts), len(self.curves), 0, 0)
        levels = np.rint(127.0 * np.clip(self.activations, -1.0, 1.0)).astype(np.int8).tobytes()
        return b"".join(
            [
                np.uint32(self.index).tobytes(),
                np.float32(self.time).tobytes(),
                np.array(counts, "<u4").tobytes(),
                self.positions.astype("<f4").tobytes(),
                levels + bytes(-len(levels) % 4),
                self.contacts.astype("<f4").tobytes(),
                self.curves.astype("<f4").tobytes(),
            ]
        )


def with_length(packet: bytes) -> bytes:
    """A frame as it stands in a file."""
    return np.uint32(len(packet)).tobytes() + packet
