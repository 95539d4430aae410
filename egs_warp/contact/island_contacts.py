"""Contacts of an island: each body with the ground, and the bodies with each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.coupled_step import CoupledSolver
from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.newton import NewtonIterate
from egs_warp.contact.pair_contact import PairContactDetector
from egs_warp.contact.selection import ACTIVATION_DEPTH

_MIN_RATIO = 1e-6
"""Lower bound of the Coulomb coefficients from which lengths of tangents are computed, because forces are divided by
these lengths."""


@dataclass(frozen=True)
class IslandContacts:
    """Detection and selection of the contacts of an island. Contacts are identified by the indices of
    ``PairContactDetector``; all arrays have the concatenated nodes of the bodies.

    The Coulomb solve of the island uses one coefficient mu, the largest. A contact with a smaller coefficient s mu has
    shorter tangents s t, with velocities s u_t and forces f_t / s. Its cone |f_t / s| <= mu f_n is that of the
    coefficient s mu.
    """

    grounds: tuple[ContactDetector, ...]
    """Detector of the contacts of each body with the ground."""
    pairs: PairContactDetector
    """Detector of the contacts between the bodies."""
    driven: frozenset[int]
    """Bodies that follow a path. They have no contacts with the ground."""
    frictions: np.ndarray
    """(k, k + 1) Coulomb coefficients of each body with each other body and, in the last column, with the ground."""

    @cached_property
    def friction(self) -> float:
        """The largest Coulomb coefficient."""
        return float(self.frictions.max())

    def tangent_lengths(self, keys: np.ndarray) -> np.ndarray:
        """Return (n, 3), the lengths of the axes of the contacts with the ``keys`` (n, 3) of ``PairContactDetector``: 1
        for the normal, and for the tangents the Coulomb coefficient divided by the largest one."""
        ratios = np.maximum(self.frictions[keys[:, 0], keys[:, 1]], _MIN_RATIO) / max(self.friction, _MIN_RATIO)
        return np.column_stack([np.ones(len(keys)), ratios, ratios])

    def select(self, previous: np.ndarray, loaded: np.ndarray, end_positions: np.ndarray) -> np.ndarray:
        """Select the contacts of a step.

        Args:
            previous: (m,) indices of the contacts of the previous step.
            loaded: (m,) bool, True for those that carried load.
            end_positions: (N, 3) m, at the end of a ballistic step (for a driven body, its prescribed end).

        Returns:
            (n,) indices, those of contacts with the ground first.
        """
        keys, selected = self.pairs.keys(previous), []
        for body, (ground, positions) in enumerate(self._by_body(end_positions)):
            if body in self.driven:
                continue
            own = (keys[:, 0] == body) & (keys[:, 1] < 0)
            points = self.pairs.bodies[body].selector.select(keys[own, 2], loaded[own], ground.gaps(positions)[0])
            selected.append(self.pairs.indices(body, points, -1))
        return np.concatenate([*selected, self.pairs.select(end_positions, previous, loaded)])

    def contact_set(self, indices: np.ndarray, positions: np.ndarray) -> ContactSet:
        """Return the contacts with the ``indices`` (n,), for nodal ``positions`` (N, 3) m at the start of the step."""
        keys = self.pairs.keys(indices)
        between = np.flatnonzero(keys[:, 1] >= 0)
        order, sets = [between], [self.pairs.contact_set(indices[between], positions)]
        for body, (ground, own_positions) in enumerate(self._by_body(positions)):
            own = np.flatnonzero((keys[:, 0] == body) & (keys[:, 1] < 0))
            order.append(own)
            sets.append(self._as_two_sided(body, ground.contact_set(keys[own, 2], own_positions)))
        joined = ContactSet.concatenated(sets).gather(np.argsort(np.concatenate(order)))
        return replace(joined, axes=joined.axes * self.tangent_lengths(keys)[:, :, None])

    def _as_two_sided(self, body: int, contacts: ContactSet) -> ContactSet:
        """Return the contacts of a body with the ground in the numbering of the island."""
        start = int(self.pairs.node_starts[body])
        nodes = (contacts.nodes + start).astype(np.int32)
        return replace(
            contacts,
            points=self.pairs.indices(body, contacts.points, -1),
            nodes=np.hstack([nodes, nodes]),
            weights=np.hstack([contacts.weights, np.zeros_like(contacts.weights)]),
            node_count=int(self.pairs.node_starts[-1]),
        )

    def find_penetrating(
        self, contacts: np.ndarray, start: np.ndarray, end: np.ndarray, tolerance: float
    ) -> np.ndarray:
        """Return the indices (k,) of points that would be too deep at the end of a step and are not contacts; see
        ``ContactSelector``.

        Args:
            contacts: (n,) indices of the contacts of the step.
            start: (N, 3) m, at the start of the step.
            end: (N, 3) m, at the end of the step.
            tolerance: penetration tolerance, m.
        """
        keys, found = self.pairs.keys(contacts), []
        for body, ((ground, before), (_, after)) in enumerate(
            zip(self._by_body(start), self._by_body(end), strict=True)
        ):
            if body in self.driven:
                continue
            gaps = ground.gaps(after)[0]
            if gaps.min() < -ACTIVATION_DEPTH * tolerance:
                own = keys[(keys[:, 0] == body) & (keys[:, 1] < 0), 2]
                selector, start_gaps = self.pairs.bodies[body].selector, ground.gaps(before)[0]
                points = selector.find_penetrating(own, gaps, start_gaps, tolerance)
                found.append(self.pairs.indices(body, points, -1))
        return np.concatenate([*found, self.pairs.find_penetrating(contacts, start, end, tolerance)])

    def min_gaps(self, positions: np.ndarray) -> np.ndarray:
        """Return (k,) m, the minimum gap of each body to the ground and to the other bodies, not to itself; at most 0
        for a driven body, which does not touch the ground."""
        parts = enumerate(self._by_body(positions))
        least = np.array([0.0 if body in self.driven else ground.gaps(part)[0].min() for body, (ground, part) in parts])
        for a, b in self.pairs.body_pairs(positions):
            if a != b:
                gap = self.pairs.gaps(a, b, positions).min()
                least[[a, b]] = np.minimum(least[[a, b]], gap)
        return least

    def min_self_gaps(self, positions: np.ndarray) -> np.ndarray:
        """Return (k,) m, the minimum gap of each body to other parts of itself; infinite without self contact."""
        least = np.full(len(self.grounds), np.inf)
        for body, pair_body in enumerate(self.pairs.bodies):
            if pair_body.self_contact:
                least[body] = self.pairs.gaps(body, body, positions).min()
        return least

    def _by_body(self, positions: np.ndarray) -> Sequence[tuple[ContactDetector, np.ndarray]]:
        """Return the detector of ground contacts and the positions of each body."""
        return list(zip(self.grounds, self.pairs.split(positions), strict=True))


@dataclass(frozen=True)
class IslandSolver(CoupledSolver):
    """Newton's method on velocities and contact forces of an island. ``detector`` and ``points`` are those of its first
    body and are not used."""

    contacts: IslandContacts = field(kw_only=True)
    """Contacts of the island."""

    @property
    def friction(self) -> float:
        """Coulomb coefficient."""
        return self.contacts.friction

    def with_penetrating_points(self, end: NewtonIterate[Any]) -> ContactSet | None:
        """Return the contacts of ``end``, extended by the points that are too deep at ``end``; None if no point is."""
        problem, contacts = end.linearization.tangent.problem, end.linearization.contacts
        start, tolerance = problem.state.positions, self.penetration_tolerance
        added = self.contacts.find_penetrating(contacts.points, start, problem.end_positions(end.velocities), tolerance)
        return None if len(added) == 0 else contacts.concatenate(self.contacts.contact_set(added, start))
