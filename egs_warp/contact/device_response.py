"""Contact responses and iterates on a GPU: matrices stay there, and a Newton step is one graph and one read-back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import warp as wp

from egs_warp.contact.detection import ContactSet
from egs_warp.contact.response import ContactResponse, Iterate
from egs_warp.fem.body import SoftBody
from egs_warp.fem.dense_factors import DenseFactors
from egs_warp.fem.element_kernels import ElementKernels
from egs_warp.fem.graphs import Recordings, Upload
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.fem.worlds import shared
from egs_warp.kernels.contact import batch_contacts as of_worlds
from egs_warp.kernels.contact import iterate as kernels
from egs_warp.launching import Mirror
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleTension
from egs_warp.precision import Mat33, Vec3, Vec4, real

_KEPT, _TRIED, _BEGUN = 0.0, 1.0, 2.0
"""Where a trial begins: at the base as it is, at the last trial, or at what was told."""
_PLACES = 8
"""Contacts are so many at a time: each number of them has memory and graphs of its own."""


class DeviceResponder:
    """Responses by dense ``factors`` of one body, where its elements are. The last one is at hand, others are not; of
    what was tried the last two."""

    def __init__(self, factors: DenseFactors, body: SoftBody, muscles: MuscleSet) -> None:
        self.factors, self.body, self.stream = factors, body, factors.stream
        elements = body.assembly.elements
        assert isinstance(elements, ElementKernels)
        self.elements = elements
        size = 3 * len(body.mesh.nodes)
        self.turned, self.keeping = self.zeros(size, 3), self.zeros(3, size)
        """What a solution lacks of a turn is ``turned`` times ``keeping`` times what it is the solution of."""
        self.masses = self.tensor(body.node_mass)
        self._start = Upload(self.stream, 6 * size + 9)
        parts = self._start.there.split([size, size, size, 3 * size, 9])
        self.positions, self.velocities, self.arms, self.turns, self.rates = parts
        self.turns = self.turns.view(size, 3)
        self.gradients = wp.zeros(len(body.mesh.tets), dtype=Mat33, device=body.assembly.device)
        self.lines = elements.muscle_lines(MuscleTension.of(muscles, np.zeros(muscles.segment_count)))
        self.segment_count = muscles.segment_count
        self._problem: StepProblem | None = None
        self._rooms: dict[int, ContactRoom] = {}
        self.at_hand: DeviceResponse | None = None

    def zeros(self, *shape: int) -> torch.Tensor:
        """On the device."""
        return torch.zeros(shape, dtype=torch.float64, device=self.factors.device)

    def tensor(self, values: np.ndarray) -> torch.Tensor:
        """On the device."""
        return torch.as_tensor(np.ascontiguousarray(values, dtype=np.float64), device=self.factors.device)

    def __call__(self, tangent: Tangent, contacts: ContactSet) -> DeviceResponse:
        """The response at hand from now on."""
        assert tangent.factors is self.factors
        count, room = contacts.count, self._room_for(contacts)
        with self.stream:
            self._take(tangent.problem)
            delassus = room.respond(tangent.problem, contacts)
            if not tangent.settle():
                delassus = room.respond(tangent.problem, contacts)
        columns = room.columns[:, : 3 * count]
        self.at_hand = DeviceResponse(tangent, contacts, columns, delassus[: 3 * count, : 3 * count], self, room)
        return self.at_hand

    def ahead(
        self,
        tangent: Tangent,
        contacts: ContactSet,
        tension: MuscleTension | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> np.ndarray | None:
        """See ``Responder``. No response is at hand then."""
        assert tangent.factors is self.factors
        room = self._room_for(contacts)
        self.at_hand = room.at_base = room.at_trial = None
        with self.stream:
            self._take(tangent.problem)
        size, ahead = room.ahead(tangent.problem, contacts, tension, velocities, forces)
        if not tangent.settle():
            size, ahead = room.ahead(tangent.problem, contacts, tension, velocities, forces)
        return ahead.reshape(velocities.shape).copy() if np.isfinite(size) else None

    def _room_for(self, contacts: ContactSet) -> ContactRoom:
        places = -(-max(contacts.count, 1) // _PLACES) * _PLACES
        if places not in self._rooms:
            self._rooms[places] = ContactRoom(self, places)
        return self._rooms[places]

    def _take(self, problem: StepProblem) -> None:
        if self._problem is problem:
            return
        self._problem = problem
        state = problem.state
        self._start.take(state.positions, state.velocities, problem.arms, problem.turns, problem.turning_rates)
        wp.copy(self.gradients, problem.damping.start)

    def enqueue_gradient(self, ends: wp.array, dt: float, tensions: wp.array, gradient: wp.array) -> None:
        """Into ``gradient``, newtons, at the positions ``ends``, under ``tensions`` of the muscles."""
        self.elements.enqueue_gradient(ends, self.gradients, dt, self.lines, tensions, gradient)


class ContactRoom:
    """Memory and graphs for so many contacts."""

    def __init__(self, owner: DeviceResponder, places: int) -> None:
        self.owner, self.places, self._device = owner, places, owner.body.assembly.device
        self._node_count = len(owner.body.mesh.nodes)
        size, width = 3 * self._node_count, 3 * places
        self._contact_nodes = wp.zeros(places, dtype=wp.vec4i, device=self._device)
        self._contact_nodes_here = Mirror(self._contact_nodes)
        self._contact_frames = Upload(owner.stream, 13 * places)
        weights, axes = self._contact_frames.there.split([4 * places, 9 * places])
        self._contacts = [
            self._contact_nodes,
            *(shared(weights.view(-1, 4), Vec4), shared(axes.view(-1, 3, 3), Mat33)),
        ]
        # As one of many worlds.
        counts = wp.array([places], dtype=int, device=self._device)
        self._world = [counts, *(each.reshape((1, places)) for each in self._contacts)]
        self.columns = owner.zeros(size, width)
        self._right, self._delassus = owner.zeros(size, 3 + width), owner.zeros(width, width)
        self._delassus_here = owner.stream.pinned(width * width)
        self._held = owner.zeros(2, 3, 3)
        # What is told and what is asked of a trial goes in one piece each.
        self._told = Upload(owner.stream, 3 + width)
        self._asked, self._asked_here = owner.zeros(1 + width + size), owner.stream.pinned(1 + width + size)
        self._begun = Upload(owner.stream, 3 * size + width + owner.segment_count)
        """As the base, and the tensions of the muscles."""
        self._tensions = shared(self._begun.there[3 * size + width :], real)
        self._base, self._trial = owner.zeros(3 * size + width), owner.zeros(3 * size + width)
        self._ends, self._gradient, self._rest, self._solved, self._pushed, self._half = owner.zeros(6, size)
        self._torque, self._turn = owner.zeros(2, 3)
        self._works = Recordings(owner.stream)
        self.at_base: DeviceIterate | None = None
        self.at_trial: DeviceIterate | None = None

    @property
    def ends(self) -> torch.Tensor:
        """(3N,) metres, where the last trial ends."""
        return self._ends

    def tried(self) -> Any:
        """Of the last trial: velocities, those after a Newton step without contact forces, the residual without them
        (3N,); forces (3K,)."""
        return self._parts(self._trial)

    def moved(self, impulses: torch.Tensor) -> torch.Tensor:
        """(3N, j) m/s of ``impulses`` of that shape, N s, by the response at hand."""
        owner = self.owner
        solved = owner.factors.inverse.T @ (owner.factors.inverse @ impulses)
        return solved.addmm_(owner.turned, owner.keeping @ impulses)

    def speeds(self, velocities: torch.Tensor) -> torch.Tensor:
        """(3K, j) m/s of the contacts for nodal ``velocities`` (3N, j)."""
        made = velocities.new_empty((3 * self.places, velocities.shape[1]))
        self._enqueue_speeds(velocities, made)
        return made

    def _enqueue_speeds(self, velocities: torch.Tensor, made: torch.Tensor) -> None:
        self._launch(
            of_worlds.contact_speeds_kernel,
            (1, self.places, velocities.shape[1]),
            [*self._world, shared(velocities[None], real)],
            [shared(made[None], real)],
        )

    def respond(self, problem: StepProblem, contacts: ContactSet) -> np.ndarray:
        """(3K, 3K) m/(N s) of ``contacts``, which are those of this room from now on, by the factors at hand."""
        self._take(contacts)
        self._do(self._enqueue_response, problem.dt, 1.0 + problem.dt * problem.drag)
        self.owner.stream.wait()
        return self._delassus_here.numpy().reshape(3 * self.places, -1).copy()

    def _take(self, contacts: ContactSet) -> None:
        more = self.places - contacts.count
        self._contact_nodes_here.put(np.vstack([contacts.nodes, np.zeros((more, 4), np.int32)]))
        self._contact_frames.take(contacts.weights, np.zeros(4 * more), contacts.axes)

    def ahead(
        self,
        problem: StepProblem,
        contacts: ContactSet,
        tension: MuscleTension | None,
        velocities: np.ndarray,
        forces: np.ndarray,
    ) -> tuple[float, np.ndarray]:
        """Velocities (3N,) after a Newton step under those ``forces`` by the factors at hand, and a number, which is
        none if they invert an element."""
        with self.owner.stream:
            self._take(contacts)
            self._begin(tension, velocities, forces)
        self._tell(0.0, False, forces, _BEGUN)
        size, _, ahead = self._ask(self._enqueue_ahead, problem.dt, 1.0 + problem.dt * problem.drag)
        return float(size), ahead

    def _do(self, work: Callable[..., None], *given: Any) -> None:
        self._works.run((work.__name__, *given), lambda: work(*given))

    def _enqueue_response(self, dt: float, ratio: float) -> None:
        owner, inverse = self.owner, self.owner.factors.inverse
        momenta, impulses = self._right[:, :3], self._right[:, 3:]
        torch.mul(owner.turns, owner.masses.repeat_interleave(3)[:, None], out=momenta)
        impulses.zero_()
        self._launch(of_worlds.contact_rows_kernel, (1, self.places), self._world, [shared(impulses[None], real)])
        impulses.mul_(dt)
        solved = inverse.T @ (inverse @ self._right)
        self._enqueue_keeping(momenta, solved[:, :3], ratio)
        torch.addmm(solved[:, 3:], owner.turned, owner.keeping @ impulses, out=self.columns)
        self._enqueue_speeds(self.columns, self._delassus)
        self._delassus_here.copy_(self._delassus.view(-1), non_blocking=True)

    def _enqueue_keeping(self, momenta: torch.Tensor, turned: torch.Tensor, ratio: float) -> None:
        """What keeps the momentum, of the ``momenta`` (3N, 3) of turns and what these bring about."""
        owner = self.owner
        owner.turned.copy_(turned)
        torch.mm(momenta.T, owner.turned, out=self._held[0])
        self._launch(kernels.holding_kernel, 1, [ratio, shared(self._held[:1], Mat33)], [shared(self._held[1:], Mat33)])
        torch.mm(self._held[1], owner.turns.T - ratio * owner.turned.T, out=owner.keeping)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self._device)

    def _parts(self, state: torch.Tensor) -> Any:
        """Velocities, those after a Newton step without contact forces, residual without them (3N,); forces (3K,)."""
        size = 3 * self._node_count
        return state.split([size, size, size, 3 * self.places])

    def begin(
        self, problem: StepProblem, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """As ``go``, at the very ``velocities`` (N, 3) and ``forces`` (n, 3), under ``tension``."""
        with self.owner.stream:
            self._begin(tension, velocities, forces)
        return self.go(problem, length=0.0, push=False, wanted=forces, base=_BEGUN)

    def _begin(self, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray) -> None:
        more = np.zeros(3 * self.places - forces.size)
        told = [] if tension is None else [tension.tensions]
        self._begun.take(velocities, velocities, np.zeros(velocities.size), forces, more, *told)

    def go(
        self, problem: StepProblem, *, length: float, push: bool, wanted: np.ndarray, base: float
    ) -> tuple[np.ndarray, ...]:
        """A trial from the ``base`` (``_KEPT``, ``_TRIED`` or ``_BEGUN``): its size, the contacts' speeds after its
        Newton step, its velocities."""
        self._tell(length, push, wanted, base)
        return self._ask(self._enqueue_trial, problem.dt, 1.0 + problem.dt * problem.drag)

    def _tell(self, length: float, push: bool, wanted: np.ndarray, base: float) -> None:
        told = self._told.here.numpy()
        told[:3], told[3:] = (length, float(push), base), 0.0
        told[3 : 3 + wanted.size] = wanted.ravel()

    def again(self, *, base: float) -> tuple[np.ndarray, ...]:
        """The ``base`` by the response at hand: no number, the contacts' speeds, no numbers."""
        self._told.here[2] = base
        return self._ask(self._enqueue_again)

    def _ask(self, work: Callable[..., None], *given: float) -> tuple[np.ndarray, ...]:
        with self.owner.stream:
            self._do(work, *given)
            self.owner.stream.wait()
        asked = self._asked_here.numpy()
        return asked[0], asked[1 : 1 + 3 * self.places], asked[1 + 3 * self.places :]

    def _enqueue_base(self) -> None:
        self._told.send()
        self._launch(
            kernels.base_kernel,
            len(self._base),
            [shared(self._told.there[2:3], real), shared(self._trial, real), shared(self._begun.there, real)],
            [shared(self._base, real)],
        )

    def _enqueue_again(self) -> None:
        self._enqueue_base()
        self._enqueue_newton(self._base)

    def _enqueue_newton(self, state: torch.Tensor) -> None:
        """A Newton step without contact forces from ``state``, and the contacts' speeds after it."""
        velocities, loose, free, _ = self._parts(state)
        self._enqueue_step(velocities, free, loose)
        self._enqueue_speeds(loose[:, None], self._asked[1 : 1 + 3 * self.places, None])
        self._asked_here.copy_(self._asked, non_blocking=True)

    def _enqueue_step(self, velocities: torch.Tensor, missing: torch.Tensor, after: torch.Tensor) -> None:
        """``after`` a Newton step from ``velocities``, where so much is ``missing`` (3N,)."""
        owner, inverse = self.owner, self.owner.factors.inverse
        torch.mv(inverse, missing, out=self._half)
        torch.mv(inverse.T, self._half, out=self._solved)
        torch.mv(owner.keeping, missing, out=self._turn)
        self._launch(
            kernels.loose_kernel,
            self._node_count,
            [shared(owner.turned, real), _vectors(velocities), _vectors(self._solved), shared(self._turn, real)],
            [_vectors(after)],
        )

    def _enqueue_ahead(self, dt: float, ratio: float) -> None:
        owner, inverse = self.owner, self.owner.factors.inverse
        momenta = self._right[:, :3]
        torch.mul(owner.turns, owner.masses.repeat_interleave(3)[:, None], out=momenta)
        self._enqueue_keeping(momenta, inverse.T @ (inverse @ momenta), ratio)
        self._enqueue_residual(dt, ratio)
        velocities, loose, _, _ = self._parts(self._trial)
        self._enqueue_step(velocities, self._rest, loose)
        torch.add(owner.positions, loose, alpha=dt, out=self._ends)
        owner.enqueue_gradient(_vectors(self._ends), dt, self._tensions, _vectors(self._gradient))
        torch.linalg.vector_norm(self._gradient, out=self._asked[0])
        self._asked[1 + 3 * self.places :].copy_(loose)
        self._asked_here.copy_(self._asked, non_blocking=True)

    def _enqueue_trial(self, dt: float, ratio: float) -> None:
        self._enqueue_residual(dt, ratio)
        torch.linalg.vector_norm(self._rest, out=self._asked[0])
        self._asked[1 + 3 * self.places :].copy_(self._parts(self._trial)[0])
        self._enqueue_newton(self._trial)

    def _enqueue_residual(self, dt: float, ratio: float) -> None:
        """Where a trial ends, and what is missing there."""
        owner, nodes = self.owner, self._node_count
        self._enqueue_base()
        velocities, _, free, forces = self._parts(self._trial)
        old, old_loose, _, old_forces = self._parts(self._base)
        lengths, wanted = shared(self._told.there[:1], real), self._told.there[3:]
        torch.mv(self.columns, wanted, out=self._pushed)
        self._pushed.mul_(self._told.there[1])
        self._launch(
            kernels.trial_kernel,
            nodes,
            [_vectors(owner.positions), dt, lengths, _vectors(old), _vectors(old_loose), _vectors(self._pushed)],
            [_vectors(velocities), _vectors(self._ends)],
        )
        self._launch(
            kernels.trial_forces_kernel,
            self.places,
            [lengths, _vectors(old_forces), _vectors(wanted)],
            [_vectors(forces)],
        )
        owner.enqueue_gradient(_vectors(self._ends), dt, self._tensions, _vectors(self._gradient))
        torch.mv(owner.turns.T, self._gradient, out=self._torque)
        gravity = Vec3(*(float(each) for each in owner.body.gravity))
        self._launch(
            kernels.residual_kernel,
            nodes,
            [
                *(shared(owner.masses, real), gravity, ratio, dt, _vectors(owner.arms)),
                *(shared(owner.rates.view(1, 3, 3), Mat33), _vectors(owner.velocities), *self._contacts),
                *(_vectors(self._torque), _vectors(self._gradient), _vectors(velocities), _vectors(forces)),
            ],
            [_vectors(free), _vectors(self._rest)],
        )


