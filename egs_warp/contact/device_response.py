"""Contact responses and iterates on a GPU: matrices stay there, a round of Newton steps is one loop and one look."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from egs_warp.contact.coulomb import ASTRAY
from egs_warp.contact.course import Course
from egs_warp.contact.detection import ContactSet
from egs_warp.contact.device_body import BodyRoom, Ended
from egs_warp.contact.device_room import KEPT, TRIED, ContactRoom, Tried
from egs_warp.contact.device_sight import DeviceSight
from egs_warp.contact.response import ContactResponse, Seen, Stretch
from egs_warp.fem.body import SoftBody
from egs_warp.fem.dense_factors import DenseFactors
from egs_warp.fem.step_problem import Tangent
from egs_warp.kernels.contact.course import FIRST
from egs_warp.launching import by_steps
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.muscles.tension import MuscleTension

_PLACES = 8
"""Contacts are so many at a time: each number of them has memory and graphs of its own."""


class DeviceResponder(BodyRoom):
    """Responses by dense factors of one body, where its elements are. The last one is at hand, others are not; of what
    was tried the last two."""

    def __init__(self, factors: DenseFactors, body: SoftBody, muscles: MuscleSet, sight: DeviceSight) -> None:
        super().__init__(factors, body, muscles, sight)
        self._rooms: dict[int, ContactRoom] = {}
        self.at_hand: DeviceResponse | None = None

    def __call__(self, tangent: Tangent, contacts: ContactSet) -> DeviceResponse:
        """The response at hand from now on."""
        assert tangent.factors is self.factors
        room, self.foreseen = self.room_for(contacts), None
        with self.stream:
            self.take(tangent.problem)
            room.respond(tangent.problem, contacts)
            if not tangent.settle():
                room.respond(tangent.problem, contacts)
        room.at_base = room.at_trial = room.coming = None
        self.at_hand = DeviceResponse.there(tangent, contacts, self, room)
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
        room = self.room_for(contacts)
        self.foreseen = self.at_hand = room.at_base = room.at_trial = room.coming = None
        with self.stream:
            self.take(tangent.problem)
        size, ahead = room.ahead(tangent.problem, contacts, tension, velocities, forces)
        if not tangent.settle():
            size, ahead = room.ahead(tangent.problem, contacts, tension, velocities, forces)
        return ahead.reshape(velocities.shape).copy() if np.isfinite(size) else None

    def room_for(self, contacts: ContactSet) -> ContactRoom:
        """Memory for them."""
        places = by_steps(contacts.count, _PLACES)
        if places not in self._rooms:
            self._rooms[places] = ContactRoom(self, places)
        return self._rooms[places]


@dataclass(frozen=True)
class DeviceResponse(ContactResponse):
    """``ContactResponse`` whose columns are a tensor on the device."""

    owner: DeviceResponder
    room: ContactRoom

    @classmethod
    def there(cls, tangent: Tangent, contacts: ContactSet, owner: DeviceResponder, room: ContactRoom) -> DeviceResponse:
        """What the ``room`` has, or will have."""
        return cls(tangent, contacts, room.columns[:, : 3 * contacts.count], owner, room)

    @cached_property
    def delassus(self) -> np.ndarray:
        """See ``ContactResponse``; of the one that is at hand."""
        assert self.owner.at_hand is self
        self.owner.stream.wait()
        width = 3 * self.contacts.count
        return self.room.delassus_here()[:width, :width]

    def wider(self, contacts: ContactSet) -> DeviceResponse:
        """See ``ContactResponse``."""
        return self.owner(self.tangent, contacts)

    def at(self, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray) -> DeviceIterate:
        """See ``ContactResponse``."""
        for known in (self.room.at_trial, self.room.coming):
            if known is not None and known.is_at(self, tension, velocities, forces):
                return known
        return self.begun_at(tension, velocities, forces)

    def begun_at(self, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray) -> DeviceIterate:
        """``at``, where the room's last trial is then."""
        assert self.owner.at_hand is self
        room = self.room
        room.begin(self.tangent.problem, tension, velocities, forces)
        room.at_base, room.at_trial, room.coming = None, DeviceIterate(self, tension, velocities, forces), None
        return room.at_trial

    def made(self, tension: MuscleTension | None, forces: np.ndarray, found: Tried) -> DeviceIterate:
        """Of what the room has ``found``."""
        return self.iterate(tension, forces, float(found.size[0]), found.speeds, found.velocities, self.seen_in(found))

    def seen_in(self, found: Tried) -> Seen | None:
        """What there is to be seen in what the room has ``found``; None if nobody has looked at the step's start."""
        return Seen.of(found.seen) if self.owner.looked_at is self.tangent.problem else None

    def iterate(
        self,
        tension: MuscleTension | None,
        forces: np.ndarray,
        size: float,
        speeds: np.ndarray,
        velocities: np.ndarray,
        seen: Seen | None,
    ) -> DeviceIterate:
        """At those ``velocities`` (3N,), under ``forces`` (n, 3), where the equation misses ``size`` N s and contacts
        go on at ``speeds`` (3K,)."""
        place = DeviceIterate(self, tension, velocities.reshape(-1, 3).copy(), forces)
        place.know(size / self.tangent.problem.unit, speeds, seen)
        return place


