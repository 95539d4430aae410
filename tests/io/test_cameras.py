"""Camera poses of real photos, of hand-made files in each convention, and of bad files."""

from __future__ import annotations

import json
import shutil
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.lens import Lens
from egs_warp.io import read_cameras, read_capture
from egs_warp.io.cameras import read_points, read_posed_images
from egs_warp.io.pose_json import LENSES
from tests.support.properties import examples


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel coordinates (n, 2) and depths (n,) along the optical axis of world points (n, 3)."""
    seen = points @ camera.rotation.T + camera.translation
    pixels = seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return pixels, seen[:, 2]


def inside(mask: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return (n,) bool, True for each pixel coordinate (n, 2) that falls on a set pixel; pixel centres lie at +0.5."""
    columns, rows = np.floor(pixels).astype(int).T
    height, width = mask.shape
    valid = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    return valid & mask[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]


def drawn(shape: tuple[int, int], pixels: np.ndarray, radius: int) -> np.ndarray:
    """Return a mask with a square dot at each pixel coordinate."""
    out = np.zeros(shape, bool)
    columns, rows = np.floor(pixels).astype(int).T
    for across in range(-radius, radius + 1):
        for down in range(-radius, radius + 1):
            out[np.clip(rows + down, 0, shape[0] - 1), np.clip(columns + across, 0, shape[1] - 1)] = True
    return out


# Real photos ---------------------------------------------------------------------------------------------------------


@pytest.mark.data
def test_plush_dog_gaussians_land_on_the_dog(data_dir: Path) -> None:
    """For a COLMAP model as text, the Gaussians of the capture cover the brown fur in each photo, and little else."""
    posed = read_cameras(data_dir / "posed/plush_dog")
    assert len(posed) == 84
    cloud = read_capture(data_dir / "objects/plush_dog.ply", device="cpu").cloud
    points = cloud.means.numpy()[cloud.opacities() > 0.5].astype(float)
    for view in posed[::7]:
        assert view.image is not None and view.image.name == view.name
        photo = np.asarray(Image.open(view.image).convert("RGB")).astype(float)
        assert photo.shape[:2] == (view.camera.height, view.camera.width)
        fur = np.ptp(photo, axis=2) > 60
        pixels, depth = project(view.camera, points)
        assert depth.min() > 0.5
        covered = drawn(fur.shape, pixels, 5)
        assert (covered & fur).sum() > 0.98 * fur.sum()
        assert covered.mean() < 0.3
        # To show that the measure detects a wrong pose, the dog is shifted by a fifth of its height.
        moved = drawn(fur.shape, project(view.camera, points + np.array([0.0, 0.06, 0.0]))[0], 5)
        assert (moved & fur).sum() < 0.9 * fur.sum()


@pytest.mark.data
def test_lego_masks_carve_a_bulldozer(data_dir: Path) -> None:
    """In a NeRF-synthetic scene, the grid points that are inside all 100 silhouettes fill each silhouette, which is the
    case only for correct poses."""
    posed = read_cameras(data_dir / "posed/lego")
    assert len(posed) == 100
    ticks = np.linspace(-1.4, 1.4, 71)
    points = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    masks = []
    for view in posed:
        assert view.image is not None
        mask = np.asarray(Image.open(view.image))[:, :, 3] > 127
        assert mask.shape == (view.camera.height, view.camera.width) == (200, 200)
        masks.append(mask)
        pixels, depth = project(view.camera, points)
        assert depth.min() > 0
        points = points[inside(mask, pixels)]
    assert 3000 < len(points) < 60_000
    low, high = points.min(axis=0), points.max(axis=0)
    # The toy is about 1.2 x 2.3 x 1.3 and stands on z = -0.35, up along +z.
    np.testing.assert_allclose(low, [-0.64, -1.16, -0.4], atol=0.12)
    np.testing.assert_allclose(high, [0.64, 1.2, 1.0], atol=0.15)
    for view, mask in list(zip(posed, masks, strict=True))[::20]:
        covered = drawn(mask.shape, project(view.camera, points)[0], 4)
        assert (covered & mask).sum() > 0.97 * mask.sum()


