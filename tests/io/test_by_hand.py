"""Captures from hand-made bytes, whose decoded values equal those of the public format descriptions."""

from __future__ import annotations

import gzip
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io import read_capture, write_ply, write_splat, write_spz
from egs_warp.render import render_gaussians
from tests.support.captures import assert_same_bits, make_cloud, spz_of_streams


@pytest.mark.parametrize("version", [1, 2, 3])
def test_spz_by_hand(version: int, tmp_path: Path) -> None:
    """The file has one Gaussian at (1.5, -2, 0.25) with rotation (w, x, y, z) = (0.8, 0, -0.6, 0) and SH of degree
    1."""
    position = struct.pack("<3e", 1.5, -2.0, 0.25)
    if version > 1:
        position = b"".join(struct.pack("<i", int(v * 4096))[:3] for v in (1.5, -2.0, 0.25))
    if version < 3:
        rotation = bytes([128, round((-0.6 + 1) * 127.5), 128])
    else:
        # The components are x, y, z, w. The largest, w (index 3), is omitted; each of the others has a sign bit and
        # nine bits of |c| sqrt(2).
        rotation = struct.pack("<I", 3 << 30 | 0 << 20 | (512 | round(0.6 * 2**0.5 * 511)) << 10 | 0)
    body = struct.pack("<IIIBBBB", 0x5053474E, version, 1, 1, 12, version == 3, 0) + position
    body += bytes([51]) + bytes([255, 128, 0]) + bytes([160, 96, 0]) + rotation
    body += bytes([128 + 64, 128, 128, 128, 128 - 64, 128, 128, 128, 0])
    (tmp_path / "a.spz").write_bytes(gzip.compress(body))
    (tmp_path / "plain.spz").write_bytes(body)
    capture = read_capture(tmp_path / "a.spz", device="cpu")
    cloud = capture.cloud
    np.testing.assert_array_equal(cloud.means.numpy(), [[1.5, -2.0, 0.25]])
    np.testing.assert_allclose(cloud.rotations.numpy(), [[0.8, 0.0, -0.6, 0.0]], atol=6e-3 if version < 3 else 1e-3)
    np.testing.assert_array_equal(cloud.log_scales.numpy(), [[0.0, -4.0, -10.0]])
    np.testing.assert_allclose(cloud.opacities(), [0.2], atol=1e-6)
    np.testing.assert_allclose(cloud.sh.numpy()[0, 0], [0.5 / 0.15, (128 / 255 - 0.5) / 0.15, -0.5 / 0.15], rtol=1e-5)
    np.testing.assert_array_equal(cloud.sh.numpy()[0, 1:], [[0.5, 0, 0], [0, -0.5, 0], [0, 0, -1.0]])
    np.testing.assert_array_equal(capture.up, [0.0, 1.0, 0.0])
    assert capture.antialiased == (version == 3)
    assert_same_bits(read_capture(tmp_path / "plain.spz", device="cpu").cloud, cloud)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz_of_streams_equals_version_3(degree: int, tmp_path: Path) -> None:
    write_spz(tmp_path / "3.spz", make_cloud(900, degree))
    plain = gzip.decompress((tmp_path / "3.spz").read_bytes())
    (tmp_path / "4.spz").write_bytes(spz_of_streams(plain, 900, 3 * ((degree + 1) ** 2 - 1)))
    capture = read_capture(tmp_path / "4.spz", device="cpu")
    assert capture.format == ".spz version 4"
    np.testing.assert_array_equal(capture.up, [0.0, 1.0, 0.0])
    assert_same_bits(capture.cloud, read_capture(tmp_path / "3.spz", device="cpu").cloud)


