"""Somersault: a jump in which the body turns over once, backward or forward (docs/concepts/motions.md)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from egs_warp.contact.terrain import Solid, surface_above
from egs_warp.geometry.frames import dots
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.airborne_soles import AirborneSoles
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.flip_worlds import LANDING_ANGLE, TUCK_INERTIA, WHOLE_TURN, FlipWorlds, angle_about_left
from egs_warp.motions.jump import AIRBORNE_POSE_WEIGHT, Jump
from egs_warp.motions.jump_plan import JumpPlan, JumpTarget
from egs_warp.motions.jump_worlds import JumpWorlds
from egs_warp.motions.request import MAX_TARGET
from egs_warp.motions.sequence import JudgedOutcome, Stance, TargetError

LEAN_FRACTION = 0.35
"""Displacement of the centre of mass during the crouch in the direction of travel, as a fraction of the distance to
that edge of the feet. The ground force acts at the opposite edge, so its lever arm becomes longer."""
DISTANCE = 0.15
"""Requested displacement of the feet in body heights. The body travels further, because it turns about its feet while
they are on the ground; more speed in the direction of travel would reduce the angular momentum."""
MAX_LEVER_FRACTION = 0.47
"""Largest mean lever arm of the ground force in a thrust, as a fraction of the distance from the displaced centre of
mass to the edge of the feet behind it. A figurine reaches 0.46; with 0.49, a pawn turns too slowly."""
MIN_FOOT_LENGTH = 0.3
"""Smallest length of the feet in the direction of travel, body heights. The rotation at touch-down differs by 14 to 38
degrees from a whole turn, which displaces the feet from under the capture point by 0.11 to 0.3 body heights. A robot,
whose feet are 0.16 body heights long, fell from a height of 1.4."""
_HEIGHT_STEP = 0.05
"""Step of the search for the smallest possible height, body heights."""
MAX_RISE = 0.03
"""Largest difference in height between the start and the ground ahead, body heights."""
MAX_TRAVEL = 2.0
"""Distance in the direction of travel up to which the ground must be level, body heights. The body travels 0.5 to 1.9
body heights, and the distance is not controlled."""
_GROUND_STEP, _GROUND_LINES = 0.05, 5
"""Points at which the ground is tested: distance between them in the direction of travel, body heights, and number of
lines over the width of the base."""
MAX_ROTATION_ERROR = 8.0
"""Largest error of the rotation of a somersault, degrees."""

MAX_LANDING_ERROR = 25.0
"""Error of the rotation at touch-down, degrees, above which a message states it."""


@dataclass(frozen=True)
class FlipPlan(JumpPlan):
    """Planned quantities of a somersault."""

    angular_momentum: Any
    """kg m^2/s, angular momentum at take-off about the horizontal axis across the direction of travel."""
    lever: Any
    """m, mean lever arm of the ground force in the thrust: distance of the centre of pressure behind the centre of
    mass."""


@dataclass(frozen=True)
class FlipOutcome(JudgedOutcome):
    """Measured result of a somersault."""

    rotation_degrees: float
    """Rotation in the direction of the somersault, without wrapping."""


class Flip(Jump):
    """Somersault in the direction of the x axis of the stance, backward if this is not the front of the body."""

    def __init__(self, stance: Stance, height: float) -> None:
        """Create the somersault of the body that stands at ``stance``, in which its centre of mass rises by ``height``
        m.

        Raises:
            TargetError: the body lies along the ground or rolls, the ground is not level up to ``MAX_TRAVEL`` ahead,
                or its feet are too short for the landing or for the lever arm that the rotation requires.
        """
        base = stance.base()
        if base in (SupportKind.LYING, SupportKind.ROUND_BASE):
            posture = "lies along the ground" if base is SupportKind.LYING else f"stands on {base.value}"
            raise TargetError(f"a somersault needs a body that stands; this one {posture}")
        _check_ground(stance)
        left = stance.ground.axes[1]
        self._inertia = float(dots(left, stance.body.inertia(stance.standing) @ left))
        super().__init__(stance, JumpTarget(DISTANCE * stance.body.height, height))
        if self.support_length < MIN_FOOT_LENGTH:
            raise TargetError(
                f"the feet are too short to land a somersault: they are {self.support_length:.2g} body heights long in"
                f" its direction, and {MIN_FOOT_LENGTH:g} are necessary; use jump, hop or spin"
            )
        self._check_lever()

    def _plan_for(self, target: JumpTarget) -> FlipPlan:
        jump = self._plan_with_lean(target, LEAN_FRACTION * self._support_ahead)
        # The body turns by half of its spin at take-off during the thrust, and faster in the air, where it is short.
        turning_time = jump.flight_time / TUCK_INERTIA + 0.5 * jump.thrust_time
        momentum = self._inertia * (WHOLE_TURN + LANDING_ANGLE) / turning_time
        lever = momentum / (self.body.mass * (jump.speed_up + self.gravity * jump.thrust_time))
        return FlipPlan(**asdict(jump), angular_momentum=momentum, lever=lever)

    def _check_lever(self) -> None:
        """Raise ``TargetError`` if the lever arm of the ground force would have to be too long."""
        plan, height, target = self._plan_for(self.target), self.body.height, self.target
        reach = self._support_behind + plan.lean
        if plan.lever <= MAX_LEVER_FRACTION * reach:
            return
        advice = "no height is sufficient"
        for tried in _HEIGHT_STEP * np.arange(1, round(MAX_TARGET / _HEIGHT_STEP) + 1):
            higher = self._plan_for(replace(target, height=float(tried) * height))
            if higher.lever <= MAX_LEVER_FRACTION * reach:
                advice = f"give a height of at least {tried:.3g}"
                break
        raise TargetError(
            f"the feet are too short for a somersault with a height of {target.height / height:.2g}: the ground force"
            f" must act {plan.lever / height:.2g} body heights beside the centre of mass, and can act"
            f" {MAX_LEVER_FRACTION * reach / height:.2g}; {advice}"
        )

    def _one_world(
        self,
        stance: Stance,
        soles: AirborneSoles,
        turn: float | None,
        airborne: float,
        skips_settling: bool,
        is_followed: bool,
    ) -> FlipWorlds:
        jump = super()._one_world(stance, soles, turn, AIRBORNE_POSE_WEIGHT, skips_settling, is_followed)
        values = {field.name: getattr(jump, field.name) for field in fields(JumpWorlds)}
        return FlipWorlds(**values, turned=np.zeros(1), landed=np.full(1, np.nan))

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return NaN (3,): the velocity along the ground is not controlled."""
        return np.full(3, np.nan)

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> FlipOutcome:
        """Return the measured rotation between the states ``first`` and ``last`` of the ``trajectory``."""
        axes, body = self.take_off_controller.ground.axes, self.body
        turns = np.array([body.best_fit_rotation(nodes) for nodes in trajectory.positions[first : last + 1]])
        angles = np.unwrap(angle_about_left(axes @ turns @ turns[0].T @ axes.T))
        degrees = float(np.degrees(angles[-1] - angles[0]))
        is_missed = abs(degrees - 360.0) > MAX_ROTATION_ERROR
        return FlipOutcome((f"rotation {degrees:.0f} of 360 degrees",) * is_missed, degrees)

    def notes(self) -> list[str]:
        """Return messages for the user: those of a jump, and a rotation that was far from complete at touch-down."""
        assert isinstance(self._worlds, FlipWorlds)
        landed = float(np.degrees(self._worlds.landed[self._row]))
        is_late = abs(landed - 360.0) > MAX_LANDING_ERROR
        return [*super().notes(), *[f"it touched down after {landed:.0f} of 360 degrees"] * is_late]


