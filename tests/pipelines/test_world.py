"""Worlds: a world of one creature gives the bits of ``simulate``, distant bodies do not affect each other, a dropped
prop comes to rest, and errors name the body and its position."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from egs_warp.assets import pawn
from egs_warp.assets.box import box_cloud
from egs_warp.contact.terrain import Solid
from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.rigid_path import RigidPath
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.world_audit import ContactShape, audit_world
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.landing import landing_of
from egs_warp.pipelines.animate_world import write_world
from egs_warp.pipelines.creature import Creature, initial_stance
from egs_warp.pipelines.prop import Prop, make_prop
from egs_warp.pipelines.simulated_run import simulate
from egs_warp.pipelines.surroundings import Surroundings
from egs_warp.pipelines.world import World
from egs_warp.pipelines.world_file import box, ramp
from egs_warp.pipelines.world_run import simulate_world
from tests.support.creatures import coarse_pawn
from tests.support.scenes import blocks

UP = np.array([0.0, 0.0, 1.0])
WALL = Solid((Plane(np.array([-1.0, 0.0, 0.0]), 1.0),))
"""Solid half-space beyond x = 1."""


@cache
def prop() -> Prop:
    scene = pawn(gaussian_count=3000, device="cpu")
    return make_prop(scene.cloud, plane=scene.plane, density=200.0, height=0.5)


def test_a_moved_body_keeps_its_place_in_the_capture() -> None:
    creature = coarse_pawn()
    assert creature.moved() is creature
    moved = creature.moved((1.0, 2.0, 0.5), 90.0)
    x, y, z = creature.start.positions.T
    np.testing.assert_allclose(moved.start.positions, np.stack([1.0 - y, 2.0 + x, 0.5 + z], axis=1), atol=1e-12)
    first, second = (one.frame.capture_points(one.start.positions) for one in (creature, moved))
    np.testing.assert_allclose(first, second, atol=1e-12)
    np.testing.assert_allclose(moved.front.direction @ creature.front.direction, 0.0, atol=1e-12)
    assert moved.body is creature.body and moved.shape is creature.shape
    slippery = moved.with_friction(0.3)
    assert slippery.geometry.friction == 0.3
    np.testing.assert_allclose(slippery.start.positions, moved.start.positions, atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("self_contact", [False, True])
def test_a_world_of_one_creature_gives_the_bits_of_the_creature_alone(self_contact: bool) -> None:
    creature, world = coarse_pawn(), World()
    world.add(creature, name="pawn", self_contact=self_contact)
    alone = simulate(creature, "jump", frames=12).trajectory
    together = simulate_world(world, {"pawn": "jump"}, frames=12)["pawn"].trajectory
    assert (alone.world_index, together.world_index) == (-1, 0 if self_contact else -1)
    for name in alone.__dataclass_fields__.keys() - {"world_index"}:
        assert np.array_equal(getattr(alone, name), getattr(together, name), equal_nan=True), name


@pytest.mark.slow
def test_distant_bodies_do_not_affect_each_other() -> None:
    """A jumping creature has the trajectory that it has alone, and a creature 3 m away stands. A prop falls from 0.1 m
    in sqrt(2 * 0.1 / g) = 0.143 s and comes to rest where it was dropped."""
    creature, world = coarse_pawn(), World(friction=0.8)
    forward = np.degrees(np.arctan2(*creature.front.direction[[1, 0]]))
    near = world.add(creature)
    far = world.add(creature, at=(3.0, 0.0), heading=forward + 90.0)
    box = world.add(prop(), at=(0.0, 2.0), above=0.1)
    assert near.body.stepper is not far.body.stepper
    run = simulate_world(world, {near: "jump 0.3"}, frames=60)
    t = run[box].trajectory
    heights = t.positions.mean(axis=1)[:, 2] - prop().start.positions.mean(axis=0)[2]
    landing = t.time[np.argmax(heights < 1e-3)]
    assert heights[0] == pytest.approx(0.1, abs=1e-9) and landing == pytest.approx(0.143, abs=0.02)
    assert np.abs(t.velocities[-1]).max() < 1e-3 and abs(heights[-1]) < 1e-3
    assert np.abs(t.positions[-1, :, :2] - t.positions[0, :, :2]).max() < 1e-3
    assert (run[far].trajectory.contact_plane == 0).all()
    alone = simulate(creature, "jump 0.3", step=float(run[near].trajectory.dt[0]), frames=60).trajectory
    assert np.array_equal(alone.positions, run[near].trajectory.positions)
    standing = run[far].trajectory.positions
    assert np.abs(standing[-1] - standing[0]).max() < 0.01


def test_invalid_worlds_are_refused_with_the_name_and_the_place() -> None:
    creature, world = coarse_pawn(), World(solids=[WALL])
    world.add(prop(), name="box")
    with pytest.raises(UserError, match="another body of the world has this name"):
        world.add(creature, at=(0.0, 3.0), name="box")
    with pytest.raises(UserError, match=r"^king: it is .* m inside solid 1 at \(1\.[0-9]+, 0\.00\); move one"):
        world.add(creature, at=(1.1, 0.0), name="king")
    with pytest.raises(UserError, match=r"^World\.add: at\[0\] is nan; give a number"):
        world.add(creature, at=(np.nan, 0.0), name="king")
    with pytest.raises(UserError, match=r"motion of 'bos': the world has no such body \(did you mean 'box'\?\)"):
        simulate_world(world, {"bos": "jump"})
    with pytest.raises(UserError, match="block: it is a prop, which does not bend; give self_contact to creatures"):
        world.add(prop(), name="block", self_contact=True)
    with pytest.raises(UserError, match="box: it is a prop, which has no muscles"):
        simulate_world(world, {"box": "jump"})
    with pytest.raises(UserError, match="world: it has no body"):
        simulate_world(World(), {})


def edged_ground() -> HeightField:
    """Return level ground that ends at x = 1 and falls by 1 m there."""
    x = -3.0 + 0.05 * np.arange(141)
    heights = np.tile(np.where(x < 1.0, 0.0, -1.0), (141, 1))
    # Used as spline coefficients, the heights give no overshoot at the edge.
    return replace(
        HeightField.through(np.eye(3), np.array([-3.0, -3.0, 0.0]), 0.05, np.zeros((141, 141))), coefficients=heights
    )


def test_a_body_rests_on_a_height_field_and_not_where_it_would_fall_over() -> None:
    """On a slope of 0.1, the prop rests at the height of the ground and is tilted like the ground."""
    x = 0.1 * np.arange(81)
    slope = HeightField.through(np.eye(3), np.array([-4.0, -4.0, 0.0]), 0.1, np.tile(0.1 * (x - 4.0), (81, 1)))
    world = World(ground=slope)
    member = world.add(prop(), at=(1.0, 0.5))
    up = member.body.body.best_fit_rotation(member.body.start.positions)[:, 2]
    np.testing.assert_allclose(up, np.array([-0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0), atol=0.01)
    gaps, _ = member.body.stepper.detector.gaps(member.body.start.positions)
    assert abs(gaps.min()) < 0.002
    with pytest.raises(UserError, match=r"prop-2: it falls over at .* too uneven there"):
        World(ground=edged_ground()).add(prop(), at=(1.0, 0.0), name="prop-2")
    tilted = replace(slope, axes=np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    with pytest.raises(UserError, match="ground 0,1,0: its heights are not measured along the z axis"):
        World(ground=tilted)


@pytest.mark.slow
def test_what_goes_over_the_edge_of_the_ground_falls() -> None:
    """Props on the ground and on the floor below it stay at rest. A prop that slides at 4 m/s towards the edge 1 m away
    falls over the edge."""
    world = World(ground=edged_ground())
    low, high = world.add(prop(), at=(2.0, 0.0), above=0.01), world.add(prop(), at=(0.0, 0.0))
    assert low.body.start.positions[:, 2].mean() < -0.7
    run = simulate_world(world, {}, frames=60)
    for member in (low, high):
        moved = run[member].trajectory.positions[-1] - run[member].trajectory.positions[0]
        assert np.abs(moved[:, :2]).max() < 0.01 and np.abs(moved[:, 2]).max() < 0.02
    pushed = World(ground=edged_ground())
    member = pushed.add(prop(), at=(0.0, 0.0))
    start = replace(member.body.start, velocities=member.body.start.velocities + np.array([4.0, 0.0, 0.0]))
    pushed._members[member.name] = replace(member, body=replace(member.body, start=start))
    t = simulate_world(pushed, {}, frames=90)[member.name].trajectory
    assert t.positions[-1, :, 0].mean() > 1.0 and t.positions[-1, :, 2].mean() < -0.5
    assert np.isfinite(t.positions).all()


def world_with_block(creature: Creature, axes: np.ndarray, *, density: float = 1000.0, slope: float = 0.0) -> World:
    """Return a world with these ``axes`` (3, 3) and a block of height 0.4, on which ``creature`` stands in the
    capture. With a ``slope``, the top of the block rises along x of the capture."""
    own = creature.frame
    cloud = blocks(((-0.6, -0.6, -0.4), (0.6, 0.6, -0.02)))
    means = cloud.means.numpy()
    means[:, 2] += (means[:, 2] + 0.4) / 0.38 * slope * means[:, 0]
    cloud = replace(cloud, means=wp.array(means, dtype=wp.vec3))
    frame = BodyFrame(axes, own.origin - 0.4 * UP, own.scale)
    world = World(surroundings=Surroundings(frame, creature.cloud))
    block = make_prop(cloud, plane=Plane(UP, 0.4), metres_per_unit=own.scale, density=density)
    world.add(block, name="block", as_captured=True)
    return world


@pytest.mark.slow
def test_a_creature_jumps_from_a_heavy_block_as_from_the_ground() -> None:
    """A motion regards the block as its ground: the thrust lasts as long and the jump is as high. The forces between
    the two bodies cancel, and the block stays where it is."""
    creature = coarse_pawn()
    on_ground = World()
    on_ground.add(creature, name="pawn")
    on_block = world_with_block(creature, creature.frame.axes, density=4000.0)
    on_block.add(creature, name="pawn", as_captured=True)
    rises = []
    for world in (on_ground, on_block):
        run = simulate_world(world, {"pawn": "jump 0.2 0.3"}, frames=60)
        heights = run["pawn"].trajectory.positions @ UP @ creature.body.node_mass / creature.body.mass
        rises.append(heights.max() - heights[0])
    assert rises[0] == pytest.approx(0.3 * creature.body.height, rel=0.1)
    assert rises[1] == pytest.approx(rises[0], rel=0.05)
    bodies = [member.body for member in on_block.members]
    shapes = [ContactShape.of(body.geometry, body.shape.level_set, body.mesh.nodes) for body in bodies]
    result = audit_world([run[member].trajectory for member in on_block.members], shapes)
    assert result.momentum_residual < 1e-12 and result.angular_momentum_residual < 1e-12
    (pair,) = result.pairs
    assert pair.unmatched_contacts == 0 and max(pair.force_residual, pair.torque_residual) < 1e-12
    block = run["block"].trajectory.positions
    assert np.abs(block - block[0]).max() < 0.005


@pytest.mark.slow
def test_a_body_is_placed_as_captured_and_stands_on_another_one() -> None:
    """The pawn of a capture stands on a block below it. In a world that is turned by 90 degrees, both are where the
    capture shows them. The stance of the pawn is on the block, and a jump over the block's edge ends 0.4 lower."""
    creature = coarse_pawn()
    own = creature.frame
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    world = world_with_block(creature, turn @ own.axes)
    assert world.surroundings is not None
    frame = world.surroundings.frame
    placed = world.add(creature, name="pawn", as_captured=True).body
    assert isinstance(placed, Creature) and placed.support is not None and world.member("block").body.support is None
    captured = own.capture_points(creature.start.positions)
    np.testing.assert_allclose(frame.capture_points(placed.start.positions), captured, atol=0.03)
    stance = initial_stance(placed)
    np.testing.assert_allclose(stance.ground.origin[2], 0.4 * own.scale, atol=0.03)
    assert len(stance.contact_points) > 3 and len(stance.feet()) == len(initial_stance(creature).feet())
    lower = landing_of(stance, JumpTarget(distance=2.0, height=0.2))
    assert lower.rise == pytest.approx(-0.4 * own.scale, abs=0.03)
    with pytest.raises(UserError, match="the world has no surroundings"):
        World().add(creature, as_captured=True)
    smaller = World(surroundings=Surroundings(replace(frame, scale=2.0 * own.scale), creature.cloud))
    with pytest.raises(UserError, match="creature-1: its scale and up direction differ from those of the surroundings"):
        smaller.add(creature, as_captured=True)


