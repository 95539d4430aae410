"""Motions one after the other: each begins where, and as, the body stands when the one before has come to rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from egs_warp.contact.terrain import Surface, surface_above
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.feet import Foot, SupportKind, find_feet, support_kind_of
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.limbs import Limbs
from egs_warp.motions.stance import GroundFrame, heading_between, sole_shares
from egs_warp.motions.style import Style

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_ROLLED = 30.0
"""Degrees: a ball that lies within this of how it lay has turned about up, else it has rolled."""
LATE = 0.03
"""Of its time so far: what a motion is given that takes longer than expected."""


@dataclass(frozen=True)
class Stance:
    """Where a body stands, upright and at rest, and which way is forward."""

    body: SoftBody
    ground: GroundFrame
    """Its origin is under the centre of mass; up is against gravity."""
    standing: np.ndarray
    """(N, 3) nodes, metres."""
    contact_points: np.ndarray
    """(k, 3) points of the body on the ground, metres."""
    step: float
    """Seconds of a solver step."""
    solids: tuple[Surface, ...] = ()
    """What there is to stand on, the ground among it."""
    friction: float = 0.8
    """Coulomb coefficient."""
    limbs: Limbs | None = None
    """Of the capture, where there is one; else they are those of the cage."""
    style: Style = field(default_factory=Style)
    """Of what jumps."""

    def feet(self) -> tuple[Foot, ...]:
        """What the body stands on (``find_feet``)."""
        heights = (self.standing - self.ground.origin) @ self.ground.surface_normal
        return find_feet(self.body.mesh, heights, self.body.height, self.limbs)

    def base(self) -> SupportKind:
        """What kind of thing that is, of the body as it is without its weight."""
        nodes = self.body.mesh.nodes
        turn = self.body.best_fit_rotation(self.standing)
        return support_kind_of(self.body.mesh, nodes @ (turn.T @ self.ground.surface_normal), len(self.feet()))

    def next_stance(self, positions: np.ndarray, report: StepReport | None) -> Stance:
        """Where a motion begins that finds the nodes at ``positions`` (N, 3) at rest; ``report`` of the step before.

        A ball stands on whatever it has rolled onto.
        """
        if report is None or report.contacts.count == 0 or self.base() is not SupportKind.ROUND_BASE:
            return self.moved_to(positions)
        body, contacts = self.body, report.contacts
        com = body.centre_of_mass(positions)
        arms = self.standing - body.centre_of_mass(self.standing)
        turn = kabsch_rotation(body.node_mass, arms, positions - com)
        axes = self.ground.axes
        if axes[2] @ turn @ axes[2] > np.cos(np.radians(_ROLLED)):
            axes = self.moved_to(positions).ground.axes
        normal = self.ground.surface_normal
        under = GroundFrame.on_plane(Plane(normal, -float(normal @ self.ground.origin)), axes[0], com, up=axes[2])
        touching = np.einsum("cw,cwi->ci", contacts.weights, positions[contacts.nodes])
        return replace(self, ground=under, standing=positions.copy(), contact_points=touching)

    def moved_to(self, positions: np.ndarray) -> Stance:
        """The same stance turned about up and moved to where the feet of ``positions`` (N, 3) are."""
        share = sole_shares(self.body, self.ground, self.standing)
        angle = heading_between(self.standing, positions, share, self.ground)
        feet, moved = share @ self.standing, share @ positions
        turn = self.ground.rotation_about_up(angle)
        return replace(
            self,
            ground=GroundFrame(
                self.ground.axes @ turn.T, moved + (self.ground.origin - feet) @ turn.T, self.ground.surface_normal
            ),
            standing=moved + (self.standing - feet) @ turn.T,
            contact_points=moved + (self.contact_points - feet) @ turn.T,
        )

    def surface_height_above(self, point: np.ndarray) -> float:
        """Metres from ``point`` (3,) up to the highest surface over or under it; 0 if there is none."""
        rise = surface_above(self.solids, point, self.ground.axes[2])
        return rise if np.isfinite(rise) else 0.0

    def landing(self, target: JumpTarget) -> JumpTarget:
        """The ``target`` on what is ahead of the feet there, higher or lower, cleared by half of the asked height at
        least. Level over nothing, and before what is higher than the jump, as a wall or a lintel is."""
        feet, up = sole_shares(self.body, self.ground, self.standing) @ self.standing, self.ground.axes[2]
        ahead = surface_above(self.solids, feet + target.distance * self.ground.axes[0], up)
        rise = ahead - surface_above(self.solids, feet, up)
        if not np.isfinite(rise) or rise > target.height:
            return target
        return replace(target, rise=rise, height=max(target.height, rise + 0.5 * target.height))

    def with_forward(self, direction: np.ndarray) -> Stance:
        """The same stance with another way forward (3,); the body is not turned."""
        x, y = self.ground.axes[:2] @ direction
        turn = self.ground.rotation_about_up(float(np.arctan2(y, x)))
        return replace(self, ground=replace(self.ground, axes=self.ground.axes @ turn.T))


class BodyMotion(Protocol):
    """A state machine that ends at rest."""

    @property
    def is_at_rest(self) -> bool:
        """Whether it has come to its end."""
        ...

    @property
    def expected_time(self) -> float:
        """Seconds from its first step until it is at rest."""
        ...

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` seconds that starts at ``state``; ``report`` is of the step before."""
        ...

    def plan_record(self) -> DataclassInstance:
        """What it aims at."""
        ...

    def planned_com(self, elapsed: float) -> np.ndarray | None:
        """(3,) metres from where the centre of mass stood to where it was planned to be ``elapsed`` seconds after the
        motion began, before its first step; NaN where nothing was planned, None if nothing ever is."""
        ...

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> DataclassInstance | None:
        """What it did beside what is measured of all motions; ``first`` and ``last`` are indices into ``time``."""
        ...

    def notes(self) -> list[str]:
        """What kept it from its target, for the user."""
        ...


