"""Displacements that the targets of a script request, before it is simulated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.motions.script import Script

_MOVING_FILES = ("walk along", "drive")
"""Motions whose displacement is described by a file."""


@dataclass(frozen=True)
class Leg:
    """Displacement of one motion of a script, in body heights and in the ground axes at the start of the script."""

    name: str
    """Name of the motion."""
    start: np.ndarray
    """(2,) position at the start of the motion: forward, left."""
    step: np.ndarray
    """(2,) displacement by the motion."""
    heading: float
    """Heading at the end of the motion, radians to the left."""


def planned_legs(script: Script) -> tuple[Leg, ...]:
    """Return the displacements of the motions of ``script`` in order, up to the first motion whose displacement is not
    given by targets; a motion that moves nothing has no displacement."""
    legs: list[Leg] = []
    place, heading = np.zeros(2), 0.0
    for request in script.requests:
        if request.begin is not None or request.name in _MOVING_FILES:
            break
        asked = request.asked
        ahead, left = asked.get("ahead", asked.get("distance", 0.0)), asked.get("left", 0.0)
        turn = float(np.radians(asked.get("heading_degrees", 0.0)))
        if "ahead" in asked:
            turn = float(np.arctan2(left, ahead))
        for _ in range(request.repeat):
            cosine, sine = np.cos(heading), np.sin(heading)
            step = np.array([cosine * ahead - sine * left, sine * ahead + cosine * left])
            heading += turn
            if step.any():
                legs.append(Leg(request.name, place, step, heading))
            place = place + step
    return tuple(legs)
