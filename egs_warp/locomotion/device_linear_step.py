"""Linear steps of the device planner on the GPU of the contact linearisation (Eq. 7, 8, 13).

``device_plan`` records these PyTorch operations as CUDA graphs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from egs_warp.contact.device_newton import DeviceContactLinearizer
from egs_warp.contact.device_newton_workspace import NewtonWorkspace
from egs_warp.contact.device_step import vectors
from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphStream, PinnedUpload
from egs_warp.locomotion.objectives import Objective
from egs_warp.locomotion.step_tensors import WeightedRows, rows_of, synergy_impulses, write_linear_step
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import real


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
    """Pinned staging buffer, which uploads arrays in one transfer and grows as needed."""

    def __init__(self, stream: GraphStream) -> None:
        self._stream, self._upload = stream, PinnedUpload(stream, 0)

    def upload(self, *parts: np.ndarray) -> torch.Tensor:
        """Upload the concatenated ``parts``; return them as one flat tensor on the device."""
        count = sum(part.size for part in parts)
        if len(self._upload.host) < count:
            self._upload = PinnedUpload(self._stream, 2 * count)
        self._upload.set(*parts)
        return self._upload.device[:count]


class DeviceLinearSteps:
    """Builder of linear steps on the device of the contact linearisations; see ``StepLinearizer``."""

    def __init__(self, owner: DeviceContactLinearizer, muscles: MuscleSet, synergies: Synergies) -> None:
        self.owner, self.count = owner, synergies.count
        at_bounds = MuscleEnergy.of(muscles, muscles.bounds)
        self._rows, self._tensions = owner.tensor(at_bounds.rows.toarray()), owner.tensor(at_bounds.tensions)
        self._members = owner.tensor(synergies.members.toarray())

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
