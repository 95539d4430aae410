"""The search over pieces of contact where the body lies: one launch, and one look at what it found."""

from __future__ import annotations

import math
from functools import cached_property, partial
from typing import Any

import numpy as np
import warp as wp

from egs_warp.kernels.locomotion import piece_search as kernels
from egs_warp.kernels.locomotion.active_set import ASTRAY
from egs_warp.kernels.locomotion.block_active_set import Holding, UnitRows
from egs_warp.kernels.locomotion.block_splitting import Splitting
from egs_warp.launching import Mirror, by_steps, kept_by_thread
from egs_warp.locomotion.contact_pieces import ContactModes, ContactPieces, PieceSearch
from egs_warp.precision import real

_PLACES = 8
"""Contacts are so many at a time."""


def search_at_once(
    program: ContactPieces, start: np.ndarray, modes: ContactModes, *, qp_limit: int, device: wp.Device
) -> PieceSearch | None:
    """``search_pieces`` on the ``device``; None where rounding leads astray."""
    places = by_steps(program.contacts, _PLACES)
    return _room(program.activations, places, device.alias).search(program, start, modes, qp_limit)


class SearchRoom:
    """Memory for programs of m activations and n contacts at most, and the launch that reads what is ``told`` and
    writes the ``answer``, see ``search_kernel``."""

    def __init__(self, m: int, n: int, alias: str) -> None:
        self._device, size = wp.get_device(alias), m + 3 * n
        zeros = partial(wp.zeros, device=self._device)
        self.told = zeros(kernels.HEADER + size * size + size + 3 * n * (size + 1) + 3 * m + 3 * n, dtype=real)
        self.answer = zeros(kernels.HEADER + size, dtype=real)
        further, forces, answers = 9 * n, 3 * n, 5 * n
        total = m + further
        room, rows, holding, splitting = kernels.Room(), UnitRows(), Holding(), Splitting()
        for name, shape in {
            **dict.fromkeys(("held_place", "first"), n),
            **dict.fromkeys(("touching", "held", "speeds"), forces),
            **{"parts": (further, 3), "contact": further, "onward": further, "next": further, "kinds": (4, n)},
        }.items():
            setattr(room, name, zeros(shape, dtype=int))
        for name, shape in {
            "shares": (further, 3),
            "equations": (forces, forces + m + 1),
            "answers": (answers, m + 1),
            "gathered": (size, forces),
            "moved": (size, m + 1),
            **dict.fromkeys(("cost", "root"), (m, m)),
            "turned": (answers, m),
            **dict.fromkeys(("slope", "minimum", "found", "start"), m),
            **dict.fromkeys(("at_minimum", "at_start", "at_found"), answers),
            **{"lengths": total, "bounds": (2, total), "pushes": further, "slips": (4, n, 2)},
            **dict.fromkeys(("values", "trial"), size),
        }.items():
            setattr(room, name, zeros(shape, dtype=real))
        rows.units = zeros((total, m), dtype=real)
        for name in ("free", "lower", "upper", "slack"):
            setattr(rows, name, zeros(total, dtype=real))
        holding.side, holding.active = zeros(total, dtype=int), zeros(m, dtype=int)
        for name in ("held", "held_across", "products", "root", "inverse"):
            setattr(holding, name, zeros((m, m), dtype=real))
        holding.at = zeros(total, dtype=real)
        for name in ("pulls", "place", "ways", "beside", "between", "outside"):
            setattr(holding, name, zeros(m, dtype=real))
        splitting.begun, splitting.held_by = zeros(total, dtype=real), zeros(total, dtype=real)
        for name in ("rows", "near", "pushes", "sums", "right", "between", "step"):
            setattr(splitting, name, zeros(m, dtype=real))
        # The launch has where these lie.
        self._held = room, rows, holding, splitting
        self._launch: Any = wp.launch(
            kernels.search_kernel,
            dim=1 if self._device.is_cpu else kernels.BLOCK,
            inputs=[self.told, room, rows, holding, splitting],
            outputs=[self.answer],
            device=self._device,
            block_dim=kernels.BLOCK,
            record_cmd=True,
        )

    @cached_property
    def _told_here(self) -> wp.array:
        """What goes there. What is read is what was told for this search: the launch before has ended, since its answer
        was looked at."""
        return self.told if self._device.is_cpu else wp.zeros(self.told.shape, real, "cpu", pinned=True)

    @cached_property
    def _answer_here(self) -> Mirror:
        return Mirror(self.answer)

    def enqueue(self) -> None:
        """The search, with nothing that waits."""
        self._launch.launch()

    def program(self) -> tuple[ContactPieces, np.ndarray]:
        """What was told, and the activations (m,) of the start."""
        told = self.told.numpy()
        m, n = int(told[0]), int(told[1])
        size = m + 3 * n
        shapes = (size, size), (size,), (3 * n, size), (3 * n,), (m,), (m,), (m,)
        ends = np.cumsum([math.prod(shape) for shape in shapes])
        parts = np.split(told[kernels.HEADER : kernels.HEADER + ends[-1]], ends[:-1])
        P, q, rows, offset, *bounds, start = (each.reshape(shape) for each, shape in zip(parts, shapes, strict=True))
        return ContactPieces(P, q, float(told[3]), rows, offset, float(told[2]), *bounds), start

    def search(
        self, program: ContactPieces, start: np.ndarray, modes: ContactModes, qp_limit: int
    ) -> PieceSearch | None:
        """See ``search_at_once``."""
        m, n, at = program.activations, program.contacts, kernels.HEADER
        given = self._told_here.numpy()
        given[:at] = m, n, program.friction, program.constant, qp_limit, 0, 0, 0
        for part in (
            *(program.P, program.q, program.rows, program.offset, program.lower, program.upper),
            *(start[:m], modes.kind, modes.slip),
        ):
            given[at : at + part.size] = part.ravel()
            at += part.size
        if self._told_here is not self.told:
            wp.copy(self.told, self._told_here, count=at)
        self.enqueue()
        answer = self._answer_here.get()
        ended, count, infeasible, objective, there = answer[:5].tolist()
        if ended == ASTRAY:
            return None
        x = answer[kernels.HEADER : kernels.HEADER + m + 3 * n] if there else None
        return PieceSearch(x, objective, int(count), int(infeasible))


_room = kept_by_thread(16)(SearchRoom)
