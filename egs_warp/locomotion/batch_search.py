"""Mode searches of many worlds on a device, with a restart in worlds whose objective is high.

The result of each world is that of ``strategies.search_program`` with the solver ``admm``. If a kernel fails
numerically in a world, the host repeats the search of this world.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
import warp as wp

from egs_warp.contact.coulomb import coulomb_forces_of_worlds
from egs_warp.fem.batched import BatchedRecord, as_warp, launch_on, nonzero
from egs_warp.kernels.locomotion import step_program as kernels
from egs_warp.kernels.locomotion.active_set import NUMERICAL_FAILURE, OPTIMUM_FOUND
from egs_warp.kernels.locomotion.mode_search import HEADER_SIZE, mode_search_kernel
from egs_warp.kernels.locomotion.relaxed_contact import pack_search_kernel, relaxed_qp_kernel
from egs_warp.launching import round_up
from egs_warp.locomotion.contact_modes import search_modes, solve_relaxed
from egs_warp.locomotion.device_search import (
    CAPACITY_MULTIPLE,
    SearchPool,
    mode_search_shapes,
    packed_qp_size,
    parse_packed_qp,
    relaxation_shapes,
)
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import RESTART_COST, RESTART_GAP
from egs_warp.locomotion.threads import one_blas_thread
from egs_warp.precision import Vec3, real
from egs_warp.worker_threads import run_all

POOL, RELAXATION_POOL = 512, 256
"""Maximum number of worlds in a launch of the search, and in a launch that computes relaxed optima."""
_STATUS, _COUNT, _INFEASIBLE, _OBJECTIVE, _HAS_POINT = range(5)
"""Number of entries of the header of a packed result."""


@dataclass(frozen=True)
class BatchProgram(BatchedRecord):
    """QPs of c worlds with m activations and up to K contacts, packed for the search, and the linearised contacts from
    which they were built."""

    packed: torch.Tensor
    """(c, ...) packed input of ``mode_search_kernel``."""
    contact_velocities: torch.Tensor
    """(c, 3K, m + 3K + 1) m/s, contact velocities as affine functions of activations and forces (Eq. 8)."""
    delassus: torch.Tensor
    """(c, 3K, 3K) m/(N s), regularised Delassus operator."""
    counts: torch.Tensor
    """(c,) int32, number of contacts."""
    normal_bias: torch.Tensor
    """(c, K) m/s, bias of the normal velocities."""
    frictions: torch.Tensor
    """(c,) Coulomb coefficients."""
    forces: torch.Tensor
    """(c, K, 3) N, predicted contact forces."""

    @classmethod
    def pack(
        cls,
        form: torch.Tensor,
        bounds: torch.Tensor,
        *,
        speed: float,
        weight: float,
        qp_limit: int,
        contact_velocities: torch.Tensor,
        **contact: torch.Tensor,
    ) -> BatchProgram:
        """Pack the QPs.

        Args:
            form: (c, m + 3K + 1, m + 3K + 1) quadratic form of the cost.
            bounds: (c, 3, m) lower bounds, upper bounds and start of the activations.
            speed: unit of speed, m/s.
            weight: body weight, N.
            qp_limit: maximum number of QPs of a search.
            contact_velocities: as the field.
            contact: the other fields.
        """
        worlds, _, m = bounds.shape
        capacity = contact_velocities.shape[1] // 3
        packed = form.new_zeros(worlds, packed_qp_size(m, capacity))
        launch_on(
            form,
            kernels.assemble_qp_kernel,
            (worlds, form.shape[1] + 3 * capacity, form.shape[1]),
            inputs=[
                *(qp_limit, speed, weight, (contact["counts"], wp.int32), (contact["frictions"], real)),
                *((each, real) for each in (form, contact_velocities, contact["normal_bias"], bounds)),
                (contact["forces"], Vec3),
            ],
            outputs=[(packed, real)],
        )
        return cls(packed, contact_velocities, **contact)

    @property
    def activation_count(self) -> int:
        """Number of activations m."""
        return self.contact_velocities.shape[2] - 1 - self.contact_velocities.shape[1]

    def contact_forces(self, activations: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
        """Return the Coulomb forces (c, K, 3) N for ``activations`` (c, m). The iteration begins at the forces
        ``start`` (c, K, 3) N."""
        m = self.activation_count
        free = self.contact_velocities[:, :, -1] + (self.contact_velocities[:, :, :m] @ activations[..., None])[..., 0]
        operands = self.delassus, free, self.normal_bias, self.frictions, start
        return coulomb_forces_of_worlds(self.counts, *operands)[0]


class BatchModeSearch:
    """Searches over contact modes in many worlds of one body."""

    def __init__(self, m: int, worlds: int, device: torch.device, *, qp_limit: int, weight: float) -> None:
        """Prepare the searches; scratch memory is allocated when it is needed.

        Args:
            m: number of activations.
            worlds: maximum number of worlds.
            device: their device.
            qp_limit: maximum number of QPs of a search.
            weight: body weight, N.
        """
        self._m, self._worlds, self._device, self._limit, self._weight = m, worlds, str(device), qp_limit, weight
        self._capacity = -1
        self._first: SearchPool | None = None
        self._relaxed: SearchPool | None = None

    def search(self, program: BatchProgram) -> torch.Tensor:
        """Return (c, ...), the packed result of the best search of each world, in the layout of ``mode_search_kernel``.
        If a QP is not finite, the status of the world's result is a numerical failure."""
        self._allocate(program.normal_bias.shape[1])
        best = self._run(program.packed)
        objective = best[:, _OBJECTIVE]
        worlds = nonzero((program.counts > 0) & ~(objective < RESTART_COST) & (best[:, _STATUS] != NUMERICAL_FAILURE))
        if len(worlds) == 0:
            return best
        activations, bound, is_known = self._relax(program.subset(worlds))
        best[worlds, _COUNT] += 1.0
        again = ~(objective[worlds] <= RESTART_GAP * bound) & is_known
        worlds, activations = worlds[again], activations[again]
        if len(worlds) == 0:
            return best
        other = self._search_from(program.subset(worlds), activations)
        totals = best[worlds, _COUNT : _INFEASIBLE + 1] + other[:, _COUNT : _INFEASIBLE + 1]
        is_better = (other[:, _OBJECTIVE] < best[worlds, _OBJECTIVE]) & (other[:, _STATUS] != NUMERICAL_FAILURE)
        best[worlds[is_better]] = other[is_better]
        best[worlds, _COUNT : _INFEASIBLE + 1] = totals
        return best

    def _allocate(self, contacts: int) -> None:
        """Allocate scratch memory for worlds with up to ``contacts`` contacts, unless enough is allocated already."""
        if contacts <= self._capacity:
            return
        self._capacity = round_up(max(contacts, 1), CAPACITY_MULTIPLE)
        self._first = SearchPool(
            *(mode_search_kernel, mode_search_shapes(self._m, self._capacity)),
            *(min(self._worlds, POOL), self._device),
        )
        self._relaxed = SearchPool(
            *(relaxed_qp_kernel, relaxation_shapes(self._m, self._capacity)),
            *(min(self._worlds, RELAXATION_POOL), self._device),
        )

    def _run(self, packed: torch.Tensor) -> torch.Tensor:
        """Run a search in each world of ``packed`` and return the packed results."""
        assert self._first is not None
        result = packed.new_zeros(len(packed), HEADER_SIZE + self._m + 3 * self._capacity)
        unused = torch.zeros((len(packed), 1), dtype=torch.int32, device=packed.device)
        # No objective is below the cost, because no restart runs concurrently with the search.
        arrays = as_warp(packed, real), as_warp(result, real), as_warp(unused, wp.int32)
        self._first.run(*arrays, restart_cost=-np.inf)
        _repeat_on_host(packed, result, self._search_on_host)
        return result

    def _search_on_host(self, packed: np.ndarray) -> np.ndarray | None:
        """Return the packed result of the search for one ``packed`` QP; None if the QP is not finite."""
        program, start, modes = parse_packed_qp(packed)
        if not (np.isfinite(program.P).all() and np.isfinite(program.rows).all()):
            return None
        found = search_modes(program, start, modes, qp_limit=self._limit, solver=QpSolver.OSQP)
        header = np.zeros(HEADER_SIZE)
        header[:5] = OPTIMUM_FOUND, found.qp_count, found.infeasible, found.objective, found.x is not None
        return header if found.x is None else np.concatenate([header, found.x])

    def _relax(self, program: BatchProgram) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Compute the relaxed optimum of each world (``contact_modes.solve_relaxed``).

        Returns:
            The activations (c, m), the objectives (c,), and (c,) bool, True where there is a solution.
        """
        assert self._relaxed is not None
        packed = program.packed
        result = packed.new_zeros(len(packed), HEADER_SIZE + self._m)
        self._relaxed.run(as_warp(packed, real), as_warp(result, real))
        _repeat_on_host(packed, result, _relax_on_host)
        return result[:, HEADER_SIZE:], result[:, 1], result[:, _STATUS] == OPTIMUM_FOUND

    def _search_from(self, program: BatchProgram, activations: torch.Tensor) -> torch.Tensor:
        """Search again in each world, starting from ``activations`` (c, m) and the contact forces that they cause."""
        forces, packed = program.contact_forces(activations, program.forces), program.packed.clone()
        enabled = torch.zeros(len(packed), dtype=torch.int32, device=packed.device)
        launch_on(
            packed,
            pack_search_kernel,
            (len(packed), self._m + forces.shape[1]),
            inputs=[self._weight, (activations.contiguous(), real), (forces, Vec3), (enabled, wp.int32)],
            outputs=[(packed, real)],
        )
        return self._run(packed)


def _repeat_on_host(
    packed: torch.Tensor, result: torch.Tensor, repeat: Callable[[np.ndarray], np.ndarray | None]
) -> None:
    """Repeat the failed problems on the host, in parallel, and store their results.

    Args:
        packed: (c, ...) packed QP of each world.
        result: (c, ...) packed results, updated in place. A failure for which ``repeat`` returns None remains one.
        repeat: function that maps the packed QP of a world to its packed result, without trailing zeros.
    """
    worlds = nonzero(result[:, _STATUS] != OPTIMUM_FOUND)
    if len(worlds) == 0:
        return
    inputs = packed[worlds].cpu().numpy()
    # With more threads for each world, BLAS takes ten times as long for matrices of this size.
    with one_blas_thread():
        found = run_all(partial(repeat, each) for each in inputs)
    for world, each in zip(worlds.tolist(), found, strict=True):
        if each is not None:
            result[world, : len(each)] = torch.from_numpy(each).to(result.device)


def _relax_on_host(packed: np.ndarray) -> np.ndarray | None:
    """Return the packed result of the relaxed problem of one ``packed`` QP; None if it has no solution."""
    relaxed = solve_relaxed(parse_packed_qp(packed)[0], QpSolver.OSQP)
    if relaxed is None:
        return None
    activations, objective = relaxed
    header = np.zeros(HEADER_SIZE)
    header[:2] = OPTIMUM_FOUND, objective
    return np.concatenate([header, activations])


def points_of(result: torch.Tensor, counts: torch.Tensor, m: int, capacity: int) -> torch.Tensor:
    """Return (c, m + 3K + 1), the points of packed search results with zeros for unused contacts, and 1 as the last
    entry.

    Args:
        result: (c, ...) packed results.
        counts: (c,) int32, number of contacts.
        m: number of activations.
        capacity: contact capacity K.
    """
    x = result.new_empty(len(result), m + 3 * capacity + 1)
    launch_on(
        result,
        kernels.scatter_solution_kernel,
        x.shape,
        inputs=[(counts, wp.int32), (result, real), m],
        outputs=[(x, real)],
    )
    return x
