"""Jump to a target: a state machine (``JumpWorlds``) that computes objectives from the measured state in a closed
loop."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial

import numpy as np

from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.airborne_soles import AirborneSoles
from egs_warp.motions.balance import MAX_LEAN, SUPPORT_MARGIN, Weights
from egs_warp.motions.foothold import foothold_limits
from egs_warp.motions.joined_motion import JoinedMotion
from egs_warp.motions.jump_plan import (
    FRICTION_FRACTION,
    LANDING_TIME,
    LEAN_FRACTION,
    MAX_USUAL_LEAN,
    SETTLE_TIME,
    JumpPhase,
    JumpPlan,
    JumpTarget,
    plan_jump,
    sufficient_lean,
)
from egs_warp.motions.jump_worlds import PHASES, JumpWorlds
from egs_warp.motions.landing import check_landing, shortened
from egs_warp.motions.sequence import Stance, TargetError
from egs_warp.motions.stance import BalanceController, GroundFrame
from egs_warp.motions.twist import Heading
from egs_warp.motions.walk_posture import LeggedPosture, select_posture

AIRBORNE_POSE_WEIGHT, BASE_AIRBORNE_POSE_WEIGHT = 2.0, 0.3
"""Weights of the pose in the air. The first is for bodies on legs, and for bodies that turn in the air, whose rotation
depends on their width. The second is for a single base without a turn: with a weight of 2, the muscles of a pawn do
0.76 m g H of work in the air; with 0.3, they do 0.30 m g H, and the pawn lands equally well."""
_DISTANCE_TOLERANCE = 1e-3
"""Largest difference between the distances of a target and of its plan, body heights."""


class Jump(JoinedMotion[JumpWorlds]):
    """Jump: settle, crouch, thrust until the measured speed suffices, fly, land ``target.distance`` ahead, and come to
    rest. Its state is a row of ``JumpWorlds``, which may be shared with the jumps of other worlds."""

    def __init__(
        self,
        stance: Stance,
        target: JumpTarget,
        *,
        turn: float | None = None,
        weights: Weights | None = None,
        skips_settling: bool = False,
        is_followed: bool = False,
        catches_fall: bool = False,
        stays_at_edges: bool = False,
    ) -> None:
        """Create the jump of the body that stands at ``stance``.

        Args:
            stance: stance at the start.
            target: target of the jump.
            turn: change of the heading until the landing in radians, counterclockwise as seen from above; None keeps
                the heading.
            weights: weights of the objectives.
            skips_settling: True starts the crouch at the first time step.
            is_followed: True if another jump follows at once: the motion ends as soon as the landed body is balanced.
            catches_fall: True if the body is falling and must land at the target: the target is not bounded by what the
                support can stop after a jump from rest.
            stays_at_edges: True jumps on the spot if the target is too far and the ground does not support the body at
                a shorter distance.

        Raises:
            TargetError: the target is too far, and the ground does not support the body at a shorter distance.
        """
        body, ground = stance.body, stance.ground
        self.body, self.target_heading = body, turn or 0.0
        self.weights = weights or Weights()
        self.gravity = float(np.linalg.norm(body.gravity))
        feet, posture = select_posture(stance)
        on_legs = posture is LeggedPosture
        soles = [foot.sole for foot in feet] if on_legs else []
        self.take_off_controller = BalanceController(
            body, ground, stance.standing, stance.contact_points, stance.friction, soles=soles
        )
        self._time_unit = float(np.sqrt(body.height / self.gravity))
        # While the fall is stopped, feet on legs do not move after touch-down.
        self._landing_time = LANDING_TIME * self._time_unit if on_legs else 0.0
        footprint = self.take_off_controller.footprint
        self._support_ahead = float(footprint.extent(np.array([1.0, 0.0])))
        self._support_behind = float(footprint.distance_to_edge(np.array([-1.0, 0.0])))
        # After a turn, the body lands with another side ahead.
        ahead = np.array([np.cos(self.target_heading), -np.sin(self.target_heading)])
        reach = max(float(footprint.scaled(SUPPORT_MARGIN).distance_to_edge(ahead)), 0.0)
        self._landing_reach = np.inf if catches_fall else reach
        # A landing force through the centre of mass must be inside the friction cone.
        max_lean = min(MAX_LEAN, FRICTION_FRACTION * self.take_off_controller.friction)
        self._max_lag = np.inf if catches_fall else max_lean * self.take_off_controller.standing_height
        limits = foothold_limits(footprint, self.take_off_controller.balance.standing_height)
        self._max_offset = float(replace(footprint, offsets=limits).distance_to_edge(-ahead))
        self._style, self._step = stance.style, stance.step
        self._requested_distance, self._stays_at_edges = target.distance, stays_at_edges
        self.target = target = self._within_reach(stance, target)
        self.plan = self._plan_for(target)
        landing = GroundFrame(
            ground.axes @ ground.rotation_about_up(self.target_heading).T,
            ground.origin + target.distance * ground.axes[0] + target.rise * ground.axes[2],
            ground.surface_normal,
        )
        local = ground.local(stance.standing)
        self.landing_controller = BalanceController(
            body,
            landing,
            landing.world(local),
            landing.world(ground.local(stance.contact_points)),
            stance.friction,
            soles=soles,
        )
        airborne = AIRBORNE_POSE_WEIGHT if on_legs or self.target_heading else BASE_AIRBORNE_POSE_WEIGHT
        airborne_soles = AirborneSoles.of(stance, feet, on_legs=on_legs)
        super().__init__(
            self.take_off_controller,
            self._one_world(stance, airborne_soles, turn, airborne, skips_settling, is_followed),
        )

    def _one_world(
        self,
        stance: Stance,
        soles: AirborneSoles,
        turn: float | None,
        airborne: float,
        skips_settling: bool,
        is_followed: bool,
    ) -> JumpWorlds:
        """Return the state of this jump as a record of one world."""
        body, start, target = self.body, self.take_off_controller, self.target
        com = body.centre_of_mass(stance.ground.local(stance.standing))

        def array(value: float | bool) -> np.ndarray:
            return np.array([value])

        return JumpWorlds(
            speed_unit=body.speed_unit,
            time_unit=self._time_unit,
            # Use the same footprint in both frames, in which it is equal up to rounding.
            landing=replace(self.landing_controller.balance, footprint=start.footprint).with_world_axis(),
            bending=start.bending[None],
            soles=soles.with_world_axis(),
            airborne_weight=array(airborne),
            landing_time=array(self._landing_time),
            distance=array(target.distance),
            height=array(target.height),
            rise=array(target.rise),
            plan=JumpPlan(**{field.name: array(getattr(self.plan, field.name)) for field in fields(JumpPlan)}),
            weights=Weights(**{field.name: array(getattr(self.weights, field.name)) for field in fields(Weights)}),
            start_com=com[None],
            start_base=(com[:2] + start.base_offset)[None],
            skips_settling=array(skips_settling),
            is_followed=array(is_followed),
            settle_time=array(np.nan),
            landing_height=array(float(com[2])),
            # Copy the arrays, because the frame changes at take-off.
            current=start.balance.with_world_axis().gather(np.array([0])),
            is_airborne=array(False),
            heading=Heading(
                turns=array(turn is not None),
                target=array(self.target_heading),
                standing_inertia=body.inertia(stance.standing)[None],
                now=array(0.0),
                predicted=array(0.0),
            ),
            phase=np.zeros(1, int),
            entered=array(0.0),
            crouch_offset=np.zeros((1, 3)),
            crouch_velocity=np.zeros((1, 3)),
            last_pose=np.eye(3)[None].copy(),
            pose_before=np.eye(3)[None].copy(),
            requested_velocity=np.full((1, 2), np.nan),
            speed_offset=array(0.0),
            off_ground=array(False),
            slow_since=array(np.nan),
            overran=np.zeros((1, len(PHASES)), bool),
        )

    @property
    def phase(self) -> JumpPhase:
        """Current phase."""
        return PHASES[self._worlds.phase[self._row]]

    @phase.setter
    def phase(self, phase: JumpPhase) -> None:
        self._worlds.phase[self._row] = PHASES.index(phase)

    @property
    def heading(self) -> float:
        """Change of the heading from the start until now in radians, without wrapping; 0 for a jump that keeps its
        heading."""
        return float(self._worlds.heading.now[self._row])

    @property
    def predicted_heading(self) -> float:
        """Predicted value of ``heading`` at touch-down, radians."""
        return float(self._worlds.heading.predicted[self._row])

    @property
    def support_length(self) -> float:
        """Length of the feet in the direction of travel, body heights."""
        return (self._support_ahead + self._support_behind) / self.body.height

    @property
    def landing_height(self) -> float:
        """Height in metres at which the centre of mass of the landed body comes to rest."""
        return float(self._worlds.landing_height[self._row])

    @landing_height.setter
    def landing_height(self, height: float) -> None:
        self._worlds.landing_height[self._row] = height

    @property
    def controller(self) -> BalanceController:
        """Balance controller: in the frame of the start until take-off, in the frame of the landing afterwards."""
        return self.landing_controller if self.is_airborne else self.take_off_controller

    @property
    def ground(self) -> GroundFrame:
        """Reference frame of the motion: the frame of the start until take-off, the frame of the landing afterwards."""
        return self.controller.ground

    @property
    def is_airborne(self) -> bool:
        """True from take-off on: the reference frame is the frame of the landing."""
        return bool(self._worlds.is_airborne[self._row])

    @property
    def expected_time(self) -> float:
        """Expected duration in seconds until the body is at rest, or until the next jump if one follows at once."""
        distance = abs(self.target.distance) / self.body.height
        return self.plan.expected_duration(
            distance, self._time_unit, is_followed=bool(self._worlds.is_followed[self._row])
        )

    def _within_reach(self, stance: Stance, target: JumpTarget) -> JumpTarget:
        """Return ``target`` with the largest distance, at most the requested one, after which the body can stop over
        its feet.

        Raises:
            TargetError: the ground does not support the body at a shorter distance, unless the jump stays at edges.
        """
        requested, reached = target, self._plan_for(target).distance
        while reached < target.distance - _DISTANCE_TOLERANCE * self.body.height:
            target = shortened(stance, requested, reached)
            reached = self._plan_for(target).distance
        if target.distance < requested.distance:
            try:
                check_landing(stance, target)
            except TargetError:
                if not self._stays_at_edges:
                    raise
                return JumpTarget(0.0, requested.height)
        return target

    def _plan_for(self, target: JumpTarget) -> JumpPlan:
        """Return the plan of a jump to ``target``, with the lean of the crouch that it needs."""
        usual = min(LEAN_FRACTION * target.distance, MAX_USUAL_LEAN * self._support_ahead)
        com_height = self.take_off_controller.standing_height
        plan = partial(self._plan_with_lean, target)
        return plan(sufficient_lean(plan, usual, self._support_ahead, com_height, self.gravity))

    def _plan_with_lean(self, target: JumpTarget, lean: float) -> JumpPlan:
        return plan_jump(
            target,
            height=self.body.height,
            com_height=self.take_off_controller.standing_height,
            support_ahead=self._support_ahead,
            gravity=self.gravity,
            step=self._step,
            lean=lean,
            friction=self.take_off_controller.friction,
            landing_time=self._landing_time,
            support_behind=self._support_behind,
            landing_reach=self._landing_reach,
            max_offset=self._max_offset,
            max_lag=self._max_lag,
            style=self._style,
        )

    def take_off_time(self, height: float) -> float:
        """Return the planned time in seconds from the start of the crouch to the end of the thrust, for a jump on the
        spot that is ``height`` metres high. Crouch and thrust take whole numbers of time steps."""
        return self._plan_for(JumpTarget(0.0, height)).take_off_time(self._step)

    @property
    def is_at_rest(self) -> bool:
        """True if the body has landed and is at rest, or is balanced and another jump follows."""
        return self.phase is JumpPhase.REST

    def plan_record(self) -> JumpPlan:
        """Return the plan of the jump."""
        return self.plan

    def planned_com(self, elapsed: float) -> np.ndarray:
        """Return the planned displacement (3,) in metres of the centre of mass ``elapsed`` seconds after the motion
        began; NaN after touch-down."""
        plan, ground = self.plan, self.ground
        axes = ground.axes @ ground.rotation_about_up(self.target_heading) if self.is_airborne else ground.axes
        worlds, row = self._worlds, self._row
        waited = float(worlds.settle_time[row])
        begin = SETTLE_TIME * self._time_unit if np.isnan(waited) else waited
        elapsed, start = max(elapsed - begin, 0.0), (worlds.crouch_offset[row], worlds.crouch_velocity[row])
        return plan.planned_displacement(elapsed, self.gravity, *start) @ axes

    def outcome_record(self, trajectory: Trajectory, first: int, last: int) -> None:
        """Return None: a jump has no quantities of its own beyond those measured for all motions."""

    def notes(self) -> list[str]:
        """Return messages for the user about a shortened distance and about phases that took too long."""
        requested, planned = (each / self.body.height for each in (self._requested_distance, self.target.distance))
        reason = "after a longer jump, the body could not stop over its feet"
        if planned == 0.0:
            reason = "the ground does not support the body at the distance after which it could stop"
        shortening = [f"planned {planned:.2f} instead of {requested:.2f} body heights ahead: {reason}"]
        named = {
            JumpPhase.THRUST: "the muscles could not reach the take-off speed within the time of a thrust",
            JumpPhase.FLIGHT: "the body never came back to the ground",
        }
        overran = self._worlds.overran[self._row]
        late = [f"{phase.value} took too long: {why}" for phase, why in named.items() if overran[PHASES.index(phase)]]
        return shortening * (planned < requested) + late
