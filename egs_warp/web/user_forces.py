"""What the hand of a user does to a body: a pull that lasts until it is released, and pushes of the next step."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.motions.push import kick_of
from egs_warp.motions.sequence import Stance
from egs_warp.web.messages import Pull, PushOnce
from egs_warp.web.spring import Spring


class UserForces:
    """The pull that goes on, and the pushes since the last step."""

    def __init__(self) -> None:
        self._spring: Spring | None = None
        self._pushes: list[PushOnce] = []

    @property
    def is_pulling(self) -> bool:
        """Whether a pull goes on."""
        return self._spring is not None

    @property
    def has_input(self) -> bool:
        """Whether the next step has something of a hand."""
        return self.is_pulling or bool(self._pushes)

    def pull(self, body: SoftBody, asked: Pull) -> None:
        """Pull towards another place, or at another node."""
        if self._spring is None or self._spring.node != asked.node:
            self._spring = Spring(body, asked.node)
        self._spring.target = np.array(asked.target)

    def release(self) -> None:
        """End the pull."""
        self._spring = None

    def push(self, asked: PushOnce) -> None:
        """Push in the next step."""
        self._pushes.append(asked)

    def clear(self) -> None:
        """Forget pull and pushes."""
        self._spring = None
        self._pushes.clear()

    def kick(self, place: Stance, state: BodyState, dt: float) -> np.ndarray | None:
        """(N, 3) m/s that they give the nodes in a step of ``dt`` s from ``state``; None if there are none."""
        hits, self._pushes = self._pushes, []
        kicks = [kick_of(place, np.array(hit.impulse), hit.height) for hit in hits]
        if self._spring is not None:
            kicks.append(self._spring.kick(state, dt))
        return np.sum(kicks, axis=0) if kicks else None
