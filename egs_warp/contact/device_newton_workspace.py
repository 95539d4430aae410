"""Memory and graphs for a step with contact on a GPU: matrices stay there, and a round of Newton steps is one loop."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from egs_warp.contact.detection import ContactSet
from egs_warp.contact.device_coulomb import CoulombWorkspace
from egs_warp.contact.device_step import StepWorkspace, vectors
from egs_warp.contact.newton_convergence import MAX_NEWTON_STEPS, ConvergenceState
from egs_warp.fem.batched import as_warp
from egs_warp.fem.cuda_graphs import GraphCache, PinnedUpload
from egs_warp.fem.step_problem import StepProblem
from egs_warp.kernels.contact import batch_contacts as of_worlds
from egs_warp.kernels.contact import iterate as kernels
from egs_warp.kernels.contact import newton_convergence as courses
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import Mat33, Vec3, Vec4, real

FROM_BASE, FROM_TRIAL, FROM_START = 0.0, 1.0, 2.0
"""Where a trial begins: at the base as it is, at the last trial, or at what was told."""
_FULL_STEP = (1.0, 1.0, FROM_TRIAL)
"""What is told of a whole Newton step from the last trial."""


class TrialReadback(NamedTuple):
    """What is asked of a trial, in memory that the next one takes."""

    residual_norm: np.ndarray
    """(1,) N s that the step's equation misses; not finite where an element is inverted."""
    free_contact_velocities: np.ndarray
    """(3K,) m/s of the contacts after a Newton step from there without their forces."""
    velocities: np.ndarray
    """(3N,) m/s."""
    coulomb_violation: np.ndarray
    """(1,) m/s by which the forces that were found last miss their laws."""
    forces: np.ndarray
    """(3K,) newtons, these."""
    penetration: np.ndarray
    """(5,), see ``Seen``."""
    convergence: np.ndarray
    """Of the round, see ``judge_kernel``, with N s after each step."""
    previous_contact_velocities: np.ndarray
    """(3K,) m/s, the speeds where the last step began, of which the next are the velocities and forces."""
    velocities_before: np.ndarray
    forces_before: np.ndarray

    @property
    def steps_taken(self) -> int:
        """Steps without a look."""
        return int(self.convergence[courses.STEPS_TAKEN])

    @property
    def step_residuals(self) -> np.ndarray:
        """(taken,) N s after each of them."""
        return self.convergence[courses.HEADER_SIZE :][: self.steps_taken]


