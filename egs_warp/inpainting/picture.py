"""Pictures that show the result of inpainting."""

from __future__ import annotations

import cv2
import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.inpainting.inpaint import InpaintResult
from egs_warp.io.video import contact_sheet
from egs_warp.render import render_gaussians

_DISTANCE = 3.2
"""Distance of the cameras from the hole, as a multiple of the hole's side."""


def before_and_after(result: InpaintResult, *, size: int = 384) -> np.ndarray:
    """Return (2 size, 4 size, 3) uint8: the scene before and after inpainting and the depth of the new floor, from two
    sides; and face-on pictures of the floor before and after."""
    kept = result.cloud.subset(~result.is_new)
    tiles, labels = [], []
    for number, camera in enumerate(_cameras(result, size)):
        before, after = render_gaussians(kept, camera), render_gaussians(result.cloud, camera)
        tiles += [before.colour_srgb8(), after.colour_srgb8(), depth_colours(after.depth.numpy())]
        labels += [f"before {number + 1}", f"after {number + 1}", f"depth {number + 1}"]
        face_on = result.before.colour if number == 0 else result.painted
        tiles.append(np.rint(255 * cv2.resize(face_on, (size, size), interpolation=cv2.INTER_AREA)).astype(np.uint8))
        labels.append("face-on, before" if number == 0 else "face-on, painted")
    return contact_sheet(tiles, 4, labels)


def depth_colours(depth: np.ndarray, near: float | None = None, far: float | None = None) -> np.ndarray:
    """Return a false-colour image (H, W, 3) uint8 RGB of ``depth``: near is dark blue, far is yellow, empty is white.
    The range defaults to the range of ``depth``."""
    seen = depth > 0.0
    if not seen.any():
        return np.full((*depth.shape, 3), 255, np.uint8)
    low, high = np.quantile(depth[seen], [0.02, 0.98])
    low, high = low if near is None else near, high if far is None else far
    grey = np.rint(255.0 * np.clip((depth - low) / max(high - low, 1e-12), 0.0, 1.0)).astype(np.uint8)
    colours = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(seen[..., None], colours, 255).astype(np.uint8)


def _cameras(result: InpaintResult, size: int) -> list[Camera]:
    """Return a high and a low camera, which show the hole from two sides."""
    window = result.window
    rows, columns = np.nonzero(result.hole)
    middle = window.points(np.array([[columns.mean(), rows.mean()]]))[0]
    side = float(max(np.ptp(rows), np.ptp(columns)) + 1) * window.texel
    first, second = window.plane.tangents()
    cameras = []
    for azimuth, elevation in ((0.6, np.radians(45.0)), (2.7, np.radians(22.0))):
        level = np.cos(azimuth) * first + np.sin(azimuth) * second
        eye = middle + _DISTANCE * side * (np.cos(elevation) * level + np.sin(elevation) * window.plane.normal)
        cameras.append(
            Camera.look_at(
                eye,
                middle,
                window.plane.normal,
                width=size,
                height=size,
                vertical_fov_degrees=38.0,
                near=0.02 * _DISTANCE * side,
            )
        )
    return cameras
