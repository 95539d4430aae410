"""A body's step on a GPU: where it starts, its matrix, and what keeps its momentum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.detection import ContactSet
from egs_warp.contact.device_selection import DeviceContactSelector
from egs_warp.fem.batched import as_warp
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.cuda_graphs import GraphCache, PinnedUpload
from egs_warp.fem.dense_cholesky import DenseCholesky
from egs_warp.fem.step_problem import MIN_RELATIVE_STIFFNESS, StepProblem
from egs_warp.fem.warp_elasticity import WarpElasticity
from egs_warp.kernels.contact import step_start as kernels
from egs_warp.launching import round_up
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import Mat33, Vec3, real

_DIRECTIONS = 64
"""Of muscles' stiffness so many are added at a time."""
_SIGNS = (1.0, -1.0)
"""Of what is added, the second one last."""


@dataclass(frozen=True)
class SolveEnd:
    """Where a solve has ended."""

    velocities: np.ndarray
    """(N, 3) m/s, after a step of ``dt`` seconds."""
    dt: float
    points: np.ndarray
    """(n,) of its contacts."""
    capacity: int

    def capacity_if_continued(self, state: BodyState, dt: float, points: np.ndarray) -> int | None:
        """The places, if a step of ``dt`` seconds from ``state`` goes on from there."""
        same = self.velocities is state.velocities and self.points is points and self.dt == dt
        return self.capacity if same else None


