"""Gestures: curves of target values for the head, a branch, or the whole body over its feet.

Times are in sqrt(H / g) from the start of the gesture. See docs/motions/gestures.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.errors import UserError
from egs_warp.locomotion.objectives import BodyPart
from egs_warp.motions.body_parts import FreeBranch, ShapeParts, protruding_part
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.follow import describe_position, head_note, parts_of_body, shape_parts
from egs_warp.motions.keyframes import Channel, Quantity
from egs_warp.motions.sequence import Stance
from egs_warp.motions.swing import LOW_FRACTION, MIN_ANGLE, find_swing

WHOLE_BODY = "body"
"""Name of the part that stands for the whole body. Its position is the position of the centre of mass over the feet.
Only a standing body can follow a gesture of this part."""
TOLERANCES = {"degrees": (3.0, 0.2), "body heights": (0.01, 0.2)}
"""Maximum error of a gesture, by unit; the larger of two values applies: an absolute one, and one relative to the
requested size."""
_BOW_LEAN, _LEAN_LIMITS = 0.6, (0.2, 0.4)
"""Lean of a bowing body relative to the angle of its head, to be reduced by the head's share of the mass; and limits of
the reduced value. The bow of a heavy head already rotates the body as a whole, so the rest of the body leans less."""
_POSE_LEAN, _POSE_HEAD = 8.0, 25.0
"""Angles in degrees by which a body in the pose after a landing leans forward and raises its head."""
_HEAD_TILT = 300.0
"""Tilt of the head in a groove, in degrees per body height of sway."""
_WATCH_ANGLE, _WATCH_PITCH = 12.0, 1.0
"""Angle in degrees by which a sneaking body turns its head to either side, and ratio of the angle by which it lowers
its head to that angle."""
_MAX_HEAD_MASS = 0.6
"""Maximum mass of a head relative to the body mass."""
_SAME_HEIGHT, _SAME_MASS = 0.1, 0.8
"""Maximum difference in height, in body heights, of the roots of two branches that are considered equally high, and
minimum ratio of the masses of two that are considered equally heavy; of such branches, the right one waves."""
_PAIR_MASS_RATIO, _PAIR_COSINE = 0.4, 0.3
"""Conditions under which two branches on different sides that start equally high form a pair, such as arms: minimum
ratio of their masses, because one may hold something, and minimum cosine of the horizontal angle between one of them
and the mirror image of the other."""
_COUNT, _SHORT_TRAVEL = 3, 0.2
"""Default number of swings of a wave, and travel of the tip in body heights below which it swings once more."""
_SWING_TIME, _RAISE_TIME = 0.8, 1.75
"""Time of half a swing by ``MIN_ANGLE``, in sqrt(H / g), and time in which the part is raised, relative to the time of
half a swing."""


@dataclass(frozen=True)
class Gesture:
    """Curves of target values for parts of a body."""

    name: str
    parts: tuple[BodyPart, ...]
    """Part of each channel."""
    channels: tuple[Channel, ...]
    """Curves of orientations in degrees and positions in body heights; times are in seconds from the start of the
    gesture. The outcome compares the measured value of the first channel with its largest target value."""
    quantity: str = "angle"
    """Quantity that the first channel sets, for messages."""
    notes: tuple[str, ...] = ()
    """Notes for the user."""

    @property
    def duration(self) -> float:
        """Time of the last key, s."""
        return max(float(channel.times[-1]) for channel in self.channels)

    @property
    def moves_whole_body(self) -> bool:
        """True if the gesture moves the whole body, for which the body must be standing."""
        return any(part.name == WHOLE_BODY for part in self.parts)


@dataclass(frozen=True)
class GestureOutcome:
    """Requested and measured size of one gesture."""

    name: str
    requested: float
    """Largest target value of the first channel."""
    reached: float
    """Measured size: for each key with the value ``requested``, the maximum around the key; of these, the minimum."""
    quantity: str
    """Name of the quantity of ``requested`` and ``reached``, such as ``angle``."""
    unit: str
    """Unit of ``requested`` and ``reached``: ``degrees`` or ``body heights``."""

    @property
    def text(self) -> str:
        """Reached and requested size, as text for messages."""
        return f"{self.name} {self.quantity} {self.reached:.2g} of {self.requested:.2g} {self.unit}"

    @property
    def is_missed(self) -> bool:
        """True if the measured size differs from the requested size by more than ``TOLERANCES``."""
        absolute, relative = TOLERANCES[self.unit]
        return abs(self.reached - self.requested) > max(absolute, relative * self.requested)


class _Builder:
    """Builder of the curves of one gesture of a body that stands at ``stance``."""

    def __init__(self, name: str, stance: Stance) -> None:
        self.name, self.stance = name, stance
        gravity = float(np.linalg.norm(stance.body.gravity))
        self._time_unit = float(np.sqrt(stance.body.height / gravity))
        self._parts: list[BodyPart] = []
        self._channels: list[Channel] = []
        self.notes: list[str] = []
        """Notes for the user."""

    def add(
        self,
        part: BodyPart,
        quantity: Quantity,
        times: Sequence[float],
        values: Sequence[Sequence[float]],
        *,
        start: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Add a channel through ``values`` at ``times`` (sqrt(H / g)), from ``start`` at time 0."""
        self._parts.append(part)
        self._channels.append(
            Channel(
                part.name,
                quantity,
                self._time_unit * np.array([0.0, *times]),
                np.array([start, *values], dtype=float),
                np.ones(len(times)),
            )
        )

    def turn(self, part: BodyPart, axis: Sequence[float], times: Sequence[float], degrees: Sequence[float]) -> None:
        """Add a channel that rotates ``part`` about ``axis`` (3,) (forward, left, up) by ``degrees`` at ``times``."""
        self.add(part, Quantity.ORIENTATION, times, [tuple(value * x for x in axis) for value in degrees])

    def beats(self, seconds: float) -> float:
        """Return the time of ``seconds`` s in units of sqrt(H / g)."""
        return seconds / self._time_unit

    def gesture(self, quantity: str = "angle") -> Gesture:
        """Return the gesture; its first channel sets ``quantity``."""
        return Gesture(self.name, tuple(self._parts), tuple(self._channels), quantity, tuple(self.notes))

    def head(self, values: Mapping[str, float] | None = None) -> BodyPart:
        """Return the part that moves as the head: the branch with the number ``values["branch"]``, or for 0 the head,
        or the top of the body if the head has most of its mass.

        Raises:
            UserError: for a body that lies along the ground or rolls, or has no branch of this number.
        """
        self.check_upright("no head above the rest")
        body, local = self.stance.body, self.stance.ground.local(self.stance.standing)
        parts = parts_of_body(self.stance)
        number = int((values or {}).get("branch", 0.0))
        if number:
            return _branch_named(self.name, number, {part.name: part for part in parts})
        note = head_note(self.stance, parts)
        self.notes += [] if note is None else [note]
        head = next(part for part in parts if part.name == "head")
        is_head = head.masses.sum() <= _MAX_HEAD_MASS * body.mass
        return head if is_head else BodyPart.head(body, local[:, 2])

    def check_upright(self, missing: str) -> None:
        """Raise ``UserError`` for a body without an upright pose; ``missing`` names the missing part in the message."""
        kind = self.stance.base()
        if kind in (SupportKind.LYING, SupportKind.ROUND_BASE):
            posture = "lies along the ground" if kind is SupportKind.LYING else f"stands on {kind.value}"
            raise UserError(f"{self.name}: the body {posture} and has {missing}; walk or jump")

    def whole(self) -> BodyPart:
        """Return the whole body."""
        return BodyPart.whole(self.stance.body)


