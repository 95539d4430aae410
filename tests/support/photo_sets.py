"""Small sets of posed photos in the layouts of other tools."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from egs_warp.geometry.camera import Camera
from egs_warp.io.cameras import PosedImages

WIDTH, HEIGHT, FOCAL = 24, 18, 28.0
NAMES = ("00.jpg", "01.jpg", "02.jpg", "03.jpg")


def cameras(count: int = len(NAMES)) -> list[Camera]:
    """Return cameras around the origin, with +z up."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        Camera(
            *(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, view.rotation, view.translation),
        )
        for view in (
            Camera.look_at(
                np.array([3 * np.cos(a), 3 * np.sin(a), 1.0]), np.zeros(3), np.array([0, 0, 1.0]), width=4, height=4
            )
            for a in angles
        )
    ]


def write_photos(folder: Path, names: Sequence[str] = NAMES, *, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    """Write photos, each of a single shade of grey."""
    for number, name in enumerate(names):
        write_picture(folder / name, np.full((size[1], size[0], 3), 40 + 20 * number, np.uint8))


def write_picture(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, "JPEG" if path.suffix.lower() in (".jpg", ".jpeg") else "PNG")


def image_lines(names: Sequence[str] = NAMES) -> list[str]:
    """Return the first line of each image in COLMAP's ``images.txt``."""
    lines = []
    for number, (name, camera) in enumerate(zip(names, cameras(len(names)), strict=True), start=1):
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        values = " ".join(f"{value:.9g}" for value in (w, x, y, z, *camera.translation))
        lines.append(f"{number} {values} 1 {name}")
    return lines


CAMERA_LINE = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}"


def write_colmap(folder: Path, names: Sequence[str] = NAMES, *, camera: str = CAMERA_LINE) -> None:
    """Write a COLMAP model as text."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(camera + "\n")
    (folder / "images.txt").write_text("".join(f"{line}\n\n" for line in image_lines(names)))


def frames(names: Sequence[str] = NAMES) -> list[dict]:
    """Return the frames of a ``transforms.json``."""
    entries = []
    for name, camera in zip(names, cameras(len(names)), strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = camera.centre
        entries.append({"file_path": name, "transform_matrix": matrix.tolist()})
    return entries


def write_transforms(folder: Path, entries: list[dict], **shared: object) -> None:
    """Write a ``transforms.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    shared = shared or {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL}
    (folder / "transforms.json").write_text(json.dumps({**shared, "frames": entries}))


def silhouettes(count: int = len(NAMES)) -> list[np.ndarray]:
    """Return masks (H, W), uint8, of a ball of radius 0.5 away from the origin: 255 inside its silhouette, else 0."""
    masks = []
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for camera in cameras(count):
        rays = np.stack([(columns - camera.cx) / FOCAL, (rows - camera.cy) / FOCAL, np.ones((HEIGHT, WIDTH))], -1)
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ camera.rotation
        to_centre = np.array([0.1, 0.0, 0.05]) - camera.centre
        off = np.linalg.norm(to_centre - (rays @ to_centre)[..., None] * rays, axis=-1)
        masks.append(np.where(off < 0.5, 255, 0).astype(np.uint8))
    return masks


def check_poses(poses: PosedImages, offset: np.ndarray | float = 0.0, *, atol: float = 1e-9) -> None:
    """Assert that the photos are found with the poses of ``cameras`` translated by ``offset``."""
    assert [one.name.removesuffix(".jpg") for one in poses.images] == [name.removesuffix(".jpg") for name in NAMES]
    for one, camera in zip(poses.images, cameras(), strict=True):
        assert one.image is not None and one.image.stem == one.name.removesuffix(".jpg")
        np.testing.assert_allclose(one.camera.rotation, camera.rotation, atol=1e-9)
        np.testing.assert_allclose(one.camera.centre, camera.centre + offset, atol=atol)
        values = (one.camera.width, one.camera.height, one.camera.fx, one.camera.fy, one.camera.cx, one.camera.cy)
        np.testing.assert_allclose(values, [WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])
