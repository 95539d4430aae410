"""Start and system matrix of a step of one body on a GPU: buffers, factorisation and prefetch of contacts.

The kernels of the start are in ``kernels/fem/step_start.py``. ``DeviceContactLinearizer`` in ``device_newton`` extends
``StepWorkspace`` by the contact linearisations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.prefetch import ContactPrefetch
from egs_warp.fem.batch_problem import enqueue_step_start
from egs_warp.fem.batched import as_warp
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.cuda_graphs import GraphCache, PinnedUpload
from egs_warp.fem.implicit_step import MIN_RELATIVE_STIFFNESS
from egs_warp.fem.step_problem import StepProblem
from egs_warp.fem.tiled_cholesky import TiledCholesky
from egs_warp.fem.warp_elasticity import WarpElasticity
from egs_warp.launching import round_up
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import Mat33, Vec3

_CAPACITY_STEP = 64
"""Multiple to which capacities for rank-one terms of the muscles' stiffness are rounded up."""
_SIGNS = (1.0, -1.0)
"""Signs of the low-rank updates; the update with the negative sign is applied last."""


@dataclass(frozen=True)
class SolveEnd:
    """End of the last solve, from which the next step may continue."""

    velocities: np.ndarray
    """(N, 3) m/s, at the end of the step."""
    dt: float
    """Step size, s."""
    points: np.ndarray
    """(n,) contact points of the solve."""
    loaded: np.ndarray
    """(n,) bool, True for points that carry load."""
    capacity: int
    """Contact capacity K of the workspace of the solve."""

    def capacity_if_continued(self, state: BodyState, dt: float, points: np.ndarray, loaded: np.ndarray) -> int | None:
        """Return the contact capacity if the next step continues from this end, else None; arguments as in
        ``ContactLinearizer.prefetch_contacts``."""
        same = self.velocities is state.velocities and self.points is points and self.dt == dt
        return self.capacity if same and np.array_equal(self.loaded, loaded) else None