@pytest.mark.slow
def test_a_creature_starts_at_rest_on_the_sloped_top_of_a_block() -> None:
    """The capture shows the pawn upright over a top that rises by 0.1. At the start it stands on this top: its stance
    has the normal of the top and most of the base as its support, the first step carries the weight, and the pawn stays
    where it is."""
    creature, slope = coarse_pawn(), 0.1
    world = world_with_block(creature, creature.frame.axes, density=4000.0, slope=slope)
    placed = world.add(creature, name="pawn", as_captured=True).body
    assert isinstance(placed, Creature)
    stance, level = initial_stance(placed), initial_stance(creature)
    x = creature.frame.axes[:, 0]
    normal = (UP - slope * x) / np.hypot(1.0, slope)
    np.testing.assert_allclose(stance.ground.surface_normal, normal, atol=0.02)
    np.testing.assert_allclose(placed.body.best_fit_rotation(placed.start.positions)[:, 2], normal, atol=0.02)
    extents = [np.ptp(one.ground.local(one.contact_points)[:, :2], axis=0) for one in (stance, level)]
    assert (extents[0] > 0.7 * extents[1]).all()
    run = simulate_world(world, {"pawn": "stand"}, frames=20)["pawn"].trajectory
    first = run.contact_step == 0
    force = run.contact_force[first].sum(axis=0)
    np.testing.assert_allclose(force, placed.body.weight * UP, atol=0.1 * placed.body.weight)
    assert np.abs(run.positions - run.positions[0]).max() < 0.005 * placed.body.height