def nod(stance: Stance, values: Mapping[str, float]) -> Gesture:
    """Return a nod: the head moves up a little, then forward and down ``count`` times."""
    built, count, size = _Builder("nod", stance), int(values["count"]), values["degrees"]
    times = [0.6, *(1.5 + 1.9 * k + shift for k in range(count) for shift in (0.0, 0.95))]
    degrees = [-0.2 * size, *(factor * size for _ in range(count) for factor in (1.0, -0.1))]
    degrees[-1] = 0.0
    times[-1] += 0.4
    built.turn(built.head(values), (0.0, 1.0, 0.0), times, degrees)
    return built.gesture()


def shake(stance: Stance, values: Mapping[str, float]) -> Gesture:
    """Return a shake of the head: to the left and to the right, ``count`` times."""
    built, count, size = _Builder("shake", stance), int(values["count"]), values["degrees"]
    times = [0.9 + 1.1 * k for k in range(2 * count)]
    degrees = [size * (-1.0) ** k for k in range(2 * count)]
    built.turn(built.head(values), (0.0, 0.0, 1.0), [*times, times[-1] + 1.2], [*degrees, 0.0])
    return built.gesture()


def look_around(stance: Stance, values: Mapping[str, float]) -> Gesture:
    """Return a look to the left and to the right: the head dips in the middle of each turn, and is held at its end."""
    built, size = _Builder("look around", stance), values["degrees"]
    head = built.head(values)
    left, right = np.array([0.0, -0.15, 1.0]) * size, np.array([0.0, -0.15, -1.0]) * size
    dip = np.array([0.0, 0.2, 0.0]) * size
    times = [0.7, 1.6, 3.6, 4.6, 5.6, 7.6, 9.0]
    keys = [0.4 * left + 0.5 * dip, left, left, dip, right, right, np.zeros(3)]
    built.add(head, Quantity.ORIENTATION, times, [tuple(key) for key in keys])
    return built.gesture()


