"""Files of arrays, whose declared sizes are compared with the actual bytes."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from egs_warp.io.arrays import read_npz


def test_arrays_saved_by_numpy_are_read(tmp_path: Path) -> None:
    saved = {"a": np.arange(6.0).reshape(2, 3), "b": np.array(["x", "yz"]), "c": np.zeros((0, 3), np.int32)}
    np.savez(tmp_path / "a.npz", schema=np.int64(2), **saved)  # pyright: ignore[reportArgumentType]
    back = read_npz(tmp_path / "a.npz")
    assert int(back.pop("schema")) == 2 and back.keys() == saved.keys()
    for name, array in saved.items():
        assert back[name].dtype == array.dtype and np.array_equal(back[name], array)


def _member(shape: str, dtype: str, data: bytes = b"") -> bytes:
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (118 - len(header) - 1) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


@pytest.mark.parametrize(
    ("member", "said"),
    [
        (_member("(10**9, 10**9)", "<f8"), "malformed|Cannot parse"),
        (_member("(1000000000000000,)", "<f8"), "does not match its number of bytes"),
        (_member("(-1, -8)", "|u1", b"12345678"), "does not match its number of bytes"),
        (_member("(2,)", "|O", b"12345678"), "an array of type object"),
        (_member("(1000000000,)", "|V0"), "an array of"),
        (b"\x93NUMPY\x03\x00", "an array of format 3.0, not 1.0 or 2.0"),
    ],
)
def test_arrays_that_declare_more_than_the_file_holds(member: bytes, said: str, tmp_path: Path) -> None:
    """Arrays that are larger than the file, and arrays of objects, are refused before memory is allocated for them."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", member)
    with pytest.raises(ValueError, match=said):
        read_npz(tmp_path / "a.npz")


def test_a_small_file_does_not_inflate(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(10**6))
    with pytest.raises(ValueError, match="its arrays are compressed"):
        read_npz(tmp_path / "a.npz")
    # Two entries of the archive refer to the same bytes, as overlapping members do.
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("a.npy", _member("(4000,)", "|u1", bytes(4000)))
        archive.filelist.append(archive.filelist[0])
    (tmp_path / "b.npz").write_bytes(data.getvalue())
    with pytest.raises(ValueError, match="its arrays are larger than the file"):
        read_npz(tmp_path / "b.npz")
