"""Table 2: number of quadratic programs and objective for every search over contact states, frame by frame.

python benchmarks/table2.py [--quick] [--device cpu] [--seed 0] [--solver daqp] [--bodies pawn stool monkey]
    [--json PATH] [--plot PATH]

The paper's protocol: 50 frames animated with known activations, 10 muscle groups and 5 contacts with 8 friction
directions, which gives 60 variables and 50 complementarity pairs per frame. Each frame is one program (Eq. 13) whose
target is the animation's own motion; every strategy gets the same programs. A second table has smaller problems of the
same bodies, and random problems, whose results are compared with the optimum over all contact states (branch and
bound).

``modes``, the engine's default, uses the exact friction cone. All others, including ``exact``, use the pyramid, so
``modes`` may be better than ``exact``. ``modes`` and ``paper`` have activations as their only unknowns. ``objective``
is the program's objective at the activations and forces that a strategy returns. ``true`` is the same objective with
the forces of exact contact under these activations, which a step then computes. ``paper`` is the paper's strategy: the
states of stage 1 (Eq. 12), then changes of one contact at a time. ``qpcc`` starts from all-static and changes one
contact at a time by the contact's own multipliers; if all-static has no solution, it starts from the states that follow
from the last activations. ``qpcc-our-moves`` differs from ``qpcc`` only in the rules by which contacts are changed, so
that the effects of the rules and of the start can be separated.

The ratios of ``exact`` to ``qpcc`` are also reported; they bound the possible gain. Aims, over all frames together:
``qps_vs_qpcc`` (``modes`` takes at most 0.37 of qpcc's QPs) and ``objective_vs_qpcc`` (its mean objective is at most
0.64 of qpcc's): the paper's own ratios.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from contact_frames import CAPTURES, BenchBody, Frame, animation_frames, body_named
from harness import Row, Table, data_folder, flags, report, timed

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.contact_states.state_search import StateSearch, search_pyramid
from egs_warp.contact.coulomb import coulomb_forces
from egs_warp.locomotion.contact_modes import CoulombProgram, PredictedContact
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import Strategy, search_program
from tests.support.contact_programs import small_problem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER_QPS, PAPER_OBJECTIVE = 17.01 / 46.19, 0.83 / 1.29
"""Ratios of the paper's strategy to QPCC in the paper's Table 2, for the number of QPs and for the objective."""
QP_LIMIT = 1000
Search: TypeAlias = Strategy | StateSearch
SEARCHES: tuple[Search, ...] = (*Strategy, *StateSearch)
"""Strategies of the engine, and the searches that they are compared with."""


def solve_all(frames: list[Frame], solver: QpSolver, directions: int) -> dict[Search, np.ndarray]:
    """Return (frames, 4) for each search: QPs, objective, true objective, milliseconds."""
    options: dict[str, Any] = {"directions": directions, "qp_limit": QP_LIMIT, "solver": solver}
    results = {}
    for kind in SEARCHES:
        figures = []
        for frame in frames:
            if isinstance(kind, Strategy):
                search, milliseconds = timed(search_program, frame.program, kind, frame.predicted, **options)
            else:
                search, milliseconds = timed(search_pyramid, frame.program, kind, frame.predicted, **options)
            x = search.x
            objectives = (
                (np.inf, np.inf)
                if x is None
                else [frame.program.objective(y) for y in (x, with_exact_forces(frame, x))]
            )
            figures.append((search.qp_count, *objectives, milliseconds))
        results[kind] = np.array(figures)
    return results


def with_exact_forces(frame: Frame, x: np.ndarray) -> np.ndarray:
    """Return (m + 3n,): the activations of ``x`` (m + 3n,) and the forces of exact contact under these activations."""
    program = frame.program
    activations, forces = np.split(x, [program.activation_count])
    return np.concatenate([activations, contact_forces(program, activations, forces).ravel()])


def contact_forces(program: CoulombProgram, activations: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the contact forces (n, 3), in body weights, that satisfy the contact laws under ``activations`` (m,)."""
    m, n = program.activation_count, program.contact_count
    free = program.rows[:, :m] @ activations + program.offset
    delassus = program.rows[:, m:].copy()
    delassus[np.diag_indices_from(delassus)] += 1e-7 * delassus.diagonal().mean()
    forces, _ = coulomb_forces(delassus, free, np.zeros(n), program.friction, start.reshape(n, 3))
    return forces


