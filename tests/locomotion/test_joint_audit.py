"""Audit of joints: the errors of two bodies that hang from each other are near zero, and deliberate errors in the
trajectories are measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from egs_warp.fem.joints import PointJoint
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.joint_audit import JointAudit, audit_joint
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.locomotion.world_audit import ContactShape, audit_world
from tests.support.passive import ABYSS
from tests.support.props import RunningWorld, box_body, point_at

DT = 1 / 120
TOP, MIDDLE, BELOW = np.array([0.05, 0.0, 0.3]), np.array([0.1, 0.0, 0.0]), (0.1, 0.0, -0.3)


@dataclass(frozen=True)
class Recorded:
    """Recorded run of a swinging chain of two boxes."""

    trajectories: tuple[Trajectory, ...]
    shapes: tuple[ContactShape, ...]
    joints: tuple[PointJoint, ...]

    def audit(self, joint: int = 1) -> JointAudit:
        return audit_joint(self.joints[joint], joint, self.trajectories)

    def with_array(self, body: int, name: str, values: np.ndarray) -> Recorded:
        """Return the run with a replaced array in the trajectory of a body."""
        changed = list(self.trajectories)
        changed[body] = replace(changed[body], **{name: values})
        return replace(self, trajectories=tuple(changed))


@cache
def chain() -> Recorded:
    bodies = [box_body((0.3, 0.3, 0.3), plane=ABYSS, soft=True), box_body((0.2, 0.2, 0.3), plane=ABYSS)]
    joints = (
        PointJoint((point_at(0, bodies[0], TOP),), TOP),
        PointJoint((point_at(0, bodies[0], MIDDLE), point_at(1, bodies[1], MIDDLE, BELOW)), MIDDLE),
    )
    world = RunningWorld(bodies, [(0.0, 0.0, 0.0), BELOW], joints=joints)
    recorders = [
        Recorder(b.stepper.body, b.stepper.muscles, b.stepper.geometry, state, 1.0, drag=b.stepper.settings.drag)
        for b, state in zip(bodies, world.states, strict=True)
    ]
    for _ in range(12):
        world.advance(DT)
        for recorder, reports in zip(recorders, world.reports, strict=True):
            recorder.add(reports)
    shapes = tuple(ContactShape.of(b.stepper.geometry, b.level_set, b.rest_positions) for b in bodies)
    return Recorded(tuple(recorder.trajectory() for recorder in recorders), shapes, joints)


def test_the_errors_of_a_chain_are_near_zero() -> None:
    run = chain()
    for joint in range(2):
        errors = run.audit(joint)
        assert errors.gap < 1e-14 and errors.unmatched_forces == 0 and errors.work_residual < 1e-14
        assert errors.force_residual < 1e-12 and errors.torque_residual < 1e-12
        assert errors.largest_force > 0.1
    for t in run.trajectories:
        books, errors = energy_balance(t), audit(t)
        assert books.max_residual < 1e-9 and np.abs(books.joints).max() > 1e-6 * books.energy_unit
        assert errors.momentum_residual < 1e-9 and errors.angular_momentum_residual < 1e-9
    world = audit_world(run.trajectories, run.shapes, joints=run.joints)
    assert world.pairs == () and [each.bodies for each in world.joints] == [(0,), (0, 1)]
    assert world.momentum_residual < 1e-12 and world.angular_momentum_residual < 1e-12


def test_deliberate_errors_are_measured() -> None:
    run = chain()
    t, u = run.trajectories
    larger = 1.01 * u.joint_force
    changed = run.with_array(1, "joint_force", larger)
    errors = changed.audit()
    assert errors.force_residual > 1e-3 and errors.torque_residual > 1e-3
    assert audit(changed.trajectories[1]).momentum_residual > 1e-3
    assert energy_balance(changed.trajectories[1]).max_residual > 1e-7
    fewer = {name: getattr(u, name)[1:] for name in ("joint_step", "joint_index", "joint_nodes", "joint_weights")}
    missing = replace(run, trajectories=(t, replace(u, joint_force=u.joint_force[1:], **fewer)))
    assert missing.audit().unmatched_forces == 1
    lowered = run.with_array(1, "positions", u.positions - [0.0, 0.0, 1e-3])
    assert lowered.audit().gap == pytest.approx(1e-3 / 0.3, rel=1e-6)
    moved = run.with_array(1, "positions", u.positions * np.linspace(1.0, 1.01, len(u.time))[:, None, None])
    assert moved.audit().work_residual > 1e-6


def test_the_joint_with_the_world_counts_as_an_external_force() -> None:
    run = chain()
    t = run.trajectories[0]
    changed = run.with_array(0, "joint_force", np.where(t.joint_index[:, None] == 0, 1.001, 1.0) * t.joint_force)
    world = audit_world(changed.trajectories, run.shapes, joints=run.joints)
    assert world.momentum_residual > 1e-6 and world.angular_momentum_residual > 1e-7
