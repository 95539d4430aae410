"""Motions of many worlds of one body on a device.

Jumps, hops and twists are computed for all worlds at once: the device reduces each state to its moments and contacts
(``ReducedState``), one transfer copies them to the host, the state machines run with a world axis (``MotionWorlds``),
and a kernel computes the rows of the objectives. Other motions are evaluated one world after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from egs_warp.fem.batched import BatchedRecord, nonzero, padded
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.locomotion.batch_objectives import BatchObjectives
from egs_warp.locomotion.batch_state import BatchState, BatchStep
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.reduced_objectives import ReducedObjectives
from egs_warp.locomotion.step_tensors import WeightedRows
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.motions.current_motion import joined_motion
from egs_warp.motions.joined_motion import JoinedMotion, MotionWorlds
from egs_warp.motions.moments import ReducedState, contact_positions, part_moments
from egs_warp.motions.sequence import MotionSequence
from egs_warp.render.autograd import torch_stream


@dataclass(frozen=True)
class _Contacts(BatchedRecord):
    """Contacts at the end of the last step of B worlds, on the device."""

    points: torch.Tensor
    """(B, K, 3) m, contact points."""
    counts: torch.Tensor
    """(B,) int32, number of contact points."""
    load: torch.Tensor
    """(B,) N, sum of the normal forces."""
    gap: torch.Tensor
    """(B,) m, height of the lowest contact point above the ground."""

    def with_capacity(self, capacity: int) -> _Contacts:
        """Return the contacts, padded to a capacity of ``capacity`` points."""
        return replace(self, points=padded(self.points, capacity - self.points.shape[1]))


@dataclass
class _Group:
    """Motions of one kind, in worlds whose parts have the same shares of the nodes."""

    worlds: list[int]
    """(k,) worlds, ascending."""
    motions: MotionWorlds
    """Motions of these worlds."""
    rows: torch.Tensor
    """(k,) rows of these worlds in the state."""
    shares: torch.Tensor
    """(P, N) shares of the nodes in each part."""
    reference: torch.Tensor
    """(k, N, 3) m, reference arms."""

    def objectives(self, state: BatchState, contacts: _Contacts, up: torch.Tensor, dt: float) -> BatchObjectives:
        """Return the objectives of the worlds of the group for the time step of ``dt`` s that starts at ``state``."""
        positions, velocities = state.positions, state.velocities
        moments = part_moments(self.shares, self.reference, positions, velocities)
        reduced = ReducedState(
            time=state.time,
            moments=moments,
            lowest=(positions @ up).amin(dim=1),
            contact_points=contacts.points,
            contact_counts=contacts.counts,
            load=contacts.load,
            gap=contacts.gap,
        )
        on_host = reduced.on_host()
        with one_blas_thread():
            objectives = self.motions.step(on_host, dt)
        return self._on_device(objectives, moments.centres[:, 0], positions)

    def _on_device(
        self, objectives: ReducedObjectives, centre: torch.Tensor, positions: torch.Tensor
    ) -> BatchObjectives:
        """Return the ``objectives`` with their rows, for centres of mass (k, 3) m and ``positions`` (k, N, 3) m."""
        device, affine = positions.device, objectives.affine
        count, rows = affine.targets.shape
        # Transfer all numbers in one transfer.
        values = [affine.coefficients, affine.targets, affine.weights, objectives.momentum]
        flat = np.concatenate([each.reshape(count, -1) for each in values], axis=1)
        momentum_weights = objectives.momentum_weight[:, None]
        flat = torch.as_tensor(np.concatenate([flat, momentum_weights], axis=1), device=device)
        sizes = [affine.coefficients[0].size, rows, rows, 3, 1]
        coefficients, targets, weights, momentum, momentum_weight = flat.split(sizes, dim=1)
        scales = (2.0 * weights).sqrt()
        on_device = replace(affine, coefficients=coefficients.reshape(affine.coefficients.shape))
        nodes = positions.shape[1]
        none = positions.new_zeros(count, 0)
        return BatchObjectives(
            WeightedRows(
                none.long(), none, none, on_device.rows(self.shares, centre, positions, scales), scales * targets
            ),
            momentum_weight,
            momentum[:, None],
            positions.new_zeros(count, nodes),
        )


class MotionBatch:
    """Motions of B worlds of one body, which provide the objectives of a ``BatchStepper``.

    Call ``objectives`` before each step and ``finish_step`` after it.
    """

    def __init__(self, body: SoftBody, motions: Sequence[MotionSequence], device: torch.device) -> None:
        """Prepare the ``motions`` of the worlds of a ``body`` on the ``device``."""
        self._body, self._motions, self._device = body, list(motions), device
        count, real = len(motions), {"dtype": torch.float64, "device": device}
        self._contacts = _Contacts(
            torch.zeros((count, 0, 3), **real),
            torch.zeros(count, dtype=torch.int32, device=device),
            torch.full((count,), body.weight, **real),
            torch.zeros(count, **real),
        )
        self._steps: Sequence[BatchStep] = ()
        self._up = torch.as_tensor(-body.gravity / np.linalg.norm(body.gravity), **real)
        self._worlds = list(range(count))
        self._groups: list[_Group] | None = None
        self._others: list[int] = []
        """Worlds whose motions are evaluated one after the other."""

    def objectives(self, state: BatchState, dt: float) -> BatchObjectives:
        """Return the objectives of the worlds of ``state`` for a time step of ``dt`` seconds."""
        with torch.no_grad(), torch_stream(self._device):
            if len(state.worlds) != len(self._worlds):
                self._worlds, self._groups = state.worlds.tolist(), None
            if self._groups is None or self._has_changed():
                self._form_groups(state)
            assert self._groups is not None
            parts: list[tuple[torch.Tensor, BatchObjectives]] = []
            contacts = self._contacts.subset(state.worlds)
            for group in self._groups:
                operands = state.subset(group.rows), contacts.subset(group.rows), self._up
                parts.append((group.rows, group.objectives(*operands, dt)))
            if self._others:
                each = [self._objectives_of(world, state, dt) for world in self._others]
                rows = self._rows_of(self._others)
                parts.append((rows, BatchObjectives.stack(each, state.positions.shape[1], self._device)))
                if any(joined_motion(self._motions[world]) is not None for world in self._others):
                    self._groups = None
            return BatchObjectives.merged(parts, len(state.worlds))

    def finish_step(self, steps: Sequence[BatchStep]) -> None:
        """Record the contacts at the end of a step; ``steps`` is the result of ``BatchStepper.advance``."""
        self._steps = steps
        with torch.no_grad(), torch_stream(self._device):
            for step in steps:
                contacts, forces = step.report.contacts, torch.as_tensor(step.report.forces)
                found = _Contacts(
                    torch.as_tensor(contact_positions(contacts, step.after.positions)),
                    contacts.counts,
                    torch.where(contacts.valid, forces[:, :, 0], 0.0).sum(dim=1),
                    torch.as_tensor(step.report.min_gap),
                )
                if len(found.counts) == len(self._motions):
                    self._contacts = found
                    continue
                capacity = max(found.points.shape[1], self._contacts.points.shape[1])
                self._contacts = self._contacts.with_capacity(capacity)
                self._contacts.scatter(step.worlds, found.with_capacity(capacity))

    def _has_changed(self) -> bool:
        """Return True if a motion of a group has come to rest and another motion follows."""
        for group in self._groups or ():
            resting = np.flatnonzero(group.motions.is_resting)
            if any(joined_motion(self._motions[group.worlds[row]]) is None for row in resting):
                return True
        return False

    def _form_groups(self, state: BatchState) -> None:
        """Divide the worlds into groups of motions, and others; start the first motion of each world."""
        groups: dict[tuple[type, bytes], list[tuple[int, JoinedMotion[Any]]]] = {}
        self._others = []
        for world in self._worlds:
            motion = self._motions[world]
            if not motion.done:
                motion.start_next(self._state_of(world, state), None)
            joined = joined_motion(motion)
            if joined is None:
                self._others.append(world)
            else:
                groups.setdefault((type(joined), joined.reference.shares.tobytes()), []).append((world, joined))
        self._groups = []
        for (kind, _), members in groups.items():
            worlds, motions = [world for world, _ in members], [motion for _, motion in members]
            self._groups.append(
                _Group(
                    worlds,
                    kind.join(motions),
                    self._rows_of(worlds),
                    self._tensor(motions[0].reference.shares),
                    self._tensor(np.stack([motion.reference.reference for motion in motions])),
                )
            )

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(values, device=self._device)

    def _rows_of(self, worlds: list[int]) -> torch.Tensor:
        """Return the rows (k,) of ``worlds`` in the state."""
        row_of = {world: row for row, world in enumerate(self._worlds)}
        return torch.tensor([row_of[world] for world in worlds], device=self._device)

    def _state_of(self, world: int, state: BatchState) -> BodyState:
        """Download the state of one world."""
        row = self._worlds.index(world)
        values = state.positions[row].cpu().numpy(), state.velocities[row].cpu().numpy()
        return BodyState(*values, float(state.time[row]))

    def _objectives_of(self, world: int, state: BatchState, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the motion of one world."""
        report: StepReport | None = None
        for step in self._steps:
            rows = nonzero(step.worlds == world)
            if len(rows) > 0:
                (report,) = step.subset(rows).reports()
        return self._motions[world].objectives(self._state_of(world, state), report, dt)
