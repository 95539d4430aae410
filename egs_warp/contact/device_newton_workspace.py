"""Buffers and CUDA graphs of a step with contact on a GPU. A round of Newton steps is one loop on the device.

Trials are evaluated by ``contact/trial.py``; the kernels in ``kernels/contact/newton_convergence.py`` control the loop.
One vector holds an iterate (see ``NewtonWorkspace.parts``). The workspace has two of them, base and trial, and a start
buffer that the host fills.

A Newton loop consists of three graphs. ``_enqueue_loop_start`` copies the row of ``NewtonProgress`` and sets the loop
condition. ``_enqueue_next_step`` is the loop body: it solves Coulomb's law at the contact-free velocities of the last
trial, makes that trial the base, takes the full Newton step to a new trial, evaluates the residual, the contact-free
velocities and the penetration test there, and judges the trial. ``_enqueue_end`` prefetches the contacts of the next
step and starts the download.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.coulomb import FAILURE_TOLERANCE
from egs_warp.contact.device_coulomb import CoulombWorkspace
from egs_warp.contact.device_step import StepWorkspace, vectors
from egs_warp.contact.newton_convergence import NewtonProgress
from egs_warp.contact.trial import NewtonDirection, Trial, TrialStep, enqueue_trial
from egs_warp.contact.trial_readback import ReadbackBuffers, TrialReadback
from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphCache, PinnedUpload
from egs_warp.fem.step_problem import StepProblem
from egs_warp.kernels.contact import iterate as kernels
from egs_warp.kernels.contact import newton_convergence as convergence_kernels
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import Vec3, real

FROM_BASE, FROM_TRIAL, FROM_START = 0.0, 1.0, 2.0
"""Slot that a trial starts from: the unchanged base, the last trial, or the start buffer."""
_FULL_STEP = (1.0, 1.0, FROM_TRIAL)
"""Packed input of a full Newton step from the last trial: step length, 1 if contact forces act (else 0), slot."""


class NewtonWorkspace:
    """Buffers and graphs of the Newton loop for up to K = ``capacity`` contacts."""

    def __init__(self, owner: StepWorkspace, capacity: int) -> None:
        self.owner, self.capacity, self._device = owner, capacity, owner.body.assembly.device
        self._node_count = len(owner.body.mesh.nodes)
        size, width = 3 * self._node_count, 3 * capacity
        self._contact_upload = PinnedUpload(owner.stream, 1 + 18 * capacity)
        count, self._packed_indices, weights, axes = self._contact_upload.device.split(
            [1, 5 * capacity, 4 * capacity, 9 * capacity]
        )
        self._indices = torch.zeros(5 * capacity, dtype=torch.int32, device=count.device)
        self._points, nodes = self._indices.split([capacity, 4 * capacity])
        self._contacts = ContactSet(
            *(self._points[None], nodes.view(1, -1, 4), weights.view(1, -1, 4), axes.view(1, -1, 3, 3), None, None),
            *(self._node_count, torch.full((1,), capacity, dtype=torch.int32, device=count.device)),
        )
        """Uploaded contacts of one world. Padding entries have zero weights and are included in ``counts``."""
        self.columns = owner.zeros(size, width)
        self._right, self.delassus = owner.zeros(size, 3 + width), owner.zeros(width, width)
        self._host_delassus = owner.stream.pinned(width * width)
        # The input and the read-back of a trial are one transfer each.
        self._trial_upload = PinnedUpload(owner.stream, 3 + width)
        self.trial_input, self.target_forces = self._trial_upload.device.split([3, width])
        """(3,) length of the step, 1 if contact forces act (else 0), slot to start from. ``target_forces`` (3K,)
        newtons."""
        self._readback = ReadbackBuffers(owner.stream, capacity, self._node_count)
        self.readback, on_device = self._readback.on_host, self._readback.on_device
        self.residual_norm, self.velocities = on_device.residual_norm, on_device.velocities
        self.free_contact_velocities = on_device.free_contact_velocities
        self.coulomb_violation = on_device.coulomb_violation
        self._penetrating_count, self._min_gap, self._internal_torque = on_device.penetration.split([1, 1, 3])
        # State of the Newton loop: row of progress, loop condition, and event at the end of the loop.
        self._progress_upload = PinnedUpload(owner.stream, convergence_kernels.ROW_SIZE)
        self._loop_condition, self._always_enabled = (
            torch.full((1,), each, dtype=torch.int32, device=count.device) for each in (0, 1)
        )
        self._full_step, self._newton_event = owner.tensor(np.array(_FULL_STEP)), None
        self.coulomb = CoulombWorkspace(owner.stream, capacity, count)
        self._start_upload = PinnedUpload(owner.stream, 3 * size + width + owner.segment_count)
        self.start_buffer, self.tensions = self._start_upload.device.split([3 * size + width, owner.segment_count])
        """Iterate that a trial can start from, in the layout of ``parts``. ``tensions`` are the tensions of the muscle
        segments in newtons."""
        self._tensions = as_warp(self.tensions, real)
        self._base, self._trial = owner.zeros(3 * size + width), owner.zeros(3 * size + width)
        self.end_positions, self._gradient, self._residual, self._force_velocities = owner.zeros(4, size)
        self._torque = owner.zeros(3)
        velocities, free_velocities, _, forces = self.parts(self._base)
        self._direction = NewtonDirection(
            *map(_one_world, (velocities, free_velocities, self._force_velocities, forces, self.target_forces))
        )
        velocities, _, free_residual, forces = self.parts(self._trial)
        self._trial_record = Trial(
            *(_one_world(velocities), _one_world(forces), _one_world(self.end_positions), _one_world(self._gradient)),
            *(self._torque[None], _one_world(free_residual), _one_world(self._residual)),
        )
        self._graphs = GraphCache(owner.stream)
        self.set_iterates()
        """``base_iterate`` and ``trial_iterate`` are the host objects of the iterates in the slots, None for an empty
        slot; ``pending_iterate`` is the start of a queued Newton loop whose result has not been read."""
        self.started = np.zeros(0)
        """(ROW_SIZE,) row of progress with which the last loop was started."""

    def set_iterates(self, *, base: Any = None, trial: Any = None, pending: Any = None) -> None:
        """Set the iterates in the slots and the iterate at the start of the queued loop; None clears one."""
        self.base_iterate, self.trial_iterate, self.pending_iterate = base, trial, pending

    def trial_parts(self) -> tuple[torch.Tensor, ...]:
        """Return the last trial, split as in ``parts``."""
        return self.parts(self._trial)

    def contact_velocities(self, velocities: torch.Tensor) -> torch.Tensor:
        """Return W v, (3K, j) m/s, for nodal ``velocities`` v (3N, j)."""
        return self._contacts.contact_velocities(velocities[None])[0]

    def linearize(self, problem: StepProblem, contacts: ContactSet) -> None:
        """Linearise ``contacts`` with the current factors, asynchronously."""
        self.set_contacts(contacts)
        self._run(self.enqueue_linearization, problem.dt, problem.inertia_ratio)

    def download_delassus(self) -> np.ndarray:
        """Return the Delassus operator, (3K, 3K) m/(N s), that ``linearize`` has downloaded. The caller must
        synchronise first."""
        return self._host_delassus.numpy().reshape(3 * self.capacity, -1).copy()

    def set_contacts(self, contacts: ContactSet) -> None:
        """Upload ``contacts``."""
        packed = np.zeros((18, self.capacity))
        targets = np.split(packed.ravel(), np.cumsum([1, 4, 4]) * self.capacity)
        arrays = contacts.points, contacts.nodes, contacts.weights, contacts.axes
        for target, values in zip(targets, arrays, strict=True):
            target[: values.size] = values.ravel()
        self._contact_upload.set(np.array([contacts.count]), packed)

    def _run(self, work: Callable[..., None], *args: Any) -> None:
        self._graphs.run((work.__name__, *args), lambda: work(*args))

    def enqueue_linearization(self, dt: float, ratio: float) -> None:
        """Compute the columns, the Delassus operator and the momentum projection. ``ratio`` is 1 + dt drag."""
        owner, factors = self.owner, self.owner.factors
        self._indices.copy_(self._packed_indices)
        momenta, impulses = self._right[:, :3], self._right[:, 3:]
        torch.mul(owner.rotation_modes, owner.masses.repeat_interleave(3)[:, None], out=momenta)
        impulses.zero_()
        self._contacts.jacobian_transposed(out=impulses[None])
        impulses.mul_(dt)
        solved = factors.enqueue_solve(self._right)
        factors.enqueue_momentum_projection(owner.rotation_modes, momenta, solved[:, :3], ratio)
        torch.addmm(solved[:, 3:], factors.rotation_response, factors.rotation_operator @ impulses, out=self.columns)
        self._contacts.contact_velocities(self.columns[None], out=self.delassus[None])
        self.coulomb.enqueue_operator(self.delassus)
        self._host_delassus.copy_(self.delassus.view(-1), non_blocking=True)

    def _launch(self, kernel: Any, dim: int | tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self._device)

    def parts(self, state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Split an iterate into velocities (3N,), velocities after a Newton step without contact forces (3N,),
        residual without contact forces (3N,) and forces (3K,)."""
        size = 3 * self._node_count
        return state.split([size, size, size, 3 * self.capacity])

    def start_trial(
        self, problem: StepProblem, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray
    ) -> None:
        """Start a trial asynchronously, at ``velocities`` (N, 3) m/s and ``forces`` (n, 3) N, under ``tension``."""
        with self.owner.stream:
            self.upload_start(tension, velocities, forces)
            self._upload_trial(0.0, False, forces, FROM_START)
            self._run(self._enqueue_trial, problem.dt, problem.inertia_ratio)
            self._trial_upload.start_copy()

    def upload_start(self, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray) -> None:
        """Upload the start buffer and the muscle tensions."""
        padding = np.zeros(3 * self.capacity - forces.size)
        tensions = [] if tension is None else [tension.tensions]
        self._start_upload.set(velocities, velocities, np.zeros(velocities.size), forces, padding, *tensions)

    def run_trial(
        self, problem: StepProblem, *, length: float, target_forces: np.ndarray, base: float
    ) -> TrialReadback[np.ndarray]:
        """Evaluate a trial and block until it is evaluated.

        Args:
            problem: the step.
            length: fraction of the Newton step.
            target_forces: (n, 3) newtons, contact forces of the full Newton step.
            base: slot to start from, ``FROM_BASE``, ``FROM_TRIAL`` or ``FROM_START``.
        """
        self._upload_trial(length, True, target_forces, base)
        return self._run_and_download(self._enqueue_trial, problem.dt, problem.inertia_ratio)

    def start_newton(
        self,
        problem: StepProblem,
        normal_bias: np.ndarray,
        friction: float,
        progress: NewtonProgress,
        *,
        base: float,
        enabled: torch.Tensor | None = None,
    ) -> None:
        """Start the Newton loop on the device, asynchronously; ``wait_newton`` blocks for its result.

        Each step uses the Coulomb forces at its own start. The loop ends at the first step that needs the host.

        Args:
            problem: the step.
            normal_bias: (n,) m/s.
            friction: Coulomb coefficient.
            progress: progress of the round.
            base: slot to start from, ``FROM_BASE`` or ``FROM_TRIAL``.
            enabled: (1,) int32 on the device; 0 skips the loop. None always runs it.
        """
        dt, ratio = problem.dt, problem.inertia_ratio
        self.started, self.owner.last_solve = progress.row.copy(), None
        row = progress.row.copy()
        row[convergence_kernels.UNIT] = problem.residual_scale
        with self.owner.stream:
            self.coulomb.upload(normal_bias, friction)
            self._progress_upload.set(row)
            work = partial(self._enqueue_loop_start, base, self._always_enabled if enabled is None else enabled)
            self._graphs.run(("loop start", base, enabled is None), work)
            self._graphs.repeat((dt, ratio), lambda: self._enqueue_next_step(dt, ratio), self._loop_condition)
            self._run(self._enqueue_end, dt)
            self._newton_event = self.owner.stream.record_event(self._newton_event)

    def wait_newton(self) -> TrialReadback[np.ndarray]:
        """Block for the result of ``start_newton``."""
        if self._newton_event is not None:
            self._newton_event.synchronize()
        return self.readback

    def _enqueue_loop_start(self, base: float, enabled: torch.Tensor) -> None:
        if base == FROM_BASE:
            self._trial.copy_(self._base)
        self._readback.on_device.progress.copy_(self._progress_upload.device)
        inputs = [as_warp(enabled, wp.int32), as_warp(self.residual_norm, real)]
        self._launch(convergence_kernels.begin_loop_kernel, 1, inputs, self._loop_state())
        self.trial_input.copy_(self._full_step)

    def _loop_state(self) -> list[wp.array]:
        """Return the row of progress and the loop condition, which both kernels of the loop write."""
        return [as_warp(self._readback.on_device.progress[None], real), as_warp(self._loop_condition, wp.int32)]

    def _enqueue_next_step(self, dt: float, ratio: float) -> None:
        """Enqueue a Newton step from the last trial and an update of the loop condition."""
        self.target_forces.copy_(self.trial_parts()[3])
        self._readback.on_device.previous_contact_velocities.copy_(self.free_contact_velocities)
        self.enqueue_newton(dt, ratio)
        self._enqueue_penetration()
        judged = self.residual_norm, self.coulomb_violation, self._penetrating_count
        inputs = [FAILURE_TOLERANCE, *(as_warp(each, real) for each in judged)]
        self._launch(convergence_kernels.judge_steps_kernel, 1, inputs, self._loop_state())

    def _enqueue_end(self, dt: float) -> None:
        """Prefetch the contacts of the step that would start at the last trial, and start the download of the
        read-back."""
        velocities, _, _, forces = self.parts(self._base)
        on_device = self._readback.on_device
        on_device.velocities_before.copy_(velocities)
        on_device.forces_before.copy_(forces)
        self._download_rest()
        before = self._points, self.coulomb.counts, on_device.forces[::3]
        self.owner.enqueue_prefetch(self.end_positions, self.velocities, dt, *before)
        self._readback.start_download()

    def _enqueue_penetration(self) -> None:
        """Count the points that penetrate too far at the end of the last trial."""
        self.owner.prefetch.enqueue_penetration(
            vectors(self.end_positions), self._points, self.coulomb.counts, self._penetrating_count
        )

    def _download_rest(self) -> None:
        """Add the minimum gap and the internal torque to the penetration test."""
        self.owner.prefetch.enqueue_min_gap(self._min_gap[0])
        self._internal_torque.copy_(self._torque)

    def enqueue_newton(self, dt: float, ratio: float) -> None:
        """Solve Coulomb's law, starting from ``target_forces``, and evaluate the trial that ``trial_input`` describes
        with the solution."""
        self.coulomb.enqueue_forces(self.free_contact_velocities, self.target_forces, self.coulomb_violation)
        self._readback.on_device.forces.copy_(self.target_forces)
        self.enqueue_trial(dt, ratio)

    def _upload_trial(self, length: float, use_forces: bool, target_forces: np.ndarray, base: float) -> None:
        self._trial_upload.write(np.array([length, float(use_forces), base]), target_forces)

    def _set_base(self, base: float) -> None:
        self._trial_upload.wait()
        self._trial_upload.host[2] = base

    def reevaluate(self, *, base: float) -> None:
        """Recompute ``free_contact_velocities`` of the iterate in the slot ``base`` with the current linearisation,
        asynchronously. The other values in the read-back still belong to the last trial."""
        with self.owner.stream:
            self._set_base(base)
            self._run(self._enqueue_reevaluate)
            self._trial_upload.start_copy()

    def refactor(
        self, problem: StepProblem, tension: MuscleEnergy | None, velocities: np.ndarray, *, base: float
    ) -> None:
        """Queue a new tangent, with its factors and linearisation, asynchronously.

        The result is valid only if ``factors.status`` is ``DEFINITE`` after synchronisation.

        Args:
            problem: the step.
            tension: muscle energy whose stiffness is added, or None.
            velocities: (N, 3) m/s, velocities of the iterate in ``base``.
            base: slot of the iterate at which the tangent is computed.
        """
        owner, ratio = self.owner, problem.inertia_ratio
        with owner.stream:
            self._set_base(base)
            owner.factors.upload_diagonal(ratio * np.repeat(owner.body.node_mass, 3))
            self._run(self._enqueue_factors, problem.dt)
            self._trial_upload.start_copy()
            if tension is not None:
                owner.enqueue_stiffness(problem, tension, velocities)
            self._run(self._enqueue_refactor, problem.dt, ratio)
        owner.factors.mark_started()

    def _enqueue_factors(self, dt: float) -> None:
        owner = self.owner
        self._trial_upload.send()
        self._enqueue_base()
        torch.add(owner.positions, self.parts(self._base)[0], alpha=dt, out=self.end_positions)
        owner.enqueue_factors(vectors(self.end_positions), dt)

    def _enqueue_refactor(self, dt: float, ratio: float) -> None:
        self.enqueue_linearization(dt, ratio)
        self._enqueue_newton(self._base)
        self._readback.start_download()

    def _run_and_download(self, work: Callable[..., None], *args: float) -> TrialReadback[np.ndarray]:
        with self.owner.stream:
            self._run(work, *args)
            self.owner.stream.wait()
        return self.readback

    def _enqueue_base(self) -> None:
        self._launch(
            kernels.select_base_kernel,
            len(self._base),
            [as_warp(self.trial_input[2:], real), as_warp(self._trial, real), as_warp(self.start_buffer, real)],
            [as_warp(self._base, real)],
        )

    def _enqueue_reevaluate(self) -> None:
        self._trial_upload.send()
        self._enqueue_base()
        self._enqueue_newton(self._base)
        self._readback.start_download()

    def _enqueue_newton(self, state: torch.Tensor) -> None:
        """Compute the nodal velocities after a Newton step without contact forces from ``state``, and the contact
        velocities after this step."""
        velocities, free_velocities, residual, _ = self.parts(state)
        self._enqueue_free_velocities(velocities, residual, free_velocities)
        self._contacts.contact_velocities(free_velocities[None], out=self.free_contact_velocities[None])

    def _enqueue_free_velocities(self, velocities: torch.Tensor, residual: torch.Tensor, end: torch.Tensor) -> None:
        """Compute the velocities after a Newton step.

        Args:
            velocities: (3N,) m/s, initial velocities.
            residual: (3N,) N s.
            end: (3N,) m/s, overwritten with the result.
        """
        factors = self.owner.factors
        solved, rotation = factors.enqueue_vector_solve(residual)
        self._launch(
            kernels.free_velocity_kernel,
            self._node_count,
            [as_warp(factors.rotation_response, real), vectors(velocities), vectors(solved), as_warp(rotation, real)],
            [vectors(end)],
        )

    def enqueue_prediction(self, dt: float, ratio: float) -> None:
        """Queue the Newton step of ``ContactLinearizer.predict_velocities`` from the trial that ``trial_input``
        describes. ``ratio`` is 1 + dt drag."""
        owner, factors = self.owner, self.owner.factors
        self._indices.copy_(self._packed_indices)
        momenta = self._right[:, :3]
        torch.mul(owner.rotation_modes, owner.masses.repeat_interleave(3)[:, None], out=momenta)
        factors.enqueue_momentum_projection(owner.rotation_modes, momenta, factors.enqueue_solve(momenta), ratio)
        self.enqueue_residual(dt, ratio)
        velocities, free_velocities, _, _ = self.trial_parts()
        self._enqueue_free_velocities(velocities, self._residual, free_velocities)
        torch.add(owner.positions, free_velocities, alpha=dt, out=self.end_positions)
        owner.enqueue_gradient(vectors(self.end_positions), dt, self._tensions, vectors(self._gradient))
        torch.linalg.vector_norm(self._gradient, out=self.residual_norm[0])
        self.velocities.copy_(free_velocities)

    def _enqueue_trial(self, dt: float, ratio: float) -> None:
        self._trial_upload.send()
        self.enqueue_trial(dt, ratio)
        self._enqueue_penetration()
        self._download_rest()
        self._readback.start_download()

    def enqueue_trial(self, dt: float, ratio: float) -> None:
        """Evaluate the trial that ``trial_input`` describes: its residual, and the Newton step from it without contact
        forces."""
        self.enqueue_residual(dt, ratio)
        torch.linalg.vector_norm(self._residual, out=self.residual_norm[0])
        self.velocities.copy_(self.trial_parts()[0])
        self._enqueue_newton(self._trial)

    def enqueue_residual(self, dt: float, ratio: float) -> None:
        """Compute the velocities, forces and residual of the trial that ``trial_input`` describes."""
        owner = self.owner
        self._enqueue_base()
        torch.mv(self.columns, self.target_forces, out=self._force_velocities)
        self._force_velocities.mul_(self.trial_input[1])
        step = TrialStep(
            *(dt, ratio, Vec3(*(float(each) for each in owner.body.gravity)), owner.masses),
            *(_one_world(owner.positions), _one_world(owner.velocities), _one_world(owner.lever_arms)),
            owner.inverse_inertia,
            lambda *_: self._enqueue_internal(dt),
        )
        enqueue_trial(step, self._contacts, self.trial_input[:1], self._direction, self._trial_record)

    def _enqueue_internal(self, dt: float) -> None:
        """Enqueue the internal gradient at the end positions of the trial, and its torque."""
        owner = self.owner
        owner.enqueue_gradient(vectors(self.end_positions), dt, self._tensions, vectors(self._gradient))
        torch.mv(owner.rotation_modes.T, self._gradient, out=self._torque)


def _one_world(flat: torch.Tensor) -> torch.Tensor:
    """View a ``flat`` tensor (3n,) as vectors of one world (1, n, 3)."""
    return flat.view(1, -1, 3)
