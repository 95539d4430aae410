"""Variants of SOG: zipped, as a folder and streamed, with a one-line error for each mistake."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egs_warp.errors import UserError
from egs_warp.io import read_capture, write_sog
from tests.support.captures import good_bytes, make_cloud, message, small_cloud, written


@pytest.fixture
def sog_folder(tmp_path: Path) -> Path:
    write_sog(tmp_path / "a.sog", small_cloud())
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "a")
    return tmp_path / "a"


def webp(pixels: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(data, "WEBP", lossless=True, exact=True)
    return data.getvalue()


def test_sog_version_1_by_hand(tmp_path: Path) -> None:
    """The file has two Gaussians in images of 2 x 1 pixels with linear ranges, and SH of degree 1 in a palette of 64
    entries."""
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
    # A folder whose only content is the folder of the capture is accepted, too.
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
    """An early writer left the first entry of the code book null; it is read as one mean step below the second
    entry."""
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


def test_bad_zip(tmp_path: Path) -> None:
    data = good_bytes("a.sog")
    assert message(written(tmp_path / "a.sog", data[: len(data) // 2])).startswith("corrupted zip (")
    with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
        archive.writestr("a.txt", "hello")
    assert message(tmp_path / "b.sog").startswith("the zip has no meta.json; give a .sog")
    with zipfile.ZipFile(tmp_path / "c.sog", "w") as archive:
        archive.writestr("inner/meta.json", json.dumps({"version": 2, "count": 1, "means": {"files": ["a", "b"]}}))
    assert message(tmp_path / "c.sog") == "inner/a is missing from the zip; copy or export the file again"


@pytest.mark.parametrize(
    ("keys", "value", "expected"),
    [
        (("version",), 3, "SOG version 3, expected 1 or 2; export it as version 2 or as .ply"),
        (("count",), 10, "truncated: 10 Gaussians, but means_l.webp has 9 pixels; export it again"),
        (("count",), -1, "count in meta.json is not an integer of at least 0; export the capture again"),
        (("means", "mins"), [0, 1], "means.mins in meta.json is not 3 finite numbers; export the capture again"),
        (("means", "maxs"), [0, 1, float("nan")], "means.maxs in meta.json is not 3 finite numbers"),
        (("means", "files"), ["../../x", "y"], "meta.json names '../../x', which lies outside the capture"),
        (("quats", "files"), "quats.webp", "quats.files in meta.json is not 1 file names"),
        (("scales", "codebook"), [1.0] * 255, "scales.codebook in meta.json is not 256 finite numbers"),
        (("shN", "bands"), 2, "shN_centroids.webp is 192 pixels wide, expected 192, 512, 960 or 1536"),
        (("sh0", "files"), ["meta.json"], "meta.json is not a readable image; export the capture again"),
    ],
)
def test_bad_sog_meta(keys: tuple[str, ...], value: object, expected: str, sog_folder: Path) -> None:
    path = sog_folder / "meta.json"
    meta = json.loads(path.read_text())
    entry = meta
    for key in keys[:-1]:
        entry = entry[key]
    entry[keys[-1]] = value
    path.write_text(json.dumps(meta))
    with pytest.raises(UserError) as caught:
        read_capture(sog_folder, device="cpu")
    assert str(caught.value).startswith(f"{path}: {expected}")


def test_sog_without_an_image_or_with_half_of_one(sog_folder: Path) -> None:
    image = sog_folder / "quats.webp"
    data = image.read_bytes()
    image.write_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match=r"meta\.json: quats\.webp is not a readable image; export the capture again"):
        read_capture(sog_folder, device="cpu")
    image.unlink()
    with pytest.raises(UserError, match=r"quats\.webp: no such file or folder; check the path"):
        read_capture(sog_folder, device="cpu")


def test_bad_json(tmp_path: Path) -> None:
    for text in ("{", "{" * 100, '{"a":' * 100_000, "{\xff"):
        path = written(tmp_path / "meta.json", text.encode("latin-1"))
        assert message(path) == "meta.json is not readable JSON; copy or export the capture again"


@pytest.mark.parametrize(
    ("tree", "expected"),
    [
        (
            {"lods": {"0": {"file": 4, "offset": 0, "count": 1}}},
            "lod-meta.json refers to file 4, counted from 0, but lists only 1",
        ),
        ({"lods": {"0": {"file": 0, "offset": -1, "count": 1}}}, "malformed leaf in lod-meta.json"),
        ({"children": 5}, "malformed tree in lod-meta.json"),
        ({"children": [[]]}, "malformed tree in lod-meta.json"),
        (
            {"lods": {"0": {"file": 0, "offset": 4, "count": 4}}},
            "truncated: a/meta.json has 7 Gaussians, expected at least 8",
        ),
        ({"lods": {}}, "it has no Gaussians"),
    ],
)
def test_bad_streamed_sog(tree: dict, expected: str, sog_folder: Path) -> None:
    path = sog_folder.parent / "lod-meta.json"
    path.write_text(json.dumps({"lodLevels": 1, "filenames": ["a/meta.json"], "tree": tree}))
    assert message(path).startswith(expected)