def bow(stance: Stance, values: Mapping[str, float]) -> Gesture:
    """Return a bow: the head leads and the body follows; both rise in the opposite order."""
    built, size = _Builder("bow", stance), values["degrees"]
    head = built.head(values)
    built.turn(head, (0.0, 1.0, 0.0), [0.5, 2.4, 4.6, 7.4], [-0.1 * size, size, size, 0.0])
    lean = size * float(np.clip(_BOW_LEAN - head.masses.sum() / stance.body.mass, *_LEAN_LIMITS))
    built.turn(built.whole(), (0.0, 1.0, 0.0), [0.8, 2.8, 4.4, 6.8], [0.0, lean, lean, 0.0])
    return built.gesture()


def wave(stance: Stance, values: Mapping[str, float]) -> Gesture:
    """Return a wave: a branch of the body, such as an arm, is raised and swings ``count`` times. If the body has no
    branches, the largest part that sticks out of it waves.

    Raises:
        UserError: for a body without such a part, or without a branch of the given number.
    """
    built = _Builder("wave", stance)
    part, branch = _waving_part(stance, int(values["branch"]))
    built.notes += [] if part.name.startswith("branch") else [_note_without_branch(stance, part)]
    swing = find_swing(stance, branch, values["degrees"])
    count = int(values["count"]) or (_COUNT if swing.travel > _SHORT_TRAVEL else _COUNT + 1)
    # The time of a swing grows with its angle, so that the accelerations, and the forces of the muscles, stay equal.
    half = _SWING_TIME * float(np.sqrt(swing.degrees / MIN_ANGLE))
    times = [_RAISE_TIME * half + half * k for k in range(2 * count)]
    degrees = [swing.degrees * (LOW_FRACTION if k % 2 else 1.0) for k in range(2 * count)]
    built.turn(part, swing.axis.tolist(), [*times[:-1], times[-1] + 0.75 * half], [*degrees[:-1], 0.0])
    return built.gesture()


def waving_part_text(stance: Stance) -> str:
    """Return a description of the part that waves if none is given, for the user.

    Raises:
        UserError: for a body without such a part.
    """
    part, _ = _waving_part(stance, 0)
    return part.name if part.name.startswith("branch") else _describe_protruding(stance, part)


