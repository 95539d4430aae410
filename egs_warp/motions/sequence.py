"""Sequence of motions; each starts from the stance in which the previous one has come to rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from egs_warp.contact.terrain import Surface, surface_above
from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.geometry.camera import FILMED_FROM
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import MotionOutcome, Trajectory, measure
from egs_warp.motions.feet import Foot, SupportKind, find_feet, support_kind_of
from egs_warp.motions.limbs import Limbs
from egs_warp.motions.stance import GroundFrame, heading_between, sole_shares
from egs_warp.motions.style import Style
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.short_repr import short_repr

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_MIN_ROLL_ANGLE = 30.0
"""Tilt of the up axis of a ball, in degrees, above which the ball has rolled; with a smaller tilt, it has only turned
about the up axis."""
REMAINING_TIME_FRACTION = 0.03
"""Estimated remaining time of a motion that takes longer than expected, as a fraction of the elapsed time."""


@dataclass(frozen=True)
class Stance:
    """Stance of a body: its standing pose, upright and at rest, on a ground frame with a forward direction."""

    __repr__ = short_repr

    body: SoftBody
    ground: GroundFrame
    """Ground frame: its origin is under the centre of mass, and its up axis is opposite to gravity."""
    standing: np.ndarray
    """(N, 3) m, positions of the nodes."""
    contact_points: np.ndarray
    """(k, 3) m, points of the body on the ground."""
    step: float
    """Solver time step, s."""
    solids: tuple[Surface, ...] = ()
    """Surfaces that can support the body, including the ground."""
    friction: float = 0.8
    """Coulomb coefficient."""
    limbs: Limbs | None = None
    """Limbs detected in the capture; None uses limbs that are detected in the cage."""
    style: Style = field(default_factory=Style)
    """Style of jumps."""
    muscles: MuscleSet | None = None
    """Muscles of the body; None if their strength is unknown."""
    seen_from: np.ndarray | None = None
    """(3,) Unit vector to the camera of the film; None uses ``FILMED_FROM``."""

    def view(self) -> np.ndarray:
        """Return the unit vector (3,) to the camera of the film, ground axes."""
        if self.seen_from is None:
            return np.array(FILMED_FROM) / np.linalg.norm(FILMED_FROM)
        return self.ground.axes @ self.seen_from

    def feet(self) -> tuple[Foot, ...]:
        """Return the feet of the body, see ``find_feet``."""
        heights = (self.standing - self.ground.origin) @ self.ground.surface_normal
        return find_feet(self.body.mesh, heights, self.body.height, self.limbs)

    def base(self) -> SupportKind:
        """Return the kind of support, computed for the undeformed body in the orientation of the stance."""
        nodes = self.body.mesh.nodes
        turn = self.body.best_fit_rotation(self.standing)
        return support_kind_of(self.body.mesh, nodes @ (turn.T @ self.ground.surface_normal), len(self.feet()))

    def next_stance(self, positions: np.ndarray, report: StepReport | None) -> Stance:
        """Return the stance in which the next motion starts.

        A ball stands on the part of its surface onto which it has rolled.

        Args:
            positions: (N, 3) m, nodes of the body at rest.
            report: report of the previous time step.
        """
        if report is None or report.contacts.count == 0 or self.base() is not SupportKind.ROUND_BASE:
            return self.moved_to(positions)
        body, contacts = self.body, report.contacts
        com = body.centre_of_mass(positions)
        arms = self.standing - body.centre_of_mass(self.standing)
        turn = kabsch_rotation(body.node_mass, arms, positions - com)
        axes = self.ground.axes
        if axes[2] @ turn @ axes[2] > np.cos(np.radians(_MIN_ROLL_ANGLE)):
            axes = self.moved_to(positions).ground.axes
        normal = self.ground.surface_normal
        under = GroundFrame.on_plane(Plane(normal, -float(normal @ self.ground.origin)), axes[0], com, up=axes[2])
        touching = np.einsum("cw,cwi->ci", contacts.weights, positions[contacts.nodes])
        return replace(self, ground=under, standing=positions.copy(), contact_points=touching)

    def moved_to(self, positions: np.ndarray) -> Stance:
        """Return the same stance, rotated about the up axis and moved so that its feet match the feet of a body with
        nodes at ``positions`` (N, 3)."""
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
        """Return the height in metres, relative to ``point`` (3,), of the highest surface on the vertical line through
        it; 0 without a surface."""
        rise = surface_above(self.solids, point, self.ground.axes[2])
        return rise if np.isfinite(rise) else 0.0

    def with_forward(self, direction: np.ndarray) -> Stance:
        """Return the same stance with another forward ``direction`` (3,); the body is not rotated."""
        x, y = self.ground.axes[:2] @ direction
        turn = self.ground.rotation_about_up(float(np.arctan2(y, x)))
        return replace(self, ground=replace(self.ground, axes=self.ground.axes @ turn.T))


class TargetError(UserError):
    """Error for a target that the body cannot reach from its stance at the start of the motion."""


@dataclass(frozen=True)
class JudgedOutcome:
    """Base class of measured results that judge targets in addition to those of ``MotionOutcome``."""

    failures: tuple[str, ...]
    """Description of each missed target, for the report."""


class BodyMotion(Protocol):
    """Motion of a body: a state machine that ends at rest."""

    @property
    def is_at_rest(self) -> bool:
        """True if the motion has ended."""
        ...

    @property
    def expected_time(self) -> float:
        """Expected time in seconds from the first time step until the body is at rest."""
        ...

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the time step of ``dt`` s that starts at ``state``; ``report`` is the report of the
        previous step."""
        ...

    def plan_record(self) -> DataclassInstance:
        """Return the planned quantities of the motion."""
        ...

    def planned_com(self, elapsed: float) -> np.ndarray | None:
        """Return the planned displacement (3,) in metres of the centre of mass ``elapsed`` seconds after the motion
        began, before its first time step; NaN where nothing was planned, None if the motion has no such plan."""
        ...

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> DataclassInstance | None:
        """Return measured quantities that only this motion has, between the states ``first`` and ``last`` of the
        ``trajectory``; None if there are none."""
        ...

    def notes(self) -> list[str]:
        """Return messages for the user about targets that were missed."""
        ...


