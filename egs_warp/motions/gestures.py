"""Gestures: curves of target values for the head, a branch, or the whole body over its feet.

Times are in sqrt(H / g) from the start of the gesture. See docs/motions/gestures.md.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.locomotion.objectives import BodyPart
from egs_warp.meshing.protrusions import find_protrusions
from egs_warp.motions.body_parts import FreeBranch, ShapeParts, protruding_part, root_of
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.follow import describe_position, head_note, parts_of_body, shape_parts
from egs_warp.motions.keyframes import Channel, Quantity
from egs_warp.motions.sequence import Stance
from egs_warp.motions.swing import MIN_SWING, TRAVEL, Swing, find_swing

WHOLE_BODY = "body"
"""Name of the part that stands for the whole body. Its position is the position of the centre of mass over the feet.
Only a standing body can follow a gesture of this part."""
TOLERANCES = {"degrees": (3.0, 0.2), "body heights": (0.01, 0.2)}
"""Maximum error of a gesture, by unit; the larger of two values applies: an absolute one, and one relative to the
requested size."""
_BOW_LEAN, _LEAN_LIMITS = 0.6, (0.2, 0.4)
"""Lean of a bowing body relative to the angle of its head, to be reduced by the head's share of the mass; and limits of
the reduced value. The bow of a heavy head already rotates the body as a whole, so the rest of the body leans less."""
_NOD_TRAVEL, _NOD_ANGLES = 0.1, (20.0, 40.0)
"""Travel of the middle of the head in the picture of the film, body heights, and limits, in degrees, of the angle of a
nod that is computed from it."""
_MIN_NOD = 2.0
"""Minimum angle of a nod in degrees."""
_NOD_LEAN, _NOD_DIP = 15.0, 0.08
"""Lean in degrees and dip in body heights of a body whose head does not travel at all in a nod; with a travel up to
``_NOD_TRAVEL``, they are smaller in proportion."""
_NECK_SHARE = 0.25
"""Fraction of the nodes of a head, the lowest, whose mean is its joint."""
_MIN_MISSING = 0.1
"""Missing fraction of the travel of a part below which the body does not follow it."""
_ROCKING = 10.0
"""Angle in degrees by which a body rocks with a wave whose tip does not travel at all; with a travel up to ``TRAVEL``,
it is smaller in proportion."""
_HEAD_TILT = 300.0
"""Tilt of the head in a groove, in degrees per body height of sway."""
_WATCH_ANGLE, _WATCH_PITCH = 12.0, 1.0
"""Angle in degrees by which a sneaking body turns its head to either side, and ratio of the angle by which it lowers
its head to that angle."""
_MAX_HEAD_MASS = 0.6
"""Maximum mass of a head relative to the body mass."""
_MIN_COMMON = 0.9
"""Minimum fraction of the nodes of a branch that lie in a part that sticks out, for both to be the same limb."""
_MIN_BELOW = 0.02
"""Minimum height of a shoulder above the tip of a waving part, body heights, that is reported."""
_SAME_HEIGHT, _SAME_MASS = 0.1, 0.8
"""Maximum difference in height, in body heights, of the roots of two branches that are considered equally high, and
minimum ratio of the masses of two that are considered equally heavy; of such branches, the right one waves."""
_PAIR_MASS_RATIO, _PAIR_COSINE = 0.4, 0.3
"""Conditions under which two branches on different sides that start equally high form a pair, such as arms: minimum
ratio of their masses, because one may hold something, and minimum cosine of the horizontal angle between one of them
and the mirror image of the other."""
_COUNT, _SHORT_TRAVEL = 3, 0.2
"""Default number of swings of a wave, and travel of the tip in body heights below which it swings once more."""
_SWING_TIME, _RAISE_FRACTION = 0.8, 1.5
"""Time of half a swing by ``MIN_SWING``, in sqrt(H / g), and time in which the part is raised or lowered, relative to
the time of half a swing by the same angle."""


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
    body_follows: bool = False
    """True if the whole body only follows the first part. On top of another motion, it does not."""

    @property
    def duration(self) -> float:
        """Time of the last key, s."""
        return max(float(channel.times[-1]) for channel in self.channels)

    @property
    def moves_whole_body(self) -> bool:
        """True if the gesture moves the whole body."""
        return any(part.name == WHOLE_BODY for part in self.parts)

    def without(self, names: Collection[str]) -> Gesture:
        """Return the gesture without the channels of the parts with these ``names``."""
        kept = [k for k, part in enumerate(self.parts) if part.name not in names]
        return replace(self, parts=tuple(self.parts[k] for k in kept), channels=tuple(self.channels[k] for k in kept))


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


class GestureBuilder:
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

    @property
    def has_steady_base(self) -> bool:
        """True if the whole body can follow a gesture of a part. On feet it may fall, as a thin figure does."""
        return self.stance.base() not in (SupportKind.LYING, SupportKind.ROUND_BASE, SupportKind.FEET)

    @property
    def is_filled(self) -> bool:
        """True if the gesture has a channel."""
        return bool(self._channels)

    def beats(self, seconds: float) -> float:
        """Return the time of ``seconds`` s in units of sqrt(H / g)."""
        return seconds / self._time_unit

    def gesture(self, quantity: str = "angle", *, body_follows: bool = False) -> Gesture:
        """Return the gesture; its first channel sets ``quantity``."""
        parts, curves = tuple(self._parts), tuple(self._channels)
        return Gesture(self.name, parts, curves, quantity, tuple(self.notes), body_follows)

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
    """Return a nod: the head moves up a little, then forward and down ``count`` times. A head that is so small that
    this is hardly visible takes the body with it, which leans and dips.

    Raises:
        UserError: for an angle below ``_MIN_NOD`` other than 0, which selects a visible one.
    """
    built, count = GestureBuilder("nod", stance), int(values["count"])
    if 0.0 < values["degrees"] < _MIN_NOD:
        raise UserError(
            f"nod: degrees {values['degrees']:g}: give {_MIN_NOD:g} or more, or 0 for an angle that the film shows"
        )
    head = built.head(values)
    size = values["degrees"] or _visible_nod(stance, head)
    # The time grows with the angle, so that the accelerations, and the forces of the muscles, stay equal.
    half = 0.95 * float(np.sqrt(size / _NOD_ANGLES[0]))
    times = [0.6, *(0.55 + half * (2 * k + 1 + down) for k in range(count) for down in (0, 1))]
    degrees = [-0.2 * size, *(factor * size for _ in range(count) for factor in (1.0, -0.1))]
    degrees[-1] = 0.0
    times[-1] += 0.4
    built.turn(head, (0.0, 1.0, 0.0), times, degrees)
    missing = 1.0 - _nod_travel(stance, head, size) / _NOD_TRAVEL
    if missing > _MIN_MISSING and not values.get("branch") and built.has_steady_base:
        late, share = [time + 0.1 for time in times], missing * np.array(degrees) / size
        built.turn(built.whole(), (0.0, 1.0, 0.0), late, (_NOD_LEAN * share).tolist())
        dips = np.minimum(-_NOD_DIP * share, 0.0)
        built.add(built.whole(), Quantity.POSITION, late, [(0.0, 0.0, dip) for dip in dips.tolist()])
    return built.gesture(body_follows=True)


def _visible_nod(stance: Stance, head: BodyPart) -> float:
    """Return the smallest angle in degrees within ``_NOD_ANGLES`` with which a nod travels ``_NOD_TRAVEL`` in the
    picture, or the largest one."""
    angles = np.arange(_NOD_ANGLES[0], _NOD_ANGLES[1] + 1.0)
    return float(next((size for size in angles if _nod_travel(stance, head, size) >= _NOD_TRAVEL), angles[-1]))


def _nod_travel(stance: Stance, head: BodyPart, degrees: float) -> float:
    """Return the displacement in the picture of the film of the middle of the ``head``, body heights, if it rotates
    forward by ``degrees`` about its lower end. The nodes on its rear edge move farther, but inside its outline."""
    local, view = stance.ground.local(stance.standing) / stance.body.height, stance.view()
    heights = local[head.nodes, 2]
    joint = local[head.nodes][heights <= np.quantile(heights, _NECK_SHARE)].mean(axis=0)
    offset = head.centre(local) - joint
    moved = Rotation.from_rotvec([0.0, degrees, 0.0], degrees=True).apply(offset) - offset
    return float(np.linalg.norm(moved - (moved @ view) * view))


def shake(stance: Stance, values: Mapping[str, float]) -> Gesture:
    """Return a shake of the head: to the left and to the right, ``count`` times."""
    built, count, size = GestureBuilder("shake", stance), int(values["count"]), values["degrees"]
    times = [0.9 + 1.1 * k for k in range(2 * count)]
    degrees = [size * (-1.0) ** k for k in range(2 * count)]
    built.turn(built.head(values), (0.0, 0.0, 1.0), [*times, times[-1] + 1.2], [*degrees, 0.0])
    return built.gesture()


def look_around(stance: Stance, values: Mapping[str, float]) -> Gesture:
    """Return a look to the left and to the right: the head dips in the middle of each turn, and is held at its end."""
    built, size = GestureBuilder("look around", stance), values["degrees"]
    head = built.head(values)
    left, right = np.array([0.0, -0.15, 1.0]) * size, np.array([0.0, -0.15, -1.0]) * size
    dip = np.array([0.0, 0.2, 0.0]) * size
    times = [0.7, 1.6, 3.6, 4.6, 5.6, 7.6, 9.0]
    keys = [0.4 * left + 0.5 * dip, left, left, dip, right, right, np.zeros(3)]
    built.add(head, Quantity.ORIENTATION, times, [tuple(key) for key in keys])
    return built.gesture()


def bow(stance: Stance, values: Mapping[str, float]) -> Gesture:
    """Return a bow: the head leads and the body follows; both rise in the opposite order."""
    built, size = GestureBuilder("bow", stance), values["degrees"]
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
    built = GestureBuilder("wave", stance)
    part, branch = _waving_part(stance, int(values["branch"]))
    swing = find_swing(stance, branch, values["degrees"])
    is_branch = part.name.startswith("branch")
    note = _low_wave_note(stance, branch, swing) if is_branch else _note_without_branch(stance, part)
    built.notes += [] if note is None else [note]
    count = int(values["count"]) or (_COUNT if swing.travel > _SHORT_TRAVEL else _COUNT + 1)
    # The time of a swing grows with its angle, so that the accelerations, and the forces of the muscles, stay equal.
    half, raising = swing_time(swing.degrees - swing.low), raise_time(swing)
    times = [raising + half * k for k in range(2 * count)]
    degrees = [swing.low if k % 2 else swing.degrees for k in range(2 * count)]
    times[-1] = times[-2] + raising
    built.turn(part, swing.axis.tolist(), times, [*degrees[:-1], 0.0])
    missing = 1.0 - swing.travel / TRAVEL
    if missing > _MIN_MISSING and built.has_steady_base:
        _rock(built, times, _ROCKING * missing)
    return built.gesture(body_follows=True)


def swing_time(degrees: float) -> float:
    """Return the time of half a swing by an angle, in sqrt(H / g)."""
    return _SWING_TIME * float(np.sqrt(degrees / MIN_SWING))


def raise_time(swing: Swing) -> float:
    """Return the time in which a part is raised to the upper end of a ``swing``, in sqrt(H / g)."""
    return _RAISE_FRACTION * swing_time(swing.degrees)


def _rock(built: GestureBuilder, times: Sequence[float], degrees: float) -> None:
    """Add a channel that rocks the whole body to alternate sides in the picture of the film by ``degrees`` at all
    ``times`` but the last."""
    view = built.stance.view()
    level = np.array([view[0], view[1], 0.0]) / np.hypot(view[0], view[1])
    sides = [degrees * (-1.0) ** k for k in range(len(times) - 1)]
    built.turn(built.whole(), level.tolist(), times, [*sides, 0.0])


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


def _low_wave_note(stance: Stance, branch: FreeBranch, swing: Swing) -> str | None:
    """Return a note for the user if a waving ``branch`` stays below the joint of its limb with the trunk; None if it
    rises above it. The branch may begin at the elbow, where an arm leaves the outline of the trunk; the part that
    sticks out there begins at the shoulder."""
    mesh, height = stance.body.mesh, stance.body.height
    parts = find_protrusions(mesh, stance.ground.surface_normal)
    limbs = [part.nodes for part in parts if np.isin(branch.nodes, part.nodes).mean() >= _MIN_COMMON]
    roots = [branch.root, *(root_of(mesh, nodes) for nodes in limbs)]
    turn = stance.ground.axes @ stance.body.best_fit_rotation(stance.standing)
    shoulder = max(float((turn @ root)[2]) for root in roots)
    below = (shoulder - float((turn @ swing.joint)[2])) / height - swing.rise
    if below < _MIN_BELOW:
        return None
    return f"the waving part stays low: its tip reaches {below:.2f} body heights below the joint of the limb"


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
    built, count, sway = GestureBuilder("groove", stance), int(values["beats"]), values["sway"]
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
    built = GestureBuilder("head turn", stance)
    length = built.beats(seconds)
    low, left, right = (np.array([0.0, _WATCH_PITCH, side]) for side in (0.0, 1.0, -1.0))
    times = [0.12, 0.24, 0.4, 0.55, 0.72, 0.85, 1.0]
    keys = [low, left, left, right, right, low, np.zeros(3)]
    size = _WATCH_ANGLE / float(np.linalg.norm(left))
    built.add(
        built.head(), Quantity.ORIENTATION, [length * time for time in times], [tuple(size * key) for key in keys]
    )
    return built.gesture()
