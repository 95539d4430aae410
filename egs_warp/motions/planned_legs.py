"""Displacements that the targets of a script request, before it is simulated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.motions.repertoire import MOTIONS
from egs_warp.motions.script import Script

_TARGETS = ("distance", "ahead", "heading_degrees", "turns")
"""Parameters that give the displacement or the turn of a motion."""


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
    given by targets, such as a somersault, a dance or one that a file describes. A motion in place, such as a turn or a
    gesture, has no displacement."""
    legs: list[Leg] = []
    place, heading = np.zeros(2), 0.0
    for request in script.requests:
        asked = request.asked
        if request.begin is not None or not (_is_in_place(request.name) or any(name in asked for name in _TARGETS)):
            break
        ahead, left = asked.get("ahead", asked.get("distance", 0.0)), asked.get("left", 0.0)
        turn = float(np.radians(asked.get("heading_degrees", 0.0) + 360.0 * asked.get("turns", 0.0)))
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


def _is_in_place(name: str) -> bool:
    """Return whether the motion called ``name`` never moves or turns the body: standing, and gestures."""
    return name == "stand" or MOTIONS[name].gesture is not None
