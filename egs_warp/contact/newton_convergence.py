"""What tells whether a round of Newton steps with contact goes on (Eq. 4, 8): on the host, and in a loop on a GPU."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.contact.coulomb import FAILURE_TOLERANCE
from egs_warp.kernels.contact.newton_convergence import MIN_DECREASE, REFACTOR_RATIO, RESIDUAL_WINDOW

MAX_NEWTON_STEPS = 60
"""Of a round at most."""


@dataclass(frozen=True)
class ConvergenceState:
    """A round so far, and its terms. Residuals are over dt x weight."""

    tolerance: float
    """Residual at which it ends."""
    activation_residual: float
    """Residual below which a round that comes down to it looks for points that are to join; 0 if none may."""
    coulomb_tolerance: float
    """m/s by which forces may miss their laws."""
    steps: int = 0
    recent_residuals: tuple[float, ...] = ()
    """Residuals after the last steps that went well, of which the largest must be undercut."""
    max_steps: int = MAX_NEWTON_STEPS
    """Steps, of all of the round, that may be taken without a look."""

    def is_acceptable(self, size: float, length: float = 1.0) -> bool:
        """Whether it may go on from a residual of ``size``, at the end of so much of a step. Contacts that open, close
        or begin to slide change the forces at once: it need not fall in every step. It is no number where an element is
        inverted."""
        least = max((1.0 - MIN_DECREASE * length) * max(self.recent_residuals, default=np.inf), self.tolerance)
        return bool(np.isfinite(size)) and size < least

    def converges_slowly(self, size: float, before: float) -> bool:
        """Whether a step from a residual ``before`` to one of ``size`` speaks against its tangent."""
        return self.steps > 0 and size > REFACTOR_RATIO * before

    def may_activate_contacts(self, size: float, before: float) -> bool:
        """Whether it has come down to where points are looked for that are to join."""
        return before > self.activation_residual >= size

    def after_steps(self, *sizes: float) -> ConvergenceState:
        """After steps to residuals of these ``sizes``, which went well."""
        recent = (*self.recent_residuals, *sizes)[-RESIDUAL_WINDOW:]
        return replace(self, steps=self.steps + len(sizes), recent_residuals=recent)

    def after_failed_step(self) -> ConvergenceState:
        """After a step that did not."""
        return replace(self, steps=self.steps + 1)

    def pack(self, unit: float, size: float | None) -> np.ndarray:
        """As ``begin_kernel`` and ``judge_kernel`` read it, with residuals in N s, of which ``unit`` are 1: it goes on
        from one of ``size``, or from that of the last trial."""
        begin = -1.0 if size is None else unit * size
        residuals = unit * np.array([self.tolerance, self.activation_residual]), unit * np.array(self.recent_residuals)
        gone = np.full(RESIDUAL_WINDOW - len(self.recent_residuals), -1.0)
        # What is led astray is for the host to find.
        terms = np.array([min(self.coulomb_tolerance, FAILURE_TOLERANCE), float(self.max_steps), 0.0])
        return np.concatenate([[float(self.steps), begin, begin], residuals[0], terms, gone, residuals[1]])
