"""How a walking body is carried: the pose that follows from where its feet and its centre of mass are.

Places of feet are (x, y, z, heading): metres in the frame of the start, radians about up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.motions.feet import Foot, SupportKind, split_base
from egs_warp.motions.gait import GaitTiming
from egs_warp.motions.route import StepLimits
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import SHEAR_BASIS

MAX_STEP_PER_LEG = 0.5
"""Longest pace over the shortest leg's length."""
MAX_SIDE_STEP = 0.5
"""Of its longest pace: how far a body on legs goes to the side, where one leg comes up to the next."""
LARGEST_TURN = float(np.radians(15.0))
"""Of one pace on legs."""
MAX_FOOT_LIFT = 0.03
"""Body heights that a foot is lifted at most."""
LEGGED_TIMING, ROCKING_TIMING = GaitTiming(0.94, 0.78, 0.2, 0.6), GaitTiming(0.94, 0.55, 0.1, 0.75)
"""Gaits at the usual speed; what turns about its sides takes most of a swing for it, and falls to and fro between them
with less of a lean, the less time it stands on both."""
MAX_PIVOT, MAX_ROLL = 0.45, 0.05
"""Radians by which a body on one base turns about one side, and tips to lift the other, at most: faster, it would throw
itself off the side on which it stands."""
COUNTER_ROTATION = 1.5
"""By how much less than its base a body turns for each body height above it, over the turn of the base: the less of it
turns with the base, the less friction it takes."""
MIN_TURNED_INERTIA = 0.2
"""Of the whole moment of inertia: what friction is taken to have to turn, whatever goes the other way."""
MAX_SWING_FACTOR = 1.25
"""Times the usual swing that it may take to turn so far, where friction under one side is not enough in the usual."""
MAX_FRICTION_USE = 1.2
"""Peak of the torque about up that a pivot would take over what friction under the one side gives; it may lag a little
(measured on monkey and pawn)."""
_PEAK = 5.77
"""Largest second derivative of the way from 0 to 1 that a foot is carried in a time of 1."""
MIN_LEG_LENGTH = 0.2
"""Body heights: on shorter legs a body goes as on one base."""
MAX_SEQUENTIAL_FEET = 4
"""Feet from which on the others stand while one swings."""
_SOLE = 0.02
"""Body heights: nodes at most this high are the sole of a base."""
_FURTHEST_LEAN = 0.5
"""Sideways for one up."""


class WalkPosture(Protocol):
    """Gives poses, and how far one pace may go."""

    step_limits: StepLimits
    """The most that a pace may be."""
    lift: float
    """Metres that a foot is lifted."""
    capture_range: float
    """Metres by which a foot may come down off its place to catch the body."""
    timing: GaitTiming
    """How the gait shares out its time at the usual speed."""
    com_weight: float
    """Weight of the motion of the centre of mass: balance."""
    swing_weight: float
    """Weight of the motion of a sole that swings."""
    stance_weight: float
    """Weight of contact points that stand and would slide, each by its share of the weight."""

    def pose(self, com: np.ndarray, heading: float, feet: np.ndarray) -> np.ndarray:
        """(N, 3) nodes of the body with its centre of mass at ``com`` (3,), turned by ``heading`` radians, its feet at
        ``feet`` (F, 4)."""
        ...


class LeggedPosture:
    """Each leg goes with its foot, the rest of the body with the centre of mass."""

    def __init__(self, place: Stance, feet: Sequence[Foot]) -> None:
        """The body stands at ``place``."""
        body, standing = place.body, place.ground.local(place.standing)
        self._start_com = body.centre_of_mass(standing)
        self._arms = standing - self._start_com
        self._legs = np.array([foot.leg for foot in feet])
        self._leg_mass = self._legs @ body.node_mass / body.mass
        self._soles = np.array([self._arms[foot.sole].mean(axis=0) for foot in feet])
        self.step_limits = StepLimits(MAX_STEP_PER_LEG * min(foot.length for foot in feet), LARGEST_TURN, MAX_SIDE_STEP)
        self.lift = MAX_FOOT_LIFT * body.height
        self.capture_range = MAX_STEP_PER_LEG * min(foot.length for foot in feet)
        self.timing = LEGGED_TIMING
        self.com_weight = 60.0
        self.swing_weight = 4.0
        self.stance_weight = 100.0

    def pose(self, com: np.ndarray, heading: float, feet: np.ndarray) -> np.ndarray:
        """See ``Carriage``."""
        turn = Rotation.from_rotvec([0.0, 0.0, heading]).as_matrix()
        stretched = feet[:, :3] - self._soles @ turn.T
        trunk = (com - self._leg_mass @ stretched) / (1.0 - self._leg_mass.sum())
        return self._arms @ turn.T + trunk + self._legs.T @ (stretched - trunk)


