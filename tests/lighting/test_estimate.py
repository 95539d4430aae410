"""Estimate of the main light of a ball on a floor from its shadow and its shading, and scenes without a main light."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.geometry.main_light import MainLight
from egs_warp.lighting.estimate import estimate_light
from tests.support.lit_scenes import AMBIENT, direction, lit_ball, lit_floor
from tests.support.scenes import FLOOR


def angle_between(light: MainLight, truth: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(light.direction @ truth, -1.0, 1.0))))


@pytest.mark.parametrize(("azimuth", "elevation"), [(200.0, 45.0), (-70.0, 62.0)])
def test_a_lit_ball_gives_the_direction_of_its_light(azimuth: float, elevation: float) -> None:
    """The direction of the light, the darkness of the shadow and the ratio of irradiances agree with those of the
    scene."""
    truth = direction(azimuth, elevation)
    light = estimate_light(lit_ball(truth), lit_floor(truth), FLOOR).light
    assert light is not None
    assert angle_between(light, truth) < 4.0
    # In linear light, the ground in shadow receives only the ambient light.
    shade = 1.0 - (AMBIENT / (AMBIENT + (1.0 - AMBIENT) * truth[2])) ** (1.0 / 2.2)
    assert light.shade == pytest.approx(shade, abs=0.06)
    facing, averted = (
        float(np.append(n, 1.0) @ light.irradiance @ np.append(n, 1.0)) for n in (truth, np.cross(truth, [0, 0, 1]))
    )
    assert facing / averted == pytest.approx(1.0 / AMBIENT, rel=0.25)


def test_an_overcast_scene_has_no_main_light() -> None:
    """A scene without a distant light has no main light; a note says what is rendered instead."""
    up = np.array([0.0, 0.0, 1.0])
    found = estimate_light(lit_ball(up, key=0.0), lit_floor(up, key=0.0), FLOOR)
    assert found.light is None
    assert "no main light is clear" in found.note


def test_conflicting_shadow_and_shading_are_reported() -> None:
    """A ball that is lit from one side and has its shadow on the same side has no main light."""
    found = estimate_light(lit_ball(direction(0.0, 40.0)), lit_floor(direction(180.0, 40.0)), FLOOR)
    assert found.light is None
    assert "do not agree" in found.note


def test_an_object_without_visible_ground_is_judged_by_its_shading() -> None:
    """Without visible ground, the direction follows from the shading, and the shadow has zero darkness."""
    truth = direction(120.0, 40.0)
    far = lit_floor(truth)
    away = far.subset(np.linalg.norm(far.means.numpy()[:, :2], axis=1) > 2.35)
    light = estimate_light(lit_ball(truth), away, FLOOR).light
    assert light is not None
    assert angle_between(light, truth) < 10.0
    assert light.shade == 0.0
