"""Options of the stepper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import warp as wp

from egs_warp.checked_calls import NonNegative, Positive, PositiveCount, Range, checked_constructor
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import Strategy


@checked_constructor
@dataclass(frozen=True, kw_only=True)
class LocomotionSettings:
    """Options of ``LocomotionStepper``. Lengths are in body heights H, forces in body weights, speeds in sqrt(g H)."""

    activation_distance: NonNegative = 0.01
    """Gap at the end of a ballistic step below which a point can become a contact of the step."""
    penetration_tolerance: NonNegative = 5e-3
    """Depth up to which a contact point is not pushed out."""
    push_out_cap: NonNegative = 0.05
    """Maximum speed at which deeper contact points are pushed out."""
    qp_limit: PositiveCount = 12
    """Maximum number of QPs in a search; the search of a restart may use as many again."""
    qp_solver: QpSolver | str | None = None
    """QP solver; None selects ``osqp``, or ``admm`` if the body is on a GPU."""
    strategy: Strategy | str = Strategy.MODES
    """Strategy of the search over contact modes."""
    directions: Annotated[int, Range(3, 64)] = 4
    """n_d, number of edges of the friction pyramid of the strategy ``paper``. The strategy ``modes`` uses the exact
    cone instead."""
    activation_weight: Positive = 2e-4
    """Weight of squared activations, for a step of sqrt(H / g) / 19 and a muscle of 4 body weights. The weight is
    scaled with the square of the step size, because shorter steps change velocities less, and with the muscle's force.
    """
    activation_change_weight: NonNegative = 3e-3
    """Weight of squared changes of activation, for the same step and muscle as in ``activation_weight``. The weight is
    scaled with the step size and with the square of the muscle's force. Without it, strong muscles of a stiff body
    alternate at full range from step to step, beyond the range in which the linearised QP is accurate."""
    drag: NonNegative = 0.0
    """alpha of the Rayleigh damping, 1/s."""

    def __post_init__(self) -> None:
        # Reject unknown names here instead of in the first step.
        if self.qp_solver is not None:
            QpSolver(self.qp_solver)
        Strategy(self.strategy)

    def qp_solver_on(self, device: wp.Device) -> QpSolver:
        """Return the solver of the QPs for a body on ``device``."""
        if self.qp_solver is None:
            return QpSolver.ADMM if device.is_cuda else QpSolver.OSQP
        return QpSolver(self.qp_solver)
