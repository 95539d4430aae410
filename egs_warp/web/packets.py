"""Binary format of the page, which is the same in files and on sockets: one header, then one packet for each frame.

All numbers are little-endian. A header consists of the 8 bytes ``EGSPAGE1``, the uint32 length of a JSON text, the text
in UTF-8, zeros up to a multiple of 8 bytes, and the arrays that the text lists. In a file, the uint32 length of a
packet precedes each packet. ``client/src/packets.ts`` reads the format.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

MAGIC = b"EGSPAGE1"
"""First bytes of a header."""


def header(facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return a header of JSON ``facts`` and named ``arrays``.

    The arrays are float32, int32 or uint8; each starts at a multiple of 8 bytes after the text.
    """
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
    """State of a creature at one time, in the frame of the body."""

    index: int
    """Number of the frame."""
    time: float
    """Simulated time, s."""
    positions: np.ndarray
    """(N, 3) m, nodes of the cage."""
    activations: np.ndarray
    """(M,) -1 to 1, activation of each segment divided by its bound."""
    contacts: np.ndarray
    """(C, 9) one row per contact: point in m, unit normal, and force on the body in N."""
    curves: np.ndarray
    """(K,) values of the curves, in the order of ``curves`` in the header."""

    def packet(self) -> bytes:
        """Return the packet: 32 + 12 N + M (padded to a multiple of 4) + 36 C + 4 K bytes."""
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
    """Return the packet preceded by its length, as in a file."""
    return np.uint32(len(packet)).tobytes() + packet
