"""Captures: real files, hand-made bytes, round trips."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from egs_warp.gaussians import GaussianCloud
from egs_warp.io import (
    read_capture,
    write_compressed_ply,
    write_ply,
    write_ply_sequence,
    write_sog,
    write_splat,
    write_spz,
)

C0 = 0.28209479177387814
ARRAYS = ("means", "rotations", "log_scales", "opacity_logits", "sh")


def make_cloud(count: int, degree: int = 0, *, seed: int = 1, device: str = "cpu") -> GaussianCloud:
    """Random Gaussians whose values every format can hold."""
    rng = np.random.default_rng(seed)
    return GaussianCloud.from_numpy(
        rng.uniform(-2.0, 2.0, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(-8.0, -1.0, (count, 3)),
        rng.uniform(-5.0, 5.0, count),
        rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3)),
        device=device,
    )


def assert_same_bits(actual: GaussianCloud, expected: GaussianCloud) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(actual, name).numpy(), getattr(expected, name).numpy(), err_msg=name)


def angles_degrees(first: GaussianCloud, second: GaussianCloud) -> np.ndarray:
    """Angle of each rotation from one cloud to the other; by the sine, which is exact for small ones."""
    p, q = first.rotations.numpy().astype(float), second.rotations.numpy().astype(float)
    p *= np.sign(np.einsum("ni,ni->n", p, q))[:, None]
    return np.degrees(4.0 * np.arcsin(np.linalg.norm(p - q, axis=1) / 2.0))


# Real captures ------------------------------------------------------------------------------------------------------

FILES = {
    "objects/plush_dog.ply": ("INRIA .ply", 15_105, 3, 0),
    "objects/plush_dog.compressed.ply": ("compressed .ply", 15_105, 3, 0),
    "objects/monkey.ply": ("INRIA .ply", 36_039, 0, 0),
    "objects/robot.spz": (".spz version 2", 267_776, 0, 0),
    "scenes/koala.ply": ("INRIA .ply", 54_804, 0, 0),
    "scenes/fox.ply": ("INRIA .ply", 50_000, 0, 37),
    "scenes/narcissus.sog": ("SOG version 2", 101_275, 0, 0),
    "scenes/playbot": ("SOG version 2", 31_000, 2, 0),
    "scenes/playbot/meta.json": ("SOG version 2", 31_000, 2, 0),
}


@pytest.mark.data
@pytest.mark.parametrize("name", FILES)
def test_real_captures_read(name: str, data_dir: Path) -> None:
    """Counts and degrees are those of the data's README; sizes and colours are those of a thing one can look at."""
    capture = read_capture(data_dir / name, device="cpu")
    cloud = capture.cloud
    assert (capture.format, cloud.count, cloud.sh_degree, capture.infinite_opacities) == FILES[name]
    np.testing.assert_allclose(np.linalg.norm(cloud.rotations.numpy(), axis=1), 1.0, atol=1e-6)
    assert np.isfinite(cloud.opacity_logits.numpy()).all()
    extent = np.ptp(np.percentile(cloud.means.numpy(), [2, 98], axis=0), axis=0).max()
    sizes = np.exp(cloud.log_scales.numpy())
    assert 5e-4 < np.median(sizes.max(axis=1)) / extent < 0.05
    colours = 0.5 + C0 * cloud.sh.numpy()[:, 0]
    assert np.mean((colours > -0.2) & (colours < 1.2)) > 0.97
    # A Gaussian's size is about the distance to its neighbours: true only if scales and means were both decoded.
    distance = cKDTree(cloud.means.numpy()).query(cloud.means.numpy()[::97], k=4)[0][:, 3]
    assert 0.2 < np.median(sizes.max(axis=1)[::97] / np.maximum(distance, 1e-9)) < 20.0
    if name.endswith(".spz"):
        np.testing.assert_array_equal(capture.up, [0.0, 1.0, 0.0])
    else:
        assert capture.up is None


