"""Linear steps on a GPU, where the responses of contact are: no column of theirs comes to the host (Eq. 7, 8, 13)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.detection import ContactSet
from egs_warp.contact.device_newton import DeviceContactLinearization, DeviceContactLinearizer
from egs_warp.contact.device_newton_workspace import NewtonWorkspace
from egs_warp.contact.device_step import vectors
from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphCache, GraphStream, PinnedUpload
from egs_warp.locomotion.linear_step import LinearStep, PredictedStep, torques_of
from egs_warp.locomotion.objectives import Objective
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import real

_MORE = 8
"""Contacts for which there is memory beyond those that there are."""


@dataclass(frozen=True)
class DeviceLinearStep(LinearStep):
    """``LinearStep`` whose velocities are a tensor."""

    response: DeviceContactLinearization
    known: np.ndarray
    """(3n, k + 1) m/s of the contacts."""
    of_ends: StagingBuffer
    of_squares: StagingBuffer

    def end_velocities(self, x: np.ndarray) -> np.ndarray:
        """See ``LinearStep``."""
        stream = self.response.owner.stream
        with stream:
            self.of_ends.start_download(self.velocities @ self.of_ends.upload(x, np.ones(1)))
            stream.wait()
        return self.of_ends.result(len(self.velocities)).copy()

    def contact_velocities(self, contacts: ContactSet) -> np.ndarray:
        """See ``LinearStep``."""
        assert contacts is self.response.contacts
        return self.known

    def objective_quadratic(self, objectives: Sequence[Objective]) -> Callable[[], np.ndarray]:
        """See ``LinearStep``; those begun before are lost."""
        stream, width = self.response.owner.stream, self.count + 1
        with stream:
            self.of_squares.start_download(squares_of(self.velocities, objectives, self.of_squares).view(-1))

        def form_here() -> np.ndarray:
            stream.wait()
            return self.of_squares.result(width**2).reshape(width, width).copy()

        return form_here


def squares_of(velocities: torch.Tensor, objectives: Sequence[Objective], room: StagingBuffer) -> torch.Tensor:
    """``LinearStep.squares`` of the ``velocities`` (3N, k + 1), on the device; what is asked goes there by the
    ``room``."""
    size = len(velocities)
    one, several = _by_entries(objectives)
    rows = np.concatenate([np.zeros((0, size)), *(root * dense for root, dense, _ in several)])
    targets = np.concatenate([np.zeros(0), *(root * target for root, _, target in several)])
    parts = [np.concatenate([np.zeros(0), *each]) for each in zip(*one, strict=True)] or [np.zeros(0)] * 3
    told = room.upload(*parts, targets, rows)
    places, shares, wanted, asked, dense = told.split([*(len(part) for part in parts), len(targets), rows.size])
    missed = shares[:, None] * velocities[places.long()]
    missed[:, -1] -= wanted
    form = missed.T @ missed
    missed = dense.view(-1, size) @ velocities
    missed[:, -1] -= asked
    return form.addmm_(missed.T, missed)


def _by_entries(objectives: Sequence[Objective]) -> tuple[list[Any], list[Any]]:
    """Of those with one entry in each row, in as many rows as there are nodes, where these are, what they are, and
    the targets; of the others the root of their weight, the rows, and the targets. The first ones' roots are in
    them."""
    one, several = [], []
    for objective in objectives:
        root, rows = np.sqrt(2.0 * objective.weight), objective.rows
        if isinstance(rows, np.ndarray):
            several.append((root, rows, objective.target))
        elif (np.diff(rows.indptr) == 1).all():
            one.append((rows.indices, root * rows.data, root * objective.target))
        else:
            several.append((root, rows.toarray(), objective.target))
    return one, several


class StagingBuffer:
    """Memory by which numbers go to the device in one piece and come back so, as long as they need it."""

    def __init__(self, stream: GraphStream) -> None:
        self._stream, self._told, self._here = stream, PinnedUpload(stream, 0), stream.pinned(0)

    def upload(self, *parts: np.ndarray) -> torch.Tensor:
        """The ``parts`` one behind the other."""
        count = sum(part.size for part in parts)
        if len(self._told.host) < count:
            self._told = PinnedUpload(self._stream, 2 * count)
        self._told.set(*parts)
        return self._told.device[:count]

    def start_download(self, values: torch.Tensor) -> None:
        """``values`` (n,) are on their way."""
        if len(self._here) < len(values):
            self._here = self._stream.pinned(2 * len(values))
        self._here[: len(values)].copy_(values, non_blocking=True)

    def result(self, count: int) -> np.ndarray:
        """(count,) of what has come."""
        return self._here.numpy()[:count]


class DeviceLinearSteps:
    """``LinearSteps`` where the responses are."""

    def __init__(self, owner: DeviceContactLinearizer, muscles: MuscleSet, synergies: Synergies) -> None:
        self.owner, self.count = owner, synergies.count
        at_bounds = MuscleEnergy.of(muscles, muscles.bounds)
        self._rows, self._tensions = owner.tensor(at_bounds.rows.toarray()), owner.tensor(at_bounds.tensions)
        self._members = owner.tensor(synergies.members.toarray())
        self._works = GraphCache(owner.stream)
        self._memory = owner.zeros(0)
        self._speeds_here = owner.stream.pinned(0)
        self._rooms = StagingBuffer(owner.stream), StagingBuffer(owner.stream)

    def linearize(self, prospect: PredictedStep, other: Callable[[], Any]) -> tuple[LinearStep, Any]:
        """See ``LinearSteps``; it is overwritten by the next. ``other`` comes last: both work on one stream."""
        response, owner, m = prospect.linearization, self.owner, self.count
        assert isinstance(response, DeviceContactLinearization)
        room, dt = response.workspace, response.tangent.problem.dt
        width = 3 * response.contacts.count
        # Without muscles and contact.
        response.running_iterate_at(None, prospect.velocities, prospect.forces)
        with owner.stream:
            velocities, speeds = self._room_for(3 * len(prospect.velocities), 3 * room.capacity, m + width + 1)

            def work() -> None:
                self.write(room, self.segment_forces(room), dt, velocities)
                speeds.copy_(room.contact_velocities(velocities), non_blocking=True)

            self._works.run((id(room), width, dt), work)
            owner.stream.wait()
        known = speeds.numpy()[:width].copy()
        torques = torques_of(response.tangent.problem, response.contacts, m)
        return DeviceLinearStep(velocities, torques, response, known, *self._rooms), other()

    def _room_for(self, unknowns: int, rows: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
        """(unknowns, width) on the device and (rows, width) on the host, always in the same memory while that will
        do."""
        if self._memory.numel() < unknowns * width or self._speeds_here.numel() < rows * width:
            self._memory = self.owner.zeros(unknowns * (width + 3 * _MORE))
            self._speeds_here = self.owner.stream.pinned((rows + 3 * _MORE) * (width + 3 * _MORE))
            self._works.forget()
        velocities = self._memory[: unknowns * width].view(unknowns, width)
        return velocities, self._speeds_here[: rows * width].view(rows, width)

    def segment_forces(self, room: NewtonWorkspace) -> torch.Tensor:
        """(M, 3) newtons by which the segments draw their ends together at their bounds, where the last trial of the
        ``room`` ends."""
        return wp.to_torch(self.owner.lines.enqueue_segment_forces(as_warp(self._tensions, real), vectors(room.ends)))

    def write(self, room: NewtonWorkspace, pulls: torch.Tensor, dt: float, velocities: torch.Tensor) -> None:
        """``LinearStep.velocities`` about the last trial of the ``room``, one under no muscles: Eq. (7)."""
        m = self.count
        foreseen, _, free, _ = room.trial_parts()
        of_groups = pulls[:, :, None] * self._members[:, None, :]
        impulses = (self._rows.T @ of_groups.flatten(1)).mul_(-dt).view(-1, m)
        moved = room.apply_inverse(torch.hstack([impulses, free[:, None]]))
        velocities[:, :m] = moved[:, :-1]
        columns = velocities[:, m:-1]
        torch.mul(room.columns[:, : columns.shape[1]], self.owner.body.weight, out=columns)
        torch.sub(foreseen, moved[:, -1], out=velocities[:, -1])

    def lengths(self, positions: torch.Tensor) -> torch.Tensor:
        """(M,) metres of the segments at node ``positions`` (3N,)."""
        return torch.linalg.vector_norm(self._rows @ positions.view(-1, 3), dim=1)