def _vectors(flat: torch.Tensor) -> wp.array:
    return shared(flat.view(-1, 3), Vec3)


@dataclass(frozen=True)
class DeviceResponse(ContactResponse):
    """``ContactResponse`` whose columns are a tensor on the device."""

    owner: DeviceResponder
    room: ContactRoom

    def wider(self, contacts: ContactSet) -> DeviceResponse:
        """See ``ContactResponse``."""
        return self.owner(self.tangent, contacts)

    def at(self, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray) -> DeviceIterate:
        """See ``ContactResponse``."""
        assert self.owner.at_hand is self
        room = self.room
        found = room.begin(self.tangent.problem, tension, velocities, forces)
        room.at_base, room.at_trial = None, self.made(tension, forces, found)
        return room.at_trial

    def made(self, tension: MuscleTension | None, forces: np.ndarray, found: tuple[np.ndarray, ...]) -> DeviceIterate:
        """Of what the room has ``found``."""
        size, speeds, velocities = found
        return DeviceIterate(
            *(self, tension, velocities.reshape(-1, 3).copy(), forces),
            *(float(size) / self.tangent.problem.unit, speeds[: 3 * self.contacts.count].copy()),
        )


@dataclass(frozen=True, eq=False)
class DeviceIterate:
    """``Iterate`` that lies on the device."""

    response: DeviceResponse
    tension: MuscleTension | None
    velocities: np.ndarray
    forces: np.ndarray
    size: float
    speeds: np.ndarray

    @property
    def feasible(self) -> bool:
        """See ``Iterate``."""
        return bool(np.isfinite(self.size))

    def toward(self, forces: np.ndarray, length: float = 1.0) -> DeviceIterate:
        """See ``Iterate``."""
        room, problem = self.response.room, self.response.tangent.problem
        found = room.go(problem, length=length, push=True, wanted=forces, base=self._base())
        told = forces if length == 1.0 else self.forces + length * (forces - self.forces)
        room.at_base, room.at_trial = self, self.response.made(self.tension, told, found)
        return room.at_trial

    def by(self, response: ContactResponse) -> Iterate:
        """See ``Iterate``."""
        assert isinstance(response, DeviceResponse) and response.room is self.response.room
        room = response.room
        _, speeds, _ = room.again(base=self._base())
        room.at_base = replace(self, response=response, speeds=speeds[: len(self.speeds)].copy())
        return room.at_base

    def _base(self) -> float:
        """Where it lies."""
        room = self.response.room
        assert self is room.at_base or self is room.at_trial
        return _KEPT if self is room.at_base else _TRIED
