"""Following key frames: measured quantities of a posed block, objectives of the next step, and messages about missed
keys."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.objectives import AngularMomentumObjective, Objective
from egs_warp.motions.follow import Follow, FollowPhase, FollowPlan
from egs_warp.motions.keyframes import Key, Quantity
from egs_warp.motions.sequence import Stance
from tests.support.meshes import block_mesh, figure, stool
from tests.support.stances import standing_stance

DT = 1 / 60


@pytest.fixture
def place() -> Stance:
    return standing_stance(block_mesh())


def key(time: float, part: str, quantity: Quantity, value: tuple[float, float, float]) -> Key:
    return Key(time, part, quantity, value, where="k.json, key 1")


@pytest.mark.parametrize("part", ["body", "base", "head", "foot"])
def test_each_quantity_is_measured_in_its_unit_along_forward_left_up(place: Stance, part: str) -> None:
    """The body moves rigidly; forward is +y and left is -x. Lengths are in H, angular momenta in m H^2 / s."""
    body, height = place.body, place.body.height
    follow = Follow(place, [key(1.0, part, Quantity.POSITION, (0.1, 0.0, 0.0))])
    turn = Rotation.from_rotvec(np.radians(30.0) * np.array([0.0, 0.0, 1.0]))
    nodes = follow.parts[part].nodes
    centre = follow.parts[part].centre(place.standing)
    positions = centre + turn.apply(place.standing - centre) + height * np.array([-0.2, 0.1, 0.3])
    omega = np.array([0.0, 2.0, 0.0])
    velocities = height * np.array([-0.5, 0.7, 0.0]) + np.cross(omega, positions - follow.parts[part].centre(positions))
    state = BodyState(positions, velocities)
    assert np.allclose(follow._measure(part, Quantity.POSITION, state), [0.1, 0.2, 0.3])
    assert np.allclose(follow._measure(part, Quantity.ORIENTATION, state), [0.0, 0.0, 30.0])
    assert np.allclose(follow._measure(part, Quantity.VELOCITY, state), [0.7, 0.5, 0.0])
    arms = positions[nodes] - follow.parts[part].centre(positions)
    spin = (body.node_mass[nodes, None] * np.cross(arms, np.cross(omega, arms))).sum(axis=0) / (body.mass * height**2)
    assert np.allclose(follow._measure(part, Quantity.ANGULAR_MOMENTUM, state), [spin[1], -spin[0], spin[2]])


def test_a_position_key_requests_the_speed_of_its_curve(place: Stance) -> None:
    """If the head is on the curve, its target speed is that of the curve; if it is behind, the target speed is
    higher."""
    follow = Follow(place, [key(1.0, "head", Quantity.POSITION, (0.2, 0.0, 0.0))])
    (channel,) = follow.channels
    still = BodyState(place.standing, 0 * place.standing)
    follow.objectives(still, None, DT)
    asked = []
    for lag in (0.0, 0.05):
        now = channel.at(0.5 + DT)[0][0] - DT * channel.at(0.5 + DT)[1][0]
        positions = place.standing + place.body.height * (now - lag) * place.ground.axes[0]
        objectives = follow.objectives(BodyState(positions, 0 * positions, 0.5), None, DT)
        (head,) = [o for o in objectives if isinstance(o, Objective) and o.name == "head velocity"]
        moving = np.tile(place.ground.axes[0], (len(positions), 1))
        assert np.allclose(head.rows @ moving.ravel(), [1.0, 0.0, 0.0])
        asked.append(head.target)
    speed = place.body.height * channel.at(0.5 + DT)[1][0]
    assert np.allclose(asked[0], [speed, 0.0, 0.0]) and asked[1][0] > 1.5 * speed


def test_each_key_has_its_own_weight(place: Stance) -> None:
    """The weight 1 of the first key applies until the time of that key, and the weight 9 of the second key
    afterwards."""
    value = (0.1, 0.0, 0.0)
    keys = [Key(time, "head", Quantity.POSITION, value, weight) for time, weight in ((6 * DT, 1.0), (12 * DT, 9.0))]
    follow, found = Follow(place, keys), []
    for index in range(14):
        wishes = follow.objectives(BodyState(place.standing, 0 * place.standing, index * DT), None, DT)
        found += [o.weight for o in wishes if isinstance(o, Objective) and o.name == "head velocity"]
    assert found == [follow.weights.com] * 6 + [9.0 * follow.weights.com] * 8


def test_keys_of_the_whole_body_replace_its_own_balance_or_spin(place: Stance) -> None:
    state = BodyState(place.standing, 0 * place.standing)
    moving = Follow(place, [key(1.0, "body", Quantity.VELOCITY, (0.3, 0.0, 0.0))]).objectives(state, None, DT)
    assert [o.name for o in moving if isinstance(o, Objective)] == ["pose", "body velocity"]
    assert sum(isinstance(o, AngularMomentumObjective) for o in moving) == 1
    spinning = Follow(place, [key(DT, "body", Quantity.ANGULAR_MOMENTUM, (0.0, 0.0, 0.02))]).objectives(state, None, DT)
    (spin,) = [o for o in spinning if isinstance(o, AngularMomentumObjective)]
    assert np.allclose(spin.target, [0.0, 0.0, 0.02 * place.body.mass * place.body.height**2])
    turning = Follow(place, [key(DT, "body", Quantity.ORIENTATION, (0.0, 0.0, 3.0))]).objectives(state, None, DT)
    (turn,) = [o for o in turning if isinstance(o, AngularMomentumObjective)]
    rate = np.linalg.solve(place.body.inertia(state.positions), turn.target)
    assert rate[2] > 0.0 and np.abs(rate[:2]).max() < 1e-6 * rate[2]


def test_feet_are_ordered_counterclockwise_from_straight_ahead() -> None:
    """Forward is +y and left is -x. The order of the feet is front left, back left, back right, front right for a
    stool, and left, right for a figure."""
    for mesh, corners in (
        (stool(), [(-1, 1), (-1, -1), (1, -1), (1, 1)]),
        (figure(), [(-1, 0), (1, 0)]),
    ):
        place = standing_stance(mesh)
        follow = Follow(place, [key(0.5, "foot 2", Quantity.POSITION, (0.0, 0.0, 0.1))])
        feet = [part for name, part in follow.parts.items() if name.startswith("foot ")]
        assert [part.name for part in feet] == [f"foot {n + 1}" for n in range(len(corners))]
        assert [tuple(np.sign(np.round(part.centre(mesh.nodes)[:2], 1)).astype(int)) for part in feet] == corners
        together = np.sort(np.concatenate([part.nodes for part in feet]))
        assert np.array_equal(together, follow.parts["base"].nodes)
        still = BodyState(place.standing, 0 * place.standing)
        (lift,) = [o for o in follow.objectives(still, None, DT) if isinstance(o, Objective) and "foot" in o.name]
        pulled = np.flatnonzero(abs(lift.rows).sum(axis=0).reshape(-1, 3).any(axis=1))
        assert lift.name == "foot 2 velocity" and np.array_equal(pulled, feet[1].nodes)
        assert np.allclose(lift.target[:2], 0.0) and lift.target[2] > 0.0


def test_an_unknown_part_is_refused_with_the_known_ones(place: Stance) -> None:
    """The only foot of a block is its base."""
    parts = Follow(place, [key(0.5, "foot", Quantity.POSITION, (0.0, 0.0, 0.1))]).parts
    assert np.array_equal(parts["foot"].nodes, parts["base"].nodes)
    with pytest.raises(UserError) as error:
        Follow(place, [key(0.5, "foot 1", Quantity.POSITION, (0.0, 0.0, 0.1))])
    assert str(error.value) == "k.json, key 1: the body has no part 'foot 1'; it has body, base, head, foot"
    with pytest.raises(
        UserError, match=r"has no part 'foot'; it has body, base, head, foot 1, foot 2, branch 1, branch 2$"
    ):
        Follow(standing_stance(figure()), [key(0.5, "foot", Quantity.POSITION, (0.0, 0.0, 0.1))])


def test_missed_keys_are_reported_and_reached_ones_are_not(place: Stance) -> None:
    keys = [
        key(0.1, "head", Quantity.POSITION, (0.1, 0.0, 0.0)),
        Key(0.2, "head", Quantity.POSITION, (0.2, 0.0, 0.0), where="k.json, key 2"),
        Key(0.3, "head", Quantity.POSITION, (0.0, 0.0, 0.0), where="k.json, key 3"),
    ]
    follow = Follow(place, keys)
    for time, forward in ((0.0, 0.0), (0.1, 0.1), (0.2, 0.12)):
        positions = place.standing + forward * place.body.height * place.ground.axes[0]
        follow.objectives(BodyState(positions, 0 * positions, time), None, DT)
    assert follow.phase is FollowPhase.FOLLOW
    planned = follow.plan_record()
    assert planned == FollowPlan(3.0, 0.3, planned.worst_miss) and planned.worst_miss == pytest.approx(
        {"position": 0.08}
    )
    assert follow.notes()[0].startswith("k.json, key 2: head position at 0.2 s: reached (0.12, ")
    assert follow.notes()[1] == "k.json, key 3: head position at 0.3 s was not reached in time"
    follow.objectives(BodyState(place.standing, 0 * place.standing, 0.4), None, DT)
    assert follow.phase is FollowPhase.HOLD and len(follow.notes()) == 1


def drifting(place: Stance, speed: float, time: float) -> BodyState:
    """Return the state of the standing body with a forward ``speed`` in sqrt(g H)."""
    velocity = speed * np.sqrt(9.81 * place.body.height) * place.ground.axes[0]
    return BodyState(place.standing, np.tile(velocity, (len(place.standing), 1)), time)


def test_a_trajectory_ends_when_the_body_is_slow_or_after_a_limit(place: Stance) -> None:
    """The motion counts as at rest 0.3 sqrt(H / g) after the body has become slow. If the body never becomes slow, the
    motion counts as at rest 9 sqrt(H / g) after the last key and reports this.
    """
    unit = np.sqrt(place.body.height / 9.81)
    for slow_from, rest in ((0.0, 0.5 + 0.3 * unit), (1.2, 1.2 + 0.3 * unit), (np.inf, 0.5 + 9.0 * unit)):
        follow = Follow(place, [key(0.5, "head", Quantity.POSITION, (0.0, 0.0, 0.0))])
        rested = None
        for time in np.arange(240) * DT:
            follow.objectives(drifting(place, 0.025 if time > slow_from else 0.035, time), None, DT)
            if follow.phase is FollowPhase.REST and rested is None:
                rested = time
        assert rested == pytest.approx(rest, abs=2.5 * DT)
        assert len(follow.notes()) == (slow_from == np.inf)


def test_positions_are_held_after_their_last_key_and_velocities_are_not(place: Stance) -> None:
    """After the last key of the body velocity, the balance objectives apply again, while the head position remains a
    target."""
    keys = [key(0.1, "body", Quantity.VELOCITY, (0.3, 0.0, 0.0)), key(0.2, "head", Quantity.POSITION, (0.1, 0.0, 0.0))]
    follow = Follow(place, keys)
    names = []
    for time in (0.0, 0.05, 0.1, 0.3):
        wishes = follow.objectives(BodyState(place.standing, 0 * place.standing, time), None, DT)
        names.append({o.name for o in wishes if isinstance(o, Objective)})
    assert names == [{"pose", "body velocity", "head velocity"}] * 2 + [{"pose", "com", "head velocity"}] * 2


def spun(place: Stance, degrees: float, time: float) -> BodyState:
    """Return the state of the block at rest, rotated about the up axis by ``degrees``."""
    centre = place.body.centre_of_mass(place.standing)
    turn = Rotation.from_rotvec([0.0, 0.0, degrees], degrees=True)
    return BodyState(centre + turn.apply(place.standing - centre), 0 * place.standing, time)


@pytest.mark.parametrize("part", ["body", "head"])
@pytest.mark.parametrize("asked", [170.0, 180.0, 270.0, 360.0, -360.0])
def test_a_turn_is_measured_in_the_requested_direction(place: Stance, part: str, asked: float) -> None:
    """The error is zero for a complete turn, 10 degrees for a turn that is 10 degrees too small, and the whole angle
    for a body that does not turn."""
    for share, miss in ((1.0, 0.0), (1.0 - 10.0 / abs(asked), 10.0), (0.0, abs(asked))):
        follow = Follow(place, [key(1.0, part, Quantity.ORIENTATION, (0.0, 0.0, asked))])
        for time in np.linspace(0.0, 1.0, 61):
            follow.objectives(spun(place, share * time * asked, time), None, DT)
        assert follow.plan_record().worst_miss == pytest.approx({"orientation": miss}, abs=1e-6)
        assert len(follow.notes()) == (miss > 36.0)


@pytest.mark.parametrize("behind", [0.0, 20.0, 190.0])
def test_a_turn_over_half_is_steered_in_the_requested_direction(place: Stance, behind: float) -> None:
    """Late in a turn by 350 degrees, the target rate is the rate of the curve plus a gain times the error, even if the
    error is above 180 degrees."""
    follow = Follow(place, [key(2.0, "body", Quantity.ORIENTATION, (0.0, 0.0, 350.0))])
    (channel,), body = follow.channels, place.body
    follow.objectives(spun(place, 0.0, 0.0), None, DT)
    rates = []
    for time in np.arange(1, 109) * DT:
        value, rate = channel.at(time + DT)
        state = spun(place, max((value - DT * rate)[2] - behind, 0.0), time)
        (spin,) = [o for o in follow.objectives(state, None, DT) if isinstance(o, AngularMomentumObjective)]
        rates.append(np.linalg.solve(body.inertia(state.positions), spin.target))
    gain = 6.0 * np.sqrt(9.81 / body.height)
    assert np.allclose(rates[-1], [0.0, 0.0, np.radians(rate[2] + gain * behind)], atol=1e-4)