@dataclass
class MotionRecord:
    """Record of a motion of a sequence that has started."""

    __repr__ = short_repr

    name: str
    asked: Mapping[str, float]
    motion: BodyMotion
    start_time: float
    standing_com: np.ndarray | None = None
    """(3,) m, centre of mass of the standing body at the start, from which a requested height is measured: the body may
    still be low from the landing of the previous motion. None uses the first state."""
    fall_note: str | None = None
    """Description of the fall that ended the motion, or None."""
    got_up: bool = False
    """True if the body has got up after that fall."""

    def measured(self, trajectory: Trajectory, first: int, last: int) -> MotionOutcome:
        """Return the measured outcome between the states ``first`` and ``last`` of the ``trajectory``."""
        standing_com = self.standing_com if "height" in self.asked else None
        return measure(trajectory, first=first, last=last, standing_com=standing_com)


@dataclass(frozen=True)
class MotionTask:
    """Motion of a sequence, which is created only when it starts."""

    name: str
    asked: Mapping[str, float]
    begin: Callable[[Stance], BodyMotion]


class MotionSequence:
    """Sequence that starts from ``stance`` and runs the motions of ``parts`` one after the other."""

    def __init__(self, stance: Stance, parts: Sequence[MotionTask]) -> None:
        self._stance = stance
        self._parts = list(parts)
        self._count = len(self._parts)
        self.done: list[MotionRecord] = []
        self._is_dropped = self._gets_up_next = False
        """Two flags: a fall has ended the current motion; and getting up is the next motion."""

    def __repr__(self) -> str:
        names = ", ".join(record.name for record in self.done) or "none"
        return f"MotionSequence({names}; {len(self._parts)} of {self._count} not started)"

    @property
    def is_finished(self) -> bool:
        """True if the last motion has come to rest."""
        return not self._parts and self._resting

    @property
    def _resting(self) -> bool:
        return bool(self.done) and (self._is_dropped or self.done[-1].motion.is_at_rest)

    def start_get_up(self, get_up: MotionTask, why: str) -> None:
        """End the current motion because the body has fallen; ``why`` describes the fall. The motion ``get_up`` runs
        before the sequence continues."""
        self.done[-1].fall_note = why
        self._parts.insert(0, get_up)
        self._is_dropped = self._gets_up_next = True

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the current motion for the time step of ``dt`` s that starts at ``state``; start the
        next motion if the current one has ended."""
        if self._parts and (not self.done or self._resting):
            self.start_next(state, report)
        return self.done[-1].motion.objectives(state, report, dt)

    def start_next(self, state: BodyState, report: StepReport | None) -> None:
        """Start the next motion at ``state``; ``report`` is the report of the previous step."""
        stance = self._stance.next_stance(state.positions, report) if self.done else self._stance
        if stance.base() is SupportKind.ROUND_BASE:
            self._stance = stance
        part = self._parts.pop(0)
        self._is_dropped = self._gets_up_next = False
        com = stance.body.centre_of_mass(stance.standing)
        self.done.append(MotionRecord(part.name, part.asked, part.begin(stance), state.time, com))

    def time_left(self, time: float, expected: Sequence[float]) -> float:
        """Estimate the time in seconds from ``time`` s until the body is at rest after the last motion; ``expected``
        are the durations of all motions, s."""
        to_come = len(self._parts) - self._gets_up_next
        later = sum(expected[len(expected) - to_come :])
        if not self.done or self._resting:
            return later
        past = time - self.done[-1].start_time
        return later + max(self.done[-1].motion.expected_time - past, REMAINING_TIME_FRACTION * past)

    def unfinished_note(self) -> list[str]:
        """Return messages for the user about motions that did not end or did not start."""
        if not self.done or self._resting:
            return self.unstarted_note()
        return [f"{self.done[-1].name} was cut off before it came to rest; give more frames", *self.unstarted_note()]

    def unstarted_note(self) -> list[str]:
        """Return messages for the user about motions that did not start."""
        if not self._parts:
            return []
        names = ", ".join(part.name for part in self._parts)
        return [f"{len(self._parts)} of {self._count} motions did not begin: {names}"]

    def spans(self, time: np.ndarray) -> list[tuple[int, int]]:
        """Return the first and last index of each started motion in the array ``time`` (F + 1,), s."""
        return spans_of(self.done, time)


def spans_of(done: Sequence[MotionRecord], time: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last index of each motion of ``done`` in the array ``time`` (F + 1,), s. A motion lasts
    until the next one starts."""
    starts = [int(np.searchsorted(time, entry.start_time - 1e-9)) for entry in done]
    return list(zip(starts, [*starts, len(time) - 1][1:], strict=True))
