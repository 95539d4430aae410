"""Camera parameters of RealityScan (.csv)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.geometry.lens import Lens
from egs_warp.io.cameras import read_points, read_posed_images
from tests.support.photo_sets import (
    FOCAL,
    HEIGHT,
    NAMES,
    WIDTH,
    cameras,
    check_poses,
    write_photos,
)

COLUMNS = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
OFFSET = np.array([431000.0, 5403000.0, 120.0])


def rows(offset: np.ndarray | float = 0.0) -> list[list[str]]:
    """Return the rows of RealityScan's table, with angles from an independent decomposition of the rotation."""
    table = []
    for name, camera in zip(NAMES, cameras(), strict=True):
        to_world = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
        yaw, pitch, roll = Rotation.from_matrix(to_world).as_euler("ZXY", degrees=True)
        numbers = [*(camera.centre + offset), -yaw, pitch, roll, FOCAL * 36 / WIDTH, *[0.0] * 8]
        table.append([name, *(f"{value:.12f}" for value in numbers)])
    return table


@pytest.mark.parametrize("kind", ["plain", "decimal commas", "tabs", "count", "mark", "utf-16", "crlf", "quotes"])
def test_reality_scan(kind: str, tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    lines = [COLUMNS, *(",".join(row) for row in rows()), ""]
    if kind == "decimal commas":
        lines = [line.replace(",", ";").replace(".", ",").replace(",jpg", ".jpg") for line in lines]
    elif kind == "tabs":
        lines = [line.replace(",", "\t") for line in lines]
    elif kind == "count":
        lines = ["#cameras 4", *lines]
    elif kind == "quotes":
        lines = [lines[0], *(f'"{line[:6]}"{line[6:]}' if line else line for line in lines[1:])]
    text = ("\r\n" if kind == "crlf" else "\n").join(lines)
    encoding = {"mark": "utf-8-sig", "utf-16": "utf-16"}.get(kind, "utf-8")
    (tmp_path / "cameras.csv").write_bytes(text.encode(encoding))
    # A table with other columns is not read as camera parameters.
    (tmp_path / "a.csv").write_text("name,value\na,1\n")
    for source in (tmp_path, tmp_path / "cameras.csv"):
        poses = read_posed_images(source)
        check_poses(poses)
        assert poses.source == tmp_path / "cameras.csv" and poses.notes == () and poses.excluded == ()
    assert read_points(tmp_path) is None


def test_georeferenced_cameras_are_moved_to_the_origin(tmp_path: Path) -> None:
    write_photos(tmp_path)
    (tmp_path / "cameras.csv").write_text("\n".join([COLUMNS, *(",".join(row) for row in rows(OFFSET))]))
    poses = read_posed_images(tmp_path)
    (note,) = poses.notes
    assert note == (
        "the cameras are 5420163 units from the origin; 431000, 5403000, 121 was subtracted from their positions"
    )
    check_poses(poses, np.array([0.0, 0.0, -1.0]), atol=1e-6)
    # A capture in the same coordinates may have another origin.
    check_poses(poses.relative_to(OFFSET - [3.0, 4.0, 5.0]), np.array([3.0, 4.0, 5.0]), atol=1e-6)
    check_poses(poses.relative_to(None), np.array([0.0, 0.0, -1.0]), atol=1e-6)


def test_reality_scans_lens_and_principal_point(tmp_path: Path) -> None:
    write_photos(tmp_path)
    row = rows()[0]
    row[8:] = ["0.02", "-0.01", "0.1", "0.2", "0.3", "0.4", "0.5", "0.6"]
    (tmp_path / "cameras.csv").write_text(f"{COLUMNS}\n{','.join(row)}\n")
    (one,) = read_posed_images(tmp_path).images
    np.testing.assert_allclose([one.camera.cx, one.camera.cy], [WIDTH / 2 + 0.48, HEIGHT / 2 - 0.24])
    assert one.lens == Lens(radial=(0.1, 0.2, 0.3, 0.4), tangential=(0.5, 0.6))


def test_invalid_rows_are_excluded(tmp_path: Path) -> None:
    write_photos(tmp_path)
    table = rows()
    table[1][4] = "nan"
    table[2][7] = "wide"
    table[3][0] = "99.jpg"
    (tmp_path / "cameras.csv").write_text("\n".join([COLUMNS, *(",".join(row) for row in table)]))
    poses = read_posed_images(tmp_path)
    assert [one.name for one in poses.images] == ["00.jpg"]
    reasons = [one.reason.removeprefix(f"{tmp_path}/cameras.csv: ") for one in poses.excluded]
    assert reasons == [
        "line 3: heading 'nan' is not a finite number; export Internal/External camera parameters again",
        "line 4: f 'wide' is not a finite number; export Internal/External camera parameters again",
        "line 5: the photo cannot be read, and the poses do not contain its size; add a readable copy",
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a,b\n1,2\n", "it has no line with the names of the columns (heading, pitch, roll, ...)"),
        ("#name,x,y,alt,heading,pitch,roll\n", "line 1 has no column f; export Internal/External camera parameters"),
        (COLUMNS, "it has no cameras; export Internal/External camera parameters"),
        (f"{COLUMNS}\n00.jpg,{'1,5,' * 15}", "line 2 has 32 fields, but there are 16 columns; export numbers with dec"),
    ],
)
def test_malformed_tables(text: str, expected: str, tmp_path: Path) -> None:
    write_photos(tmp_path)
    (tmp_path / "cameras.csv").write_text(text)
    with pytest.raises(UserError) as caught:
        read_posed_images(tmp_path / "cameras.csv")
    assert str(caught.value).startswith(f"{tmp_path}/cameras.csv: {expected}")


def test_the_rotation_is_that_of_the_xmp_of_the_same_camera(tmp_path: Path) -> None:
    """The CSV and XMP exports of one camera, published at https://forums.unrealengine.com/t/710449, have the same
    rotation."""
    write_photos(tmp_path)
    row = rows()[0]
    row[4:7] = ["163.736597399311", "83.4154313461628", "174.386496244756"]
    (tmp_path / "cameras.csv").write_text(f"{COLUMNS}\n{','.join(row)}\n")
    xmp = [0.982594073, 0.185426734, -0.011216689, -0.032113633, 0.110081027, -0.993403685, -0.182968856, 0.976472782]
    rotation = read_posed_images(tmp_path).images[0].camera.rotation
    np.testing.assert_allclose(rotation.ravel()[:8], xmp, atol=1e-8)


def test_a_wrong_focal_length_is_reported_with_file_and_photo(tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    lines = [COLUMNS, *(",".join([*row[:7], "-1.0", *row[8:]]) for row in rows())]
    (tmp_path / "cameras.csv").write_text("\n".join(lines))
    with pytest.raises(
        UserError, match=r"cameras\.csv.*: focal lengths -.* fit no photo of .*; export the poses again"
    ):
        read_posed_images(tmp_path)
