"""A body of a live session, steered by a queue of motions."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from egs_warp.contact.contact_set import ContactSet
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.stepper import StepReport
from egs_warp.web.world_session import SteeredBody


def test_bodies_that_push_from_the_side_are_no_support() -> None:
    """The motion sees contacts with the ground and with a body below, but not one with a body beside; its gap is that
    to the ground, not to other bodies."""
    gravity, positions = np.array([0.0, 0.0, -9.81]), np.eye(4, 3)
    detector = SimpleNamespace(gaps=lambda positions: (np.array([0.02, 0.5]), np.zeros(2, int)))
    stepper = SimpleNamespace(body=SimpleNamespace(gravity=gravity), detector=detector)
    upright = np.eye(3)[[2, 0, 1]]
    contacts = ContactSet(
        np.array([0, 8, 9]),
        np.tile(np.arange(4, dtype=np.int32), (3, 1)),
        np.full((3, 4), 0.25),
        np.stack([upright, upright, np.eye(3)]),
        np.zeros(3),
        np.array([0, -2, -3], np.int32),
        4,
    )
    state = BodyState(positions, np.zeros((4, 3)))
    report = StepReport(
        *(state, 0.01, contacts, np.arange(9.0).reshape(3, 3), np.zeros(3), -0.1, np.zeros(0)),
        qp_count=0,
        qp_infeasible=0,
        newton_iterations=0,
        converged=True,
        added_spin=0.0,
    )
    seen: list[StepReport] = []
    member: Any = SimpleNamespace(body=SimpleNamespace(stepper=stepper))
    memory: Any = None
    steering: Any = SimpleNamespace(objectives=lambda state, report, dt: seen.append(report))
    SteeredBody(member, state, memory, report, steering=steering).objectives(0.01)
    assert seen[0].contacts.faces.tolist() == [0, -2] and seen[0].min_gap == 0.02
    np.testing.assert_array_equal(seen[0].forces, report.forces[:2])