# Conventions by hand -------------------------------------------------------------------------------------------------

# The camera is at (1, 2, 3), its optical axis is +x, and +z is up in the image: right is -y, down is -z.
ROTATION = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CENTRE = np.array([1.0, 2.0, 3.0])


def check_by_hand(camera: Camera) -> None:
    np.testing.assert_allclose(camera.rotation, ROTATION, atol=1e-9)
    np.testing.assert_allclose(camera.centre, CENTRE, atol=1e-9)
    assert (camera.width, camera.height, camera.fx, camera.fy) == (640, 480, 500.0, 510.0)
    # The point is one unit ahead, 0.1 to the left (+y) and 0.1 up.
    pixels, depth = project(camera, CENTRE[None] + [[1.0, 0.1, 0.1]])
    np.testing.assert_allclose(pixels, [[320.0 - 50.0, 240.0 - 51.0]], atol=1e-9)
    np.testing.assert_allclose(depth, [1.0])


def test_inria_by_hand(tmp_path: Path) -> None:
    entry = {"id": 0, "img_name": "a", "width": 640, "height": 480, "fx": 500.0, "fy": 510.0}
    entry |= {"position": CENTRE.tolist(), "rotation": ROTATION.T.tolist()}
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").write_bytes(b"")
    (view,) = read_cameras(tmp_path)
    check_by_hand(view.camera)
    assert view.name == "a" and view.image == tmp_path / "images" / "a.jpg"
    # Some programs add the principal point.
    (tmp_path / "cameras.json").write_text(json.dumps([entry | {"cx": 310.0, "cy": 250.0}]))
    (view,) = read_cameras(tmp_path)
    assert (view.camera.cx, view.camera.cy) == (310.0, 250.0)


@pytest.mark.parametrize("place", ["shared", "frame"])
def test_nerfstudio_by_hand(place: str, tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, :3] = ROTATION.T @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = CENTRE
    intrinsics = {"w": 640, "h": 480, "fl_x": 500.0, "fl_y": 510.0, "cx": 320.0, "cy": 240.0, "k1": 0.0}
    frame = {"file_path": "images/a.png", "transform_matrix": pose.tolist()}
    tree = {"camera_model": "OPENCV", "frames": [frame]}
    (tree if place == "shared" else frame).update(intrinsics)
    (tmp_path / "transforms.json").write_text(json.dumps(tree))
    (view,) = read_cameras(tmp_path / "transforms.json")
    check_by_hand(view.camera)
    assert view.image is None


def colmap_text(folder: Path, *, camera: str = "3 PINHOLE 640 480 500 510 320 240") -> None:
    w, x, y, z = 0.5, 0.5, -0.5, 0.5
    tx, ty, tz = -ROTATION @ CENTRE
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(f"# comment\n{camera}\n")
    lines = [f"7 {w} {x} {y} {z} {tx} {ty} {tz} 3 sub/with space.jpg", "1.0 2.0 -1 3.0 4.0 -1", ""]
    lines += [f"8 {w} {x} {y} {z} {tx} {ty} {tz} 3 b.jpg", ""]
    (folder / "images.txt").write_text("# comment\n" + "\n".join(lines))


def colmap_binary(folder: Path, *, model: int = 1) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    parameters = {
        0: (500.0, 320.0, 240.0),
        1: (500.0, 510.0, 320.0, 240.0),
        4: (500.0, 510.0, 320.0, 240.0, 0, 0, 0, 0),
    }
    camera = struct.pack("<QiiQQ", 1, 3, model, 640, 480)
    (folder / "cameras.bin").write_bytes(camera + struct.pack(f"<{len(parameters[model])}d", *parameters[model]))
    pose = struct.pack("<i7di", 7, 0.5, 0.5, -0.5, 0.5, *(-ROTATION @ CENTRE), 3)
    points = struct.pack("<Q2dq2dq", 2, 1.0, 2.0, -1, 3.0, 4.0, 5)
    images = struct.pack("<Q", 2) + pose + b"sub/with space.jpg\0" + points + pose + b"b.jpg\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(images)


