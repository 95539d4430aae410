"""Files of picked objects."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.picked import PickedFile, PickedObject, read_picked, write_picked
from egs_warp.io.planes import PlaneRecord
from tests.support.scenes import ball_on_floor


def picked(count: int) -> PickedFile:
    """Return two objects among ``count`` Gaussians."""
    plane = PlaneRecord(Plane(np.array([0.0, 0.6, 0.8]), -0.25))
    masks = np.random.default_rng(0).random((2, count)) < 0.3
    front = np.array([0.0, 0.8, -0.6])
    return PickedFile(
        "ball.ply", (PickedObject("a toy", masks[0], plane, front), PickedObject("b", masks[1], plane)), 1
    )


@pytest.fixture(scope="module")
def cloud() -> GaussianCloud:
    """Return a ball on a floor."""
    return ball_on_floor()[0]


@pytest.fixture
def written(tmp_path: Path, cloud: GaussianCloud) -> Path:
    """Write a file of picked objects and return its path."""
    path = tmp_path / "picked.json"
    write_picked(path, picked(cloud.count), cloud)
    return path


def test_a_file_is_read_as_it_was_written(written: Path, cloud: GaussianCloud):
    expected, result = picked(cloud.count), read_picked(written, cloud)
    assert (result.capture, result.selected) == ("ball.ply", 1)
    for one, other in zip(result.objects, expected.objects, strict=True):
        assert one.name == other.name
        assert np.array_equal(one.gaussians, other.gaussians)
        assert np.array_equal(one.plane.plane.normal, other.plane.plane.normal)
        assert one.plane.plane.offset == other.plane.plane.offset
    first, second = result.objects
    assert first.front == pytest.approx([0.0, 0.8, -0.6]) and second.front is None
    assert result.named(None, written) is second and result.named("a toy", written) is first
    with pytest.raises(UserError, match=r"it has no object 'a tay' \(did you mean 'a toy'\?\); it has a toy, b"):
        result.named("a tay", written)


def test_equal_objects_give_equal_bytes(written: Path, cloud: GaussianCloud):
    before = written.read_bytes()
    write_picked(written, picked(cloud.count), cloud)
    assert written.read_bytes() == before


def with_object(**changes: Any) -> Callable[[dict[str, Any]], None]:
    """Return a function that changes entries of the first object."""

    def change(tree: dict[str, Any]) -> None:
        for name, value in changes.items():
            if value is None:
                del tree["objects"][0][name]
            else:
                tree["objects"][0][name] = value

    return change


def packed(data: bytes) -> str:
    """Return ``data`` in the encoding of the file."""
    return base64.b64encode(zlib.compress(data)).decode()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tree: tree.pop("objects"), "not a file of egs-warp pick: it has no capture and objects"),
        (lambda tree: tree.update(version=2), "version 2 is unknown; pick the object again with egs-warp pick"),
        (lambda tree: tree.update(objects=[]), "it has no objects"),
        (lambda tree: tree.update(selected=2), "selected must be a number from 0 to 1; correct it"),
        (lambda tree: tree.update(capture=3), "its capture needs name, gaussians and sha256"),
        (
            lambda tree: tree["capture"].update(gaussians=12),
            r"it belongs to another capture, ball.ply of 12 Gaussians, and this one has \d+; give that capture",
        ),
        (lambda tree: tree["capture"].update(sha256="0"), "it belongs to another capture"),
        (with_object(plane=None), "object 1 needs name, plane and gaussians"),
        (with_object(name=""), "object 1 needs a name of 1 to 60 characters; correct it"),
        (with_object(plane={"normal": [0, 0, 0], "offset": 0}), "give four finite numbers"),
        (with_object(front=[0, 0, 0]), "the front of 'a toy' must be three numbers, not all zero; correct it"),
        (with_object(front="ahead"), "the front of 'a toy' must be three numbers"),
        (with_object(gaussians="%"), "the Gaussians of 'a toy' are damaged; pick the object again"),
        (with_object(gaussians=packed(b"abc")), r"the Gaussians of 'a toy' are damaged: they are not \d+ bits"),
        (with_object(gaussians=packed(bytes(1 << 24))), r"damaged: they are not \d+ bits"),
        (with_object(gaussians=7), "the Gaussians of 'a toy' are damaged"),
    ],
)
def test_a_damaged_file_gives_one_clear_line(
    written: Path, cloud: GaussianCloud, change: Callable[[dict[str, Any]], None], message: str
):
    tree = json.loads(written.read_text())
    change(tree)
    written.write_text(json.dumps(tree))
    with pytest.raises(UserError, match=message) as caught:
        read_picked(written, cloud)
    assert "\n" not in str(caught.value)


def test_an_object_without_gaussians_and_a_missing_file_are_reported(written: Path, cloud: GaussianCloud):
    tree = json.loads(written.read_text())
    tree["objects"][0]["gaussians"] = packed(bytes(-(-cloud.count // 8)))
    written.write_text(json.dumps(tree))
    with pytest.raises(UserError, match="'a toy' has no Gaussians"):
        read_picked(written, cloud)
    with pytest.raises(UserError, match="make it with egs-warp pick"):
        read_picked(written.with_name("absent.json"), cloud)
    written.write_text("{")
    with pytest.raises(UserError, match="not JSON at line 1"):
        read_picked(written, cloud)
