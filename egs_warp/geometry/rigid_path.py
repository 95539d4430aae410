"""Prescribed rigid motion of a body: translations and rotations at given times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.checked_calls import checked_constructor
from egs_warp.errors import UserError
from egs_warp.short_repr import short_repr


@checked_constructor
@dataclass(frozen=True)
class RigidPath:
    """Rigid motion of a body that follows a path whatever forces act on it, such as a lift or a swinging door.

    The body starts at rest at time 0 and passes through the given points. Between two points, its position is a cubic
    polynomial of time; it is at rest at each point.
    """

    __repr__ = short_repr

    times: Sequence[float]
    """(K,) s, time of each point, positive and ascending."""
    shifts: Sequence[Sequence[float]]
    """(K, 3) m, translation from the start to each point, in the axes of the world."""
    turns: Sequence[float] | None = None
    """(K,) degrees, rotation from the start to each point about the vertical through the centre of mass,
    counter-clockwise seen from above; with None, the body does not turn."""
    repeat: bool = False
    """True to repeat the path for ever; the last point must be the start."""

    def __post_init__(self) -> None:
        times, shifts, turns = self._arrays()
        if len(times) < 2:
            raise UserError("path: it has no points; give at least one")
        for number in range(1, len(times)):
            if not times[number - 1] < times[number] < np.inf:
                raise UserError(
                    f"path: time {number} is {times[number]:g} s, and the one before it {times[number - 1]:g} s; give"
                    " finite, ascending times above 0 s"
                )
        if len(shifts) != len(times) or len(turns) != len(times):
            raise UserError(
                f"path: the numbers of times, shifts and turns are {len(times) - 1}, {len(shifts) - 1} and"
                f" {len(turns) - 1}; give one shift for each time, and either no turns or one for each time"
            )
        for name, values in (("shift", shifts), ("turn", turns)):
            for number, value in enumerate(values):
                if not np.isfinite(value).all():
                    raise UserError(f"path: {name} {number} is {value.tolist()}; give finite numbers")
        if self.repeat and (shifts[-1].any() or turns[-1] % 360.0 != 0.0):
            raise UserError(
                f"path: it ends with the shift {shifts[-1].tolist()} and the turn {turns[-1]:g}, but a path that is"
                " repeated must end where it starts; add the start as its last point"
            )

    def _arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the times (K + 1,), translations (K + 1, 3) and rotations (K + 1,) of all points, including the
        start."""
        turns = np.zeros(len(self.times)) if self.turns is None else np.asarray(self.turns, float)
        shifts = [np.zeros(3), *(np.asarray(shift, float) for shift in self.shifts)]
        for number, shift in enumerate(shifts):
            if shift.shape != (3,):
                raise UserError(f"path: shift {number} has shape {shift.shape}; give three numbers (x, y, z)")
        return np.append(0.0, self.times), np.array(shifts), np.append(0.0, turns)

    @property
    def end(self) -> float:
        """Time of the last point, s; 0 for a repeated path."""
        return 0.0 if self.repeat else float(self.times[-1])

    def moved(self, positions: np.ndarray, time: float) -> np.ndarray:
        """Return the positions (N, 3) m at ``time`` s of nodes with equal masses that are at ``positions`` (N, 3) m at
        time 0."""
        times, shifts, turns = self._arrays()
        time = time % times[-1] if self.repeat else min(time, times[-1])
        after = int(np.clip(np.searchsorted(times, time, side="right"), 1, len(times) - 1))
        s = (time - times[after - 1]) / (times[after] - times[after - 1])
        s = s * s * (3.0 - 2.0 * s)
        turn, shift = (each[after - 1] + s * (each[after] - each[after - 1]) for each in (turns, shifts))
        centre = positions.mean(axis=0)
        rotation = Rotation.from_rotvec([0.0, 0.0, np.radians(turn)])
        return centre + rotation.apply(positions - centre) + shift
