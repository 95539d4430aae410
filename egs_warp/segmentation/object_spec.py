"""The user's description of an object, and the result of its segmentation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from egs_warp.checked_calls import checked_constructor
from egs_warp.errors import ArgumentError, UserError
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.votes import MaskedView
from egs_warp.short_repr import short_repr


@checked_constructor
@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the capture's frame."""

    __repr__ = short_repr

    low: Annotated[np.ndarray, 3]
    """(3,) corner with the lowest coordinates, scene units."""
    high: Annotated[np.ndarray, 3]
    """(3,) corner with the highest coordinates, scene units."""

    def __post_init__(self) -> None:
        if not (self.low < self.high).all():
            low, high = (",".join(f"{x:g}" for x in corner) for corner in (self.low, self.high))
            advice = "give the corner with the lowest coordinates, then the one with the highest"
            raise ArgumentError("box", advice, value=f"from {low} to {high}")

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return the mask (n,) bool of the points (n, 3) in the box."""
        return np.all((points >= self.low) & (points <= self.high), axis=1)


@checked_constructor
@dataclass(frozen=True)
class ObjectSpec:
    """The user's description of an object: one of masks, a box and a point, or the picked Gaussians, which replace the
    result of a search. Clicks add Gaussians to the object and remove others from it.

    Raises:
        ArgumentError: if nothing describes the object, or several of masks, a box and a point do.
    """

    __repr__ = short_repr

    masks: tuple[MaskedView, ...] = ()
    box: Box | None = None
    point: Annotated[np.ndarray, 3] | None = None
    """(3,) point on or in the object, scene units."""
    clicks: tuple[Click, ...] = ()
    """Clicks. Each one adds the Gaussians that it hits and the parts connected to them, or removes them."""
    picked: np.ndarray | None = None
    """(n,) bool, the object's Gaussians as picked by the user; no search takes place."""

    def __post_init__(self) -> None:
        searched = {"masks": self.masks or None, "box": self.box, "point": self.point}
        names = [name for name, value in searched.items() if value is not None]
        if len(names) > 1 or (not names and self.picked is None):
            problem = f"{' and '.join(names)} are given" if names else "nothing says where the object is"
            raise ArgumentError("object", f"{problem}; give one of {', '.join(searched)} and picked")
        if self.picked is not None and not (self.picked.ndim == 1 and self.picked.dtype == bool):
            array = f"of type {self.picked.dtype} and shape {self.picked.shape}"
            raise ArgumentError("picked", f"{array}; give True or False for each Gaussian of the capture")

    @classmethod
    def of_clicks(cls, clicks: Sequence[Click]) -> ObjectSpec:
        """Return the description of the object at the first of the ``clicks`` that adds something, corrected by all of
        them. Raises ``UserError`` if every click removes something."""
        for click in clicks:
            if click.inside:
                return cls(point=click.point, clicks=tuple(clicks))
        raise UserError("object: every click removes something; click on the object itself as well")


@dataclass(frozen=True)
class Segmentation:
    """The object among the Gaussians of a capture."""

    object_mask: np.ndarray
    """(n,) bool, the object's Gaussians, whose means lie above the plane."""
    buried_mask: np.ndarray
    """(n,) bool, Gaussians under the object's foot or claimed as its parts, with means near or below the plane, mostly
    hidden. They belong to neither object nor background."""
    floater_mask: np.ndarray
    """(n,) bool, Gaussians similar to the object but detached from it. They belong to neither object nor background."""
    size: float
    """Diagonal of the object's bounding box, scene units."""
    shared_colours: float = 0.0
    """Fraction of the object, by area, whose colours continue in the surroundings connected to it
    (``click_energy.shared_colours``); 0 if the object was not found by clicks in photos."""
    cut_sides: tuple[str, ...] = ()
    """Sides of the user's box, such as ``-x``, beyond which what is connected to the object continues; empty if the
    object was not found by a box."""

    @property
    def background_mask(self) -> np.ndarray:
        """(n,) bool, all other Gaussians."""
        return ~(self.object_mask | self.buried_mask | self.floater_mask)
