"""Steps with contact of many worlds side by side: ``coupled_step`` in lockstep, on the device (Eq. 4, 8, 9).

Every world takes the decisions that it would take alone; those that are done wait for the others.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Protocol

import torch

from egs_warp.contact.batch_contacts import BatchContacts, BatchDetector, coulomb_forces_of_many, padded
from egs_warp.contact.coupled_step import (
    ADDED,
    ANSWERED,
    CREEPS,
    JOINING,
    PUSH_OUT,
    ROUNDS,
    SHORTEST,
    SINKS,
    UNANSWERED,
)
from egs_warp.contact.course import ITERATIONS
from egs_warp.contact.response import SINGULAR
from egs_warp.fem.batch_problem import BatchProblem, BatchTurning, inverse_of
from egs_warp.fem.worlds import Worlds, indices
from egs_warp.kernels.contact.course import MEMORY, SLOW


class Stages(Protocol):
    """Whoever wants to know where the time goes."""

    def __call__(self, name: str) -> AbstractContextManager[object]:
        """Around the work of the stage ``name``."""
        ...


def untimed(name: str) -> AbstractContextManager[object]:
    """``Stages`` of nobody."""
    return nullcontext()


@dataclass(frozen=True)
class BatchResponse(Worlds):
    """``ContactResponse`` of c worlds, by the tangents in their slots."""

    turning: BatchTurning
    columns: torch.Tensor
    """(c, 3N, 3K)."""
    delassus: torch.Tensor
    """(c, 3K, 3K), made regular."""


@dataclass(frozen=True)
class BatchResult(Worlds):
    """``CoupledResult`` of c worlds."""

    velocities: torch.Tensor
    """(c, N, 3) m/s."""
    forces: torch.Tensor
    """(c, K, 3) newtons."""
    converged: torch.Tensor
    """(c,) bool."""
    iterations: torch.Tensor
    """(c,) int64."""
    lost: torch.Tensor
    """(c,) bool: a tangent had no factors, ``UnsolvableStepError``."""
    joined: torch.Tensor
    """(c,) bool: it ended where points were found that are to join."""


@dataclass(frozen=True)
class BatchSolver:
    """``CoupledSolver`` of many worlds."""

    detector: BatchDetector
    push_out_cap: float
    """m/s."""
    penetration_tolerance: float
    """Metres."""
    tolerance: float
    """Residual over dt x weight."""
    stages: Stages = untimed

    def shift(self, contacts: BatchContacts, dt: float) -> torch.Tensor:
        """(c, K) m/s: ``push_out_speeds``."""
        gaps = contacts.gaps
        deep = ((gaps + self.penetration_tolerance).clamp(max=0.0) * PUSH_OUT / dt).clamp(min=-self.push_out_cap)
        return (gaps.clamp(min=0.0) / dt + deep) * contacts.there

    def respond(
        self, problem: BatchProblem, contacts: BatchContacts, turning: BatchTurning | None = None
    ) -> BatchResponse:
        """By the tangents in the worlds' slots, with their ``turning`` if it is known."""
        with self.stages("substitute"):
            columns, turning = inverse_of(problem, problem.dt * contacts.rows(problem.positions.shape[1]), turning)
        delassus = contacts.speeds(columns)
        diagonal = delassus.diagonal(dim1=1, dim2=2)
        mean = diagonal.sum(dim=1, keepdim=True) / (3 * contacts.counts[:, None]).clamp(min=1)
        diagonal += SINGULAR * mean
        return BatchResponse(turning, columns, delassus)

    def forces(
        self,
        contacts: BatchContacts,
        response: BatchResponse,
        free: torch.Tensor,
        shift: torch.Tensor,
        frictions: torch.Tensor,
        start: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """``ContactResponse.forces``: (c, K, 3) newtons where the bodies move at ``free`` (c, N, 3) without, and (c,)
        m/s by which they miss the laws."""
        with self.stages("coulomb"):
            speeds = contacts.speeds(free.flatten(1)[:, :, None])[:, :, 0]
            return coulomb_forces_of_many(contacts.counts, response.delassus, speeds, shift, frictions, start)

    def solve(
        self,
        problem: BatchProblem,
        contacts: BatchContacts,
        response: BatchResponse,
        tensions: torch.Tensor,
        frictions: torch.Tensor,
        *,
        velocities: torch.Tensor,
        forces: torch.Tensor,
        start_gaps: tuple[torch.Tensor, torch.Tensor],
    ) -> tuple[BatchContacts, BatchResult]:
        """The steps from a start of ``velocities`` (c, N, 3) and ``forces`` (c, K, 3) under muscles' ``tensions``
        (c, M) newtons; ``start_gaps`` are gaps and faces at the start of the step."""
        count = len(velocities)
        whole = BatchResult(
            velocities.clone(),
            forces.clone(),
            torch.zeros(count, dtype=torch.bool, device=velocities.device),
            torch.zeros(count, dtype=torch.int64, device=velocities.device),
            *torch.zeros((2, count), dtype=torch.bool, device=velocities.device),
        )
        todo = every = torch.arange(count, device=velocities.device)
        for number in range(ROUNDS):
            part, touched = problem.kept(todo), contacts.kept(todo)
            shift, gaps = self.shift(touched, problem.dt), start_gaps[0][todo]
            task = _Task(part, touched, shift, tensions[todo], frictions[todo], gaps)
            last = number == ROUNDS - 1
            done, left = self._round(task, response, whole.velocities[todo], whole.forces[todo], last=last)
            done = replace(done, iterations=done.iterations + whole.iterations[todo])
            whole.put(todo, done)
            if last:
                break
            with self.stages("detect"):
                added, ends = self._added(task, done.velocities)
            more = indices(added.any(dim=1) & (done.converged | done.joined))
            if len(more) == 0:
                break
            new = self.detector.contacts(added[more], *(each[todo[more]] for each in start_gaps), order=ends[more])
            grown, forces = self.detector.joined(touched.of(more), done.forces[more], new)
            wider = grown.most - contacts.most
            # A copy: those that were given stay as they are.
            contacts = contacts.widened(grown.most).of(every)
            whole = replace(whole, forces=padded(whole.forces, wider))
            todo = todo[more]
            contacts.put(todo, grown)
            whole.forces[todo] = forces
            response = self.respond(problem.kept(todo), grown, left.turning.of(more))
        return contacts, whole

    def _added(self, task: _Task, velocities: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(c, P) bool: the points that would end too deep by ``velocities`` (c, N, 3); (c, P) metres, the gaps of all
        at the end."""
        gaps, _ = self.detector.gaps(task.problem.end_positions(velocities))
        tolerance = self.penetration_tolerance
        allowed = torch.where(gaps < -tolerance, CREEPS * tolerance, SINKS * tolerance)
        sinking = torch.where(gaps < task.start_gaps - allowed, gaps, 0.0)
        return self.detector.deeper(task.contacts, sinking, ADDED * tolerance), gaps

    def _round(
        self, task: _Task, response: BatchResponse, velocities: torch.Tensor, forces: torch.Tensor, *, last: bool
    ) -> tuple[BatchResult, BatchResponse]:
        """Newton's method with the task's contacts, until points are found that are to join, but in the ``last`` round;
        the last tangents' response comes along."""
        with self.stages("elasticity"):
            every = _Search.begin(velocities, forces, *task.missing(velocities, forces))
        for iteration in range(1, ITERATIONS + 1):
            active = indices(every.active)
            if len(active) == 0:
                break
            part, search = task.kept(active), every.kept(active)
            search.iterations.fill_(iteration)
            slow = self._step(part, search, response.kept(active), first=iteration == 1)
            looking = indices(search.near)
            if len(looking) > 0 and not last:
                self._look(part.kept(looking), search, looking)
            fresh = indices(slow & search.active)
            if len(fresh) > 0:
                again = part.kept(fresh)
                with self.stages("factor"):
                    factored = again.problem.factor(search.velocities[fresh], again.tensions)
                response.put(active[fresh], self.respond(again.problem, again.contacts))
                search.fresh[fresh] = True
                search.lost[fresh] = ~factored
                search.active[fresh] = factored
            if search is not every:
                every.put(active, search)
        ends = every.velocities, every.forces, every.converged, every.iterations, every.lost, every.joined
        return BatchResult(*ends), response

    def _look(self, task: _Task, search: _Search, places: torch.Tensor) -> None:
        """Whether points are to join in the worlds of the ``task``, which are at ``places`` of the ``search``."""
        with self.stages("detect"):
            added, _ = self._added(task, search.velocities[places])
        joined = added.any(dim=1)
        search.joined[places], search.active[places] = joined, ~joined

    def _step(self, task: _Task, search: _Search, response: BatchResponse, *, first: bool) -> torch.Tensor:
        """One Newton step of each world in ``search``, which has it then; (c,) bool, where the tangent is to be made
        anew."""
        problem = task.problem
        answered = ANSWERED * problem.unit / problem.common.body.mass
        with self.stages("substitute"):
            moved, _ = inverse_of(problem, search.free.flatten(1)[:, :, None], response.turning)
        loose = search.velocities - moved.view_as(search.velocities)
        wanted, missed = self.forces(task.contacts, response, loose, task.shift, task.frictions, search.forces)
        unanswered = missed > answered
        search.unanswered.add_(unanswered)
        pushed = (response.columns @ wanted.flatten(1)[:, :, None]).view_as(loose)
        change, turned = loose + pushed - search.velocities, wanted - search.forces
        before = search.size.clone()
        better, whole = torch.zeros((2, len(before)), dtype=torch.bool, device=before.device)
        most = search.recent.amax(dim=1)
        most = torch.where(most >= 0.0, most, torch.inf)
        waiting, length = torch.arange(len(before), device=before.device), 1.0
        while length > SHORTEST and len(waiting) > 0:
            trial = search.velocities[waiting] + length * change[waiting]
            trial_forces = search.forces[waiting] + length * turned[waiting]
            with self.stages("elasticity"):
                free, size = task.kept(waiting).missing(trial, trial_forces)
            least = ((1.0 - 1e-4 * length) * most[waiting]).clamp(min=self.tolerance)
            good = size.isfinite() & (size < least) if not first else size.isfinite()
            at = waiting[good]
            better[at] = True
            whole[at] = length == 1.0
            search.velocities[at], search.forces[at] = trial[good], trial_forces[good]
            search.free[at], search.size[at] = free[good], size[good]
            waiting, length = waiting[~good], 0.5 * length
        recent = torch.cat([search.recent[:, 1:], search.size[:, None]], dim=1)
        search.recent.copy_(torch.where(better[:, None], recent, search.recent))
        search.converged.copy_(whole & (search.size <= self.tolerance) & ~unanswered)
        search.near.copy_(whole & (before > JOINING) & (search.size <= JOINING) & ~unanswered & ~search.converged)
        given_up = (~better & search.fresh) | (search.unanswered > UNANSWERED)
        search.active.copy_(~search.converged & ~given_up)
        search.fresh.fill_(False)
        slow = ~better | ~whole | unanswered
        return slow if first else slow | (search.size > SLOW * before)


@dataclass(frozen=True)
class _Task(Worlds):
    """What a round of c worlds is asked."""

    problem: BatchProblem
    contacts: BatchContacts
    shift: torch.Tensor
    """(c, K) m/s."""
    tensions: torch.Tensor
    """(c, M) newtons."""
    frictions: torch.Tensor
    """(c,)."""
    start_gaps: torch.Tensor
    """(c, P) metres."""

    def missing(self, velocities: torch.Tensor, forces: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(c, N, 3) N s, the residual without contact at ``velocities`` (c, N, 3), and (c,) the size of that with
        ``forces`` (c, K, 3), over dt x weight."""
        problem = self.problem
        free = problem.residual(velocities, self.tensions)
        rest = free - problem.dt * self.contacts.pushes(forces, velocities.shape[1])
        return free, rest.flatten(1).norm(dim=1) / problem.unit


@dataclass(frozen=True)
class _Search(Worlds):
    """Where Newton's method is in each of c worlds; written in place."""

    velocities: torch.Tensor
    """(c, N, 3) m/s."""
    forces: torch.Tensor
    """(c, K, 3) newtons."""
    free: torch.Tensor
    """(c, N, 3) N s, the residual without contact."""
    size: torch.Tensor
    """(c,) of the residual with it, over dt x weight."""
    recent: torch.Tensor
    """(c, MEMORY) sizes of the last steps; -1 where there was none."""
    unanswered: torch.Tensor
    """(c,) int64: how often forces missed their laws."""
    iterations: torch.Tensor
    """(c,) int64."""
    active: torch.Tensor
    """(c,) bool."""
    fresh: torch.Tensor
    """(c,) bool: the tangent is that of the velocities."""
    converged: torch.Tensor
    """(c,) bool."""
    lost: torch.Tensor
    """(c,) bool."""
    near: torch.Tensor
    """(c,) bool: by its last step the end is known well enough to look for points that are to join."""
    joined: torch.Tensor
    """(c,) bool: there were some."""

    @classmethod
    def begin(cls, velocities: torch.Tensor, forces: torch.Tensor, free: torch.Tensor, size: torch.Tensor) -> _Search:
        """All worlds are to go."""
        count, device = len(size), size.device
        numbers = torch.zeros((2, count), dtype=torch.int64, device=device)
        flags = torch.zeros((6, count), dtype=torch.bool, device=device)
        flags[0] = True
        return cls(velocities, forces, free, size, size.new_full((count, MEMORY), -1.0), *numbers, *flags)
