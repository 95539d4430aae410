"""Positions of georeferenced captures, in memory and after round trips through files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.io import read_capture, write_ply
from egs_warp.io.glb import write_glb
from egs_warp.io.origin import relative_positions
from tests.support.captures import make_cloud

_PLACE = np.array([431000.0, 5403000.0, 120.0])


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_far_positions_in_double_precision_keep_their_shape(size: float) -> None:
    means = _PLACE + np.random.default_rng(0).uniform(-size, size, (500, 3))
    relative, origin, (note,) = relative_positions(means)
    assert origin is not None and np.abs(origin - _PLACE).max() < size
    assert np.abs(relative + origin - means).max() < 1e-7 * size + 1e-9
    assert note.startswith("positions are relative to ") and "steps of 0.5 units" in note


def test_near_positions_have_no_origin() -> None:
    means = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3)) + 3.0
    relative, origin, (note,) = relative_positions(means)
    assert origin is None and np.array_equal(relative, means.astype(np.float32))
    assert note == "positions were rounded to single precision, by at most 1.2e-07 units"
    exact, origin, notes = relative_positions(relative)
    assert origin is None and notes == () and np.array_equal(exact, relative)


def test_positions_that_were_cut_before_are_reported() -> None:
    means = (_PLACE + np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3))).astype(np.float32)
    relative, origin, (note,) = relative_positions(means)
    assert origin is None and np.array_equal(relative, means)
    assert note.startswith("positions lie in steps of 0.5 units, ") and "export it with an offset" in note


def test_all_at_one_point() -> None:
    _, origin, notes = relative_positions(np.tile(_PLACE + 0.1, (10, 1)))
    assert origin is None and len(notes) == 1


def test_files_with_a_place_for_the_offset_keep_it(tmp_path: Path) -> None:
    """A .ply keeps the offset in positions of double precision, a .glb in the translation of its node."""
    cloud = make_cloud(200, 1)
    write_ply(tmp_path / "a.ply", cloud, origin=_PLACE)
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert b"property double x\nproperty double y\nproperty double z\nproperty float nx\n" in header
    first = np.frombuffer(body, "<f8", 3)
    np.testing.assert_array_equal(first, cloud.means.numpy()[0].astype(float) + _PLACE)
    write_glb(tmp_path / "a.glb", cloud, origin=_PLACE)
    for name in ("a.ply", "a.glb"):
        capture = read_capture(tmp_path / name, device="cpu")
        assert capture.origin is not None
        np.testing.assert_allclose(
            capture.cloud.means.numpy() + capture.origin, cloud.means.numpy() + _PLACE, rtol=0, atol=2e-7
        )
        np.testing.assert_array_equal(capture.cloud.sh.numpy(), cloud.sh.numpy())


def test_captures_beside_each_other_share_an_origin(tmp_path: Path) -> None:
    """The positions of an object and of its background are relative to different origins; those of one are converted to
    the origin of the other."""
    cloud = make_cloud(200, 1)
    write_ply(tmp_path / "object.ply", cloud, origin=_PLACE)
    write_ply(tmp_path / "background.ply", cloud, origin=_PLACE + [40.0, 30.0, 0.0])
    write_ply(tmp_path / "near.ply", cloud)
    thing, background, near = (
        read_capture(tmp_path / f"{name}.ply", device="cpu") for name in ("object", "background", "near")
    )
    assert thing.origin is not None and background.origin is not None and (thing.origin != background.origin).any()
    steps = background.cloud_aligned_with(thing).means.numpy() - thing.means.numpy()
    np.testing.assert_allclose(steps, np.tile([40.0, 30.0, 0.0], (200, 1)), atol=1e-5)
    # Parts that ``egs-warp segment`` wrote have no origin, but belong to a capture that has one.
    np.testing.assert_array_equal(near.cloud_aligned_with(thing).means.numpy(), near.means.numpy())


def test_what_a_ply_holds_besides_is_reported(tmp_path: Path) -> None:
    """The report names double-precision values that single precision cannot represent, and properties and elements that
    are not read."""
    write_ply(tmp_path / "a.ply", make_cloud(3))
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(3, -1)
    header = header.replace(b"float opacity", b"double opacity") + b"property float confidence\nelement camera 1\n"
    data = b"".join(
        row[:9].tobytes() + np.array([0.1 + k], "<f8").tobytes() + row[10:].tobytes() + b"\0\0\0\0"
        for k, row in enumerate(rows)
    )
    (tmp_path / "b.ply").write_bytes(header + b"property float fov\nend_header\n" + data + b"\0\0\0\0")
    capture = read_capture(tmp_path / "b.ply", device="cpu")
    assert capture.notes == (
        "rounded to single precision: opacity",
        "properties left out: confidence",
        "elements left out: camera",
    )
    np.testing.assert_allclose(capture.cloud.opacity_logits.numpy(), [0.1, 1.1, 2.1], rtol=1e-7)
