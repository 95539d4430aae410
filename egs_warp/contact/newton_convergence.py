"""Convergence test of the Newton loop with contact (Eq. 4, 8).

The host loop in ``coupled_step`` uses the methods of ``ConvergenceState``. The GPU loop uses the kernels of
``kernels/contact/newton_convergence.py``, which read the packed state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.contact.coulomb import FAILURE_TOLERANCE
from egs_warp.kernels.contact.newton_convergence import MIN_DECREASE, REFACTOR_RATIO, RESIDUAL_WINDOW

MAX_NEWTON_STEPS = 60
"""Maximum number of Newton steps of a round."""


@dataclass(frozen=True)
class ConvergenceState:
    """State and tolerances of one Newton loop (round). Residuals are divided by dt x weight."""

    tolerance: float
    """Residual at which the loop ends."""
    activation_residual: float
    """Residual below which the loop first searches for penetrating points; 0 disables the search."""
    coulomb_tolerance: float
    """Maximum violation of Coulomb's law, m/s."""
    steps: int = 0
    recent_residuals: tuple[float, ...] = ()
    """Residuals after the last accepted steps. A step must end below the largest of them."""
    max_steps: int = MAX_NEWTON_STEPS
    """Number of steps in the round at which the GPU loop stops and returns to the host."""

    def is_acceptable(self, size: float, length: float = 1.0) -> bool:
        """Return True if the line search may accept a point.

        The test is non-monotone, because contacts that open, close or begin to slide change the forces at once.

        Args:
            size: residual at the point; not finite where an element is inverted.
            length: fraction of the Newton step.
        """
        limit = max((1.0 - MIN_DECREASE * length) * max(self.recent_residuals, default=np.inf), self.tolerance)
        return bool(np.isfinite(size)) and size < limit

    def converges_slowly(self, size: float, before: float) -> bool:
        """Return True if a step from residual ``before`` to ``size`` shows that the tangent should be updated."""
        return self.steps > 0 and size > REFACTOR_RATIO * before

    def may_activate_contacts(self, size: float, before: float) -> bool:
        """Return True if a step from residual ``before`` to ``size`` passes the activation threshold."""
        return before > self.activation_residual >= size

    def after_steps(self, *sizes: float) -> ConvergenceState:
        """Return the state after accepted steps to residuals ``sizes``."""
        recent = (*self.recent_residuals, *sizes)[-RESIDUAL_WINDOW:]
        return replace(self, steps=self.steps + len(sizes), recent_residuals=recent)

    def after_failed_step(self) -> ConvergenceState:
        """Return the state after a step that was not accepted."""
        return replace(self, steps=self.steps + 1)

    def pack(self, unit: float, size: float | None) -> np.ndarray:
        """Pack the state for ``init_convergence_kernel`` and ``check_convergence_kernel``.

        Args:
            unit: dt x weight, N s. The packed residuals are in N s.
            size: residual at the start of the loop; None uses that of the last trial.
        """
        start = -1.0 if size is None else unit * size
        residuals = unit * np.array([self.tolerance, self.activation_residual]), unit * np.array(self.recent_residuals)
        padding = np.full(RESIDUAL_WINDOW - len(self.recent_residuals), -1.0)
        # The loop also stops at a numerical failure of the Coulomb solve, which the host then repeats.
        terms = np.array([min(self.coulomb_tolerance, FAILURE_TOLERANCE), float(self.max_steps), 0.0])
        return np.concatenate([[float(self.steps), start, start], residuals[0], terms, padding, residuals[1]])