@dataclass
class MotionRecord:
    """A motion of a sequence and when it began."""

    name: str
    asked: Mapping[str, float]
    motion: BodyMotion
    start_time: float
    fell: str | None = None
    """How it was told that the body fell, where that ended it."""
    got_up: bool = False
    """Whether the body has got up after that."""


@dataclass(frozen=True)
class MotionTask:
    """A motion to come."""

    name: str
    asked: Mapping[str, float]
    begin: Callable[[Stance], BodyMotion]


class MotionSequence:
    """Runs ``parts`` one after the other from ``place``; itself a motion."""

    def __init__(self, place: Stance, parts: Sequence[MotionTask]) -> None:
        self._place = place
        self._parts = list(parts)
        self._count = len(self._parts)
        self.done: list[MotionRecord] = []
        self._dropped = self._rises = False
        """Whether the present motion counts no more, and getting up is next."""

    @property
    def is_finished(self) -> bool:
        """Whether the last motion has come to rest."""
        return not self._parts and self._resting

    @property
    def _resting(self) -> bool:
        return bool(self.done) and (self._dropped or self.done[-1].motion.is_at_rest)

    def start_get_up(self, get_up: MotionTask, why: str) -> None:
        """The body has fallen, as ``why`` tells: what it does ends, and it is to ``get_up`` before it goes on."""
        self.done[-1].fell = why
        self._parts.insert(0, get_up)
        self._dropped = self._rises = True

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``, from the motion whose turn it is."""
        if self._parts and (not self.done or self._resting):
            place = self._place.next_stance(state.positions, report) if self.done else self._place
            if place.base() is SupportKind.ROUND_BASE:
                self._place = place
            part = self._parts.pop(0)
            self._dropped = self._rises = False
            self.done.append(MotionRecord(part.name, part.asked, part.begin(place), state.time))
        return self.done[-1].motion.objectives(state, report, dt)

    def time_left(self, time: float, expected: Sequence[float]) -> float:
        """Seconds from ``time`` until the last motion is at rest; ``expected`` is what each of all takes, seconds."""
        to_come = len(self._parts) - self._rises
        later = sum(expected[len(expected) - to_come :])
        if not self.done or self._resting:
            return later
        past = time - self.done[-1].start_time
        return later + max(self.done[-1].motion.expected_time - past, LATE * past)

    def unfinished_note(self) -> list[str]:
        """What the last frame kept from its end, for the user."""
        if not self.done or self._resting:
            return self.unstarted_note()
        return [f"{self.done[-1].name} was cut off before it came to rest; give more frames", *self.unstarted_note()]

    def unstarted_note(self) -> list[str]:
        """What did not begin, for the user."""
        if not self._parts:
            return []
        names = ", ".join(part.name for part in self._parts)
        return [f"{len(self._parts)} of {self._count} motions did not begin: {names}"]

    def spans(self, time: np.ndarray) -> list[tuple[int, int]]:
        """First and last index into ``time`` (F+1,) of each motion that was begun."""
        return spans_of(self.done, time)


def spans_of(done: Sequence[MotionRecord], time: np.ndarray) -> list[tuple[int, int]]:
    """First and last index into ``time`` (F+1,) of each of the motions ``done``, one after the other to the end."""
    starts = [int(np.searchsorted(time, entry.start_time - 1e-9)) for entry in done]
    return list(zip(starts, [*starts, len(time) - 1][1:], strict=True))
