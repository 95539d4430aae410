"""OSQP's iterations as kernels, compared with OSQP itself on recorded programs of motions.

python benchmarks/qp_kernels.py [--quick] [--device cuda:0] [--programs 1000] [--json PATH] [--plot PATH]

Built-in bodies with cages of about 250 nodes jump and walk (a snake crawls) on the CPU, with OSQP as the solver. Each
QP of their steps is recorded with its bounds, its start and ``skip_splitting`` (another QP of the step was solved).
Then both solvers solve all of them: ``full`` by iterations alone, to 1e-12, at most 20,000; ``few`` like the first
program of a step, 50 iterations on the rows that matter; ``whole`` as the engine does (few iterations and the active
set, or that alone). Milliseconds are medians per program: of OSQP with its set-up, of the kernels for one program
(``alone``, every tenth), and the share of one program when all are solved at once (``together``), both with the copies
to and from the device.

|x - x'| is relative to the largest |x|. If P is nearly singular (``flat``: smallest eigenvalue below 1e-6 of the
largest; optima that need not satisfy the contact laws) x is not unique: objective and A x are compared instead,
relative to their own size.

Aims: ``cpu_equal`` and ``gpu_equal``, for the device of this run: every program ends with OSQP's status, and |x - x'|
(or its substitute) is at most 1e-6 wherever both solve it; ``thousand``: there were 1,000 programs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np

from egs_warp.assets import figurine, pawn, snake
from egs_warp.locomotion import contact_modes
from egs_warp.locomotion.active_set import WhitenedQp
from egs_warp.locomotion.admm import AdmmPrograms, AdmmResult, AdmmStatus, DenseQp
from egs_warp.locomotion.operator_splitting import AdmmSplitting, OperatorSplitting, OsqpSplitting
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.solvers import QpSolution, QpSolver, QuadraticProgram, quadratic_program
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.simulated_run import simulate
from harness import Row, Table, flags, report, timed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOTIONS = (
    *((snake, 250, "walk"), (pawn, 175, "jump"), (figurine, 150, "jump")),
    *((pawn, 175, "walk"), (figurine, 150, "walk")),
)
"""Bodies, ``--nodes`` that give them cages of about 250 nodes, and motions."""
FULL_ACCURACY, MAX_ITERATIONS = 1e-12, 20000
"""Accuracy and maximum number of iterations of ``full``."""
FEW_ITERATIONS, FEW_ACCURACY = 50, 3e-5
"""Number of iterations and accuracy of ``few``, the engine's own."""
FLAT_RATIO = 1e-6
MAX_DIFFERENCE = 1e-6


@dataclass(frozen=True)
class Recorded:
    """A QP of a step."""

    motion: str
    program: DenseQp
    lower: np.ndarray
    upper: np.ndarray
    """(m,) bounds."""
    start: np.ndarray | None
    """(n,) start of the iterations; None for a cold start."""
    skip_splitting: bool

    @property
    def flat(self) -> bool:
        """True if its optimum is not unique."""
        smallest, *_, largest = np.linalg.eigvalsh(self.program.P)
        return bool(smallest < FLAT_RATIO * largest)


class _EnoughError(Exception):
    """Raised to stop the recorded motion when enough programs are recorded."""


@contextmanager
def recording(name: str, limit: int) -> Iterator[list[Recorded]]:
    """Record the QPs of the mode search in the yielded list, and stop the enclosed motion after ``limit`` of them."""
    records: list[Recorded] = []

    class Recorder:
        """A ``QuadraticProgram`` that records its inputs."""

        def __init__(self, P: np.ndarray, q: np.ndarray, A: np.ndarray, **options: Any) -> None:
            self._program, self._solver = DenseQp(P, q, A), quadratic_program(P, q, A, **options)

        def solve(
            self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None = None, *, skip_splitting: bool = False
        ) -> QpSolution:
            """Record the program and solve it; see ``QuadraticProgram.solve`` for the arguments."""
            if len(records) == limit:
                raise _EnoughError
            start_copy = None if start is None else start.copy()
            records.append(Recorded(name, self._program, lower.copy(), upper.copy(), start_copy, skip_splitting))
            return self._solver.solve(lower, upper, start, skip_splitting=skip_splitting)

    with patch.object(contact_modes, "quadratic_program", Recorder), suppress(_EnoughError):
        yield records


def recorded(body: Callable[..., Any], nodes: int, text: str, *, limit: int, seed: int) -> list[Recorded]:
    """Record the first ``limit`` QPs of a motion, or all of them if there are fewer."""
    scene = body(seed=seed, device="cpu")
    settings = LocomotionSettings(qp_solver=QpSolver.OSQP)
    creature = make_creature(scene.cloud, plane=scene.plane, options=CreatureOptions(nodes=nodes, settings=settings))
    with recording(f"{body.__name__} {text}", limit) as programs:
        simulate(creature, motion(text))
    return programs