@pytest.mark.parametrize("degree", [0, 2])
def test_spz_of_streams_is_written_as_described(degree: int, tmp_path: Path) -> None:
    """Header, table and streams follow https://github.com/nianticlabs/spz byte by byte; the decompressed data equal
    those of version 3."""
    write_spz(tmp_path / "3.spz", make_cloud(900, degree))
    write_spz(tmp_path / "4.spz", make_cloud(900, degree), version=4)
    plain, data = gzip.decompress((tmp_path / "3.spz").read_bytes()), (tmp_path / "4.spz").read_bytes()
    count = 6 if degree else 5
    assert data[:4] == b"NGSP" and struct.unpack("<II", data[4:12]) == (4, 900)
    assert data[12:15] == plain[12:15] and data[15] == count and data[16:32] == struct.pack("<I12x", 32)
    rows = [struct.unpack_from("<QQ", data, 32 + 16 * k) for k in range(count)]
    assert [size for _, size in rows] == [900 * w for w in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1))][:count]
    place, blocks = 32 + 16 * count, []
    for packed, size in rows:
        blocks.append(zstandard.ZstdDecompressor().decompress(data[place : place + packed]))
        assert zstandard.frame_content_size(data[place : place + packed]) == size == len(blocks[-1])
        place += packed
    assert place == len(data) and b"".join(blocks) == plain[16:]


def _one_spz(tmp_path: Path) -> bytes:
    write_spz(tmp_path / "3.spz", make_cloud(1))
    return gzip.decompress((tmp_path / "3.spz").read_bytes())


@pytest.mark.parametrize(("axes", "up"), [(4, (0, 1, 0)), (6, (0, -1, 0)), (12, (0, 0, 1)), (9, (0, 0, -1))])
def test_spz_of_streams_declares_the_up_direction(axes: int, up: tuple[int, int, int], tmp_path: Path) -> None:
    """The axes are RUB (right, up, back), RDF, RFU or LFD, and are declared after a record of another kind."""
    records = struct.pack("<IIfff", 0xADBE0002, 12, 0.0, 1.0, 2.0) + struct.pack("<III", 0xADBE0003, 4, axes)
    (tmp_path / "4.spz").write_bytes(spz_of_streams(_one_spz(tmp_path), 1, 0, records))
    np.testing.assert_array_equal(read_capture(tmp_path / "4.spz", device="cpu").up, up)


def test_left_handed_spz_is_mirrored(tmp_path: Path) -> None:
    """A file in Unity's left-handed axes LUB is converted to RUB, so that it shows the mirror image of a RUB file with
    the same numbers."""
    write_spz(tmp_path / "3.spz", make_cloud(50, 3))
    plain = gzip.decompress((tmp_path / "3.spz").read_bytes())
    records = struct.pack("<III", 0xADBE0003, 4, 3)
    (tmp_path / "4.spz").write_bytes(spz_of_streams(plain, 50, 45, records))
    capture = read_capture(tmp_path / "4.spz", device="cpu")
    stored, read = read_capture(tmp_path / "3.spz", device="cpu").cloud, capture.cloud
    assert capture.notes == ("vendor extensions left out", "left-handed axes: x was reversed")
    np.testing.assert_array_equal(capture.up, [0, 1, 0])
    mirror = np.array([-1.0, 1.0, 1.0])
    np.testing.assert_array_equal(read.means.numpy(), stored.means.numpy() * mirror)
    views = [
        Camera.look_at(np.array([x, 2.0, 5.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), width=64, height=48)
        for x in (3.0, -3.0)
    ]
    pictures = [render_gaussians(cloud, view).colour.numpy() for cloud, view in zip((stored, read), views, strict=True)]
    np.testing.assert_allclose(pictures[1], pictures[0][:, ::-1], atol=1e-4)


def test_a_few_negative_scales_of_a_splat_are_left_out(tmp_path: Path) -> None:
    write_splat(tmp_path / "a.splat", make_cloud(20))
    data = bytearray((tmp_path / "a.splat").read_bytes())
    data[32 * 4 + 12 : 32 * 4 + 16] = struct.pack("<f", -0.5)
    (tmp_path / "a.splat").write_bytes(data)
    capture = read_capture(tmp_path / "a.splat", device="cpu")
    assert capture.cloud.count == 19
    assert capture.notes == ("left out 1 Gaussians that have a value that is not finite (scale_0 of number 4)",)


def test_damaged_spz_of_streams_is_one_line(tmp_path: Path) -> None:
    good = spz_of_streams(_one_spz(tmp_path), 1, 0)
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 26))
    for data, said in {
        good[:20]: "truncated: .spz header of 20 bytes, expected 32",
        good[:50]: "its table lies outside the file",
        good[:-3]: "corrupt or truncated .spz: a stream",
        good[:15] + b"\4" + good[16:]: "the .spz has 4 streams, expected 5",
        good[:112] + b"\0" * (len(good) - 112): "corrupted .spz data",
        good[:32] + struct.pack("<QQ", len(bomb), 1 << 26) + good[48:112] + bomb: "of which 9 are needed",
        gzip.compress(good): "the gzip data contain a .spz of version 4; unpack it first",
    }.items():
        (tmp_path / "4.spz").write_bytes(data)
        with pytest.raises(UserError, match=re.escape(said)):
            read_capture(tmp_path / "4.spz", device="cpu")


