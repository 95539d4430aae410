"""Rendered masks of selected Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.votes import MaskedView


def masks_from_selection(cloud: GaussianCloud, selection: np.ndarray, cameras: Sequence[Camera]) -> list[MaskedView]:
    """Render masks through ``cameras``. A pixel is True if the Gaussians selected by ``selection`` (n,) bool contribute
    more than half of its light."""
    sh = np.zeros((cloud.count, 1, 3), np.float32)
    sh[:, 0, :] = np.where(selection, 0.5, -0.5)[:, None] / SH_BAND_0
    painted = GaussianCloud.from_numpy(
        cloud.means.numpy(),
        cloud.rotations.numpy(),
        cloud.log_scales.numpy(),
        cloud.opacity_logits.numpy(),
        sh,
        antialiased=cloud.antialiased,
        device=str(cloud.device),
    )
    return [
        MaskedView(
            camera,
            render_gaussians(painted, camera, background=(0.0, 0.0, 0.0)).colour.numpy()[..., 0] > 0.5,
            f"view {k}",
        )
        for k, camera in enumerate(cameras)
    ]
