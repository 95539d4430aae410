"""Camera of a page's picture, for comparison with pictures of this package."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from egs_warp.geometry.camera import Camera


def page_camera(page: Any, stage: str) -> Camera:
    """Return the camera of the JavaScript expression ``stage``, a ``Stage`` of the page."""
    eye, target, fov, width, height, right, down = page.evaluate(
        f"""() => {{
            const {{ camera, controls, canvas }} = {stage};
            const {{ offsetX, offsetY, fullHeight }} = camera.view, scale = canvas.height / fullHeight;
            const offset = [scale * offsetX, scale * offsetY];
            const [eye, target] = [camera.position.toArray(), controls.target.toArray()];
            return [eye, target, camera.fov, canvas.width, canvas.height, ...offset];
        }}"""
    )
    up = np.array([0.0, 0.0, 1.0])
    camera = Camera.look_at(
        np.array(eye), np.array(target), up, width=width, height=height, vertical_fov_degrees=fov, near=0.02
    )
    return replace(camera, cx=camera.cx - right, cy=camera.cy - down)