def test_splat_by_hand(tmp_path: Path) -> None:
    row = struct.pack("<6f", 1.0, 2.0, 3.0, 0.5, 1.0, 2.0) + bytes([255, 0, 51, 255]) + bytes([128, 128, 0, 128])
    zero = struct.pack("<6f", 0.0, 0.0, 0.0, 0.0, 1.0, 1.0) + bytes(8)
    (tmp_path / "a.splat").write_bytes(row + zero)
    capture = read_capture(tmp_path / "a.splat", device="cpu")
    cloud = capture.cloud
    np.testing.assert_array_equal(cloud.means.numpy()[0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(np.exp(cloud.log_scales.numpy()[0]), [0.5, 1.0, 2.0], rtol=1e-6)
    np.testing.assert_array_equal(cloud.rotations.numpy()[0], [0.0, 0.0, -1.0, 0.0])
    np.testing.assert_allclose(0.5 + SH_BAND_0 * cloud.sh.numpy()[0, 0], [1.0, 0.0, 0.2], atol=1e-6)
    np.testing.assert_array_equal(cloud.opacity_logits.numpy(), [16.0, -16.0])
    assert capture.infinite_opacities == 0
    assert capture.notes == ("1 Gaussians with a scale of 0 read as 1e-38",)


def test_compressed_ply_by_hand(tmp_path: Path) -> None:
    """The file has the oldest layout, which lacks colour bounds, and extreme and middle values of each packed field."""
    names = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
    names += ["min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z"]
    header = "ply\r\nformat binary_little_endian 1.0\r\nelement chunk 1\r\n"
    header += "".join(f"property float {name}\r\n" for name in names) + "element vertex 1\r\n"
    header += "".join(f"property uint packed_{name}\r\n" for name in ("position", "rotation", "scale", "color"))
    chunk = struct.pack("<12f", -1.0, -1.0, -1.0, 1.0, 3.0, 5.0, -8.0, -8.0, -8.0, -2.0, -2.0, -2.0)
    position = 0 << 21 | 1023 << 11 | 2047
    # The largest component, x (index 1), is omitted; w, y, z follow in this order.
    rotation = 1 << 30 | round((0.6 / 2**0.5 + 0.5) * 1023) << 20 | round(0.5 * 1023) << 10 | round(0.5 * 1023)
    scale = 2047 << 21 | 0 << 11 | 2047
    colour = 255 << 24 | 0 << 16 | 102 << 8 | 51
    vertex = struct.pack("<4I", position, rotation, scale, colour)
    (tmp_path / "a.ply").write_bytes(header.encode() + b"end_header\r\n" + chunk + vertex)
    cloud = read_capture(tmp_path / "a.ply", device="cpu").cloud
    np.testing.assert_array_equal(cloud.means.numpy(), [[-1.0, 3.0, 5.0]])
    np.testing.assert_allclose(cloud.rotations.numpy(), [[0.6, 0.8, 0.0, 0.0]], atol=1.5e-3)
    np.testing.assert_array_equal(cloud.log_scales.numpy(), [[-2.0, -8.0, -2.0]])
    np.testing.assert_allclose(0.5 + SH_BAND_0 * cloud.sh.numpy()[0, 0], [1.0, 0.0, 0.4], atol=1e-6)
    np.testing.assert_allclose(cloud.opacities(), [0.2], atol=1e-6)


def ply_text(cloud: GaussianCloud, *, kind: str, order: str, number: str) -> bytes:
    """Return the Gaussians as an unusual but valid .ply: shuffled properties, extra elements, other number types."""
    rest = 3 * ((cloud.sh_degree + 1) ** 2 - 1)
    columns = {f"f_rest_{i}": cloud.sh.numpy()[:, 1 + i % (rest // 3), i // (rest // 3)] for i in range(rest)}
    for i in range(3):
        columns |= {"xyz"[i]: cloud.means.numpy()[:, i], f"scale_{i}": cloud.log_scales.numpy()[:, i]}
        columns |= {f"f_dc_{i}": cloud.sh.numpy()[:, 0, i]}
    columns |= {f"rot_{i}": cloud.rotations.numpy()[:, i] for i in range(4)}
    columns |= {"opacity": cloud.opacity_logits.numpy(), "beauty": np.arange(cloud.count)}
    names = sorted(columns, key=lambda name: zlib.crc32(name.encode()))
    header = f"ply\nformat {kind} 1.0\ncomment made by hand\nelement camera 2\nproperty uchar id\nproperty int f\n"
    header += f"element vertex {cloud.count}\n" + "".join(f"property {number} {name}\n" for name in names)
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.stack([columns[name] for name in names], axis=1).astype(np.float64)
    if kind == "ascii":
        lines = ["1 5", "2 6", *(" ".join(repr(float(value)) for value in row) for row in rows), "3 0 1 2"]
        return header.encode() + "\n".join(lines).encode() + b"\n"
    code = {"float": "f4", "double": "f8"}[number]
    camera = struct.pack(f"{order}BiBi", 1, 5, 2, 6)
    return header.encode() + camera + rows.astype(f"{order}{code}").tobytes() + struct.pack(f"{order}B3i", 3, 0, 1, 2)


@pytest.mark.parametrize(
    ("kind", "order", "number"),
    [
        ("binary_little_endian", "<", "float"),
        ("binary_little_endian", "<", "double"),
        ("binary_big_endian", ">", "float"),
        ("ascii", "", "float"),
    ],
)
def test_ply_in_any_order_and_type(kind: str, order: str, number: str, tmp_path: Path) -> None:
    cloud = make_cloud(40, 2)
    (tmp_path / "a.ply").write_bytes(ply_text(cloud, kind=kind, order=order, number=number))
    assert_same_bits(read_capture(tmp_path / "a.ply", device="cpu").cloud, cloud)


def test_infinite_opacities_are_counted_and_made_finite(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", make_cloud(3))
    data = bytearray((tmp_path / "a.ply").read_bytes())
    data[-32:-28] = struct.pack("<f", np.inf)
    data[-32 - 68 : -28 - 68] = struct.pack("<f", -np.inf)
    (tmp_path / "a.ply").write_bytes(data)
    capture = read_capture(tmp_path / "a.ply", device="cpu")
    assert capture.infinite_opacities == 2
    assert capture.notes == ("2 infinite opacities were read as 0 or 1",)
    np.testing.assert_array_equal(capture.cloud.opacity_logits.numpy()[1:], [-16.0, 16.0])
