"""Reader of the packets that the server sends to the page."""

from __future__ import annotations

import json

import numpy as np


def read_packets(data: bytes) -> tuple[dict, dict[str, np.ndarray], list[dict]]:
    """Read packets in the layout of docs/guide/view.md; return the header's values, the arrays and the frames."""
    assert data[:8] == b"EGSPAGE1"
    length = int(np.frombuffer(data, "<u4", 1, 8)[0])
    facts = json.loads(data[12 : 12 + length])
    base = -(-(12 + length) // 8) * 8
    arrays = {
        name: np.frombuffer(data, entry["type"], int(np.prod(entry["shape"])), base + entry["start"]).reshape(
            entry["shape"]
        )
        for name, entry in facts["arrays"].items()
    }
    frames, at = [], base + facts["bytes"]
    while at < len(data):
        size = int(np.frombuffer(data, "<u4", 1, at)[0])
        words = np.frombuffer(data, "<u4", 8, at + 4)
        place = at + 36
        parts = {"index": int(words[0]), "time": float(np.frombuffer(data, "<f4", 1, at + 8)[0])}
        nodes, segments, contacts, curves = map(int, words[2:6])
        for name, kind, count in (
            ("positions", "<f4", 3 * nodes),
            ("activations", "i1", segments),
            ("contacts", "<f4", 9 * contacts),
            ("curves", "<f4", curves),
        ):
            parts[name] = np.frombuffer(data, kind, count, place)
            place += -(-parts[name].nbytes // 4) * 4
        assert place == at + 4 + size
        frames.append(parts)
        at = place
    return facts, arrays, frames
