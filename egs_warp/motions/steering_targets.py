"""Targets of steered walks: reach a point or a body, follow a body, keep away from it, or push it to a target
position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egs_warp.motions.other_body import OtherBody, radius_of
from egs_warp.motions.sequence import Stance
from egs_warp.motions.steering import View

_ARRIVED = 0.03
"""Distance from the goal at which a walk stops, body heights."""
_TOLERANCE = 0.1
"""Maximum error of a distance, body heights."""
_RUN_UP = 0.12
"""Gap behind a body at which a push begins, body heights."""
_STEER_GAIN = 2.5
"""Heading change of a pushing body relative to its sideways distance from the line through the pushed body and its
goal, radians per body height. It moves the contact point to the side to which the pushed body has to turn."""
_AIM_DISTANCE = 0.6
"""Distance beyond the target, in body heights, of the point at which the pushing body aims, so that its direction
changes little near the target."""
_MAX_STEER = np.radians(35.0)
_MAX_OFFSET = 0.5
"""Sideways distance of the pushing body from the line through the pushed body and its goal above which the push starts
again from behind the body, relative to the distance at which the bodies touch."""


@dataclass(frozen=True)
class WalkToPoint:
    """Walk to a point."""

    stance: Stance
    point: np.ndarray
    """(2,) m, target point in the ground frame of ``stance``."""

    def goal(self, view: View) -> np.ndarray:
        """Return the point."""
        return self.point

    def is_over(self, view: View) -> bool:
        """Return True if the body has reached the point."""
        return float(np.linalg.norm(self.point - view.position)) < _ARRIVED * self.stance.body.height

    def ignored(self) -> Sequence[str]:
        """Return no names: all bodies are avoided."""
        return ()

    def failures(self, view: View) -> tuple[str, ...]:
        """Describe the distance from the point, if it is too large."""
        left = float(np.linalg.norm(self.point - view.position)) / self.stance.body.height
        return (f"{left:.2f} body heights from the target",) if left > _TOLERANCE else ()


class WalkToBody:
    """Walk towards a body, even if it moves, and stop at a gap from it."""

    def __init__(self, stance: Stance, other: OtherBody, name: str, gap: float) -> None:
        """Create the target; ``gap`` is the distance in metres between the bodies at which the walk ends."""
        self._stance, self._other, self._name, self._gap = stance, other, name, gap
        self._touching = other.place(stance)[1]

    def goal(self, view: View) -> np.ndarray:
        """Return the position of the other body."""
        return self._other.centre(self._stance)

    def _left(self, view: View) -> float:
        centre = self._other.centre(self._stance)
        return float(np.linalg.norm(centre - view.position)) - self._touching - self._gap

    def is_over(self, view: View) -> bool:
        """Return True if the gap to the other body has been reached."""
        return self._left(view) < _ARRIVED * self._stance.body.height

    def ignored(self) -> Sequence[str]:
        """Return the name of the other body, which is not avoided."""
        return (self._name,)

    def failures(self, view: View) -> tuple[str, ...]:
        """Describe the remaining distance, if it is too large."""
        left = self._left(view) / self._stance.body.height
        return (f"{left:.2f} body heights too far from {self._name}",) if left > _TOLERANCE else ()


class FollowBody:
    """Keep close to a body for some time."""

    def __init__(self, stance: Stance, other: OtherBody, name: str, gap: float, seconds: float) -> None:
        """Create the target; ``gap`` in metres is the distance between the bodies."""
        self._stance, self._other, self._name = stance, other, name
        self._gap, self._seconds, self._touching = gap, seconds, other.place(stance)[1]

    def _left(self, view: View) -> float:
        centre = self._other.centre(self._stance)
        return float(np.linalg.norm(centre - view.position)) - self._touching - self._gap

    def goal(self, view: View) -> np.ndarray | None:
        """Return the position of the other body; None if the gap to it is small enough."""
        near = _ARRIVED * self._stance.body.height
        return self._other.centre(self._stance) if self._left(view) > near else None

    def is_over(self, view: View) -> bool:
        """Return True after the requested time."""
        return view.time >= self._seconds

    def ignored(self) -> Sequence[str]:
        """Return the name of the other body, which is not avoided."""
        return (self._name,)

    def failures(self, view: View) -> tuple[str, ...]:
        """Describe the remaining distance, if it is more than a body height."""
        left = self._left(view) / self._stance.body.height
        return (f"{left:.2f} body heights behind {self._name}",) if left > 1.0 else ()


class AvoidBody:
    """Keep away from a body for some time."""

    def __init__(self, stance: Stance, other: OtherBody, name: str, gap: float, seconds: float) -> None:
        """Create the target; ``gap`` in metres is the distance between the bodies below which the body walks away."""
        self._stance, self._other, self._name = stance, other, name
        self._gap, self._seconds, self._touching = gap, seconds, other.place(stance)[1]
        self._minimum = np.inf

    def _apart(self, view: View) -> float:
        centre = self._other.centre(self._stance)
        return float(np.linalg.norm(centre - view.position)) - self._touching

    def goal(self, view: View) -> np.ndarray | None:
        """Return a point away from the other body; None if the gap to it is large enough."""
        self._minimum = min(self._minimum, self._apart(view))
        if self._apart(view) > self._gap:
            return None
        away = view.position - self._other.centre(self._stance)
        return view.position + away / max(float(np.linalg.norm(away)), 1e-9) * self._stance.body.height

    def is_over(self, view: View) -> bool:
        """Return True after the requested time."""
        return view.time >= self._seconds

    def ignored(self) -> Sequence[str]:
        """Return no names: all bodies are avoided."""
        return ()

    def failures(self, view: View) -> tuple[str, ...]:
        """Describe the failure if the bodies touched."""
        return (f"{self._name} was touched",) if self._minimum < 0.0 else ()


class PushTo:
    """Walk behind a body and push it to a target position."""

    def __init__(self, stance: Stance, other: OtherBody, name: str, target: np.ndarray) -> None:
        """Create the target; ``target`` (2,) m is the target position of the other body, ground frame of ``stance``."""
        self._stance, self._other, self._name, self._target = stance, other, name, target
        arm = target - other.centre(stance)
        self._direction = arm / max(float(np.linalg.norm(arm)), 1e-9)
        self._radius = radius_of(stance.ground.local(stance.standing))
        self._is_pushing = False

    def goal(self, view: View) -> np.ndarray:
        """Return the point to walk to: first a point behind the body, then a point ahead on the line of the push."""
        centre, along = self._line()
        height = self._stance.body.height
        extent = float(((centre - self._stance.ground.local(self._other.points())[:, :2]) @ along).max())
        touching = self._radius + extent
        behind = centre - (touching + _RUN_UP * height) * along
        across = np.array([-along[1], along[0]])
        lateral, depth = float((view.position - centre) @ across), float((view.position - centre) @ along)
        if self._is_pushing and (abs(lateral) > _MAX_OFFSET * touching or depth > 0.0):
            self._is_pushing = False
        if not self._is_pushing and np.linalg.norm(view.position - behind) < 1.5 * _ARRIVED * height:
            self._is_pushing = True
        if not self._is_pushing:
            return behind
        # Steer back to the line, so that the pushing force points through the middle of the body towards the target.
        angle = float(np.clip(-_STEER_GAIN * lateral / height, -_MAX_STEER, _MAX_STEER))
        return view.position + height * (np.cos(angle) * along + np.sin(angle) * across)

    def _line(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the position (2,) m of the other body, and the unit vector (2,) of the line along which it is
        pushed."""
        centre = self._other.centre(self._stance)
        arm = self._target + _AIM_DISTANCE * self._stance.body.height * self._direction - centre
        return centre, arm / max(float(np.linalg.norm(arm)), 1e-9)

    def is_over(self, view: View) -> bool:
        """Return True if the other body has been pushed as far as its target position."""
        left = float((self._target - self._other.centre(self._stance)) @ self._direction)
        return left < _ARRIVED * self._stance.body.height

    def ignored(self) -> Sequence[str] | None:
        """Return None during a push: the body then walks straight to the goal, even up a ramp under the pushed body."""
        return None if self._is_pushing else ()

    def failures(self, view: View) -> tuple[str, ...]:
        """Describe the distance of the other body from its target position, if it is too large."""
        off = self._target - self._other.centre(self._stance)
        left = float(np.linalg.norm(off)) / self._stance.body.height
        return (f"{self._name} is {left:.2f} body heights from its target",) if left > _TOLERANCE else ()