def _describe_protruding(stance: Stance, part: BodyPart) -> str:
    local = stance.ground.local(stance.standing[part.nodes]) / stance.body.height
    return f"the part {describe_position(local.mean(axis=0))}"


def _note_without_branch(stance: Stance, part: BodyPart) -> str:
    """Return the note for the user that ``part`` waves, because the body has no branch."""
    return f"the body has no free arm or other branch; {_describe_protruding(stance, part)} waves"


def _waving_part(stance: Stance, number: int) -> tuple[BodyPart, FreeBranch]:
    """Return the part that waves, and its shape: the branch with a ``number``; for 0 the branch that suits best, or, if
    the body has no branches, the largest part that sticks out. Raises ``UserError`` if there is none."""
    body, shape = stance.body, shape_parts(stance)
    names = [f"branch {each}" for each in range(1, len(shape.branches) + 1)]
    if number > len(names):
        raise UserError(_no_branch("wave", number, names))
    index = number - 1 if number else _waving_branch(stance, shape, _branch_directions(stance, shape.branches))
    if names and index is not None:
        return BodyPart.of(body, names[index], shape.branches[index].nodes), shape.branches[index]
    protruding = None if names else protruding_part(body.mesh, stance.ground.surface_normal, shape.head)
    if protruding is not None:
        return BodyPart.of(body, "protruding part", protruding.nodes), protruding
    instead, touching = "use nod, shake, look around, bow or groove", "; parts that touch the trunk do not count"
    if stance.base() in (SupportKind.LYING, SupportKind.ROUND_BASE):
        instead, touching = "walk or jump", ""
    if names:
        raise UserError(
            f"wave: the body has no branch on its trunk, such as an arm or a tail; {instead}, or give branch=1"
        )
    raise UserError(f"wave: the body has no branch that is free, such as an arm, a tail or an ear{touching}; {instead}")


def _branch_named(gesture: str, number: int, parts: Mapping[str, BodyPart]) -> BodyPart:
    """Return the branch with a ``number``. Raises ``UserError`` if the body has none."""
    name = f"branch {number}"
    if name not in parts:
        raise UserError(_no_branch(gesture, number, [each for each in parts if each.startswith("branch")]))
    return parts[name]


def _no_branch(gesture: str, number: int, names: Sequence[str]) -> str:
    others = f"it has {', '.join(names)}" if names else f"it has none, so use {gesture} without branch"
    return f"{gesture}: the body has no branch {number}; {others}"


def _waving_branch(stance: Stance, shape: ShapeParts, directions: np.ndarray) -> int | None:
    """Return the index of the branch that waves: if possible one of a pair, such as arms; of these, one that holds
    nothing, that is, one with a single tip; of these, the highest, lightest and rightmost one, in this order.

    Args:
        stance: stance of the body.
        shape: branches of the body.
        directions: (branches, 3) from the root of each branch to its middle, ground axes.

    Returns:
        The index, or None if no branch is attached to the trunk.
    """
    if not shape.branches:
        return None
    body, local = stance.body, stance.ground.local(stance.standing)
    masses = np.array([body.node_mass[branch.nodes].sum() for branch in shape.branches])
    centres = np.array([local[branch.nodes].mean(axis=0) for branch in shape.branches])
    roots = (centres - directions)[:, 2]
    level = directions[:, :2] / np.maximum(np.linalg.norm(directions[:, :2], axis=1, keepdims=True), 1e-9 * body.height)
    is_pair = np.abs(roots[:, None] - roots) < _SAME_HEIGHT * body.height
    is_pair &= np.minimum(masses, masses[:, None]) > _PAIR_MASS_RATIO * np.maximum(masses, masses[:, None])
    is_pair &= (level[:, 1] * level[:, 1:] < 0.0) & (level * [1.0, -1.0] @ level.T > _PAIR_COSINE)
    chosen = [k for k, branch in enumerate(shape.branches) if branch.is_on_trunk]
    if not chosen:
        return None
    ranks = [(not is_pair[k, chosen].any(), shape.branches[k].tip_count > 1) for k in chosen]
    chosen = [k for k, rank in zip(chosen, ranks, strict=True) if rank == min(ranks)]
    chosen = [k for k in chosen if roots[k] > roots[chosen].max() - _SAME_HEIGHT * body.height]
    return min((k for k in chosen if _SAME_MASS * masses[k] < masses[chosen].min()), key=lambda k: centres[k, 1])


