"""Detection of falls from tilt, contacts and capture point. A fall ends the motion or starts an attempt to get up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.geometry.frames import nearest_rotation
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.capture_step import FALLEN_TILT
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.follow import Follow
from egs_warp.motions.get_up import GetUp
from egs_warp.motions.keyframes import Quantity
from egs_warp.motions.pendulum import capture_point, momentum_as_velocity
from egs_warp.motions.sequence import BodyMotion, MotionSequence, MotionTask, Stance
from egs_warp.motions.stance import sole_shares
from egs_warp.motions.support import MIN_OVERHANG, SupportPolygon, overhang

MIN_LYING_LOAD = 0.5
"""Minimum load, as a share of the weight, on other parts of the surface for a body with an unloaded base to be
considered lying. Smaller loads also occur in brief contacts with a riser or a wall."""
MAX_RECOVERIES = 3
"""Maximum number of falls in one run from which the body tries to get up."""
FALLEN_TIME = 0.5
"""Time in sqrt(H / g) for which a body on the ground must be tilted or lying to be considered fallen. In free fall, a
body descends by H / 8 in this time; brief contacts during a landing are shorter."""
LOST_TIME, LOST_DISTANCE = 1.0, 0.02
"""Criterion for a body that is tipping over: its capture point has been outside the support by more than
``LOST_DISTANCE``, in body heights, for ``LOST_TIME``, in sqrt(H / g). ``LOST_TIME`` is longer than a swing of a walk;
within it, the distance grows by a factor of four if the centre of mass is at H / 2."""
_MIN_HEIGHT = 0.1
"""Lower bound, in body heights, of the height of the centre of mass above the contacts when the capture point is
computed."""


class LyingDetector:
    """Detector of bodies that have been lying on the ground for ``FALLEN_TIME``. A body in the air does not lie,
    whatever its tilt."""

    def __init__(self, stance: Stance) -> None:
        """Create the detector of a body with the upright ``stance``. A ball never lies."""
        body = stance.body
        self._weight, self._up = body.weight, stance.ground.axes[2]
        arms = stance.standing - body.centre_of_mass(stance.standing)
        self._moments = body.node_mass[:, None] * arms
        self._has_upright = stance.base() is not SupportKind.ROUND_BASE
        self._in_base = sole_shares(body, stance.ground, stance.standing) > 0.0
        self._min_time = FALLEN_TIME * float(np.sqrt(body.height / np.linalg.norm(body.gravity)))
        self._time = 0.0

    def note(self, state: BodyState, report: StepReport) -> str | None:
        """Describe how a body on the ground lies; None if it stands."""
        if not self._has_upright:
            return None
        loads = report.forces[:, 0] / self._weight
        # Best-fit rotation from the standing pose. The weighted arms sum to zero, so the centre of mass need not be
        # subtracted.
        turn = nearest_rotation(state.positions.T @ self._moments)
        tilt = float(np.degrees(np.arccos(np.clip(self._up @ turn @ self._up, -1.0, 1.0))))
        if tilt > FALLEN_TILT:
            return f"tilted by {tilt:.0f} degrees"
        on_base = self._in_base[report.contacts.nodes].any(axis=1)
        if loads.sum() > MIN_LYING_LOAD and loads[on_base].sum() <= 0.0:
            return "its base off the ground"
        return None

    def update(self, lies: bool, report: StepReport, elapsed: float) -> bool:
        """Add a step of ``elapsed`` s after which the body ``lies`` or not; return True if it has been lying for
        ``FALLEN_TIME``."""
        # Do not reset the time while the body is in the air, because the body may be bouncing on its side.
        if report.forces[:, 0].sum() > 0.0:
            self._time = self._time + elapsed if lies else 0.0
        return self._time >= self._min_time

    def reset(self) -> None:
        """Restart the detection."""
        self._time = 0.0


def start_overhang(stance: Stance) -> float:
    """Return the distance, in body heights, by which the centre of mass of a body at ``stance`` is outside its support;
    0 if it can stand, or if nothing carries it."""
    carrying, com = (
        stance.ground.local(points) for points in (stance.contact_points, stance.body.centre_of_mass(stance.standing))
    )
    outside = overhang(carrying[:, :2], com[:2]) / stance.body.height
    return outside if MIN_OVERHANG <= outside < np.inf else 0.0


class FallMonitor:
    """Run a sequence until the body falls. After a fall, either return no objectives, so that the muscles relax, or get
    up and continue with the next motion. A ball cannot fall."""

    def __init__(self, sequence: MotionSequence, stance: Stance, *, gets_up: bool = False) -> None:
        """Monitor ``sequence``.

        Args:
            sequence: motions to run.
            stance: stance of the body at the start.
            gets_up: True if a fallen body tries to get up.
        """
        body = stance.body
        self.sequence = sequence
        self._body, self._ground = body, stance.ground
        self._start_overhang = start_overhang(stance)
        self._has_upright = stance.base() is not SupportKind.ROUND_BASE
        self._lying = LyingDetector(stance)
        self._lost_time_limit = LOST_TIME * float(np.sqrt(body.height / np.linalg.norm(body.gravity)))
        self._last_time = self._lost_time = 0.0
        self._gets_up, self._recoveries = gets_up, 0
        self.get_up_time = 0.0
        """Time spent on getting up, s."""
        self.time = 0.0
        """Time of the last state, s."""
        self.fallen: str | None = None
        """Description of the fall, or None if the body has not fallen."""

    @property
    def is_finished(self) -> bool:
        """True if the last motion has come to rest or the body has fallen."""
        return self.sequence.is_finished or self.fallen is not None

    @property
    def fall_note(self) -> str | None:
        """Description of the fall at the end of the run; None if the body has not fallen. A fall that has only begun
        also counts: the capture point has been outside the support for ``LOST_TIME``, so the body would tip over if the
        run continued."""
        if self.fallen is not None or self._lost_time < self._lost_time_limit:
            return self.fallen
        return self._with_cause(f"tipping over, with its capture point outside its feet, at {self.time:.2f} s")

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Return the objectives of the sequence; none if the body has fallen."""
        self.time = state.time
        if self.fallen is None and report is not None and self._has_upright:
            self._check_fall(state, report)
        return self.sequence.objectives(state, report, dt) if self.fallen is None else []

    def _check_fall(self, state: BodyState, report: StepReport) -> None:
        elapsed, self._last_time = state.time - self._last_time, state.time
        motion = self.sequence.done[-1].motion
        if isinstance(motion, GetUp):
            self._lost_time = 0.0
            self._check_recovery(motion, elapsed)
            return
        is_lost = not tips_body(motion) and self._is_outside_support(state, report)
        self._lost_time = self._lost_time + elapsed if is_lost else 0.0
        lies = self._lying_note(state, report)
        if self._lying.update(lies is not None, report, elapsed):
            self._record_fall(f"{lies} at {state.time:.2f} s")

    def _record_fall(self, why: str) -> None:
        why = self._with_cause(why)
        self._lying.reset()
        if not self._gets_up or self._recoveries == MAX_RECOVERIES:
            self.fallen = why
            return
        self._recoveries += 1
        self.sequence.start_get_up(MotionTask("get up", {}, GetUp), why)

    def _with_cause(self, why: str) -> str:
        """Return the description ``why`` of a fall, with its cause if the body could not stand at the start."""
        if self._start_overhang == 0.0 or len(self.sequence.done) > 1:
            return why
        return (
            f"{why}; at the start, its centre of mass was {self._start_overhang:.2g} body heights outside its support"
        )

    def _check_recovery(self, getting_up: GetUp, elapsed: float) -> None:
        """Check whether getting up has succeeded or failed."""
        self.get_up_time += elapsed
        if not getting_up.is_at_rest:
            return
        before = self.sequence.done[-2] if len(self.sequence.done) > 1 else None
        if getting_up.is_up and before is not None and before.fall_note is not None:
            before.got_up = True
        elif not getting_up.is_up:
            description = before.fall_note if before is not None else None
            self.fallen = description or f"the body has not got up by {self._last_time:.2f} s"

    def _is_outside_support(self, state: BodyState, report: StepReport) -> bool:
        """Return True if the body touches the ground and its capture point is more than ``LOST_DISTANCE`` outside the
        convex hull of the contacts."""
        contacts, body = report.contacts, self._body
        if contacts.count == 0 or not np.isfinite(state.velocities).all():
            return False
        local = self._ground.local(state.positions)
        com = body.centre_of_mass(local)
        touching = np.einsum("cw,cwi->ci", contacts.weights, local[contacts.nodes])
        height = max(float(com[2] - touching[:, 2].mean()), _MIN_HEIGHT * body.height)
        axes = self._ground.axes
        velocity = (axes @ body.centre_of_mass(state.velocities))[:2] + momentum_as_velocity(
            axes @ body.angular_momentum(state.positions, state.velocities), body.mass, height
        )
        rate = float(np.sqrt(np.linalg.norm(body.gravity) / height))
        margin = SupportPolygon.hull(touching[:, :2]).margin(capture_point(com[:2], velocity, rate))
        return margin < -LOST_DISTANCE * body.height

    def _lying_note(self, state: BodyState, report: StepReport) -> str | None:
        """Describe how a body on the ground lies; None if it stands, or if its key frames may tip it over."""
        return None if tips_body(self.sequence.done[-1].motion) else self._lying.note(state, report)


def tips_body(motion: BodyMotion) -> bool:
    """Return True if key frames of the user may tip the body over."""
    return isinstance(motion, Follow) and any(
        key.part == "body" and key.quantity in (Quantity.ORIENTATION, Quantity.ANGULAR_MOMENTUM) for key in motion.keys
    )
