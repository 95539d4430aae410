"""Newton steps with contact on a CPU by a launch or two, where arrays of the host take twenty calls (Eq. 4, 8)."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from egs_warp.contact.detection import ContactSet
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.simd_elasticity import SimdElasticity
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.kernels.contact import iterate_cpu as kernels
from egs_warp.launching import launch_cached, thread_local_cache
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.precision import real


class IterateBuffer:
    """What a step of Newton's method starts from, in one piece of memory: addresses take longer to find out than to
    use."""

    def __init__(self, contacts: ContactSet) -> None:
        size, width = 3 * contacts.node_count, 3 * contacts.count
        self.contacts, self._all = contacts, np.empty(3 * size + 2 * width)
        self._ends = [size, 2 * size, 3 * size, 3 * size + width]
        places = address_of(self._all)
        self.velocities_at, self.loose_at, self.free_at, self.forces_at, self.speeds_at = (
            places + 8 * begin for begin in (0, *self._ends)
        )

    @classmethod
    def of(cls, contacts: ContactSet, velocities: np.ndarray, forces: np.ndarray) -> IterateBuffer:
        """At nodal ``velocities`` (N, 3) and contact ``forces`` (n, 3)."""
        state = cls(contacts)
        state.velocities[:], state.forces[:] = velocities, forces
        return state

    def copy(self) -> IterateBuffer:
        """In memory of its own."""
        other = IterateBuffer(self.contacts)
        other._all[:] = self._all
        return other

    @property
    def velocities(self) -> np.ndarray:
        """(N, 3) m/s."""
        return self._all[: self._ends[0]].reshape(-1, 3)

    @property
    def free_velocities(self) -> np.ndarray:
        """(N, 3) m/s after a Newton step without contact forces."""
        return self._all[self._ends[0] : self._ends[1]].reshape(-1, 3)

    @property
    def forces(self) -> np.ndarray:
        """(n, 3) newtons."""
        return self._all[self._ends[2] : self._ends[3]].reshape(-1, 3)

    @property
    def free_contact_velocities(self) -> np.ndarray:
        """(3n,) m/s of the contacts after that step."""
        return self._all[self._ends[3] :]


class HostNewtonWorkspace:
    """Memory for a step of so many nodes, and what of it has been told already."""

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
        self._told: dict[str, np.ndarray] = {}
        for name, size in sizes.items():
            self._told[name], array = _shared(size)
            setattr(self._step, name, array)
        _, self._ends = _shared((nodes, 3))
        _, self._gradient = _shared((nodes, 3))
        rest, self._rest = _shared((nodes, 3))
        """N s, the residual of the last trial."""
        self._rest_at = address_of(rest)
        self._size, self._size_array = _shared(1)
        self._problem: StepProblem | None = None
        self._contacts: tuple[ContactSet | None, list[Any], list[Any]] = (None, [], [])

    def trial(
        self,
        problem: StepProblem,
        tension: MuscleEnergy | None,
        base: IterateBuffer,
        step: tuple[int, np.ndarray, float] | None = None,
    ) -> tuple[IterateBuffer, float]:
        """From ``base`` on after a ``step``, or where that is: the state there, and the size of what the equation
        misses.

        A step is the address of columns (3N, 3n), contact forces (n, 3) that are wanted with them, and how much of the
        way is gone.
        """
        self._take(problem)
        elements = problem.body.assembly.elements
        assert isinstance(elements, SimdElasticity)
        columns, wanted, length = 0, base.forces_at, 0.0
        end = base
        if step is not None:
            columns, given, length = step
            wanted, end = address_of(given), IterateBuffer(base.contacts)
        launch_cached(
            kernels.trial_kernel,
            1,
            inputs=[
                *(elements.elements, elements.lines_of(tension), self._step, problem.damping.start),
                *(problem.dt, 1.0 + problem.dt * problem.drag, *self._contacts_of(base.contacts), columns),
                *(base.velocities_at, base.loose_at, base.forces_at, wanted, float(length)),
            ],
            outputs=[
                *(self._ends, self._gradient, self._rest, end.velocities_at, end.forces_at, end.free_at),
                self._size_array,
            ],
            device=self._device,
        )
        return end, float(self._size[0]) / problem.residual_scale

    def newton(self, tangent: Tangent, state: IterateBuffer, *, rest: bool = False) -> None:
        """In the ``state``: velocities and contact speeds after a Newton step by ``tangent`` without contact forces,
        or, from the last trial, with those that it has (``rest``)."""
        factors = tangent.factors
        assert isinstance(factors, MultifrontalLdl)
        solving, added, room = factors.solving_one(tangent.momentum_projection)
        right = self._rest_at if rest else state.free_at
        launch_cached(
            kernels.newton_kernel,
            1,
            inputs=[*solving, *added, *self._contacts_of(state.contacts), right, state.velocities_at],
            outputs=[room, state.loose_at, state.speeds_at],
            device=self._device,
        )

    def _take(self, problem: StepProblem) -> None:
        if self._problem is problem:
            return
        self._problem, told, state = problem, self._told, problem.state
        told["positions"][:], told["arms"][:] = state.positions.ravel(), problem.lever_arms.ravel()
        told["ballistic_velocities"][:] = (state.velocities + problem.dt * problem.body.gravity).ravel()
        told["inverse_inertia"][:], told["masses"][:] = problem.inverse_inertia.ravel(), problem.body.node_mass

    def _contacts_of(self, contacts: ContactSet) -> list[Any]:
        """How many they are, and the addresses of their nodes, weights and axes."""
        if self._contacts[0] is not contacts:
            parts = [
                np.ascontiguousarray(part, dtype=kind)
                for part, kind in ((contacts.nodes, np.int32), (contacts.weights, float), (contacts.axes, float))
            ]
            self._contacts = contacts, parts, [contacts.count, *map(address_of, parts)]
        return self._contacts[2]


host_newton_workspace = thread_local_cache(4)(HostNewtonWorkspace)
"""That of so many nodes, and of this thread."""


def _shared(shape: int | tuple[int, ...]) -> tuple[np.ndarray, wp.array]:
    values = np.zeros(shape)
    return values, wp.array(values, dtype=real, device="cpu", copy=False)


def address_of(values: np.ndarray) -> int:
    """Of its first number, behind which the others lie row by row."""
    assert values.flags.c_contiguous
    return values.ctypes.data