def lively_frames(bench: BenchBody, strength: float, **options: Any) -> tuple[list[Frame], float]:
    """Animate the body, halving ``strength`` until every step converges; return the frames and the strength."""
    while True:
        try:
            return animation_frames(bench, strength=strength, **options), strength
        except RuntimeError:
            strength *= 0.5


def table_rows(table: str, body: str, results: dict[Search, np.ndarray], **more: Any) -> list[Row]:
    """Return one row for each strategy."""
    best = results[StateSearch.EXACT][:, 1]
    rows = []
    for strategy, figures in results.items():
        qps, objective, true, milliseconds = figures.T
        ratio = (objective + 1e-12) / (best + 1e-12)
        rows.append(
            {
                "table": table,
                "body": body,
                "strategy": strategy.value,
                "frames": len(figures),
                "qps": {"average": float(qps.mean()), "best": int(qps.min()), "worst": int(qps.max())},
                "objective": {
                    "average": float(objective.mean()),
                    "best": float(objective.min()),
                    "worst": float(objective.max()),
                },
                "true_objective": float(true.mean()),
                "milliseconds": float(np.median(milliseconds)),
                "over_exact": {
                    "mean": float(ratio.mean()),
                    "median": float(np.median(ratio)),
                    "ninetieth": float(np.quantile(ratio, 0.9)),
                },
                "within_two_percent": float((ratio <= 1.02).mean()),
                **more,
            }
        )
    return rows


def print_rows(rows: list[Row]) -> None:
    """Print QPs and objectives (mean, best, worst), milliseconds, and the ratio of the objective to the optimum."""
    table = Table(
        **{"body": "<12", "strategy": "<14", "frames": "d"},
        **{"QPs_avg": ".2f", "QPs_best": "d", "QPs_worst": "d"},
        **{"objective": "10.3e", "its_best": "8.1e", "its_worst": "8.1e", "true": "9.3e"},
        **{"ms": "6.1f", "median/exact": ".3f", "within_2_%": ".0%"},
    )
    for row in rows:
        table.row(
            *(row["body"], row["strategy"], row["frames"]),
            *row["qps"].values(),
            *row["objective"].values(),
            *(row["true_objective"], row["milliseconds"], row["over_exact"]["median"], row["within_two_percent"]),
        )


def pooled(parts: list[dict[Search, np.ndarray]]) -> dict[Search, np.ndarray]:
    """Concatenate the frames of all parts, by strategy."""
    return {strategy: np.concatenate([part[strategy] for part in parts]) for strategy in SEARCHES}


