"""Errors in captures: one clear line for any bytes."""

from __future__ import annotations

import gzip
import json
import struct
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egs_warp.errors import UserError
from egs_warp.io import read_capture, write_spz
from tests.support.captures import WRITERS, good_bytes, message, small_cloud, written
from tests.support.properties import examples

PLY_HEADER = b"ply\nformat binary_little_endian 1.0\n"


def ply_with(name: str, value: float, row: int) -> bytes:
    """Return the valid .ply with one number replaced."""
    data = bytearray(good_bytes("a.ply"))
    start = data.index(b"end_header\n") + 11
    names = [line.split()[2].decode() for line in data[:start].splitlines() if line.startswith(b"property")]
    struct.pack_into("<f", data, start + 4 * (row * len(names) + names.index(name)), value)
    return bytes(data)


# File system ---------------------------------------------------------------------------------------------------------


def test_missing_file_and_folder(tmp_path: Path) -> None:
    assert message(tmp_path / "no.ply") == "no such file or folder; check the path"
    assert message(tmp_path) == "the folder has no meta.json; give an unbundled SOG folder or a capture file"
    assert message(written(tmp_path / "a.ply", b"")) == "the file is empty; copy or export it again"


def test_wrong_magic(tmp_path: Path) -> None:
    advice = "give a .ply, .spz, .splat, .sog, .glb or a SOG folder"
    expected = f"unknown format (starts with b'\\xff\\xd8abcdef'); {advice}"
    for name in ("a.ply", "a.spz", "a.sog"):
        assert message(written(tmp_path / name, b"\xff\xd8abcdefgh")) == expected


def test_a_mesh_is_not_a_capture(tmp_path: Path) -> None:
    assert message(written(tmp_path / "thing.obj", b"v 0 0 0\nv 1 0 0\n")).startswith(
        "a .obj file is a mesh, which has no Gaussians; cover its surface with Gaussians (docs/guide/capture.md"
    )


@pytest.mark.parametrize("name", ["a.ksplat", "run.USDC", "a.usdz"])
def test_formats_that_are_not_read(name: str, tmp_path: Path) -> None:
    text = message(written(tmp_path / name, b"PK\x03\x04" + bytes(100)))
    kind = Path(name).suffix.lower()
    assert text == (
        f"{kind} files are not read; export the Gaussians as .ply, .spz or .sog, for example with SuperSplat"
    )


def test_content_decides_not_the_name(tmp_path: Path) -> None:
    for name in ("a.ply", "b.ply", "a.spz", "a.sog"):
        path = written(tmp_path / "capture.splat", good_bytes(name))
        assert read_capture(path, device="cpu").cloud.count == 7


# .ply ----------------------------------------------------------------------------------------------------------------


def test_a_truncated_ply_reports_the_missing_bytes(tmp_path: Path) -> None:
    for name, element in (("a.ply", "vertex"), ("b.ply", "sh")):
        data = good_bytes(name)
        expected = f"truncated: 7 rows of element {element} need a file of {len(data)} bytes, found {len(data) - 3}"
        assert message(written(tmp_path / name, data[:-3])) == f"{expected}; copy or export it again"
    assert message(written(tmp_path / "a.ply", good_bytes("a.ply")[:40])).startswith(
        "truncated: the .ply header has no"
    )


def test_mesh_ply_names_what_is_missing(tmp_path: Path) -> None:
    mesh = PLY_HEADER + b"element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    mesh += b"element face 0\nproperty list uchar int vertex_indices\nend_header\n" + bytes(12)
    assert message(written(tmp_path / "mesh.ply", mesh)) == (
        "not a 3DGS capture: element vertex has no rot_0, rot_1, rot_2, rot_3, scale_0, scale_1, opacity, "
        "f_dc_0, f_dc_1, f_dc_2; it is a point cloud, which cannot be animated: train or export it as Gaussians"
    )


