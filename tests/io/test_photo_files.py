"""Photos and masks in the folders and under the names that other tools use."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egs_warp.errors import UserError
from egs_warp.io.cameras import PosedImages, read_posed_images
from egs_warp.io.photo_files import photos_without_pose, without_masks
from egs_warp.io.photos import read_photo
from tests.support.photo_sets import (
    HEIGHT,
    NAMES,
    WIDTH,
    frames,
    silhouettes,
    write_colmap,
    write_photos,
    write_picture,
    write_transforms,
)

FRONT_BACK = ("front/00.jpg", "front/01.jpg", "back/00.jpg", "back/01.jpg")


def found(poses: PosedImages, root: Path) -> list[str | None]:
    return [None if one.image is None else one.image.relative_to(root).as_posix() for one in poses.images]


@pytest.mark.parametrize(
    ("model", "folder", "names", "files"),
    [
        (".", ".", NAMES, NAMES),
        ("sparse/0", ".", NAMES, NAMES),
        ("sparse/0", "input", NAMES, NAMES),
        ("sparse/0", "photos", NAMES, NAMES),
        ("sparse/0", "images_2", NAMES, NAMES),
        ("sparse/0", "images_8", NAMES, NAMES),
        ("sparse/0", "my shots/day 1", NAMES, NAMES),
        ("colmap/sparse/0", "images", NAMES, NAMES),
        ("colmap/sparse/0", "input", NAMES, NAMES),
        ("sparse/0", "images", ("00.JPG", "01.JPG"), ("00.jpg", "01.jpg")),
        ("sparse/0", "images", ("00.jpg", "01.jpg"), ("00.JPG", "01.JPEG")),
        ("sparse/0", "images", ("00.jpg", "01.jpg"), ("00.png", "01.webp")),
        ("sparse/0", "images", ("Img_00.jpg", "IMG_01.jpg"), ("IMG_00.jpg", "img_01.jpg")),
        ("sparse/0", "images", ("caf\u00e9.jpg", "01.jpg"), ("cafe\u0301.jpg", "01.jpg")),
        ("sparse/0", "images", ("front\\00.jpg", "back\\00.jpg"), ("front/00.jpg", "back/00.jpg")),
        ("sparse/0", "images", ("images/00.jpg", "images/01.jpg"), ("00.jpg", "01.jpg")),
        ("sparse/0", "input", FRONT_BACK, FRONT_BACK),
        ("sparse/0", "images", ("Front/00.JPG", "Back/00.JPG"), ("front/00.jpg", "back/00.jpg")),
        ("sparse/0", "images", (r"C:\set\images\00.jpg", "D:/set/images/01.jpg"), ("00.jpg", "01.jpg")),
        ("sparse/0", "images", ("/home/me/set/images/00.jpg", "../elsewhere/01.jpg"), ("00.jpg", "01.jpg")),
    ],
)
def test_colmap_photos(model: str, folder: str, names: tuple[str, ...], files: tuple[str, ...], tmp_path: Path) -> None:
    write_colmap(tmp_path / model, names)
    for number, file in enumerate(files):
        (tmp_path / folder / file).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (4, 3), number).save(tmp_path / folder / file, "PNG")
    # Images that are not photos must not be read as photos.
    for other in ("masks", "depth", "images/thumbnails"):
        if not (folder == "." and other.startswith("images")):
            for file in files:
                (tmp_path / other / file).parent.mkdir(parents=True, exist_ok=True)
                Image.new("L", (4, 3), 99).save(tmp_path / other / file, "PNG")
    expected = [os.path.normpath(f"{folder}/{file}") for file in files]
    assert found(read_posed_images(tmp_path), tmp_path) == expected
    # The result is the same if the folder of the model itself is read.
    assert found(read_posed_images(tmp_path / model), tmp_path) == expected


@pytest.mark.parametrize(
    "rename",
    [
        lambda name, _root: rf".\images\{name}",
        lambda name, _root: f"./images/{name}",
        lambda name, _root: f"images//{name}",
        lambda name, root: f"{root}/images/{name}",
        lambda name, root: f"../{root.name}/images/{name}",
        lambda name, _root: f"masks/../images/{name}",
        lambda name, _root: rf"C:\Users\me\set\images\{name}",
        lambda name, _root: f"/home/me/set/images/{name}",
        lambda name, _root: f"../../set/images/{name}",
        lambda name, _root: f"images/{name.upper()}",
        lambda name, _root: f"images/{name.removesuffix('.jpg')}",
        lambda name, _root: f"images/{name.replace('.jpg', '.png')}",
        lambda name, _root: name,
        lambda name, _root: f"input/{name}",
    ],
)
def test_transforms_photos(rename: Callable[[str, Path], str], tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    write_photos(tmp_path / "masks")
    write_transforms(tmp_path, frames([rename(name, tmp_path) for name in NAMES]))
    poses = read_posed_images(tmp_path)
    assert found(poses, tmp_path) == [f"images/{name}" for name in NAMES]
    assert [one.mask.name for one in poses.images if one.mask is not None] == list(NAMES)


@pytest.mark.parametrize("source", [".", "sparse/0", "sparse", "../{}"])
def test_paths_relative_to_the_working_folder(source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(tmp_path / "sparse/0", ("00.jpg", "/elsewhere/01.jpg", f"../{tmp_path.name}/images/02.jpg"))
    write_photos(tmp_path / "images")
    write_photos(tmp_path / "mask")
    monkeypatch.chdir(tmp_path)
    poses = read_posed_images(source.format(tmp_path.name))
    assert [one.image is not None and one.image.is_file() for one in poses.images] == [True] * 3
    assert [one.mask is not None and one.mask.parent.name for one in poses.images] == ["mask"] * 3


def test_the_full_size_comes_before_reduced_copies(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse/0")
    for factor in (8, 4, 2):
        write_photos(tmp_path / f"images_{factor}", size=(WIDTH // factor, HEIGHT // factor))
        assert found(read_posed_images(tmp_path), tmp_path)[0] == f"images_{factor}/00.jpg"
    photo = read_photo(read_posed_images(tmp_path).images[0])
    assert (photo.camera.width, photo.camera.fx) == (WIDTH // 2, 14.0)
    write_photos(tmp_path / "images", NAMES[:3])
    assert found(read_posed_images(tmp_path), tmp_path) == [
        *(f"images/{name}" for name in NAMES[:3]),
        "images_2/03.jpg",
    ]


def test_photos_that_several_files_fit_are_reported(tmp_path: Path) -> None:
    write_transforms(tmp_path, frames(["shots/00.jpg", "shots/01.jpg"]))
    write_photos(tmp_path / "front", ["00.jpg"])
    write_photos(tmp_path / "back", ["00.jpg", "01.jpg"])
    first, second = read_posed_images(tmp_path).images
    assert first.image is None and second.image == tmp_path / "back" / "01.jpg"
    assert first.missing.startswith("2 files fit its name, back/00.jpg and front/00.jpg; keep one, or give its folder")
    with pytest.raises(UserError, match=r"shots/00.jpg: 2 files fit its name"):
        read_photo(first)


def test_a_photo_of_another_folder_is_not_used(tmp_path: Path) -> None:
    """Photos with the same name, for example from the cameras of a rig, are distinguished by their folders."""
    write_colmap(tmp_path / "sparse/0", FRONT_BACK)
    write_photos(tmp_path / "images/front", ["00.jpg", "01.jpg"])
    assert found(read_posed_images(tmp_path), tmp_path) == ["images/front/00.jpg", "images/front/01.jpg", None, None]


def test_two_poses_do_not_share_a_photo(tmp_path: Path) -> None:
    write_transforms(tmp_path, frames(["a/00.jpg", "00.JPG"]))
    write_photos(tmp_path / "images", ["00.jpg"])
    first, second = read_posed_images(tmp_path).images
    assert first.image is None
    assert second.image is None or second.missing == ""


def test_heic_gives_way_to_its_copy_and_is_reported_without_one(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse/0", ("00.HEIC", "01.HEIC"))
    (tmp_path / "images").mkdir()
    for name in ("00.HEIC", "01.HEIC"):
        (tmp_path / "images" / name).write_bytes(b"\0\0\0\x18ftypheic")
    write_photos(tmp_path / "images", ["00.jpg"])
    first, second = read_posed_images(tmp_path).images
    assert first.image == tmp_path / "images" / "00.jpg"
    with pytest.raises(UserError, match=r"01.HEIC: HEIC is not read; convert the photos to JPEG, and keep their names"):
        read_photo(second)


def test_masks_among_photos_are_no_photos(tmp_path: Path) -> None:
    photos = ["images/00.jpg", "images/01.jpg", "a_mask.jpg", "mask.png"]
    others = ["masks/00.jpg", "masks/deep/01.png", "depth/00.png", "images/00_mask.png", "images/01.jpg.png"]
    kept, counts = without_masks([tmp_path / name for name in (*photos, *others)], tmp_path)
    assert kept == [tmp_path / name for name in photos]
    assert {folder.relative_to(tmp_path).as_posix(): count for folder, count in counts.items()} == {
        **{"masks": 1, "masks/deep": 1, "depth": 1, "images": 2},
    }
    # These names only contain such words, or have another meaning.
    names = ["normal/10.jpg", "thumbelina/11.jpg", "01_alpha_centauri/12.jpg", "unmasked/13.jpg", "in_alpha/14.jpg"]
    assert without_masks([tmp_path / name for name in (*photos, *names)], tmp_path)[0] == [
        tmp_path / name for name in (*photos, *names)
    ]
    others = ["normal/00.png", "alpha/01_alpha.png", "my-thumbs_2/00.jpg", "Depth0/3.png", "01_segmentation/4.png"]
    kept, counts = without_masks([tmp_path / name for name in (*photos, *others)], tmp_path)
    assert kept == [tmp_path / name for name in photos] and set(counts.values()) == {1} and len(counts) == len(others)
    # The user may name the folder itself.
    kept, counts = without_masks([tmp_path / "masks/00.jpg"], tmp_path / "masks")
    assert kept == [tmp_path / "masks/00.jpg"] and not counts


def test_photos_without_a_pose_are_counted(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", [*NAMES, "04.jpg", "05.jpg", "00_mask.png", "00_depth.png"])
    (tmp_path / "images" / "._00.jpg").write_bytes(b"\0\5\x16\7")
    assert photos_without_pose([tmp_path / "images" / name for name in NAMES]) == {tmp_path / "images": 2}
    assert photos_without_pose([tmp_path / "images" / f"0{number}.jpg" for number in range(6)]) == {}


# Masks ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "place",
    [
        "masks/{stem}.png",
        "masks/{stem}.jpg.png",
        "masks/{stem}.jpg",
        "masks/{stem}.PNG",
        "masks/{stem}_mask.png",
        "masks/{stem}.mask.png",
        "masks/mask_{stem}.png",
        "mask/{stem}.png",
        "mask/{stem}.jpg.png",
        "Masks/{stem}.png",
        "masks_2/{stem}.png",
        "segmentation/{stem}.png",
        "images/masks/{stem}.png",
        "images/{stem}_mask.png",
        "images/{stem}.jpg.mask.png",
        "images_masks/{stem}.png",
        "masks/images/{stem}.png",
    ],
)
@pytest.mark.parametrize("is_colmap", [True, False])
def test_masks(place: str, is_colmap: bool, tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    if is_colmap:
        write_colmap(tmp_path / "sparse/0")
    else:
        write_transforms(tmp_path, frames([f"images/{name}" for name in NAMES]))
    for name, mask in zip(NAMES, silhouettes(), strict=True):
        write_picture(tmp_path / place.format(stem=name[:2]), mask)
    poses = read_posed_images(tmp_path)
    assert found(poses, tmp_path) == [f"images/{name}" for name in NAMES]
    assert [one.mask for one in poses.images] == [tmp_path / place.format(stem=name[:2]) for name in NAMES]


@pytest.mark.parametrize("masks", ["masks/{}.png", "masks/{}.jpg.png", "mask/{}.png", "masks/{}_mask.png"])
@pytest.mark.parametrize("is_colmap", [True, False])
def test_masks_in_folders(masks: str, is_colmap: bool, tmp_path: Path) -> None:
    write_photos(tmp_path / "images", FRONT_BACK)
    if is_colmap:
        write_colmap(tmp_path / "sparse/0", FRONT_BACK)
    else:
        write_transforms(tmp_path, frames([f"images/{name}" for name in FRONT_BACK]))
    expected: list[Path | None] = [tmp_path / masks.format(name.removesuffix(".jpg")) for name in FRONT_BACK]
    for path in expected[:3]:
        assert path is not None
        write_picture(path, silhouettes(1)[0])
    # The masks of front/01.jpg and of back/01.jpg are distinguished.
    assert [one.mask for one in read_posed_images(tmp_path).images] == [*expected[:3], None]


@pytest.mark.parametrize("rename", [str, lambda name: name.replace("/", "\\"), lambda name: f"D:\\set\\{name}"])
def test_mask_path(rename: Callable[[str], str], tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    entries = frames([f"images/{name}" for name in NAMES])
    for entry, name in zip(entries, NAMES, strict=True):
        entry["mask_path"] = rename(f"cut/{name[:2]}_object.png")
        write_picture(tmp_path / f"cut/{name[:2]}_object.png", silhouettes(1)[0])
    (tmp_path / "cut/03_object.png").unlink()
    write_transforms(tmp_path, entries)
    images = read_posed_images(tmp_path).images
    assert [one.mask for one in images] == [*(tmp_path / f"cut/{name[:2]}_object.png" for name in NAMES[:3]), None]
    assert images[3].missing == f"its mask {entries[3]['mask_path']} was not found; put it there"


@pytest.mark.parametrize("factor", [0.5, 2, 3])
def test_a_mask_of_another_size_is_scaled(factor: float, tmp_path: Path) -> None:
    write_colmap(tmp_path)
    write_photos(tmp_path)
    mask = np.zeros((round(HEIGHT * factor), round(WIDTH * factor)), np.uint8)
    mask[:, mask.shape[1] // 2 :] = 255
    write_picture(tmp_path / "masks/00.png", mask)
    alpha = read_photo(read_posed_images(tmp_path).images[0]).alpha
    assert alpha is not None and alpha.shape == (HEIGHT, WIDTH)
    assert not alpha[:, : WIDTH // 2 - 1].any() and (alpha[:, WIDTH // 2 + 1 :] == 1.0).all()


@pytest.mark.parametrize("kind", ["L", "zero and one", "label", "1", "P", "RGB", "RGBA", "LA"])
def test_kinds_of_mask_files(kind: str, tmp_path: Path) -> None:
    mask = silhouettes(1)[0]
    grey = Image.fromarray(mask)
    white = Image.new("L", grey.size, 255)
    pictures = {
        "L": grey,
        "zero and one": Image.fromarray(mask // 255),
        "label": Image.fromarray(mask // 255).convert("P"),
        "1": grey.convert("1", dither=Image.Dither.NONE),
        "P": grey.convert("P"),
        "RGB": grey.convert("RGB"),
        # The photo has its cut-out in the alpha channel.
        "RGBA": Image.merge("RGBA", (white, white, white, grey)),
        "LA": Image.merge("LA", (white, grey)),
    }
    pictures["label"].putpalette([0, 0, 0, 128, 0, 0])
    write_colmap(tmp_path)
    write_photos(tmp_path)
    (tmp_path / "masks").mkdir()
    pictures[kind].save(tmp_path / "masks/00.png")
    alpha = read_photo(read_posed_images(tmp_path).images[0]).alpha
    np.testing.assert_array_equal(alpha, mask / np.float32(255))


def test_alpha_and_masks_together(tmp_path: Path) -> None:
    """An opaque alpha channel is ignored; any other one is combined with the mask."""
    mask = silhouettes(1)[0]
    rgba = np.dstack([np.full((HEIGHT, WIDTH, 3), 90, np.uint8), np.full((HEIGHT, WIDTH), 255, np.uint8)])
    write_colmap(tmp_path, ("00.png",))
    write_picture(tmp_path / "00.png", rgba)
    photo = read_photo(read_posed_images(tmp_path).images[0])
    assert photo.alpha is None and photo.is_opaque
    write_picture(tmp_path / "masks/00.png", mask)
    one = read_posed_images(tmp_path).images[0]
    np.testing.assert_array_equal(read_photo(one).alpha, mask / np.float32(255))
    np.testing.assert_array_equal(read_photo(one, is_mask_inverted=True).alpha, 1 - mask / np.float32(255))
    rgba[: HEIGHT // 2, :, 3] = 51
    write_picture(tmp_path / "00.png", rgba)
    np.testing.assert_array_equal(read_photo(one).alpha, np.minimum(mask, rgba[..., 3]) / np.float32(255))
