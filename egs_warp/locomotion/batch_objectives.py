"""Objectives of many worlds on tensors, stacked with padding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from egs_warp.contact.contact_set import ContactSet
from egs_warp.fem.batch_problem import BatchProblem
from egs_warp.fem.batched import BatchedRecord
from egs_warp.locomotion.objectives import AngularMomentumObjective, AnyObjective, LoadObjective, Objective
from egs_warp.locomotion.step_tensors import WeightedRows, rows_of


@dataclass(frozen=True)
class BatchObjectives(BatchedRecord):
    """Objectives on the end of a step in c worlds; padding has no effect."""

    rows: WeightedRows
    """Objectives on the end velocity (``Objective``)."""
    momentum_weights: torch.Tensor
    """(c, J) weights of the objectives on the angular momentum (``AngularMomentumObjective``)."""
    momentum_targets: torch.Tensor
    """(c, J, 3) kg m^2/s, targets of the objectives on the angular momentum."""
    load_weights: torch.Tensor
    """(c, N) weight of the squared load at each node (``LoadObjective``)."""

    @classmethod
    def stack(
        cls, objectives: Sequence[Sequence[AnyObjective]], node_count: int, device: torch.device
    ) -> BatchObjectives:
        """Stack the ``objectives`` of each world, and upload them."""
        by_world = [rows_of([one for one in each if isinstance(one, Objective)], 3 * node_count) for each in objectives]
        indices, *others = ([world[part] for world in by_world] for part in range(5))
        momenta = [[one for one in each if isinstance(one, AngularMomentumObjective)] for each in objectives]
        loads = np.zeros((len(objectives), node_count))
        for world, each in enumerate(objectives):
            for one in each:
                if isinstance(one, LoadObjective):
                    loads[world, one.nodes] += one.weight

        def upload(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, device=device)

        return cls(
            WeightedRows(upload(_stacked(indices).astype(np.int64)), *(upload(_stacked(each)) for each in others)),
            upload(_stacked([np.array([one.weight for one in each], dtype=np.float64) for each in momenta])),
            upload(_stacked([np.array([one.target for one in each]).reshape(-1, 3) for each in momenta])),
            upload(loads),
        )

    @classmethod
    def merged(cls, parts: Sequence[tuple[torch.Tensor, BatchObjectives]], count: int) -> BatchObjectives:
        """Return the objectives of ``count`` worlds; each of the ``parts`` has the indices (k,) of some worlds and
        their objectives."""
        first_rows, first = parts[0]
        if len(first_rows) == count:
            return first

        def merge(values: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
            width = max(each.shape[1] for _, each in values)
            one = values[0][1]
            merged = one.new_zeros(count, width, *one.shape[2:])
            for rows, each in values:
                merged[rows, : each.shape[1]] = each
            return merged

        names = [name for name, _ in first.rows.batched_fields()]
        rows = {name: merge([(at, getattr(part.rows, name)) for at, part in parts]) for name in names}
        others = {
            name: merge([(at, getattr(part, name)) for at, part in parts])
            for name in ("momentum_weights", "momentum_targets", "load_weights")
        }
        return cls(WeightedRows(**rows), **others)

    def form(self, problem: BatchProblem, contacts: ContactSet, velocities: torch.Tensor, m: int) -> torch.Tensor:
        """Return the quadratic form (c, k + 1, k + 1) of the cost in (x, 1), see ``step_cost.objectives_cost``.

        Args:
            problem: steps of c worlds.
            contacts: their contacts, with a capacity of K.
            velocities: (c, 3N, k + 1) m/s, ``LinearStep.velocities``, with k = m + 3K.
            m: number of activations.
        """
        body = problem.body
        form = self.rows.form(velocities) / body.speed_unit**2
        if self.momentum_weights.shape[1] > 0:
            unit, momentum = _momentum_unit(problem), _angular_momentum(problem)
            torques = contacts.contact_velocities(problem.rotation_modes).mT * (problem.dt * body.weight)
            rows = form.new_zeros(*self.momentum_targets.shape, form.shape[2])
            rows[..., m:-1] = torques[:, None]
            rows[..., -1] = momentum[:, None] - self.momentum_targets
            rows *= ((2.0 * self.momentum_weights).sqrt() / unit[:, None])[:, :, None, None]
            rows = rows.flatten(1, 2)
            form += rows.mT @ rows
        nearest = contacts.nodes.gather(2, contacts.weights.argmax(dim=2, keepdim=True)).squeeze(2).long()
        loads = torch.where(contacts.valid, self.load_weights.gather(1, nearest), 0.0)
        form.diagonal(dim1=1, dim2=2)[:, m:-1:3] += 2.0 * loads
        return form

    def value(
        self, problem: BatchProblem, contacts: ContactSet, velocities: torch.Tensor, forces: torch.Tensor
    ) -> torch.Tensor:
        """Return the costs (c,) at an end of the step, see ``step_cost.objectives_value``.

        Args:
            problem: steps of c worlds.
            contacts: their contacts, with a capacity of K.
            velocities: (c, N, 3) m/s, end of the step.
            forces: (c, K, 3) N, contact forces.
        """
        value = self.rows.value(velocities.flatten(1)) / problem.body.speed_unit**2
        if self.momentum_weights.shape[1] > 0:
            nodal = contacts.nodal_forces(forces).flatten(1)[..., None]
            impulse = problem.dt * (problem.rotation_modes.mT @ nodal)[..., 0]
            missing = (_angular_momentum(problem) + impulse)[:, None] - self.momentum_targets
            squares = missing.square().sum(dim=2) / _momentum_unit(problem)[:, None] ** 2
            value = value + (self.momentum_weights * squares).sum(dim=1)
        return value


def _stacked(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return (c, L, ...), the arrays ``parts`` (l, ...) padded with zeros to the largest length L."""
    stacked = np.zeros((len(parts), max(len(part) for part in parts), *parts[0].shape[1:]))
    for one, part in zip(stacked, parts, strict=True):
        one[: len(part)] = part
    return stacked


def _angular_momentum(problem: BatchProblem) -> torch.Tensor:
    """Return (c, 3) kg m^2/s, angular momenta about the centres of mass at the start of the step."""
    momenta = problem.node_mass[:, None] * problem.state.velocities
    return torch.linalg.cross(problem.lever_arms, momenta).sum(dim=1)


def _momentum_unit(problem: BatchProblem) -> torch.Tensor:
    """Return (c,) kg m^2/s, the unit of ``AngularMomentumObjective``: mass times radius of gyration times unit of
    speed."""
    body = problem.body
    half_trace = (problem.node_mass[:, None] * problem.lever_arms.square()).sum(dim=(1, 2))
    return body.mass * (half_trace / body.mass).sqrt() * body.speed_unit
