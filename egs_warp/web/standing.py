"""Between two motions: a body stands where its feet are, upright, or lies where it fell."""

from __future__ import annotations

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.sequence import Place
from egs_warp.motions.stance import CALM, Calm, PoseFamily, Weights

_RATE = 4.0
"""Over sqrt(H / g): how fast the centre of mass comes back over the feet."""


class Stand:
    """Balances over the feet where they are, as a landed jump does, however long."""

    def __init__(self, place: Place) -> None:
        self.body = place.body
        self.pose = PoseFamily(place.body, place.ground, place.standing, place.touching, place.friction)
        self._gravity = float(np.linalg.norm(place.body.gravity))
        self._time_unit = float(np.sqrt(place.body.height / self._gravity))
        self._height = self.pose.standing_height
        self._calm = Calm(place.body)
        # It begins as the motion before has ended, at rest.
        self._resting = True

    @property
    def resting(self) -> bool:
        """Whether it stands calmly."""
        return self._resting

    def notes(self) -> list[str]:
        """None: it has no target."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """Objectives of the step of ``dt`` that starts at ``state``; ``report`` of the step before."""
        seen = self.pose.measure(state, report)
        slow = bool(np.linalg.norm(seen.velocity) <= CALM * np.sqrt(self._gravity * self.body.height))
        self._resting = self._calm.held(seen.velocity, state.time) or (self._resting and slow)
        rate = _RATE / self._time_unit
        goal = np.array([*(seen.base - self.pose.base_offset), self._height])
        acceleration = rate**2 * (goal - seen.com) - 2.0 * rate * seen.velocity
        acceleration[:2] = self.pose.caught(seen, goal[:2])
        acceleration[2] = max(acceleration[2], -0.8 * self._gravity)
        velocity = seen.velocity + dt * acceleration
        heading = self.pose.sole_heading(state.positions)
        pose = self.pose.over_base(seen.com + dt * velocity, seen.base, heading)
        upright = self.pose.turn_towards(state, pose) * 4.0 / self._time_unit
        velocity, spin = self.pose.balanced(state, seen, velocity, upright, dt)
        return self.pose.objectives(
            state,
            com_velocity=velocity,
            pose=pose,
            pose_rate=np.zeros((3, 3)),
            spin=spin,
            follow=6.0 / self._time_unit,
            weights=Weights(),
        )


class Lie:
    """Relaxes its muscles."""

    @property
    def resting(self) -> bool:
        """Always."""
        return True

    def notes(self) -> list[str]:
        """None: it has no target."""
        return []

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> list[AnyObjective]:
        """None."""
        return []


def tilt_degrees(place: Place, positions: np.ndarray) -> float:
    """How far nodes at ``positions`` (N, 3) are from upright, as the body stands at ``place``."""
    turn = place.body.best_fit_rotation(positions) @ place.body.best_fit_rotation(place.standing).T
    up = place.ground.axes[2]
    return float(np.degrees(np.arccos(np.clip(up @ turn @ up, -1.0, 1.0))))
