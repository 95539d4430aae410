"""Curves of a frame of a live body."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from egs_warp.web.frame_encoding import encode_frame
from egs_warp.web.recording import CURVES
from tests.support.slides import slide


def test_self_contact_does_not_count_in_the_friction_used() -> None:
    made = slide()
    report = max(made.reports, key=lambda each: each.forces[:, 0].sum())
    made_of = cast(
        Any, SimpleNamespace(**{each: getattr(made.stepper, each) for each in ("body", "muscles", "geometry")})
    )
    # The first loaded contact becomes one with the body itself, with a large tangential force.
    own = int(np.argmax(report.forces[:, 0]))
    faces, forces = report.contacts.faces.copy(), report.forces.copy()
    faces[own], forces[own, 1:] = -3, 1e6
    changed = replace(report, contacts=replace(report.contacts, faces=faces), forces=forces)
    frame = encode_frame(0, report.state, changed, made_of, world_index=2)
    others = np.delete(forces, own, axis=0)
    expected = np.linalg.norm(others[:, 1:], axis=1).sum() / (made.stepper.geometry.friction * others[:, 0].sum())
    assert expected > 0.1 and np.isclose(frame.curves[[name for name, _, _ in CURVES].index("friction")], expected)