class NewtonWorkspace:
    """Memory and graphs for so many contacts."""

    def __init__(self, owner: StepWorkspace, places: int) -> None:
        self.owner, self.capacity, self._device = owner, places, owner.body.assembly.device
        self._node_count = len(owner.body.mesh.nodes)
        size, width = 3 * self._node_count, 3 * places
        self._taken = PinnedUpload(owner.stream, 1 + 18 * places)
        count, self._numbers_told, weights, axes = self._taken.device.split([1, 5 * places, 4 * places, 9 * places])
        self._numbers = torch.zeros(5 * places, dtype=torch.int32, device=count.device)
        self._points, nodes = self._numbers.split([places, 4 * places])
        self._contacts = [
            as_warp(nodes.view(-1, 4), wp.vec4i),
            *(as_warp(weights.view(-1, 4), Vec4), as_warp(axes.view(-1, 3, 3), Mat33)),
        ]
        # As one of many worlds.
        counts = wp.array([places], dtype=int, device=self._device)
        self._world = [counts, *(each.reshape((1, places)) for each in self._contacts)]
        self.columns = owner.zeros(size, width)
        self._right, self.delassus = owner.zeros(size, 3 + width), owner.zeros(width, width)
        self._delassus_here = owner.stream.pinned(width * width)
        self._held = owner.zeros(2, 3, 3)
        # What is told and what is asked of a trial goes in one piece each.
        self._told = PinnedUpload(owner.stream, 3 + width)
        self.trial_input, self.target_forces = self._told.device.split([3, width])
        """Of a trial its length, whether forces push, where it begins; and the forces (3K,) newtons."""
        parts = [1, width, size, 1, width, 5, courses.HEADER_SIZE + MAX_NEWTON_STEPS, width, size, width]
        self._asked, self._asked_here = owner.zeros(sum(parts)), owner.stream.pinned(sum(parts))
        self.size, self.speeds_after, self.velocities, self.coulomb_violation, self._found, *others = self._asked.split(
            parts
        )
        seen, self._course, self._speeds_before, *self._before = others
        self._sinking, self._least, self._torque_seen = seen.split([1, 1, 3])
        self.readback = TrialReadback(*np.split(self._asked_here.numpy(), np.cumsum(parts)[:-1]))
        # A loop of Newton steps: what it is told, whether it goes on, and when it has come to an end.
        self._course_told = PinnedUpload(owner.stream, courses.HEADER_SIZE)
        self._going, self._always = (torch.full((1,), each, dtype=torch.int32, device=count.device) for each in (0, 1))
        self._forward, self._arrival = owner.tensor(np.array(_FULL_STEP)), None
        self.coulomb = CoulombWorkspace(owner.stream, places, count)
        self._begun = PinnedUpload(owner.stream, 3 * size + width + owner.segment_count)
        self.start_buffer, self.tensions = self._begun.device.split([3 * size + width, owner.segment_count])
        """As the base; newtons of the muscles."""
        self._tensions = as_warp(self.tensions, real)
        self._base, self._trial = owner.zeros(3 * size + width), owner.zeros(3 * size + width)
        self.ends, self._gradient, self._rest, self._solved, self._pushed, self._half = owner.zeros(6, size)
        self._torque, self._turn = owner.zeros(2, 3)
        self._works = GraphCache(owner.stream)
        self.base_iterate: Any = None
        self.trial_iterate: Any = None
        """The iterates that lie there."""
        self.pending_iterate: Any = None
        """The iterate from which ``begin_onward`` went, if nobody has waited for that."""
        self.convergence: ConvergenceState | None = None
        """That of which it was told."""

    def trial_parts(self) -> Any:
        """Of the last trial, see ``parts``."""
        return self.parts(self._trial)

    def apply_inverse(self, impulses: torch.Tensor) -> torch.Tensor:
        """(3N, j) m/s of ``impulses`` of that shape, N s, by the response at hand."""
        owner = self.owner
        solved = owner.factors.inverse.T @ (owner.factors.inverse @ impulses)
        return solved.addmm_(owner.rotation_response, owner.momentum_projection @ impulses)

    def contact_velocities(self, velocities: torch.Tensor) -> torch.Tensor:
        """(3K, j) m/s of the contacts for nodal ``velocities`` (3N, j)."""
        made = velocities.new_empty((3 * self.capacity, velocities.shape[1]))
        self._enqueue_speeds(velocities, made)
        return made

    def _enqueue_speeds(self, velocities: torch.Tensor, made: torch.Tensor) -> None:
        self._launch(
            of_worlds.contact_velocities_kernel,
            (1, self.capacity, velocities.shape[1]),
            [*self._world, as_warp(velocities[None], real)],
            [as_warp(made[None], real)],
        )

    def linearize(self, problem: StepProblem, contacts: ContactSet) -> None:
        """To ``contacts``, which are those of this room from now on, by the factors at hand; nobody waits."""
        self.set_contacts(contacts)
        self._run(self.enqueue_linearization, problem.dt, 1.0 + problem.dt * problem.drag)

    def download_delassus(self) -> np.ndarray:
        """(3K, 3K) m/(N s), what has come of ``respond``."""
        return self._delassus_here.numpy().reshape(3 * self.capacity, -1).copy()

    def set_contacts(self, contacts: ContactSet) -> None:
        """Those of this room from now on."""
        told = np.zeros((18, self.capacity))
        places = np.split(told.ravel(), np.cumsum([1, 4, 4]) * self.capacity)
        of_each = contacts.points, contacts.nodes, contacts.weights, contacts.axes
        for place, values in zip(places, of_each, strict=True):
            place[: values.size] = values.ravel()
        self._taken.set(np.array([contacts.count]), told)

    def predict_velocities(
        self,
        problem: StepProblem,
        contacts: ContactSet,
        tension: MuscleEnergy | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> tuple[float, np.ndarray]:
        """Velocities (3N,) after a Newton step under those ``forces`` by the factors at hand, and a number, which is
        none if they invert an element."""
        with self.owner.stream:
            self.set_contacts(contacts)
            self.upload_start(tension, velocities, forces)
        self._upload_trial(0.0, False, forces, FROM_START)
        found = self._run_and_download(self._enqueue_ahead, problem.dt, 1.0 + problem.dt * problem.drag)
        return float(found.residual_norm[0]), found.velocities

    def _run(self, work: Callable[..., None], *given: Any) -> None:
        self._works.run((work.__name__, *given), lambda: work(*given))

    def enqueue_linearization(self, dt: float, ratio: float) -> None:
        """``respond``, with nothing that waits."""
        owner, inverse = self.owner, self.owner.factors.inverse
        self._numbers.copy_(self._numbers_told)
        momenta, impulses = self._right[:, :3], self._right[:, 3:]
        torch.mul(owner.rotation_modes, owner.masses.repeat_interleave(3)[:, None], out=momenta)
        impulses.zero_()
        self._launch(
            of_worlds.contact_jacobian_kernel, (1, self.capacity), self._world, [as_warp(impulses[None], real)]
        )
        impulses.mul_(dt)
        solved = inverse.T @ (inverse @ self._right)
        self._enqueue_momentum_projection(momenta, solved[:, :3], ratio)
        torch.addmm(solved[:, 3:], owner.rotation_response, owner.momentum_projection @ impulses, out=self.columns)
        self._enqueue_speeds(self.columns, self.delassus)
        self.coulomb.enqueue_operator(self.delassus)
        self._delassus_here.copy_(self.delassus.view(-1), non_blocking=True)

    def _enqueue_momentum_projection(self, momenta: torch.Tensor, turned: torch.Tensor, ratio: float) -> None:
        """What keeps the momentum, of the ``momenta`` (3N, 3) of turns and what these bring about."""
        owner = self.owner
        owner.rotation_response.copy_(turned)
        torch.mm(momenta.T, owner.rotation_response, out=self._held[0])
        self._launch(
            kernels.invert_momentum_matrix_kernel,
            1,
            [ratio, as_warp(self._held[:1], Mat33)],
            [as_warp(self._held[1:], Mat33)],
        )
        torch.mm(
            self._held[1], owner.rotation_modes.T - ratio * owner.rotation_response.T, out=owner.momentum_projection
        )

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self._device)

    def parts(self, state: torch.Tensor) -> Any:
        """Velocities, those after a Newton step without contact forces, residual without them (3N,); forces (3K,)."""
        size = 3 * self._node_count
        return state.split([size, size, size, 3 * self.capacity])

    def start_trial(
        self, problem: StepProblem, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray
    ) -> None:
        """A trial at the very ``velocities`` (N, 3) and ``forces`` (n, 3), under ``tension``; nobody waits."""
        with self.owner.stream:
            self.upload_start(tension, velocities, forces)
            self._upload_trial(0.0, False, forces, FROM_START)
            self._run(self._enqueue_trial, problem.dt, 1.0 + problem.dt * problem.drag)
            self._told.start_copy()

    def upload_start(self, tension: MuscleEnergy | None, velocities: np.ndarray, forces: np.ndarray) -> None:
        """Tell where a trial may begin."""
        more = np.zeros(3 * self.capacity - forces.size)
        told = [] if tension is None else [tension.tensions]
        self._begun.set(velocities, velocities, np.zeros(velocities.size), forces, more, *told)

    def run_trial(self, problem: StepProblem, *, length: float, wanted: np.ndarray, base: float) -> TrialReadback:
        """A trial at so much of the way from the ``base`` (``KEPT`` or ``TRIED``) to the end of a Newton step."""
        self._upload_trial(length, True, wanted, base)
        return self._run_and_download(self._enqueue_trial, problem.dt, 1.0 + problem.dt * problem.drag)

    def start_newton(
        self,
        problem: StepProblem,
        shifts: np.ndarray,
        friction: float,
        course: ConvergenceState,
        *,
        base: float,
        size: float | None = None,
        usual: torch.Tensor | None = None,
    ) -> None:
        """Newton steps from the ``base`` (``KEPT`` or ``TRIED``), where the residual has this ``size``, or that of the
        last trial, each under the forces that obey contact and friction where it begins, as long as the ``course`` of
        the round says nothing else, or none where ``usual`` (1,) int32 turns out to be 0; nobody waits for them but
        ``arrived``."""
        dt, ratio = problem.dt, 1.0 + problem.dt * problem.drag
        self.convergence, self.owner.last_solve = course, None
        with self.owner.stream:
            self.coulomb.upload(shifts, friction)
            self._course_told.set(course.pack(problem.residual_scale, size))
            work = partial(self._enqueue_convergence, base, self._always if usual is None else usual)
            self._works.run(("course", base, usual is None), work)
            self._works.repeat((dt, ratio), lambda: self._enqueue_next_step(dt, ratio), self._going)
            self._run(self._enqueue_end, dt)
            self._arrival = self.owner.stream.record_event(self._arrival)

    def wait_newton(self) -> TrialReadback:
        """What has come of ``begin_onward``."""
        if self._arrival is not None:
            self._arrival.synchronize()
        return self.readback

    def _enqueue_convergence(self, base: float, usual: torch.Tensor) -> None:
        if base == FROM_BASE:
            self._trial.copy_(self._base)
        self._course[: courses.HEADER_SIZE].copy_(self._course_told.device)
        self._launch(
            courses.init_convergence_kernel,
            1,
            [as_warp(usual, wp.int32), as_warp(self.size, real)],
            [as_warp(self._course, real), as_warp(self._going, wp.int32)],
        )
        self.trial_input.copy_(self._forward)

    def _enqueue_next_step(self, dt: float, ratio: float) -> None:
        """From the last trial, and whether another comes after it."""
        self.target_forces.copy_(self.trial_parts()[3])
        self._speeds_before.copy_(self.speeds_after)
        self.enqueue_newton(dt, ratio)
        self._enqueue_penetration()
        self._launch(
            courses.check_convergence_kernel,
            1,
            [as_warp(each, real) for each in (self.size, self.coulomb_violation, self._sinking)],
            [as_warp(self._course, real), as_warp(self._going, wp.int32)],
        )

    def _enqueue_end(self, dt: float) -> None:
        """What is asked of the last trial, of where its step began, and of a step that begins there."""
        velocities, _, _, forces = self.parts(self._base)
        for there, value in zip(self._before, (velocities, forces), strict=True):
            there.copy_(value)
        self._download_rest()
        self.owner.enqueue_prefetch(self.ends, self.velocities, dt, self._points)
        self._start_download()

    def _enqueue_penetration(self) -> None:
        """Of points at the end of the last trial."""
        self.owner.selector.enqueue_penetration(vectors(self.ends), self._points, self.coulomb.counts, self._sinking)

    def _download_rest(self) -> None:
        """The rest of what is to be seen there, see ``Seen``."""
        self.owner.selector.enqueue_min_gap(self._least[0])
        self._torque_seen.copy_(self._torque)

    def enqueue_newton(self, dt: float, ratio: float) -> None:
        """``onward`` as is told, from the forces that are wanted, with nothing that waits."""
        self.coulomb.enqueue_forces(self.speeds_after, self.target_forces, self.coulomb_violation)
        self._found.copy_(self.target_forces)
        self.enqueue_trial(dt, ratio)

    def _upload_trial(self, length: float, push: bool, wanted: np.ndarray, base: float) -> None:
        self._told.write(np.array([length, float(push), base]), wanted)

    def _tell_base(self, base: float) -> None:
        self._told.wait()
        self._told.host[2] = base

    def reevaluate(self, *, base: float) -> None:
        """The speeds at the ``base`` by the response at hand; the rest is another trial's. Nobody waits."""
        with self.owner.stream:
            self._tell_base(base)
            self._run(self._enqueue_reevaluate)
            self._told.start_copy()

    def refactor(
        self, problem: StepProblem, tension: MuscleEnergy | None, velocities: np.ndarray, *, base: float
    ) -> None:
        """Factors and response by the tangent at the ``base``, where these ``velocities`` (N, 3) are, with the muscles'
        stiffness, and the speeds there, all of which hold if these factors are ``ready``. Nobody waits."""
        owner, ratio = self.owner, 1.0 + problem.dt * problem.drag
        with owner.stream:
            self._tell_base(base)
            owner.factors.upload_diagonal(ratio * np.repeat(owner.body.node_mass, 3))
            self._run(self._enqueue_factors, problem.dt)
            self._told.start_copy()
            if tension is not None:
                owner.enqueue_stiffness(problem, tension, velocities)
            self._run(self._enqueue_refactor, problem.dt, ratio)
        owner.factors.mark_started()

    def _enqueue_factors(self, dt: float) -> None:
        owner = self.owner
        self._told.send()
        self._enqueue_base()
        torch.add(owner.positions, self.parts(self._base)[0], alpha=dt, out=self.ends)
        owner.enqueue_factors(vectors(self.ends), dt)

    def _enqueue_refactor(self, dt: float, ratio: float) -> None:
        self.enqueue_linearization(dt, ratio)
        self._enqueue_newton(self._base)
        self._start_download()

    def _run_and_download(self, work: Callable[..., None], *given: float) -> TrialReadback:
        with self.owner.stream:
            self._run(work, *given)
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
        self._told.send()
        self._enqueue_base()
        self._enqueue_newton(self._base)
        self._start_download()

    def _start_download(self) -> None:
        """What was asked of a trial is on its way to the host."""
        self._asked_here.copy_(self._asked, non_blocking=True)

    def _enqueue_newton(self, state: torch.Tensor) -> None:
        """A Newton step without contact forces from ``state``, and the contacts' speeds after it."""
        velocities, loose, free, _ = self.parts(state)
        self._enqueue_step(velocities, free, loose)
        self._enqueue_speeds(loose[:, None], self.speeds_after[:, None])

    def _enqueue_step(self, velocities: torch.Tensor, missing: torch.Tensor, after: torch.Tensor) -> None:
        """``after`` a Newton step from ``velocities``, where so much is ``missing`` (3N,)."""
        owner, inverse = self.owner, self.owner.factors.inverse
        torch.mv(inverse, missing, out=self._half)
        torch.mv(inverse.T, self._half, out=self._solved)
        torch.mv(owner.momentum_projection, missing, out=self._turn)
        self._launch(
            kernels.free_velocity_kernel,
            self._node_count,
            [
                as_warp(owner.rotation_response, real),
                vectors(velocities),
                vectors(self._solved),
                as_warp(self._turn, real),
            ],
            [vectors(after)],
        )

    def _enqueue_ahead(self, dt: float, ratio: float) -> None:
        self._told.send()
        self.enqueue_prediction(dt, ratio)
        self._start_download()

    def enqueue_prediction(self, dt: float, ratio: float) -> None:
        """``ahead`` of what is told, with nothing that waits."""
        owner, inverse = self.owner, self.owner.factors.inverse
        self._numbers.copy_(self._numbers_told)
        momenta = self._right[:, :3]
        torch.mul(owner.rotation_modes, owner.masses.repeat_interleave(3)[:, None], out=momenta)
        self._enqueue_momentum_projection(momenta, inverse.T @ (inverse @ momenta), ratio)
        self.enqueue_residual(dt, ratio)
        velocities, loose, _, _ = self.trial_parts()
        self._enqueue_step(velocities, self._rest, loose)
        torch.add(owner.positions, loose, alpha=dt, out=self.ends)
        owner.enqueue_gradient(vectors(self.ends), dt, self._tensions, vectors(self._gradient))
        torch.linalg.vector_norm(self._gradient, out=self.size[0])
        self.velocities.copy_(loose)

    def _enqueue_trial(self, dt: float, ratio: float) -> None:
        self._told.send()
        self.enqueue_trial(dt, ratio)
        self._enqueue_penetration()
        self._download_rest()
        self._start_download()

    def enqueue_trial(self, dt: float, ratio: float) -> None:
        """``go`` as is told, with nothing that waits."""
        self.enqueue_residual(dt, ratio)
        torch.linalg.vector_norm(self._rest, out=self.size[0])
        self.velocities.copy_(self.trial_parts()[0])
        self._enqueue_newton(self._trial)

    def enqueue_residual(self, dt: float, ratio: float) -> None:
        """Where a trial ends, and what is missing there."""
        owner, nodes = self.owner, self._node_count
        self._enqueue_base()
        velocities, _, free, forces = self.parts(self._trial)
        old, old_loose, _, old_forces = self.parts(self._base)
        lengths, wanted = as_warp(self.trial_input[:1], real), self.target_forces
        torch.mv(self.columns, wanted, out=self._pushed)
        self._pushed.mul_(self.trial_input[1])
        self._launch(
            kernels.trial_kernel,
            nodes,
            [vectors(owner.positions), dt, lengths, vectors(old), vectors(old_loose), vectors(self._pushed)],
            [vectors(velocities), vectors(self.ends)],
        )
        self._launch(
            kernels.trial_forces_kernel,
            self.capacity,
            [lengths, vectors(old_forces), vectors(wanted)],
            [vectors(forces)],
        )
        owner.enqueue_gradient(vectors(self.ends), dt, self._tensions, vectors(self._gradient))
        torch.mv(owner.rotation_modes.T, self._gradient, out=self._torque)
        gravity = Vec3(*(float(each) for each in owner.body.gravity))
        self._launch(
            kernels.residual_kernel,
            nodes,
            [
                *(as_warp(owner.masses, real), gravity, ratio, dt, vectors(owner.lever_arms)),
                *(as_warp(owner.inverse_inertia.view(1, 3, 3), Mat33), vectors(owner.velocities), *self._contacts),
                *(vectors(self._torque), vectors(self._gradient), vectors(velocities), vectors(forces)),
            ],
            [vectors(free), vectors(self._rest)],
        )