@pytest.mark.parametrize("write", [colmap_text, colmap_binary])
def test_colmap_by_hand(write: Callable[[Path], None], tmp_path: Path) -> None:
    write(tmp_path / "sparse" / "0")
    (tmp_path / "images" / "sub").mkdir(parents=True)
    (tmp_path / "images" / "sub" / "with space.jpg").write_bytes(b"")
    for place in (tmp_path, tmp_path / "sparse" / "0"):
        first, second = read_cameras(place)
        check_by_hand(first.camera)
        check_by_hand(second.camera)
        assert (first.name, second.name) == ("sub/with space.jpg", "b.jpg")
        assert first.image == tmp_path / "images" / "sub" / "with space.jpg" and second.image is None


def test_colmap_models_without_distortion(tmp_path: Path) -> None:
    colmap_binary(tmp_path, model=4)
    check_by_hand(read_cameras(tmp_path)[0].camera)
    colmap_binary(tmp_path, model=0)
    assert read_cameras(tmp_path)[0].camera.fy == 500.0


def test_lenses_of_colmap_and_nerfstudio(tmp_path: Path) -> None:
    """The undistorted pinhole photo keeps its size and focal length; the distortion is stored separately."""
    colmap_text(tmp_path, camera="3 RADIAL 640 480 500 320 240 0.01 0.02")
    (view, _) = read_cameras(tmp_path)
    assert (view.camera.fx, view.camera.fy, view.camera.cx) == (500.0, 500.0, 320.0)
    assert view.lens == Lens(radial=(0.01, 0.02, 0.0, 0.0))
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist(), "w": 8, "h": 8, "fl_x": 5.0}
    bent = {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.2}
    path = tmp_path / "t.json"
    path.write_text(json.dumps({"frames": [frame, frame | bent, frame | {"k1": 0.1, "p1": 0.3}]}))
    lenses = [view.lens for view in read_cameras(path)]
    assert lenses == [
        None,
        Lens(fisheye=True, radial=(0.1, 0.0, 0.0, 0.2)),
        Lens(radial=(0.1, 0.0, 0.0, 0.0), tangential=(0.3, 0.0)),
    ]


