"""Camera poses in JSON as other programs write them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egs_warp.errors import UserError
from egs_warp.io.cameras import read_posed_images
from tests.support.photo_sets import (
    FOCAL,
    HEIGHT,
    NAMES,
    WIDTH,
    check_poses,
    frames,
    write_photos,
    write_transforms,
)


def test_matrices_of_three_rows_or_in_one_list_and_decimal_commas(tmp_path: Path) -> None:
    write_photos(tmp_path)
    entries = frames()
    for number, entry in enumerate(entries):
        entry["transform_matrix"] = entry["transform_matrix"][:3]
        if number % 2:
            entry["transform_matrix"] = [
                [f"{x:.17g}".replace(".", ",") for x in row] for row in entry["transform_matrix"]
            ]
    entries[2]["transform_matrix"] = np.ravel(entries[2]["transform_matrix"]).tolist()
    write_transforms(tmp_path, entries)
    check_poses(read_posed_images(tmp_path))


def test_fields_of_null_are_missing_and_models_may_be_in_lower_case(tmp_path: Path) -> None:
    write_photos(tmp_path)
    entries = [entry | {"fl_x": None, "cx": None, "w": None, "mask_path": None} for entry in frames()]
    write_transforms(tmp_path, entries, fl_x=FOCAL, fl_y=None, w=None, h=None, k1=None, camera_model=None)
    check_poses(read_posed_images(tmp_path))
    write_transforms(tmp_path, entries, fl_x=FOCAL, w=WIDTH, h=HEIGHT, k1=0.1, camera_model="opencv_fisheye")
    lens = read_posed_images(tmp_path).images[0].lens
    assert lens is not None and lens.fisheye and lens.radial[0] == 0.1


def test_the_scale_of_a_camera_object_is_no_part_of_its_pose(tmp_path: Path) -> None:
    write_photos(tmp_path)
    entries = frames()
    for entry, scale in zip(entries, ([2, 2, 2, 1], [0.1, 3, 0.1, 1], [1, 1, 1, 1], [1e9, 1, 1e-9, 1]), strict=True):
        entry["transform_matrix"] = (np.array(entry["transform_matrix"]) * scale).tolist()
    write_transforms(tmp_path, entries)
    check_poses(read_posed_images(tmp_path))
    for entry, skew in zip(entries, ([0, 0], [0.3, 0], [0.3, 0], [0.3, 0]), strict=True):
        matrix = np.array(entry["transform_matrix"])
        matrix[:2, 2] += skew
        entry["transform_matrix"] = matrix.tolist()
    write_transforms(tmp_path, entries)
    poses = read_posed_images(tmp_path)
    assert [one.name for one in poses.images] == ["00.jpg"] and "not a rotation" in poses.excluded[0].reason


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_json_with_a_byte_order_mark(encoding: str, tmp_path: Path) -> None:
    write_photos(tmp_path)
    write_transforms(tmp_path, frames())
    text = (tmp_path / "transforms.json").read_text().replace("\n", "\r\n")
    (tmp_path / "transforms.json").write_bytes(text.encode(encoding))
    check_poses(read_posed_images(tmp_path))


@pytest.mark.parametrize("value", ["NaN", "nan", "-nan(ind)", "null", "inf", "-Infinity", "1e999", '"nan"'])
def test_a_pose_that_is_not_finite_is_excluded(value: str, tmp_path: Path) -> None:
    write_photos(tmp_path)
    entries = frames([*NAMES[:3], "a nan, inf.jpg"])
    entries[1]["transform_matrix"][0][3] = "VALUE"
    write_transforms(tmp_path, entries)
    path = tmp_path / "transforms.json"
    path.write_text(path.read_text().replace('"VALUE"', value))
    poses = read_posed_images(tmp_path)
    # Words such as nan and inf in names are not changed.
    assert [one.name for one in poses.images] == ["00.jpg", "02.jpg", "a nan, inf.jpg"]
    (excluded,) = poses.excluded
    assert excluded.name == "01.jpg" and "frame 1: transform_matrix" in excluded.reason


def test_each_photo_has_its_own_size(tmp_path: Path) -> None:
    write_photos(tmp_path, NAMES[:2])
    write_photos(tmp_path, NAMES[2:], size=(HEIGHT, WIDTH))
    write_transforms(tmp_path, frames(), camera_angle_x=0.8)
    cameras_read = [one.camera for one in read_posed_images(tmp_path).images]
    assert [(camera.width, camera.height) for camera in cameras_read] == [(24, 18), (24, 18), (18, 24), (18, 24)]
    np.testing.assert_allclose([camera.fx for camera in cameras_read], 0.5 / np.tan(0.4) * np.array([24, 24, 18, 18]))
    assert [(camera.cx, camera.cy) for camera in cameras_read][2] == (9.0, 12.0)
    # The size of a missing photo can be determined only if all others have the same size.
    (tmp_path / "00.jpg").unlink()
    poses = read_posed_images(tmp_path)
    assert len(poses.images) == 3 and poses.excluded[0].name == "00.jpg"
    for name in NAMES[2:]:
        (tmp_path / name).unlink()
    assert [one.camera.width for one in read_posed_images(tmp_path).images] == [24] * 4


@pytest.mark.parametrize(("middle", "size"), [((9, 12), (18, 24)), ((12, 9), (24, 18)), (None, (24, 18))])
def test_the_principal_point_decides_on_the_exif_orientation(
    middle: tuple[int, int] | None, size: tuple[int, int], tmp_path: Path
) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "00.jpg", exif=exif)
    shared = {"fl_x": FOCAL} | ({} if middle is None else {"cx": middle[0], "cy": middle[1]})
    write_transforms(tmp_path, frames(["00.jpg"]), **shared)
    (one,) = read_posed_images(tmp_path).images
    assert (one.camera.width, one.camera.height) == size


def test_json_errors_name_the_line(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text('{"w": 8,\n"h" 6}')
    with pytest.raises(UserError, match=r"transforms.json: not readable JSON at line 2 \(Expecting ':' delimiter\)"):
        read_posed_images(tmp_path)


def test_poses_in_a_folder_below(tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    write_transforms(tmp_path / "poses", frames([f"../images/{name}" for name in NAMES]))
    poses = read_posed_images(tmp_path)
    check_paths = [one.image for one in poses.images]
    assert check_paths == [tmp_path / "images" / name for name in NAMES]
    assert poses.notes == (f"poses are read from {tmp_path / 'poses' / 'transforms.json'}",)
    assert json.loads((tmp_path / "poses" / "transforms.json").read_text())["w"] == WIDTH


def test_poses_far_from_the_origin_are_reported(tmp_path: Path) -> None:
    """At 5403000 units, single precision has steps of half a unit; the cameras are on a circle of radius 3."""
    write_photos(tmp_path)
    entries = frames()
    for entry in entries:
        entry["transform_matrix"][1][3] += 5403000.0
    write_transforms(tmp_path, entries)
    (note,) = read_posed_images(tmp_path).notes
    assert note == (
        "the cameras are 5403000 units from the origin, where single precision has steps of 0.5 units, 17 % of the"
        " radius of the camera path; export the poses with an offset"
    )
    write_transforms(tmp_path, frames())
    assert not read_posed_images(tmp_path).notes
