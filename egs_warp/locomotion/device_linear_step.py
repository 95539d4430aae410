"""Linear steps on a GPU, where the responses of contact are: no column of theirs comes to the host (Eq. 7, 8, 13)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.detection import ContactSet
from egs_warp.contact.device_response import DeviceResponder, DeviceResponse
from egs_warp.fem.graphs import Recordings
from egs_warp.fem.worlds import shared
from egs_warp.locomotion.linear_step import LinearStep, Prospect, torques_of
from egs_warp.locomotion.objectives import Objective
from egs_warp.locomotion.synergies import Synergies
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleTension
from egs_warp.precision import Vec3, real

_MORE = 8
"""Contacts for which there is memory beyond those that there are."""


@dataclass(frozen=True)
class DeviceLinearStep(LinearStep):
    """``LinearStep`` whose velocities are a tensor."""

    response: DeviceResponse
    known: np.ndarray
    """(3n, k + 1) m/s of the contacts."""

    def end(self, x: np.ndarray) -> np.ndarray:
        """See ``LinearStep``."""
        owner = self.response.owner
        with torch.no_grad(), owner.stream:
            return (self.velocities @ owner.tensor(np.append(x, 1.0))).cpu().numpy()

    def speeds(self, contacts: ContactSet) -> np.ndarray:
        """See ``LinearStep``."""
        assert contacts is self.response.contacts
        return self.known

    def squares(self, objectives: Sequence[Objective]) -> np.ndarray:
        """See ``LinearStep``."""
        owner = self.response.owner
        with torch.no_grad(), owner.stream:
            form = owner.zeros(self.count + 1, self.count + 1)
            dense: list[tuple[np.ndarray, np.ndarray]] = []
            for objective in objectives:
                root, rows = np.sqrt(2.0 * objective.weight), objective.rows
                if not isinstance(rows, np.ndarray) and (np.diff(rows.indptr) == 1).all():
                    # One entry in each row, in as many rows as there are nodes.
                    places = torch.as_tensor(rows.indices.astype(np.int64), device=owner.factors.device)
                    missed = owner.tensor(root * rows.data)[:, None] * self.velocities[places]
                    missed[:, -1] -= owner.tensor(root * objective.target)
                    form.addmm_(missed.T, missed)
                else:
                    rows = rows if isinstance(rows, np.ndarray) else rows.toarray()
                    dense.append((root * rows, root * objective.target))
            if dense:
                missed = owner.tensor(np.vstack([rows for rows, _ in dense])) @ self.velocities
                missed[:, -1] -= owner.tensor(np.concatenate([target for _, target in dense]))
                form.addmm_(missed.T, missed)
            return form.cpu().numpy()


class DeviceLinearSteps:
    """``LinearSteps`` where the responses are."""

    def __init__(self, owner: DeviceResponder, muscles: MuscleSet, synergies: Synergies) -> None:
        self.owner, self.count = owner, synergies.count
        at_bounds = MuscleTension.of(muscles, muscles.bounds)
        self._rows, self._tensions = owner.tensor(at_bounds.rows.toarray()), owner.tensor(at_bounds.tensions)
        self._members = owner.tensor(synergies.members.toarray())
        self._works = Recordings(owner.stream)
        self._memory = owner.zeros(0)
        self._speeds_here = owner.stream.pinned(0)

    def about(self, prospect: Prospect, other: Callable[[], Any]) -> tuple[LinearStep, Any]:
        """See ``LinearSteps``; it is overwritten by the next. ``other`` comes last: both work on one stream."""
        response, owner, m = prospect.response, self.owner, self.count
        assert isinstance(response, DeviceResponse)
        room, dt, newtons = response.room, response.tangent.problem.dt, owner.body.weight
        width = 3 * response.contacts.count
        # Without muscles and contact.
        response.at(None, prospect.velocities, prospect.forces)
        with torch.no_grad(), owner.stream:
            velocities, speeds = self._room_for(3 * len(prospect.velocities), 3 * room.places, m + width + 1)

            def work() -> None:
                foreseen, _, free, _ = room.tried()
                moved = room.moved(torch.hstack([self.impulses(room.ends.view(-1, 3), dt), free[:, None]]))
                velocities[:, :m] = moved[:, :-1]
                torch.mul(room.columns[:, :width], newtons, out=velocities[:, m:-1])
                torch.sub(foreseen, moved[:, -1], out=velocities[:, -1])
                speeds.copy_(room.speeds(velocities), non_blocking=True)

            self._works.run((id(room), width, dt), work)
            owner.stream.wait()
        known = speeds.numpy()[:width].copy()
        return DeviceLinearStep(velocities, torques_of(response, m), response, known), other()

    def _room_for(self, unknowns: int, rows: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
        """(unknowns, width) on the device and (rows, width) on the host, always in the same memory while that will
        do."""
        if self._memory.numel() < unknowns * width or self._speeds_here.numel() < rows * width:
            self._memory = self.owner.zeros(unknowns * (width + 3 * _MORE))
            self._speeds_here = self.owner.stream.pinned((rows + 3 * _MORE) * (width + 3 * _MORE))
            self._works.forget()
        velocities = self._memory[: unknowns * width].view(unknowns, width)
        return velocities, self._speeds_here[: rows * width].view(rows, width)

    def impulses(self, positions: torch.Tensor, dt: float) -> torch.Tensor:
        """(3N, m) N s over ``dt`` seconds at node ``positions`` (N, 3), of each group at its bounds: Eq. (7)."""
        pulls = wp.to_torch(self.owner.lines.enqueue_pulls(shared(self._tensions, real), shared(positions, Vec3)))
        of_groups = pulls[:, :, None] * self._members[:, None, :]
        return (self._rows.T @ of_groups.flatten(1)).mul_(-dt).view(-1, self.count)
