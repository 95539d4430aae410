"""Implicit Euler steps of one body in many worlds, on tensors with a world axis, and their tangents (Eq. 4, 6)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.fem.batched import as_warp, launch_on, nonzero
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.fem.implicit_step import MIN_RELATIVE_STIFFNESS, ImplicitStep
from egs_warp.fem.linear_solver import FactorStatus
from egs_warp.fem.momentum_projection import MomentumProjection
from egs_warp.fem.panel_cholesky import CHUNK_BYTES, PANEL, PanelCholesky
from egs_warp.fem.warp_elasticity import MuscleSegmentMaps, WarpElasticity
from egs_warp.kernels.fem import step_start as kernels
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import segment_stiffnesses
from egs_warp.precision import Mat33, Vec3, real

_MIN_LENGTH = 1e-300
"""Lower bound of segment lengths, m. A segment whose ends coincide gets the direction 0."""


class BatchBody:
    """Data shared by all worlds of one body: mass, gravity, elasticity, muscles and storage for the factors."""

    def __init__(
        self, body: SoftBody, muscles: MuscleSet, count: int, *, panel: int = PANEL, chunk_bytes: int = CHUNK_BYTES
    ) -> None:
        """Build the shared data.

        Args:
            body: the body, on the device of the batch.
            muscles: its muscles.
            count: maximum number of worlds.
            panel: as in ``PanelCholesky``.
            chunk_bytes: as in ``PanelCholesky``.
        """
        self.body, assembly = body, body.assembly
        self.device = torch.device(str(assembly.device))
        self.factors = PanelCholesky(assembly.upper_pattern, count, self.device, panel=panel, chunk_bytes=chunk_bytes)
        matrices = min(count, self.factors.chunk)
        self.elements = WarpElasticity(
            assembly.maps, assembly.material, assembly.device, worlds=count, matrices=matrices
        )
        self.segments = MuscleSegmentMaps(muscles.difference_rows, muscles.rest_lengths, assembly.device, worlds=count)
        self.mass = torch.as_tensor(body.node_mass, device=self.device)
        self.gravity, self.difference_rows, self._rest_lengths = (
            torch.as_tensor(np.asarray(values, dtype=np.float64), device=self.device)
            for values in (body.gravity, muscles.difference_rows.toarray(), muscles.rest_lengths)
        )

    def centre(self, values: torch.Tensor) -> torch.Tensor:
        """Return the mass-weighted mean (c, 1, 3) of nodal ``values`` (c, N, 3)."""
        return (self.mass[:, None] * values).sum(dim=1, keepdim=True) / self.body.mass

    def add_muscle_stiffness(
        self, matrices: torch.Tensor, positions: torch.Tensor, tensions: torch.Tensor, factor: float
    ) -> None:
        """Add ``factor`` times the Hessian of the muscle energy to ``matrices``.

        Stiffnesses of at most ``MIN_RELATIVE_STIFFNESS`` times the largest stiffness of the same world are dropped, as
        in ``TensionHessian.rank_one_terms``.

        Args:
            matrices: (c, 3N, 3N) kg, modified in place.
            positions: (c, N, 3) m.
            tensions: (c, M) N, muscle tensions.
            factor: s^2, multiplies the Hessian.
        """
        rows, rest_lengths = self.difference_rows, self._rest_lengths
        vectors = rows @ positions
        lengths = vectors.norm(dim=2).clamp(min=_MIN_LENGTH)
        directions = vectors / lengths[:, :, None]
        across, stretch = segment_stiffnesses(tensions, lengths, rest_lengths)
        largest = torch.maximum(across.abs(), stretch.abs()).amax(dim=1, keepdim=True).clamp(min=_MIN_LENGTH)
        across, stretch = (
            torch.where(rate.abs() > MIN_RELATIVE_STIFFNESS * largest, rate, 0.0) for rate in (across, stretch)
        )
        blocks = matrices.view(len(matrices), len(self.mass), 3, len(self.mass), 3)
        for i in range(3):
            for k in range(i + 1):
                rates = (stretch - across) * directions[:, :, i] * directions[:, :, k] + (across if i == k else 0.0)
                part = rows.T @ (factor * rates[:, :, None] * rows)
                blocks[:, :, i, :, k] += part
                if i != k:
                    blocks[:, :, k, :, i] += part


@dataclass(frozen=True, kw_only=True)
class BatchProblem(ImplicitStep[torch.Tensor]):
    """Implicit steps of c worlds, with tensors on the device of the body."""

    worlds: BatchBody
    """Data that the worlds share."""
    slots: torch.Tensor
    """(c,) slot of each world's factors, ascending."""
    start_gradients: torch.Tensor
    """(c, T, 3, 3) deformation gradients at the start of the step."""
    lever_arms: torch.Tensor
    """(c, N, 3) m, positions relative to the centre of mass."""
    rotation_modes: torch.Tensor
    """(c, 3N, 3) m, nodal velocities e_k x r of unit rotations about the centre of mass."""
    inverse_inertia: torch.Tensor
    """(c, 3, 3) 1/(kg m^2), inverse inertia."""
    rigid_guess: torch.Tensor
    """(c, N, 3) m/s, rigid motion with the momenta of the state, the initial guess of the solver."""

    @classmethod
    def at(
        cls,
        common: BatchBody,
        slots: torch.Tensor,
        positions: torch.Tensor,
        velocities: torch.Tensor,
        *,
        dt: float,
        drag: float = 0.0,
    ) -> BatchProblem:
        """Build the step that starts at the given state.

        Args:
            common: shared data of the body.
            slots: (c,) slots for the factors, ascending.
            positions: (c, N, 3) m.
            velocities: (c, N, 3) m/s.
            dt: step size, s.
            drag: alpha of the Rayleigh damping, 1/s.
        """
        modes = positions.new_empty(len(positions), 3 * len(common.mass), 3)
        inverse_inertia = positions.new_empty(len(positions), 3, 3)
        arms, guess = torch.empty_like(positions), torch.empty_like(positions)
        enqueue_step_start(dt, common.mass, (positions, velocities), arms, modes, inverse_inertia, guess)
        gradients = positions.new_empty(len(positions), len(common.body.mesh.tets), 3, 3)
        common.elements.enqueue_start(as_warp(positions, Vec3), as_warp(gradients, Mat33))
        state: Any = positions, velocities
        return cls(
            *(common.body, BodyState(*state), dt, drag),
            worlds=common,
            slots=slots,
            start_gradients=gradients,
            lever_arms=arms,
            rotation_modes=modes,
            inverse_inertia=inverse_inertia,
            rigid_guess=guess,
        )

    @property
    def node_mass(self) -> torch.Tensor:
        """(N,) kg, lumped masses."""
        return self.worlds.mass

    @property
    def gravity(self) -> torch.Tensor:
        """(3,) m/s^2, gravitational acceleration."""
        return self.worlds.gravity

    def is_inversion_free(self, velocities: torch.Tensor) -> torch.Tensor:
        """Return (c,) bool, True for worlds in which no element is inverted at the end positions for ``velocities``."""
        _, determinants = self.worlds.elements.enqueue_energies(
            as_warp(self.end_positions(velocities), Vec3), None, 0.0
        )
        return wp.to_torch(determinants)[: len(velocities)].amin(dim=1) > 0.0

    def internal_gradient(self, velocities: torch.Tensor, tension: torch.Tensor | None) -> torch.Tensor:
        """Return minus the internal forces (c, N, 3) N at the end of the step, with muscle tensions (c, M) N."""
        gradient = torch.empty_like(velocities)
        self.enqueue_gradient(self.end_positions(velocities), tension, gradient)
        return gradient

    def enqueue_gradient(self, ends: torch.Tensor, tension: torch.Tensor | None, gradient: torch.Tensor) -> None:
        """Write minus the internal forces at the end positions ``ends`` (c, N, 3) m to ``gradient`` (c, N, 3) N, with
        muscle tensions (c, M) N."""
        worlds = self.worlds
        segments, loads = (None, None) if tension is None else (worlds.segments, as_warp(tension, real))
        arrays = as_warp(ends, Vec3), as_warp(self.start_gradients, Mat33), as_warp(gradient, Vec3)
        worlds.elements.enqueue_gradient(*arrays[:2], self.dt, segments, arrays[2], loads)

    def factor(self, velocities: torch.Tensor, tensions: torch.Tensor | None) -> torch.Tensor:
        """Factor the derivative of the residual, or a positive definite approximation of it, into the worlds' slots.

        The fallback matrices are the same as in ``StepProblem.tangent``.

        Args:
            velocities: (c, N, 3) m/s, linearisation point.
            tensions: (c, M) N, muscle tensions, or None.

        Returns:
            (c,) bool, True where a factor exists.
        """
        factored = [
            self._factor(slice(part.start, part.stop), velocities, tensions)
            for part in self.worlds.factors.chunks(len(velocities))
        ]
        return torch.cat(factored)

    def _factor(self, part: slice, velocities: torch.Tensor, tensions: torch.Tensor | None) -> torch.Tensor:
        end = self.end_positions(velocities)[part]
        gradients, slots = self.start_gradients[part], self.slots[part]
        part_tensions = None if tensions is None else tensions[part]
        factored = torch.zeros(len(end), dtype=torch.bool, device=end.device)
        remaining = torch.arange(len(end), device=end.device)
        diagonal = self.inertia_ratio * self.coordinate_mass
        # Try the matrix with the muscles' stiffness, then without it, then with the projected Hessian, which is
        # positive definite.
        for muscles, projected in ((True, False), (False, False), (False, True)):
            if (muscles and part_tensions is None) or len(remaining) == 0:
                continue
            entries = self.worlds.elements.enqueue_entries(
                as_warp(end[remaining], Vec3),
                as_warp(gradients[remaining], Mat33),
                self.dt,
                factor=self.dt**2,
                projected=projected,
            )
            stiffness = None
            if muscles and part_tensions is not None:
                stiffness = partial(
                    self.worlds.add_muscle_stiffness,
                    positions=end[remaining],
                    tensions=part_tensions[remaining],
                    factor=self.dt**2,
                )
            factors = self.worlds.factors
            factors.factor(wp.to_torch(entries)[: len(remaining)], diagonal, slots[remaining], stiffness)
            factored[remaining] = factors.status[slots[remaining]] == FactorStatus.DEFINITE
            remaining = nonzero(~factored)
        return factored


