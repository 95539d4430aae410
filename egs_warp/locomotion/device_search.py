"""Mode searches on a device: of one step, in one launch and one read-back, and the memory of those of many worlds.

The kernels are in ``egs_warp.kernels.locomotion.mode_search`` and ``egs_warp.kernels.locomotion.relaxed_contact``.
"""

from __future__ import annotations

import math
from functools import cached_property, partial
from typing import Any

import numpy as np
import warp as wp

from egs_warp.fem.batched import StructPerWorld, as_world
from egs_warp.kernels.locomotion import mode_search as kernels
from egs_warp.kernels.locomotion.active_set import NUMERICAL_FAILURE, OPTIMUM_FOUND, ActiveSet, UnitConstraints
from egs_warp.kernels.locomotion.mode_region import CONE_FACES
from egs_warp.kernels.locomotion.relaxed_contact import Relaxed, relaxed_qp_kernel
from egs_warp.kernels.locomotion.splitting import Splitting
from egs_warp.launching import PinnedMirror, device_of, round_up, thread_local_cache
from egs_warp.locomotion.active_set import active_set_shapes
from egs_warp.locomotion.contact_modes import ContactModes, CoulombProgram, ModeSearchResult
from egs_warp.precision import real

CAPACITY_MULTIPLE = 8
"""Multiple to which contact capacities are rounded up."""
WORLD_BLOCK = 128
"""Number of threads in the block of each world on a GPU. It is smaller than that of a single world, so that several
blocks share a multiprocessor."""


def search_modes_device(
    program: CoulombProgram, start: np.ndarray, modes: ContactModes, *, qp_limit: int, device: wp.Device
) -> ModeSearchResult | None:
    """Run ``search_modes`` on a device, with the same result.

    Args:
        program: the QP of the step.
        start: (m + 3n,) point in the region of ``modes``.
        modes: modes in which the search begins.
        qp_limit: maximum number of QPs.
        device: device of the kernel.

    Returns:
        The result, or None on numerical failure.
    """
    capacity = round_up(program.contact_count, CAPACITY_MULTIPLE)
    return _thread_workspace(program.activation_count, capacity, device.alias).search(program, start, modes, qp_limit)


class ModeSearchWorkspace:
    """Buffers of ``mode_search_kernel`` in one world, for at most ``m`` activations and ``n`` contacts.

    ``packed_qp`` is the input and ``packed_result`` the output; the kernel documents their layouts. ``is_accepted``
    (1,) int32 is set as soon as the search has a result whose objective is below ``restart_cost``. If ``first_search``
    is given, this search runs concurrently with the first search and ends once the latter sets its ``is_accepted``.
    """

    def __init__(
        self, m: int, n: int, alias: str, *, restart_cost: float = 0.0, first_search: ModeSearchWorkspace | None = None
    ) -> None:
        self._device, size = wp.get_device(alias), m + 3 * n
        zeros = partial(wp.zeros, device=self._device)
        self.packed_qp = zeros(packed_qp_size(m, n), dtype=real)
        self.packed_result, self.is_accepted = zeros(kernels.HEADER_SIZE + size, dtype=real), zeros(1, dtype=int)
        cancelled, self._restart_cost = first_search.is_accepted if first_search else None, restart_cost
        self._pool = SearchPool(kernels.mode_search_kernel, mode_search_shapes(m, n), 1, alias, cancelled=cancelled)

    @cached_property
    def _host_input(self) -> wp.array:
        """Host buffer for ``packed_qp``. It may be overwritten once the result of the previous launch has been read."""
        return self.packed_qp if self._device.is_cpu else wp.zeros(self.packed_qp.shape, real, "cpu", pinned=True)

    @cached_property
    def _host_result(self) -> PinnedMirror:
        """Host mirror of ``packed_result``."""
        return PinnedMirror(self.packed_result)

    def enqueue(self) -> None:
        """Queue the search, asynchronously."""
        arrays = map(as_world, (self.packed_qp, self.packed_result, self.is_accepted))
        self._pool.run(*arrays, restart_cost=self._restart_cost)

    def parse_input(self) -> tuple[CoulombProgram, np.ndarray, ContactModes]:
        """Return the contents of ``packed_qp``: the QP, and the activations (m,) and contact modes at the start of the
        search."""
        return parse_packed_qp(self.packed_qp.numpy())

    def search(
        self, program: CoulombProgram, start: np.ndarray, modes: ContactModes, qp_limit: int
    ) -> ModeSearchResult | None:
        """Upload the QP, run the search, and return its result; arguments as in ``search_modes_device``."""
        m, n, at = program.activation_count, program.contact_count, kernels.HEADER_SIZE
        packed = self._host_input.numpy()
        packed[:at] = m, n, program.friction, program.constant, qp_limit, 0, 0, 0
        for part in (
            *(program.P, program.q, program.rows, program.offset, program.lower, program.upper),
            *(start[:m], modes.kind, modes.slip),
        ):
            packed[at : at + part.size] = part.ravel()
            at += part.size
        if self._host_input is not self.packed_qp:
            wp.copy(self.packed_qp, self._host_input, count=at)
        self.enqueue()
        return self.parse_result(m + 3 * n)

    def parse_result(self, size: int) -> ModeSearchResult | None:
        """Download the result, whose point has ``size`` entries; return None on numerical failure."""
        return parse_packed_result(self._host_result.get(), size)


