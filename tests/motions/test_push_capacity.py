"""Largest work of a single push by a block that lies on its side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.motions.push_capacity import PushCapacity, push_capacity
from tests.support.creatures import coarse_creature
from tests.support.meshes import box_mesh
from tests.support.stances import FORWARD

MADE = coarse_creature(box_mesh((2, 2, 4), (0.5, 0.5, 1.0)), forward=FORWARD, all_round=True)


def capacity(strength: float) -> PushCapacity:
    """Return the capacity of a block to push one end of a side against the normal, relative to the other end."""
    x = MADE.start.positions
    side = x[:, 0] < x[:, 0].min() + 0.05
    far, edge = (np.flatnonzero(side & (np.abs(x[:, 2] - z) < 0.05)) for z in (x[:, 2].max(), x[:, 2].min()))
    muscles = MADE.stepper.muscles
    weak = replace(muscles, stiffness=strength * muscles.stiffness)
    return push_capacity(MADE.stepper.body, weak, x, far, edge, np.array([1.0, 0.0, 0.0]))


def test_capacity_grows_with_strength() -> None:
    """Force and stroke are proportional to the strength of the muscles, and the work is proportional to its square."""
    one, half = capacity(1.0), capacity(0.5)
    assert half.force == pytest.approx(0.5 * one.force) and half.stroke == pytest.approx(0.5 * one.stroke)
    work = one.work(np.inf)
    assert half.work(np.inf) == pytest.approx(0.25 * work) and work == pytest.approx(0.5 * one.force * one.stroke)
    assert one.force > MADE.stepper.body.weight


def test_a_short_push_does_less_work() -> None:
    """The work is the integral of a force that decreases linearly to zero over the stroke."""
    push = PushCapacity(force=10.0, stroke=2.0)
    assert push.work(0.5) == pytest.approx(0.5 * (10.0 + 7.5) * 0.5)
    assert push.work(-0.1) == 0.0 and push.work(3.0) == push.work(2.0) == pytest.approx(10.0)