@pytest.mark.data
def test_plush_dog_agrees_with_its_compressed_twin(data_dir: Path) -> None:
    """The same capture written by SuperSplat in both layouts: equal up to half a step of each packed number."""
    plain = read_capture(data_dir / "objects/plush_dog.ply", device="cpu").cloud
    packed = read_capture(data_dir / "objects/plush_dog.compressed.ply", device="cpu").cloud

    def features(cloud: GaussianCloud) -> np.ndarray:
        return np.concatenate([100.0 * cloud.means.numpy(), cloud.log_scales.numpy(), cloud.sh.numpy()[:, 0]], axis=1)

    _, order = cKDTree(features(plain)).query(features(packed))
    assert len(np.unique(order)) == plain.count
    plain = plain.subset(order)
    chunk_of = np.arange(plain.count) // 256

    def half_steps(values: np.ndarray, bits: tuple[int, int, int]) -> np.ndarray:
        ranges = np.stack([np.ptp(values[chunk_of == chunk], axis=0) for chunk in range(chunk_of[-1] + 1)])
        return 0.5 * ranges[chunk_of] / (2.0 ** np.array(bits) - 1.0)

    for name, bits in (("means", (11, 10, 11)), ("log_scales", (11, 10, 11))):
        exact, read = getattr(plain, name).numpy(), getattr(packed, name).numpy()
        # Clamped scales (SuperSplat keeps -20 ... 20) do not occur in this capture.
        assert np.all(np.abs(read - exact) <= 1.02 * half_steps(exact, bits) + 2e-6), name
    colours = plain.sh.numpy()[:, 0]
    assert np.all(np.abs(packed.sh.numpy()[:, 0] - colours) <= 1.02 * half_steps(colours, (8, 8, 8)) + 2e-5)
    assert np.abs(packed.sh.numpy()[:, 1:] - plain.sh.numpy()[:, 1:]).max() <= 4.0 / 256.0 + 1e-5
    assert np.abs(packed.opacities() - plain.opacities()).max() <= 0.5 / 255.0 + 1e-6
    assert angles_degrees(plain, packed).max() < 0.25


# Exact round trips --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_round_trip_keeps_every_bit(degree: int, tmp_path: Path, device: str) -> None:
    cloud = make_cloud(700, degree, device=device)
    write_ply(tmp_path / "a.ply", cloud)
    capture = read_capture(tmp_path / "a.ply", device=device)
    assert_same_bits(capture.cloud, cloud)
    assert str(capture.cloud.device) == device
    assert capture.source == tmp_path / "a.ply"


def test_copies_keep_every_bit() -> None:
    """Quaternions are normalised once, not again in every copy."""
    cloud = make_cloud(5000)
    assert_same_bits(cloud.subset(np.arange(5000)), cloud)


@pytest.mark.data
@pytest.mark.parametrize("name", ["objects/plush_dog.ply", "objects/robot.spz", "scenes/playbot"])
def test_real_captures_survive_ply(name: str, data_dir: Path, tmp_path: Path) -> None:
    cloud = read_capture(data_dir / name, device="cpu").cloud
    write_ply(tmp_path / "a.ply", cloud)
    assert_same_bits(read_capture(tmp_path / "a.ply", device="cpu").cloud, cloud)


@pytest.mark.data
@pytest.mark.parametrize("name", ["scenes/narcissus.sog", "scenes/playbot"])
def test_real_sog_survives_being_written_again(name: str, data_dir: Path, tmp_path: Path) -> None:
    """A capture with at most 256 different scales and colours loses nothing but rotation grid."""
    cloud = read_capture(data_dir / name, device="cpu").cloud
    write_sog(tmp_path / "a.sog", cloud, keep_order=True)
    again = read_capture(tmp_path / "a.sog", device="cpu").cloud
    for array in ("means", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(again, array).numpy(), getattr(cloud, array).numpy(), rtol=1e-6, atol=1e-6)
    assert angles_degrees(cloud, again).max() < 1.0


