"""Objectives of the soles of a body in the air: move to their places in the landing pose, and turn a base flat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.geometry.frames import kabsch_rotation
from egs_warp.locomotion.objectives import AnyObjective, BodyPart, Coordinates, part_angular_velocity, part_velocity
from egs_warp.motions.feet import Foot
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController, sole_shares

SWING_WEIGHT, BASE_SWING_WEIGHT = 5.0, 1.0
"""Weights of the velocities of the soles in the air, for feet on legs and for a single base. Without these objectives,
the soles land 0.03 body heights short, and a body with little support in front falls forward. A base is stiff: with a
weight of 5, the jump of a monkey takes 50 % more work and does not land better."""
BASE_TILT_WEIGHT = 5.0
"""Weight of the tilt rate of a single base in the air. A base on a slender stem tilts while it is moved forward.
Without this objective, the base of a lamp lands on its rear rim, tilted by 35 degrees."""
_MIN_INERTIA_RATIO = 1e-6
"""Minimum ratio of the smallest to the largest principal moment of inertia of a sole that spans an area."""


@dataclass(frozen=True)
class AirborneSoles:
    """Soles of a body in the air and the weights of their objectives. There is one sole for each foot on a leg, or the
    base alone."""

    parts: tuple[BodyPart, ...]
    swing_weight: float
    """Weight of the velocity of a sole."""
    tilt_weight: float
    """Weight of the tilt rate of a sole; 0 for feet on legs, which are too short to need it."""

    @classmethod
    def of(cls, stance: Stance, feet: Sequence[Foot], *, on_legs: bool) -> AirborneSoles:
        """Return the soles of the body of ``stance``: those of its ``feet`` if they are ``on_legs``, else its base."""
        body = stance.body
        if on_legs:
            return cls(tuple(BodyPart.of(body, "sole", foot.sole) for foot in feet), SWING_WEIGHT, 0.0)
        base = BodyPart.of(body, "sole", np.flatnonzero(sole_shares(body, stance.ground, stance.standing)))
        moments = np.linalg.eigvalsh(base.inertia(stance.standing))
        spans_area = moments[0] > _MIN_INERTIA_RATIO * moments[-1]
        return cls((base,), BASE_SWING_WEIGHT, BASE_TILT_WEIGHT if spans_area else 0.0)

    def objectives(
        self, controller: BalanceController, state: BodyState, pose: np.ndarray, rate: float, share: float
    ) -> list[AnyObjective]:
        """Return the objectives that move the soles to their positions in the pose of the landing and tilt them to
        their orientations there.

        Args:
            controller: balance controller of the standing body.
            state: current state.
            pose: (3, 3) rotation of the standing body to its landing pose.
            rate: 1/s, rate at which the pose is approached.
            share: factor of the weights.
        """
        body, arms, level = controller.body, controller.arms, Coordinates(controller.ground.axes[:2], False)
        com, about = body.centre_of_mass(state.positions), Coordinates(np.eye(3), True)
        objectives: list[AnyObjective] = []
        for sole in self.parts:
            offset = pose @ sole.centre(arms) - (sole.centre(state.positions) - com)
            objectives.append(part_velocity(body, sole, rate * offset, share * self.swing_weight, about))
            if self.tilt_weight > 0.0:
                now, target = (_normal(controller, sole, points) for points in (state.positions, arms @ pose.T))
                spin = rate * level.axes @ np.cross(now, target)
                objectives.append(part_angular_velocity(body, sole, state, spin, share * self.tilt_weight, level))
        return objectives


def _normal(controller: BalanceController, sole: BodyPart, points: np.ndarray) -> np.ndarray:
    """Return the unit normal (3,) of a ``sole`` of a body with nodes at ``points`` (N, 3): the up axis, rotated by the
    best-fit rotation of the sole from its standing shape."""
    before, after = (x[sole.nodes] - sole.centre(x) for x in (controller.arms, points))
    return kabsch_rotation(sole.masses, before, after) @ controller.ground.axes[2]