def test_triangulated_points(tmp_path: Path) -> None:
    """Points are read from COLMAP's text and binary files and from nerfstudio's .ply."""
    colmap_text(tmp_path)
    assert read_points(tmp_path) is None
    (tmp_path / "points3D.txt").write_text("# comment\n5 1.0 2.0 3.0 255 0 51 0.5 7 0 8 1\n")
    record = struct.pack("<Q3d3BdQ", 9, -1.0, 0.5, 2.0, 0, 255, 102, 0.1, 2) + struct.pack("<4i", 7, 0, 8, 1)
    points = read_points(tmp_path)
    assert points is not None
    np.testing.assert_allclose(points.positions, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(points.colours, [[1.0, 0.0, 0.2]])
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 2) + record + record)
    points = read_points(tmp_path)
    assert points is not None
    np.testing.assert_allclose(points.positions, [[-1.0, 0.5, 2.0]] * 2)
    np.testing.assert_allclose(points.colours, [[0.0, 1.0, 0.4]] * 2)
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 3) + record + record)
    with pytest.raises(UserError, match=r"points3D.bin: truncated at 142 bytes; copy or export it again"):
        read_points(tmp_path)
    folder = tmp_path / "studio"
    folder.mkdir()
    header = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {n}\n" for n in "xyz")
    header += "".join(f"property uchar {n}\n" for n in ("red", "green", "blue")) + "end_header\n"
    (folder / "points.ply").write_text(header + "1 2 3 51 102 255\n")
    (folder / "transforms.json").write_text(json.dumps({"ply_file_path": "points.ply", "frames": []}))
    points = read_points(folder)
    assert points is not None
    np.testing.assert_allclose(points.positions, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(points.colours, [[0.2, 0.4, 1.0]])
    for kind, names, values in (
        ("float", "red green blue", "0.2 0.4 1"),
        ("double", "r g b", "0.2 0.4 1"),
        ("ushort", "red green blue", "13107 26214 65535"),
        ("uchar", "diffuse_red diffuse_green diffuse_blue", "51 102 255"),
    ):
        text = header[: header.index("property uchar")] + "".join(f"property {kind} {name}\n" for name in names.split())
        (folder / "points.ply").write_text(f"{text}end_header\n1 2 3 {values}\n")
        points = read_points(folder)
        assert points is not None
        np.testing.assert_allclose(points.colours, [[0.2, 0.4, 1.0]], rtol=1e-6)
    # A COLMAP model without points may have them in a .ply.
    colmap_text(tmp_path / "model")
    shutil.copy(folder / "points.ply", tmp_path / "model" / "points3D.ply")
    points = read_points(tmp_path / "model")
    assert points is not None and points.positions.tolist() == [[1.0, 2.0, 3.0]]


# Bad files -----------------------------------------------------------------------------------------------------------


def message(path: Path) -> str:
    with pytest.raises(UserError) as caught:
        read_cameras(path)
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    return text.removeprefix(str(path)).removeprefix("/")


def test_missing_or_unreadable(tmp_path: Path) -> None:
    assert message(tmp_path / "a.json") == ": no such file or folder; check the path"
    assert message(tmp_path) == (
        ": it contains no camera poses; give a COLMAP model, a cameras.json, a transforms.json, RealityScan's camera"
        " parameters (.csv) or Metashape's cameras (.xml)"
    )
    for text, expected in (
        ("[", ": not readable JSON at line 1 (Expecting value); give a cameras.json or a transforms.json"),
        ("{}", ": neither a list of cameras nor frames; give a cameras.json or a transforms.json"),
        ("[]", ": it has no cameras; export the poses again"),
        ("[1]", ": camera 0 is not a JSON object; export the poses again"),
    ):
        (tmp_path / "b.json").write_text(text)
        assert message(tmp_path / "b.json") == expected


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"fx": -1.0}, "fx -1.0 is not a positive number"),
        ({"width": 3.5}, "width 3.5 is not a number of pixels"),
        ({"position": [0.0, 1.0]}, "position of shape (2,) is not 3 finite numbers"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "the pose is not a rotation"),
        ({"rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}, "the pose is not a rotation"),
        ({"img_name": 5}, "img_name 5 is not a name"),
    ],
)
def test_bad_inria(change: dict, expected: str, tmp_path: Path) -> None:
    entry = {"img_name": "a", "width": 640, "height": 480, "fx": 500.0, "fy": 510.0}
    entry |= {"position": [0.0, 0.0, 0.0], "rotation": np.eye(3).tolist()}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([entry, entry | change]))
    poses = read_posed_images(path)
    assert [one.name for one in poses.images] == ["a"]
    assert [one.reason for one in poses.excluded] == [f"{path}: camera 1: {expected}; export the poses again"]
    # If no camera is valid, the reason is raised as an error.
    path.write_text(json.dumps([entry | change] * 2))
    assert message(path) == f": camera 0: {expected}; export the poses again"


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {"camera_angle_x": 4.0},
            ": frame 0: camera_angle_x 4.0 is not an angle between 0 and pi; export the poses again",
        ),
        ({"k1": "much"}, ": frame 0: k1 much is not a finite number; export the poses again"),
        (
            {"camera_model": "EQUIRECTANGULAR"},
            f": frame 0 has the unknown lens model 'EQUIRECTANGULAR'; give one of {', '.join(LENSES)}",
        ),
        ({"w": None}, ": it has no w and h, and none of its photos can be read; add w and h, or the photos"),
        (
            {"transform_matrix": [[1]]},
            ": frame 0: transform_matrix of shape (1, 1) is not a matrix of 3 or 4 rows of 4 finite numbers; export the"
            " poses again",
        ),
    ],
)
def test_bad_transforms(change: dict, expected: str, tmp_path: Path) -> None:
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist(), "w": 8, "h": 8, "camera_angle_x": 0.7}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": [frame | change]}))
    assert message(path) == expected


