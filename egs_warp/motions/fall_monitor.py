"""A body that has fallen ends its motion: told by how it is tilted, and by what it lies on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egs_warp.fem.body import BodyState
from egs_warp.geometry.frames import nearest_rotation
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.stepper import StepReport
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.follow import Follow
from egs_warp.motions.get_up import GetUp
from egs_warp.motions.keyframes import Quantity
from egs_warp.motions.sequence import BodyMotion, MotionSequence, MotionTask, Stance
from egs_warp.motions.stance import sole_shares

FALLEN_TILT = 60.0
"""Degrees. A body on feet of half width w, its centre of mass h above them, has tipped for good beyond atan(w / h): by
60 degrees whatever is no wider than 3.5 h, and so all that can tip."""
MIN_LYING_LOAD = 0.5
"""Of the weight. Where the ground bears so much of a body and none of it by the base, it lies on something else; less
is what brushes a riser or a wall."""
MAX_RECOVERIES = 3
"""In one run."""
FALLEN_TIME = 0.5
"""Of sqrt(H / g): for how long either must last on the ground. A body falls by H / 8 meanwhile; what a landing does in
passing is shorter."""


class FallMonitor:
    """Runs a sequence until its body has fallen, then asks for nothing more: the muscles let go. Or it gets up, and
    goes on with what is next. A ball cannot fall."""

    def __init__(self, sequence: MotionSequence, place: Stance, *, gets_up: bool = False) -> None:
        """``place``: how the body stands; ``gets_up``: whether it is to try that."""
        body = place.body
        self.sequence = sequence
        self._body, self._up = body, place.ground.axes[2]
        arms = place.standing - body.centre_of_mass(place.standing)
        self._moments = body.node_mass[:, None] * arms
        self._has_upright = place.base() is not SupportKind.ROUND_BASE
        self._in_base = sole_shares(body, place.ground, place.standing) > 0.0
        self._longest = FALLEN_TIME * float(np.sqrt(body.height / np.linalg.norm(body.gravity)))
        self._seen = self._lain = 0.0
        self._gets_up, self._risen = gets_up, 0
        self.spent = 0.0
        """Seconds in which it has got up."""
        self.time = 0.0
        """Seconds of the state that it saw last."""
        self.fallen: str | None = None
        """How it was told, once the body has fallen."""

    @property
    def is_finished(self) -> bool:
        """Whether the last motion has come to rest, or the body has fallen."""
        return self.sequence.is_finished or self.fallen is not None

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        """Those of the sequence, none of a fallen body."""
        self.time = state.time
        if self.fallen is None and report is not None and self._has_upright:
            self._check_fall(state, report)
        return self.sequence.objectives(state, report, dt) if self.fallen is None else []

    def _check_fall(self, state: BodyState, report: StepReport) -> None:
        past, self._seen = state.time - self._seen, state.time
        motion = self.sequence.done[-1].motion
        if isinstance(motion, GetUp):
            self._check_recovery(motion, past)
            return
        # What bounces on its side has not come to its feet in between.
        if report.forces[:, 0].sum() <= 0.0:
            return
        lies = self._lying_note(state, report) if not _tips(self.sequence.done[-1].motion) else None
        self._lain = 0.0 if lies is None else self._lain + past
        if self._lain >= self._longest:
            self._record_fall(f"{lies} at {state.time:.2f} s")

    def _record_fall(self, why: str) -> None:
        self._lain = 0.0
        if not self._gets_up or self._risen == MAX_RECOVERIES:
            self.fallen = why
            return
        self._risen += 1
        self.sequence.start_get_up(MotionTask("get up", {}, GetUp), why)

    def _check_recovery(self, getting_up: GetUp, past: float) -> None:
        """How it gets on."""
        self.spent += past
        if not getting_up.resting:
            return
        before = self.sequence.done[-2] if len(self.sequence.done) > 1 else None
        if getting_up.up and before is not None and before.fell is not None:
            before.got_up = True
        elif not getting_up.up:
            told = before.fell if before is not None else None
            self.fallen = told or f"it does not get up, at {self._seen:.2f} s"

    def _lying_note(self, state: BodyState, report: StepReport) -> str | None:
        """How a body on the ground lies that does not stand on it."""
        loads = report.forces[:, 0] / self._body.weight
        # By how the body stood, as ``best_turn``; moments about the centre of mass sum to nothing.
        turn = nearest_rotation(state.positions.T @ self._moments)
        tilt = float(np.degrees(np.arccos(np.clip(self._up @ turn @ self._up, -1.0, 1.0))))
        if tilt > FALLEN_TILT:
            return f"tilted by {tilt:.0f} degrees"
        on_base = self._in_base[report.contacts.nodes].any(axis=1)
        if loads.sum() > MIN_LYING_LOAD and loads[on_base].sum() <= 0.0:
            return "its base off the ground"
        return None


def _tips(motion: BodyMotion) -> bool:
    """Whether its user may ask a ``motion`` to tip the body."""
    return isinstance(motion, Follow) and any(
        key.part == "body" and key.quantity in (Quantity.ORIENTATION, Quantity.ANGULAR_MOMENTUM) for key in motion.keys
    )
