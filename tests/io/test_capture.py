"""Reading of real captures, and round trips through each format."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from egs_warp.assets import pawn
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io import (
    read_capture,
    write_compressed_ply,
    write_ply,
    write_ply_sequence,
    write_sog,
    write_splat,
    write_spz,
)
from tests.support.captures import ARRAYS, assert_same_bits, make_cloud


def angles_degrees(first: GaussianCloud, second: GaussianCloud) -> np.ndarray:
    """Return the angles (n,), degrees, between corresponding rotations of two clouds, by the arcsine, which is accurate
    for small angles."""
    p, q = first.rotations.numpy().astype(float), second.rotations.numpy().astype(float)
    p *= np.sign(np.einsum("ni,ni->n", p, q))[:, None]
    return np.degrees(4.0 * np.arcsin(np.linalg.norm(p - q, axis=1) / 2.0))


def test_parts_and_copies_of_a_capture_keep_the_facts_about_its_file(tmp_path: Path) -> None:
    """Parts and pickled copies of a capture keep the up direction, source and format of the file, and the rows of their
    Gaussians."""
    write_spz(tmp_path / "a.spz", make_cloud(50, 1))
    capture = read_capture(tmp_path / "a.spz", device="cpu")
    part = capture.subset(np.arange(10, 50)).subset(np.array([0, 3]))
    copy = pickle.loads(pickle.dumps(part))
    for one in (part, copy):
        np.testing.assert_array_equal(one.means.numpy(), capture.means.numpy()[[10, 13]])
        np.testing.assert_array_equal(one.up, [0, 1, 0])
        np.testing.assert_array_equal(one.rows, [10, 13])
        assert one.source == capture.source and one.format == capture.format


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
    """Counts and SH degrees agree with the README of the data; sizes and colours are plausible for a visible object."""
    capture = read_capture(data_dir / name, device="cpu")
    cloud = capture.cloud
    assert (capture.format, cloud.count, cloud.sh_degree, capture.infinite_opacities) == FILES[name]
    np.testing.assert_allclose(np.linalg.norm(cloud.rotations.numpy(), axis=1), 1.0, atol=1e-6)
    assert np.isfinite(cloud.opacity_logits.numpy()).all()
    extent = np.ptp(np.percentile(cloud.means.numpy(), [2, 98], axis=0), axis=0).max()
    sizes = np.exp(cloud.log_scales.numpy())
    assert 5e-4 < np.median(sizes.max(axis=1)) / extent < 0.05
    colours = 0.5 + SH_BAND_0 * cloud.sh.numpy()[:, 0]
    assert np.mean((colours > -0.2) & (colours < 1.2)) > 0.97
    # A Gaussian's size is similar to the distance to its neighbours only if scales and means were both decoded.
    distance = KDTree(cloud.means.numpy()).query(cloud.means.numpy()[::97], k=4)[0][:, 3]
    assert 0.2 < np.median(sizes.max(axis=1)[::97] / np.maximum(distance, 1e-9)) < 20.0
    if name.endswith(".spz"):
        np.testing.assert_array_equal(capture.up, [0.0, 1.0, 0.0])
    else:
        assert capture.up is None


@pytest.mark.data
def test_plush_dog_agrees_with_its_compressed_twin(data_dir: Path) -> None:
    """SuperSplat wrote the same capture in both layouts; all values agree to half a step of each packed number."""
    plain = read_capture(data_dir / "objects/plush_dog.ply", device="cpu").cloud
    packed = read_capture(data_dir / "objects/plush_dog.compressed.ply", device="cpu").cloud

    def features(cloud: GaussianCloud) -> np.ndarray:
        return np.concatenate([100.0 * cloud.means.numpy(), cloud.log_scales.numpy(), cloud.sh.numpy()[:, 0]], axis=1)

    order = np.asarray(KDTree(features(plain)).query(features(packed))[1], np.int64)
    assert len(np.unique(order)) == plain.count
    plain = plain.subset(order)
    chunk_of = np.arange(plain.count) // 256

    def half_steps(values: np.ndarray, bits: tuple[int, int, int]) -> np.ndarray:
        ranges = np.stack([np.ptp(values[chunk_of == chunk], axis=0) for chunk in range(chunk_of[-1] + 1)])
        return 0.5 * ranges[chunk_of] / (2.0 ** np.array(bits) - 1.0)

    for name, bits in (("means", (11, 10, 11)), ("log_scales", (11, 10, 11))):
        exact, read = getattr(plain, name).numpy(), getattr(packed, name).numpy()
        # This capture has no log scales outside SuperSplat's range of -20 to 20.
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
    """Quaternions are normalised once, so that copies keep their bits."""
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
    """In a capture with at most 256 different scales and colours, only the rotations are rounded."""
    cloud = read_capture(data_dir / name, device="cpu").cloud
    write_sog(tmp_path / "a.sog", cloud, keep_order=True)
    again = read_capture(tmp_path / "a.sog", device="cpu").cloud
    for array in ("means", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(again, array).numpy(), getattr(cloud, array).numpy(), rtol=1e-6, atol=1e-6)
    assert angles_degrees(cloud, again).max() < 1.0


# Lossy round trips --------------------------------------------------------------------------------------------------

WRITERS: dict[str, Callable[..., object]] = {
    "a.compressed.ply": lambda path, cloud: write_compressed_ply(path, cloud, keep_order=True),
    "a2.spz": lambda path, cloud: write_spz(path, cloud, version=2),
    "a3.spz": write_spz,
    "a4.spz": lambda path, cloud: write_spz(path, cloud, version=4),
    "a.splat": write_splat,
    "a.sog": lambda path, cloud: write_sog(path, cloud, keep_order=True),
}
# Maximum errors of means, log scales, rotations (degrees), colours of band 0 and higher SH bands, which are half a step
# of each grid.
TOLERANCES = {
    "a.compressed.ply": (0.5 * 4.0 / 1023.0, 0.5 * 7.0 / 1023.0, 0.25, 0.5 * 1.8 / 255.0, 1.0 / 64.0),
    "a2.spz": (2.0**-13, 1.0 / 32.0, 12.0, 0.5 / 255.0 / 0.15, 0.0625),
    "a3.spz": (2.0**-13, 1.0 / 32.0, 0.25, 0.5 / 255.0 / 0.15, 0.0625),
    "a4.spz": (2.0**-13, 1.0 / 32.0, 0.25, 0.5 / 255.0 / 0.15, 0.0625),
    "a.splat": (0.0, 1e-6, 1.0, 0.5 / 255.0 / SH_BAND_0, np.inf),
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
    # A second round trip changes nothing, because all values are on the grid.
    WRITERS[name](tmp_path / f"again.{name}", read)
    again = read_capture(tmp_path / f"again.{name}", device="cpu").cloud
    np.testing.assert_allclose(again.opacity_logits.numpy(), read.opacity_logits.numpy(), atol=1e-6)


@pytest.mark.parametrize("write", [write_compressed_ply, write_sog])
def test_sorted_in_space_holds_the_same_gaussians(write: Callable[..., None], tmp_path: Path) -> None:
    cloud = make_cloud(3000)
    for keep_order in (True, False):
        write(tmp_path / f"{keep_order}{'.sog' if write is write_sog else '.ply'}", cloud, keep_order=keep_order)
    kept, moved = (read_capture(path, device="cpu").cloud for path in sorted(tmp_path.iterdir(), reverse=True))
    distance, order = (np.asarray(found) for found in KDTree(moved.means.numpy()).query(cloud.means.numpy()))
    assert sorted(order) == list(range(3000))
    assert np.median(distance) < 1.2 * np.median(np.linalg.norm(kept.means.numpy() - cloud.means.numpy(), axis=1))
    neighbours = np.linalg.norm(np.diff(moved.means.numpy(), axis=0), axis=1)
    assert np.median(neighbours) < 0.3 * np.median(np.linalg.norm(np.diff(kept.means.numpy(), axis=0), axis=1))


def test_sog_with_more_sh_sets_than_the_palette_holds(tmp_path: Path) -> None:
    """70,000 Gaussians with similar coefficients of 300 kinds share 65,536 palette entries; the error of every
    coefficient is less than 0.01."""
    rng = np.random.default_rng(0)
    kinds = rng.uniform(-0.5, 0.5, (300, 4, 3))
    base = make_cloud(70_000)
    sh = kinds[rng.integers(0, 300, 70_000)] + rng.normal(scale=1e-4, size=(70_000, 4, 3))
    arrays = [getattr(base, name).numpy() for name in ARRAYS[:4]]
    cloud = GaussianCloud.from_numpy(*arrays, sh=sh, device="cpu")
    write_sog(tmp_path / "a.sog", cloud, keep_order=True)
    read = read_capture(tmp_path / "a.sog", device="cpu").cloud
    assert np.abs(read.sh.numpy() - cloud.sh.numpy())[:, 1:].max() < 0.01


def test_sequence_names(tmp_path: Path) -> None:
    """SuperSplat plays files whose names have a common prefix and end in a number."""
    clouds = [make_cloud(10, seed=seed) for seed in range(3)]
    paths = write_ply_sequence(tmp_path / "new" / "folder", iter(clouds))
    assert [path.name for path in paths] == ["frame0001.ply", "frame0002.ply", "frame0003.ply"]
    for path, cloud in zip(paths, clouds, strict=True):
        assert_same_bits(read_capture(path, device="cpu").cloud, cloud)
    packed = write_ply_sequence(tmp_path, clouds, prefix="jump", compressed=True)
    assert re.fullmatch(r"jump0003\.compressed\.ply", packed[-1].name)
    assert read_capture(packed[-1], device="cpu").format == "compressed .ply"


@pytest.mark.parametrize("first", [b"{", b"PK", b"\x1f\x8b"])
def test_a_splat_may_begin_with_any_coordinate(tmp_path: Path, first: bytes) -> None:
    """The format has no magic number, so one of 256 files begins with the first byte of JSON, for example."""
    write_splat(tmp_path / "a.splat", pawn(gaussian_count=50, device="cpu").cloud)
    data = (tmp_path / "a.splat").read_bytes()
    (tmp_path / "a.splat").write_bytes(first + data[len(first) :])
    capture = read_capture(tmp_path / "a.splat", device="cpu")
    assert capture.format == ".splat" and capture.cloud.count == len(data) // 32