class DeviceIterate:
    """``Iterate`` that lies on the device. What it is asked for may be on its way, and its tangent only begun."""

    def __init__(
        self, response: DeviceResponse, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray
    ) -> None:
        self._response, self.tension, self.velocities, self.forces = response, tension, velocities, forces
        self._size: float | None = None
        self._speeds: np.ndarray | None = None
        self._seen: Seen | None = None
        self._begun = False

    def know(self, size: float, speeds: np.ndarray, seen: Seen | None) -> None:
        """What has come: of the residual, ``speeds`` (3K,) of the contacts, and what is ``seen``."""
        self._size, self._seen = size, seen
        self._speeds = speeds[: 3 * self._response.contacts.count].copy()

    @property
    def response(self) -> DeviceResponse:
        """See ``Iterate``."""
        return self._response

    @property
    def size(self) -> float:
        """See ``Iterate``."""
        if self._size is None:
            self._wait()
        assert self._size is not None
        return self._size

    @property
    def speeds(self) -> np.ndarray:
        """See ``Iterate``."""
        if self._speeds is None:
            self._wait()
        assert self._speeds is not None
        return self._speeds

    @property
    def seen(self) -> Seen | None:
        """See ``Iterate``."""
        if self._size is None:
            self._wait()
        return self._seen

    @property
    def feasible(self) -> bool:
        """See ``Iterate``."""
        return bool(np.isfinite(self.size))

    def is_at(
        self, response: DeviceResponse, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray
    ) -> bool:
        """Whether it is what is asked for: at these very arrays."""
        if self.response is not response or self.velocities is not velocities or self.forces is not forces:
            return False
        if tension is None or self.tension is None:
            return tension is self.tension
        return np.array_equal(tension.tensions, self.tension.tensions)

    def toward(self, forces: np.ndarray, length: float = 1.0) -> DeviceIterate:
        """See ``Iterate``."""
        self._settle()
        room, problem = self.response.room, self.response.tangent.problem
        assert self.response.owner.at_hand is self.response
        found = room.go(problem, length=length, wanted=forces, base=self._base())
        told = forces if length == 1.0 else self.forces + length * (forces - self.forces)
        room.at_base, room.at_trial, room.coming = self, self.response.made(self.tension, told, found), None
        return room.at_trial

    def onward(self, shift: np.ndarray, friction: float, course: Course | None = None) -> Stretch:
        """See ``Iterate``."""
        response, room = self.response, self.response.room
        owner, problem, count = response.owner, response.tangent.problem, response.contacts.count
        course = course or Course(0.0, 0.0, np.inf, most=1)
        assert owner.at_hand is response
        if room.coming is not self or room.course != course or not room.coulomb.knows(shift, friction):
            base = self._base()
            if base == KEPT and room.at_trial is not None:
                # The speeds are the trial's.
                room.again(base=base)
            room.begin_onward(problem, shift, friction, course, base=base, size=self._size)
        found = room.arrived()
        if self._begun and not owner.factors.ready:
            room.at_base = room.at_trial = room.coming = None
            self._settle()
            return self.onward(shift, friction, course)
        self._begun = False
        if found.taken == 0:
            # A plan that was not as usual: the device has stayed there.
            room.at_base, room.at_trial, room.coming = None, self, None
            return self.onward(shift, friction, course)
        sizes, first = found.sizes, self
        if len(sizes) == 1:
            if self._speeds is None:
                self.know(float(found.course[FIRST]) / problem.unit, found.speeds_before, self._seen)
        else:
            forces = found.forces_before[: 3 * count].reshape(-1, 3).copy()
            first = response.iterate(
                self.tension, forces, float(sizes[-2]), found.speeds_before, found.velocities_before, None
            )
        forces, missed = found.forces[: 3 * count].reshape(-1, 3).copy(), float(found.missed[0])
        end = response.made(self.tension, forces, found)
        if end._seen is not None and end._seen.sinking:
            end._seen = replace(end._seen, deepest=owner.sight.deepest(room.places))
        room.at_base, room.at_trial, room.coming = first, end, None
        owner.ended = Ended(end.velocities, problem.dt, response.contacts.points, room.places)
        if missed > ASTRAY:
            forces, missed = response.forces(first.speeds, shift, friction, first.forces)
            end = first.toward(forces)
        return Stretch(tuple(sizes[:-1] / problem.unit), first, forces, missed, end)

    def anew(self) -> DeviceIterate:
        """See ``Iterate``. No response but that is at hand then."""
        old, owner, room = self.response, self.response.owner, self.response.room
        assert owner.at_hand is old
        problem = old.tangent.problem
        room.anew(problem, self.tension, self.velocities, base=self._base())
        response = DeviceResponse.there(Tangent(problem, owner.factors), old.contacts, owner, room)
        place = DeviceIterate(response, self.tension, self.velocities, self.forces)
        place._size, place._seen, place._begun = self._size, self._seen, True
        owner.at_hand, room.at_base, room.at_trial, room.coming = response, place, None, None
        return place

    def _wait(self) -> None:
        """For what is on its way, which nothing has gone past."""
        self._settle()
        response, room = self.response, self.response.room
        assert room.coming is None and self is (room.at_trial or room.at_base)
        response.owner.stream.wait()
        size, seen = self._size, self._seen
        if self is room.at_trial:
            size, seen = float(room.answer.size[0]) / response.tangent.problem.unit, response.seen_in(room.answer)
        assert size is not None
        self.know(size, room.answer.speeds, seen)

    def _settle(self) -> None:
        """Wait for a tangent that is begun; if it is not definite, another is made: a sum may be where its first part
        is not."""
        if not self._begun:
            return
        self._begun = False
        owner, old = self.response.owner, self.response
        if owner.factors.ready:
            return
        problem = old.tangent.problem
        self._response = owner(problem.tangent(owner.factors, self.velocities, self.tension), old.contacts)
        self._speeds = None
        room = self._response.room
        room.begin(problem, self.tension, self.velocities, self.forces)
        room.at_trial = self

    def _base(self) -> float:
        """Where it lies; what the device has left behind is told it again."""
        room = self.response.room
        if self is room.at_base:
            return KEPT
        if self is not room.at_trial:
            room.begin(self.response.tangent.problem, self.tension, self.velocities, self.forces)
            room.at_base, room.at_trial, room.coming = None, self, None
        return TRIED
