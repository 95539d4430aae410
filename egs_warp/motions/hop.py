"""Hops: jumps in a row, each to its own square, aimed from where the one before has landed (DESIGN 9)."""

from __future__ import annotations

import numpy as np

from egs_warp.motions.jump import JumpTarget
from egs_warp.motions.leap import Leap
from egs_warp.motions.sequence import Part, Place
from egs_warp.motions.stance import Weights, sole_shares


class Hop(Leap):
    """A jump whose feet aim at a point of the ground."""

    def __init__(self, place: Place, square: np.ndarray, height: float, *, weights: Weights | None = None) -> None:
        """``square`` (3,): where the middle of the feet shall land;
        ``height``: rise of the centre of mass, both metres.
        """
        feet = sole_shares(place.body, place.ground, place.standing) @ place.standing
        way = square - feet
        place = place.facing(way)
        forward, _, rise = place.ground.axes @ way
        super().__init__(
            place,
            JumpTarget(float(forward), height + max(float(rise), 0.0), float(rise)),
            weights=weights,
        )
        self._feet = sole_shares(place.body, place.ground, place.standing)
        self.square = square

    def miss(self, positions: np.ndarray) -> float:
        """Metres from the middle of the feet to the middle of the square, along the ground."""
        off = self._feet @ positions - self.square
        return float(np.linalg.norm(off - (off @ self.ground.axes[2]) * self.ground.axes[2]))


class Squares:
    """A row of squares ahead of a place; made when the first hop begins,
    so that later ones do not add up their errors.
    """

    def __init__(self, distance: float, height: float, count: int, asked: dict[str, float]) -> None:
        """``distance`` from square to square and ``height`` of each jump in metres; ``asked`` is what a report says."""
        self.distance, self.height, self.count, self.asked = distance, height, count, asked
        self._first: np.ndarray | None = None
        self._way = np.zeros(3)
        self._clearance = 0.0

    def parts(self) -> list[Part]:
        """The hops, for a sequence."""
        return [
            Part("hop", {**self.asked, "square": float(k)}, lambda place, k=k: self._begin(place, k))
            for k in range(1, self.count + 1)
        ]

    def _begin(self, place: Place, number: int) -> Hop:
        if self._first is None:
            share = sole_shares(place.body, place.ground, place.standing)
            self._first = share @ place.standing
            self._way = place.ground.axes[0]
            # The middle of the feet is a little above what they stand on.
            self._clearance = -place.rise_at(self._first)
        square = self._first + number * self.distance * self._way
        rise = place.rise_at(square) + self._clearance
        return Hop(place, square + rise * place.ground.axes[2], self.height)
