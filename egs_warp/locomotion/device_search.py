"""The search over pieces of contact where the body lies: one launch, and one look at what it found."""

from __future__ import annotations

import math
from functools import cached_property, partial
from typing import Any

import numpy as np
import warp as wp

from egs_warp.kernels.locomotion import mode_search as kernels
from egs_warp.kernels.locomotion.active_set import FOUND, NUMERICAL_FAILURE
from egs_warp.kernels.locomotion.block_active_set import ActiveSet, UnitConstraints
from egs_warp.kernels.locomotion.block_splitting import Splitting
from egs_warp.kernels.locomotion.mode_region import CONE_FACES
from egs_warp.kernels.locomotion.relaxed_contact import Relaxed, relaxed_qp_kernel
from egs_warp.launching import PinnedMirror, device_of, round_up, thread_local_cache
from egs_warp.locomotion.contact_modes import ContactModes, CoulombProgram, ModeSearchResult
from egs_warp.precision import real

_PLACES = 8
"""Contacts are so many at a time."""


def search_modes_device(
    program: CoulombProgram, start: np.ndarray, modes: ContactModes, *, qp_limit: int, device: wp.Device
) -> ModeSearchResult | None:
    """``search_pieces`` on the ``device``; None where rounding leads astray."""
    places = round_up(program.contact_count, _PLACES)
    return _room(program.activation_count, places, device.alias).search(program, start, modes, qp_limit)


class ModeSearchWorkspace:
    """Memory for programs of m activations and n contacts at most, and the launch that reads what is ``told`` and
    writes the ``answer``, see ``search_kernel``: it has ``settled`` the search as soon as an end is not ``costly``, and
    ends where another that it is ``beside`` has done so."""

    def __init__(
        self, m: int, n: int, alias: str, *, costly: float = 0.0, beside: ModeSearchWorkspace | None = None
    ) -> None:
        self._device, size = wp.get_device(alias), m + 3 * n
        zeros = partial(wp.zeros, device=self._device)
        self.packed_qp = zeros(
            kernels.HEADER_SIZE + size * size + size + 3 * n * (size + 1) + 3 * m + 3 * n, dtype=real
        )
        self.packed_result, self.settled = zeros(kernels.HEADER_SIZE + size, dtype=real), zeros(1, dtype=int)
        further, forces, answers = 9 * n, 3 * n, 5 * n
        total = m + further
        room = kernels.Workspace()
        for name, shape in {
            **dict.fromkeys(("held_index", "first"), n),
            **dict.fromkeys(("closed_forces", "held_forces", "speeds"), forces),
            **{"base_rows": (further, 3), "contact": further, "transition": further, "next": further, "kinds": (4, n)},
        }.items():
            setattr(room, name, zeros(shape, dtype=int))
        for name, shape in {
            "coefficients": (further, 3),
            "equations": (forces, forces + m + 1),
            "force_map": (answers, m + 1),
            "cost_rows": (size, forces),
            "cost_products": (size, m + 1),
            **dict.fromkeys(("cost", "root"), (m, m)),
            **dict.fromkeys(("slope", "minimum", "optimum", "start"), m),
            **dict.fromkeys(("at_minimum", "at_start", "at_found"), answers),
            **{"lengths": total, "bounds": (2, total), "multipliers": further, "slips": (4, n, 2)},
            **dict.fromkeys(("values", "trial"), size),
        }.items():
            setattr(room, name, zeros(shape, dtype=real))
        # The launch has where these lie.
        self._held = room, *_active_set(total, m + answers, m, beside.settled if beside else zeros(1, dtype=int))
        given = [self.packed_qp, costly, *self._held]
        self._launch: Any = _launch(kernels.mode_search_kernel, given, [self.packed_result, self.settled])

    @cached_property
    def _host_input(self) -> wp.array:
        """What goes there. What is read is what was told for this search: the launch before has ended, since its answer
        was looked at."""
        return self.packed_qp if self._device.is_cpu else wp.zeros(self.packed_qp.shape, real, "cpu", pinned=True)

    @cached_property
    def _host_result(self) -> PinnedMirror:
        return PinnedMirror(self.packed_result)

    def enqueue(self) -> None:
        """The search, with nothing that waits."""
        self._launch.launch()

    def parse_input(self) -> tuple[CoulombProgram, np.ndarray, ContactModes]:
        """What was told: the program, activations (m,) of the start and how contacts move there."""
        told = self.packed_qp.numpy()
        m, n = int(told[0]), int(told[1])
        size = m + 3 * n
        shapes = (size, size), (size,), (3 * n, size), (3 * n,), (m,), (m,), (m,), (n,), (n, 2)
        ends = np.cumsum([math.prod(shape) for shape in shapes])
        parts = np.split(told[kernels.HEADER_SIZE : kernels.HEADER_SIZE + ends[-1]], ends[:-1])
        P, q, rows, offset, lower, upper, *start = (
            each.reshape(shape) for each, shape in zip(parts, shapes, strict=True)
        )
        program = CoulombProgram(P, q, float(told[3]), rows, offset, float(told[2]), lower, upper)
        return program, start[0], ContactModes(start[1].astype(int), start[2])

    def search(
        self, program: CoulombProgram, start: np.ndarray, modes: ContactModes, qp_limit: int
    ) -> ModeSearchResult | None:
        """See ``search_at_once``."""
        m, n, at = program.activation_count, program.contact_count, kernels.HEADER_SIZE
        given = self._host_input.numpy()
        given[:at] = m, n, program.friction, program.constant, qp_limit, 0, 0, 0
        for part in (
            *(program.P, program.q, program.rows, program.offset, program.lower, program.upper),
            *(start[:m], modes.kind, modes.slip),
        ):
            given[at : at + part.size] = part.ravel()
            at += part.size
        if self._host_input is not self.packed_qp:
            wp.copy(self.packed_qp, self._host_input, count=at)
        self.enqueue()
        return self.parse_result(m + 3 * n)

    def parse_result(self, size: int) -> ModeSearchResult | None:
        """What has come of the search, a point (size,); None where rounding leads astray."""
        answer = self._host_result.get()
        ended, count, infeasible, objective, there = answer[:5].tolist()
        if ended == NUMERICAL_FAILURE:
            return None
        x = answer[kernels.HEADER_SIZE : kernels.HEADER_SIZE + size] if there else None
        return ModeSearchResult(x, objective, int(count), int(infeasible))


