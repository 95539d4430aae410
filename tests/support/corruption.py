"""Hypothesis strategies for corrupted files, for the tests and for Atheris (``tests/fuzz.py``)."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st

from tests.support.readers import Reader

_NUMBERS = (0.0, -1.0, 1e-300, 60.0, 8.0, 255.0, 1e6, 1e19, 3e38, -3e38, 1e300, float("inf"), float("nan"))
_WHOLE = (0, 1, -1, 7, 255, 65_535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
_WORDS = tuple(
    [
        struct.pack("<f", number) if abs(number) < 3.4e38 or number != number else struct.pack("<f", np.inf)
        for number in _NUMBERS
    ]
    + [struct.pack("<d", number) for number in _NUMBERS]
    + [struct.pack("<Q", number % 2**64) for number in _WHOLE]
    + [struct.pack("<I", number % 2**32) for number in _WHOLE]
    + [b"\n", b" ", b"-", b"e99", b"nan", b"inf", b"99999999999999999999", b"\0", b"../", b"/", b'"', b",", b"{", b"["]
)
_DIGITS = "@digits@"
_LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.sampled_from(_NUMBERS),
    st.sampled_from(_WHOLE),
    st.just(_DIGITS),
    st.floats(),
    st.integers(),
    st.sampled_from(["", "../a", "/etc/hostname", "a\0b", "x" * 300, "0", "true"]),
    st.text(max_size=4),
    st.just([]),
    st.just({}),
    st.lists(st.sampled_from(_NUMBERS), max_size=4),
)


def damaged(reader: Reader) -> st.SearchStrategy[bytes]:
    """Return the valid file of ``reader`` with up to six corruptions."""
    return _damaged_json(reader.good()) if reader.json else _damaged_bytes(reader.good())


@st.composite
def _damaged_bytes(draw: st.DrawFn, good: bytes) -> bytes:
    data = bytearray(good)
    for _ in range(draw(st.integers(0, 6))):
        # Half of the corruptions are in the first 64 bytes, because corrupted headers have the largest effect.
        place = draw(st.integers(0, max(len(data) - 1, 0)) | st.integers(0, min(len(data), 64)))
        match draw(st.integers(0, 5)):
            case 0:
                data[place : place + 1] = bytes([draw(st.integers(0, 255))])
            case 1:
                word = draw(st.sampled_from(_WORDS))
                data[place : place + len(word)] = word
            case 2:
                data[place:place] = draw(st.sampled_from(_WORDS) | st.binary(max_size=8))
            case 3:
                del data[place : place + draw(st.integers(1, 40))]
            case 4:
                data[place:place] = data[place : place + draw(st.integers(1, 200))]
            case _:
                del data[place:]
    return bytes(data)


@st.composite
def _damaged_json(draw: st.DrawFn, good: bytes) -> bytes:
    tree = [json.loads(good)]
    for _ in range(draw(st.integers(1, 4))):
        parent: Any = tree
        key: Any = 0
        while isinstance(parent[key], dict | list) and parent[key] and draw(st.integers(0, 5)) > 0:
            parent = parent[key]
            keys: Sequence[Any] = sorted(parent) if isinstance(parent, dict) else range(len(parent))
            key = draw(st.sampled_from(keys))
        match draw(st.integers(0, 4)):
            case 0 if parent is not tree:
                del parent[key]
            case 1 if isinstance(parent, list) and parent is not tree:
                parent.extend(parent[: draw(st.integers(1, 8))])
            case 2 if isinstance(parent, dict):
                parent[draw(st.text(max_size=4))] = draw(_LEAVES)
            case _:
                parent[key] = draw(_LEAVES)
    text = json.dumps(tree[0]).replace(f'"{_DIGITS}"', "9" * 5000)
    return text.encode()[: draw(st.just(len(text)) | st.integers(0, len(text)))]
