"""Photo files that are rotated by an EXIF tag, resized or truncated, with masks in either orientation."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.lens import Lens
from egs_warp.io.cameras import PosedImage
from egs_warp.io.limits import picture_size
from egs_warp.io.orientation import apply_orientation, orientation
from egs_warp.io.photos import decoded, read_photo

# All corners of the image differ, and it is smooth enough for JPEG.
ROWS, COLUMNS = np.mgrid[:40, :60]
PICTURE = np.stack([4 * COLUMNS, 6 * ROWS, 255 - 2 * COLUMNS - 3 * ROWS], axis=-1).astype(np.uint8)


def camera(width: int, height: int) -> Camera:
    return Camera(width, height, 50.0, 50.0, width / 2, height / 2, np.eye(3), np.zeros(3))


def saved(path: Path, pixels: np.ndarray, turn: int = 1) -> Path:
    exif = Image.Exif()
    exif[0x0112] = turn
    Image.fromarray(pixels).save(path, exif=exif, quality=100)
    return path


@pytest.mark.parametrize("turn", range(1, 9))
def test_turns_are_pillows(turn: int, tmp_path: Path) -> None:
    path = saved(tmp_path / "a.png", PICTURE, turn)
    assert orientation(path) == turn
    with Image.open(path) as opened:
        expected = np.asarray(ImageOps.exif_transpose(opened))
    np.testing.assert_array_equal(apply_orientation(PICTURE, turn), expected)


@pytest.mark.parametrize("turn", [5, 6, 7, 8])
def test_pixels_are_turned_only_where_that_fits_the_camera(turn: int, tmp_path: Path) -> None:
    path = saved(tmp_path / "a.png", PICTURE, turn)
    as_stored = read_photo(PosedImage("a.png", camera(60, 40), path))
    np.testing.assert_allclose(as_stored.colour, PICTURE / 255.0, atol=1e-6)
    upright = read_photo(PosedImage("a.png", camera(40, 60), path))
    np.testing.assert_allclose(upright.colour, apply_orientation(PICTURE, turn) / 255.0, atol=1e-6)
    assert (upright.camera.width, upright.camera.height) == (40, 60)


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("compression", [None, "tiff_lzw"])
def test_a_tiff_is_turned_once(turn: int, compression: str | None, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = turn
    Image.fromarray(PICTURE).save(tmp_path / "a.tif", exif=exif, compression=compression)
    np.testing.assert_array_equal(decoded(tmp_path / "a.tif"), PICTURE[..., ::-1])
    assert orientation(tmp_path / "a.tif") == turn
    assert picture_size(tmp_path / "a.tif", "") == (60, 40)


def test_the_alpha_of_a_tiff_does_not_darken_its_colours(tmp_path: Path) -> None:
    Image.fromarray(np.dstack([PICTURE, np.full((40, 60), 51, np.uint8)])).save(tmp_path / "a.tif")
    photo = read_photo(PosedImage("a.tif", camera(60, 40), tmp_path / "a.tif"))
    np.testing.assert_allclose(photo.colour, PICTURE / 255.0, atol=1e-6)
    assert photo.alpha is not None
    np.testing.assert_allclose(photo.alpha, 0.2, atol=1e-6)


@pytest.mark.parametrize("kind", ["uint16", "float32", "float64"])
def test_deep_pictures(kind: str, tmp_path: Path) -> None:
    full = 65535 if kind == "uint16" else 1
    cv2.imwrite(str(tmp_path / "a.tif"), (PICTURE[..., ::-1] / 255.0 * full).astype(kind))
    photo = read_photo(PosedImage("a.tif", camera(60, 40), tmp_path / "a.tif"))
    np.testing.assert_allclose(photo.colour, PICTURE / 255.0, atol=1e-4)


def test_floats_beyond_1_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tif"), PICTURE.astype(np.float32))
    with pytest.raises(UserError, match=r"a.tif: its values are of the type float32 and reach 255; save it with 8 or"):
        read_photo(PosedImage("a.tif", camera(60, 40), tmp_path / "a.tif"))


def test_a_photo_of_another_shape_is_refused_and_one_of_another_size_scaled(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.png", PICTURE)
    with pytest.raises(
        UserError, match=r"a.png: the photo has 60 x 40 pixels, but its camera has 40 x 60; use the photos that"
    ):
        read_photo(PosedImage("a.png", camera(40, 60), path))
    photo = read_photo(PosedImage("a.png", camera(240, 160), path))
    assert (photo.camera.width, photo.camera.height, photo.camera.fx) == (60, 40, 12.5)


def test_a_photo_cut_short_or_broken_or_missing_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.jpg", np.kron(PICTURE, np.ones((8, 8, 1), np.uint8)))
    assert read_photo(PosedImage("a.jpg", camera(60, 40), path)).colour.shape == (320, 480, 3)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"a.jpg: the picture is cut short; copy it again"):
        read_photo(PosedImage("a.jpg", camera(60, 40), path))
    path.write_bytes(b"\xff\xd8 not a picture")
    with pytest.raises(UserError, match=r"a.jpg: not a readable picture"):
        read_photo(PosedImage("a.jpg", camera(60, 40), path))
    with pytest.raises(UserError, match=r"b.jpg: the photo is not beside the poses; put it there"):
        read_photo(PosedImage("b.jpg", camera(60, 40), None))


@pytest.mark.parametrize("drawn_upright", [False, True])
def test_masks_of_turned_photos_fit_either_way(drawn_upright: bool, tmp_path: Path) -> None:
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
    path = saved(tmp_path / "images" / "a.png", PICTURE, 6)
    mask = np.where(PICTURE[..., 0] > 100, 255, 0).astype(np.uint8)
    mask_path = tmp_path / "masks" / "a.png.png"
    cv2.imwrite(str(mask_path), apply_orientation(mask, 6) if drawn_upright else mask)
    photo = read_photo(PosedImage("a.png", camera(40, 60), path, mask=mask_path))
    np.testing.assert_array_equal(photo.alpha, apply_orientation(mask, 6) / 255.0)


def test_pixels_outside_the_lens_stay_unknown_when_resized(tmp_path: Path) -> None:
    """Black outside the field of the lens must not darken neighbouring pixels."""
    white = np.full((80, 120, 3), 255, np.uint8)
    path = saved(tmp_path / "a.png", white)
    posed = PosedImage("a.png", camera(120, 80), path, Lens(radial=(0.2, 0.0, 0.0, 0.0)))
    full, half = read_photo(posed), read_photo(posed, max_side=60)
    for photo in (full, half):
        assert photo.known is not None
        assert 0.3 < photo.known.mean() < 1.0
        np.testing.assert_allclose(photo.colour[photo.known], 1.0, atol=1e-3)


def test_a_png_that_declares_more_than_it_holds(tmp_path: Path) -> None:
    """For this file of 135 bytes, which was found by fuzzing, OpenCV would allocate 1.8 GiB."""
    data = bytearray(cv2.imencode(".png", np.zeros((16, 24, 3), np.uint8))[1].tobytes())
    place = data.index(b"IDAT") - 4
    data[place : place + 4] = b"nanN"
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(UserError, match=r"a\.png: the picture is cut short; copy it again"):
        decoded(tmp_path / "a.png")
