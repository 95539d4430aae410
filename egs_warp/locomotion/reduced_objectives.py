"""Objectives of a step as a few numbers of each world, from which a kernel computes their rows.

In the shapes below, "..." is the world axis, or nothing for one world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np

from egs_warp.fem.batched import ArrayT, BatchedRecord, contiguous, empty_like, launch_on
from egs_warp.kernels.locomotion.objective_rows import affine_rows_kernel
from egs_warp.locomotion.objectives import AngularMomentumObjective, AnyObjective, Objective, strain_modes
from egs_warp.precision import Vec3, real


@dataclass(frozen=True)
class AffineObjectives(BatchedRecord):
    """Objectives on the end velocity v, R in number, that cost weight (row . v - target)^2. Their rows are affine
    functions of the node positions x: the row of node n is sum_p s_pn (A_p (x_n - c) + b_p), with the shares s of P
    parts of the body and its centre of mass c at the start of the step."""

    names: tuple[str, ...]
    """(R,) name of each row."""
    coefficients: Any
    """(..., R, P, 3, 4) matrices (A_p, b_p)."""
    targets: Any
    """(..., R) m/s."""
    weights: Any
    """(..., R) weights."""

    @classmethod
    def combined(cls, parts: Sequence[AffineObjectives]) -> AffineObjectives:
        """Return the objectives of all ``parts`` on the same worlds."""
        return cls(
            tuple(name for part in parts for name in part.names),
            np.concatenate([part.coefficients for part in parts], axis=-4),
            np.concatenate([part.targets for part in parts], axis=-1),
            np.concatenate([part.weights for part in parts], axis=-1),
        )

    def expanded(self, worlds: np.ndarray, count: int) -> AffineObjectives:
        """Return these objectives of the ``worlds`` (k,) as objectives of ``count`` worlds, with the weight 0 in the
        other worlds."""
        if len(worlds) == count:
            return self

        def spread(values: np.ndarray) -> np.ndarray:
            all_worlds = np.zeros((count, *values.shape[1:]))
            all_worlds[worlds] = values
            return all_worlds

        return replace(self, **{name: spread(value) for name, value in self.batched_fields()})

    def rows(self, shares: ArrayT, centre: ArrayT, positions: ArrayT, scales: ArrayT) -> ArrayT:
        """Return the rows (B, R, 3N) of B worlds, on the device of the arguments.

        Args:
            shares: (P, N) weights of the nodes in each part.
            centre: (B, 3) m, centres of mass.
            positions: (B, N, 3) m.
            scales: (B, R) factors of the rows.
        """
        worlds, count, parts = self.coefficients.shape[:3]
        nodes = positions.shape[1]
        rows = empty_like(positions, (worlds, count, nodes, 3))
        by_row = self.coefficients.reshape(worlds, count, parts, 12)
        launch_on(
            positions,
            affine_rows_kernel,
            (worlds, count, nodes),
            inputs=[
                (shares, real),
                *((contiguous(each), Vec3) for each in (centre, positions)),
                *((contiguous(each), real) for each in (by_row, scales)),
            ],
            outputs=[(rows, Vec3)],
        )
        return rows.reshape(worlds, count, 3 * nodes)


@dataclass(frozen=True)
class ReducedObjectives(BatchedRecord):
    """Objectives of a step, on the end velocity and on the angular momentum."""

    affine: AffineObjectives
    """Objectives on the end velocity."""
    momentum: Any
    """(..., 3) kg m^2/s, target of the angular momentum (``AngularMomentumObjective``)."""
    momentum_weight: Any
    """(...,) weight of the objective on the angular momentum."""

    def of_one_world(self, shares: np.ndarray, positions: np.ndarray) -> list[AnyObjective]:
        """Return the objectives of a record of one world. Objectives on the end velocity with zero weight are left out,
        except that on the centre of mass.

        Args:
            shares: (P, N) weights of the nodes in each part.
            positions: (N, 3) m.
        """
        affine, ones = self.affine, np.ones((1, len(self.affine.names)))
        rows = affine.rows(shares, (shares[0] @ positions)[None], positions[None], ones)[0]
        momentum = AngularMomentumObjective(self.momentum[0], float(self.momentum_weight[0]))
        objectives: list[AnyObjective] = []
        keys = zip(affine.names, affine.weights[0], strict=True)
        first = 0
        for (name, weight), group in groupby(keys):
            last = first + len(list(group))
            if name != "com" and momentum not in objectives:
                objectives.append(momentum)
            if weight > 0.0 or name == "com":
                objectives.append(Objective(name, rows[first:last], affine.targets[0, first:last], float(weight)))
            first = last
        return objectives


def centre_of_mass_objectives(
    parts: int, axes: np.ndarray, velocity: np.ndarray, weights: np.ndarray
) -> AffineObjectives:
    """Return three objectives on the velocity of the centre of mass along ``axes``.

    Args:
        parts: number of parts P.
        axes: (..., 3, 3) unit vectors, as rows.
        velocity: (..., 3) m/s, target velocity along the axes.
        weights: (..., 3) weight of each axis.
    """
    coefficients = np.zeros((*velocity.shape, parts, 3, 4))
    coefficients[..., 0, :, 3] = axes
    return AffineObjectives(("com",) * 3, coefficients, velocity, weights)


def strain_objectives(parts: int, second: np.ndarray, target: np.ndarray, weight: np.ndarray) -> AffineObjectives:
    """Return six objectives on the mean rates of stretch and shear, see ``objectives.deformation_velocities``.

    Args:
        parts: number of parts P.
        second: (..., 3, 3) m^2, mass-weighted mean of the products a_i a_j of the arms (``strain_modes``).
        target: (..., 3, 3) m^2/s, mass-weighted mean of the products v_i a_j of the target velocities and the arms.
        weight: (...,) weight.
    """
    modes, is_independent = strain_modes(second)
    coefficients = np.zeros((*modes.shape[:-2], parts, 3, 4))
    coefficients[..., 0, :, :3] = modes
    targets = (modes * target[..., None, :, :]).sum(axis=(-2, -1))
    return AffineObjectives(("pose",) * 6, coefficients, targets, weight[..., None] * is_independent)