# Lossy round trips --------------------------------------------------------------------------------------------------

WRITERS: dict[str, Callable[..., None]] = {
    "a.compressed.ply": lambda path, cloud: write_compressed_ply(path, cloud, keep_order=True),
    "a2.spz": lambda path, cloud: write_spz(path, cloud, version=2),
    "a3.spz": write_spz,
    "a.splat": write_splat,
    "a.sog": lambda path, cloud: write_sog(path, cloud, keep_order=True),
}
# Largest error of means, log scales, rotations in degrees, colour of band 0, higher SH. From each grid's half step.
TOLERANCES = {
    "a.compressed.ply": (0.5 * 4.0 / 1023.0, 0.5 * 7.0 / 1023.0, 0.25, 0.5 * 1.8 / 255.0, 1.0 / 64.0),
    "a2.spz": (2.0**-13, 1.0 / 32.0, 12.0, 0.5 / 255.0 / 0.15, 0.0625),
    "a3.spz": (2.0**-13, 1.0 / 32.0, 0.25, 0.5 / 255.0 / 0.15, 0.0625),
    "a.splat": (0.0, 1e-6, 1.0, 0.5 / 255.0 / C0, np.inf),
    "a.sog": (0.5 * 2.0 * np.log(3.0) / 65535.0 * 3.0, 0.03, 1.0, 0.01, 0.01),
}


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("name", WRITERS)
def test_lossy_round_trip(name: str, degree: int, tmp_path: Path) -> None:
    cloud = make_cloud(1500, degree)
    WRITERS[name](tmp_path / name, cloud)
    read = read_capture(tmp_path / name, device="cpu").cloud
    means, scales, degrees, colour, rest = TOLERANCES[name]
    assert read.sh_degree == (0 if name == "a.splat" else degree)
    assert np.abs(read.means.numpy() - cloud.means.numpy()).max() <= means * 1.01
    assert np.abs(read.log_scales.numpy() - cloud.log_scales.numpy()).max() <= scales * 1.01
    assert angles_degrees(read, cloud).max() <= degrees
    assert np.abs(read.opacities() - cloud.opacities()).max() <= 0.5 / 255.0 + 1e-6
    assert np.abs(read.sh.numpy()[:, 0] - cloud.sh.numpy()[:, 0]).max() <= colour * 1.01
    if read.sh_degree:
        assert np.abs(read.sh.numpy()[:, 1:] - cloud.sh.numpy()[:, 1:]).max() <= rest * 1.01
    # What lies on the grid already stays on it.
    WRITERS[name](tmp_path / f"again.{name}", read)
    again = read_capture(tmp_path / f"again.{name}", device="cpu").cloud
    np.testing.assert_allclose(again.opacity_logits.numpy(), read.opacity_logits.numpy(), atol=1e-6)


@pytest.mark.parametrize("write", [write_compressed_ply, write_sog])
def test_sorted_in_space_holds_the_same_gaussians(write: Callable[..., None], tmp_path: Path) -> None:
    cloud = make_cloud(3000)
    for keep_order in (True, False):
        write(tmp_path / f"{keep_order}{'.sog' if write is write_sog else '.ply'}", cloud, keep_order=keep_order)
    kept, moved = (read_capture(path, device="cpu").cloud for path in sorted(tmp_path.iterdir(), reverse=True))
    distance, order = cKDTree(moved.means.numpy()).query(cloud.means.numpy())
    assert sorted(order) == list(range(3000))
    assert np.median(distance) < 1.2 * np.median(np.linalg.norm(kept.means.numpy() - cloud.means.numpy(), axis=1))
    neighbours = np.linalg.norm(np.diff(moved.means.numpy(), axis=0), axis=1)
    assert np.median(neighbours) < 0.3 * np.median(np.linalg.norm(np.diff(kept.means.numpy(), axis=0), axis=1))


