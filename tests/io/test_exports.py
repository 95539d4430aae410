"""Poses of RealityScan (.csv) and Metashape (.xml), and the JSON that other programs write."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.geometry.lens import Lens
from egs_warp.io.cameras import PosedImages, read_points, read_posed_images
from tests.support.photo_sets import (
    FOCAL,
    HEIGHT,
    NAMES,
    WIDTH,
    cameras,
    frames,
    write_photos,
    write_transforms,
)

COLUMNS = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
OFFSET = np.array([431000.0, 5403000.0, 120.0])


def rows(offset: np.ndarray | float = 0.0) -> list[list[str]]:
    """Rows of RealityScan's table, from an independent decomposition of the rotation."""
    table = []
    for name, camera in zip(NAMES, cameras(), strict=True):
        to_world = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
        yaw, pitch, roll = Rotation.from_matrix(to_world).as_euler("ZXY", degrees=True)
        numbers = [*(camera.centre + offset), -yaw, pitch, roll, FOCAL * 36 / WIDTH, *[0.0] * 8]
        table.append([name, *(f"{value:.12f}" for value in numbers)])
    return table


def check(poses: PosedImages, offset: np.ndarray | float = 0.0, *, atol: float = 1e-9) -> None:
    assert [one.name.removesuffix(".jpg") for one in poses.images] == [name.removesuffix(".jpg") for name in NAMES]
    for one, camera in zip(poses.images, cameras(), strict=True):
        assert one.image is not None and one.image.stem == one.name.removesuffix(".jpg")
        np.testing.assert_allclose(one.camera.rotation, camera.rotation, atol=1e-9)
        np.testing.assert_allclose(one.camera.centre, camera.centre + offset, atol=atol)
        values = (one.camera.width, one.camera.height, one.camera.fx, one.camera.fy, one.camera.cx, one.camera.cy)
        np.testing.assert_allclose(values, [WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])


# RealityScan ---------------------------------------------------------------------------------------------------------


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
    # A table of something else is not taken for poses.
    (tmp_path / "a.csv").write_text("name,value\na,1\n")
    for source in (tmp_path, tmp_path / "cameras.csv"):
        poses = read_posed_images(source)
        check(poses)
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
    check(poses, np.array([0.0, 0.0, -1.0]), atol=1e-6)


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
        "line 5: the photo cannot be read, and the poses do not contain its size; put it there",
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a,b\n1,2\n", "no line with the names of the columns (heading, pitch, roll, ...)"),
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


# Metashape -----------------------------------------------------------------------------------------------------------

TURN, SHIFT, SCALE = Rotation.from_euler("xyz", [20, -30, 50], degrees=True).as_matrix(), np.array([5.0, 6, 7]), 2.5
CALIBRATION = f"<f>{FOCAL}</f>"


def spaced(values: np.ndarray) -> str:
    return " ".join(f"{value:.15g}" for value in np.ravel(values))


def document(
    *,
    calibration: str = CALIBRATION,
    kind: str = "frame",
    component: bool = True,
    offset: np.ndarray | float = 0.0,
    label: str = "{}",
    extra: str = "",
) -> str:
    """Metashape's cameras.xml, whose chunk is turned, scaled and shifted against the world."""
    frame = f"<transform><rotation>{spaced(TURN)}</rotation><translation>{spaced(SHIFT + offset)}</translation>"
    frame += f"<scale>{SCALE}</scale></transform>"
    entries = ""
    for number, (name, camera) in enumerate(zip(NAMES, cameras(), strict=True)):
        pose = np.eye(4)
        pose[:3, :3] = TURN.T @ camera.rotation.T
        pose[:3, 3] = TURN.T @ (camera.centre - SHIFT) / SCALE
        entries += f'<camera id="{number}" sensor_id="0" component_id="0" label="{label.format(name[:2])}">'
        entries += f"<transform>{spaced(pose)}</transform></camera>"
    return (
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1"><sensors>'
        f'<sensor id="0" label="lens" type="{kind}"><resolution width="{WIDTH}" height="{HEIGHT}"/>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>{calibration}'
        f"</calibration></sensor></sensors>"
        + (f'<components><component id="0">{frame}</component></components>' if component else frame)
        + f"<cameras>{entries}{extra}</cameras></chunk></document>"
    )