@pytest.mark.slow
def test_a_creature_on_a_solid_or_a_prop_stands_there() -> None:
    """The ground of the stance is the top of the solid or of the prop that ``above`` reaches."""
    creature = coarse_pawn()
    on_box = World(solids=[box((0.0, 0.0), (3.0, 3.0, 0.3))]).add(creature).body
    on_ramp = World(solids=[ramp((-2.0, 0.0), 4.0, 4.0, 0.4)]).add(creature).body
    world = World()
    block = make_prop(blocks(((-0.5, -0.5, 0.0), (0.5, 0.5, 0.4))), up="z", metres_per_unit=1.0)
    top = world.add(block, name="block").body.contact_points()[:, 2].max()
    on_prop = world.add(creature, above=top + 0.008, name="pawn").body
    assert isinstance(on_box, Creature) and isinstance(on_ramp, Creature) and isinstance(on_prop, Creature)
    for placed, height, slope in ((on_box, 0.3, 0.0), (on_ramp, 0.2, 0.1), (on_prop, top, 0.0)):
        stance = initial_stance(placed)
        normal = np.array([-slope, 0.0, 1.0]) / np.hypot(1.0, slope)
        np.testing.assert_allclose(stance.ground.surface_normal, normal, atol=0.02)
        x, _, z = stance.ground.origin
        assert z == pytest.approx(height + slope * x, abs=0.01)


