"""OSQP's iterations as kernels, against OSQP itself, on recorded programs of motions.

python benchmarks/qp_kernels.py [--quick] [--device cuda:0] [--programs 1000] [--json PATH] [--plot PATH]

Built-in bodies with cages of about 250 nodes jump and walk (a snake crawls) on the CPU, solved by OSQP there; each QP
of their steps is recorded with its bounds, its start and whether it was one beside another. Then both solve all of
them: ``full`` by iterations alone, to 1e-12, at most 20,000; ``few`` as the first program of a step, 50 iterations on
the rows that matter; ``whole`` as the engine does (few iterations and the active set, or that alone). Milliseconds are
medians of a program, of OSQP with its set-up, of the kernels for one program (``alone``, every tenth), and a share of
all programs at once (``together``), both with the copies to and from the device.

|x - x'| is relative to the largest |x|. Where P is flat (its least eigenvalue below 1e-6 of the largest: optima that
need not obey contact) x is not unique: objective and A x, relative to their own size, are compared instead.

Aims: ``cpu_equal`` and ``gpu_equal``, for the device that is given: every program ends as OSQP ends on it, and |x - x'|
(or what stands for it) is at most 1e-6 wherever both solve it; ``thousand``: there were 1,000 programs.
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
"""Bodies, --nodes that give them cages of about 250, and what they do."""
FULL, MOST = 1e-12, 20000
"""Accuracy and iterations of ``full``."""
FEW, ROUGH = 50, 3e-5
"""Iterations and accuracy of ``few``: those of the engine."""
FLAT = 1e-6
EQUAL = 1e-6


@dataclass(frozen=True)
class Recorded:
    """A QP of a step."""

    motion: str
    program: DenseQp
    lower: np.ndarray
    upper: np.ndarray
    """(m,)."""
    start: np.ndarray | None
    """(n,)."""
    beside: bool

    @property
    def flat(self) -> bool:
        """Whether its optimum is not one point."""
        least, *_, largest = np.linalg.eigvalsh(self.program.P)
        return bool(least < FLAT * largest)


class _EnoughError(Exception):
    """As many are recorded as were wanted."""


@contextmanager
def recording(name: str, most: int) -> Iterator[list[Recorded]]:
    """While it lasts, the QPs of steps by pieces are kept in the list; it is left when there are ``most``."""
    made: list[Recorded] = []

    class Recorder:
        """A ``QuadraticProgram`` that is told of."""

        def __init__(self, P: np.ndarray, q: np.ndarray, A: np.ndarray, **options: Any) -> None:
            self._program, self._solver = DenseQp(P, q, A), quadratic_program(P, q, A, **options)

        def solve(
            self, lower: np.ndarray, upper: np.ndarray, start: np.ndarray | None = None, *, beside: bool = False
        ) -> QpSolution:
            """See ``QuadraticProgram``."""
            if len(made) == most:
                raise _EnoughError
            kept = None if start is None else start.copy()
            made.append(Recorded(name, self._program, lower.copy(), upper.copy(), kept, beside))
            return self._solver.solve(lower, upper, start, skip_splitting=beside)

    with patch.object(contact_modes, "quadratic_program", Recorder), suppress(_EnoughError):
        yield made


def recorded(body: Callable[..., Any], nodes: int, text: str, *, most: int, seed: int) -> list[Recorded]:
    """The first ``most`` QPs of a motion, or all of them."""
    made = body(seed=seed, device="cpu")
    settings = LocomotionSettings(qp_solver=QpSolver.OSQP)
    creature = make_creature(made.cloud, plane=made.plane, options=CreatureOptions(nodes=nodes, settings=settings))
    with recording(f"{body.__name__} {text}", most) as programs:
        simulate(creature, motion(text))
    return programs


def missed(one: Recorded, x: np.ndarray, other: np.ndarray) -> float:
    """By how much two solutions differ: in x, or where that is not unique in objective and A x; relative."""
    if not one.flat:
        return _apart(x, other)
    values = [np.array([0.5 * at @ one.program.P @ at + one.program.q @ at]) for at in (x, other)]
    return max(_apart(*values), _apart(one.program.A @ x, one.program.A @ other))


def _apart(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.abs(first - second).max() / max(float(np.abs(second).max()), 1e-12))


def on_rows_that_matter(one: Recorded) -> Recorded:
    """The program that its step's first iterations see: rows that the minimum without bounds breaks; all if it breaks
    none."""
    free = WhitenedQp.of(one.program.P, one.program.q, one.program.A).values_at_minimum
    broken = (free < one.lower) | (free > one.upper)
    index = np.flatnonzero(broken) if broken.any() else np.arange(len(free))
    program = DenseQp(one.program.P, one.program.q, one.program.A[index])
    return Recorded(one.motion, program, one.lower[index], one.upper[index], one.start, one.beside)


def iterated(
    programs: Sequence[Recorded], splitting_of: Callable[[DenseQp], OperatorSplitting], most: int
) -> tuple[list[AdmmResult], float]:
    """Where each ends, one after another, and the median of their milliseconds with their set-up."""
    ends, times = [], []
    for one in programs:
        end, milliseconds = timed(
            lambda one=one: splitting_of(one.program).full_run(one.program.A, most).run(one.lower, one.upper, one.start)
        )
        ends.append(end)
        times.append(milliseconds)
    return ends, float(np.median(times))


def together(
    programs: Sequence[Recorded], device: str, *, accuracy: float, most: int
) -> tuple[list[AdmmResult], float]:
    """Where each ends, all at once, and the milliseconds of one's share."""

    def solve() -> list[AdmmResult]:
        return AdmmPrograms([one.program for one in programs], device=device).solve(
            [one.lower for one in programs],
            [one.upper for one in programs],
            [one.start for one in programs],
            accuracy=accuracy,
            iterations=most,
        )

    ends, milliseconds = timed(solve)
    return ends, milliseconds / len(programs)


