"""Speed of the machine, and the number of cage nodes of a live creature that suits it."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.threads import one_blas_thread

GPU_NODES = 500
"""Number of nodes on a GPU; a step with this number takes less than 1 / 60 s (docs/benchmarks/step.md)."""
MIN_CHOSEN, MAX_CHOSEN = 120, 500
"""Limits of the chosen number: the limbs of most bodies need at least the minimum, and the maximum is the number that
``animate`` uses."""
_PROBE_TIME = 0.3
"""Duration of the speed measurement, s. It is long enough for other processes to take their usual share of the
cores."""
_MIN_SPEED = 0.5
"""Speed that the chosen number should reach, as a fraction of real time."""
_PROBE_SIZE, _PROBE_COLUMNS = 300, 60
_STEP_TIME_PER_PROBE = 20.5
"""Mean time of a step of a jumping pawn, relative to the time of one pass of the probe under the same load (160 ms and
7.8 ms on two busy cores of a Xeon), for 250 requested nodes, with which its cage has 362. For 120 requested nodes, with
which its cage has 220, 97 ms and 7.0 ms were measured; the two exponents follow from both measurements."""
_REQUESTED_NODES, _REQUEST_EXPONENT = 250, 0.54
"""Requested number of nodes to which ``_STEP_TIME_PER_PROBE`` applies, and exponent with which the step time grows with
this number."""
_STEP_NODES, _STEP_EXPONENT = 362, 0.79
"""Number of nodes of a cage to which ``_STEP_TIME_PER_PROBE`` applies, and exponent with which the step time grows with
this number."""


@dataclass(frozen=True)
class MachineSpeed:
    """Speed of the machine under its current load, and the number of nodes to request for it."""

    seconds: float
    """Time of one pass of the probe, s (``probe_seconds``)."""

    @property
    def nodes(self) -> int:
        """Largest number of nodes to request, within limits, for which the CPU simulates at half of real-time speed or
        faster. The cage has more nodes; the pawn's factor is assumed."""
        slowdown = _MIN_SPEED * FRAME_RATE * self._step_seconds
        fitting = _REQUESTED_NODES * slowdown ** (-1.0 / _REQUEST_EXPONENT)
        return int(np.clip(10.0 * np.floor(0.1 * fitting), MIN_CHOSEN, MAX_CHOSEN))

    def speed(self, nodes: int) -> float:
        """Return the expected speed of a body whose cage has ``nodes`` nodes, as a fraction of real time, at most 1."""
        return min(1.0 / (FRAME_RATE * self._step_seconds * (nodes / _STEP_NODES) ** _STEP_EXPONENT), 1.0)

    @property
    def _step_seconds(self) -> float:
        """Expected time of a step of a body whose cage has ``_STEP_NODES`` nodes, s."""
        return _STEP_TIME_PER_PROBE * self.seconds

    def speed_note(self, nodes: int) -> str:
        """Return a note for the user about the speed of a body whose cage has ``nodes`` nodes."""
        speed = self.speed(nodes)
        return f"expect {'real time' if speed >= 1.0 else f'about {speed:.1g} of real time'}"


def probe_seconds() -> float:
    """Return the mean wall-clock time, s, of a dense factorisation and solve under the current load of the machine."""
    random = np.random.default_rng(0)
    half = random.standard_normal((_PROBE_SIZE, _PROBE_SIZE))
    matrix = half @ half.T + _PROBE_SIZE * np.eye(_PROBE_SIZE)
    columns = random.standard_normal((_PROBE_SIZE, _PROBE_COLUMNS))
    passes = 0
    with one_blas_thread():
        started = time.perf_counter()
        while passes < 2 or time.perf_counter() < started + _PROBE_TIME:
            scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix), columns)
            passes += 1
        return (time.perf_counter() - started) / passes
