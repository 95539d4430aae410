"""A body's step on a GPU: where it starts, its matrix, and what keeps its momentum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.detection import ContactSet
from egs_warp.contact.device_sight import DeviceSight
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.dense_factors import DenseFactors
from egs_warp.fem.element_kernels import ElementKernels
from egs_warp.fem.graphs import Recordings, Upload
from egs_warp.fem.step_problem import NEGLIGIBLE, StepProblem
from egs_warp.fem.worlds import shared
from egs_warp.kernels.contact import step_start as kernels
from egs_warp.launching import by_steps
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleTension
from egs_warp.precision import Mat33, Vec3, real

_DIRECTIONS = 64
"""Of muscles' stiffness so many are added at a time."""
_SIGNS = (1.0, -1.0)
"""Of what is added, the second one last."""


@dataclass(frozen=True)
class Ended:
    """Where a solve has ended."""

    velocities: np.ndarray
    """(N, 3) m/s, after a step of ``dt`` seconds."""
    dt: float
    points: np.ndarray
    """(n,) of its contacts."""
    places: int

    def places_for(self, state: BodyState, dt: float, points: np.ndarray) -> int | None:
        """The places, if a step of ``dt`` seconds from ``state`` goes on from there."""
        same = self.velocities is state.velocities and self.points is points and self.dt == dt
        return self.places if same else None


