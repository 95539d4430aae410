"""OSQP and DAQP on the engine's quadratic programs, as a function of the number of contacts.

python benchmarks/qp_solvers.py [--quick] [--device cpu] [--seed 0] [--body pawn] [--json PATH] [--plot PATH]

The programs are steps of an animation (Eq. 13) with 40 muscle groups, 4 friction directions and 1 to 32 contacts.
``first`` is the time to set up and solve the program for one choice of contact states. ``again`` is the time to solve
it for other states, which changes only bounds. ``search`` is the time of the engine's complete search over contact
modes in a step, with activations as the only unknowns. All solvers solve the same programs in turn. ``breach`` is the
largest violation of a bound (forces in body weights, velocities in sqrt(g H)); ``objective`` is relative to DAQP's.
This benchmark has no aim.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from contact_frames import Frame, animation_frames, body_named
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.solvers import QpSolution, QpSolver, quadratic_program
from egs_warp.locomotion.strategies import Strategy, search_program
from harness import Row, Table, flags, report, timed

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.contact_states.complementarity import SEPARATE, states_of_pairs
from benchmarks.contact_states.pyramid_program import PyramidProgram
from benchmarks.contact_states.state_search import contact_response

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONTACTS = (1, 2, 4, 8, 16, 32)
GROUPS = 40
DIRECTIONS = 4
QP_LIMIT = LocomotionSettings.qp_limit
SOLVERS = QpSolver.OSQP, QpSolver.DAQP


def frame_figures(frame: Frame, solver: QpSolver) -> Row:
    """Return times, QP count, objective, violation and number of failures of the solver for one program."""
    program = PyramidProgram.of(frame.program, DIRECTIONS)
    y = contact_response(program, frame.predicted.activations)
    separate = np.full(program.layout.contacts, SEPARATE)
    states = separate if y is None else states_of_pairs(program.layout, *program.pairs(y))
    other = contact_response(program, frame.known)
    changed = separate if other is None else states_of_pairs(program.layout, *program.pairs(other))

    def first() -> tuple[Any, QpSolution]:
        qp = quadratic_program(program.P, program.q, program.A, solver=solver)
        return qp, qp.solve(*program.bounds(states))

    (qp, solution), first_time = timed(first)
    resolved, again_time = timed(qp.solve, *program.bounds(changed))
    searched, search_time = timed(
        search_program,
        frame.program,
        Strategy.MODES,
        frame.predicted,
        directions=DIRECTIONS,
        qp_limit=QP_LIMIT,
        solver=solver,
    )
    breach = 0.0
    for result, chosen in ((solution, states), (resolved, changed)):
        if result.usable:
            lower, upper = program.bounds(chosen)
            rows = program.A @ result.x
            breach = max(breach, float((lower - rows).max()), float((rows - upper).max()))
    return {
        "first": first_time,
        "again": again_time,
        "search": search_time,
        "breach": breach,
        "failed": int(not solution.usable) + int(not resolved.usable),
        "objective": searched.objective,
        "qps": searched.qp_count,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="10 frames per number of contacts instead of 40", device="cpu")
    parser.add_argument("--body", default="pawn")
    options = parser.parse_args(arguments)
    bench = body_named(options.body, options.device)
    frames = 10 if options.quick else 40
    rows = []
    table = Table(
        contacts="d",
        variables="d",
        solver="4s",
        first_ms="8.2f",
        again_ms="8.2f",
        search_ms="8.2f",
        QPs="5.2f",
        breach=".1e",
        objective=".4f",
        failed="d",
    )
    for contacts in CONTACTS:
        frames_of_body = animation_frames(
            bench,
            frames=frames + 4,
            activations=GROUPS,
            contacts=contacts,
            strength=0.2,
            seed=options.seed,
        )[4:]
        figures: dict[QpSolver, list[Row]] = {solver: [] for solver in SOLVERS}
        for frame in frames_of_body:
            for solver in SOLVERS:
                figures[solver].append(frame_figures(frame, solver))
        reference = np.array([row["objective"] for row in figures[QpSolver.DAQP]])
        for solver, measured in figures.items():
            column = {name: np.array([row[name] for row in measured]) for name in measured[0]}
            row = {
                "contacts": contacts,
                "variables": PyramidProgram.of(frames_of_body[0].program, DIRECTIONS).layout.variables,
                "solver": solver.value,
                **{name: float(np.median(column[name])) for name in ("first", "again", "search")},
                "qps": float(column["qps"].mean()),
                "breach": float(column["breach"].max()),
                "objective": float(np.median((column["objective"] + 1e-12) / (reference + 1e-12))),
                "failed": int(column["failed"].sum()),
            }
            rows.append(row)
            table.row(*row.values())
    report(
        options,
        rows,
        aims={},
        packages=["daqp"],
        conditions={"body": options.body, "frames": frames},
        draw=lambda figure: draw(figure, rows),
        size=(9.0, 3.6),
    )


def draw(figure: Figure, rows: list[Row]) -> None:
    """Draw the milliseconds and the largest violation of a bound against the number of contacts."""
    left, right = figure.subplots(1, 2)
    for solver, colour in zip(SOLVERS, ("tab:orange", "tab:blue"), strict=True):
        own = [row for row in rows if row["solver"] == solver.value]
        contacts = [row["contacts"] for row in own]
        left.plot(contacts, [row["again"] for row in own], "o-", color=colour, label=f"{solver.value}, re-solve")
        left.plot(contacts, [row["search"] for row in own], "s--", color=colour, label=f"{solver.value}, whole search")
        right.plot(contacts, [max(row["breach"], 1e-17) for row in own], "o-", color=colour, label=solver.value)
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        axes.set_xticks(CONTACTS, [str(count) for count in CONTACTS])
        axes.set_xlabel("contacts")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    left.set_ylabel("milliseconds, median")
    right.set_ylabel("worst violation of a bound")


if __name__ == "__main__":
    main()
