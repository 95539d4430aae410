"""Linear step and cost of a step on PyTorch tensors, for one world or many (Eq. 7, 13).

In the shapes below, "..." is the world axis, or nothing for one world. ``device_plan`` records these operations as CUDA
graphs of one world; ``batch_plan`` applies them to many worlds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from egs_warp.fem.batched import BatchedRecord
from egs_warp.fem.body import SoftBody
from egs_warp.locomotion.objectives import Objective
from egs_warp.locomotion.planner import WORK_WEIGHT
from egs_warp.locomotion.step_cost import EFFORT_WEIGHT


def synergy_impulses(
    rows: torch.Tensor, members: torch.Tensor, segment_forces: torch.Tensor, dt: float
) -> torch.Tensor:
    """Return the nodal impulses of the synergies at the bounds of their activations, (..., 3N, m) N s.

    Args:
        rows: (M, N) difference rows of the segments.
        members: (M, m) membership matrix of the synergies.
        segment_forces: (..., M, 3) N, forces with which segments pull their ends together at the bounds of their
            activations.
        dt: step size, s.
    """
    group_forces = (segment_forces[..., None] * members[:, None, :]).flatten(-2)
    impulses = (rows.T @ group_forces).mul_(-dt)
    return impulses.view(*impulses.shape[:-2], -1, members.shape[1])


def write_linear_step(
    solved: torch.Tensor, columns: torch.Tensor, predicted: torch.Tensor, weight: float, velocities: torch.Tensor
) -> None:
    """Write ``LinearStep.velocities``, v = v^ - J^-1 r0(v^) + dt J^-1 (A a + W^T f), Eq. (7).

    Args:
        solved: (..., 3N, m + 1) m/s, J^-1 times the impulses of the synergies and the residual r0 without muscles and
            contact.
        columns: (..., 3N, 3n) m/s per newton, dt J^-1 W^T.
        predicted: (..., 3N) m/s, predicted end velocities v^.
        weight: body weight, N.
        velocities: (..., 3N, m + 3n + 1) m/s, output.
    """
    m = solved.shape[-1] - 1
    velocities[..., :m] = solved[..., :-1]
    torch.mul(columns, weight, out=velocities[..., m:-1])
    torch.sub(predicted, solved[..., -1], out=velocities[..., -1])


@dataclass(frozen=True)
class WeightedRows(BatchedRecord):
    """Rows and targets of objectives on the end velocity, multiplied by sqrt(2 weight): rows with one entry, and dense
    rows.

    Padding with zeros has no effect.
    """

    indices: torch.Tensor
    """(..., S) int64, column of the entry of each row with one entry."""
    entries: torch.Tensor
    """(..., S) entries of the rows with one entry."""
    entry_targets: torch.Tensor
    """(..., S) m/s, targets of the rows with one entry."""
    rows: torch.Tensor
    """(..., R, 3N) dense rows."""
    targets: torch.Tensor
    """(..., R) m/s, targets of the dense rows."""

    def form(self, velocities: torch.Tensor) -> torch.Tensor:
        """Return the form G of ``LinearStep.objective_quadratic``, (..., k + 1, k + 1) (m/s)^2, for
        ``LinearStep.velocities`` (..., 3N, k + 1) m/s."""
        residual = self.entries[..., None] * torch.take_along_dim(velocities, self.indices[..., None], dim=-2)
        residual[..., -1] -= self.entry_targets
        dense = self.rows @ velocities
        dense[..., -1] -= self.targets
        return (residual.mT @ residual).add_(dense.mT @ dense)

    def value(self, velocities: torch.Tensor) -> torch.Tensor:
        """Return the sums of weighted squares (...,) (m/s)^2 at the end ``velocities`` (..., 3N) m/s."""
        residual = self.entries * velocities.gather(-1, self.indices) - self.entry_targets
        dense = (self.rows @ velocities[..., None])[..., 0] - self.targets
        return 0.5 * (residual.square().sum(-1) + dense.square().sum(-1))


def rows_of(objectives: Sequence[Objective], size: int) -> list[np.ndarray]:
    """Return the arrays of the ``WeightedRows`` of one world, for end velocities (size,)."""
    single, dense_rows, dense_targets = [], [np.zeros((0, size))], [np.zeros(0)]
    for objective in objectives:
        root, rows = np.sqrt(2.0 * objective.weight), objective.rows
        if not isinstance(rows, np.ndarray) and (np.diff(rows.indptr) == 1).all():
            single.append((rows.indices, root * rows.data, root * objective.target))
            continue
        dense_rows.append(root * (rows if isinstance(rows, np.ndarray) else rows.toarray()))
        dense_targets.append(root * objective.target)
    parts = [np.concatenate([np.zeros(0), *each]) for each in zip(*single, strict=True)] or [np.zeros(0)] * 3
    return [*parts, np.concatenate(dense_rows), np.concatenate(dense_targets)]


def add_effort(
    form: torch.Tensor, quadratic: torch.Tensor, linear: torch.Tensor, energy: torch.Tensor, body: SoftBody
) -> None:
    """Add the cost of ``step_cost.effort_cost`` to a quadratic form.

    Args:
        form: (..., k + 1, k + 1) quadratic form of the cost, updated in place.
        quadratic: (..., k + 1, k + 1) J, quadratic form of the elastic energy.
        linear: (..., k + 1) J, its linear term.
        energy: (...,) J, energy at the predicted end.
        body: the body.
    """
    unit = EFFORT_WEIGHT / (body.weight * body.height)
    form.add_(quadratic, alpha=unit)
    form[..., -1].add_(linear, alpha=unit)
    form[..., -1, -1].add_(linear[..., -1] + 2.0 * energy, alpha=unit)


def add_activation_cost(
    form: torch.Tensor, diagonal: torch.Tensor, linear: torch.Tensor, constant: torch.Tensor, squared_work: torch.Tensor
) -> None:
    """Add the costs of the size and the change of the activations, and of the work of their muscles, to a quadratic
    form, as ``StepPlanner.program`` does.

    Args:
        form: (..., k + 1, k + 1) quadratic form of the cost, updated in place.
        diagonal: (m,) or (..., m) Hessian of the activations.
        linear: (..., m) linear term.
        constant: (...,) twice the constant.
        squared_work: (..., m) squared work of the muscles of each synergy at their bounds, in (m g H)^2.
    """
    m = squared_work.shape[-1]
    form.diagonal(dim1=-2, dim2=-1)[..., :m].add_(diagonal + (2.0 * WORK_WEIGHT) * squared_work)
    form[..., :m, -1].add_(linear)
    form[..., -1, -1].add_(constant)
