"""Trials of Newton's method on tensors, in one world on a GPU or in many: a point on a Newton step and its residual
(Eq. 4, 8).

``enqueue_trial`` evaluates the trials with the kernels in ``kernels/contact/iterate.py``. On the host,
``newton.HostNewtonIterate`` evaluates the trials of one world.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from egs_warp.contact.contact_set import ContactSet
from egs_warp.fem.batched import BatchedRecord, launch_on
from egs_warp.kernels.contact import iterate as kernels
from egs_warp.precision import Mat33, Vec3, real


@dataclass(frozen=True)
class TrialStep:
    """Data of the steps of c worlds with N nodes (see ``ImplicitStep``)."""

    dt: float
    """Step size, s."""
    inertia_ratio: float
    """1 + dt drag."""
    gravity: Vec3
    """m/s^2, gravitational acceleration."""
    node_mass: torch.Tensor
    """(N,) kg, lumped masses."""
    positions: torch.Tensor
    """(c, N, 3) m, at the start of the step."""
    velocities: torch.Tensor
    """(c, N, 3) m/s, at the start of the step."""
    lever_arms: torch.Tensor
    """(c, N, 3) m, positions relative to the centre of mass at the start of the step."""
    inverse_inertia: torch.Tensor
    """(c, 3, 3) 1/(kg m^2), inverse of the inertia tensor."""
    enqueue_internal: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], None]
    """Function of end positions (c, N, 3) that writes the internal gradient (c, N, 3) N and its torque (c, 3) N m."""


@dataclass(frozen=True)
class NewtonDirection(BatchedRecord):
    """Start and end of the full Newton step of c worlds with up to K contacts."""

    velocities: torch.Tensor
    """(c, N, 3) m/s, at the start."""
    free_velocities: torch.Tensor
    """(c, N, 3) m/s, at the end without contact forces."""
    force_velocities: torch.Tensor
    """(c, N, 3) m/s, difference that the contact forces make at the end."""
    forces: torch.Tensor
    """(c, K, 3) newtons, contact forces at the start."""
    target_forces: torch.Tensor
    """(c, K, 3) newtons, contact forces at the end."""


@dataclass(frozen=True)
class Trial(BatchedRecord):
    """Result of a trial of c worlds."""

    velocities: torch.Tensor
    """(c, N, 3) m/s, at the end of the step."""
    forces: torch.Tensor
    """(c, K, 3) newtons, contact forces."""
    end_positions: torch.Tensor
    """(c, N, 3) m, at the end of the step."""
    gradient: torch.Tensor
    """(c, N, 3) newtons, internal gradient."""
    torque: torch.Tensor
    """(c, 3) N m, torque of ``gradient`` about the centre of mass."""
    free_residual: torch.Tensor
    """(c, N, 3) N s, residual without contact forces."""
    residual: torch.Tensor
    """(c, N, 3) N s, residual with contact forces."""

    @classmethod
    def empty(cls, velocities: torch.Tensor, forces: torch.Tensor) -> Trial:
        """Allocate a trial whose velocities and forces have the shapes of ``velocities`` and ``forces``."""
        nodal = [torch.empty_like(velocities) for _ in range(5)]
        torque = velocities.new_empty((len(velocities), 3))
        return cls(nodal[0], torch.empty_like(forces), nodal[1], nodal[2], torque, nodal[3], nodal[4])


def enqueue_trial(
    step: TrialStep, contacts: ContactSet, lengths: torch.Tensor, direction: NewtonDirection, trial: Trial
) -> None:
    """Evaluate the trial at the fractions ``lengths`` (c,) of the Newton steps of c worlds, without allocations.

    At length 0, only velocities and forces at the start of the step are read.
    """
    launch = partial(launch_on, lengths)
    velocities, ends = (trial.velocities, Vec3), (trial.end_positions, Vec3)
    worlds, nodes, _ = trial.velocities.shape
    start = direction.velocities, direction.free_velocities, direction.force_velocities
    launch(
        kernels.trial_kernel,
        (worlds, nodes),
        inputs=[(step.positions, Vec3), step.dt, (lengths, real), *((each, Vec3) for each in start)],
        outputs=[velocities, ends],
    )
    launch(
        kernels.trial_forces_kernel,
        (worlds, contacts.capacity),
        inputs=[(lengths, real), (direction.forces, Vec3), (direction.target_forces, Vec3)],
        outputs=[(trial.forces, Vec3)],
    )
    step.enqueue_internal(trial.end_positions, trial.gradient, trial.torque)
    launch(
        kernels.residual_kernel,
        (worlds, nodes),
        inputs=[
            *((step.node_mass, real), step.gravity, step.inertia_ratio, step.dt, (step.lever_arms, Vec3)),
            *((step.inverse_inertia, Mat33), (step.velocities, Vec3), *contacts.arrays),
            *((each, Vec3) for each in (trial.torque, trial.gradient, trial.velocities, trial.forces)),
        ],
        outputs=[(trial.free_residual, Vec3), (trial.residual, Vec3)],
    )
