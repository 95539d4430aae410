"""``StepProblem`` and its ``Tangent`` for many worlds side by side, on the device (Eq. 4, 6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from egs_warp.fem.batch_elasticity import BatchElasticity
from egs_warp.fem.batch_factors import CHUNK_BYTES, PANEL, BatchCholesky
from egs_warp.fem.batched import BatchedRecord, nonzero
from egs_warp.fem.body import SoftBody
from egs_warp.fem.step_problem import MIN_RELATIVE_STIFFNESS
from egs_warp.muscles.muscle_set import MuscleSet


class BatchBody:
    """What the worlds of one body have in common: its mass, gravity, elasticity, muscles, and room for the factors of
    ``count`` worlds."""

    def __init__(
        self,
        body: SoftBody,
        muscles: MuscleSet,
        count: int,
        *,
        panel: int = PANEL,
        chunk_bytes: int = CHUNK_BYTES,
    ) -> None:
        """``panel``, ``chunk_bytes``: see ``BatchFactors``."""
        self.body = body
        self.device = torch.device(str(body.assembly.device))
        size = 3 * len(body.mesh.nodes)
        self.factors = BatchCholesky(count, size, self.device, panel=panel, chunk_bytes=chunk_bytes)
        self.elasticity = BatchElasticity(body.assembly, muscles, count, matrices=min(count, self.factors.chunk))
        self.mass = torch.as_tensor(body.node_mass, device=self.device)
        self.gravity = torch.as_tensor(np.asarray(body.gravity, dtype=np.float64), device=self.device)

    def centre(self, values: torch.Tensor) -> torch.Tensor:
        """(c, 1, 3) mean by mass of ``values`` (c, N, 3)."""
        return (self.mass[:, None] * values).sum(dim=1, keepdim=True) / self.body.mass


@dataclass(frozen=True)
class BatchProblem(BatchedRecord):
    """A step of ``dt`` s of c worlds; see ``StepProblem``, whose names these are."""

    body: BatchBody
    dt: float
    drag: float
    """1/s."""
    slots: torch.Tensor
    """(c,) where each world's factors lie."""
    positions: torch.Tensor
    """(c, N, 3) metres, at the start."""
    velocities: torch.Tensor
    """(c, N, 3) m/s."""
    start_gradients: torch.Tensor
    """(c, T, 3, 3)."""
    rotation_modes: torch.Tensor
    """(c, 3N, 3)."""
    inverse_inertia: torch.Tensor
    """(c, 3, 3) 1/(kg m^2), the inverse of the inertia; no numbers where there is none, in place of an error for all
    worlds."""

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
        """From ``positions`` (c, N, 3) and ``velocities`` (c, N, 3) on."""
        arms = positions - common.centre(positions)
        turns = arms.new_zeros((*arms.shape, 3))
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            turns[:, :, i, k], turns[:, :, j, k] = -arms[:, :, j], arms[:, :, i]
        turns = turns.flatten(1, 2)
        inertia = (turns * common.mass.repeat_interleave(3)[:, None]).mT @ turns
        gradients = common.elasticity.deformation_gradients(positions)
        rates = torch.linalg.inv_ex(inertia).inverse
        return cls(common, dt, drag, slots, positions, velocities, gradients, turns, rates)

    @property
    def momenta(self) -> torch.Tensor:
        """(c, 3, 3N)."""
        return (self.rotation_modes * self.body.mass.repeat_interleave(3)[:, None]).mT

    @property
    def residual_scale(self) -> float:
        """N s."""
        return self.dt * self.body.body.weight

    @property
    def inertia_ratio(self) -> float:
        """1 + dt alpha."""
        return 1.0 + self.dt * self.drag

    def end_positions(self, velocities: torch.Tensor) -> torch.Tensor:
        """(c, N, 3)."""
        return self.positions + self.dt * velocities

    def is_inversion_free(self, velocities: torch.Tensor) -> torch.Tensor:
        """(c,) bool: whether no element is inverted at the end of ``velocities`` (c, N, 3)."""
        return self.body.elasticity.is_inversion_free(self.end_positions(velocities))

    def rigid_guess(self) -> torch.Tensor:
        """(c, N, 3) m/s to solve the step from: the body goes on rigidly."""
        arms = self.positions - self.body.centre(self.positions)
        spin = (self.inverse_inertia @ (self.momenta @ self.velocities.flatten(1)[:, :, None]))[:, :, 0]
        turned = _turned(self.dt * spin, arms)
        return self.body.centre(self.velocities) + (turned - arms) / self.dt

    def internal_gradient(self, velocities: torch.Tensor, tensions: torch.Tensor | None) -> torch.Tensor:
        """(c, N, 3) newtons; ``tensions`` (c, M) newtons of the muscles."""
        end = self.end_positions(velocities)
        return self.body.elasticity.gradient(end, self.start_gradients, self.dt, tensions)

    def momentum_correction(self, internal_gradient: torch.Tensor) -> torch.Tensor:
        """(c, 3) rad/s that the step gives back."""
        torque = self.rotation_modes.mT @ internal_gradient.flatten(1)[:, :, None]
        return self.dt * (self.inverse_inertia @ torque)[:, :, 0]

    def residual(self, velocities: torch.Tensor, tensions: torch.Tensor | None) -> torch.Tensor:
        """(c, N, 3) N s."""
        internal = self.internal_gradient(velocities, tensions)
        turned = (self.rotation_modes @ self.momentum_correction(internal)[:, :, None]).view_as(velocities)
        change = self.inertia_ratio * velocities - self.velocities - self.dt * self.body.gravity - turned
        return self.body.mass[:, None] * change + self.dt * internal

    def factor(self, velocities: torch.Tensor, tensions: torch.Tensor | None) -> torch.Tensor:
        """Factor the derivative of the residual at ``velocities`` (c, N, 3), or a definite one near it, into the
        worlds' slots; (c,) bool, whether there is one. In the order of ``StepProblem.tangent``."""
        fine = [
            self._factor(slice(part.start, part.stop), velocities, tensions)
            for part in self.body.factors.chunks(len(velocities))
        ]
        return torch.cat(fine)

    def _factor(self, part: slice, velocities: torch.Tensor, tensions: torch.Tensor | None) -> torch.Tensor:
        end = self.end_positions(velocities)[part]
        gradients, slots = self.start_gradients[part], self.slots[part]
        pulls = None if tensions is None else tensions[part]
        fine = torch.zeros(len(end), dtype=torch.bool, device=end.device)
        left = torch.arange(len(end), device=end.device)
        diagonal = self.inertia_ratio * self.body.mass.repeat_interleave(3)
        # With the muscles' stiffness, without it, and with the elements' alone that is surely definite.
        for muscles, projected in ((True, False), (False, False), (False, True)):
            if (muscles and pulls is None) or len(left) == 0:
                continue
            matrices = self.body.elasticity.matrices(end[left], gradients[left], self.dt, diagonal, projected=projected)
            if muscles and pulls is not None:
                self.body.elasticity.add_stiffness(
                    matrices, end[left], pulls[left], self.dt**2, least=MIN_RELATIVE_STIFFNESS
                )
            fine[left] = self.body.factors.factor(slots[left], matrices)
            left = nonzero(~fine)
        return fine


