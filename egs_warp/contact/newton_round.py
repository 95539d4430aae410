"""One round of Newton's method on velocities and contact forces with fixed contacts, in one world or in many (Eq. 4, 8,
9).

``run_round`` is the iteration. A world takes a full Newton step, whose contact forces satisfy Coulomb's law for its
contact-free velocities, and halves it until the rule of ``newton_convergence`` accepts it. The round then ends if it
has converged or failed, or if points outside the contact set penetrate too far and must be added. Otherwise the tangent
is renewed if necessary, and the next step follows. ``coupled_step`` implements the protocol ``NewtonWorlds`` for one
world on the host or on a GPU, ``batch_step`` for many worlds.
"""

from __future__ import annotations

from collections.abc import Sized
from typing import Protocol, TypeVar

from egs_warp.kernels.contact.newton_convergence import ENDED, FAILED, NEAR_END, NEEDS_TANGENT, SHORTEN

WorldsT = TypeVar("WorldsT", bound=Sized)
"""Type of a set of worlds, for example a tensor of their indices."""


class NewtonWorlds(Protocol[WorldsT]):
    """Worlds that run one round together. Arguments named ``worlds`` are results of ``running`` or ``active``."""

    def running(self) -> WorldsT:
        """Return the active worlds that have steps left."""
        ...

    def active(self, bits: int) -> WorldsT:
        """Return the active worlds whose last trial had any of ``bits`` as its outcome."""
        ...

    def take_step(self, worlds: WorldsT) -> None:
        """Take a full Newton step in each of the ``worlds``, judge its trial, and make it the iterate if accepted."""
        ...

    def halve_step(self, worlds: WorldsT) -> None:
        """Judge the trial at the reduced length of the last Newton step in each of the ``worlds``."""
        ...

    def stop(self, bits: int) -> None:
        """End the round of the worlds whose last trial had any of ``bits`` as its outcome."""
        ...

    def check_penetration(self, worlds: WorldsT) -> None:
        """End the round of each of the ``worlds`` whose contacts must be extended by penetrating points."""
        ...

    def renew_tangent(self, worlds: WorldsT) -> None:
        """Factor the tangents of the ``worlds`` at their velocities and linearise their contacts. End the round of
        worlds whose tangent cannot be factored."""
        ...


def run_round(newton: NewtonWorlds[WorldsT]) -> None:
    """Iterate until the round of every world has ended."""
    while len(worlds := newton.running()) > 0:
        newton.take_step(worlds)
        while len(short := newton.active(SHORTEN)) > 0:
            newton.halve_step(short)
        newton.stop(ENDED | FAILED)
        if len(near := newton.active(NEAR_END)) > 0:
            newton.check_penetration(near)
        if len(fresh := newton.active(NEEDS_TANGENT)) > 0:
            newton.renew_tangent(fresh)
