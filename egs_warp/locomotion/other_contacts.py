"""Contacts of an island that the planned body does not touch, eliminated from its QP.

These contacts keep their predicted modes in the plan, so their forces are an affine function of the other unknowns:
the other bodies yield to the planned body as far as their own contacts permit. The solve of the step computes the
forces of all contacts again from Coulomb's law.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.locomotion.contact_modes import ContactModes, forces_in_modes


@dataclass(frozen=True)
class OtherContacts:
    """Contacts that are eliminated from a QP with m activations and the forces of n contacts, in the units of
    the QP."""

    retained: np.ndarray
    """(p,) contacts of the planned body, whose forces stay unknown."""
    others: np.ndarray
    """(n - p,) eliminated contacts."""
    coupled: np.ndarray
    """(c,) remaining unknowns, among all m + 3p, on which the forces of the eliminated contacts depend: those of bodies
    that have contacts with both."""
    forces: np.ndarray
    """(3 (n - p), c + 1) forces of the eliminated contacts as an affine function of the ``coupled`` unknowns, with the
    constant in the last column."""

    @classmethod
    def of(
        cls, retained: np.ndarray, rows: np.ndarray, offset: np.ndarray, friction: float, forces: np.ndarray
    ) -> OtherContacts | None:
        """Eliminate the contacts that are not in ``retained`` (p,).

        Args:
            retained: indices of the contacts of the planned body.
            rows: (3n, m + 3n) derivative of all contact velocities with respect to activations and forces.
            offset: (3n,) contact velocities at zero activations and forces.
            friction: Coulomb coefficient.
            forces: (n, 3) predicted contact forces, which determine the modes.

        Returns:
            The eliminated contacts; None if the equations of their forces are singular.
        """
        n = len(forces)
        others = np.setdiff1d(np.arange(n), retained)
        m = rows.shape[1] - 3 * n
        of_others = _coordinates(others)
        remaining, own_rows = np.concatenate([np.arange(m), m + _coordinates(retained)]), rows[of_others]
        coupled = np.flatnonzero(own_rows[:, remaining].any(axis=0))
        order = np.concatenate([remaining[coupled], m + of_others])
        modes = ContactModes.of(forces[others], friction)
        solved = forces_in_modes(own_rows[:, order], offset[of_others], friction, modes)
        return None if solved is None else cls(retained, others, coupled, solved)

    def contact_rows(self, rows: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative (3p, m + 3p) and the offset (3p,) of the velocities of the remaining contacts; ``rows``
        and ``offset`` are those of all contacts, as in ``of``."""
        of_retained, m = _coordinates(self.retained), rows.shape[1] - len(rows)
        own = rows[of_retained]
        yielding = own[:, m + _coordinates(self.others)] @ self.forces
        reduced = np.hstack([own[:, :m], own[:, m + of_retained]])
        reduced[:, self.coupled] += yielding[:, :-1]
        return reduced, offset[of_retained] + yielding[:, -1]

    def all_forces(self, x: np.ndarray) -> np.ndarray:
        """Return the forces (n, 3) of all contacts for the remaining unknowns ``x`` (m + 3p,)."""
        forces = np.empty((len(self.retained) + len(self.others), 3))
        forces[self.retained] = x[len(x) - 3 * len(self.retained) :].reshape(-1, 3)
        forces[self.others] = (self.forces[:, :-1] @ x[self.coupled] + self.forces[:, -1]).reshape(-1, 3)
        return forces


def contacts_of_nodes(contacts: ContactSet, nodes: slice) -> np.ndarray:
    """Return the indices of the contacts that involve a node of ``nodes``."""
    is_own = (contacts.nodes >= nodes.start) & (contacts.nodes < nodes.stop) & (contacts.weights != 0.0)
    return np.flatnonzero(is_own.any(axis=1))


def _coordinates(contacts: np.ndarray) -> np.ndarray:
    """Return the indices (3k,) of the force components of ``contacts`` (k,)."""
    return (3 * contacts[:, None] + np.arange(3)).ravel()