class RockingPosture:
    """The two sides of the base turn and tip the body, as one walks a wardrobe; it leans over them, and what is above
    turns the other way, as shoulders do over hips."""

    def __init__(self, place: Stance, feet: Sequence[Foot]) -> None:
        """The body stands at ``place``; the two ``feet``."""
        body, standing = place.body, place.ground.local(place.standing)
        soles = np.array([standing[foot.sole].mean(axis=0) for foot in feet])
        self._arms = standing - soles.mean(axis=0)
        self._com = body.centre_of_mass(self._arms)
        self._share = body.node_mass / body.mass
        self._turning = 1.0 - COUNTER_ROTATION * self._arms[:, 2] / body.height
        """(N,) how far each node turns with the base."""
        self._between = soles[0] - soles[1]
        self._width = float(np.hypot(*self._between[:2]))
        usual = MAX_FRICTION_USE * self._pivot(place, soles, self._inertia(body.node_mass))
        slower = float(np.clip(np.sqrt(MAX_PIVOT / max(usual, 1e-12)), 1.0, MAX_SWING_FACTOR))
        self.timing = replace(ROCKING_TIMING, swing_time=slower * ROCKING_TIMING.swing_time)
        pivot = min(MAX_PIVOT, slower**2 * usual)
        self.step_limits = StepLimits(0.5 * pivot * self._width, 0.5 * pivot)
        self.lift = min(MAX_ROLL * self._width, MAX_FOOT_LIFT * body.height)
        self.capture_range = 0.0
        self.com_weight = 300.0  # where friction gives too little for both, balance goes before turning
        self.swing_weight = (
            2.0  # half of the body swings: faster, it pushes the rest back, and that falls behind its feet
        )
        self.stance_weight = 5.0  # what turns about a patch slides at its edges

    def _inertia(self, node_mass: np.ndarray) -> float:
        """kg m^2, angular momentum about up through the centre of mass for one radian a second of the base."""
        moments = node_mass * ((self._arms - self._com)[:, :2] ** 2).sum(axis=1)
        return float(max(moments @ self._turning, MIN_TURNED_INERTIA * moments.sum()))

    @staticmethod
    def _pivot(place: Stance, soles: np.ndarray, inertia: float) -> float:
        """Radians by which friction under one side turns the body while the other is carried ahead in a usual
        swing."""
        body = place.body
        touching = place.ground.local(place.contact_points)[:, :2]
        away = np.linalg.norm(touching[:, None] - soles[:, :2], axis=2)
        patches = [touching[away.argmin(axis=1) == side] for side in (0, 1)]
        arms = [np.linalg.norm(patch - patch.mean(axis=0), axis=1).mean() for patch in patches if len(patch)]
        gravity = float(np.linalg.norm(body.gravity))
        torque = place.friction * body.mass * gravity * min(map(float, arms), default=0.0)
        time = ROCKING_TIMING.transfer_fraction * ROCKING_TIMING.swing_time * float(np.sqrt(body.height / gravity))
        return torque * time**2 / (_PEAK * inertia)

    def pose(self, com: np.ndarray, heading: float, feet: np.ndarray) -> np.ndarray:
        """See ``Carriage``; the places of the feet turn its base, ``heading`` is that of the body as a whole."""
        middle, between, rest = feet[:, :3].mean(axis=0), feet[0, :3] - feet[1, :3], self._between
        yaw = np.arctan2(between[1], between[0]) - np.arctan2(rest[1], rest[0])
        across = np.array([between[1], -between[0], 0.0]) / np.hypot(*between[:2])
        roll = (between[2] - rest[2]) / self._width
        turn = (Rotation.from_rotvec(roll * across) * Rotation.from_rotvec([0.0, 0.0, yaw])).as_matrix()
        upright = middle + turn @ self._com
        moved = np.stack([(turn @ lean @ self._com)[:2] for lean in SHEAR_BASIS], axis=1)
        lean = np.linalg.solve(moved, (com - upright)[:2])
        lean *= min(1.0, _FURTHEST_LEAN / max(float(np.linalg.norm(lean)), 1e-12))
        strain = np.eye(3) + np.einsum("k,kij->ij", lean, SHEAR_BASIS)
        strain[:, 2] *= 1.0 + (com[2] - upright[2]) / self._com[2]
        leant = self._arms @ strain.T
        centre = self._share @ leant
        # Turned less than the base, about up through the centre of mass, which stays.
        less = (self._turning - 1.0) * (np.remainder(yaw - heading + np.pi, 2.0 * np.pi) - np.pi)
        cos, sin = np.cos(less)[:, None], np.sin(less)[:, None]
        level = (leant - centre)[:, :2]
        leant[:, :2] = cos * level + sin * (level @ [[0.0, 1.0], [-1.0, 0.0]])
        leant[:, :2] += centre[:2] - self._share @ leant[:, :2]
        return middle + leant @ turn.T


def select_posture(place: Stance) -> tuple[tuple[Foot, ...], type[LeggedPosture] | type[RockingPosture]]:
    """The feet on which the body that stands at ``place`` walks, and how these carry it: its own, or the sides of its
    base. No feet at all where it lies or rolls."""
    feet, standing, height = place.feet(), place.ground.local(place.standing), place.body.height
    heights = standing[:, 2] - standing[:, 2].min()
    base = place.base()

    def on_leg(foot: Foot) -> bool:
        # On few feet a swing is a fall that the next footprint catches: a stump wider than long does not reach there.
        return foot.length >= max(
            MIN_LEG_LENGTH * height, _width(standing[foot.sole]) if len(feet) < MAX_SEQUENTIAL_FEET else 0.0
        )

    if base is SupportKind.FEET and all(on_leg(foot) for foot in feet):
        return feet, LeggedPosture
    if base is SupportKind.FEET and len(feet) == 2:
        return feet, RockingPosture
    if base in (SupportKind.LYING, SupportKind.ROUND_BASE):
        return (), RockingPosture
    return split_base(standing[:, :2], heights, np.flatnonzero(heights < _SOLE * height), height), RockingPosture


def _width(sole: np.ndarray) -> float:
    """Metres: side of the square that is as large as the box around a ``sole`` (k, 3)."""
    return float(np.sqrt(np.ptp(sole[:, :2], axis=0).prod()))
