"""Camera files of Metashape (.xml)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.geometry.lens import Lens
from egs_warp.io.cameras import read_posed_images
from tests.support.photo_sets import (
    FOCAL,
    HEIGHT,
    NAMES,
    WIDTH,
    cameras,
    write_photos,
)

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
    """Return the text of Metashape's cameras.xml; its chunk is rotated, scaled and shifted relative to the world."""
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
    """The distortion at one point equals the sum of the terms in the appendix of Metashape's manual; b1 is the
    difference of the focal lengths."""
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
    (tmp_path / "cameras.xml").write_text(document(calibration=CALIBRATION + "<p3>0</p3><p4>-0.1</p4>"))
    assert read_posed_images(tmp_path).notes == (
        "p3 and p4, which are up to 0.1, are ignored; export undistorted photos if that matters",
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
        ("<document><chunk/></document>", "it has no chunk with cameras; export the cameras again as XML"),
        ("<document><chunk><cameras/></chunk></document>", "it has no cameras; export the cameras again as XML"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><document><chunk/></document>', "it has a document type declaration, which"),
        (
            document(kind="spherical"),
            "camera 00 has a sensor of type 'spherical'; give one of frame, fisheye, equidist",
        ),
        (document(calibration="<f>wide</f>"), "camera 00 has a sensor with invalid numbers (f not finite)"),
        (document().replace(f'width="{WIDTH}"', ""), "camera 00 has a sensor without resolution"),
        (document().replace("<scale>2.5", "<scale>-2.5"), "camera 00: its transform is not a rotation with a positive"),
    ],
)
def test_malformed_xml(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_text(text)
    with pytest.raises(UserError) as caught:
        read_posed_images(tmp_path / "cameras.xml")
    assert str(caught.value).startswith(f"{tmp_path}/cameras.xml: {expected}")