def test_zero_gaussians(tmp_path: Path) -> None:
    expected = "it has no Gaussians; export it again from the tool that made it"
    data = good_bytes("a.ply")
    none = data[: data.index(b"end_header\n") + 11].replace(b"element vertex 7", b"element vertex 0")
    assert message(written(tmp_path / "a.ply", none)) == expected
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, 0, 0, 12, 0, 0)
    assert message(written(tmp_path / "a.spz", gzip.compress(header))) == expected


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["x", "rot_3", "scale_1", "f_dc_2", "f_rest_4", "opacity"])
def test_values_that_are_not_finite_are_named(name: str, value: float, tmp_path: Path) -> None:
    capture = read_capture(written(tmp_path / "a.ply", ply_with(name, value, 4)), device="cpu")
    if name == "opacity" and np.isinf(value):
        assert capture.infinite_opacities == 1
    elif name == "scale_1" and value < 0.0:
        assert capture.cloud.log_scales.numpy()[4, 1] == -100.0
    else:
        assert capture.cloud.count == 6
        expected = f"left out 1 Gaussians that have a value that is not finite ({name} of number 4)"
        assert capture.notes == (expected,)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            (b"property float f_rest_8\n", b"property float other\n"),
            "8 f_rest properties, expected three times",
        ),
        (
            (b"property float f_rest_8\n", b"property float f_rest_9\n"),
            "9 f_rest properties, expected three times",
        ),
        (
            (b"property float f_rest_8\n", b"property float x\n"),
            "malformed .ply header, element vertex repeats property x",
        ),
        ((b"property float x\n", b"property colour x\n"), "malformed .ply header, line 'property colour x'"),
        ((b"element vertex 7\n", b"element vertex many\n"), "malformed .ply header, line 'element vertex many'"),
        ((b"format binary_little_endian 1.0\n", b""), "malformed .ply header, no format line"),
        (
            (b"element vertex 7\n", b"element vertex 99999999999\n"),
            "truncated: 99999999999 rows of element vertex need",
        ),
        (
            (b"element vertex", b"element face 1\nproperty list uchar int i\nelement vertex"),
            "element face before the Gauss",
        ),
    ],
)
def test_malformed_ply_headers(change: tuple[bytes, bytes], expected: str, tmp_path: Path) -> None:
    data = good_bytes("a.ply")
    assert change[0] in data
    assert message(written(tmp_path / "a.ply", data.replace(*change))).startswith(expected)


def test_text_ply_that_is_not_numbers(tmp_path: Path) -> None:
    data = good_bytes("a.ply")
    header = data[: data.index(b"end_header\n") + 11].replace(b"binary_little_endian", b"ascii")
    row = b"1 " * 26 + b"\n"
    for body, expected in (
        (row * 5, "truncated: element vertex needs 7 lines, found 5"),
        (row * 6 + row.replace(b"1", b"one", 1), "element vertex is not 7 lines of 26 numbers"),
        (row * 6 + b"1 1 1\n", "element vertex is not 7 lines of 26 numbers"),
    ):
        assert message(written(tmp_path / "a.ply", header + body)).startswith(expected)


def test_compressed_ply_without_its_parts(tmp_path: Path) -> None:
    data = good_bytes("b.ply")
    for old, new, expected in (
        (b"float max_scale_z", b"float something", "the compressed .ply has no max_scale_z; export it again"),
        (b"uint packed_scale", b"uint packed_other", "the compressed .ply has no packed_scale; export it again"),
        (b"element chunk 1", b"element chunk 0", "7 Gaussians need 1 chunks, found 0; export it again"),
        (b"uchar f_rest_3", b"uchar f_nest_3", "element sh has 7 rows of 9 properties, expected 7 of 9, 24 or 45"),
    ):
        assert message(written(tmp_path / "b.ply", data.replace(old, new))).startswith(expected)


# .spz, .splat --------------------------------------------------------------------------------------------------------


