"""Landing positions of jumps: their height, and positions that are refused at edges of the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.contact.terrain import Solid
from egs_warp.geometry.plane import Plane
from egs_warp.motions.jump import Jump
from egs_warp.motions.jump_plan import JumpTarget
from egs_warp.motions.landing import landing_of, shortened
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import Stance, TargetError
from egs_warp.motions.turn import Turn
from tests.support.stances import FORWARD

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(("slope", "rise", "height"), [(0.1, 0.05, 0.2), (-0.1, -0.05, 0.2), (0.4, 0.2, 0.3)])
def test_a_jump_lands_on_the_ground_ahead(place: Stance, slope: float, rise: float, height: float) -> None:
    """The jump lands half a metre up or down a slope. Its apex is above the landing surface by at least half of the
    requested height of 0.2."""
    normal = np.array([-slope, 0.0, 1.0]) / np.hypot(1.0, slope)
    target = landing_of(replace(place, solids=(Solid((Plane(normal, 0.0),)),)), JumpTarget(0.5, 0.2))
    assert (target.distance, target.rise, target.height) == pytest.approx((0.5, rise, height))
    assert landing_of(place, JumpTarget(0.5, 0.2)) == JumpTarget(0.5, 0.2)


def test_a_jump_is_level_before_a_wall_and_under_a_lintel(place: Stance) -> None:
    """In each of these cases, the requested target is unchanged."""
    ground, asked = Solid((Plane(UP, 0.0),)), JumpTarget(0.5, 0.2)
    block = (Plane(UP, -2.5), Plane(-FORWARD, 0.3))
    lintel = Solid((*block, Plane(-UP, 2.0)))
    for solids in ((ground, Solid(block)), (ground, lintel)):
        assert landing_of(replace(place, solids=solids), asked) == asked


def table(edge: float) -> Solid:
    """Return a solid with its top at z = 0 that ends at x = ``edge``."""
    return Solid((Plane(UP, 0.0), Plane(FORWARD, -edge)))


@pytest.mark.parametrize("floor", [None, -0.3, -1.5])
def test_a_landing_on_the_edge_of_a_table_is_refused(place: Stance, floor: float | None) -> None:
    """The base is 0.4 wide, so the centre of mass must land at least 0.1 before the edge, whether there is ground below
    the table or not. The distance that the message suggests is accepted."""
    below = () if floor is None else (Solid((Plane(UP, -floor),)),)
    asked = JumpTarget(0.5, 0.2)
    across = np.linspace(-0.2, 0.2, 11)
    base = np.stack([*np.meshgrid(across, across), np.zeros((11, 11))], axis=-1).reshape(-1, 3)
    for edge in (0.63, 0.9):
        stance = replace(place, contact_points=base, solids=(table(edge), *below))
        assert landing_of(stance, asked) == asked
    for edge in (0.35, 0.5, 0.57):
        stance = replace(place, contact_points=base, solids=(table(edge), *below))
        with pytest.raises(
            TargetError, match=r"the ground ends where the body would land, 0\.5 body heights"
        ) as caught:
            landing_of(stance, asked)
        best = float(str(caught.value).rpartition(" ")[2])
        assert edge - 0.07 <= best + 0.1 <= edge
        assert landing_of(stance, JumpTarget(best, 0.2)).rise == 0.0


def test_a_jump_from_a_table_lands_beyond_its_edge_or_is_refused(place: Stance) -> None:
    """A floor 0.3 body heights lower is accepted; one 1.5 body heights lower is not."""
    floors = {depth: (table(0.25), Solid((Plane(UP, depth),))) for depth in (0.3, 1.5)}
    assert landing_of(replace(place, solids=floors[0.3]), JumpTarget(0.5, 0.2)).rise == pytest.approx(-0.3)
    with pytest.raises(TargetError, match="the ground ends where the body would land"):
        landing_of(replace(place, solids=floors[1.5]), JumpTarget(0.5, 0.2))


def test_hops_are_refused_before_they_start_and_missed_when_they_come_to_the_edge(place: Stance) -> None:
    stance = replace(place, solids=(table(0.9),))
    with pytest.raises(TargetError, match="the ground ends"):
        motion("hop 0.9").check(stance)
    assert motion("hop 0.5 x2").check(stance)[1] == 0.0


@pytest.mark.parametrize("name", ["jump", "twist"])
def test_motions_jump_onto_the_solid_ahead(place: Stance, name: str) -> None:
    step = Solid((Plane(UP, -0.1), Plane(-FORWARD, 0.3)))
    ground = Solid((Plane(UP, 0.0),))
    target, stepped = JumpTarget(0.5, 0.2), replace(place, solids=(ground, step))
    begun = (
        motion("jump 0.5 0.2").parts(1.0)[0].begin(stepped) if name == "jump" else Turn(stepped, target, 0.5).jumps[0]
    )
    assert isinstance(begun, Jump) and begun.target.rise == pytest.approx(0.1)


@pytest.mark.parametrize(("top", "rise", "height"), [(0.1, 0.1, 0.3), (0.5, 0.0, 0.2)])
def test_a_shortened_jump_lands_on_the_box_that_it_would_have_crossed(
    place: Stance, top: float, rise: float, height: float
) -> None:
    """The clearance is kept on a low box; a box that is higher than the jump does not change the rise."""
    box = Solid((Plane(UP, -top), Plane(-FORWARD, 0.3), Plane(FORWARD, -1.5)))
    stance, target = replace(place, solids=(Solid((Plane(UP, 0.0),)), box)), JumpTarget(2.0, 0.2)
    assert landing_of(stance, target) == target
    nearer = shortened(stance, target, 0.8)
    assert (nearer.distance, nearer.rise, nearer.height) == pytest.approx((0.8, rise, height))
    if rise:
        jump = Jump(stance, JumpTarget(2.0, 0.2))
        assert 0.3 < jump.target.distance < 1.5 and jump.target.rise == pytest.approx(rise)
