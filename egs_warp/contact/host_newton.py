"""Newton steps with contact on a CPU, in one or two kernel launches each (Eq. 4, 8).

The kernels are in ``kernels/contact/iterate_cpu.py``. ``HostNewtonWorkspace.trial`` moves an iterate along a Newton
step and evaluates the residual of the result; ``HostNewtonWorkspace.newton`` solves for the next contact-free
velocities.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from egs_warp.contact.contact_set import ContactSet
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.simd_elasticity import SimdElasticity
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.kernels.contact import iterate_cpu as kernels
from egs_warp.launching import launch_cached, shared_zeros, thread_local_cache
from egs_warp.muscles.tension import MuscleEnergy


class IterateBuffer:
    """Data of a Newton iterate in one block of memory, so that only one address has to be looked up. In NumPy, a
    look-up takes longer than the computation with the array."""

    def __init__(self, contacts: ContactSet) -> None:
        size, width = 3 * contacts.node_count, 3 * contacts.count
        self.contacts, self._all = contacts, np.empty(3 * size + 2 * width)
        self._ends = [size, 2 * size, 3 * size, 3 * size + width]
        address = address_of(self._all)
        (
            self.velocities_at,
            self.free_velocities_at,
            self.free_residual_at,
            self.forces_at,
            self.free_contact_velocities_at,
        ) = (address + 8 * offset for offset in (0, *self._ends))

    @classmethod
    def of(cls, contacts: ContactSet, velocities: np.ndarray, forces: np.ndarray) -> IterateBuffer:
        """Create a buffer with nodal ``velocities`` (N, 3) m/s and contact ``forces`` (n, 3) newtons."""
        state = cls(contacts)
        state.velocities[:], state.forces[:] = velocities, forces
        return state

    def copy(self) -> IterateBuffer:
        """Return a copy in separate memory."""
        other = IterateBuffer(self.contacts)
        other._all[:] = self._all
        return other

    @property
    def velocities(self) -> np.ndarray:
        """(N, 3) m/s, nodal velocities."""
        return self._all[: self._ends[0]].reshape(-1, 3)

    @property
    def free_velocities(self) -> np.ndarray:
        """(N, 3) m/s, nodal velocities after a Newton step without contact forces."""
        return self._all[self._ends[0] : self._ends[1]].reshape(-1, 3)

    @property
    def forces(self) -> np.ndarray:
        """(n, 3) newtons, contact forces."""
        return self._all[self._ends[2] : self._ends[3]].reshape(-1, 3)

    @property
    def free_contact_velocities(self) -> np.ndarray:
        """(3n,) m/s, contact velocities after a Newton step without contact forces."""
        return self._all[self._ends[3] :]


class HostNewtonWorkspace:
    """Buffers for the steps of a body with ``nodes`` nodes. The data of the last step stay loaded."""

    def __init__(self, nodes: int) -> None:
        self._device = wp.get_device("cpu")
        self._step = kernels.Step()
        sizes = {
            "positions": 3 * nodes,
            "ballistic_velocities": 3 * nodes,
            "arms": 3 * nodes,
            "inverse_inertia": 9,
            "masses": nodes,
        }
        self._step_arrays: dict[str, np.ndarray] = {}
        for name, size in sizes.items():
            self._step_arrays[name], array = shared_zeros(size)
            setattr(self._step, name, array)
        _, self._ends = shared_zeros((nodes, 3))
        _, self._gradient = shared_zeros((nodes, 3))
        residual, self._residual = shared_zeros((nodes, 3))
        """Residual of the last trial with contact forces, N s."""
        self._residual_at = address_of(residual)
        self._norm, self._norm_array = shared_zeros(1)
        self._problem: StepProblem | None = None

    def trial(
        self,
        problem: StepProblem,
        tension: MuscleEnergy | None,
        base: IterateBuffer,
        step: tuple[int, np.ndarray, float] | None = None,
    ) -> tuple[IterateBuffer, float]:
        """Evaluate the residual at ``base``, or at a point on the Newton step from ``base``.

        Args:
            problem: the step.
            tension: muscle energy, or None.
            base: start of the Newton step.
            step: address of the columns (3N, 3n), contact forces (n, 3) of the Newton step, and the fraction of the
                step to take; None evaluates ``base`` itself.

        Returns:
            The evaluated iterate, and the norm of its residual, divided by dt x weight.
        """
        self._load(problem)
        assembly = problem.body.assembly
        elements, segments = assembly.elements, assembly.load_segments(tension)
        assert isinstance(elements, SimdElasticity)
        columns, target_forces, length = 0, base.forces_at, 0.0
        end = base
        if step is not None:
            columns, forces, length = step
            target_forces, end = address_of(forces), IterateBuffer(base.contacts)
        launch_cached(
            kernels.trial_kernel,
            1,
            inputs=[
                *(elements.elements, elements.struct_of(segments), self._step, problem.damping.start),
                *(problem.dt, problem.inertia_ratio, *base.contacts.addresses, columns),
                *(base.velocities_at, base.free_velocities_at, base.forces_at, target_forces, float(length)),
            ],
            outputs=[
                *(self._ends, self._gradient, self._residual, end.velocities_at, end.forces_at, end.free_residual_at),
                self._norm_array,
            ],
            device=self._device,
        )
        return end, float(self._norm[0]) / problem.residual_scale

    def newton(self, tangent: Tangent, state: IterateBuffer, *, rest: bool = False) -> None:
        """Write the velocities and contact velocities after a Newton step without contact forces into ``state``.

        Args:
            tangent: factored tangent.
            state: the iterate.
            rest: if True, use the residual of the last trial, which includes contact forces, instead of the
                contact-free residual in ``state``.
        """
        factors = tangent.factors
        assert isinstance(factors, MultifrontalLdl)
        factor_arrays, low_rank_arrays, scratch = factors.solving_one(tangent.momentum_projection)
        right_side = self._residual_at if rest else state.free_residual_at
        launch_cached(
            kernels.newton_kernel,
            1,
            inputs=[*factor_arrays, *low_rank_arrays, *state.contacts.addresses, right_side, state.velocities_at],
            outputs=[scratch, state.free_velocities_at, state.free_contact_velocities_at],
            device=self._device,
        )

    def _load(self, problem: StepProblem) -> None:
        if self._problem is problem:
            return
        self._problem, arrays, state = problem, self._step_arrays, problem.state
        arrays["positions"][:], arrays["arms"][:] = state.positions.ravel(), problem.lever_arms.ravel()
        arrays["ballistic_velocities"][:] = (state.velocities + problem.dt * problem.body.gravity).ravel()
        arrays["inverse_inertia"][:], arrays["masses"][:] = problem.inverse_inertia.ravel(), problem.body.node_mass


host_newton_workspace = thread_local_cache(4)(HostNewtonWorkspace)
"""Return the workspace of this thread for the given number of nodes."""


def address_of(values: np.ndarray) -> int:
    """Return the address of a C-contiguous array."""
    assert values.flags.c_contiguous
    return values.ctypes.data
