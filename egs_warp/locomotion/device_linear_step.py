"""Linear steps on the GPU of the contact linearisation. Their columns are never downloaded (Eq. 7, 8, 13).

PyTorch computes the linear steps; its operations are recorded as CUDA graphs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.device_newton import DeviceContactLinearization, DeviceContactLinearizer
from egs_warp.contact.device_newton_workspace import NewtonWorkspace
from egs_warp.contact.device_step import vectors
from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphCache, GraphStream, PinnedUpload
from egs_warp.locomotion.linear_step import LinearStep, PredictedStep, torques_of
from egs_warp.locomotion.objectives import Objective
from egs_warp.locomotion.step_tensors import WeightedRows, rows_of, synergy_impulses, write_linear_step
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import real

_EXTRA_CONTACTS = 8
"""Additional contact capacity when buffers grow."""


@dataclass(frozen=True)
class DeviceLinearStep(LinearStep):
    """``LinearStep`` whose ``velocities`` are a tensor on the device."""

    response: DeviceContactLinearization
    host_contact_velocities: np.ndarray
    """(3n, k + 1) m/s, contact velocities, on the host."""
    end_staging: StagingBuffer
    """Staging buffer of ``end_velocities``."""
    square_staging: StagingBuffer
    """Staging buffer of ``objective_quadratic``."""

    def end_velocities(self, x: np.ndarray) -> np.ndarray:
        """Return v(x), (3N,) m/s, for ``x`` (k,)."""
        stream = self.response.owner.stream
        with stream:
            self.end_staging.start_download(self.velocities @ self.end_staging.upload(x, np.ones(1)))
            stream.wait()
        return self.end_staging.result(len(self.velocities)).copy()

    def contact_velocities(self, contacts: ContactSet) -> np.ndarray:
        """Return W ``velocities``, (3n, k + 1) m/s, which were downloaded when the step was linearised."""
        assert contacts is self.response.contacts
        return self.host_contact_velocities

    def objective_quadratic(self, objectives: Sequence[Objective]) -> Callable[[], np.ndarray]:
        """Start computing the quadratic form of the weighted squares of ``objectives``, see ``LinearStep``. The next
        call overwrites the result."""
        stream, width = self.response.owner.stream, self.count + 1
        with stream:
            self.square_staging.start_download(
                objective_form(self.velocities, objectives, self.square_staging).view(-1)
            )

        def wait_form() -> np.ndarray:
            stream.wait()
            return self.square_staging.result(width**2).reshape(width, width).copy()

        return wait_form


def objective_form(velocities: torch.Tensor, objectives: Sequence[Objective], staging: StagingBuffer) -> torch.Tensor:
    """Return the form G of ``LinearStep.objective_quadratic``, (k + 1, k + 1) on the device.

    Args:
        velocities: (3N, k + 1) m/s, ``LinearStep.velocities``.
        objectives: objectives of the motion.
        staging: buffer through which their rows and targets are uploaded.
    """
    parts = rows_of(objectives, len(velocities))
    indices, entries, entry_targets, rows, targets = staging.upload(*parts).split([part.size for part in parts])
    dense = rows.view(-1, len(velocities))
    return WeightedRows(indices.long(), entries, entry_targets, dense, targets).form(velocities)


class StagingBuffer:
    """Pinned staging buffer, which uploads and downloads arrays in one transfer and grows as needed."""

    def __init__(self, stream: GraphStream) -> None:
        self._stream, self._upload, self._download = stream, PinnedUpload(stream, 0), stream.pinned(0)

    def upload(self, *parts: np.ndarray) -> torch.Tensor:
        """Upload the concatenated ``parts``; return them as one flat tensor on the device."""
        count = sum(part.size for part in parts)
        if len(self._upload.host) < count:
            self._upload = PinnedUpload(self._stream, 2 * count)
        self._upload.set(*parts)
        return self._upload.device[:count]

    def start_download(self, values: torch.Tensor) -> None:
        """Start downloading ``values`` (n,), asynchronously."""
        if len(self._download) < len(values):
            self._download = self._stream.pinned(2 * len(values))
        self._download[: len(values)].copy_(values, non_blocking=True)

    def result(self, count: int) -> np.ndarray:
        """Return the first ``count`` downloaded entries; the caller must synchronise the stream first."""
        return self._download.numpy()[:count]


class DeviceLinearSteps:
    """``StepLinearizer`` on the device of the contact linearisations."""

    def __init__(self, owner: DeviceContactLinearizer, muscles: MuscleSet, synergies: Synergies) -> None:
        self.owner, self.count = owner, synergies.count
        at_bounds = MuscleEnergy.of(muscles, muscles.bounds)
        self._rows, self._tensions = owner.tensor(at_bounds.rows.toarray()), owner.tensor(at_bounds.tensions)
        self._members = owner.tensor(synergies.members.toarray())
        self._graphs = GraphCache(owner.stream)
        self._buffer = owner.zeros(0)
        self._host_buffer = owner.stream.pinned(0)
        self._staging = StagingBuffer(owner.stream), StagingBuffer(owner.stream)

    def linearize(self, predicted: PredictedStep, other: Callable[[], Any]) -> tuple[LinearStep, Any]:
        """Linearise the step about ``predicted``; the next call overwrites the result. ``other`` runs afterwards,
        because both use the same stream."""
        response, owner, m = predicted.linearization, self.owner, self.count
        assert isinstance(response, DeviceContactLinearization)
        newton, dt = response.workspace, response.tangent.problem.dt
        width = 3 * response.contacts.count
        # Residual without muscles and contact.
        response.running_iterate_at(None, predicted.velocities, predicted.forces)
        with owner.stream:
            velocities, host_speeds = self._buffers_for(
                3 * len(predicted.velocities), 3 * newton.capacity, m + width + 1
            )

            def work() -> None:
                self.write(newton, self.segment_forces(newton), dt, velocities)
                host_speeds.copy_(newton.contact_velocities(velocities), non_blocking=True)

            self._graphs.run((id(newton), width, dt), work)
            owner.stream.wait()
        host_contact_velocities = host_speeds.numpy()[:width].copy()
        torques = torques_of(response.tangent.problem, response.contacts, m)
        return DeviceLinearStep(velocities, torques, response, host_contact_velocities, *self._staging), other()

    def _buffers_for(self, unknowns: int, rows: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return buffers (unknowns, width) on the device and (rows, width) on the host. Their memory is reused while
        its capacity suffices."""
        if self._buffer.numel() < unknowns * width or self._host_buffer.numel() < rows * width:
            self._buffer = self.owner.zeros(unknowns * (width + 3 * _EXTRA_CONTACTS))
            self._host_buffer = self.owner.stream.pinned((rows + 3 * _EXTRA_CONTACTS) * (width + 3 * _EXTRA_CONTACTS))
            self._graphs.forget()
        velocities = self._buffer[: unknowns * width].view(unknowns, width)
        return velocities, self._host_buffer[: rows * width].view(rows, width)

    def segment_forces(self, newton: NewtonWorkspace) -> torch.Tensor:
        """Return (M, 3) N, the forces by which the segments pull their ends together if they are activated at their
        bounds, at the end positions of the last trial of ``newton``."""
        return wp.to_torch(
            self.owner.muscle_segments.enqueue_segment_forces(
                as_warp(self._tensions, real), vectors(newton.end_positions)
            )
        )[0]

    def write(self, newton: NewtonWorkspace, segment_forces: torch.Tensor, dt: float, velocities: torch.Tensor) -> None:
        """Write ``LinearStep.velocities`` about the last trial of ``newton``, which must have been evaluated without
        muscles (Eq. 7).

        Args:
            newton: workspace of the Newton loop.
            segment_forces: (M, 3) N, result of the method ``segment_forces``.
            dt: step size, s.
            velocities: (3N, k + 1) m/s, output.
        """
        m = self.count
        predicted_velocities, _, free, _ = newton.trial_parts()
        impulses = synergy_impulses(self._rows, self._members, segment_forces, dt)
        solved = self.owner.factors.enqueue_projected_solve(torch.hstack([impulses, free[:, None]]))
        columns = newton.columns[:, : velocities.shape[1] - m - 1]
        write_linear_step(solved, columns, predicted_velocities, self.owner.body.weight, velocities)

    def lengths(self, positions: torch.Tensor) -> torch.Tensor:
        """Return (M,) m, lengths of the segments at node ``positions`` (3N,)."""
        return torch.linalg.vector_norm(self._rows @ positions.view(-1, 3), dim=1)
