"""Contact responses and iterates on a GPU: matrices stay there, and a Newton step is one graph and one read-back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.contact.coulomb import ASTRAY
from egs_warp.contact.detection import ContactSet
from egs_warp.contact.device_body import BodyRoom
from egs_warp.contact.device_room import KEPT, TRIED, ContactRoom, Tried
from egs_warp.contact.device_sight import DeviceSight
from egs_warp.contact.response import ContactResponse, Iterate, Seen
from egs_warp.fem.body import SoftBody
from egs_warp.fem.dense_factors import DenseFactors
from egs_warp.fem.step_problem import Tangent
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
            delassus = room.respond(tangent.problem, contacts)
            if not tangent.settle():
                delassus = room.respond(tangent.problem, contacts)
        self.at_hand = DeviceResponse.there(tangent, contacts, self, room, delassus)
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
    def there(
        cls, tangent: Tangent, contacts: ContactSet, owner: DeviceResponder, room: ContactRoom, delassus: np.ndarray
    ) -> DeviceResponse:
        """What the ``room`` has, whose ``delassus`` operator (3K, 3K) has come."""
        width = 3 * contacts.count
        return cls(tangent, contacts, room.columns[:, :width], delassus[:width, :width], owner, room)

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
        found = room.begin(self.tangent.problem, tension, velocities, forces)
        room.at_base, room.at_trial, room.coming = None, self.made(tension, forces, found), None
        return room.at_trial

    def made(self, tension: MuscleTension | None, forces: np.ndarray, found: Tried) -> DeviceIterate:
        """Of what the room has ``found``."""
        seen = Seen.of(found.seen) if self.owner.looked_at is self.tangent.problem else None
        return self.iterate(tension, forces, float(found.size[0]), found.speeds, found.velocities, seen)

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
        return DeviceIterate(
            *(self, tension, velocities.reshape(-1, 3).copy(), forces),
            *(size / self.tangent.problem.unit, speeds[: 3 * self.contacts.count].copy(), seen),
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
    seen: Seen | None

    def is_at(
        self, response: DeviceResponse, tension: MuscleTension | None, velocities: np.ndarray, forces: np.ndarray
    ) -> bool:
        """Whether it is what is asked for: at these very arrays."""
        if self.response is not response or self.velocities is not velocities or self.forces is not forces:
            return False
        if tension is None or self.tension is None:
            return tension is self.tension
        return np.array_equal(tension.tensions, self.tension.tensions)

    @property
    def feasible(self) -> bool:
        """See ``Iterate``."""
        return bool(np.isfinite(self.size))

    def toward(self, forces: np.ndarray, length: float = 1.0) -> DeviceIterate:
        """See ``Iterate``."""
        room, problem = self.response.room, self.response.tangent.problem
        assert self.response.owner.at_hand is self.response
        found = room.go(problem, length=length, push=True, wanted=forces, base=self._base())
        told = forces if length == 1.0 else self.forces + length * (forces - self.forces)
        room.at_base, room.at_trial, room.coming = self, self.response.made(self.tension, told, found), None
        return room.at_trial

    def onward(self, shift: np.ndarray, friction: float, *, further: bool = False) -> tuple[np.ndarray, float, Iterate]:
        """See ``Iterate``."""
        room, count, problem = self.response.room, self.response.contacts.count, self.response.tangent.problem
        number = room.slot
        assert self.response.owner.at_hand is self.response
        if room.coming is self:
            assert room.coulomb.knows(shift, friction)
        else:
            base = self._base()
            if base == KEPT and room.at_trial is not None:
                # The speeds are the trial's.
                room.again(base=base)
            number = room.begin_onward(problem, shift, friction, base=base)
        if further:
            # The device goes on while the host looks at what has come.
            room.begin_onward(problem, shift, friction, base=TRIED)
        found = room.arrived(number)
        missed, forces = float(found.missed[0]), found.forces[: 3 * count].reshape(-1, 3).copy()
        trial = self.response.made(self.tension, forces, found)
        if further:
            room.at_base, room.at_trial, room.coming = trial, None, trial
        else:
            room.at_base, room.at_trial, room.coming = self, trial, None
        if missed <= ASTRAY:
            return forces, missed, trial
        forces, missed = self.response.forces(self.speeds, shift, friction, self.forces)
        return forces, missed, self.toward(forces)

    def anew(self) -> DeviceIterate:
        """See ``Iterate``. No response but that is at hand then."""
        old, owner, room = self.response, self.response.owner, self.response.room
        assert owner.at_hand is old
        problem, base = old.tangent.problem, self._base()
        found = room.anew(problem, self.tension, self.velocities, base=base)
        if found is None:
            # A sum may be definite where its first part is not.
            response = owner(problem.tangent(owner.factors, self.velocities, self.tension), old.contacts)
            found = room.again(base=base)
        else:
            tangent = Tangent(problem, owner.factors)
            response = DeviceResponse.there(tangent, old.contacts, owner, room, room.delassus_here())
            owner.at_hand = response
        room.at_trial = room.coming = None
        room.at_base = replace(self, response=response, speeds=found.speeds[: len(self.speeds)].copy())
        return room.at_base

    def _base(self) -> float:
        """Where it lies; what the device has left behind is told it again."""
        room = self.response.room
        if self is room.at_base:
            return KEPT
        if self is not room.at_trial:
            room.begin(self.response.tangent.problem, self.tension, self.velocities, self.forces)
            room.at_base, room.at_trial = None, self
        return TRIED