class StepWorkspace:
    """Buffers for the start, the system matrix and the momentum projection of a step of one body with dense
    ``factors``, on the device that holds its elements."""

    def __init__(self, factors: TiledCholesky, body: SoftBody, muscles: MuscleSet, prefetch: ContactPrefetch) -> None:
        self.factors, self.body, self.stream, self.prefetch = factors, body, factors.stream, prefetch
        elements = body.assembly.elements
        assert isinstance(elements, WarpElasticity)
        self.elements = elements
        size = 3 * len(body.mesh.nodes)
        self.masses = self.tensor(body.node_mass)
        self._start_upload = PinnedUpload(self.stream, 2 * size)
        self.positions, self.velocities = self._start_upload.device.split(size)
        self.lever_arms, self.rigid_guess, self.ballistic, self._next_ballistic = self.zeros(4, size)
        self.rotation_modes, self.inverse_inertia = self.zeros(size, 3), self.zeros(1, 3, 3)
        """(3N, 3) and (1, 3, 3), as in ``StepProblem``. ``ballistic`` (3N,) m are the end positions of the nodes
        without internal and contact forces."""
        self._ends = vectors(self.positions), vectors(self.ballistic)
        self._gravity = self.tensor(np.tile(body.gravity, len(body.mesh.nodes)))
        self._graphs = GraphCache(self.stream)
        self.gradients = wp.zeros(len(body.mesh.tets), dtype=Mat33, device=body.assembly.device)
        self.muscle_segments = elements.segments(muscles.difference_rows, muscles.rest_lengths)
        self.segment_count = muscles.segment_count
        self._rows = self.tensor(self.muscle_segments.rows.toarray())
        self._directions_upload = PinnedUpload(self.stream, 4 * (3 * self.segment_count + 2 * _CAPACITY_STEP))
        self._loaded_step: tuple[BodyState, float] | None = None
        """State and step size in seconds of the loaded step."""
        self._prefetch_points: tuple[np.ndarray, np.ndarray] | None = None
        """Arguments of the prefetch in flight: (m,) contact points of the previous step, and (m,) bool, True for points
        that carried load."""
        self.last_solve: SolveEnd | None = None
        """End of the last solve. If the next step continues from it, its contacts are already prefetched."""
        self._prefetch_capacity: int | None = None
        """Contact capacity of the solve that prefetched the contacts; None if ``ContactPrefetch.start`` prefetched
        them."""
        self.predicted_start: Any = None
        """Start of the step for which a plan is in flight; None if the buffers have been used otherwise since."""
        self.gaps_of: StepProblem | None = None
        """Step whose initial gaps ``prefetch`` holds."""

    def zeros(self, *shape: int) -> torch.Tensor:
        """Return a float64 tensor of zeros on the device."""
        return torch.zeros(shape, dtype=torch.float64, device=self.factors.device)

    def tensor(self, values: np.ndarray) -> torch.Tensor:
        """Return ``values`` as a float64 tensor on the device."""
        return torch.as_tensor(np.ascontiguousarray(values, dtype=np.float64), device=self.factors.device)

    def load_start(self, state: BodyState, dt: float) -> None:
        """Load the start of the step of ``dt`` seconds from ``state``, unless it is already loaded."""
        if self._loaded_step is not None and self._loaded_step[0] is state and self._loaded_step[1] == dt:
            return
        self._cancel_prefetch()
        self._loaded_step, self.gaps_of, self.predicted_start = (state, dt), None, None
        self._start_upload.write(state.positions, state.velocities)
        self._graphs.run(dt, lambda: self._enqueue_start(dt))
        self._start_upload.start_copy()

    def _enqueue_start(self, dt: float) -> None:
        self._start_upload.send()
        vectors_at_start = self.positions, self.velocities, self.lever_arms, self.rigid_guess
        positions, velocities, arms, guess = (each.view(1, -1, 3) for each in vectors_at_start)
        modes = self.rotation_modes[None]
        enqueue_step_start(dt, self.masses, (positions, velocities), arms, modes, self.inverse_inertia, guess)
        self.elements.enqueue_start(vectors(self.positions), self.gradients)
        self._enqueue_ballistic(self.positions, self.velocities, dt, self.ballistic)

    def prefetch_contacts(self, state: BodyState, dt: float, before: np.ndarray, loaded: np.ndarray) -> None:
        """Start ``select_contacts``, asynchronously; see ``ContactLinearizer``."""
        with self.stream:
            self._cancel_prefetch()
            self.load_start(state, dt)
            self._prefetch_capacity = (
                self.last_solve.capacity_if_continued(state, dt, before, loaded) if self.last_solve else None
            )
            if self._prefetch_capacity is None:
                self.prefetch.start(*self._ends, before, loaded)
            else:
                self.prefetch.advance()
        self._prefetch_points, self.last_solve = (before, loaded), None

    def select_contacts(self, problem: StepProblem, before: np.ndarray, loaded: np.ndarray) -> ContactSet:
        """Select the contacts of the step ``problem``; see ``ContactLinearizer``."""
        with self.stream:
            self.load_start(problem.state, problem.dt)
        if self._prefetch_points is None or not all(map(np.array_equal, self._prefetch_points, (before, loaded))):
            self.prefetch_contacts(problem.state, problem.dt, before, loaded)
        self.gaps_of, self._prefetch_points = problem, None
        if self._prefetch_capacity is None:
            self.stream.wait()
        return self.prefetch.contacts(len(before) if self._prefetch_capacity is None else self._prefetch_capacity)

    def _cancel_prefetch(self) -> None:
        """Drop a prefetch whose result was not used. Its upload may still be in flight, so the call blocks until it is
        done."""
        if self._prefetch_points is not None:
            self._prefetch_points = None
            self.stream.wait()

    def enqueue_prefetch(self, ends: torch.Tensor, velocities: torch.Tensor, dt: float, *before: torch.Tensor) -> None:
        """Queue the contact selection for the next step.

        Args:
            ends: (3N,) m, positions at the start of the next step.
            velocities: (3N,) m/s, velocities at the start of the next step.
            dt: step size, s.
            before: contact points (K,) int32 of the current step, their number (1,) int32 and their normal forces (K,)
                newtons.
        """
        self._enqueue_ballistic(ends, velocities, dt, self._next_ballistic)
        self.prefetch.enqueue_next((self._ends[0], vectors(ends)), vectors(self._next_ballistic), *before)

    def _enqueue_ballistic(
        self, positions: torch.Tensor, velocities: torch.Tensor, dt: float, ballistic: torch.Tensor
    ) -> None:
        torch.add(velocities, self._gravity, alpha=dt, out=ballistic)
        ballistic.mul_(dt).add_(positions)

    def enqueue_factors(self, ends: wp.array, dt: float) -> None:
        """Factor the system matrix of the step at the end positions ``ends`` (N,), without muscles."""
        entries = self.elements.enqueue_entries(ends, self.gradients, dt, factor=dt**2, projected=False)
        self.factors.enqueue_factor(wp.to_torch(entries)[0])

    def enqueue_stiffness(self, problem: StepProblem, tension: MuscleEnergy, velocities: np.ndarray) -> None:
        """Add the stiffness of the muscles under ``tension``, at the end positions for ``velocities`` (N, 3) m/s, to
        the factored matrix."""
        segments, directions, rates = tension.hessian(problem.end_positions(velocities)).rank_one_terms(
            min_relative_stiffness=MIN_RELATIVE_STIFFNESS
        )
        # Terms of positive stiffness are added, those of negative stiffness subtracted. Padding rows are zero and
        # change nothing.
        terms_by_sign = {sign: np.flatnonzero(sign * rates > 0.0) for sign in _SIGNS}
        packed = [np.zeros((round_up(len(terms), _CAPACITY_STEP), 4)) for terms in terms_by_sign.values()]
        for terms, part in zip(terms_by_sign.values(), packed, strict=True):
            part[: len(terms), 0] = segments[terms]
            part[: len(terms), 1:] = problem.dt * np.sqrt(np.abs(rates[terms]))[:, None] * directions[terms]
        self._directions_upload.set(*packed)
        capacities, signs = tuple(map(len, packed)), tuple(s for s, terms in terms_by_sign.items() if len(terms) > 0)
        self._graphs.run((capacities, signs), lambda: self._enqueue_low_rank_updates(capacities, signs))

    def _enqueue_low_rank_updates(self, capacities: tuple[int, ...], signs: tuple[float, ...]) -> None:
        """Add the uploaded rank-one terms with these ``signs``; ``capacities`` are the row counts for +1 and -1."""
        parts = self._directions_upload.device[: 4 * sum(capacities)].view(-1, 4).split(capacities)
        for sign, part in zip(_SIGNS, parts, strict=True):
            if sign in signs:
                directions = self._rows[part[:, 0].long()][:, :, None] * part[:, None, 1:]
                self.factors.enqueue_low_rank(directions.view(len(part), -1), sign)

    def enqueue_gradient(self, ends: wp.array, dt: float, tensions: wp.array, gradient: wp.array) -> None:
        """Compute the internal ``gradient`` in newtons at the positions ``ends``, under the muscles' ``tensions``."""
        self.elements.enqueue_gradient(ends, self.gradients, dt, self.muscle_segments, gradient, tensions)


def vectors(flat: torch.Tensor) -> wp.array:
    """View a ``flat`` tensor (3N,) as a Warp array of N vectors."""
    return as_warp(flat.view(-1, 3), Vec3)