def test_bad_spz(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    body = gzip.decompress(good_bytes("a.spz"))
    size = len(body)
    assert message(written(path, gzip.compress(body[:-1]))) == (
        f"truncated: 7 Gaussians need {size} bytes, found {size - 1}; copy it again"
    )
    assert message(written(path, good_bytes("a.spz")[:-100])).startswith(f"truncated: 7 Gaussians need {size} bytes, f")
    assert message(written(path, gzip.compress(b"something else, longer than a header"))) == (
        "gzip data, but no .spz inside; unpack it first if it holds another format"
    )
    assert message(written(path, gzip.compress(body[:4] + struct.pack("<I", 7) + body[8:]))) == (
        "the .spz has version 7, expected 1 to 4; export it as version 4 or as .ply"
    )
    assert message(written(path, gzip.compress(body[:12] + b"\x09" + body[13:]))).startswith("the .spz has SH degree 9")
    assert message(written(path, b"NGSP\x04\0\0\0")).startswith("truncated: .spz header of 8 bytes, expected 16")
    # A file of 300 bytes that declares four thousand million Gaussians is refused before memory is allocated.
    many = gzip.compress(body[:8] + b"\xff\xff\xff\xff" + body[12:])
    assert message(written(path, many)) == (
        f"it declares 4294967295 Gaussians, more than its {len(many)} bytes can hold; copy or export it again"
    )
    flipped = bytearray(good_bytes("a.spz"))
    flipped[-6] ^= 255
    assert message(written(path, bytes(flipped))).startswith("corrupted gzip data (")


def test_spz_refuses_distant_means(tmp_path: Path) -> None:
    far = small_cloud().scaled(1e8)
    with pytest.raises(
        UserError, match=r"a mean lies .* units from the origin, the limit of \.spz is 8388607; scale the capture down"
    ):
        write_spz(tmp_path / "a.spz", far)
    with pytest.raises(UserError, match=r"\.spz version 5 cannot be written; choose 2, 3 or 4"):
        write_spz(tmp_path / "a.spz", far, version=5)
    # With fewer fractional bits, positions have a larger range.
    wide = replace(small_cloud(), means=small_cloud().scaled(1e5).means)
    write_spz(tmp_path / "a.spz", wide)
    read = read_capture(tmp_path / "a.spz", device="cpu").cloud
    np.testing.assert_allclose(read.means.numpy(), wide.means.numpy(), atol=0.05)


def test_bad_splat(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    assert message(written(path, good_bytes("a.splat")[:-5])) == (
        "truncated or not a .splat: 7 Gaussians need 224 bytes, found 219; copy or export it again"
    )
    data = bytearray(good_bytes("a.splat"))
    for row in range(3, 7):
        struct.pack_into("<f", data, row * 32 + 12, -1.0)
    assert message(written(path, bytes(data))) == (
        "4 Gaussians have a negative scale (the first is number 3), so the file is damaged or not a .splat; export it"
        " again"
    )


# Arbitrary bytes -----------------------------------------------------------------------------------------------------


def assert_capture_or_one_line(name: str, data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = written(Path(folder) / name, data)
        try:
            capture = read_capture(path, device="cpu")
        except UserError as error:
            assert "\n" not in str(error) and str(path) in str(error)
            return
        for array in ("means", "rotations", "log_scales", "opacity_logits", "sh"):
            assert np.isfinite(getattr(capture.cloud, array).numpy()).all()


@pytest.mark.filterwarnings("error")
@settings(max_examples=examples(150))
@given(st.data())
@pytest.mark.parametrize("name", WRITERS)
def test_any_truncation_and_any_flipped_bytes(name: str, data: st.DataObject) -> None:
    good = bytearray(good_bytes(name))
    # Half of the flipped bytes are in the header, where they have the largest effect.
    header = good.find(b"end_header") if name.endswith(".ply") else len(good)
    for _ in range(data.draw(st.integers(0, 4))):
        place = data.draw(st.integers(0, header - 1) | st.integers(0, len(good) - 1))
        good[place] = data.draw(st.sampled_from(b"\n 09\0") | st.integers(0, 255))
    keep = data.draw(st.just(len(good)) | st.integers(0, len(good)))
    assert_capture_or_one_line(name, bytes(good[:keep]))


@pytest.mark.filterwarnings("error")
@settings(max_examples=examples(200))
@given(st.data())
def test_any_flipped_bytes_inside_gzip(data: st.DataObject) -> None:
    """The bytes are flipped before compression: flips of the compressed file only violate its checksum."""
    body = bytearray(gzip.decompress(good_bytes("a.spz")))
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    assert_capture_or_one_line("a.spz", gzip.compress(bytes(body[: data.draw(st.integers(0, len(body)))])))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda children: st.lists(children, max_size=3) | st.dictionaries(st.text(max_size=5), children, max_size=3),
    max_leaves=6,
)


@pytest.mark.filterwarnings("error")
@settings(max_examples=examples(200))
@given(st.data())
def test_any_entry_of_meta_json_replaced(data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = written(Path(folder) / "a.sog", good_bytes("a.sog"))
        with zipfile.ZipFile(path) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
        meta = entry = json.loads(files["meta.json"])
        while True:
            key = data.draw(st.sampled_from(sorted(entry) if isinstance(entry, dict) else range(len(entry))))
            if not isinstance(entry[key], dict | list) or not entry[key] or data.draw(st.booleans()):
                break
            entry = entry[key]
        entry[key] = data.draw(JSON)
        files["meta.json"] = json.dumps(meta).encode()
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        assert_capture_or_one_line("a.sog", path.read_bytes())
