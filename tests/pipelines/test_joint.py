"""Joints of a world: a pendulum of a captured prop passes its audit and continues as it began, and invalid joints are
refused with one line."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from egs_warp.assets import pawn
from egs_warp.errors import UserError
from egs_warp.geometry.rigid_path import RigidPath
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.world_audit import ContactShape, audit_world
from egs_warp.pipelines.prop import Prop, make_prop
from egs_warp.pipelines.world import World
from egs_warp.pipelines.world_run import WorldRun, simulate_world
from tests.support.creatures import coarse_pawn


@cache
def prop() -> Prop:
    scene = pawn(gaussian_count=3000, device="cpu")
    return make_prop(scene.cloud, plane=scene.plane, density=200.0, height=0.5)


def pendulum(parts: Path | None = None, resume: Path | None = None, frames: int = 6) -> WorldRun:
    """Return the run of a prop that hangs from a point near the top of another one, which hangs from the world."""
    world = World()
    upper = world.add(prop(), above=1.0, name="upper")
    lower = world.add(prop(), at=(0.02, 0.0), above=0.505, name="lower")
    world.add_joint(upper, at=(0.03, 0.0, 1.45))
    world.add_joint(upper, at=(0.01, 0.0, 1.005), to=lower)
    folder = None if parts is None else lambda name: parts / name / "parts"
    return simulate_world(world, {}, frames=frames, parts=folder, resume=resume)


def test_a_chain_of_captured_props_passes_its_audits() -> None:
    run = pendulum()
    shapes = [
        ContactShape.of(each.body.geometry, each.body.shape.level_set, each.body.mesh.nodes)
        for each in run.world.members
    ]
    trajectories = [result.simulation.trajectory for result in run.results]
    joints = [joint.point_joint for joint in run.world.joints]
    whole = audit_world(trajectories, shapes, joints=joints)
    assert [joint.bodies for joint in run.world.joints] == [("upper",), ("upper", "lower")]
    assert max(each.gap for each in whole.joints) < 1e-12 and not whole.pairs
    assert max(each.force_residual for each in whole.joints) < 1e-12
    assert whole.momentum_residual < 1e-10 and whole.angular_momentum_residual < 1e-10
    for t in trajectories:
        result = audit(t)
        assert result.momentum_residual < 1e-9 and result.angular_momentum_residual < 1e-9
        assert energy_balance(t).max_residual < 1e-9
        assert np.abs(np.diff(t.positions[:, :, 0], axis=0)).max() > 1e-5
    weight = prop().body.weight
    vertical = trajectories[0].joint_force[trajectories[0].joint_index == 0][:, 2]
    assert vertical == pytest.approx(2.0 * weight, rel=0.1)


def test_a_continued_run_has_the_joint_forces_of_the_first_one(tmp_path: Path) -> None:
    first = pendulum(tmp_path / "first")
    second = pendulum(tmp_path / "second", resume=tmp_path / "first")
    for t, u in zip(first.results, second.results, strict=True):
        for name in ("positions", "joint_step", "joint_index", "joint_nodes", "joint_weights", "joint_force"):
            assert np.array_equal(getattr(t.simulation.trajectory, name), getattr(u.simulation.trajectory, name)), name


def test_invalid_joints_are_refused_with_one_line() -> None:
    world = World()
    left = world.add(prop(), name="left")
    world.add(prop(), at=(1.0, 0.0), name="right")
    lift = world.add(prop(), at=(3.0, 0.0), name="lift", path=RigidPath([1.0], [(0.0, 0.0, 0.1)]))
    refused = {
        r"^joint of 'lef': the world has no such body \(did you mean 'left'\?\)": ("lef", (0, 0, 0.2)),
        r"^joint at \(0\.00, 0\.00, 0\.90\): this is 0\.41 m outside left; give a point inside it": (left, (0, 0, 0.9)),
        r"^joint at \(3\.00, 0\.00, 0\.20\): lift follows a path, so the joint moves nothing": (lift, (3, 0, 0.2)),
        r"^World.add_joint: at\[1\] is nan; give a number": (left, (0, np.nan, 0.2)),
    }
    for message, (body, at) in refused.items():
        with pytest.raises(UserError, match=message):
            world.add_joint(body, at=at)
    with pytest.raises(UserError, match=r"^joint at \(0\.00, 0\.00, 0\.20\): this is 0\.\d+ m outside right"):
        world.add_joint(left, at=(0.0, 0.0, 0.2), to="right")
    with pytest.raises(UserError, match=r"^World\.add_joint: at is 'one'; give a list of numbers"):
        world.add_joint(left, at=cast(Any, "one"))
    with pytest.raises(UserError, match="both bodies are left"):
        world.add_joint(left, at=(0.0, 0.0, 0.2), to="left")
    for height in (0.1, 0.2):
        world.add_joint(left, at=(0.0, 0.0, height))
    with pytest.raises(UserError, match=r"^joint at \(0\.00, 0\.00, 0\.40\): earlier joints hold this point already"):
        world.add_joint(left, at=(0.0, 0.0, 0.4))
    assert len(world.joints) == 2


@pytest.mark.slow
def test_a_creature_stands_while_a_prop_hangs_from_its_side() -> None:
    world, scene = World(friction=0.8), pawn(gaussian_count=3000, device="cpu")
    holder = world.add(coarse_pawn(), name="holder", heading=0.0)
    points = holder.body.contact_points()
    x, y, z = max(points[points[:, 2] > 0.6].tolist(), key=lambda point: point[1])
    lamp = make_prop(scene.cloud, plane=scene.plane, density=200.0, height=0.2)
    world.add(lamp, at=(x, y + 0.045), above=z - 0.2, name="lamp")
    world.add_joint(holder, at=(x, y + 0.03, z - 0.01), to="lamp")
    run = simulate_world(world, {"holder": "stand"}, frames=25)
    assert not run.stopped
    for result in run.results:
        t = result.simulation.trajectory
        errors = audit(t)
        assert errors.momentum_residual < 1e-9 and errors.angular_momentum_residual < 1e-9
        assert energy_balance(t).max_residual < 1e-9
    t = run.results[0].simulation.trajectory
    body = holder.body.body
    turn = body.best_fit_rotation(t.positions[-1]) @ body.best_fit_rotation(t.positions[0]).T
    assert turn[2, 2] > np.cos(np.radians(2.0))
    assert -t.joint_force[:, 2].mean() == pytest.approx(lamp.body.weight, rel=0.2)
