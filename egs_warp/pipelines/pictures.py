"""Pictures that show the results of plane search and segmentation, for visual checks."""

from __future__ import annotations

from collections.abc import Sequence
from colorsys import hsv_to_rgb
from textwrap import wrap

import numpy as np

from egs_warp.geometry.camera import Camera, downscale
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.video import contact_sheet
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.render.shadow import ContactShadow

_BACKDROP = (0.55, 0.75, 0.55)
_SIDE = 480
_LINES, _LETTERS, _LINE_LENGTH = 40, 2100.0, 110
"""Width of a sheet, relative to the height of a line of text below it and to the size of the letters in OpenCV's unit,
and maximum number of characters in a line."""


def picture_cameras(plane: Plane, centre: np.ndarray, size: float, cameras: Sequence[Camera] = ()) -> list[Camera]:
    """Return four evenly chosen ``cameras`` above the plane; if there are fewer than four, return four cameras on a
    ring."""
    above = [camera for camera in cameras if plane.heights(camera.centre) > 0.0]
    if len(above) >= 4:
        return [downscale(above[len(above) * k // 4], _SIDE) for k in range(4)]
    return ring_cameras(plane, centre, 0.7 * size, count=4, elevations=(12.0, 35.0), size=_SIDE)


def plane_picture(
    cloud: GaussianCloud, planes: Sequence[Plane], cameras: Sequence[Camera], *, centre: np.ndarray, size: float
) -> np.ndarray:
    """Draw the capture with a coloured grid on each plane, faint where the capture hides it.

    Args:
        cloud: The capture.
        planes: Planes, scene units.
        cameras: One picture is drawn for each.
        centre: (3,) Centre of the object.
        size: Size of the object, scene units; the grid has ten lines in this length.

    Returns:
        (H, W, 3) uint8, a contact sheet.
    """
    frames = []
    for camera in cameras:
        image = render_gaussians(cloud, camera)
        picture = np.clip(image.colour.numpy(), 0.0, 1.0)
        depth = np.where(image.alpha.numpy() > 0.5, image.depth.numpy(), np.inf)
        for number, plane in enumerate(planes):
            # Hues at golden-ratio distances are distinct for any number of planes.
            colour = np.array(hsv_to_rgb((0.92 + 0.618 * number) % 1.0, 0.85, 0.95))
            floor_grid, cell = ContactShadow(camera, plane, centre=centre, reach=size, device=cloud.device), 0.1 * size
            flat, pixel, ground = (
                values.numpy().reshape(*depth.shape, -1)
                for values in (floor_grid.flat, floor_grid.pixel, floor_grid.depth)
            )
            distance = np.abs((flat / cell + 0.5) % 1.0 - 0.5) * cell
            line = np.clip(1.6 - distance / pixel, 0.0, 1.0).max(axis=-1)
            line *= np.clip(4.0 - 2.0 * np.linalg.norm(flat, axis=-1) / size, 0.0, 1.0) * (ground[..., 0] > 0.0)
            line *= np.where(ground[..., 0] < 1.01 * depth, 0.9, 0.12)
            picture = picture + line[..., None] * (colour - picture)
        frames.append(_bytes(picture))
    return contact_sheet(frames, 2, ["the grid must lie on what the object stands on", "", "", ""][: len(frames)])


def segmentation_picture(
    cloud: GaussianCloud,
    object_cloud: GaussianCloud,
    background: GaussianCloud,
    cameras: Sequence[Camera],
    words: Sequence[str] = (),
) -> np.ndarray:
    """Draw three rows, the capture, the object alone and the background alone, with lines of text below.

    Args:
        cloud: The capture.
        object_cloud: The object.
        background: The background.
        cameras: Columns of the sheet.
        words: Lines of text.

    Returns:
        (H, W, 3) uint8.
    """
    frames = [_bytes(render_gaussians(cloud, camera).colour.numpy()) for camera in cameras]
    for part in (object_cloud, background):
        frames += [_bytes(render_gaussians(part, camera, background=_BACKDROP).colour.numpy()) for camera in cameras]
    labels = [""] * len(frames)
    for row, text in enumerate(("capture", "object", "background")):
        labels[row * len(cameras)] = text
    sheet = contact_sheet(frames, len(cameras), labels)
    if not words:
        return sheet
    # Draw the text on a separate sheet with one column, so that lines may be as wide as the whole sheet.
    return np.concatenate([sheet, _text(words, sheet.shape[1])])


def _text(words: Sequence[str], width: int) -> np.ndarray:
    """Return an image (H, ``width``, 3) uint8 of lines of text, whose letters are scaled with the width."""
    import cv2

    lines = [line for text in words for line in wrap(text, _LINE_LENGTH)]
    size, height = max(width / _LETTERS, 0.35), max(width // _LINES, 16)
    strip = np.full((height * len(lines), width, 3), 255, np.uint8)
    for number, line in enumerate(lines):
        place = (height // 2, round((number + 0.7) * height))
        cv2.putText(
            strip, line, place, cv2.FONT_HERSHEY_SIMPLEX, size, (20,) * 3, max(1, round(1.4 * size)), cv2.LINE_AA
        )
    return strip


def _bytes(picture: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8)
