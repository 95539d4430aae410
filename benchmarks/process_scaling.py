"""How many steps of a creature a second `simulate_many` makes, over the number of processes.

python benchmarks/process_scaling.py [--quick] [--workers N ...] [--nodes N ...] [--frames N] [--jobs N] [--device cpu]
    [--json PATH] [--plot PATH]

Each of so many ``--workers`` does ``--jobs`` standing jumps of the pawn, each of another distance, of each the first
``--frames``. The rate is that of the middle 70 % of all frames: all workers have begun by then, and none has run out of
jobs; what they take to load is told apart. Each process has one thread, so a machine gives less to each where its cores
share memory or clock.

It judges no aim: worlds side by side on a GPU are ``many_worlds.py``'s.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.assets import pawn
from egs_warp.launching import available_threads
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from egs_warp.pipelines.job import Job
from egs_warp.pipelines.many import simulate_many
from harness import Row, Table, flags, record, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ASKED = (175, 500)
"""--nodes that give the pawn cages of about 250 and 541."""
FIRST, LAST = 0.15, 0.85
"""Of all frames, between which the rate is taken."""


def measure(creature: Creature, workers: int, *, jobs: int, frames: int) -> Row:
    """The rate of so many ``workers``, each with so many ``jobs``."""
    asked = [Job(motion(f"jump {distance:.3f}"), frames=frames) for distance in np.linspace(0.2, 0.8, jobs * workers)]
    seen: list[tuple[float, int]] = [(0.0, 0)]
    begun = time.perf_counter()

    def told(done: int, _: int) -> None:
        seen.append((time.perf_counter() - begun, done))

    outcomes = simulate_many(creature, asked, workers=workers, progress=told)
    whole = time.perf_counter() - begun
    if wrong := next((one.error for one in outcomes if one.error is not None), None):
        raise RuntimeError(wrong)
    steps = sum(len(one.trajectory.dt) for one in outcomes)
    (first, early), (last, late) = window(seen)
    return {
        "nodes": len(creature.body.mesh.nodes),
        "workers": workers,
        "jobs": len(asked),
        "steps": steps,
        "rate": steps * (late - early) / seen[-1][1] / (last - first),
        "loading": seen[1][0],
        "seconds": whole,
    }


def window(seen: Sequence[tuple[float, int]]) -> tuple[tuple[float, int], tuple[float, int]]:
    """The first and the last of ``seen``, seconds and frames done, between ``FIRST`` and ``LAST`` of all frames."""
    inside = [one for one in seen if FIRST * seen[-1][1] <= one[1] <= LAST * seen[-1][1]]
    return inside[0], inside[-1]


def main(arguments: Sequence[str] | None = None) -> None:
    """Time each number of workers for each cage."""
    parser = flags(__doc__, quick="250 nodes, 12 frames, 2 jobs", device="cpu", seed="of the pawn's Gaussians")
    cores = available_threads()
    powers = [2**power for power in range(cores.bit_length()) if 2**power < cores]
    parser.add_argument("--workers", type=int, nargs="*", default=[*powers, cores], help="processes, of each row")
    parser.add_argument("--nodes", type=int, nargs="*", default=list(ASKED), help="asked for, of each cage")
    parser.add_argument("--frames", type=int, default=60, help="of each jump (60)")
    parser.add_argument("--jobs", type=int, default=3, help="of each worker (3)")
    options = parser.parse_args(arguments)
    if options.quick:
        options.nodes, options.frames, options.jobs = options.nodes[:1], 12, 2
    rows: list[Row] = []
    table = Table(nodes="d", workers="d", steps="d", steps_a_second=".1f", of_first=".2f", loading=".1f", seconds=".0f")
    made = pawn(seed=options.seed, device=options.device)
    for nodes in options.nodes:
        creature = make_creature(made.cloud, plane=made.plane, options=CreatureOptions(nodes=nodes))
        # Kernels compile once, here, not in every worker.
        Job(motion("jump"), frames=3).run(creature)
        first = len(rows)
        for workers in options.workers:
            rows.append(row := measure(creature, workers, jobs=options.jobs, frames=options.frames))
            row["of_first"] = row["rate"] / rows[first]["rate"]
            figures = [row[name] for name in ("nodes", "workers", "steps", "rate", "of_first", "loading", "seconds")]
            table.row(*figures)
            record(options, rows, aims={})
    report(options, rows, aims={}, draw=lambda figure: draw(figure, rows))


def draw(figure: Figure, rows: list[Row]) -> None:
    """Steps a second over processes, by nodes."""
    axes = figure.subplots()
    for nodes in dict.fromkeys(row["nodes"] for row in rows):
        chosen = [row for row in rows if row["nodes"] == nodes]
        axes.plot([row["workers"] for row in chosen], [row["rate"] for row in chosen], "o-", label=f"{nodes} nodes")
    axes.set(xlabel="processes", ylabel="steps a second", ylim=(0.0, None))
    axes.legend()


if __name__ == "__main__":
    main()
