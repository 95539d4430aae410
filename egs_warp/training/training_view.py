"""A training picture, at full or reduced resolution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from egs_warp.checked_calls import checked_constructor
from egs_warp.geometry.camera import Camera, reduced_camera
from egs_warp.short_repr import short_repr


@checked_constructor
@dataclass(frozen=True)
class TrainingView:
    """A picture that a training run is to match."""

    __repr__ = short_repr

    camera: Camera
    image: Annotated[np.ndarray, "H", "W", 3]
    """(H, W, 3) float32, 0 to 1, display-referred."""
    alpha: Annotated[np.ndarray, "H", "W"] | None = None
    """(H, W) float32, alpha of ``image``, which is then not yet composited over a background; None if it is opaque."""
    weight: Annotated[np.ndarray, "H", "W"] | None = None
    """(H, W) float32, nonnegative weight of each pixel in the L1 loss; None weights all pixels equally."""
    name: str = ""
    """Name of the photo, for messages."""

    def reduced(self, factor: int) -> TrainingView:
        """Return the view with both sides divided by ``factor``, rounded down.

        Each pixel is the mean of ``factor`` x ``factor`` pixels, and has the smallest of their weights.
        """
        if factor == 1:
            return self
        camera = reduced_camera(self.camera, factor)
        width, height = camera.width, camera.height

        def blocks(values: np.ndarray) -> np.ndarray:
            """Return the pixels of each block as an array (height, width, factor^2, channels)."""
            used = values[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
            return used.swapaxes(1, 2).reshape(height, width, factor * factor, -1)

        weight = None if self.weight is None else blocks(self.weight).min(axis=2)[..., 0]
        if self.alpha is None:
            return replace(self, camera=camera, image=blocks(self.image).mean(axis=2), weight=weight)
        alpha = blocks(self.alpha)
        cover = alpha.mean(axis=2)
        image = (blocks(self.image) * alpha).mean(axis=2) / np.maximum(cover, 1e-6)
        return replace(self, camera=camera, image=image, alpha=cover[..., 0], weight=weight)
