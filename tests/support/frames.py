"""Variants of a capture: shuffled, in another unit, translated or rotated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.deformation.rigid import to_body_frame
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane

TURN = Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix()


@dataclass(frozen=True)
class Lying:
    """Capture with its support plane, whose normal points up."""

    cloud: GaussianCloud
    plane: Plane

    @property
    def up(self) -> np.ndarray:
        return self.plane.normal

    def on_grid(self, step: float = 2.0**-12) -> Lying:
        """Round means to a grid, so that integer translations are exact."""
        return Lying(self._with(np.round(self.cloud.means.numpy().astype(np.float64) / step) * step), self.plane)

    def shuffled(self, seed: int = 0) -> Lying:
        return Lying(self.cloud.subset(np.random.default_rng(seed).permutation(self.cloud.count)), self.plane)

    def scaled(self, factor: float) -> Lying:
        return Lying(self.cloud.scaled(factor), self.plane.scaled(factor))

    def moved(self, shift: tuple[float, float, float]) -> Lying:
        return Lying(self._with(self.cloud.means.numpy().astype(np.float64) + shift), self.plane.moved(np.array(shift)))

    def turned(self, turn: np.ndarray = TURN) -> Lying:
        frame = BodyFrame(turn, np.zeros(3), 1.0)
        return Lying(to_body_frame(self.cloud, frame), frame.plane(self.plane))

    def _with(self, means: np.ndarray) -> GaussianCloud:
        return replace(self.cloud, means=wp.array(means.astype(np.float32), dtype=wp.vec3, device=self.cloud.device))