class RelaxationWorkspace:
    """Buffers of ``relaxed_qp_kernel`` in one world, for at most ``m`` activations and ``n`` contacts.

    The kernel computes the relaxed optimum of the QP in ``search.packed_qp`` and writes it to ``packed_result``, whose
    layout it documents. It ends early once ``search`` has set ``is_accepted``.
    """

    def __init__(self, m: int, n: int, search: ModeSearchWorkspace) -> None:
        device = device_of(search.packed_qp)
        self.packed_result = wp.zeros(kernels.HEADER_SIZE + m, dtype=real, device=device)
        cancelled, self._packed_qp = search.is_accepted, search.packed_qp
        self._pool = SearchPool(relaxed_qp_kernel, relaxation_shapes(m, n), 1, device.alias, cancelled=cancelled)

    @cached_property
    def _host_result(self) -> PinnedMirror:
        """Host mirror of ``packed_result``."""
        return PinnedMirror(self.packed_result)

    def enqueue(self) -> None:
        """Queue the launch, asynchronously."""
        self._pool.run(as_world(self._packed_qp), as_world(self.packed_result))

    def parse_result(self) -> tuple[np.ndarray, float] | None:
        """Download the activations and the objective of the relaxed optimum, as in ``solve_relaxed``. Return None on
        numerical failure, or if the launch ended early because the mode search had an accepted result."""
        packed_result = self._host_result.get()
        # Large enough forces always prevent penetration, so the relaxed QP is feasible and any other status is a
        # failure.
        return (
            (packed_result[kernels.HEADER_SIZE :], float(packed_result[1]))
            if packed_result[0] == OPTIMUM_FOUND
            else None
        )


def packed_qp_size(m: int, n: int) -> int:
    """Return the length of the packed input of ``mode_search_kernel`` for ``m`` activations and ``n`` contacts."""
    size = m + 3 * n
    return kernels.HEADER_SIZE + size * size + size + 3 * n * (size + 1) + 3 * m + 3 * n


def parse_packed_qp(packed: np.ndarray) -> tuple[CoulombProgram, np.ndarray, ContactModes]:
    """Return the contents of a packed input: the QP, and the activations (m,) and contact modes at the start of the
    search."""
    m, n = int(packed[0]), int(packed[1])
    size = m + 3 * n
    shapes = (size, size), (size,), (3 * n, size), (3 * n,), (m,), (m,), (m,), (n,), (n, 2)
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    parts = np.split(packed[kernels.HEADER_SIZE : kernels.HEADER_SIZE + ends[-1]], ends[:-1])
    P, q, rows, offset, lower, upper, *start = (each.reshape(shape) for each, shape in zip(parts, shapes, strict=True))
    program = CoulombProgram(P, q, float(packed[3]), rows, offset, float(packed[2]), lower, upper)
    return program, start[0], ContactModes(start[1].astype(int), start[2])


def parse_packed_result(packed: np.ndarray, size: int) -> ModeSearchResult | None:
    """Return a packed result, whose point has ``size`` entries; None on numerical failure."""
    status, count, infeasible, objective, has_point = packed[:5].tolist()
    if status == NUMERICAL_FAILURE:
        return None
    x = packed[kernels.HEADER_SIZE : kernels.HEADER_SIZE + size] if has_point else None
    return ModeSearchResult(x, objective, int(count), int(infeasible))