def relative_difference(one: Recorded, x: np.ndarray, other: np.ndarray) -> float:
    """Return the relative difference of two solutions: of x, or of objective and A x if x is not unique."""
    if not one.flat:
        return _apart(x, other)
    values = [np.array([0.5 * at @ one.program.P @ at + one.program.q @ at]) for at in (x, other)]
    return max(_apart(*values), _apart(one.program.A @ x, one.program.A @ other))


def _apart(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.abs(first - second).max() / max(float(np.abs(second).max()), 1e-12))


def on_rows_that_matter(one: Recorded) -> Recorded:
    """Return the program with only the rows that the unconstrained minimum violates, or with all if there are none."""
    free = WhitenedQp.of(one.program.P, one.program.q, one.program.A).values_at_minimum
    broken = (free < one.lower) | (free > one.upper)
    index = np.flatnonzero(broken) if broken.any() else np.arange(len(free))
    program = DenseQp(one.program.P, one.program.q, one.program.A[index])
    return Recorded(one.motion, program, one.lower[index], one.upper[index], one.start, one.skip_splitting)


def iterated(
    programs: Sequence[Recorded], splitting_of: Callable[[DenseQp], OperatorSplitting], limit: int
) -> tuple[list[AdmmResult], float]:
    """Solve the programs one after another; return the results and the median of the milliseconds with set-up."""
    ends, times = [], []
    for one in programs:
        end, milliseconds = timed(
            lambda one=one: (
                splitting_of(one.program).full_run(one.program.A, limit).run(one.lower, one.upper, one.start)
            )
        )
        ends.append(end)
        times.append(milliseconds)
    return ends, float(np.median(times))


def together(
    programs: Sequence[Recorded], device: str, *, accuracy: float, limit: int
) -> tuple[list[AdmmResult], float]:
    """Solve all programs at once; return the results and the milliseconds per program."""

    def solve() -> list[AdmmResult]:
        return AdmmPrograms([one.program for one in programs], device=device).solve(
            [one.lower for one in programs],
            [one.upper for one in programs],
            [one.start for one in programs],
            accuracy=accuracy,
            iterations=limit,
        )

    ends, milliseconds = timed(solve)
    return ends, milliseconds / len(programs)


