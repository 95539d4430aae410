"""Small set of photos with poses."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.render import render_gaussians
from tests.support.training_views import ball, ring


def posed_folder(folder: Path, *, count: int = 9, size: int = 32, alpha: bool = False) -> Path:
    """Write renders of a ball of Gaussians as a NeRF-synthetic data set."""
    folder.mkdir(parents=True, exist_ok=True)
    cloud = GaussianCloud.from_numpy(**ball(80), device="cpu")
    frames = []
    for number, camera in enumerate(ring(count, size)):
        picture = render_gaussians(cloud, camera, background=(0.2, 0.3, 0.4))
        pixels = picture.colour_srgb8()[:, :, ::-1]
        if alpha:
            pixels = np.dstack([pixels, np.rint(picture.alpha.numpy() * 255).astype(np.uint8)])
        assert cv2.imwrite(str(folder / f"r_{number}.png"), pixels)
        matrix = np.eye(4)
        matrix[:3, :3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = camera.centre
        frames.append({"file_path": f"r_{number}.png", "transform_matrix": matrix.tolist()})
    shared = {"w": size, "h": size, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    (folder / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    return folder
