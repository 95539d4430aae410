"""Routes: the planar pose of a body after each step.

A planar pose is (x, y, heading): metres forward and to the left of the start, radians about the up axis. See
docs/concepts/motions.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.text import read_text

MAX_STEPS = 400
"""Largest number of steps of one walk."""
_MAX_GAP = 1.0
"""Largest distance in body heights between two points of a path."""
_ROUNDING = 1e-9
"""Tolerance of rounding errors, in metres or steps."""


@dataclass(frozen=True)
class StepLimits:
    """Maximum change of a body's planar pose in one step. In a step with rotation, the maximum displacement is
    smaller."""

    length: float
    """Largest displacement, m."""
    turn: float
    """Largest rotation, rad."""
    side_fraction: float = 0.0
    """Largest sideways displacement as a fraction of ``length``."""
    faces_travel: bool = True
    """True if the body turns to the direction in which it moves. A body that rolls or crawls moves in any direction
    without turning."""


Route = Callable[[StepLimits], np.ndarray]
"""Function that returns the planar poses (P+1, 3) before the first step and after each step, for the limits of a
step."""


def straight_route(distance: float) -> Route:
    """Return the route of ``distance`` metres forward in equal steps; a negative distance leads backwards."""

    def planar_poses(limits: StepLimits) -> np.ndarray:
        count = max(int(np.ceil(abs(distance) / limits.length - _ROUNDING)), 1)
        return np.linspace([0.0, 0.0, 0.0], [distance, 0.0, 0.0], count + 1)

    return planar_poses


def turn_route(angle: float) -> Route:
    """Return the route that turns by ``angle`` radians on the spot, in equal steps."""

    def planar_poses(limits: StepLimits) -> np.ndarray:
        count = max(int(np.ceil(abs(angle) / limits.turn - _ROUNDING)), 1)
        return np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, angle], count + 1)

    return planar_poses


def path_route(points: np.ndarray) -> Route:
    """Return the route through ``points`` (n, 2), m. A body that faces its direction of travel turns on the spot where
    necessary.

    Raises:
        UserError: if the path takes more than ``MAX_STEPS`` steps; it is raised when the returned route is called.
    """

    def planar_poses(limits: StepLimits) -> np.ndarray:
        poses = [np.zeros(3)]
        for number, point in enumerate(points):
            near = _ROUNDING if number == len(points) - 1 else limits.length
            while np.linalg.norm(point - poses[-1][:2]) > near:
                if len(poses) > MAX_STEPS:
                    raise UserError(f"walk: the path takes more than {MAX_STEPS} steps; choose a shorter one")
                poses.append(_nearer(poses[-1], point, limits))
        return np.array(poses) if len(poses) > 1 else np.zeros((2, 3))

    return planar_poses


def _nearer(planar_pose: np.ndarray, point: np.ndarray, limits: StepLimits) -> np.ndarray:
    """Return the planar pose (3,) one step after ``planar_pose`` (3,) towards ``point`` (2,)."""
    arm = point - planar_pose[:2]
    if not limits.faces_travel:
        distance = float(np.linalg.norm(arm))
        return np.array([*(planar_pose[:2] + min(1.0, limits.length / distance) * arm), planar_pose[2]])
    off = np.arctan2(arm[1], arm[0]) - planar_pose[2]
    turn = float(np.clip((off + np.pi) % (2.0 * np.pi) - np.pi, -limits.turn, limits.turn))
    heading = planar_pose[2] + turn
    ahead = np.array([np.cos(heading), np.sin(heading)])
    length = min(limits.length * (1.0 - abs(turn) / limits.turn), max(float(arm @ ahead), 0.0))
    if float(np.linalg.norm(arm)) <= limits.length and abs(turn) < 0.5 * limits.turn:
        return np.array([*point, heading])
    return np.array([*(planar_pose[:2] + length * ahead), heading])


def read_path(path: Path) -> np.ndarray:
    """Read a path from a file of lines ``ahead,left``.

    Returns:
        (n, 2) body heights forward and to the left of the start.

    Raises:
        UserError: for a malformed file or a gap; the message contains the line.
    """
    points: list[Sequence[float]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            point = [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            if not points:
                continue  # Skip the header line.
            point = []
        if len(point) != 2 or not np.all(np.isfinite(point)):
            raise UserError(
                f"{path}, line {number}: {line.strip()[:60]!r}: give two numbers, ahead and left in body heights"
            )
        gap = float(np.linalg.norm(np.subtract(point, points[-1] if points else (0.0, 0.0))))
        if gap > _MAX_GAP:
            advice = f"give points at most {_MAX_GAP:g} apart, the first at most that far from the start 0,0"
            raise UserError(f"{path}, line {number}: the path jumps by {gap:.3g} body heights; {advice}")
        points.append(point)
    if not points:
        raise UserError(f"{path}: it has no points; give lines of two numbers, ahead and left in body heights")
    return np.array(points)