def compared(
    programs: Sequence[Recorded], device: str, *, accuracy: float, limit: int
) -> tuple[Row, list[AdmmResult], list[AdmmResult]]:
    """Run both solvers; return their milliseconds, OSQP's results and the kernels' results."""

    def osqp(program: DenseQp) -> OperatorSplitting:
        return OsqpSplitting(program.P, program.q, accuracy=accuracy)

    def kernels(program: DenseQp) -> OperatorSplitting:
        return AdmmSplitting(program.P, program.q, accuracy=accuracy, device=device)

    osqp_results, osqp_ms = iterated(programs, osqp, limit)
    iterated(programs[:1], kernels, 1)  # compiles
    _, alone_ms = iterated(programs[:: max(1, len(programs) // 100)], kernels, limit)
    kernel_results, together_ms = together(programs, device, accuracy=accuracy, limit=limit)
    row = {
        "osqp_ms": osqp_ms,
        "alone_ms": alone_ms,
        "together_ms": together_ms,
        "osqp_iterations": float(np.mean([end.iterations for end in osqp_results])),
        "iterations": float(np.mean([end.iterations for end in kernel_results])),
        "same_iterations": sum(
            one.iterations == other.iterations for one, other in zip(osqp_results, kernel_results, strict=True)
        ),
    }
    return row, osqp_results, kernel_results


def full(programs: Sequence[Recorded], device: str) -> list[Row]:
    """Return a row for each motion and one for all: how often both solvers end with the same status, and how far their
    solutions differ."""
    times, osqp_results, kernel_results = compared(programs, device, accuracy=FULL_ACCURACY, limit=MAX_ITERATIONS)
    differences = [
        relative_difference(one, b.x, a.x) if a.status is b.status is AdmmStatus.SOLVED else None
        for one, a, b in zip(programs, osqp_results, kernel_results, strict=True)
    ]
    rows = []
    for name in ["all", *dict.fromkeys(one.motion for one in programs)]:
        of = [i for i, one in enumerate(programs) if name in ("all", one.motion)]
        apart = [value for i in of if (value := differences[i]) is not None]
        unlike = [
            f"{i}: {osqp_results[i].status.name} {kernel_results[i].status.name}"
            for i in of
            if osqp_results[i].status != kernel_results[i].status
        ]
        rows.append(
            {
                **{"kind": "full", "motion": name, "programs": len(of), "solved": len(apart)},
                **{"flat": sum(programs[i].flat for i in of), "unlike": unlike},
                **{"worst": max(apart, default=0.0), "median": float(np.median(apart)) if apart else 0.0},
                **(times if name == "all" else {}),
            }
        )
    return rows


def few(programs: Sequence[Recorded], device: str) -> Row:
    """Return the row of the first programs of steps under few iterations."""
    first = [on_rows_that_matter(one) for one in programs if not one.skip_splitting]
    times, osqp_results, kernel_results = compared(first, device, accuracy=FEW_ACCURACY, limit=FEW_ITERATIONS)
    ends = list(enumerate(zip(osqp_results, kernel_results, strict=True)))
    # After a certificate of infeasibility x is not a solution.
    points = (AdmmStatus.SOLVED, AdmmStatus.INEXACT, AdmmStatus.LIMIT)
    apart = [_apart(b.x, a.x) for _, (a, b) in ends if a.status in points and b.status in points]
    return {
        **{"kind": "few", "motion": "all", "programs": len(first)},
        "unlike": [f"{i}: {a.status.name} {b.status.name}" for i, (a, b) in ends if a.status is not b.status],
        **{"worst": max(apart), "median": float(np.median(apart)), **times},
    }


def whole(programs: Sequence[Recorded], device: str) -> Row:
    """Return the row of all programs, solved as the engine solves them."""

    def solved(solver: QpSolver) -> tuple[list[QpSolution], float]:
        ends, times = [], []
        for one in programs:

            def solve(one: Recorded = one) -> QpSolution:
                program: QuadraticProgram = quadratic_program(
                    one.program.P, one.program.q, one.program.A, solver=solver, device=device
                )
                return program.solve(one.lower, one.upper, one.start, skip_splitting=one.skip_splitting)

            end, milliseconds = timed(solve)
            ends.append(end)
            times.append(milliseconds)
        return ends, float(np.median(times))

    osqp_results, osqp_ms = solved(QpSolver.OSQP)
    kernel_results, alone_ms = solved(QpSolver.ADMM)
    apart = [
        relative_difference(one, b.x, a.x)
        for one, a, b in zip(programs, osqp_results, kernel_results, strict=True)
        if a.usable and b.usable
    ]
    unlike = [
        f"{i}: {a.status.name} {b.status.name}"
        for i, (a, b) in enumerate(zip(osqp_results, kernel_results, strict=True))
        if a.status is not b.status
    ]
    return {
        **{"kind": "whole", "motion": "all", "programs": len(programs), "solved": len(apart), "unlike": unlike},
        **{"worst": max(apart), "median": float(np.median(apart)), "osqp_ms": osqp_ms, "alone_ms": alone_ms},
    }


def aims(rows: Sequence[Row], device: str) -> tuple[dict[str, bool | None], dict[str, str]]:
    """Return the aims from the row of ``full``, and the reasons of null ones."""
    everything = next(row for row in rows if row["kind"] == "full" and row["motion"] == "all")
    equal = not everything["unlike"] and everything["worst"] <= MAX_DIFFERENCE
    measured, other = ("cpu_equal", "gpu_equal") if device == "cpu" else ("gpu_equal", "cpu_equal")
    values: dict[str, bool | None] = {measured: equal, other: None, "thousand": everything["programs"] >= 1000}
    return values, {other: f"the kernels ran on {device}"}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="96 programs in place of 1,000")
    parser.add_argument("--programs", type=int, help="number of programs to record (default 1,000)")
    options = parser.parse_args(arguments)
    count = options.programs or (96 if options.quick else 1000)
    programs: list[Recorded] = []
    for i, (body, nodes, text) in enumerate(MOTIONS):
        # If one motion has too few programs, the next ones make up for it.
        share = -(-(count - len(programs)) // (len(MOTIONS) - i))
        programs += recorded(body, nodes, text, limit=share, seed=options.seed)
        print(f"{body.__name__} {text}: {len(programs)} programs so far", flush=True)
    rows = [*full(programs, options.device), few(programs, options.device), whole(programs, options.device)]
    table = Table(
        **{"kind": "<6s", "motion": "<14s", "programs": "d", "unlike": "d", "worst": ".1e"},
        **{"osqp_ms": "8.3f", "alone_ms": "8.3f", "together_ms": "8.4f", "osqp_iterations": "8.1f"},
        iterations="8.1f",
    )
    for row in rows:
        times = [row.get(name) for name in ("osqp_ms", "alone_ms", "together_ms", "osqp_iterations", "iterations")]
        table.row(row["kind"], row["motion"], row["programs"], len(row["unlike"]), row["worst"], *times)
    values, why = aims(rows, options.device)
    report(
        options,
        rows,
        aims=values,
        why_null=why,
        packages=["osqp"],
        conditions={
            "variables": float(np.mean([len(one.program.q) for one in programs])),
            "rows": float(np.mean([len(one.lower) for one in programs])),
        },
        draw=lambda figure: draw(figure, rows),
    )


def draw(figure: Figure, rows: list[Row]) -> None:
    """Draw milliseconds per program, by kind."""
    axes = figure.subplots()
    kinds = [row for row in rows if "osqp_ms" in row]
    for offset, name, label in (
        (-0.25, "osqp_ms", "OSQP"),
        (0.0, "alone_ms", "kernels, alone"),
        (0.25, "together_ms", "kernels, together"),
    ):
        shown = [(i + offset, row[name]) for i, row in enumerate(kinds) if name in row]
        axes.bar([at for at, _ in shown], [value for _, value in shown], width=0.25, label=label)
    axes.set_yscale("log")
    axes.set_xticks(range(len(kinds)), [row["kind"] for row in kinds])
    axes.set_ylabel("milliseconds of a program")
    axes.legend(fontsize=8)


if __name__ == "__main__":
    main()
