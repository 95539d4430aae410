"""What the feet can give: accelerations that do not tip the body, against a search over all of them."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.fem.body import BodyState
from egs_warp.motions.sequence import Place
from egs_warp.motions.stance import PoseFamily

GRAVITY, EDGE = 9.81, 0.2


@pytest.mark.parametrize("wanted", [(0.3, -0.2), (9.0, 0.5), (-4.0, -20.0)])
@pytest.mark.parametrize("up", [0.0, 6.0, -5.0])
@pytest.mark.parametrize("margin", [0.6, 0.9])
def test_the_nearest_acceleration_that_does_not_tip(
    place: Place, wanted: tuple[float, float], up: float, margin: float
) -> None:
    """The ground's force on a body that neither turns nor tips points through its centre of mass, from inside the
    footprint.
    """
    pose = PoseFamily(place.body, place.ground, place.standing, place.touching)
    positions = place.standing + np.array([0.05, -0.03, 0.1]) * (place.standing[:, 2:] > 1e-9)
    seen = pose.measure(BodyState(positions, np.zeros_like(positions)), None)
    com = place.ground.local(place.body.centre_of_mass(positions))

    def pressure(level: np.ndarray) -> np.ndarray:
        """(..., 2) where the line of the force (level, g + up) through the centre of mass meets the floor."""
        return com[:2] - com[2] * level / (GRAVITY + up)

    got = pose.balanced_acceleration(seen, np.array(wanted), up, GRAVITY, margin=margin)
    middle = place.ground.local(place.touching)[:, :2].mean(axis=0)
    assert np.abs(pressure(got) - middle).max() <= margin * EDGE + 1e-9
    line = np.linspace(-30.0, 30.0, 601)
    levels = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    stands = levels[np.abs(pressure(levels) - middle).max(axis=1) <= margin * EDGE]
    nearest = np.linalg.norm(stands - wanted, axis=1).min()
    spacing = line[1] - line[0]
    assert nearest - 2.0 * spacing < np.linalg.norm(got - wanted) <= nearest + 1e-9


def test_the_usual_margin_stays_inside_the_feet_and_a_falling_body_may_be_pushed_either_way(place: Place) -> None:
    pose = PoseFamily(place.body, place.ground, place.standing, place.touching)
    still = np.zeros_like(place.standing)
    seen = pose.measure(BodyState(place.standing, still), None)
    hard = pose.balanced_acceleration(seen, np.array([100.0, -100.0]), 0.0, GRAVITY)
    assert hard * [1.0, -1.0] == pytest.approx(np.full(2, 0.8 * EDGE * GRAVITY / 0.5), rel=0.02)
    past = place.standing + np.array([0.5, 0.0, 0.0]) * (place.standing[:, 2:] > 1e-9)
    falling = pose.measure(BodyState(past, still), None)
    ways = [pose.balanced_acceleration(falling, np.array([x, 0.0]), 0.0, GRAVITY)[0] for x in (-100.0, 100.0)]
    assert ways[0] < -0.5 and ways[1] > 0.5
