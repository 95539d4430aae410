"""What a built-in object is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.gaussians import GaussianCloud
from egs_warp.plane import Plane


@dataclass(frozen=True)
class BuiltInObject:
    """A Gaussian object standing on its plane."""

    name: str
    cloud: GaussianCloud
    """Scene units."""
    plane: Plane
    """What it rests on, scene units."""

    @property
    def up(self) -> np.ndarray:
        """(3,) unit."""
        return self.plane.normal