class BodyRoom:
    """Of one body with dense ``factors``, where its elements are: a step's start, and what keeps its momentum."""

    def __init__(self, factors: DenseFactors, body: SoftBody, muscles: MuscleSet, sight: DeviceSight) -> None:
        self.factors, self.body, self.stream, self.sight = factors, body, factors.stream, sight
        elements = body.assembly.elements
        assert isinstance(elements, ElementKernels)
        self.elements = elements
        size = 3 * len(body.mesh.nodes)
        self.turned, self.keeping = self.zeros(size, 3), self.zeros(3, size)
        """What a solution lacks of a turn is ``turned`` times ``keeping`` times what it is the solution of."""
        self.masses = self.tensor(body.node_mass)
        self._start = Upload(self.stream, 2 * size)
        self.positions, self.velocities = self._start.there.split(size)
        self.arms, self.start, self.ballistic, self._next_ballistic = self.zeros(4, size)
        self.turns, self.rates = self.zeros(size, 3), self.zeros(1, 3, 3)
        """See ``StepProblem``; ``ballistic`` is where the nodes would end without forces, metres."""
        self._ends = vectors(self.positions), vectors(self.ballistic)
        self._gravity = self.tensor(np.tile(body.gravity, len(body.mesh.nodes)))
        self._works = Recordings(self.stream)
        self.no_tensions = wp.zeros(0, dtype=real, device=body.assembly.device)
        self.gradients = wp.zeros(len(body.mesh.tets), dtype=Mat33, device=body.assembly.device)
        self.lines = elements.muscle_lines(MuscleTension.of(muscles, np.zeros(muscles.segment_count)))
        self.segment_count = muscles.segment_count
        self._rows = self.tensor(self.lines.rows.toarray())
        self._ways = Upload(self.stream, 4 * (3 * self.segment_count + 2 * _DIRECTIONS))
        self._taken: tuple[BodyState, float] | None = None
        """What lies there: the state that a step of so many seconds begins from."""
        self._looked_for: np.ndarray | None = None
        """(m,) points of the step before with which contacts are being chosen."""
        self.ended: Ended | None = None
        """Where the solve has ended that came last: contacts of a step from there are chosen already."""
        self._places: int | None = None
        """As many places had the contacts there, if these are asked for."""
        self.foreseen: Any = None
        """The start of which a plan has begun there; None once anything else was done."""
        self.looked_at: StepProblem | None = None
        """Whose gaps at the start are known to ``sight``."""

    def zeros(self, *shape: int) -> torch.Tensor:
        """On the device."""
        return torch.zeros(shape, dtype=torch.float64, device=self.factors.device)

    def tensor(self, values: np.ndarray) -> torch.Tensor:
        """On the device."""
        return torch.as_tensor(np.ascontiguousarray(values, dtype=np.float64), device=self.factors.device)

    def take(self, problem: StepProblem) -> None:
        """The step that begins there."""
        self._take(problem.state, problem.dt)

    def _take(self, state: BodyState, dt: float) -> None:
        if self._taken is not None and self._taken[0] is state and self._taken[1] == dt:
            return
        self._leave()
        self._taken, self.looked_at, self.foreseen = (state, dt), None, None
        self._start.write(state.positions, state.velocities)
        self._works.run(dt, lambda: self._enqueue_start(dt))
        self._start.sent()

    def _enqueue_start(self, dt: float) -> None:
        self._start.send()
        device = self.body.assembly.device
        lanes = 1 if device.is_cpu else kernels.BLOCK
        wp.launch(
            kernels.step_start_kernel,
            lanes,
            inputs=[dt, shared(self.masses, real), vectors(self.positions), vectors(self.velocities)],
            outputs=[vectors(self.arms), shared(self.turns, real), shared(self.rates, Mat33), vectors(self.start)],
            device=device,
            block_dim=lanes,
        )
        self.elements.enqueue_start(vectors(self.positions), self.gradients)
        self._enqueue_ballistic(self.positions, self.velocities, dt, self.ballistic)

    def look_ahead(self, state: BodyState, dt: float, before: np.ndarray) -> None:
        """Begin ``choose`` for a step of ``dt`` seconds from ``state``; nobody waits."""
        with self.stream:
            self._leave()
            self._take(state, dt)
            self._places = self.ended.places_for(state, dt, before) if self.ended else None
            if self._places is None:
                self.sight.look(*self._ends, before)
            else:
                self.sight.go_on()
        self._looked_for, self.ended = before, None

    def choose(self, problem: StepProblem, before: np.ndarray, loaded: np.ndarray) -> ContactSet:
        """Contacts of a step that begins there, see ``DeviceSight``."""
        with self.stream:
            self.take(problem)
        if self._looked_for is None or not np.array_equal(self._looked_for, before):
            self.look_ahead(problem.state, problem.dt, before)
        self.looked_at, self._looked_for = problem, None
        return self.sight.choose(before, loaded, problem.state.positions, places=self._places)

    def _leave(self) -> None:
        """What was begun and nobody has asked for: what was told for it may still be on its way."""
        if self._looked_for is not None:
            self._looked_for = None
            self.stream.wait()

    def enqueue_next(self, ends: torch.Tensor, velocities: torch.Tensor, dt: float, points: torch.Tensor) -> None:
        """Begin ``choose`` for a step from ``ends`` (3N,) at ``velocities`` (3N,), after ``points`` (K,) int32."""
        self._enqueue_ballistic(ends, velocities, dt, self._next_ballistic)
        self.sight.enqueue_next(vectors(self._next_ballistic), points)

    def _enqueue_ballistic(
        self, positions: torch.Tensor, velocities: torch.Tensor, dt: float, ballistic: torch.Tensor
    ) -> None:
        torch.add(velocities, self._gravity, alpha=dt, out=ballistic)
        ballistic.mul_(dt).add_(positions)

    def enqueue_factors(self, ends: wp.array, dt: float) -> None:
        """Of the step's matrix at the positions ``ends``, without muscles."""
        made = self.elements.enqueue_entries(ends, self.gradients, dt, factor=dt**2, projected=False)
        self.factors.enqueue(wp.to_torch(made))

    def enqueue_stiffness(self, problem: StepProblem, tension: MuscleTension, velocities: np.ndarray) -> None:
        """Add that of muscles under ``tension`` at the end of ``velocities`` (N, 3) to the matrix that is factored."""
        segments, ways, rates = tension.hessian(problem.end_positions(velocities)).ways(least=NEGLIGIBLE)
        # What pulls adds to it, what pushes takes away; what is there in between adds nothing.
        of_signs = {sign: np.flatnonzero(sign * rates > 0.0) for sign in _SIGNS}
        told = [np.zeros((by_steps(len(chosen), _DIRECTIONS), 4)) for chosen in of_signs.values()]
        for chosen, part in zip(of_signs.values(), told, strict=True):
            part[: len(chosen), 0] = segments[chosen]
            part[: len(chosen), 1:] = problem.dt * np.sqrt(np.abs(rates[chosen]))[:, None] * ways[chosen]
        self._ways.take(*told)
        places, signs = tuple(map(len, told)), tuple(sign for sign, chosen in of_signs.items() if len(chosen) > 0)
        self._works.run((places, signs), lambda: self._enqueue_sums(places, signs))

    def _enqueue_sums(self, places: tuple[int, ...], signs: tuple[float, ...]) -> None:
        """Of the ways that were told, so many for each sign, those with these ``signs``."""
        parts = self._ways.there[: 4 * sum(places)].view(-1, 4).split(places)
        for sign, part in zip(_SIGNS, parts, strict=True):
            if sign in signs:
                directions = self._rows[part[:, 0].long()][:, :, None] * part[:, None, 1:]
                self.factors.enqueue_sum(directions.view(len(part), -1), sign)

    def enqueue_gradient(self, ends: wp.array, dt: float, tensions: wp.array, gradient: wp.array) -> None:
        """Into ``gradient``, newtons, at the positions ``ends``, under ``tensions`` of the muscles."""
        self.elements.enqueue_gradient(ends, self.gradients, dt, self.lines, tensions, gradient)


def vectors(flat: torch.Tensor) -> wp.array:
    """(N, 3) of a ``flat`` one (3N,)."""
    return shared(flat.view(-1, 3), Vec3)
