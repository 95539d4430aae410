"""Reduced state of a body: the moments of its parts and its contacts, from which motions compute their objectives.

In the shapes below, "..." is the world axis, or nothing for one world. The functions take NumPy arrays of one world, or
PyTorch tensors of many worlds on a device.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.fem.batched import Array, BatchedRecord, array_module
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.locomotion.stepper import StepReport


@dataclass(frozen=True)
class PartMoments(BatchedRecord):
    """Moments of the P parts of a body. The first part is the whole body."""

    centres: Any
    """(..., P, 3) m, centre of mass of each part."""
    velocity: Any
    """(..., 3) m/s, velocity of the centre of mass of the body."""
    spin: Any
    """(..., 3) m^2/s, angular momentum about the centre of mass, divided by the mass of the body."""
    second: Any
    """(..., P, 3, 3) m^2, mean of the products a_i a_j of the arms about the centre of each part."""
    cross: Any
    """(..., P, 3, 3) m^2, mean of the products a_i b_j of the arms and the reference arms."""


def part_moments(shares: Array, reference: Array, positions: Array, velocities: Array) -> PartMoments:
    """Return the moments of the parts of a body.

    Args:
        shares: (P, N) weights of the nodes in each part, with a sum of 1; in the first part, they are the shares of the
            mass.
        reference: (..., N, 3) m, reference arms: nodes in a reference pose relative to their centre of mass, in any
            axes.
        positions: (..., N, 3) m, nodes.
        velocities: (..., N, 3) m/s, velocities of the nodes.
    """
    lib: Any = array_module(positions)
    centre = shares[0] @ positions
    arms = positions - centre[..., None, :]
    values = lib.concatenate([arms, reference, velocities], -1)
    means = shares @ values
    weighted = (shares[:, :, None] * arms[..., None, :, :]).swapaxes(-1, -2)
    products = weighted @ values[..., None, :, :]
    middles = means[..., :3]
    products = products - middles[..., None] * means[..., None, :]
    turning = products[..., 0, :, 6:]
    turning = turning - turning.swapaxes(-1, -2)
    spin = lib.stack([turning[..., 1, 2], turning[..., 2, 0], turning[..., 0, 1]], -1)
    return PartMoments(centre[..., None, :] + middles, means[..., 0, 6:], spin, products[..., :3], products[..., 3:6])


@dataclass(frozen=True)
class ReducedState(BatchedRecord):
    """Reduced state of a body at the start of a step."""

    time: Any
    """(...,) s, time."""
    moments: PartMoments
    lowest: Any
    """(...,) m, coordinate along the up axis of the lowest node."""
    contact_points: Any
    """(..., K, 3) m, contact points, of which the first ``contact_counts`` are valid."""
    contact_counts: Any
    """(...,) int, number of contact points."""
    load: Any
    """(...,) N, sum of the normal contact forces."""
    gap: Any
    """(...,) m, height of the lowest contact point above the ground."""

    def with_capacity(self, capacity: int) -> ReducedState:
        """Return the reduced state of one world on the host, with its contact points padded with zeros to
        ``capacity``."""
        points = np.zeros((capacity, 3))
        points[: len(self.contact_points)] = self.contact_points
        return replace(self, contact_points=points)


def contact_positions(contacts: ContactSet, positions: Array) -> Array:
    """Return the positions (..., K, 3) m of the contact points, for node ``positions`` (..., N, 3)."""
    if contacts.nodes.ndim == 2:
        return np.einsum("cw,cwi->ci", contacts.weights, positions[contacts.nodes])
    worlds = array_module(positions).arange(len(positions), device=positions.device)[:, None, None]
    return (contacts.weights[..., None] * positions[worlds, contacts.nodes.long()]).sum(-2)


def reduced_state(
    body: SoftBody, shares: np.ndarray, reference: np.ndarray, state: BodyState, report: StepReport | None
) -> ReducedState:
    """Return the reduced state of one world on the host, without a world axis.

    Args:
        body: the body.
        shares: (P, N) as for ``part_moments``.
        reference: (N, 3) as for ``part_moments``.
        state: the state.
        report: report of the previous step; None for a body that stands on the ground with its whole weight.
    """
    up = -body.gravity / np.linalg.norm(body.gravity)
    touching = np.zeros((0, 3))
    if report is not None and report.contacts.count > 0:
        touching = contact_positions(report.contacts, state.positions)
    return ReducedState(
        time=np.asarray(state.time),
        moments=part_moments(shares, reference, state.positions, state.velocities),
        lowest=(state.positions @ up).min(),
        contact_points=touching,
        contact_counts=np.asarray(len(touching)),
        load=np.asarray(body.weight if report is None else report.forces[:, 0].sum()),
        gap=np.asarray(0.0 if report is None else report.min_gap),
    )
