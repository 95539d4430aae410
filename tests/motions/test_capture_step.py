"""Capture steps of a body: their condition, direction and length."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.motions.capture_step import MAX_DISTANCE, STEP_MARGIN, capture_motion
from egs_warp.motions.jump import Jump
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import BalanceController
from egs_warp.motions.walk import Walk
from tests.support.meshes import block_mesh, coarse_stool, figure
from tests.support.stances import block_place


def begun(place: Stance, velocity: np.ndarray, contacts: int = 1) -> Walk | Jump | None:
    """Return the motion of a standing body that moves with ``velocity`` (3,), m/s; without contacts, the body is in the
    air."""
    controller = BalanceController(place.body, place.ground, place.standing, place.contact_points, place.friction)
    state = BodyState(place.standing, np.broadcast_to(velocity, place.standing.shape))
    measurement = controller.measure(state, None)
    nearest = np.zeros(1, np.int64)
    report = SimpleNamespace(
        contacts=SimpleNamespace(count=contacts, nearest_nodes=nearest), forces=np.array([[place.body.weight, 0, 0]])
    )
    return capture_motion(place, controller, measurement, place.standing, cast(Any, report))


def edge_speed(place: Stance) -> float:
    """Return the forward speed in m/s at which the capture point is on the edge of the support."""
    com = place.body.centre_of_mass(place.ground.local(place.standing))
    front = float(place.ground.local(place.contact_points)[:, 0].max())
    return (front - float(com[0])) * float(np.sqrt(np.linalg.norm(place.body.gravity) / com[2]))


@pytest.mark.parametrize(("mesh", "kind"), [(block_mesh, Jump), (coarse_stool, Walk), (figure, Jump)])
def test_a_body_moves_only_if_its_capture_point_has_left_the_support(mesh: Any, kind: type[Walk | Jump]) -> None:
    """A body steps if its capture point is more than 0.02 body heights outside the edge; a body on one base hops, a
    body on legs steps, and a figure with one foot ahead of the other, which would lose its balance in a step, hops."""
    place = block_place(cast(TetMesh, mesh()))
    margin = (
        STEP_MARGIN
        * place.body.height
        * edge_speed(place)
        / float(place.ground.local(place.contact_points)[:, 0].max())
    )
    assert begun(place, np.zeros(3)) is None
    assert begun(place, np.array([edge_speed(place) + 0.9 * margin, 0.0, 0.0])) is None
    fast = np.array([edge_speed(place) + 1.1 * margin, 0.0, 0.0])
    assert isinstance(begun(place, fast), kind)
    assert begun(place, fast, contacts=0) is None
    assert begun(place, np.full(3, np.nan)) is None


@pytest.mark.parametrize("angle", [0.0, 0.5 * np.pi, np.pi])
def test_a_hop_follows_the_fall(angle: float) -> None:
    """The hop is along the velocity, and is longer after a stronger push, up to the maximum."""
    place = block_place()
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    hops = [begun(place, speed * along) for speed in (1.4, 2.0, 9.0)]
    lengths = []
    for hop in hops:
        assert isinstance(hop, Jump)
        assert hop.ground.axes[0] == pytest.approx(along, abs=1e-9)
        lengths.append(hop.target.distance / place.body.height)
    assert lengths[0] < lengths[1] <= lengths[2] == pytest.approx(MAX_DISTANCE)


def test_feet_step_under_the_capture_point() -> None:
    """The walk starts with a swing of the feet with the smaller load and moves along the velocity."""
    place = block_place(coarse_stool())
    walk = begun(place, np.array([0.0, -2.0, 0.0]))
    assert isinstance(walk, Walk)
    end = walk.planar_poses[-1]
    assert abs(end[0]) < 0.01 * place.body.height and end[1] < -0.2 * place.body.height and end[2] == 0.0
    walk.objectives(BodyState(place.standing, np.zeros_like(place.standing)), None, 1.0 / 60.0)
    loaded = int(np.argmax([foot.leg[0] for foot in walk.feet]))
    assert len(walk.swinging) == 2 and loaded not in walk.swinging
