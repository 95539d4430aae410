"""Forces of the user on a body: a pull, which lasts until it is released, and pushes, which act in the next step."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.motions.push import kick_of
from egs_warp.motions.sequence import Stance
from egs_warp.web.messages import Pull, PushOnce
from egs_warp.web.spring import Spring


class UserForces:
    """The active pull, and the pushes since the last step."""

    def __init__(self) -> None:
        self.push_count = 0
        """Number of pushes that have acted so far."""
        self.dropped_count = 0
        """Number of pushes that were removed before they acted."""
        self._spring: Spring | None = None
        self._pushes: list[PushOnce] = []

    @property
    def is_pulling(self) -> bool:
        """True if a pull is active."""
        return self._spring is not None

    @property
    def has_input(self) -> bool:
        """True if a pull or a push acts in the next step."""
        return self.is_pulling or bool(self._pushes)

    def pull(self, body: SoftBody, request: Pull) -> None:
        """Start a pull, or move the target of the active pull or its node."""
        if self._spring is None or self._spring.node != request.node:
            self._spring = Spring(body, request.node)
        self._spring.target = np.array(request.target)

    def release(self) -> None:
        """End the user's pull."""
        self._spring = None

    def push(self, request: PushOnce) -> None:
        """Add a push that acts in the next step."""
        self._pushes.append(request)

    def clear(self) -> None:
        """Remove the pull and all pushes."""
        self._spring = None
        self.dropped_count += len(self._pushes)
        self._pushes.clear()

    def kick(self, place: Stance, state: BodyState, dt: float) -> np.ndarray | None:
        """Return the velocities (N, 3), m/s, that the pull and pushes add to the nodes; None if there are none.

        Args:
            place: stance of the body, from which the height of a push is measured.
            state: state at the start of the step.
            dt: step size, s.
        """
        pushes, self._pushes = self._pushes, []
        self.push_count += len(pushes)
        kicks = [kick_of(place, np.array(push.impulse), push.height) for push in pushes]
        if self._spring is not None:
            kicks.append(self._spring.kick(state, dt))
        return np.sum(kicks, axis=0) if kicks else None