def test_sog_with_more_sh_sets_than_the_palette_holds(tmp_path: Path) -> None:
    """70,000 Gaussians of 300 kinds share 65,536 places: nearly every one keeps its own coefficients."""
    rng = np.random.default_rng(0)
    kinds = rng.uniform(-0.5, 0.5, (300, 4, 3))
    base = make_cloud(70_000)
    sh = kinds[rng.integers(0, 300, 70_000)] + rng.normal(scale=1e-4, size=(70_000, 4, 3))
    arrays = [getattr(base, name).numpy() for name in ARRAYS[:4]]
    cloud = GaussianCloud.from_numpy(*arrays, sh, device="cpu")
    write_sog(tmp_path / "a.sog", cloud, keep_order=True)
    read = read_capture(tmp_path / "a.sog", device="cpu").cloud
    assert np.abs(read.sh.numpy() - cloud.sh.numpy())[:, 1:].max() < 0.01


# Hand-made bytes: what the public descriptions say, value by value --------------------------------------------------


@pytest.mark.parametrize("version", [1, 2, 3])
def test_spz_by_hand(version: int, tmp_path: Path) -> None:
    """One Gaussian at (1.5, -2, 0.25) with rotation (w, x, y, z) = (0.8, 0, -0.6, 0), SH of degree 1."""
    position = struct.pack("<3e", 1.5, -2.0, 0.25)
    if version > 1:
        position = b"".join(struct.pack("<i", int(v * 4096))[:3] for v in (1.5, -2.0, 0.25))
    if version < 3:
        rotation = bytes([128, round((-0.6 + 1) * 127.5), 128])
    else:
        # Components x, y, z, w; w is the largest (index 3); a sign bit and nine bits of |c| sqrt(2) for each other one.
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


