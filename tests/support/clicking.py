"""Two balls on a floor, and clicks on the balls."""

from __future__ import annotations

import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.segmentation.clicks import Click, click_at
from tests.support.grounds import level
from tests.support.scenes import lying, round_ones, shell

SPAN = 1.0
"""Distance between the centres of two balls that touch."""


def balls(tones: tuple[float, float], between: float = SPAN) -> GaussianCloud:
    """Return two balls of diameter 1 on a floor, with 1500 Gaussians each, the left one first. ``tones`` are their
    shades of grey, ``between`` is the distance between their centres."""
    skin = shell()
    left, right = skin - [0.5 * between, 0.0, 0.0], skin + [0.5 * between, 0.0, 0.0]
    cloud = concatenate(
        round_ones(np.concatenate([left, right]), 0.025), lying(level((-2.0, -1.5), (2.0, 1.5), 0.0, 0.05))
    )
    sh = cloud.sh.numpy()
    sh[:1500], sh[1500:3000] = tones
    return GaussianCloud.from_numpy(
        cloud.means.numpy(), cloud.rotations.numpy(), cloud.log_scales.numpy(), cloud.opacity_logits.numpy(), sh
    )


def front(width: int = 200) -> Camera:
    """Return a camera that shows both balls from the front."""
    eye = np.array([0.0, -5.0, 1.2])
    return Camera.look_at(eye, np.array([0.0, 0.0, 0.4]), np.array([0.0, 0.0, 1.0]), width=width, height=width)


def click(cloud: GaussianCloud, point: tuple[float, float, float], *, inside: bool = True) -> Click:
    """Return a click on a point as seen by the camera ``front()``."""
    camera = front()
    x, y, z = camera.rotation @ np.array(point) + camera.translation
    hit = click_at(cloud, camera, camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z, inside=inside)
    assert hit is not None
    return hit