def random_frames(count: int, seed: int) -> list[Frame]:
    """Return random programs with three contacts, whose optimum without complementarity is far from the true
    optimum."""
    frames = []
    for index in range(count):
        program = small_problem(1000 * seed + index, contacts=3).coulomb
        at_rest = np.zeros(program.activation_count)
        forces = contact_forces(program, at_rest, np.zeros((3, 3)))
        velocities = (program.rows[:, program.activation_count :] @ forces.ravel() + program.offset).reshape(-1, 3)
        frames.append(Frame(program, PredictedContact(at_rest, forces, velocities), at_rest))
    return frames


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="one animation per body instead of two", device="cpu")
    parser.add_argument("--solver", default="daqp", choices=[solver.value for solver in QpSolver])
    parser.add_argument("--bodies", nargs="+", default=["pawn", "stool", "monkey"])
    options = parser.parse_args(arguments)
    solver = QpSolver(options.solver)
    strengths = (0.2,) if options.quick else (0.2, 0.4)
    large: list[dict[Search, np.ndarray]] = []
    small: list[dict[Search, np.ndarray]] = []
    rows, skipped = [], []
    for name in options.bodies:
        if name in CAPTURES and not data_folder().is_dir():
            skipped.append(name)
            continue
        bench = body_named(name, options.device)
        for target_strength in strengths:
            frames, strength = lively_frames(bench, target_strength, seed=options.seed)
            large.append(solve_all(frames, solver, 8))
            body_rows = table_rows("frames", f"{name} {strength:g}", large[-1], strength=strength)
            rows += body_rows
            print_rows(body_rows)
        frames, strength = lively_frames(bench, strengths[0], activations=4, contacts=3, seed=options.seed + 1)
        small.append(solve_all(frames, solver, 4))
        rows += table_rows("small", f"{name} {strength:g}", small[-1], strength=strength)
    rows += table_rows("frames", "all", pooled(large))
    rows += table_rows("small", "all", pooled(small))
    rows += table_rows("random", "random", solve_all(random_frames(60, options.seed), solver, 4))
    print("\nFrames of 60 variables and 50 pairs, all bodies")
    print_rows([row for row in rows if row["table"] == "frames" and row["body"] == "all"])
    print("\nSmall problems (4 muscle groups, 3 contacts of 4 directions) and random ones against the exact optimum")
    print_rows([row for row in rows if row["table"] in ("small", "random")])
    total = pooled(large)
    qpcc, near = total[StateSearch.QPCC], pooled(small)
    ratios = {
        strategy: tuple(float(column) for column in (total[strategy].mean(axis=0) / qpcc.mean(axis=0))[:3])
        for strategy in (Strategy.MODES, Strategy.PAPER, StateSearch.EXACT)
    }
    within = {
        strategy: float((near[strategy][:, 1] <= 1.02 * near[StateSearch.EXACT][:, 1] + 1e-12).mean())
        for strategy in ratios
    }
    for strategy, (qps, objective, true) in ratios.items():
        print(
            f"\n{strategy.value} / qpcc: QPs {qps:.2f} (paper 0.37), objective {objective:.2f} (paper 0.64), true "
            f"objective {true:.2f}; {total[strategy][:, 0].mean():.2f} QPs a frame; within 2 % of exact in "
            f"{within[strategy]:.0%} of the small problems"
        )
    qps, objective, _ = ratios[Strategy.MODES]
    report(
        options,
        rows,
        ratios={
            strategy.value: dict(
                zip(("qps_vs_qpcc", "objective_vs_qpcc", "true_objective_vs_qpcc"), values, strict=True)
            )
            for strategy, values in ratios.items()
        },
        beyond={
            "qps_a_frame": float(total[Strategy.MODES][:, 0].mean()),
            "small_within_two_percent": within[Strategy.MODES],
        },
        skipped_bodies=skipped,
        aims={"qps_vs_qpcc": qps <= round(PAPER_QPS, 2), "objective_vs_qpcc": objective <= round(PAPER_OBJECTIVE, 2)},
        packages=["daqp"],
        conditions={"qp_solver": solver.value},
        draw=lambda figure: draw(figure, total, near),
        size=(13.0, 3.8),
    )


def draw(figure: Figure, total: dict[Search, np.ndarray], near: dict[Search, np.ndarray]) -> None:
    """Draw QPs per frame, and the cumulative distribution of the objective relative to the optimum."""
    left, *others = figure.subplots(1, 3)
    shown = [strategy for strategy in SEARCHES if strategy is not StateSearch.EXACT]
    palette = ("tab:blue", "tab:green", "tab:gray", "tab:orange", "tab:olive", "tab:purple")
    colours = dict(zip(shown, palette, strict=True))
    counts = [total[strategy][:, 0] for strategy in shown]
    boxes = left.boxplot(
        counts, orientation="horizontal", whis=(0, 100), showmeans=True, patch_artist=True, medianprops={"color": "k"}
    )
    for box, strategy in zip(boxes["boxes"], shown, strict=True):
        box.set_facecolor(colours[strategy])
    left.set_yticks(range(1, len(shown) + 1), [strategy.value for strategy in shown])
    left.set_xscale("log")
    left.set_xlabel("QPs a frame (triangle: mean)")
    for axes, results, title in zip(others, (total, near), ("60 variables, 50 pairs", "small problems"), strict=True):
        best = results[StateSearch.EXACT][:, 1] + 1e-12
        for strategy in shown:
            ratio = np.sort((results[strategy][:, 1] + 1e-12) / best)
            share = np.arange(1, len(ratio) + 1) / len(ratio)
            axes.step([*ratio, 1e9], [*share, 1.0], where="post", label=strategy.value, color=colours[strategy])
        axes.axvline(1.02, color="k", linewidth=0.6, linestyle=":")
        axes.set_xscale("log")
        axes.set_xlim(0.99, 30.0)
        axes.set_ylim(0.0, 1.02)
        axes.set_xlabel("objective / exact optimum")
        axes.set_title(title, fontsize=10)
    others[0].set_ylabel("share of frames")
    others[1].legend(loc="lower right", fontsize=8)


if __name__ == "__main__":
    main()
