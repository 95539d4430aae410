"""Outliers among the Gaussians of a capture, which are left out and reported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io import read_capture, write_ply
from tests.support.captures import assert_same_bits, make_cloud, message

GOOD = make_cloud(50, 1)
_CHANGED = ("means", "log_scales", "opacity_logits", "rotations")


def spoiled(path: Path, rows: slice | list[int], *, sh: float = 0.0, **values: float) -> Path:
    """Write ``GOOD`` with the values of some rows replaced."""
    arrays = {
        name: getattr(GOOD, name).numpy().copy() for name in ("means", "log_scales", "opacity_logits", "rotations")
    }
    for name, value in values.items():
        arrays[name][rows] = value
    coefficients = GOOD.sh.numpy().copy()
    coefficients[rows, -1] += np.float32(sh)
    write_ply(path, unchecked(arrays | {"sh": coefficients}))
    return path


def unchecked(arrays: dict[str, np.ndarray]) -> GaussianCloud:
    """Return a cloud without the checks of ``GaussianCloud.from_numpy``."""
    kinds = {name: getattr(GOOD, name).dtype for name in arrays}
    made: dict[str, Any] = {name: wp.array(value, dtype=kinds[name], device="cpu") for name, value in arrays.items()}
    return GaussianCloud(**made)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"means": 1e19}, "lie more than 10000 sizes of the capture away"),
        ({"means": 3e38}, "lie more than 10000 sizes of the capture away"),
        ({"means": 1e6}, "lie more than 10000 sizes of the capture away"),
        ({"log_scales": 60.0}, "are larger than 100 sizes of the capture"),
        ({"log_scales": 8.0}, "are larger than 100 sizes of the capture"),
        ({"log_scales": 3e38}, "are larger than 100 sizes of the capture"),
        ({"sh": 1e6}, "have a colour beyond 1000"),
        (
            {"means": 1e19, "log_scales": 60.0},
            "lie more than 10000 sizes of the capture away or are larger than 100 sizes of the capture",
        ),
    ],
)
def test_outliers_are_left_out_and_reported(values: dict[str, float], said: str, tmp_path: Path) -> None:
    capture = read_capture(spoiled(tmp_path / "a.ply", [3, 7, 11, 20], **values), device="cpu")
    rest = np.ones(50, bool)
    rest[[3, 7, 11, 20]] = False
    assert_same_bits(capture.cloud, GOOD.subset(rest))
    assert capture.notes[0].startswith(
        f"left out 4 Gaussians that {said} (number 3, 7, 11, ...; the capture's size is "
    )


def test_a_capture_of_outliers_is_refused(tmp_path: Path) -> None:
    path = spoiled(tmp_path / "a.ply", slice(0, 30), sh=1e6)
    assert message(path) == "30 of 50 Gaussians have a colour beyond 1000; export it again"
    path = spoiled(tmp_path / "a.ply", slice(0, 50), means=3e38)
    assert message(path) == "it extends 3e+38 units from the origin, the limit is 1e+12; export it again"
    path = spoiled(tmp_path / "a.ply", slice(0, 50), log_scales=200.0)
    assert message(path).startswith("it extends 7.23e+86 units from the origin")


def test_values_beyond_single_precision_are_reported(tmp_path: Path) -> None:
    path = spoiled(tmp_path / "a.ply", [5, 6], log_scales=-3e38, opacity_logits=-1e30)
    capture = read_capture(path, device="cpu")
    assert capture.notes == (
        "2 Gaussians with a log scale below -100 read with that value",
        "2 infinite opacities were read as 0 or 1",
    )
    assert capture.infinite_opacities == 2
    assert (capture.cloud.log_scales.numpy()[[5, 6]] == -100.0).all()
    assert (capture.cloud.opacity_logits.numpy()[[5, 6]] == -16.0).all()


def test_a_wide_capture_keeps_its_sky(tmp_path: Path) -> None:
    """The Gaussians of a sky are as large as the scene, and hundreds of times its size away."""
    path = spoiled(tmp_path / "a.ply", [1, 2], means=800.0, log_scales=3.0)
    capture = read_capture(path, device="cpu")
    assert capture.cloud.count == 50 and capture.notes == ()


def test_few_gaussians_and_flat_captures_have_no_outliers(tmp_path: Path) -> None:
    for cloud in (make_cloud(1), make_cloud(2), make_cloud(3)):
        write_ply(tmp_path / "a.ply", cloud)
        assert_same_bits(read_capture(tmp_path / "a.ply", device="cpu").cloud, cloud)
    one_place = spoiled(tmp_path / "a.ply", slice(0, 50), means=0.0)
    assert read_capture(one_place, device="cpu").cloud.count == 50


def test_bounds_do_not_depend_on_the_order_or_the_unit(tmp_path: Path) -> None:
    cloud = read_capture(spoiled(tmp_path / "a.ply", [3], means=1e6), device="cpu").cloud
    for factor in (1e-3, 1e3):
        write_ply(tmp_path / "b.ply", read_all(spoiled(tmp_path / "a.ply", [3], means=1e6)).scaled(factor))
        assert read_capture(tmp_path / "b.ply", device="cpu").cloud.count == cloud.count == 49


def read_all(path: Path) -> GaussianCloud:
    """Return all Gaussians of the file, without removing outliers."""
    from egs_warp.io.ply import decode_ply, read_header

    data = path.read_bytes()
    raw = decode_ply(data, read_header(data, path), path)
    return GaussianCloud.from_numpy(raw.means, raw.rotations, raw.log_scales, raw.opacity_logits, raw.sh, device="cpu")
