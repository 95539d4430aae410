"""Progress of Newton's method with contact in one world (Eq. 4, 8).

The kernel in ``kernels/contact/newton_convergence.py`` judges the steps. This module runs the kernel on a CPU; the loop
on a GPU and the steps of many worlds (``batch_step``) use the same kernel.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from egs_warp.kernels.contact import newton_convergence as kernels
from egs_warp.launching import launch_cached, thread_local_cache
from egs_warp.precision import real

MAX_NEWTON_STEPS = 60
"""Maximum number of Newton steps of a round."""


class NewtonProgress:
    """Progress of one round of Newton's method. Residuals are divided by dt x weight."""

    def __init__(
        self,
        tolerance: float,
        activation_residual: float,
        coulomb_tolerance: float,
        *,
        max_steps: int = MAX_NEWTON_STEPS,
    ) -> None:
        """Start a round.

        Args:
            tolerance: residual at which the round ends.
            activation_residual: residual below which points that penetrate too far are first searched for; they are
                searched for again at the end. Negative values disable both searches.
            coulomb_tolerance: maximum violation of Coulomb's law, m/s.
            max_steps: number of steps of the round at which a loop on a GPU returns to the host.
        """
        self.row = np.full(kernels.ROW_SIZE, -1.0)
        """(ROW_SIZE,) row of progress, with the columns listed in ``kernels/contact/newton_convergence.py``."""
        self.row[: kernels.RECENT_RESIDUALS] = 0.0
        self.row[[kernels.RESIDUAL, kernels.PREVIOUS_RESIDUAL]] = -1.0
        self.row[[kernels.LENGTH, kernels.UNIT]] = 1.0
        self.row[kernels.TOLERANCE], self.row[kernels.ACTIVATION_RESIDUAL] = tolerance, activation_residual
        self.row[kernels.COULOMB_TOLERANCE], self.row[kernels.MAX_STEPS] = coulomb_tolerance, max_steps

    @property
    def steps(self) -> int:
        """Number of completed Newton steps of the round."""
        return int(self.row[kernels.STEPS])

    @property
    def length(self) -> float:
        """Fraction of the Newton step that the next trial takes."""
        return float(self.row[kernels.LENGTH])

    @property
    def previous_residual(self) -> float:
        """Residual before the last trial, divided by dt x weight."""
        return float(self.row[kernels.PREVIOUS_RESIDUAL])

    def has(self, bits: int) -> bool:
        """Return True if the outcome of the last trial has any of ``bits``."""
        return bool(int(self.row[kernels.OUTCOME]) & bits)

    def begin(self, residual: float) -> None:
        """Set the ``residual`` at the start of the next step, unless it is already known."""
        if self.row[kernels.RESIDUAL] < 0.0:
            self.row[kernels.RESIDUAL] = residual

    def judge(self, residual: float, violation: float) -> None:
        """Judge a trial.

        Args:
            residual: residual of the trial; not finite where an element is inverted.
            violation: violation of Coulomb's law by its forces, m/s.
        """
        values, arrays = _buffers(kernels.ROW_SIZE)
        values[:] = residual, violation, 0.0, *self.row
        inputs, outputs = [np.inf, *arrays[:3]], arrays[3:]
        launch_cached(kernels.judge_steps_kernel, 1, inputs=inputs, outputs=outputs, device=wp.get_device("cpu"))
        self.row[:] = values[3:]

    def take(self, row: np.ndarray) -> bool:
        """Copy the ``row`` (ROW_SIZE,) from a loop on a GPU; return True if the loop evaluated only one trial."""
        before = self.steps
        self.row[:] = row
        self.row[kernels.UNIT] = 1.0
        undecided = self.has(kernels.SHORTEN | kernels.REPEAT)
        return self.steps - before + undecided == 1

    def renew_tangent(self) -> None:
        """Record that the tangent was computed at the current velocities."""
        self.row[kernels.TANGENT_IS_CURRENT] = 1.0


@thread_local_cache(1)
def _buffers(columns: int) -> tuple[np.ndarray, list[wp.array]]:
    """Return memory for three inputs of ``judge_steps_kernel`` and a row of progress, and Warp arrays that share it."""
    values = np.zeros(3 + columns)
    parts = [values[k : k + 1] for k in range(3)]
    inputs = [wp.array(part, dtype=real, device="cpu", copy=False) for part in parts]
    row = wp.array(values[None, 3:], dtype=real, device="cpu", copy=False)
    return values, [*inputs, row, wp.zeros(1, dtype=int, device="cpu")]