@dataclass(frozen=True)
class BatchMomentumProjection(BatchedRecord):
    """What makes the inverse of the elements' matrix keep angular momentum, see ``Tangent``."""

    turned: torch.Tensor
    """(c, 3N, 3)."""
    inverse: torch.Tensor
    """(c, 3, 3)."""


def apply_inverse(
    problem: BatchProblem, impulses: torch.Tensor, turning: BatchMomentumProjection | None = None
) -> tuple[torch.Tensor, BatchMomentumProjection]:
    """(c, 3N, m) m/s that ``impulses`` of that shape, N s, bring about by the factors in the worlds' slots, and the
    ``turning`` of these, if it is not known."""
    factors, momenta = problem.body.factors, problem.momenta
    if turning is None:
        both = factors.solve(problem.slots, torch.cat([momenta.mT, impulses], dim=2))
        turned, plain = both[:, :, :3].contiguous(), both[:, :, 3:]
        turning = BatchMomentumProjection(
            turned, torch.linalg.inv_ex(problem.inertia_ratio * (momenta @ turned)).inverse
        )
    else:
        plain = factors.solve(problem.slots, impulses)
    missing = problem.rotation_modes.mT @ impulses - problem.inertia_ratio * (momenta @ plain)
    return plain + turning.turned @ (turning.inverse @ missing), turning


def _turned(vectors: torch.Tensor, arms: torch.Tensor) -> torch.Tensor:
    """(c, n, 3) ``arms`` turned by the rotation vectors ``vectors`` (c, 3)."""
    half = 0.5 * vectors.norm(dim=1, keepdim=True)
    axis = (0.5 * torch.sinc(half / torch.pi) * vectors)[:, None].expand_as(arms)
    once = torch.linalg.cross(axis, arms)
    return arms + 2.0 * (half.cos()[:, :, None] * once + torch.linalg.cross(axis, once))
