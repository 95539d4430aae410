"""State of many worlds of one body, and the result of one of their steps, on a device."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from egs_warp.fem.batched import BatchedRecord, padded
from egs_warp.locomotion.stepper import StepReport


@dataclass(frozen=True)
class BatchState(BatchedRecord):
    """State of c worlds, with the warm start of their next step."""

    worlds: torch.Tensor
    """(c,) int64, ascending indices of these worlds among all worlds of the stepper."""
    positions: torch.Tensor
    """(c, N, 3) m, nodal positions."""
    velocities: torch.Tensor
    """(c, N, 3) m/s, nodal velocities."""
    time: torch.Tensor
    """(c,) s, time since the start of the simulation."""
    points: torch.Tensor
    """(c, K) int32, contact points in use; each world uses the first ``counts`` of the K slots."""
    counts: torch.Tensor
    """(c,) int32, number of contact points in use."""
    forces: torch.Tensor
    """(c, K, 3) N, contact forces in the axes of each contact."""
    activations: torch.Tensor
    """(c, M) m, muscle activations of the last step."""


@dataclass(frozen=True)
class BatchStep(BatchedRecord):
    """Result of one step of c worlds, on the device."""

    after: BatchState
    """State at the end of the step."""
    report: StepReport
    """Report of all worlds, with tensors that have a leading world axis, and without timings."""

    @property
    def worlds(self) -> torch.Tensor:
        """(c,) int64, ascending, worlds that made this step."""
        return self.after.worlds

    def reports(self) -> list[StepReport]:
        """Download the step; return one report for each of ``worlds``, in the form of ``LocomotionStepper``."""
        reports, counts = self.report.download(), self.after.counts.tolist()
        return [
            replace(report, forces=report.forces[:count], end_gaps=report.end_gaps[:count])
            for report, count in zip(reports, counts, strict=True)
        ]


def merged(one: BatchState, other: BatchState) -> BatchState:
    """Return the worlds of both states, which are disjoint, in ascending order."""
    capacity = max(one.points.shape[1], other.points.shape[1])
    one, other = (
        replace(each, points=padded(each.points, more), forces=padded(each.forces, more))
        for each, more in ((each, capacity - each.points.shape[1]) for each in (one, other))
    )
    both = BatchState.concatenated([one, other])
    return both.gather(torch.argsort(both.worlds))