class StepWorkspace:
    """Of one body with dense ``factors``, where its elements are: a step's start, and what keeps its momentum."""

    def __init__(
        self, factors: DenseCholesky, body: SoftBody, muscles: MuscleSet, sight: DeviceContactSelector
    ) -> None:
        self.factors, self.body, self.stream, self.selector = factors, body, factors.stream, sight
        elements = body.assembly.elements
        assert isinstance(elements, WarpElasticity)
        self.elements = elements
        size = 3 * len(body.mesh.nodes)
        self.rotation_response, self.momentum_projection = self.zeros(size, 3), self.zeros(3, size)
        """What a solution lacks of a turn is ``turned`` times ``keeping`` times what it is the solution of."""
        self.masses = self.tensor(body.node_mass)
        self._start = PinnedUpload(self.stream, 2 * size)
        self.positions, self.velocities = self._start.device.split(size)
        self.lever_arms, self.rigid_guess, self.ballistic, self._next_ballistic = self.zeros(4, size)
        self.rotation_modes, self.inverse_inertia = self.zeros(size, 3), self.zeros(1, 3, 3)
        """See ``StepProblem``; ``ballistic`` is where the nodes would end without forces, metres."""
        self._ends = vectors(self.positions), vectors(self.ballistic)
        self._gravity = self.tensor(np.tile(body.gravity, len(body.mesh.nodes)))
        self._works = GraphCache(self.stream)
        self.no_tensions = wp.zeros(0, dtype=real, device=body.assembly.device)
        self.gradients = wp.zeros(len(body.mesh.tets), dtype=Mat33, device=body.assembly.device)
        self.lines = elements.muscle_segments(MuscleEnergy.of(muscles, np.zeros(muscles.segment_count)))
        self.segment_count = muscles.segment_count
        self._rows = self.tensor(self.lines.rows.toarray())
        self._ways = PinnedUpload(self.stream, 4 * (3 * self.segment_count + 2 * _DIRECTIONS))
        self._loaded_step: tuple[BodyState, float] | None = None
        """What lies there: the state that a step of so many seconds begins from."""
        self._prefetch_points: np.ndarray | None = None
        """(m,) points of the step before with which contacts are being chosen."""
        self.last_solve: SolveEnd | None = None
        """Where the solve has ended that came last: contacts of a step from there are chosen already."""
        self._prefetch_capacity: int | None = None
        """As many places had the contacts there, if these are asked for."""
        self.predicted_start: Any = None
        """The start of which a plan has begun there; None once anything else was done."""
        self.gaps_of: StepProblem | None = None
        """Whose gaps at the start are known to ``sight``."""

    def zeros(self, *shape: int) -> torch.Tensor:
        """On the device."""
        return torch.zeros(shape, dtype=torch.float64, device=self.factors.device)

    def tensor(self, values: np.ndarray) -> torch.Tensor:
        """On the device."""
        return torch.as_tensor(np.ascontiguousarray(values, dtype=np.float64), device=self.factors.device)

    def set_problem(self, problem: StepProblem) -> None:
        """The step that begins there."""
        self._take(problem.state, problem.dt)

    def _take(self, state: BodyState, dt: float) -> None:
        if self._loaded_step is not None and self._loaded_step[0] is state and self._loaded_step[1] == dt:
            return
        self._cancel_prefetch()
        self._loaded_step, self.gaps_of, self.predicted_start = (state, dt), None, None
        self._start.write(state.positions, state.velocities)
        self._works.run(dt, lambda: self._enqueue_start(dt))
        self._start.start_copy()

    def _enqueue_start(self, dt: float) -> None:
        self._start.send()
        device = self.body.assembly.device
        lanes = 1 if device.is_cpu else kernels.BLOCK
        wp.launch(
            kernels.step_start_kernel,
            lanes,
            inputs=[dt, as_warp(self.masses, real), vectors(self.positions), vectors(self.velocities)],
            outputs=[
                vectors(self.lever_arms),
                as_warp(self.rotation_modes, real),
                as_warp(self.inverse_inertia, Mat33),
                vectors(self.rigid_guess),
            ],
            device=device,
            block_dim=lanes,
        )
        self.elements.enqueue_start(vectors(self.positions), self.gradients)
        self._enqueue_ballistic(self.positions, self.velocities, dt, self.ballistic)

    def prefetch_contacts(self, state: BodyState, dt: float, before: np.ndarray) -> None:
        """Begin ``choose`` for a step of ``dt`` seconds from ``state``; nobody waits."""
        with self.stream:
            self._cancel_prefetch()
            self._take(state, dt)
            self._prefetch_capacity = (
                self.last_solve.capacity_if_continued(state, dt, before) if self.last_solve else None
            )
            if self._prefetch_capacity is None:
                self.selector.start_prefetch(*self._ends, before)
            else:
                self.selector.advance_prefetch()
        self._prefetch_points, self.last_solve = before, None

    def select_contacts(self, problem: StepProblem, before: np.ndarray, loaded: np.ndarray) -> ContactSet:
        """Contacts of a step that begins there, see ``DeviceSight``."""
        with self.stream:
            self.set_problem(problem)
        if self._prefetch_points is None or not np.array_equal(self._prefetch_points, before):
            self.prefetch_contacts(problem.state, problem.dt, before)
        self.gaps_of, self._prefetch_points = problem, None
        return self.selector.select(before, loaded, problem.state.positions, places=self._prefetch_capacity)

    def _cancel_prefetch(self) -> None:
        """What was begun and nobody has asked for: what was told for it may still be on its way."""
        if self._prefetch_points is not None:
            self._prefetch_points = None
            self.stream.wait()

    def enqueue_prefetch(self, ends: torch.Tensor, velocities: torch.Tensor, dt: float, points: torch.Tensor) -> None:
        """Begin ``choose`` for a step from ``ends`` (3N,) at ``velocities`` (3N,), after ``points`` (K,) int32."""
        self._enqueue_ballistic(ends, velocities, dt, self._next_ballistic)
        self.selector.enqueue_prefetch(vectors(self._next_ballistic), points)

    def _enqueue_ballistic(
        self, positions: torch.Tensor, velocities: torch.Tensor, dt: float, ballistic: torch.Tensor
    ) -> None:
        torch.add(velocities, self._gravity, alpha=dt, out=ballistic)
        ballistic.mul_(dt).add_(positions)

    def enqueue_factors(self, ends: wp.array, dt: float) -> None:
        """Of the step's matrix at the positions ``ends``, without muscles."""
        made = self.elements.enqueue_entries(ends, self.gradients, dt, factor=dt**2, projected=False)
        self.factors.enqueue(wp.to_torch(made))

    def enqueue_stiffness(self, problem: StepProblem, tension: MuscleEnergy, velocities: np.ndarray) -> None:
        """Add that of muscles under ``tension`` at the end of ``velocities`` (N, 3) to the matrix that is factored."""
        segments, ways, rates = tension.hessian(problem.end_positions(velocities)).rank_one_terms(
            least=MIN_RELATIVE_STIFFNESS
        )
        # What pulls adds to it, what pushes takes away; what is there in between adds nothing.
        of_signs = {sign: np.flatnonzero(sign * rates > 0.0) for sign in _SIGNS}
        told = [np.zeros((round_up(len(chosen), _DIRECTIONS), 4)) for chosen in of_signs.values()]
        for chosen, part in zip(of_signs.values(), told, strict=True):
            part[: len(chosen), 0] = segments[chosen]
            part[: len(chosen), 1:] = problem.dt * np.sqrt(np.abs(rates[chosen]))[:, None] * ways[chosen]
        self._ways.set(*told)
        places, signs = tuple(map(len, told)), tuple(sign for sign, chosen in of_signs.items() if len(chosen) > 0)
        self._works.run((places, signs), lambda: self._enqueue_low_rank_updates(places, signs))

    def _enqueue_low_rank_updates(self, places: tuple[int, ...], signs: tuple[float, ...]) -> None:
        """Of the ways that were told, so many for each sign, those with these ``signs``."""
        parts = self._ways.device[: 4 * sum(places)].view(-1, 4).split(places)
        for sign, part in zip(_SIGNS, parts, strict=True):
            if sign in signs:
                directions = self._rows[part[:, 0].long()][:, :, None] * part[:, None, 1:]
                self.factors.enqueue_low_rank(directions.view(len(part), -1), sign)

    def enqueue_gradient(self, ends: wp.array, dt: float, tensions: wp.array, gradient: wp.array) -> None:
        """Into ``gradient``, newtons, at the positions ``ends``, under ``tensions`` of the muscles."""
        self.elements.enqueue_gradient(ends, self.gradients, dt, self.lines, tensions, gradient)


def vectors(flat: torch.Tensor) -> wp.array:
    """(N, 3) of a ``flat`` one (3N,)."""
    return as_warp(flat.view(-1, 3), Vec3)
