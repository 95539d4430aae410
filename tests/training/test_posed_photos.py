"""Photos and masks that are read for a training run, and the summary of their sources."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.io.cameras import read_cameras
from tests.support.photo_sets import (
    HEIGHT,
    NAMES,
    WIDTH,
    frames,
    image_lines,
    silhouettes,
    write_colmap,
    write_photos,
    write_picture,
    write_transforms,
)

pytest.importorskip("torch")
from egs_warp.training.mask_colours import is_object_black
from egs_warp.training.posed_photos import read_views

EIGHT = tuple(f"0{number}.jpg" for number in range(8))


def photo_set(folder: Path, masks: list[np.ndarray] | None = None) -> Path:
    write_colmap(folder / "sparse/0", EIGHT)
    write_photos(folder / "images", EIGHT)
    for name, mask in zip(EIGHT, masks or [], strict=False):
        write_picture(folder / "masks" / f"{name}.png", mask)
    return folder


def test_the_summary_names_numbers_and_folders(tmp_path: Path) -> None:
    folder = photo_set(tmp_path / "set", silhouettes(8))
    sources = read_views(folder).sources
    assert sources.summary() == "photos: 8 of 8 used (8 in images; poses of sparse/0), 8 with masks"
    assert sources.notes == ()
    (folder / "images/03.jpg").unlink()
    (folder / "images/04.jpg").rename(folder / "04.JPG")
    (folder / "masks/05.jpg.png").unlink()
    write_photos(folder / "images", ["90.jpg", "91.jpg"])
    photos = read_views(folder)
    assert photos.sources.summary() == (
        f"photos: 7 of 8 used (6 in images, 1 in {folder}; poses of sparse/0), 6 with masks"
    )
    assert [one.name for one in photos.left_out] == ["03.jpg"]
    assert photos.sources.notes == (
        "photos without a mask, which show their background: 1 of 7; add masks, or remove these photos",
        "photos in images without a pose, not used: 2",
    )


def test_invalid_poses_are_left_out_of_the_photos(tmp_path: Path) -> None:
    folder = photo_set(tmp_path)
    lines = image_lines(EIGHT)
    lines[2] = lines[2].replace(lines[2].split()[1], "nan")
    (folder / "sparse/0/images.txt").write_text("\n".join(lines))
    photos = read_views(folder)
    assert len(photos.views) == 7 and photos.sources.total == 8
    assert photos.sources.notes == ()
    assert photos.left_out[0].name == "02.jpg" and "has no valid pose (nan " in photos.left_out[0].reason


def test_opaque_alpha_channels(tmp_path: Path) -> None:
    """If all alpha channels are opaque, they are ignored. If another photo has a cut-out, an opaque alpha channel means
    that the object fills the photo."""
    names = [name.replace(".jpg", ".png") for name in NAMES]
    write_transforms(tmp_path, frames(names))
    rgba = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    for name in names:
        write_picture(tmp_path / name, rgba)
    photos = read_views(tmp_path)
    assert all(view.alpha is None for view in photos.views) and photos.sources.masked == 0
    rgba[:3, :, 3] = 0
    write_picture(tmp_path / names[0], rgba)
    photos = read_views(tmp_path)
    assert all(view.alpha is not None for view in photos.views) and photos.sources.masked == 4
    assert photos.views[1].alpha is not None and (photos.views[1].alpha == 1.0).all()
    assert photos.sources.notes == ()


def test_a_mask_that_is_missing_is_reported(tmp_path: Path) -> None:
    entries = frames()
    entries[0]["mask_path"] = "cut/00.png"
    write_photos(tmp_path)
    write_transforms(tmp_path, entries)
    assert read_views(tmp_path).sources.notes == (
        "00.jpg is used without a mask: its mask cut/00.png was not found; put it there",
    )


# Colour of the object in masks ---------------------------------------------------------------------------------------


def moving_blots() -> list[np.ndarray]:
    """Return white masks, each with a black blot at another position, as for people who walk by."""
    masks = []
    for number in range(8):
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        row, column = (2, 3) if number % 2 else (11, 16)
        mask[row : row + 5, column : column + 5] = 0
        masks.append(mask)
    return masks


@pytest.mark.parametrize(
    ("masks", "expected"),
    [
        (silhouettes(8), False),
        ([255 - mask for mask in silhouettes(8)], True),
        (moving_blots(), False),
        ([255 - mask for mask in moving_blots()], False),
        ([np.full((HEIGHT, WIDTH), 255, np.uint8)] * 8, False),
        ([np.zeros((HEIGHT, WIDTH), np.uint8)] * 8, False),
        # Three masks are too few to be sure.
        ([255 - mask for mask in silhouettes(8)[:3]], False),
        # One mask with the opposite colours does not change the result of the others.
        ([*(255 - mask for mask in silhouettes(8)[:7]), silhouettes(8)[7]], False),
    ],
)
def test_black_objects_are_found_on_sure_evidence(masks: list[np.ndarray], expected: bool, tmp_path: Path) -> None:
    folder = photo_set(tmp_path, masks)
    assert is_object_black(read_cameras(folder)) is expected


def test_masks_that_are_too_large_are_no_evidence(tmp_path: Path) -> None:
    """Masks that are too large are not decoded to find the colour of the object; they are refused later, together with
    their photo."""
    for factor, expected in ((10, True), (20, False)):
        folder = photo_set(
            tmp_path / str(factor), [np.kron(255 - m, np.ones((factor,) * 2, np.uint8)) for m in silhouettes(8)]
        )
        assert is_object_black(read_cameras(folder)) is expected


def test_inverted_masks_are_used_and_reported(tmp_path: Path) -> None:
    folder = photo_set(tmp_path, [255 - mask for mask in silhouettes(8)])
    photos = read_views(folder, max_side=16)
    note = "the object is black in the masks, so they are inverted (docs/guide/photos.md#masks)"
    assert photos.sources.notes == (note,)
    alpha = photos.views[0].alpha
    assert alpha is not None and alpha[6, 8] == 1.0 and not alpha[0].any()
    kept = read_views(folder, inverted_masks=False)
    assert kept.sources.notes == () and kept.views[0].alpha is not None and kept.views[0].alpha[0].all()
    black = read_views(photo_set(tmp_path / "white", silhouettes(8)), inverted_masks=True)
    assert black.views[0].alpha is not None and black.views[0].alpha[0].all()