def compared(
    programs: Sequence[Recorded], device: str, *, accuracy: float, most: int
) -> tuple[Row, list[AdmmResult], list[AdmmResult]]:
    """Milliseconds of both, and where all have ended, OSQP's first."""

    def osqp(program: DenseQp) -> OperatorSplitting:
        return OsqpSplitting(program.P, program.q, accuracy=accuracy)

    def kernels(program: DenseQp) -> OperatorSplitting:
        return AdmmSplitting(program.P, program.q, accuracy=accuracy, device=device)

    asked, osqp_ms = iterated(programs, osqp, most)
    iterated(programs[:1], kernels, 1)  # compiles
    _, alone_ms = iterated(programs[:: max(1, len(programs) // 100)], kernels, most)
    made, together_ms = together(programs, device, accuracy=accuracy, most=most)
    row = {
        "osqp_ms": osqp_ms,
        "alone_ms": alone_ms,
        "together_ms": together_ms,
        "osqp_iterations": float(np.mean([end.iterations for end in asked])),
        "iterations": float(np.mean([end.iterations for end in made])),
        "as_many": sum(one.iterations == other.iterations for one, other in zip(asked, made, strict=True)),
    }
    return row, asked, made


def full(programs: Sequence[Recorded], device: str) -> list[Row]:
    """A row for each motion and one for all: how often both end alike, and how far their solutions are apart."""
    times, asked, made = compared(programs, device, accuracy=FULL, most=MOST)
    differences = [
        missed(one, b.x, a.x) if a.status is b.status is AdmmStatus.SOLVED else None
        for one, a, b in zip(programs, asked, made, strict=True)
    ]
    rows = []
    for name in ["all", *dict.fromkeys(one.motion for one in programs)]:
        of = [i for i, one in enumerate(programs) if name in ("all", one.motion)]
        apart = [value for i in of if (value := differences[i]) is not None]
        unlike = [f"{i}: {asked[i].status.name} {made[i].status.name}" for i in of if asked[i].status != made[i].status]
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
    """What the first programs of steps take of the iterations."""
    first = [on_rows_that_matter(one) for one in programs if not one.beside]
    times, asked, made = compared(first, device, accuracy=ROUGH, most=FEW)
    ends = list(enumerate(zip(asked, made, strict=True)))
    # What a certificate has ended is no point.
    points = (AdmmStatus.SOLVED, AdmmStatus.INEXACT, AdmmStatus.LIMIT)
    apart = [_apart(b.x, a.x) for _, (a, b) in ends if a.status in points and b.status in points]
    return {
        **{"kind": "few", "motion": "all", "programs": len(first)},
        "unlike": [f"{i}: {a.status.name} {b.status.name}" for i, (a, b) in ends if a.status is not b.status],
        **{"worst": max(apart), "median": float(np.median(apart)), **times},
    }


def whole(programs: Sequence[Recorded], device: str) -> Row:
    """Each program as the engine solves it."""

    def solved(solver: QpSolver) -> tuple[list[QpSolution], float]:
        ends, times = [], []
        for one in programs:

            def solve(one: Recorded = one) -> QpSolution:
                made: QuadraticProgram = quadratic_program(
                    one.program.P, one.program.q, one.program.A, solver=solver, device=device
                )
                return made.solve(one.lower, one.upper, one.start, skip_splitting=one.beside)

            end, milliseconds = timed(solve)
            ends.append(end)
            times.append(milliseconds)
        return ends, float(np.median(times))

    asked, osqp_ms = solved(QpSolver.OSQP)
    made, alone_ms = solved(QpSolver.ADMM)
    apart = [missed(one, b.x, a.x) for one, a, b in zip(programs, asked, made, strict=True) if a.usable and b.usable]
    unlike = [
        f"{i}: {a.status.name} {b.status.name}"
        for i, (a, b) in enumerate(zip(asked, made, strict=True))
        if a.status is not b.status
    ]
    return {
        **{"kind": "whole", "motion": "all", "programs": len(programs), "solved": len(apart), "unlike": unlike},
        **{"worst": max(apart), "median": float(np.median(apart)), "osqp_ms": osqp_ms, "alone_ms": alone_ms},
    }


def aims(rows: Sequence[Row], device: str) -> tuple[dict[str, bool | None], dict[str, str]]:
    """What the rows of ``full`` say, and why what they say nothing about is null."""
    everything = next(row for row in rows if row["kind"] == "full" and row["motion"] == "all")
    equal = not everything["unlike"] and everything["worst"] <= EQUAL
    here, there = ("cpu_equal", "gpu_equal") if device == "cpu" else ("gpu_equal", "cpu_equal")
    found: dict[str, bool | None] = {here: equal, there: None, "thousand": everything["programs"] >= 1000}
    return found, {there: f"the kernels ran on {device}"}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="96 programs in place of 1,000")
    parser.add_argument("--programs", type=int, help="to record (1,000)")
    options = parser.parse_args(arguments)
    count = options.programs or (96 if options.quick else 1000)
    programs: list[Recorded] = []
    for i, (body, nodes, text) in enumerate(MOTIONS):
        # What one motion has too few of, the next ones make up for.
        share = -(-(count - len(programs)) // (len(MOTIONS) - i))
        programs += recorded(body, nodes, text, most=share, seed=options.seed)
        print(f"{body.__name__} {text}: {len(programs)} programs by now", flush=True)
    rows = [*full(programs, options.device), few(programs, options.device), whole(programs, options.device)]
    table = Table(
        **{"kind": "<6s", "motion": "<14s", "programs": "d", "unlike": "d", "worst": ".1e"},
        **{"osqp_ms": "8.3f", "alone_ms": "8.3f", "together_ms": "8.4f", "osqp_iterations": "8.1f"},
        iterations="8.1f",
    )
    for row in rows:
        times = [row.get(name) for name in ("osqp_ms", "alone_ms", "together_ms", "osqp_iterations", "iterations")]
        table.row(row["kind"], row["motion"], row["programs"], len(row["unlike"]), row["worst"], *times)
    found, why = aims(rows, options.device)
    report(
        options,
        rows,
        aims=found,
        why_null=why,
        packages=["osqp"],
        conditions={
            "variables": float(np.mean([len(one.program.q) for one in programs])),
            "rows": float(np.mean([len(one.lower) for one in programs])),
        },
        draw=lambda figure: draw(figure, rows),
    )


def draw(figure: Figure, rows: list[Row]) -> None:
    """Milliseconds of a program, by kind."""
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