@pytest.mark.parametrize(
    ("on_prop", "stands", "falls"),
    [(False, 0.05, 0.02), pytest.param(True, 0.12, 0.07, marks=pytest.mark.slow)],
)
def test_a_creature_that_would_tip_slowly_over_an_edge_is_refused(on_prop: bool, stands: float, falls: float) -> None:
    """Distances of the centre of mass from the edge of a solid, and from the rounded rim of a prop, at which the pawn
    stands still for 1 s, and at which it is upright to 10 degrees when it has been settled, but then falls."""
    creature = coarse_pawn()
    centre = creature.body.centre_of_mass(creature.start.positions)[0]

    def add(distance: float) -> Creature:
        world, edge, above = World(solids=[] if on_prop else [box((0.0, 0.0), (1.0, 1.0, 0.4))]), 0.5, 0.0
        if on_prop:
            block = make_prop(blocks(((-0.5, -0.5, 0.0), (0.5, 0.5, 0.4))), up="z", metres_per_unit=1.0)
            edge, _, above = world.add(block).body.contact_points().max(axis=0) + [0.0, 0.0, 0.002]
        body = world.add(creature, at=(edge - distance - centre, 0.0), above=above, name="pawn").body
        assert isinstance(body, Creature)
        return body

    assert add(stands).support is not None
    with pytest.raises(UserError, match=r"^pawn: it falls over .* its centre of mass is 0\.0\d+ m outside its support"):
        add(falls)