class RelaxationWorkspace:
    """Memory for the optimum without complementarity of the program that a ``search`` of m activations and n contacts
    at most was told, and its launch, whose ``answer`` is what ``relax_kernel`` says, unless that search has settled."""

    def __init__(self, m: int, n: int, search: ModeSearchWorkspace) -> None:
        device, size, total = device_of(search.packed_qp), m + 3 * n, m + (2 + CONE_FACES) * n
        self.answer = wp.zeros(kernels.HEADER_SIZE + m, dtype=real, device=device)
        relaxed = Relaxed()
        for name, shape in {
            **{"cost": (size, size), "root": (size, size), "leaving": (n, size), "speeds": n},
            **dict.fromkeys(("minimum", "found", "slope", "values"), size),
            **{"lengths": total, "bounds": (2, total)},
        }.items():
            setattr(relaxed, name, wp.zeros(shape, dtype=real, device=device))
        # The launch has where these lie.
        self._held = search.packed_qp, relaxed, *_active_set(total, n + size, size, search.settled)
        self._launch: Any = _launch(relaxed_qp_kernel, list(self._held), [self.answer])

    @cached_property
    def _answer_here(self) -> PinnedMirror:
        return PinnedMirror(self.answer)

    def enqueue(self) -> None:
        """The launch, with nothing that waits."""
        self._launch.launch()

    def found(self) -> tuple[np.ndarray, float] | None:
        """What has come of it, see ``solve_relaxed``; None where rounding leads astray, or the search has settled."""
        answer = self._answer_here.get()
        # Contact can always push so hard that nothing sinks in: where no point is found there is one all the same.
        return (answer[kernels.HEADER_SIZE :], float(answer[1])) if answer[0] == FOUND else None


def _active_set(rows: int, made_of: int, unknowns: int, settled: wp.array) -> tuple[Any, Any, Any]:
    """``UnitRows``, ``Holding`` and ``Splitting`` for so many at most."""
    zeros = partial(wp.zeros, device=device_of(settled))
    units, holding, splitting = UnitConstraints(), ActiveSet(), Splitting()
    units.cancelled = settled
    units.units, units.base_values = zeros((made_of, unknowns), dtype=real), zeros(made_of, dtype=real)
    units.base_rows, units.coefficients = zeros((rows, 3), dtype=int), zeros((rows, 3), dtype=real)
    for name in ("values_at_origin", "lower", "upper", "slack"):
        setattr(units, name, zeros(rows, dtype=real))
    holding.side, holding.active = zeros(rows, dtype=int), zeros(unknowns, dtype=int)
    for name in ("active_rows", "active_columns", "products", "root", "inverse"):
        setattr(holding, name, zeros((unknowns, unknowns), dtype=real))
    holding.values = zeros(rows, dtype=real)
    for name in ("multipliers", "z", "dual_direction", "scratch_a", "scratch_b", "entering_row", "orthogonal_part"):
        setattr(holding, name, zeros(unknowns, dtype=real))
    splitting.initial_values, splitting.all_multipliers = zeros(rows, dtype=real), zeros(rows, dtype=real)
    for name in ("rows", "projected", "multipliers", "sums", "right", "between", "step"):
        setattr(splitting, name, zeros(unknowns, dtype=real))
    return units, holding, splitting


def _launch(kernel: Any, inputs: list[Any], outputs: list[wp.array]) -> Any:
    """By one block."""
    device = device_of(outputs[0])
    return wp.launch(
        kernel,
        dim=1 if device.is_cpu else kernels.BLOCK,
        inputs=inputs,
        outputs=outputs,
        device=device,
        block_dim=kernels.BLOCK,
        record_cmd=True,
    )


_room = thread_local_cache(16)(ModeSearchWorkspace)
