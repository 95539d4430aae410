"""A jump to a place: from take-off on it is told in the frame of the landing, which may be turned, higher or lower."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import Objective, SpinObjective
from egs_warp.motions.jump import Jump, JumpPhase, JumpTarget
from egs_warp.motions.sequence import Place
from egs_warp.motions.stance import Ground, Measurement, PoseFamily, Weights

LEAN = 0.2
"""Of the distance: how far the weight is put ahead before take-off. With it over the middle of the feet a push forward
would turn the body backward."""
FURTHEST_LEAN = 0.35
"""Of the way from under the centre of mass to the front of the feet."""
DEEPEST_CROUCH = 0.3
"""Of the height of the centre of mass; a higher jump thrusts harder instead."""
FOOTHOLD = 0.4
"""Of the footprint: how far from the capture point the feet may be put down for the sake of the target."""
RUN_ON = 0.08
"""Of sqrt(H / g): for how long the feet go on at the body's speed when they touch down,
swinging and sliding (measured on the pawn).
"""
CLEARANCE = 0.15
"""Of the height of a step: how far above it the feet are before they swing ahead."""
THRUST_LEAD = 0.7
"""Part of the time of a thrust in which the speed forward is to be reached."""
AIRBORNE_POSE = 0.08
"""Weight of the pose in the air, where nothing else can be steered and the feet have to get to their place. Much more
crumples the body, and one so slender that it was made stiffer to stand (``SoftBody.stiffening``) buckles under less, by
the square."""
IN_TIME = 2.5
"""Over the time left in the air: the rate at which the pose of the landing is approached, gently at first."""
CALM = 0.03
"""Speed of the centre of mass, in sqrt(g H), below which a body that has landed is at rest."""


class Leap(Jump):
    """A jump that lands ``target.distance`` ahead, turned by ``turn`` radians,
    and rests as soon as the body is calm.
    """

    def __init__(
        self,
        place: Place,
        target: JumpTarget,
        *,
        turn: float = 0.0,
        lean: float | None = None,
        weights: Weights | None = None,
    ) -> None:
        super().__init__(
            place.body,
            place.ground,
            place.standing,
            target,
            touching=place.touching,
            step=place.step,
            weights=weights,
            lean=self._lean(place, target) if lean is None else lean,
        )
        self.turn = turn
        ground = place.ground
        self._landing = Ground(
            ground.axes @ ground.turn(turn).T,
            ground.origin + target.distance * ground.axes[0] + target.rise * ground.axes[2],
            ground.surface_normal,
        )
        self._landing_pose = PoseFamily(
            place.body,
            self._landing,
            self._landing.world(ground.local(place.standing)),
            self._landing.world(ground.local(place.touching)),
        )
        crouch = min(self.plan.crouch_depth, DEEPEST_CROUCH * self.pose.standing_height)
        stroke = crouch + self.plan.extension
        thrust_time = max(2.0 * stroke / self.plan.speed_up - place.step, 2.0 * place.step)
        self.plan = replace(self.plan, crouch_depth=crouch, thrust_time=thrust_time)
        self._calm_since: float | None = None
        self._asked: np.ndarray | None = None
        self._pose_weight = self.weights.pose
        self._airborne_weight = max(AIRBORNE_POSE / place.body.stiffening**2, self._pose_weight)
        self._stance_follow = self._follow

    @staticmethod
    def _lean(place: Place, target: JumpTarget) -> float:
        ahead = place.ground.axes[0] @ (place.touching - place.body.centre_of_mass(place.standing)).T
        return min(LEAN * target.distance, FURTHEST_LEAN * float(ahead.max()))

    @property
    def left_ground(self) -> bool:
        """Whether the motion is told in the frame of the landing."""
        return self.pose is self._landing_pose

    def _thrust_velocity(
        self, com_velocity: np.ndarray, seen: Measurement, position: np.ndarray, dt: float
    ) -> np.ndarray:
        """Along the ground the speed that brings the centre of mass from where it is to where it shall touch down."""
        plan, velocity = self.plan, super()._thrust_velocity(com_velocity, seen, position, dt)
        left = max((plan.speed_up - seen.velocity[2]) / plan.speed_up * plan.thrust_time, dt)
        goal = np.array([self._landing_com(position)[0], self._start_com[1]])
        needed = (goal - seen.com[:2] - 0.5 * left * seen.velocity[:2]) / (plan.flight_time + 0.5 * left)
        # What the ground gives lags behind what is asked: the speed forward is asked for ahead of the speed up, and
        # with what the last step fell short by, at most twice over.
        change = (needed - seen.velocity[:2]) * dt / max(THRUST_LEAD * left, dt)
        short = self._asked - seen.velocity[:2] if self._asked is not None else np.zeros(2)
        most = np.linalg.norm(change)
        short *= min(1.0, most / max(float(np.linalg.norm(short)), 1e-12))
        velocity = self._balanced(seen, np.array([*(seen.velocity[:2] + change + short), velocity[2]]), dt)
        self._asked = velocity[:2]
        return velocity

    def _risen(self, seen: Measurement, dt: float) -> bool:
        # A body in the air has thrust, however fast it goes; waiting for the asked speed there would lose the steering
        # of the feet.
        return super()._risen(seen, dt) or not (seen.touching or seen.sole_height <= 0.0)

    def _falling(self, seen: Measurement, dt: float) -> tuple[np.ndarray, float, np.ndarray]:
        """As for any jump, but the feet touch down when they have fallen by their distance to the ground now."""
        touch_down, latest, velocity = super()._falling(seen, dt)
        speed, gap = seen.velocity[2], max(seen.sole_height, 0.0)
        left = min(max((speed + np.sqrt(speed**2 + 2.0 * self.gravity * gap)) / self.gravity, dt), latest)
        touch_down[:2] = seen.com[:2] + seen.velocity[:2] * left
        self._follow = min(IN_TIME / left, self._stance_follow)
        return touch_down, left, velocity

    def _fly(self, state: BodyState, seen: Measurement, dt: float) -> list[Objective | SpinObjective]:
        touch_down, _, velocity = self._falling(seen, dt)
        pose = self.pose.over_base(touch_down, self._foothold(state, seen, touch_down))
        # A foot that lags on the ground must not push any more.
        momentum = self.body.angular_momentum(state.positions, state.velocities)
        return self._write(state, velocity, pose, np.linalg.solve(self.body.inertia(state.positions), momentum), dt)

    def _foothold(self, state: BodyState, seen: Measurement, touch_down: np.ndarray) -> np.ndarray:
        """(2,) where to put the feet: the target, if the body that comes in so can stop over it."""
        if seen.velocity[2] > 0.0 and self.ground.local(state.positions)[:, 2].min() < CLEARANCE * self.target.rise:
            # Feet that swing ahead before they are higher than the step would strike it.
            return touch_down[:2] + seen.base - seen.com[:2]
        capture_time = np.sqrt(self.pose.standing_height / self.gravity)
        capture = touch_down[:2] + seen.velocity[:2] * capture_time + self.pose.base_offset
        low, high = self.pose.support_low, self.pose.support_high
        goal = self._goal_base - RUN_ON * self._time_unit * seen.velocity[:2]
        return np.clip(goal, capture + FOOTHOLD * low, capture + FOOTHOLD * high)

    def _advance_phase(self, seen: Measurement, time: float, dt: float) -> None:
        # What a foot brushes on its way up is no landing.
        super()._advance_phase(replace(seen, touching=seen.touching and seen.velocity[2] < 0.0), time, dt)
        in_air = self.phase is JumpPhase.FLIGHT
        self._follow = self._stance_follow
        self.weights = replace(self.weights, pose=self._airborne_weight if in_air else self._pose_weight)
        if in_air and not self.left_ground:
            self.pose, self.ground = self._landing_pose, self._landing
            self._goal_base = self._start_base
        if self.phase is JumpPhase.LAND:
            if np.linalg.norm(seen.velocity) > CALM * np.sqrt(self.gravity * self.body.height):
                self._calm_since = None
            elif self._calm_since is None:
                self._calm_since = time
            elif time - self._calm_since > 0.3 * self._time_unit:
                self.phase = JumpPhase.REST
