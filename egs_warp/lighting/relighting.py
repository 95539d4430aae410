"""Relighting of a moving creature: its captured colours, scaled by the irradiance at the rotated normals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.main_light import DISPLAY_GAMMA, MainLight, mean_irradiance
from egs_warp.kernels.lighting.relighting import relight_kernel
from egs_warp.launching import launch_rows
from egs_warp.lighting.surface_normals import surface_normals


class Relighter:
    """Relighting of one cloud in successive poses; each call writes into the same array."""

    def __init__(self, rest: GaussianCloud, light: MainLight) -> None:
        """Compute the normals of the cloud ``rest``. The ``light`` is in the axes of that cloud."""
        self._form = wp.mat44(*np.float32(light.irradiance / mean_irradiance(light)).ravel().tolist())
        self._normals = wp.array(surface_normals(rest).astype(np.float32), dtype=wp.vec3, device=rest.device)
        self._sh = wp.empty_like(rest.sh)

    def relight(self, cloud: GaussianCloud, rotations: wp.array) -> GaussianCloud:
        """Return the deformed ``cloud`` with new colours; the next call overwrites them.

        Args:
            cloud: the n Gaussians of the rest cloud, deformed.
            rotations: (n,) vec4, unit quaternions w, x, y, z of the rotations from the rest pose.
        """
        launch_rows(
            relight_kernel,
            cloud.count,
            inputs=[self._form, 1.0 / DISPLAY_GAMMA, self._normals, rotations, cloud.sh],
            outputs=[self._sh],
            device=cloud.device,
        )
        return replace(cloud, sh=self._sh)