def test_transforms_without_a_size(tmp_path: Path) -> None:
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"camera_angle_x": 0.7, "frames": [frame]}))
    assert message(path) == ": it has no w and h, and none of its photos can be read; add w and h, or the photos"
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n no")
    assert message(path) == ": it has no w and h, and none of its photos can be read; add w and h, or the photos"
    # The first photo that can be read determines the size of all photos.
    path.write_text(json.dumps({"camera_angle_x": 0.7, "frames": [frame, frame | {"file_path": "b"}]}))
    Image.new("RGB", (12, 8)).save(tmp_path / "b.png")
    assert [(view.camera.width, view.camera.height) for view in read_cameras(path)] == [(12, 8)] * 2


def test_bad_colmap(tmp_path: Path) -> None:
    colmap_text(tmp_path, camera="3 EQUIRECTANGULAR 640 480 640 480")
    assert message(tmp_path).startswith(
        "cameras.txt: camera 3 (line 2) of model EQUIRECTANGULAR with 2 parameters is unknown; undistort the photos"
        " with `colmap image_undistorter`, or give one of SIMPLE_PINHOLE, PINHOLE, "
    )
    colmap_text(tmp_path, camera="4 PINHOLE 640 480 500 510 320 240")
    assert (
        message(tmp_path)
        == "images.txt: image sub/with space.jpg has camera 3, which is missing in cameras.txt; export the model again"
    )
    colmap_text(tmp_path, camera="3 PINHOLE 640 480 500 510 320")
    assert message(tmp_path).startswith("cameras.txt: camera 3 (line 2) of model PINHOLE with 3 parameters is unknown")
    colmap_text(tmp_path, camera="3 PINHOLE wide")
    assert message(tmp_path) == "cameras.txt: malformed camera in line 2, '3 PINHOLE wide'; export the model again"
    (tmp_path / "cameras.txt").unlink()
    assert message(tmp_path) == "cameras.txt: no such file or folder; a COLMAP model needs it"
    colmap_binary(tmp_path)
    data = (tmp_path / "images.bin").read_bytes()
    (tmp_path / "images.bin").write_bytes(data[:-30])
    assert message(tmp_path) == f"images.bin: truncated at {len(data) - 30} bytes; copy or export it again"
    (tmp_path / "images.bin").write_bytes(bytes(8))
    assert message(tmp_path) == "images.bin: it has no images; reconstruct the scene again"


@pytest.mark.filterwarnings("error")
@settings(max_examples=examples(100))
@given(st.data())
@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "cameras.bin", "images.bin", "transforms.json"])
def test_any_bytes(name: str, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if name.endswith(".bin"):
            colmap_binary(folder)
        elif name.endswith(".txt"):
            colmap_text(folder)
        else:
            frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist(), "w": 8, "h": 8, "fl_x": 1.0, "cx": 4.0}
            (folder / name).write_text(json.dumps({"frames": [frame]}))
        content = bytearray((folder / name).read_bytes())
        for _ in range(data.draw(st.integers(1, 3))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(
                st.sampled_from(b"0 9\n-") | st.integers(0, 255)
            )
        keep = data.draw(st.just(len(content)) | st.integers(0, len(content)))
        (folder / name).write_bytes(content[:keep])
        try:
            posed = read_cameras(folder)
        except UserError as error:
            assert "\n" not in str(error)
            return
        for view in posed:
            np.testing.assert_allclose(view.camera.rotation @ view.camera.rotation.T, np.eye(3), atol=3e-3)
            assert np.isfinite(view.camera.translation).all() and view.camera.fx > 0
