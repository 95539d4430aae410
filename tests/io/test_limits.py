"""Small files that declare large contents are rejected before memory is allocated."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io import read_cameras, read_capture
from egs_warp.io.cameras import PosedImage
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes
from egs_warp.io.photos import read_photo
from egs_warp.io.planes import read_planes
from egs_warp.io.writing import WRITERS, writer_of
from egs_warp.pipelines.object_selection import read_mask
from tests.support.captures import good_bytes, message, written
from tests.support.memory import megabytes_of

HUGE = (13_300, 13_300)
"""Width and height of an image of 177 megapixels, just below Pillow's own limit."""


read_on_cpu = partial(read_capture, device="cpu")


def members(name: str = "a.sog") -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(good_bytes(name))) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(files: dict[str, bytes]) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return data.getvalue()


def large_png(path: Path, size: tuple[int, int] = HUGE) -> Path:
    Image.new("1", size).save(path)
    return path


def test_pictures_larger_than_the_gaussians_need(tmp_path: Path) -> None:
    """A small .sog file whose images have 33.6 megapixels each is refused, because its 7 Gaussians need fewer
    pixels."""
    data = io.BytesIO()
    Image.new("RGBA", (8192, 4096)).save(data, "WEBP", lossless=True)
    files = members()
    files |= {name: data.getvalue() for name in files if name.endswith(".webp")}
    path = written(tmp_path / "a.sog", zipped(files))
    assert message(path) == (
        "means_l.webp has 8192 x 4096 pixels; the limits are 32768 a side and 4110 in all; make it smaller"
    )
    assert megabytes_of(read_on_cpu, path) < 16


def test_more_gaussians_than_the_images_can_hold(tmp_path: Path) -> None:
    files = members()
    meta = json.loads(files["meta.json"])
    meta["count"] = 33_554_432
    files["meta.json"] = json.dumps(meta).encode()
    size = len(files["means_l.webp"]) + len(files["means_u.webp"])
    assert message(written(tmp_path / "a.sog", zipped(files))) == (
        f"it declares 33554432 Gaussians, more than its {size} bytes can hold; copy or export it again"
    )


def test_unrequested_zip_members_are_not_inflated(tmp_path: Path) -> None:
    path = written(tmp_path / "a.sog", zipped(members() | {"ballast": bytes(200 << 20)}))
    assert read_capture(path, device="cpu").cloud.count == 7
    named = members()
    named["means_l.webp"] += bytes(64 << 20)
    path = written(tmp_path / "b.sog", zipped(named))
    assert "means_l.webp inflates from" in message(path)
    assert megabytes_of(read_on_cpu, path) < 16
    path = written(tmp_path / "c.sog", zipped(members() | {"meta.json": bytes(MAX_TEXT_BYTES + 1)}))
    assert "meta.json inflates from" in message(path)


def test_a_small_spz_of_many_gaussians(tmp_path: Path) -> None:
    count = 50_000_000
    header = struct.pack("<IIIBBBB", 0x5053474E, 2, count, 0, 12, 0, 0)
    path = written(tmp_path / "a.spz", gzip.compress(header + bytes(20 << 20)))
    assert message(path).startswith(f"it declares {count} Gaussians, more than its ")
    assert megabytes_of(read_on_cpu, path) < 16


def test_positions_without_an_integer_part(tmp_path: Path) -> None:
    """A .spz with 255 fractional bits, which would map all means to one point, is refused."""
    body = bytearray(gzip.decompress(good_bytes("a.spz")))
    body[13] = 255
    assert message(written(tmp_path / "a.spz", gzip.compress(bytes(body)))) == (
        "the .spz has 255 fractional bits, but a position has 24 bits; export it again"
    )