def _check_ground(stance: Stance) -> None:
    """Raise ``TargetError`` at the first place where the ground in the direction of travel, as wide as the base, ends,
    is not level, or is inside a wall."""
    if not stance.solids:
        return
    height, up = stance.body.height, stance.ground.axes[2]
    base = stance.ground.local(stance.contact_points)
    (front, _, _), level = base.max(axis=0), float(np.median(base[:, 2]))
    for x in np.arange(0.0, front + MAX_TRAVEL * height, _GROUND_STEP * height):
        for y in np.linspace(base[:, 1].min(), base[:, 1].max(), _GROUND_LINES):
            point = stance.ground.world(np.array([x, y, level]))
            rise = surface_above(stance.solids, point, up) / height
            # A half space with a vertical face has no top.
            middle = point + 0.5 * height * up
            is_wall = any(isinstance(solid, Solid) and solid.contains(middle) for solid in stance.solids)
            if abs(rise) <= MAX_RISE and not is_wall:
                continue
            if is_wall:
                obstacle = "there is a wall"
            elif np.isfinite(rise):
                obstacle = f"the ground is {abs(rise):.2g} body heights {'higher' if rise > 0.0 else 'lower'}"
            else:
                obstacle = "the ground ends"
            raise TargetError(
                f"a somersault needs {MAX_TRAVEL:g} body heights of level ground in its direction; {x / height:.2g}"
                f" body heights ahead, {obstacle}; turn to another direction first, or walk to more level ground"
            )
