"""Objectives that move the soles of airborne bodies to their positions in the landing pose, and that level a single
base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.fem.batched import BatchedRecord
from egs_warp.geometry.frames import nearest_rotation, times
from egs_warp.locomotion.objectives import BodyPart
from egs_warp.locomotion.reduced_objectives import AffineObjectives
from egs_warp.motions.balance import Balance
from egs_warp.motions.feet import Foot
from egs_warp.motions.moments import PartMoments
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import sole_shares

SWING_WEIGHT, BASE_SWING_WEIGHT = 5.0, 1.0
"""Weights of the velocities of the soles in the air, for feet on legs and for a single base. Without these objectives,
the soles land 0.03 body heights short, and a body with little support in front falls forward. A base is stiff: with a
weight of 5, the jump of a monkey takes 50 % more work and does not land better."""
BASE_TILT_WEIGHT = 5.0
"""Weight of the tilt rate of a single base in the air. A base under a slender stem tilts while it is moved forward.
Without this objective, the base of a lamp lands on its rear rim, tilted by 35 degrees."""
_MIN_INERTIA_RATIO = 1e-6
"""Minimum ratio of the smallest to the largest principal moment of inertia of a sole that spans an area."""
_BASE = 1
"""Index of the base among the parts of ``BalanceController.shares``; the soles of the feet follow."""


@dataclass(frozen=True)
class AirborneSoles(BatchedRecord):
    """Weights of the objectives of the S soles of bodies in the air. The first sole is the whole base, whose weights
    are zero for a body on legs; the soles of its feet follow. "..." is the world axis, or nothing for one world."""

    swing_weight: np.ndarray
    """(..., S) weights of the velocities of the base and of the soles of the feet."""
    tilt_weight: np.ndarray
    """(...,) weight of the tilt rate of the base; 0 for feet on legs, which are too short to need it."""

    @classmethod
    def of(cls, stance: Stance, feet: Sequence[Foot], *, on_legs: bool) -> AirborneSoles:
        """Return the weights for the body of ``stance``: for the soles of its ``feet`` if it stands ``on_legs``,
        otherwise for its base."""
        if on_legs:
            return cls(np.array([0.0, *(SWING_WEIGHT for _ in feet)]), np.asarray(0.0))
        body = stance.body
        base = BodyPart.of(body, "sole", np.flatnonzero(sole_shares(body, stance.ground, stance.standing)))
        moments = np.linalg.eigvalsh(base.inertia(stance.standing))
        spans_area = moments[0] > _MIN_INERTIA_RATIO * moments[-1]
        return cls(np.array([BASE_SWING_WEIGHT]), np.asarray(BASE_TILT_WEIGHT if spans_area else 0.0))

    def objectives(
        self,
        balance: Balance,
        moments: PartMoments,
        pose: np.ndarray,
        rate: np.ndarray,
        share: np.ndarray,
        turning: np.ndarray,
    ) -> AffineObjectives:
        """Return the objectives that move the soles to their positions in the pose of the landing and tilt them to
        their orientations there.

        Args:
            balance: balance of the standing body.
            moments: moments of the parts of the body.
            pose: (..., 3, 3) target pose, world axes.
            rate: (...,) 1/s, rate at which the pose is approached.
            share: (...,) factor on the weights.
            turning: (..., 3) rad/s, angular velocity of the target pose, world axes.
        """
        worlds, parts = share.shape, moments.centres.shape[-2]
        blocks = []
        for sole in range(self.swing_weight.shape[-1]):
            part = _BASE + sole
            standing, now = (
                each.centres[..., part, :] - each.centres[..., 0, :] for each in (balance.standing, moments)
            )
            coefficients = np.zeros((*worlds, 3, parts, 3, 4))
            coefficients[..., part, :, 3], coefficients[..., 0, :, 3] = np.eye(3), -np.eye(3)
            targets = rate[..., None] * (times(pose, standing) - now) + np.cross(turning, now)
            weights = np.repeat((share * self.swing_weight[..., sole])[..., None], 3, axis=-1)
            blocks.append(AffineObjectives(("sole velocity",) * 3, coefficients, targets, weights))
        if self.tilt_weight.any():
            blocks.append(self._tilt_objectives(balance, moments, pose, rate, share, turning))
        return AffineObjectives.combined(blocks)

    def _tilt_objectives(
        self,
        balance: Balance,
        moments: PartMoments,
        pose: np.ndarray,
        rate: np.ndarray,
        share: np.ndarray,
        turning: np.ndarray,
    ) -> AffineObjectives:
        """Return the two objectives on the tilt rates of the base; the arguments are those of ``objectives``. They
        refer to the angular velocity of a rigid body with the angular momentum of the base, times the radius of
        gyration."""
        up, level = balance.axes[..., 2, :], balance.axes[..., :2, :]
        second = moments.second[..., _BASE, :, :]
        now = times(nearest_rotation(moments.cross[..., _BASE, :, :] @ balance.axes), up)
        target = times(nearest_rotation(pose @ balance.standing.second[..., _BASE, :, :]), up)
        spin = times(level, np.cross(now, target)) * rate[..., None] + times(level, turning)
        trace = np.trace(second, axis1=-2, axis2=-1)
        radius = np.sqrt(trace)[..., None]
        # The inertia of a base that spans no area may be singular; the weight of its tilt rate is zero.
        has_tilt = (self.tilt_weight > 0.0)[..., None, None]
        inertia = np.where(has_tilt, trace[..., None, None] * np.eye(3) - second, np.eye(3))
        turning = radius[..., None] * (level @ np.linalg.inv(inertia))
        matrices = np.cross(turning[..., None, :], np.eye(3)).swapaxes(-1, -2)
        offset = moments.centres[..., _BASE, :] - moments.centres[..., 0, :]
        coefficients = np.zeros((*share.shape, 2, moments.centres.shape[-2], 3, 4))
        coefficients[..., _BASE, :, :3] = matrices
        coefficients[..., _BASE, :, 3] = -times(matrices, offset[..., None, :])
        weights = np.repeat((share * self.tilt_weight)[..., None], 2, axis=-1)
        return AffineObjectives(("sole turning",) * 2, coefficients, radius * spin, weights)