@pytest.mark.parametrize(
    ("leaves", "said"),
    [
        (20_000, "leaves of part/meta.json overlap in lod-meta.json; export the capture again"),
        (1, None),
    ],
)
def test_leaves_that_overlap(leaves: int, said: str | None, tmp_path: Path) -> None:
    leaf = {"lods": {"0": {"file": 0, "offset": 0, "count": 7}}}
    meta = {"lodLevels": 1, "filenames": ["part/meta.json"], "tree": {"children": [leaf] * leaves}}
    files = {f"part/{name}": data for name, data in members().items()}
    path = written(tmp_path / "a.sog", zipped(files | {"lod-meta.json": json.dumps(meta).encode()}))
    if said is None:
        assert read_capture(path, device="cpu").cloud.count == 7
    else:
        assert message(path) == said


def test_odd_trees(tmp_path: Path) -> None:
    files = {f"part/{name}": data for name, data in members().items()}
    for names, level, said in (
        (["part/meta.json", "./part/meta.json"], "0", "lod-meta.json names a file twice; export the capture again"),
        (["part/meta.json"], "9" * 5000, "it has no Gaussians; export it again from the tool that made it"),
    ):
        tree = {"lods": {level: {"file": 0, "offset": 0, "count": 7}}}
        meta = {"lodLevels": 1, "filenames": names, "tree": tree}
        path = written(tmp_path / "a.sog", zipped(files | {"lod-meta.json": json.dumps(meta).encode()}))
        assert message(path) == said


def test_masks_are_measured_before_they_are_decoded(tmp_path: Path) -> None:
    path = large_png(tmp_path / "mask.png", (14_000, 14_000))
    with pytest.raises(UserError, match=r"mask\.png: it has more than 178956970 pixels; make it smaller"):
        read_mask(path)
    assert megabytes_of(read_mask, path) < 16


def test_a_mask_of_a_photo_is_measured_first(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    Image.new("RGB", (40, 30)).save(tmp_path / "images" / "a.png")
    large_png(tmp_path / "masks" / "a.png")
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(3), np.zeros(3))
    with pytest.raises(UserError, match="13300 x 13300 pixels, but its photo has 40 x 30"):
        read_photo(PosedImage("a.png", camera, tmp_path / "images" / "a.png", mask=tmp_path / "masks" / "a.png"))
    # This mask has the aspect ratio of the photo, but too many pixels.
    large_png(tmp_path / "masks" / "a.png", (13_200, 9_900))
    with pytest.raises(UserError, match="13200 x 9900 pixels; the limits are 32768 a side and 307200 in all; make it"):
        read_photo(PosedImage("a.png", camera, tmp_path / "images" / "a.png", mask=tmp_path / "masks" / "a.png"))


def test_cameras_of_no_photo(tmp_path: Path) -> None:
    entry = {
        **{"img_name": "a", "width": 640, "height": 480, "fx": 600.0, "fy": 600.0},
        **{"position": [0.0, 0.0, 0.0], "rotation": np.eye(3).tolist()},
    }
    for change, said in (
        ({"width": 100_000}, "camera 0 has 100000 x 480 pixels; the limits are 32768 a side"),
        ({"width": 32_768, "height": 32_768}, "the limits are 32768 a side and 178956970 in all"),
        ({"fx": 1e-300}, "fit no photo of 640 x 480 pixels"),
        ({"fy": 1e9}, "fit no photo of 640 x 480 pixels"),
        ({"position": [1e30, 0.0, 0.0]}, "it lies more than 1e\\+12 units from the origin"),
        ({"width": int("9" * 400)}, "width inf is not a finite number"),
    ):
        (tmp_path / "cameras.json").write_text(json.dumps([entry | change]))
        with pytest.raises(UserError, match=said):
            read_cameras(tmp_path / "cameras.json")


@pytest.mark.parametrize("name", ["../secret.png", "/secret.png", "a/../../secret.png"])
def test_photos_outside_of_the_folder_are_not_looked_for(name: str, tmp_path: Path) -> None:
    """The result does not depend on whether a photo outside the folder exists."""
    folder = tmp_path / "poses"
    folder.mkdir()
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    photo = name.replace("/secret", f"{tmp_path}/secret") if name[0] == "/" else name
    frame = {"file_path": photo, "transform_matrix": np.eye(4).tolist()}
    (folder / "transforms.json").write_text(json.dumps({"w": 4, "h": 4, "fl_x": 4.0, "frames": [frame]}))
    posed = read_cameras(folder)[0]
    assert posed.image is None
    with pytest.raises(UserError, match="the photo is not beside the poses; put it there"):
        read_photo(posed)


