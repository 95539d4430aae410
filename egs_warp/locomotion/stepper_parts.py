"""Parts of a stepper that exist for the host and for a GPU: contact linearizer and device planner."""

from __future__ import annotations

from typing import Any

from egs_warp.contact.coupled_step import CoupledSolver
from egs_warp.contact.newton import ContactLinearizer
from egs_warp.fem.body import SoftBody
from egs_warp.fem.linear_solver import LinearSolver
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.locomotion.planner import StepPlanner
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import Strategy
from egs_warp.muscles.muscle_set import MuscleSet


def make_linearizer(
    factors: LinearSolver, body: SoftBody, muscles: MuscleSet, solver: CoupledSolver
) -> ContactLinearizer:
    """Return the contact linearizer for tangents of ``body``: on the host, or on the device of ``factors``."""
    if isinstance(factors, MultifrontalLdl):
        return ContactLinearizer()
    from egs_warp.contact.device_newton import DeviceContactLinearizer
    from egs_warp.contact.prefetch import ContactPrefetch
    from egs_warp.fem.tiled_cholesky import TiledCholesky

    assert isinstance(factors, TiledCholesky)
    prefetch = ContactPrefetch(solver.detector, solver.points, factors.stream, solver.penetration_tolerance)
    return DeviceContactLinearizer(factors, body, muscles, prefetch)


def make_device_planner(planner: StepPlanner, linearizer: ContactLinearizer, solver: CoupledSolver) -> Any:
    """Return a device planner, or None if the matrices are on the host or the strategy or the QP solver runs on the
    host."""
    settings, device = planner.settings, planner.body.assembly.device
    if linearizer.is_on_host or Strategy(settings.strategy) is not Strategy.MODES:
        return None
    if settings.qp_solver_on(device) is not QpSolver.ADMM:
        return None
    from egs_warp.contact.device_newton import DeviceContactLinearizer
    from egs_warp.locomotion.device_plan import DevicePlanner

    assert isinstance(linearizer, DeviceContactLinearizer)
    return DevicePlanner(planner, linearizer, solver.progress)
