"""Newton steps with contact on a CPU by a launch or two, where arrays of the host take twenty calls (Eq. 4, 8)."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from egs_warp.contact.detection import ContactSet
from egs_warp.fem.element_vectors import ElementVectors
from egs_warp.fem.sparse_factors import SparseFactors
from egs_warp.fem.step_problem import StepProblem, Tangent
from egs_warp.kernels.contact import iterate_cpu as kernels
from egs_warp.launching import kept_by_thread, launch_again
from egs_warp.muscles.tension import MuscleTension
from egs_warp.precision import real


class NewtonState:
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
    def of(cls, contacts: ContactSet, velocities: np.ndarray, forces: np.ndarray) -> NewtonState:
        """At nodal ``velocities`` (N, 3) and contact ``forces`` (n, 3)."""
        state = cls(contacts)
        state.velocities[:], state.forces[:] = velocities, forces
        return state

    def copy(self) -> NewtonState:
        """In memory of its own."""
        other = NewtonState(self.contacts)
        other._all[:] = self._all
        return other

    @property
    def velocities(self) -> np.ndarray:
        """(N, 3) m/s."""
        return self._all[: self._ends[0]].reshape(-1, 3)

    @property
    def loose(self) -> np.ndarray:
        """(N, 3) m/s after a Newton step without contact forces."""
        return self._all[self._ends[0] : self._ends[1]].reshape(-1, 3)

    @property
    def forces(self) -> np.ndarray:
        """(n, 3) newtons."""
        return self._all[self._ends[2] : self._ends[3]].reshape(-1, 3)

    @property
    def speeds(self) -> np.ndarray:
        """(3n,) m/s of the contacts after that step."""
        return self._all[self._ends[3] :]


class NewtonRoom:
    """Memory for a step of so many nodes, and what of it has been told already."""

    def __init__(self, nodes: int) -> None:
        self._device = wp.get_device("cpu")
        self._step = kernels.Step()
        sizes = {"positions": 3 * nodes, "known": 3 * nodes, "arms": 3 * nodes, "rates": 9, "masses": nodes}
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
        tension: MuscleTension | None,
        base: NewtonState,
        step: tuple[int, np.ndarray, float] | None = None,
    ) -> tuple[NewtonState, float]:
        """From ``base`` on after a ``step``, or where that is: the state there, and the size of what the equation
        misses.

        A step is the address of columns (3N, 3n), contact forces (n, 3) that are wanted with them, and how much of the
        way is gone.
        """
        self._take(problem)
        elements = problem.body.assembly.elements
        assert isinstance(elements, ElementVectors)
        columns, wanted, length = 0, base.forces_at, 0.0
        end = base
        if step is not None:
            columns, given, length = step
            wanted, end = address_of(given), NewtonState(base.contacts)
        launch_again(
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
        return end, float(self._size[0]) / problem.unit

    def newton(self, tangent: Tangent, state: NewtonState, *, rest: bool = False) -> None:
        """In the ``state``: velocities and contact speeds after a Newton step by ``tangent`` without contact forces,
        or, from the last trial, with those that it has (``rest``)."""
        factors = tangent.factors
        assert isinstance(factors, SparseFactors)
        solving, added, room = factors.solving_one(tangent.kept)
        right = self._rest_at if rest else state.free_at
        launch_again(
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
        told["positions"][:], told["arms"][:] = state.positions.ravel(), problem.arms.ravel()
        told["known"][:] = (state.velocities + problem.dt * problem.body.gravity).ravel()
        told["rates"][:], told["masses"][:] = problem.turning_rates.ravel(), problem.body.node_mass

    def _contacts_of(self, contacts: ContactSet) -> list[Any]:
        """How many they are, and the addresses of their nodes, weights and axes."""
        if self._contacts[0] is not contacts:
            parts = [
                np.ascontiguousarray(part, dtype=kind)
                for part, kind in ((contacts.nodes, np.int32), (contacts.weights, float), (contacts.axes, float))
            ]
            self._contacts = contacts, parts, [contacts.count, *map(address_of, parts)]
        return self._contacts[2]


newton_room = kept_by_thread(4)(NewtonRoom)
"""That of so many nodes, and of this thread."""


def _shared(shape: int | tuple[int, ...]) -> tuple[np.ndarray, wp.array]:
    values = np.zeros(shape)
    return values, wp.array(values, dtype=real, device="cpu", copy=False)


def address_of(values: np.ndarray) -> int:
    """Of its first number, behind which the others lie row by row."""
    assert values.flags.c_contiguous
    return values.ctypes.data
