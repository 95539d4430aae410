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
"""Mean time of a step of a jumping pawn with ``_STEP_NODES`` nodes, relative to the time of one pass of the probe under
the same load (160 ms and 7.8 ms on two busy cores of a Xeon)."""
_STEP_NODES, _STEP_EXPONENT = 250, 0.54
"""Number of nodes to which ``_STEP_TIME_PER_PROBE`` applies, and exponent with which the step time grows with
this number (with 120 nodes, 97 ms and 7.0 ms were measured)."""


@dataclass(frozen=True)
class MachineSpeed:
    """Speed of the machine under its current load, and the number of nodes that suits it."""

    seconds: float
    """Time of one pass of the probe, s (``probe_seconds``)."""

    @property
    def nodes(self) -> int:
        """Largest number of nodes, within limits, for which the CPU simulates at half of real-time speed or faster."""
        fitting = (1.0 / (_MIN_SPEED * FRAME_RATE * self._per_node)) ** (1.0 / _STEP_EXPONENT)
        return int(np.clip(10.0 * np.floor(0.1 * fitting), MIN_CHOSEN, MAX_CHOSEN))

    def speed(self, nodes: int) -> float:
        """Return the expected speed of a body of ``nodes`` nodes, as a fraction of real time, at most 1."""
        return min(1.0 / (FRAME_RATE * self._per_node * nodes**_STEP_EXPONENT), 1.0)

    @property
    def _per_node(self) -> float:
        """Duration of a step of a body with one node, s."""
        return _STEP_TIME_PER_PROBE * self.seconds / _STEP_NODES**_STEP_EXPONENT

    def choice(self) -> str:
        """Return one line for the user about the chosen number of nodes."""
        return f"a body of about {self.nodes} nodes suits this machine; {self._expectation(self.nodes)}"

    def revision(self, nodes: int) -> str:
        """Return one line for the user about the speed of a body that has ``nodes`` nodes."""
        return f"the body has {nodes} nodes; {self._expectation(nodes)}"

    def _expectation(self, nodes: int) -> str:
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
