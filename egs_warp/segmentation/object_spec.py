"""Where the user says that the object is, and what was found there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.errors import UserError
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.votes import MaskedView


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the capture's frame."""

    low: np.ndarray
    """(3,)"""
    high: np.ndarray
    """(3,)"""

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool for points (n, 3)."""
        return np.all((points >= self.low) & (points <= self.high), axis=1)


@dataclass(frozen=True)
class ObjectSpec:
    """What the user says about where the object is: exactly one of masks, box and point; clicks add to it and take
    from it.
    """

    masks: tuple[MaskedView, ...] = ()
    box: Box | None = None
    point: np.ndarray | None = None
    """(3,) on or in the object, scene units."""
    clicks: tuple[Click, ...] = ()
    """What each hits goes along, with what hangs together with it, or does not."""

    @classmethod
    def of_clicks(cls, clicks: Sequence[Click]) -> ObjectSpec:
        """The first of the ``clicks`` that are on the object says where it is. Raises ``UserError`` if none is."""
        for click in clicks:
            if click.inside:
                return cls(point=click.point, clicks=tuple(clicks))
        raise UserError("object: every click takes something away; click on the object itself as well")


@dataclass(frozen=True)
class Segmentation:
    """The object among the Gaussians of a capture."""

    object_mask: np.ndarray
    """(n,) bool: the object, means above the plane."""
    buried_mask: np.ndarray
    """(n,) bool: of the object, but with means below the plane. Belongs to neither object nor background."""
    floater_mask: np.ndarray
    """(n,) bool: looks like the object's, but hangs apart from it. Belongs to neither."""
    size: float
    """Scene units: diagonal of the object's bounding box."""

    @property
    def background_mask(self) -> np.ndarray:
        """(n,) bool."""
        return ~(self.object_mask | self.buried_mask | self.floater_mask)