def test_splat_by_hand(tmp_path: Path) -> None:
    row = struct.pack("<6f", 1.0, 2.0, 3.0, 0.5, 1.0, 2.0) + bytes([255, 0, 51, 255]) + bytes([128, 128, 0, 128])
    zero = struct.pack("<6f", 0.0, 0.0, 0.0, 0.0, 1.0, 1.0) + bytes(8)
    (tmp_path / "a.splat").write_bytes(row + zero)
    capture = read_capture(tmp_path / "a.splat", device="cpu")
    cloud = capture.cloud
    np.testing.assert_array_equal(cloud.means.numpy()[0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(np.exp(cloud.log_scales.numpy()[0]), [0.5, 1.0, 2.0], rtol=1e-6)
    np.testing.assert_array_equal(cloud.rotations.numpy()[0], [0.0, 0.0, -1.0, 0.0])
    np.testing.assert_allclose(0.5 + C0 * cloud.sh.numpy()[0, 0], [1.0, 0.0, 0.2], atol=1e-6)
    np.testing.assert_array_equal(cloud.opacity_logits.numpy(), [16.0, -16.0])
    assert capture.infinite_opacities == 0
    assert capture.notes == ("1 Gaussians with a scale of 0 read as 1e-38",)


def test_compressed_ply_by_hand(tmp_path: Path) -> None:
    """The oldest layout, without bounds of colour; extremes and middles of each packed field."""
    names = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
    names += ["min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z"]
    header = "ply\r\nformat binary_little_endian 1.0\r\nelement chunk 1\r\n"
    header += "".join(f"property float {name}\r\n" for name in names) + "element vertex 1\r\n"
    header += "".join(f"property uint packed_{name}\r\n" for name in ("position", "rotation", "scale", "color"))
    chunk = struct.pack("<12f", -1.0, -1.0, -1.0, 1.0, 3.0, 5.0, -8.0, -8.0, -8.0, -2.0, -2.0, -2.0)
    position = 0 << 21 | 1023 << 11 | 2047
    # x is the largest (index 1); w, y, z follow in order.
    rotation = 1 << 30 | round((0.6 / 2**0.5 + 0.5) * 1023) << 20 | round(0.5 * 1023) << 10 | round(0.5 * 1023)
    scale = 2047 << 21 | 0 << 11 | 2047
    colour = 255 << 24 | 0 << 16 | 102 << 8 | 51
    vertex = struct.pack("<4I", position, rotation, scale, colour)
    (tmp_path / "a.ply").write_bytes(header.encode() + b"end_header\r\n" + chunk + vertex)
    cloud = read_capture(tmp_path / "a.ply", device="cpu").cloud
    np.testing.assert_array_equal(cloud.means.numpy(), [[-1.0, 3.0, 5.0]])
    np.testing.assert_allclose(cloud.rotations.numpy(), [[0.6, 0.8, 0.0, 0.0]], atol=1.5e-3)
    np.testing.assert_array_equal(cloud.log_scales.numpy(), [[-2.0, -8.0, -2.0]])
    np.testing.assert_allclose(0.5 + C0 * cloud.sh.numpy()[0, 0], [1.0, 0.0, 0.4], atol=1e-6)
    np.testing.assert_allclose(cloud.opacities(), [0.2], atol=1e-6)


def ply_text(cloud: GaussianCloud, *, kind: str, order: str, number: str) -> bytes:
    """The same Gaussians in an unusual but lawful .ply: shuffled properties, extra elements, other number types."""
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
    np.testing.assert_array_equal(capture.cloud.opacity_logits.numpy()[1:], [-16.0, 16.0])


# SOG variants -------------------------------------------------------------------------------------------------------


def webp(pixels: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(data, "WEBP", lossless=True, exact=True)
    return data.getvalue()


def test_sog_version_1_by_hand(tmp_path: Path) -> None:
    """Linear ranges; two Gaussians in images of 2 x 1; SH of degree 1 through a palette of 64."""
    folder = tmp_path / "old"
    folder.mkdir()
    palette = np.zeros((1, 192, 4))
    palette[0, 3 * 5 : 3 * 5 + 3, :3] = [[0, 255, 51], [102, 153, 204], [255, 0, 0]]
    images = {
        "means_l.webp": [[[0, 255, 0, 255], [255, 0, 0, 255]]],
        "means_u.webp": [[[0, 255, 0, 255], [255, 0, 128, 255]]],
        "quats.webp": [[[128, 128, 128, 252], [255, 128, 128, 255]]],
        "scales.webp": [[[0, 255, 51, 255], [0, 0, 0, 255]]],
        "sh0.webp": [[[0, 255, 51, 102], [0, 0, 0, 0]]],
        "c.webp": palette,
        "l.webp": [[[5, 0, 0, 255], [0, 0, 0, 255]]],
    }
    for name, pixels in images.items():
        (folder / name).write_bytes(webp(np.array(pixels)))
    ranges = {"mins": [-1.0, -2.0, -3.0], "maxs": [1.0, 2.0, 3.0]}
    meta = {
        "means": {"shape": [2, 3], "mins": [-1.0, 0.0, 0.0], "maxs": [1.0, 2.0, 1.0], "files": list(images)[:2]},
        "quats": {"files": ["quats.webp"]},
        "scales": {**ranges, "files": ["scales.webp"]},
        "sh0": {"mins": [0, 0, 0, -5], "maxs": [1, 1, 1, 5], "files": ["sh0.webp"]},
        "shN": {"mins": -1.0, "maxs": 1.0, "files": ["c.webp", "l.webp"]},
    }
    (folder / "meta.json").write_text(json.dumps(meta))
    # A folder that holds only the capture's folder will do as well.
    for place in (folder, tmp_path):
        capture = read_capture(place, device="cpu")
        cloud = capture.cloud
        assert capture.format == "SOG version 1"
        e = np.exp(1.0)
        z = np.expm1(128 * 256 / 65535)
        np.testing.assert_allclose(cloud.means.numpy(), [[1 - e, e**2 - 1, 0], [e - 1, 0, z]], rtol=1e-5, atol=1e-6)
        half = 0.5**0.5
        np.testing.assert_allclose(cloud.rotations.numpy(), [[1, 0, 0, 0], [half, 0, 0, half]], atol=6e-3)
        np.testing.assert_allclose(cloud.log_scales.numpy(), [[-1.0, 2.0, -1.8], [-1, -2, -3]], atol=1e-6)
        np.testing.assert_allclose(cloud.sh.numpy()[0, 0], [0.0, 1.0, 0.2], atol=1e-6)
        np.testing.assert_allclose(cloud.opacity_logits.numpy(), [-1.0, -5.0], atol=1e-6)
        np.testing.assert_allclose(cloud.sh.numpy()[0, 1:], [[-1, 1, -0.6], [-0.2, 0.2, 0.6], [1, -1, -1]], atol=1e-6)


def unzip(sog: Path, folder: Path) -> dict:
    with zipfile.ZipFile(sog) as archive:
        archive.extractall(folder)
    return json.loads((folder / "meta.json").read_text())


def test_sog_code_book_without_first_entry(tmp_path: Path) -> None:
    """An early writer left codebook[0] null; it lies one mean step below the second."""
    cloud = make_cloud(600)
    write_sog(tmp_path / "a.sog", cloud, keep_order=True)
    meta = unzip(tmp_path / "a.sog", tmp_path / "a")
    book = meta["scales"]["codebook"]
    book[0] = None
    (tmp_path / "a" / "meta.json").write_text(json.dumps(meta))
    read = read_capture(tmp_path / "a", device="cpu").cloud.log_scales.numpy()
    assert np.float32(book[1] - (book[255] - book[1]) / 255) == read.min()


def test_streamed_sog_reads_the_finest_level(tmp_path: Path) -> None:
    fine, other, coarse = make_cloud(50, 1, seed=1), make_cloud(30, seed=2), make_cloud(5, seed=3)
    for name, cloud in (("0_0", fine), ("0_1", other), ("1_0", coarse)):
        write_sog(tmp_path / f"{name}.sog", cloud, keep_order=True)
        unzip(tmp_path / f"{name}.sog", tmp_path / "streamed" / name)
    leaves = [
        {"lods": {"0": {"file": 0, "offset": 0, "count": 20}, "1": {"file": 2, "offset": 0, "count": 5}}},
        {"lods": {"0": {"file": 0, "offset": 20, "count": 30}}},
        {"children": [{"lods": {"0": {"file": 1, "offset": 10, "count": 20}}}]},
    ]
    tree = {
        "lodLevels": 2,
        "filenames": [f"{n}/meta.json" for n in ("0_0", "0_1", "1_0")],
        "tree": {"children": leaves},
    }
    (tmp_path / "streamed" / "lod-meta.json").write_text(json.dumps(tree))
    capture = read_capture(tmp_path / "streamed", device="cpu")
    expected = np.concatenate([fine.means.numpy(), other.means.numpy()[10:]])
    assert capture.cloud.count == 70 and capture.cloud.sh_degree == 1
    np.testing.assert_allclose(capture.cloud.means.numpy(), expected, atol=2e-4)
    assert not capture.cloud.sh.numpy()[50:, 1:].any()
    assert capture.notes == ("finest level of detail",)


def test_sequence_names(tmp_path: Path) -> None:
    """SuperSplat plays files whose names share a prefix and end in a number."""
    clouds = [make_cloud(10, seed=seed) for seed in range(3)]
    paths = write_ply_sequence(tmp_path / "new" / "folder", iter(clouds))
    assert [path.name for path in paths] == ["frame0001.ply", "frame0002.ply", "frame0003.ply"]
    for path, cloud in zip(paths, clouds, strict=True):
        assert_same_bits(read_capture(path, device="cpu").cloud, cloud)
    packed = write_ply_sequence(tmp_path, clouds, prefix="jump", compressed=True)
    assert re.fullmatch(r"jump0003\.compressed\.ply", packed[-1].name)
    assert read_capture(packed[-1], device="cpu").format == "compressed .ply"