def test_a_driven_prop_follows_its_path_and_its_balances_hold() -> None:
    world = World()
    path = RigidPath([0.2, 0.4], [(0.0, 0.0, 0.2), (0.3, 0.0, 0.0)], [0.0, 90.0])
    lift = world.add(prop(), heading=0.0, path=path)
    run = simulate_world(world, {})[lift]
    t = run.trajectory
    assert t.time[-1] >= 0.4
    assert t.positions[-1] == pytest.approx(path.moved(t.positions[0], 0.4), abs=1e-12)
    result = audit(t)
    assert result.momentum_residual < 1e-12 and result.angular_momentum_residual < 1e-12
    assert energy_balance(t).max_residual < 1e-9
    with pytest.raises(UserError, match=r"^creature-2: it is a creature, which moves with its muscles"):
        world.add(coarse_pawn(), path=path)


@pytest.mark.slow
def test_the_friction_of_two_materials_carries_a_box_on_a_plate(tmp_path: Path) -> None:
    """A plate moves by 0.3 m in 0.7 s, with at most 0.36 g, which the friction of the pair allows. With the friction of
    the world, the box would move by at most 0.1 m. The audit uses the coefficient of the pair."""
    plate, box = (
        make_prop(box_cloud(size, lambda points: (0.5, 0.5, 0.5), spacing=0.05), up="z", height=size[2])
        for size in ((1.2, 0.6, 0.2), (0.3, 0.3, 0.2))
    )
    world = World(friction=0.02, frictions={("wood", "rubber"): 0.9})
    world.add(plate, path=RigidPath([0.7], [(0.3, 0.0, 0.0)]), name="plate", material="rubber")
    world.add(box, above=0.2, name="box", material="wood")
    run = simulate_world(world, {}, frames=50)
    moved = [np.ptp(run[name].trajectory.positions[:, 0, 0]) for name in ("plate", "box")]
    np.testing.assert_allclose(moved, 0.3, atol=0.03)
    assert "audit: passed" in write_world(run, tmp_path / "run", film=False).summary()
