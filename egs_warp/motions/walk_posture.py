"""Posture of a walking body: its pose as a function of its footholds and its centre of mass.

Footholds are (x, y, z, heading): metres in the ground frame of the start, radians about the up axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.motions.balance import SHEAR_BASIS
from egs_warp.motions.feet import Foot, SupportKind, order_counterclockwise, split_base
from egs_warp.motions.gait import GaitTiming
from egs_warp.motions.route import StepLimits
from egs_warp.motions.sequence import Stance

MAX_STEP_PER_LEG = 0.5
"""Maximum step length relative to the length of the shortest leg."""
MAX_SIDE_STEP = 0.5
"""Maximum length of a sideways step of a body on legs relative to a forward step; with a longer step, a leg could
overtake the next one."""
MAX_TURN = float(np.radians(15.0))
"""Maximum turn of one step on legs, radians."""
MAX_FOOT_LIFT = 0.03
"""Largest lift of a foot, in body heights."""
LEGGED_TIMING, ROCKING_TIMING = GaitTiming(0.94, 0.78, 0.2, 0.6), GaitTiming(0.94, 0.55, 0.1, 0.75)
"""Gait timing at nominal speed, on legs and on a single base. On a single base, the body pivots during most of a swing.
The shorter the double support, the less the body sways between its sides."""
MAX_PIVOT, MAX_ROLL = 0.45, 0.05
"""Maximum angles in radians by which a body on a single base pivots about one side, and tips to lift the other side.
With larger angles, it would lose its balance on the standing side."""
COUNTER_ROTATION = 1.5
"""Decrease of the rotation of a node per body height above the base, relative to the rotation of the base. If less of
the body rotates with the base, the pivot needs less friction."""
MIN_TURNED_INERTIA = 0.2
"""Minimum fraction of the moment of inertia that friction is assumed to rotate in spite of the counter-rotation of the
upper body."""
MAX_SWING_FACTOR = 1.25
"""Maximum factor on the swing time, which is increased if friction under one side cannot complete a pivot in the
nominal time."""
MAX_FRICTION_USE = 1.2
"""Maximum peak torque of a pivot about the up axis, relative to the friction torque under one side. Above 1, the side
slips a little (measured for monkey and pawn)."""
_MAX_CURVATURE = 5.77
"""Maximum second derivative of ``smooth``, which is the path of a foot from 0 to 1 in unit time."""
MIN_LEG_LENGTH = 0.2
"""Minimum length of legs, in body heights, for walking on them; with shorter legs, a body moves as on a single base."""
MAX_SEQUENTIAL_FEET = 4
"""Minimum number of feet at which a body is balanced during a swing, so that short legs suffice."""
_SOLE_HEIGHT = 0.02
"""Height in body heights up to which nodes of a base form its sole."""
_MAX_LEAN = 0.5
"""Largest lean: horizontal displacement per height."""


class WalkPosture(Protocol):
    """Posture of a walking body: target poses, limits of a step, timing and weights."""

    step_limits: StepLimits
    """Maximum changes of the planar pose in one step."""
    lift: float
    """Lift of a foot, m."""
    capture_range: float
    """Maximum distance of a landing foot from its nominal foothold to catch the body, m."""
    timing: GaitTiming
    """Timing of the gait at nominal speed."""
    swing_weight: float
    """Weight of the velocity of a swinging sole."""
    stance_weight: float
    """Weight of zero slip at standing contact points; each point is scaled by its share of the load.
    ``WalkControl.slip`` is the weight of the mean slip of a foot."""

    def pose(self, com: np.ndarray, heading: float, feet: np.ndarray) -> np.ndarray:
        """Return the target nodes (N, 3), ground coordinates.

        Args:
            com: (3,) m, centre of mass.
            heading: heading of the body, radians.
            feet: (F, 4) footholds.
        """
        ...


class LeggedPosture:
    """Posture on legs: each leg moves with its foot, and the rest of the body moves with the centre of mass."""

    def __init__(self, stance: Stance, feet: Sequence[Foot]) -> None:
        """Create the posture of the body that stands at ``stance``."""
        body, standing = stance.body, stance.ground.local(stance.standing)
        self._start_com = body.centre_of_mass(standing)
        self._arms = standing - self._start_com
        self._legs = np.array([foot.leg for foot in feet])
        self._leg_mass = self._legs @ body.node_mass / body.mass
        self._soles = np.array([self._arms[foot.sole].mean(axis=0) for foot in feet])
        self.step_limits = StepLimits(MAX_STEP_PER_LEG * min(foot.length for foot in feet), MAX_TURN, MAX_SIDE_STEP)
        self.lift = MAX_FOOT_LIFT * body.height
        self.capture_range = MAX_STEP_PER_LEG * min(foot.length for foot in feet)
        self.timing = LEGGED_TIMING
        self.swing_weight = 4.0
        self.stance_weight = 100.0

    def pose(self, com: np.ndarray, heading: float, feet: np.ndarray) -> np.ndarray:
        """Return the target nodes (N, 3); see ``WalkPosture.pose``."""
        turn = Rotation.from_rotvec([0.0, 0.0, heading]).as_matrix()
        stretched = feet[:, :3] - self._soles @ turn.T
        trunk = (com - self._leg_mass @ stretched) / (1.0 - self._leg_mass.sum())
        return self._arms @ turn.T + trunk + self._legs.T @ (stretched - trunk)


class RockingPosture:
    """Posture on a single base: the body alternately tips and pivots on its two sides, like a wardrobe that is walked
    across a floor. It leans over the standing side, and its upper part rotates against the base, like shoulders against
    hips."""

    def __init__(self, stance: Stance, feet: Sequence[Foot]) -> None:
        """Create the posture of the body that stands at ``stance``; ``feet`` are the two sides of its base."""
        body, standing = stance.body, stance.ground.local(stance.standing)
        soles = np.array([standing[foot.sole].mean(axis=0) for foot in feet])
        self._arms = standing - soles.mean(axis=0)
        self._com = body.centre_of_mass(self._arms)
        self._share = body.node_mass / body.mass
        self._turning = 1.0 - COUNTER_ROTATION * self._arms[:, 2] / body.height
        """(N,) ratio of the rotation of each node to the rotation of the base."""
        self._between = soles[0] - soles[1]
        self._width = float(np.hypot(*self._between[:2]))
        usual = MAX_FRICTION_USE * self._pivot(stance, soles, self._inertia(body.node_mass))
        slower = float(np.clip(np.sqrt(MAX_PIVOT / max(usual, 1e-12)), 1.0, MAX_SWING_FACTOR))
        self.timing = replace(ROCKING_TIMING, swing_time=slower * ROCKING_TIMING.swing_time)
        pivot = min(MAX_PIVOT, slower**2 * usual)
        self.step_limits = StepLimits(0.5 * pivot * self._width, 0.5 * pivot)
        self.lift = min(MAX_ROLL * self._width, MAX_FOOT_LIFT * body.height)
        self.capture_range = 0.0
        self.swing_weight = 2.0  # Half of the body swings; a faster swing would push the rest back, behind its feet.
        self.stance_weight = 1.0  # A contact patch that rotates on the ground slides at its edges.

    def _inertia(self, node_mass: np.ndarray) -> float:
        """Return the angular momentum about the up axis through the centre of mass per rotation rate of the base, kg
        m^2."""
        moments = node_mass * ((self._arms - self._com)[:, :2] ** 2).sum(axis=1)
        return float(max(moments @ self._turning, MIN_TURNED_INERTIA * moments.sum()))

    @staticmethod
    def _pivot(stance: Stance, soles: np.ndarray, inertia: float) -> float:
        """Return the angle in radians by which friction under one side can rotate the body in a nominal swing of the
        other side."""
        body = stance.body
        touching = stance.ground.local(stance.contact_points)[:, :2]
        away = np.linalg.norm(touching[:, None] - soles[:, :2], axis=2)
        patches = [touching[away.argmin(axis=1) == side] for side in (0, 1)]
        arms = [np.linalg.norm(patch - patch.mean(axis=0), axis=1).mean() for patch in patches if len(patch)]
        gravity = float(np.linalg.norm(body.gravity))
        torque = stance.friction * body.mass * gravity * min(map(float, arms), default=0.0)
        time = ROCKING_TIMING.transfer_fraction * ROCKING_TIMING.swing_time * float(np.sqrt(body.height / gravity))
        return torque * time**2 / (_MAX_CURVATURE * inertia)

    def pose(self, com: np.ndarray, heading: float, feet: np.ndarray) -> np.ndarray:
        """Return the target nodes (N, 3); see ``WalkPosture.pose``. The footholds define the rotation of the base, and
        ``heading`` the rotation of the whole body."""
        middle, between, rest = feet[:, :3].mean(axis=0), feet[0, :3] - feet[1, :3], self._between
        yaw = np.arctan2(between[1], between[0]) - np.arctan2(rest[1], rest[0])
        across = np.array([between[1], -between[0], 0.0]) / np.hypot(*between[:2])
        roll = (between[2] - rest[2]) / self._width
        turn = (Rotation.from_rotvec(roll * across) * Rotation.from_rotvec([0.0, 0.0, yaw])).as_matrix()
        upright = middle + turn @ self._com
        moved = np.stack([(turn @ lean @ self._com)[:2] for lean in SHEAR_BASIS], axis=1)
        lean = np.linalg.solve(moved, (com - upright)[:2])
        lean *= min(1.0, _MAX_LEAN / max(float(np.linalg.norm(lean)), 1e-12))
        strain = np.eye(3) + np.einsum("k,kij->ij", lean, SHEAR_BASIS)
        strain[:, 2] *= 1.0 + (com[2] - upright[2]) / self._com[2]
        leant = self._arms @ strain.T
        centre = self._share @ leant
        # Rotate the upper body less than the base, about the up axis through the centre of mass, which does not move.
        less = (self._turning - 1.0) * (np.remainder(yaw - heading + np.pi, 2.0 * np.pi) - np.pi)
        cos, sin = np.cos(less)[:, None], np.sin(less)[:, None]
        level = (leant - centre)[:, :2]
        leant[:, :2] = cos * level + sin * (level @ [[0.0, 1.0], [-1.0, 0.0]])
        leant[:, :2] += centre[:2] - self._share @ leant[:, :2]
        return middle + leant @ turn.T


def select_posture(stance: Stance) -> tuple[tuple[Foot, ...], type[LeggedPosture] | type[RockingPosture]]:
    """Return the feet on which a body walks, which are its own feet or the two sides of its base, and the class of its
    posture. There are no feet if the body lies or rolls."""
    feet, standing, height = stance.feet(), stance.ground.local(stance.standing), stance.body.height
    base = stance.base()
    if base is SupportKind.FEET and not _missing_leg_lengths(stance):
        return feet, LeggedPosture
    if base is SupportKind.FEET and len(feet) == 2:
        return feet, RockingPosture
    if base in (SupportKind.LYING, SupportKind.ROUND_BASE):
        return (), RockingPosture
    heights = standing[:, 2] - standing[:, 2].min()
    return split_base(standing[:, :2], heights, np.flatnonzero(heights < _SOLE_HEIGHT * height), height), RockingPosture


def walking_feet(stance: Stance) -> tuple[tuple[Foot, ...], type[LeggedPosture] | type[RockingPosture]]:
    """Return the result of ``select_posture`` with the feet numbered counterclockwise, in which they swing in turn."""
    feet, posture = select_posture(stance)
    if not feet:
        return feet, posture
    standing = stance.ground.local(stance.standing)
    order = order_counterclockwise(np.array([standing[foot.sole, :2].mean(axis=0) for foot in feet]))
    return tuple(feet[k] for k in order), posture


def rocking_reason(stance: Stance) -> str:
    """Return the reason why the body at ``stance`` rocks on the sides of its base instead of swinging its legs."""
    if stance.base() is not SupportKind.FEET:
        return "it stands on one base, without separate legs"
    length, needed = max(_missing_leg_lengths(stance), key=lambda pair: pair[1] - pair[0])
    unit = stance.body.height
    return f"a leg is {length / unit:.2f} body heights long; to swing, it would have to be at least {needed / unit:.2f}"


def _missing_leg_lengths(stance: Stance) -> list[tuple[float, float]]:
    """Return the length and the required length in metres of each leg that is too short to swing.

    A body on few feet falls during a swing until the swinging foot lands. For such a body, a leg that is shorter than
    its sole is wide is also too short.
    """
    feet, standing = stance.feet(), stance.ground.local(stance.standing)
    few = len(feet) < MAX_SEQUENTIAL_FEET
    required = [
        (foot.length, max(MIN_LEG_LENGTH * stance.body.height, _width(standing[foot.sole]) if few else 0.0))
        for foot in feet
    ]
    return [(length, needed) for length, needed in required if length < needed]


def _width(sole: np.ndarray) -> float:
    """Return the side in metres of the square with the area of the bounding box of a ``sole`` (k, 3)."""
    return float(np.sqrt(np.ptp(sole[:, :2], axis=0).prod()))