def test_a_pipe_does_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    assert message(tmp_path / "pipe.ply") == "not a regular file; give a file"
    with pytest.raises(UserError, match=r"pipe\.ply: not a regular file; give a file"):
        read_mask(tmp_path / "pipe.ply")


def test_texts_have_a_largest_size(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    with open(path, "wb") as file:
        file.truncate(MAX_TEXT_BYTES + 1)
    with pytest.raises(UserError, match=r"the file has 33554433 bytes, the limit is 33554432; give a smaller one"):
        read_cameras(path)
    assert len(read_bytes(path)) == MAX_TEXT_BYTES + 1


HOLE = {"centre": [0, 0, 0], "texel": 0.1, "texels": [20, 20], "outlines": [[[1, 1], [5, 1], [5, 5]]]}


@pytest.mark.parametrize(
    "change",
    [
        {"texels": [10**400, 20]},
        {"texels": [300_000, 200_000]},
        {"texels": [-1, 20]},
        {"texel": float("nan")},
        {"texel": 0.0},
        {"centre": [0, 0, float("inf")]},
        {"outlines": [[[1, 1], [50, 1]]]},
        {"outlines": [[[10**30, 1]]]},
        {"outlines": 3},
    ],
)
def test_holes_that_are_none(change: dict, tmp_path: Path) -> None:
    def planes(hole: dict) -> str:
        return json.dumps({"planes": [{"normal": [0, 0, 1], "offset": 0, "hole": hole}]})

    path = tmp_path / "plane.json"
    path.write_text(planes(HOLE))
    assert read_planes(path)[0].hole is not None
    path.write_text(planes(HOLE | change))
    with pytest.raises(UserError, match=r"its hole is not valid; write the file again with egs-warp segment"):
        read_planes(path)


def test_a_text_ply_needs_little_more_memory_than_its_numbers(tmp_path: Path) -> None:
    """The file has two million short lines and is not a capture."""
    header = b"ply\nformat ascii 1.0\nelement other 2000000\nproperty float x\nelement vertex 1\n"
    names = ["x", "y", "z", "opacity", *(f"rot_{i}" for i in range(4)), *(f"scale_{i}" for i in range(3))]
    names += [f"f_dc_{i}" for i in range(3)]
    header += "".join(f"property float {name}\n" for name in names).encode() + b"end_header\n"
    path = written(tmp_path / "a.ply", header + b"1\n" * 2_000_000)
    assert message(path).startswith("truncated: element vertex needs 1 lines, found 0")
    assert megabytes_of(read_on_cpu, path) < 4 * 4 + 16


@pytest.mark.parametrize("ending", [write.ending for write in WRITERS.values()])
def test_memory_to_read_a_valid_capture_is_bounded(tmp_path: Path, ending: str) -> None:
    """The limit is four times the size of the file plus six times the size of the cloud, which has 14 single-precision
    numbers per Gaussian. Packed formats are decoded in double precision."""
    count = 200_000
    random = np.random.default_rng(0)
    cloud = GaussianCloud.from_numpy(
        random.normal(size=(count, 3)),
        random.normal(size=(count, 4)),
        random.uniform(-6.0, -3.0, (count, 3)),
        random.normal(size=count),
        random.normal(size=(count, 1, 3)),
        device="cpu",
    )
    path = tmp_path / f"a{ending}"
    writer_of(path)(path, cloud)
    room = (4 * path.stat().st_size + 6 * count * 14 * 4) / 2**20
    assert 2.0 < megabytes_of(read_on_cpu, path) < room


def test_two_elements_of_one_name(tmp_path: Path) -> None:
    data = good_bytes("a.ply").replace(b"element vertex 7\n", b"element vertex 1\nproperty float x\nelement vertex 7\n")
    assert message(written(tmp_path / "a.ply", data)) == (
        "malformed .ply header, an element occurs twice; export the file again"
    )