def mode_search_shapes(m: int, n: int) -> dict[Any, dict[str, tuple[int, ...]]]:
    """Return the shapes of the arrays of each struct of ``mode_search_kernel``, in the order of its parameters, for at
    most ``m`` activations and ``n`` contacts."""
    size, constraint_capacity, force_count, base_count = m + 3 * n, 9 * n, 3 * n, 5 * n
    row_capacity = m + constraint_capacity
    shapes = {
        **dict.fromkeys(("held_index", "first"), (n,)),
        **dict.fromkeys(("closed_forces", "held_forces", "speeds"), (force_count,)),
        **dict.fromkeys(("base_rows", "coefficients"), (constraint_capacity, 3)),
        **dict.fromkeys(("contact", "transition", "next", "multipliers"), (constraint_capacity,)),
        **{"kinds": (4, n), "slips": (4, n, 2)},
        "equations": (force_count, force_count + m + 1),
        "force_map": (base_count, m + 1),
        "cost_rows": (size, force_count),
        "cost_products": (size, m + 1),
        **dict.fromkeys(("cost", "root"), (m, m)),
        **dict.fromkeys(("slope", "minimum", "optimum", "start"), (m,)),
        **dict.fromkeys(("at_minimum", "at_start", "at_optimum"), (base_count,)),
        **{"lengths": (row_capacity,), "bounds": (2, row_capacity)},
        **dict.fromkeys(("values", "trial"), (size,)),
    }
    return {kernels.Workspace: shapes, **_active_set_shapes(row_capacity, m + base_count, m)}


def relaxation_shapes(m: int, n: int) -> dict[Any, dict[str, tuple[int, ...]]]:
    """Return the shapes for ``relaxed_qp_kernel``, see ``mode_search_shapes``."""
    size, row_capacity = m + 3 * n, m + (2 + CONE_FACES) * n
    shapes = {
        **{"cost": (size, size), "root": (size, size), "leaving": (n, size), "speeds": (n,)},
        **dict.fromkeys(("minimum", "optimum", "slope", "values"), (size,)),
        **{"lengths": (row_capacity,), "bounds": (2, row_capacity)},
    }
    return {Relaxed: shapes, **_active_set_shapes(row_capacity, n + size, size)}


def _active_set_shapes(rows: int, base_rows: int, unknowns: int) -> dict[Any, dict[str, tuple[int, ...]]]:
    """Return the shapes of ``UnitConstraints``, ``ActiveSet`` and ``Splitting``, see ``active_set_shapes``."""
    row_shapes, state_shapes = active_set_shapes(rows, base_rows, unknowns)
    names = "rows", "projected", "multipliers", "sums", "right", "between", "step"
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(names, (unknowns,)),
        **dict.fromkeys(("initial_values", "all_multipliers"), (rows,)),
    }
    return {UnitConstraints: row_shapes, ActiveSet: state_shapes, Splitting: shapes}


class SearchPool:
    """Scratch memory of ``mode_search_kernel`` or ``relaxed_qp_kernel`` for a limited number of worlds. More worlds are
    processed in several launches."""

    def __init__(
        self,
        kernel: Any,
        shapes: dict[Any, dict[str, tuple[int, ...]]],
        worlds: int,
        alias: str,
        *,
        cancelled: wp.array | None = None,
    ) -> None:
        """Allocate the memory.

        Args:
            kernel: the kernel.
            shapes: its structs with the shapes of their arrays, see ``mode_search_shapes``.
            worlds: number of worlds that are processed at once.
            alias: name of the device.
            cancelled: (1,) int32, ``UnitConstraints.cancelled``; None if nothing cancels the launches.
        """
        self._device, self._kernel, self._worlds = wp.get_device(alias), kernel, worlds
        flag = wp.zeros(1, dtype=int, device=self._device) if cancelled is None else cancelled
        self._structs = [
            StructPerWorld(
                struct, each, worlds, self._device, **({"cancelled": flag} if struct is UnitConstraints else {})
            )
            for struct, each in shapes.items()
        ]

    def run(self, packed: wp.array, *outputs: wp.array, restart_cost: float | None = None) -> None:
        """Launch the kernel for the worlds of ``packed`` (B, ...), and write its ``outputs`` (B, ...). The
        ``restart_cost`` is that of ``mode_search_kernel``; other kernels have none."""
        block = kernels.BLOCK if self._worlds == 1 else WORLD_BLOCK
        lanes = 1 if self._device.is_cpu else block
        parameters = [] if restart_cost is None else [restart_cost]
        for first in range(0, packed.shape[0], self._worlds):
            part = slice(first, min(first + self._worlds, packed.shape[0]))
            wp.launch(
                self._kernel,
                dim=(part.stop - part.start, lanes),
                inputs=[packed[part], *parameters, *(each.structs for each in self._structs)],
                outputs=[each[part] for each in outputs],
                device=self._device,
                block_dim=lanes,
            )


_thread_workspace = thread_local_cache(16)(ModeSearchWorkspace)
