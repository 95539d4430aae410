"""COLMAP models as other tools write them: without points, with invalid values, or several models in one folder."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.io.cameras import read_posed_images
from tests.support.photo_sets import CAMERA_LINE, NAMES, cameras, image_lines, write_colmap, write_photos

LINES = image_lines()
POINTS = "1.5 2.5 -1 3.5 4.5 7"
# All values are integers, so only the position of the line shows that it is not an image line.
WHOLE_POINTS = "3 4 -1 5 6 -1 7 8 2 9 10 -1"


def check(folder: Path, names: tuple[str, ...] = NAMES) -> None:
    poses = read_posed_images(folder)
    assert tuple(one.name for one in poses.images) == names and not poses.excluded
    for one, camera in zip(poses.images, cameras(len(names)), strict=True):
        np.testing.assert_allclose(one.camera.rotation, camera.rotation, atol=1e-6)
        np.testing.assert_allclose(one.camera.centre, camera.centre, atol=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("\n".join(LINES), id="no point lines"),
        pytest.param("\n\n".join(LINES), id="empty point lines"),
        pytest.param("\n\n\n".join(LINES) + "\n\n\n", id="two empty lines"),
        pytest.param("# list\n" + "\n# next\n".join(LINES), id="comments in place of points"),
        pytest.param("  # list\n" + f"\n# next\n{POINTS}\n".join([*LINES, ""]), id="comments before points"),
        pytest.param(f"\n{POINTS}\n".join([*LINES, ""]), id="points"),
        pytest.param(f"\n{WHOLE_POINTS}\n".join([*LINES, ""]), id="points in whole numbers"),
        pytest.param(f"\n{POINTS} 5.5 6.5 -1 1.5 1.5 3\n".join([*LINES, ""]), id="many points"),
        pytest.param(f"{LINES[0]}\n{POINTS}\n{LINES[1]}\n{LINES[2]}\n\n{LINES[3]}", id="mixed"),
        pytest.param(f"{LINES[0]}\n{LINES[1]}\nnan nan -1\n\n{LINES[2]}\n\n\n{LINES[3]}\n", id="points of NaN"),
        pytest.param("\r\n".join(LINES) + "\r\n", id="CRLF"),
        pytest.param("\r\n\r\n".join(LINES), id="CRLF and empty lines"),
        pytest.param("\ufeff" + "\n".join(LINES), id="byte order mark"),
        pytest.param("\ufeff# list\n" + "\n\n".join(LINES), id="byte order mark before a comment"),
        pytest.param(
            "\n".join(
                " ".join([*(word.replace(".", ",") for word in line.split()[:-1]), line.split()[-1]]) for line in LINES
            ),
            id="decimal commas",
        ),
    ],
)
def test_image_lines_are_recognised_by_their_content(text: str, tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "images.txt").write_bytes(text.encode())
    check(tmp_path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("name", ["cameras.txt", "images.txt"])
def test_byte_order_marks(name: str, encoding: str, tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / name).write_bytes((tmp_path / name).read_text().encode(encoding))
    check(tmp_path)


@pytest.mark.parametrize("names", [("a b.jpg", "c  d.jpg"), ("1", "2"), ("7 8.jpg", "9")])
def test_names_with_spaces_and_numbers(names: tuple[str, ...], tmp_path: Path) -> None:
    write_colmap(tmp_path, names)
    for between in ("\n", "\n\n", f"\n{WHOLE_POINTS}\n"):
        (tmp_path / "images.txt").write_text(between.join([*image_lines(names), ""]))
        check(tmp_path, names)


@pytest.mark.parametrize("with_counts", [True, False])
def test_binary_images_without_points(with_counts: bool, tmp_path: Path) -> None:
    records = struct.pack("<Q", len(LINES))
    for line in LINES:
        words = line.split()
        pose = [float(word) for word in words[1:8]]
        records += struct.pack("<i7di", int(words[0]), *pose, 1) + words[9].encode() + b"\0"
        records += struct.pack("<Q", 0) if with_counts else b""
    (tmp_path / "images.bin").write_bytes(records)
    parameters = [float(word) for word in CAMERA_LINE.split()[4:]]
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 24, 18, *parameters))
    check(tmp_path)
    (tmp_path / "images.bin").write_bytes(records[:-3])
    with pytest.raises(UserError, match=r"images.bin: truncated at \d+ bytes; copy or export it again"):
        read_posed_images(tmp_path)


def test_names_in_the_code_page_of_windows(tmp_path: Path) -> None:
    record = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 3, 1)
    names, codes = ("Gr\u00fc\u00dfe \u2013 1.jpg", "\u00e4.jpg"), ("cp1252", "utf-8")
    records = [record + name.encode(code) + struct.pack("<xQ", 0) for name, code in zip(names, codes, strict=True)]
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 2) + b"".join(records))
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 24, 18, 28, 28, 12, 9))
    write_photos(tmp_path / "images", names)
    assert [one.image for one in read_posed_images(tmp_path).images] == [tmp_path / "images" / name for name in names]


def test_sizes_with_a_decimal_point(tmp_path: Path) -> None:
    write_colmap(tmp_path, camera=CAMERA_LINE.replace(" 24 18 ", " 24.0 18.0 "))
    check(tmp_path)


def test_a_camera_that_no_photo_uses_may_have_any_values(tmp_path: Path) -> None:
    for rest in ("-nan(ind) -nan(ind) 12 9", "nan 1.#QNAN 12 9", "0 0 0 0", "1 2"):
        write_colmap(tmp_path, camera=f"{CAMERA_LINE}\n2 PINHOLE 24 18 {rest}\n3 NEW_MODEL 24 18 1 2 3 4 5 6 7")
        check(tmp_path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("0 0 0 1", "nan nan nan nan"), "image 01.jpg has no valid pose (nan nan nan nan 0 0 3)"),
        (("0 0 0 1", "0 0 0 0"), "image 01.jpg has no valid pose (0 0 0 0 0 0 3)"),
        (("0 0 3 1", "0 0 3 9"), "image 01.jpg has camera 9, which is missing in cameras.txt"),
        (("0 0 3 1", "0 0 3 2"), "camera 2 (line 2) has no valid size and focal length (24 x 18, nan 28 12 9)"),
        (("0 0 3 1", "0 0 3 3"), "camera 3 (line 3) of model NEW_MODEL with 2 parameters is unknown; undistort the"),
        (("0 0 3 1", "0 0 3 4"), "camera 4 (line 4) has no valid lens (alpha 2 is not from 0 to 1, or beta 1 is not"),
    ],
)
def test_a_photo_with_an_invalid_pose_or_camera_is_excluded(
    change: tuple[str, str], reason: str, tmp_path: Path
) -> None:
    bad = "2 PINHOLE 24 18 nan 28 12 9\n3 NEW_MODEL 24 18 1 2\n4 EUCM 24 18 28 28 12 9 2 1"
    write_colmap(tmp_path, camera=f"{CAMERA_LINE}\n{bad}")
    line = "2 0 0 0 1 0 0 3 1 01.jpg"
    (tmp_path / "images.txt").write_text("\n".join([LINES[0], line.replace(*change), *LINES[2:]]))
    poses = read_posed_images(tmp_path)
    assert [one.name for one in poses.images] == ["00.jpg", "02.jpg", "03.jpg"]
    (excluded,) = poses.excluded
    assert excluded.name == "01.jpg" and reason in excluded.reason
    assert poses.messages == (f"left out camera 01.jpg: {excluded.reason}",)
    # If this image is the only one, the reason is raised as an error.
    (tmp_path / "images.txt").write_text(line.replace(*change))
    with pytest.raises(UserError) as caught:
        read_posed_images(tmp_path)
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    ("models", "expected"),
    [
        ({"sparse/0": 2, "sparse/1": 4}, "sparse/1"),
        ({"sparse/0": 4, "sparse/1": 2, "sparse/10": 3}, "sparse/0"),
        ({"sparse/0": 3, "sparse/1": 3}, "sparse/0"),
        ({"0": 2, "1": 4}, "1"),
        ({"sparse": 2, "sparse/0": 4}, "sparse/0"),
        ({"colmap/sparse/0": 2, "colmap/sparse/1": 4}, "colmap/sparse/1"),
        ({"colmap/0": 2, "colmap/1": 4}, "colmap/1"),
        ({".": 2, "sparse/0": 4}, "sparse/0"),
        ({"sparse/0": 2, "colmap/sparse/0": 3, "colmap/sparse/1": 4}, "colmap/sparse/1"),
        ({"distorted/sparse/0": 2, "distorted/sparse/1": 4}, "distorted/sparse/1"),
        # The photos in ``images`` are those of the undistorted model.
        ({"sparse/0": 3, "distorted/sparse/0": 4}, "sparse/0"),
        ({"work/models/0": 2, "work/models/1": 4}, "work/models/1"),
        ({"dense/sparse": 4}, "dense/sparse"),
    ],
)
def test_the_largest_model_is_used(models: dict[str, int], expected: str, tmp_path: Path) -> None:
    for folder, count in models.items():
        write_colmap(tmp_path / folder, NAMES[:count])
    write_photos(tmp_path / "images")
    poses = read_posed_images(tmp_path)
    assert poses.source == tmp_path / expected and len(poses.images) == models[expected]
    assert all(one.image == tmp_path / "images" / one.name for one in poses.images)
    among = [folder for folder in models if folder.startswith("distorted") == expected.startswith("distorted")]
    assert len(poses.notes) == (len(among) > 1)
    for note in poses.notes:
        assert f"of {len(among)} COLMAP models, the largest is used: {expected} with {models[expected]} photos" in note
        assert all(f"{folder} ({models[folder]} photos)" in note for folder in among if folder != expected)
    if expected.startswith("work"):
        return
    # A model that the user names is read without a note about other models.
    named = read_posed_images(tmp_path / expected)
    assert named.notes == () and [one.image for one in named.images] == [one.image for one in poses.images]


def test_a_damaged_model_beside_a_good_one(tmp_path: Path) -> None:
    write_colmap(tmp_path / "sparse/0")
    write_colmap(tmp_path / "sparse/1")
    (tmp_path / "sparse/0/images.txt").write_text("1 2 3")
    poses = read_posed_images(tmp_path)
    assert poses.source == tmp_path / "sparse/1"
    assert poses.notes[0].endswith("not used: sparse/0 (not readable)")
    (tmp_path / "sparse/1/cameras.txt").unlink()
    with pytest.raises(UserError, match=r"0/images.txt: malformed image in line 1, '1 2 3'; a line has IMAGE_ID QW QX"):
        read_posed_images(tmp_path)


def test_photos_before_the_undistortion_belong_to_the_distorted_model(tmp_path: Path) -> None:
    write_colmap(tmp_path / "distorted/sparse/0")
    write_photos(tmp_path / "images")
    write_photos(tmp_path / "input")
    assert read_posed_images(tmp_path).images[0].image == tmp_path / "input" / "00.jpg"
    write_colmap(tmp_path / "sparse/0")
    assert read_posed_images(tmp_path).images[0].image == tmp_path / "images" / "00.jpg"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("cameras.txt", "# cameras\n\n1 PINHOLE wide 18 1", "malformed camera in line 3, '1 PINHOLE wide 18 1'"),
        ("images.txt", f"{LINES[0]}\n\nsome words", "malformed image in line 3, 'some words'; a line has IMAGE_ID QW"),
        ("images.txt", f"{LINES[0]}\n{POINTS}\n{POINTS}", f"malformed image in line 3, '{POINTS}'"),
        ("images.txt", f"{LINES[0]}\n1 2 3 4", "malformed image in line 2, '1 2 3 4'"),
        ("images.txt", "\xe9\n".encode("latin-1"), "not a text file (UTF-8); save it as UTF-8"),
    ],
)
def test_errors_name_the_line(name: str, text: str | bytes, expected: str, tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserError) as caught:
        read_posed_images(tmp_path)
    assert f"{tmp_path / name}: {expected}" in str(caught.value)
