"""What may be chosen of a step."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import Strategy


@dataclass(frozen=True)
class LocomotionSettings:
    """Numbers of the stepper; lengths are in body heights, forces in body weights, speeds in sqrt(g H)."""

    activation_distance: float = 0.01
    """A point takes part if the step may bring it this near to a plane."""
    penetration_tolerance: float = 5e-3
    push_out_cap: float = 0.05
    qp_limit: int = 12
    """QPs a step at most; in doubt ``strategies.PATIENCE`` times as many for all strategies but ``pieces``."""
    qp_solver: QpSolver | str | None = None
    """None is OSQP, whose iterations are kernels where the body lies on a GPU."""
    strategy: Strategy | str = Strategy.MODES
    directions: int = 4
    """n_d, edges of the friction pyramid of all strategies but ``pieces``, which has the cone."""
    activation_weight: float = 2e-4
    """For a step of sqrt(H / g) / 19 and a muscle of 4 body weights. Shorter steps change speeds by less, so they weigh
    activations less: by the square of their share. Stronger muscles weigh more, as their force."""
    activation_change_weight: float = 3e-3
    """Likewise, by the step's share, and by the square of the force: the strong muscles of a stiff body would else play
    full strokes against each other from step to step, further than the linearised program knows the way."""
    drag: float = 0.0
    """alpha, 1/s."""

    def __post_init__(self) -> None:
        # Names that are not known are refused here, not in the first step.
        if self.qp_solver is not None:
            QpSolver(self.qp_solver)
        Strategy(self.strategy)

    def qp_solver_on(self, device: wp.Device) -> QpSolver:
        """Who solves the QPs of a body that lies on ``device``."""
        if self.qp_solver is None:
            return QpSolver.ADMM if device.is_cuda else QpSolver.OSQP
        return QpSolver(self.qp_solver)