def enqueue_step_start(
    dt: float,
    mass: torch.Tensor,
    state: tuple[torch.Tensor, torch.Tensor],
    arms: torch.Tensor,
    modes: torch.Tensor,
    inverse_inertia: torch.Tensor,
    guess: torch.Tensor,
) -> None:
    """Compute the values at the start of a step that ``BatchProblem`` holds, asynchronously.

    Args:
        dt: step size, s.
        mass: (N,) kg, lumped masses.
        state: positions (c, N, 3) m and velocities (c, N, 3) m/s.
        arms: (c, N, 3), output: lever arms.
        modes: (c, 3N, 3), output: rotation modes.
        inverse_inertia: (c, 3, 3), output.
        guess: (c, N, 3), output: rigid guess.
    """
    lanes = kernels.BLOCK if arms.is_cuda else 1
    launch_on(
        arms,
        kernels.step_start_kernel,
        (len(arms), lanes),
        inputs=[dt, (mass, real), *((each, Vec3) for each in state)],
        outputs=[(arms, Vec3), (modes, real), (inverse_inertia, Mat33), (guess, Vec3)],
        block_dim=lanes,
    )


def apply_inverse(
    problem: BatchProblem, impulses: torch.Tensor, projection: MomentumProjection[torch.Tensor] | None = None
) -> tuple[torch.Tensor, MomentumProjection[torch.Tensor]]:
    """Return the velocity changes J^-1 ``impulses`` and the momentum projection that was used.

    Args:
        problem: the steps, whose slots hold factors.
        impulses: (c, 3N, m) N s.
        projection: momentum projection of these factors; computed if None.

    Returns:
        (c, 3N, m) m/s, and the momentum projection.
    """
    factors = problem.worlds.factors
    if projection is not None:
        return factors.solve(impulses, problem.slots, projection), projection
    momenta = problem.momenta.mT.contiguous()
    both = factors.solve(torch.cat([momenta, impulses], dim=2), problem.slots)
    projection = problem.momentum_projection(momenta, both[:, :, :3].contiguous())
    return projection.corrected(impulses, both[:, :, 3:]), projection
