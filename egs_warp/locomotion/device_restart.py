"""Restart of a mode search whose objective is high: a second search on the device from the relaxed optimum."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
import warp as wp

from egs_warp.contact.device_newton import DeviceContactLinearizer
from egs_warp.contact.device_newton_workspace import NewtonWorkspace
from egs_warp.fem.batched import as_warp, as_world
from egs_warp.fem.cuda_graphs import PinnedUpload
from egs_warp.kernels.locomotion.mode_search import HEADER_SIZE
from egs_warp.kernels.locomotion.relaxed_contact import pack_search_kernel
from egs_warp.locomotion.contact_modes import ModeSearchResult, search_modes, solve_relaxed
from egs_warp.locomotion.device_search import ModeSearchWorkspace, RelaxationWorkspace
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import needs_restart, restart_from_relaxation
from egs_warp.precision import Vec3, real


class DeviceRestart:
    """Workspace of the restarts for one contact capacity."""

    def __init__(
        self,
        body: DeviceContactLinearizer,
        newton: NewtonWorkspace,
        search: ModeSearchWorkspace,
        contact_velocities: torch.Tensor,
        predicted_forces: torch.Tensor,
        *,
        qp_limit: int,
    ) -> None:
        """Allocate the workspace.

        Args:
            body: builder of contact linearisations on the device.
            newton: workspace of the step.
            search: workspace of the first search.
            contact_velocities: (3n, m + 3n + 1) m/s, contact velocities as affine functions of the unknowns.
            predicted_forces: (3n,) N, predicted contact forces.
            qp_limit: maximum number of QPs of a search.
        """
        self._body, self._newton, self._search, self._limit = body, newton, search, qp_limit
        self._contact_velocities, self._predicted_forces = contact_velocities, predicted_forces
        width = 3 * newton.capacity
        self._m = contact_velocities.shape[1] - width - 1
        self._relaxed = RelaxationWorkspace(self._m, newton.capacity, search)
        self._second = ModeSearchWorkspace(self._m, newton.capacity, str(body.factors.device), first_search=search)
        self._uploaded_point = PinnedUpload(body.stream, self._m)
        # Contact forces at the start of the second search, and their violation of Coulomb's law, which is not checked.
        self._forces, self._violation = body.zeros(width), body.zeros(1)

    def improve(
        self, result: ModeSearchResult, contacts: int, run: Callable[[Callable[[], None]], None], *, is_done: bool
    ) -> ModeSearchResult:
        """Return ``result``; if its objective is high, run a restart and return the better of both results.

        Args:
            result: result of the first search.
            contacts: number of contacts.
            run: function that runs what its argument queues, as a CUDA graph.
            is_done: True if ``enqueue_restart`` has run concurrently with the first search.
        """
        if not needs_restart(result.objective, contacts):
            return result
        relaxed_on_device = self._relaxed.parse_result() if is_done else None
        if relaxed_on_device is None:
            with self._body.stream:
                self._search.is_accepted.zero_()
                run(self.enqueue_restart)
            relaxed_on_device = self._relaxed.parse_result()
        relaxed = relaxed_on_device or solve_relaxed(self._search.parse_input()[0], QpSolver.OSQP)

        def search(activations: np.ndarray) -> ModeSearchResult:
            if relaxed_on_device is None:
                with self._body.stream:
                    self._uploaded_point.set(activations)
                    run(self.enqueue_from_point)
            return self._second.parse_result(self._m + 3 * contacts) or self.search_on_host(self._second)

        return restart_from_relaxation(result, relaxed, search)

    def search_on_host(self, search: ModeSearchWorkspace) -> ModeSearchResult:
        """Repeat the search in the workspace ``search`` on the host, after a numerical failure of the kernel."""
        program, start, modes = search.parse_input()
        return search_modes(program, start, modes, qp_limit=self._limit, solver=QpSolver.OSQP)

    def enqueue_restart(self) -> None:
        """Queue the solve for the relaxed optimum, and a search that starts from it."""
        # Make Warp launch on PyTorch's current stream.
        with wp.ScopedStream(self._body.stream.current(), sync_enter=False):
            self._relaxed.enqueue()
            self._enqueue_from(wp.to_torch(self._relaxed.packed_result)[HEADER_SIZE:])

    def enqueue_from_point(self) -> None:
        """Queue the second search from the activations that were uploaded."""
        self._enqueue_from(self._uploaded_point.device)

    def _enqueue_from(self, activations: torch.Tensor) -> None:
        """Queue the second search, from ``activations`` (m,) and the contact forces that they cause."""
        body, newton = self._body, self._newton
        contact_free = torch.addmv(self._contact_velocities[:, -1], self._contact_velocities[:, : self._m], activations)
        self._forces.copy_(self._predicted_forces)
        newton.coulomb.enqueue_forces(contact_free, self._forces, self._violation)
        wp.to_torch(self._second.packed_qp).copy_(wp.to_torch(self._search.packed_qp))
        wp.launch(
            pack_search_kernel,
            (1, self._m + newton.capacity),
            inputs=[
                *(body.body.weight, as_warp(activations[None], real)),
                *(as_warp(self._forces.view(1, -1, 3), Vec3), self._search.is_accepted),
            ],
            outputs=[as_world(self._second.packed_qp)],
            device=body.body.assembly.device,
        )
        self._second.enqueue()
