"""Audit of a world: all errors are near zero in a collision and in a slide, and deliberate errors in the trajectories
are measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.recorder import Recorder
from egs_warp.locomotion.stepper import WarmStart
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.locomotion.world_audit import ContactShape, PairAudit, WorldAudit, audit_world
from tests.support.passive import ABYSS
from tests.support.props import RunningWorld, box_body, prongs_in_flight

DT = 1 / 120
NEAR_ZERO = {
    "force_residual": 1e-12,
    "torque_residual": 1e-12,
    "cone_violation": 1e-9,
    "friction_gap": 1e-8,
    "complementarity_gap": 1e-9,
    "gap_error": 1e-10,
    "normal_error": 1e-10,
    "penetration": 0.01,
    "unmatched_contacts": 0,
}


@dataclass(frozen=True)
class Recorded:
    """Recorded run of a world of two bodies."""

    trajectories: tuple[Trajectory, ...]
    shapes: tuple[ContactShape, ...]
    frictions: np.ndarray

    def audit(self) -> WorldAudit:
        return audit_world(self.trajectories, self.shapes, frictions=self.frictions)

    def with_arrays(self, body: int, **arrays: Any) -> Recorded:
        """Return the run with replaced arrays in the trajectory of one body."""
        changed = list(self.trajectories)
        changed[body] = replace(changed[body], **arrays)
        return replace(self, trajectories=tuple(changed))

    def with_force(self, contact: int, force: np.ndarray) -> Recorded:
        """Return the run with another ``force`` in one contact of body 0 and the opposite force in that of body 1."""
        t, u = self.trajectories
        other = np.flatnonzero((u.contact_normal == -t.contact_normal[contact]).all(axis=1))
        steps = u.contact_step[other] == t.contact_step[contact]
        same = other[steps & (u.contact_force[other] == -t.contact_force[contact]).all(axis=1)]
        other = same[np.argmin(np.abs(u.contact_gap[same] - t.contact_gap[contact]))]
        forces, opposite = t.contact_force.copy(), u.contact_force.copy()
        forces[contact], opposite[other] = force, -force
        return self.with_arrays(0, contact_force=forces).with_arrays(1, contact_force=opposite)


def record(world: RunningWorld, steps: int, *, halved: Sequence[int] = ()) -> Recorded:
    """Run a world and record it. If ``halved`` is given, there is an additional first step, which only the bodies
    ``halved`` make in two half steps."""
    bodies = world.stepper.bodies
    recorders = [
        Recorder(each.stepper.body, each.stepper.muscles, each.stepper.geometry, state, 0.0, drag=0.0)
        for each, state in zip(bodies, world.states, strict=True)
    ]
    if halved:
        for i, (body, recorder) in enumerate(zip(bodies, recorders, strict=True)):
            for _ in range(1 + (i in halved)):
                dt = DT / (1 + (i in halved))
                end, _, reports = body.stepper.advance(world.states[i], body.stepper.initial_memory(), (), dt)
                world.states[i], world.memories[i] = end, WarmStart.from_report(reports[-1])
                recorder.add(reports)
    for _ in range(steps):
        world.advance(DT)
        for recorder, reports in zip(recorders, world.reports, strict=True):
            recorder.add(reports)
    return Recorded(
        tuple(recorder.trajectory() for recorder in recorders),
        tuple(ContactShape.of(each.stepper.geometry, each.level_set, each.rest_positions) for each in bodies),
        world.stepper.frictions,
    )


@cache
def collision(*, halved: Sequence[int] = ()) -> Recorded:
    """A prop hits a soft block in flight, with friction."""
    bodies = [box_body((0.4, 0.4, 0.4), plane=ABYSS), box_body((0.8, 0.4, 0.4), plane=ABYSS, soft=True)]
    world = RunningWorld(bodies, [(0.0, 0.0, 0.0), (0.63, 0.0, 0.05)], [(1.0, 0.0, 0.5), (0.0, 0.0, 0.0)])
    return record(world, 8, halved=halved)


@cache
def closing() -> Recorded:
    """Two prongs of one body meet in flight."""
    return record(prongs_in_flight(self_contact=True), 16)


def audit_of_one(recorded: Recorded) -> WorldAudit:
    return audit_world(recorded.trajectories, recorded.shapes, frictions=recorded.frictions, self_contact=(0,))


@cache
def slide() -> Recorded:
    """A prop slides down another prop, whose coefficient of friction with the ground is larger."""
    slope = np.arctan(0.55)
    up = np.array([-np.sin(slope), 0.0, np.cos(slope)])
    bodies = [box_body((1.6, 0.8, 0.2), up=up, friction=0.9), box_body((0.2, 0.2, 0.1), up=up, friction=0.1)]
    return record(RunningWorld(bodies, [(0, 0, 0), (-0.4, 0, 0.2)], frictions=np.full((2, 2), 0.5)), 12)


def only_pair(recorded: Recorded) -> PairAudit:
    (pair,) = recorded.audit().pairs
    return pair


@pytest.mark.parametrize("run", [collision, slide])
def test_a_correct_run_passes(run: Any) -> None:
    recorded = run()
    found = recorded.audit()
    assert max(found.momentum_residual, found.angular_momentum_residual) < 1e-12
    for name, bound in NEAR_ZERO.items():
        assert found.worst(name) <= bound, name
    (pair,) = found.pairs
    assert pair.bodies == (0, 1) and pair.contacts > 50 and pair.friction_work < 0.0
    deepest = -min(float(t.min_gap[1:].min()) for t in recorded.trajectories)
    height = min(t.height for t in recorded.trajectories)
    assert pair.penetration * height <= deepest + 1e-9
    # The work of the contacts equals the contact terms in the energy balances of both bodies.
    if run is collision:
        books = [energy_balance(t) for t in recorded.trajectories]
        flows = [sum(float((b.friction + b.contact + b.push_out).sum()) for b in books)]
        assert pair.friction_work + pair.contact_work + pair.push_out_work == pytest.approx(sum(flows), rel=1e-9)
        assert pair.penetration * height == pytest.approx(deepest, rel=1e-6)


def test_the_audit_of_a_body_leaves_its_friction_with_bodies_to_the_pair() -> None:
    assert all(audit(t).cone_violation < 1e-9 for t in slide().trajectories)


def test_friction_of_a_slide_dissipates_the_work_of_coulomb_friction() -> None:
    recorded = slide()
    lower, upper = recorded.trajectories
    moved = [np.diff(t.positions[[0, -1]].mean(axis=1), axis=0)[0] for t in (lower, upper)]
    normal_force = -upper.node_mass.sum() * upper.gravity[2]
    work = only_pair(recorded).friction_work
    assert work == pytest.approx(-0.5 * normal_force * abs(moved[1] - moved[0])[0], rel=1e-3)


def test_bodies_with_different_steps_are_compared_at_common_times() -> None:
    recorded = collision(halved=(1,))
    assert [len(t.dt) for t in recorded.trajectories] == [9, 10]
    found = recorded.audit()
    assert max(found.momentum_residual, found.angular_momentum_residual) < 1e-12
    assert all(found.worst(name) <= bound for name, bound in NEAR_ZERO.items())
    assert only_pair(recorded).contacts > 50


def test_a_force_without_reaction_is_detected() -> None:
    recorded = collision()
    t = recorded.trajectories[0]
    forces, unit = t.contact_force.copy(), t.node_mass.sum() * 9.81
    chosen = np.argmax(np.linalg.norm(forces, axis=1))
    forces[chosen] *= 1.01
    pair = only_pair(recorded.with_arrays(0, contact_force=forces))
    added = forces[chosen] / 101.0
    assert pair.force_residual == pytest.approx(np.linalg.norm(added) / unit, rel=1e-6)
    point = t.contact_weights[chosen] @ t.positions[t.contact_step[chosen], t.contact_nodes[chosen]]
    assert pair.torque_residual == pytest.approx(np.linalg.norm(np.cross(point, added)) / (unit * 0.4), rel=1e-6)
    assert pair.unmatched_contacts == 2


def test_a_missing_record_is_detected() -> None:
    recorded = collision()
    t = recorded.trajectories[0]
    own = t.contact_plane.copy()
    own[np.argmax(np.linalg.norm(t.contact_force, axis=1))] = -3
    pair = only_pair(recorded.with_arrays(0, contact_plane=own))
    assert pair.unmatched_contacts == 1 and pair.force_residual > 0.01


def test_friction_not_opposite_to_the_relative_slip_is_detected() -> None:
    """The friction of one contact is reversed or halved in the records of both bodies, so action still equals
    reaction."""
    recorded = slide()
    t = recorded.trajectories[0]
    touching = np.flatnonzero(t.contact_plane < 0)
    contact = touching[np.argmax(np.linalg.norm(t.contact_force[touching], axis=1) * (t.contact_step[touching] > 8))]
    normal = t.contact_normal[contact]
    pressed = t.contact_force[contact] @ normal
    tangential = t.contact_force[contact] - pressed * normal
    for factor in (-1.0, 0.5):
        pair = only_pair(recorded.with_force(int(contact), pressed * normal + factor * tangential))
        assert pair.friction_gap > 1e-5 and pair.cone_violation < 1e-9
        assert pair.unmatched_contacts == 0 and pair.force_residual < 1e-12
    wider = only_pair(recorded.with_force(int(contact), pressed * normal + 1.2 * tangential))
    weight = recorded.trajectories[1].node_mass.sum() * 9.81
    assert wider.cone_violation == pytest.approx(0.1 * pressed / weight, rel=1e-6)
    assert only_pair(replace(recorded, frictions=np.full((2, 2), 0.4))).cone_violation > 0.01


def test_a_force_across_a_gap_is_detected() -> None:
    recorded = collision()
    t = recorded.trajectories[0]
    apart = int(np.argmax(t.contact_gap))
    assert t.contact_gap[apart] > 1e-4
    pair = only_pair(recorded.with_force(apart, 10.0 * t.contact_normal[apart]))
    unit = t.node_mass.sum() * 9.81 * 0.4
    assert pair.complementarity_gap == pytest.approx(10.0 * t.contact_gap[apart] / unit, rel=1e-6)


def test_wrong_gaps_and_normals_are_detected() -> None:
    recorded = collision()
    u = recorded.trajectories[1]
    gaps, normals = u.contact_gap.copy(), u.contact_normal.copy()
    gaps[20] += 1e-4
    assert only_pair(recorded.with_arrays(1, contact_gap=gaps)).gap_error == pytest.approx(1e-4 / 0.4, rel=1e-6)
    normals[20] += [0.0, 1e-3, 0.0]
    assert only_pair(recorded.with_arrays(1, contact_normal=normals)).normal_error == pytest.approx(1e-3, rel=1e-6)


def test_lost_momenta_are_detected() -> None:
    """The deliberate errors are in the velocity of one node, in the rotation of one body, which no torque causes, and
    in ground forces."""
    recorded = collision()
    masses = [t.node_mass.sum() for t in recorded.trajectories]
    u = recorded.trajectories[1]
    velocities, speed = u.velocities.copy(), np.sqrt(9.81 * 0.4)
    velocities[-1, 3] += [0.0, 1e-3, 0.0]
    found = recorded.with_arrays(1, velocities=velocities).audit()
    assert found.momentum_residual == pytest.approx(1e-3 * u.node_mass[3] / (sum(masses) * speed), rel=1e-6)
    velocities = u.velocities.copy()
    arms = u.positions[-1] - u.node_mass @ u.positions[-1] / u.node_mass.sum()
    velocities[-1] += np.cross([0.0, 0.0, 1e-3], arms)
    found = recorded.with_arrays(1, velocities=velocities).audit()
    assert found.momentum_residual < 1e-12 and found.angular_momentum_residual > 1e-6
    on_ground = slide()
    t = on_ground.trajectories[0]
    forces = np.where(t.contact_plane[:, None] < 0, 1.0, 1.001) * t.contact_force
    assert on_ground.with_arrays(0, contact_force=forces).audit().momentum_residual > 1e-7


def test_penetration_is_recomputed_from_the_level_set() -> None:
    """In one state, the prop is moved 0.05 m further into the block."""
    recorded = collision()
    t = recorded.trajectories[0]
    positions = t.positions.copy()
    positions[5] += [0.05, 0.0, 0.0]
    before = -min(float(each.min_gap[5]) for each in recorded.trajectories)
    found = only_pair(recorded.with_arrays(0, positions=positions)).penetration
    assert found * 0.4 == pytest.approx(0.05 + before, abs=2e-3)


def test_a_body_that_touches_itself_passes() -> None:
    recorded = closing()
    found = audit_of_one(recorded)
    assert max(found.momentum_residual, found.angular_momentum_residual) < 1e-12
    for name, bound in NEAR_ZERO.items():
        assert found.worst(name) <= bound, name
    (pair,) = found.pairs
    assert pair.bodies == (0, 0) and pair.contacts > 10 and pair.friction_work < 0.0
    (t,) = recorded.trajectories
    book = energy_balance(t)
    assert book.max_residual < 1e-9
    flow = float((book.friction + book.contact + book.push_out).sum())
    assert pair.friction_work + pair.contact_work + pair.push_out_work == pytest.approx(flow, rel=1e-9)
    contacts = prongs_in_flight(self_contact=True).stepper.island((0,)).contacts
    deepest = min(float(contacts.min_self_gaps(positions).min()) for positions in t.positions)
    assert pair.penetration * t.height == pytest.approx(-deepest, abs=1e-9)
    assert recorded.audit().pairs == ()


def test_errors_in_self_contact_are_detected() -> None:
    recorded = closing()
    (t,) = recorded.trajectories
    forces, gaps = t.contact_force.copy(), t.contact_gap.copy()
    chosen = np.argmax(np.linalg.norm(forces, axis=1))
    forces[chosen] *= 1.01
    (pair,) = audit_of_one(recorded.with_arrays(0, contact_force=forces)).pairs
    added = np.linalg.norm(forces[chosen]) / 101.0
    assert pair.force_residual == pytest.approx(added / (t.node_mass.sum() * 9.81), rel=1e-6)
    assert pair.torque_residual > 0.0 and pair.unmatched_contacts == 2
    gaps[chosen] += 1e-4
    (pair,) = audit_of_one(recorded.with_arrays(0, contact_gap=gaps)).pairs
    assert pair.gap_error == pytest.approx(1e-4 / t.height, rel=1e-6)