@pytest.mark.parametrize("component", [True, False])
@pytest.mark.parametrize("label", ["{}", "{}.jpg", "{}.JPG"])
def test_metashape(component: bool, label: str, tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    (tmp_path / "other.xml").write_text("<document/>")
    (tmp_path / "cameras.xml").write_bytes(document(component=component, label=label).encode("utf-8-sig"))
    for source in (tmp_path, tmp_path / "cameras.xml"):
        poses = read_posed_images(source)
        check_names = [one.image.name for one in poses.images if one.image is not None]
        assert check_names == list(NAMES) and poses.notes == ()
        for one, camera in zip(poses.images, cameras(), strict=True):
            np.testing.assert_allclose(one.camera.rotation, camera.rotation, atol=1e-9)
            np.testing.assert_allclose(one.camera.centre, camera.centre, atol=1e-9)
            assert (one.camera.fx, one.camera.cx, one.camera.cy) == (FOCAL, WIDTH / 2, HEIGHT / 2)


def test_metashapes_lens(tmp_path: Path) -> None:
    """At one point, term by term as in the appendix of the manual; b1 is the difference of the focal lengths."""
    number = {
        "k1": 0.1,
        "k2": -0.02,
        "k3": 0.03,
        "k4": 0.004,
        "p1": 0.01,
        "p2": -0.02,
        "cx": 0.3,
        "cy": -0.4,
        "b1": 0.5,
    }
    text = CALIBRATION + "".join(f"<{name}>{value}</{name}>" for name, value in number.items())
    (tmp_path / "cameras.xml").write_text(document(calibration=text))
    one = read_posed_images(tmp_path).images[0]
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    gain = 1 + 0.1 * r2 - 0.02 * r2**2 + 0.03 * r2**3 + 0.004 * r2**4
    bent_x = x * gain + 0.01 * (r2 + 2 * x * x) + 2 * -0.02 * x * y
    bent_y = y * gain - 0.02 * (r2 + 2 * y * y) + 2 * 0.01 * x * y
    u = WIDTH * 0.5 + 0.3 + bent_x * FOCAL + bent_x * 0.5
    v = HEIGHT * 0.5 - 0.4 + bent_y * FOCAL
    assert one.lens is not None
    bent = one.lens.distorted(np.array([x, y]))
    np.testing.assert_allclose(bent * [one.camera.fx, one.camera.fy] + [one.camera.cx, one.camera.cy], [u, v])
    (tmp_path / "cameras.xml").write_text(document(kind="fisheye"))
    assert read_posed_images(tmp_path).images[0].lens == Lens(fisheye=True)
    (tmp_path / "cameras.xml").write_text(document(calibration=CALIBRATION + "<b2>3</b2>"))
    assert read_posed_images(tmp_path).notes == (
        "the skew b2 of 3 pixels is ignored; export undistorted photos if that matters",
    )


def test_metashape_leaves_out_what_is_not_aligned(tmp_path: Path) -> None:
    write_photos(tmp_path)
    pose = spaced(np.eye(4))
    extra = '<camera id="7" sensor_id="0" label="07"/>'
    extra += f'<camera id="8" sensor_id="0" label="08"><transform>{pose.replace("1", "nan")}</transform></camera>'
    extra += f'<camera id="9" sensor_id="9" label="09"><transform>{pose}</transform></camera>'
    extra += f'<camera id="5" sensor_id="0" label="05" enabled="0"><transform>{pose}</transform></camera>'
    (tmp_path / "cameras.xml").write_text(document(extra=f"<group>{extra}</group>"))
    poses = read_posed_images(tmp_path)
    assert len(poses.images) == 4
    reasons = [one.reason.removeprefix(f"{tmp_path}/cameras.xml: camera ") for one in poses.excluded]
    assert reasons == [
        "07 is not aligned; align the photos, and export the cameras again as XML",
        "08: its transform 'nan 0 0 0 0 nan 0 0 0 0 nan 0 0 0 0 nan' is not 16 finite numbers; export the cameras again"
        " as XML",
        "09 has no calibrated sensor; export the cameras again as XML",
        "05 is disabled; enable it and export the cameras again as XML",
    ]
    (tmp_path / "cameras.xml").write_text(document(offset=1e6))
    assert "units from the origin; 1000000, 1000000, 1000001 was subtracted" in read_posed_images(tmp_path).notes[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("<document><chunk>", "not readable XML (no element found"),
        ("<document><chunk/></document>", "no cameras of a chunk; export the cameras again as XML"),
        ("<document><chunk><cameras/></chunk></document>", "it has no cameras; export the cameras again as XML"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><document><chunk/></document>', "it has a document type, which Metashape does"),
        (
            document(kind="spherical"),
            "camera 00 has a sensor of type 'spherical'; give one of frame, fisheye, equidist",
        ),
        (document(calibration="<f>wide</f>"), "camera 00 has a sensor with invalid numbers"),
        (document().replace(f'width="{WIDTH}"', ""), "camera 00 has a sensor without resolution"),
        (document().replace("<scale>2.5", "<scale>-2.5"), "camera 00: its transform is not a rotation with a positive"),
    ],
)
def test_malformed_xml(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_text(text)
    with pytest.raises(UserError) as caught:
        read_posed_images(tmp_path / "cameras.xml")
    assert str(caught.value).startswith(f"{tmp_path}/cameras.xml: {expected}")


# JSON ----------------------------------------------------------------------------------------------------------------


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
    check(read_posed_images(tmp_path))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_json_with_a_byte_order_mark(encoding: str, tmp_path: Path) -> None:
    write_photos(tmp_path)
    write_transforms(tmp_path, frames())
    text = (tmp_path / "transforms.json").read_text().replace("\n", "\r\n")
    (tmp_path / "transforms.json").write_bytes(text.encode(encoding))
    check(read_posed_images(tmp_path))


@pytest.mark.parametrize("value", ["NaN", "nan", "-nan(ind)", "null", "inf", "-Infinity", "1e999", '"nan"'])
def test_a_pose_that_is_not_finite_is_excluded(value: str, tmp_path: Path) -> None:
    write_photos(tmp_path)
    entries = frames([*NAMES[:3], "a nan, inf.jpg"])
    entries[1]["transform_matrix"][0][3] = "VALUE"
    write_transforms(tmp_path, entries)
    path = tmp_path / "transforms.json"
    path.write_text(path.read_text().replace('"VALUE"', value))
    poses = read_posed_images(tmp_path)
    # Names keep such words.
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
    # The size of a photo that is missing is known only if all have the same.
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
    assert poses.notes == (f"the poses are those of {tmp_path / 'poses' / 'transforms.json'}",)
    assert json.loads((tmp_path / "poses" / "transforms.json").read_text())["w"] == WIDTH
