"""Support of a body by its ground and by other bodies at rest: passive steps among them, and supporting contacts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.coupled_step import CoupledResult
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.driven_step import FixedDrive
from egs_warp.locomotion.stepper import LocomotionStepper, WarmStart
from egs_warp.locomotion.world_stepper import WorldBody, WorldStepper
from egs_warp.short_repr import short_repr

MIN_UPWARD = 0.5
"""Minimum vertical component of the normal of a contact that supports a body; other contacts touch it from the side."""


@dataclass(frozen=True)
class Support:
    """Contacts from below of a body at rest."""

    __repr__ = short_repr

    points: np.ndarray
    """(k, 3) m, points of contact."""
    normals: np.ndarray
    """(k, 3) unit normals towards the body."""
    faces: np.ndarray
    """(k,) int32, face of the ground or of a solid (``ContactSet.faces``), or -1 minus the index of the other body."""

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit vector, mean of the normals."""
        total = self.normals.sum(axis=0)
        return total / np.linalg.norm(total)


def ground_support(stepper: LocomotionStepper, state: BodyState, distance: float) -> Support:
    """Return the contacts with the ground and the solids that support a body in ``state``: points of the body that are
    closer than ``distance`` metres to a surface below."""
    positions = state.positions
    near = np.flatnonzero(stepper.detector.gaps(positions)[0] < distance)
    return _from_below(stepper.body, stepper.detector.contact_set(near, positions), positions)


class StepperAmongBodies:
    """Passive steps of a body on its ground and among other bodies, which do not move. Self contact is neglected, as
    where a body alone comes to rest."""

    def __init__(
        self, body: WorldBody, others: Sequence[WorldBody], states: Sequence[BodyState], frictions: np.ndarray
    ) -> None:
        """Make the stepper.

        Args:
            body: the body.
            others: other bodies.
            states: their states at rest.
            frictions: (k, k) Coulomb coefficients between the bodies, of which ``body`` is the first.
        """
        self._stepper = body.stepper
        bodies = (replace(body, self_contact=False), *(replace(other, drive=FixedDrive()) for other in others))
        self._island = WorldStepper(bodies, frictions=frictions).island(tuple(range(len(bodies))))
        self._states = tuple(states)

    @property
    def body(self) -> SoftBody:
        """The soft body."""
        return self._stepper.body

    def initial_memory(self) -> WarmStart:
        """Return the warm start of a first step."""
        return self._stepper.initial_memory()

    def passive_step(self, state: BodyState, memory: WarmStart, dt: float) -> CoupledResult:
        """Solve a step of ``dt`` s without muscles. The ``points`` of ``memory`` and of the contacts of the result are
        indices of ``PairContactDetector``."""
        result = self._island.passive_step((state, *self._states), memory.points, memory.forces, dt)
        return replace(result, velocities=result.velocities[: len(state.positions)])

    def support(self, state: BodyState, distance: float) -> Support:
        """Return the contacts that support the body in ``state``: those with the ground (``ground_support``), and
        points of the body, or of another body, that are closer than ``distance`` metres to the surface of the other
        one below."""
        pairs, positions = self._island.contacts.pairs, np.concatenate([s.positions for s in (state, *self._states)])
        found = [ground_support(self._stepper, state, distance)]
        for a, b in pairs.body_pairs(positions):
            if 0 in (a, b):
                near = np.flatnonzero(pairs.gaps(a, b, positions) < distance)
                contacts = pairs.contact_set(pairs.indices(a, near, b), positions)
                if a != 0:
                    # The contact acts on this body in the opposite direction.
                    faces = np.full(len(near), -1 - a, np.int32)
                    contacts = replace(contacts, axes=-contacts.axes, faces=faces)
                found.append(_from_below(self.body, contacts, positions))
        points, normals, faces = (
            np.concatenate([getattr(each, name) for each in found]) for name in ("points", "normals", "faces")
        )
        return Support(points, normals, faces)


def _from_below(body: SoftBody, contacts: ContactSet, positions: np.ndarray) -> Support:
    """Return those of the ``contacts`` that act on ``body`` from below, for nodal ``positions`` (N, 3) m."""
    # The first four nodes of a contact are those of its point.
    points = np.einsum("nw,nwi->ni", contacts.weights[:, :4], positions[contacts.nodes[:, :4]])
    normals = contacts.axes[:, 0]
    up = -body.gravity / np.linalg.norm(body.gravity)
    below = normals @ up > MIN_UPWARD
    return Support(points[below], normals[below], contacts.faces[below])