def _branch_directions(stance: Stance, branches: Sequence[FreeBranch]) -> np.ndarray:
    """Return the vectors (branches, 3) in metres from the root of each branch to its middle, ground axes."""
    nodes = stance.body.mesh.nodes
    turn = stance.ground.axes @ stance.body.best_fit_rotation(stance.standing)
    offsets = [nodes[branch.nodes].mean(axis=0) - branch.root for branch in branches]
    return np.reshape(offsets, (-1, 3)) @ turn.T


def groove(stance: Stance, values: Mapping[str, float]) -> Gesture:
    """Return a dance on the spot that ends in its initial pose.

    The body sways from side to side on the beats and dips between them, and the head tilts in the opposite direction.
    """
    built, count, sway = _Builder("groove", stance), int(values["beats"]), values["sway"]
    built.check_upright("no feet to sway over")
    beat = built.beats(60.0 / values["tempo"])
    sides = [0.0 if k + 1 == count else (-1.0) ** k for k in range(count)]
    times, positions, tilts = [], [], []
    before = 0.0
    for k, side in enumerate(sides):
        times += [(k + 0.5) * beat, (k + 1.0) * beat]
        positions += [(0.0, 0.5 * (before + side) * sway, -0.9 * sway), (0.0, side * sway, 0.0)]
        tilts += [0.5 * (before + side), side]
        before = side
    built.add(built.whole(), Quantity.POSITION, times, positions)
    late = [time + 0.15 * beat for time in times]
    built.turn(built.head(), (1.0, 0.0, 0.0), late, [_HEAD_TILT * sway * tilt for tilt in tilts])
    return built.gesture("sway")


def watch(stance: Stance, seconds: float) -> Gesture:
    """Return the gesture of a body that sneaks for ``seconds``: it turns its lowered head to both sides."""
    built = _Builder("head turn", stance)
    length = built.beats(seconds)
    low, left, right = (np.array([0.0, _WATCH_PITCH, side]) for side in (0.0, 1.0, -1.0))
    times = [0.12, 0.24, 0.4, 0.55, 0.72, 0.85, 1.0]
    keys = [low, left, left, right, right, low, np.zeros(3)]
    size = _WATCH_ANGLE / float(np.linalg.norm(left))
    built.add(
        built.head(), Quantity.ORIENTATION, [length * time for time in times], [tuple(size * key) for key in keys]
    )
    return built.gesture()


def landed_pose(stance: Stance, depth: float, seconds: float) -> Gesture:
    """Return the gesture after a landing in a crouch of ``depth`` metres: the body holds the crouch for ``seconds``,
    raises its head, and then stands up."""
    built = _Builder("pose", stance)
    low = (0.0, 0.0, -depth / stance.body.height)
    hold = max(built.beats(seconds), 1.0)
    built.add(built.whole(), Quantity.POSITION, [hold, hold + 2.5], [low, (0.0, 0.0, 0.0)], start=low)
    raised, lowered = min(1.2, 0.5 * hold), hold + 2.0
    built.turn(built.whole(), (0.0, 1.0, 0.0), [raised, hold, hold + 2.5], [_POSE_LEAN, _POSE_LEAN, 0.0])
    built.turn(built.head(), (0.0, 1.0, 0.0), [raised, hold, lowered], [-_POSE_HEAD, -_POSE_HEAD, 0.0])
    return built.gesture("depth")
