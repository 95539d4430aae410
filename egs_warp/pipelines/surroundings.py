"""The surroundings of the bodies of a world: what remains of a captured scene, as background and as obstacles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.contact.terrain import Solid
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.short_repr import short_repr


@dataclass(frozen=True)
class Surroundings:
    """Scene without the objects that have become bodies; metres, in the frame of the world."""

    __repr__ = short_repr

    frame: BodyFrame
    """Frame of the world in the capture."""
    cloud: GaussianCloud
    """Gaussians behind the bodies."""
    ground: HeightField | None = None
    """Ground; None if it is the plane z = 0 without an edge."""
    solids: tuple[Solid, ...] = ()
    """Convex parts of the obstacles beside and above the ground; they are not drawn, because ``cloud`` shows them."""
    views: np.ndarray | None = None
    """(n, 3) directions to the cameras of the capture; None if they are unknown."""
