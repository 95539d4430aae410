"""Steps per second of `simulate_many`, as a function of the number of processes.

python benchmarks/process_scaling.py [--quick] [--workers N ...] [--nodes N ...] [--frames N] [--jobs N] [--device cpu]
    [--json PATH] [--plot PATH]

Each of the ``--workers`` processes simulates the first ``--frames`` frames of ``--jobs`` standing jumps of the pawn,
each with a different distance. The rate is measured over the middle 70 % of all frames, when all workers have started
and none has run out of jobs; the time for loading the workers is reported separately. Each process has one thread. A
process is slower if the cores share memory bandwidth or reduce their clock rate when all are busy.

This benchmark has no aim; ``many_worlds.py`` measures parallel worlds on a GPU.
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

REQUESTED_NODES = (175, 500)
"""Values of ``--nodes`` that give the pawn cages of about 250 and 541 nodes."""
FIRST, LAST = 0.15, 0.85
"""Fractions of all frames between which the rate is measured."""


def measure(creature: Creature, workers: int, *, jobs: int, frames: int) -> Row:
    """Measure the rate of ``workers`` processes that run ``jobs`` jobs each."""
    job_list = [
        Job(motion(f"jump {distance:.3f}"), frames=frames) for distance in np.linspace(0.2, 0.8, jobs * workers)
    ]
    samples: list[tuple[float, int]] = [(0.0, 0)]
    started = time.perf_counter()

    def note_progress(done: int, _: int) -> None:
        samples.append((time.perf_counter() - started, done))

    outcomes = simulate_many(creature, job_list, workers=workers, progress=note_progress)
    whole = time.perf_counter() - started
    if wrong := next((one.error for one in outcomes if one.error is not None), None):
        raise RuntimeError(wrong)
    steps = sum(len(one.trajectory.dt) for one in outcomes)
    (first, early), (last, late) = window(samples)
    return {
        "nodes": len(creature.body.mesh.nodes),
        "workers": workers,
        "jobs": len(job_list),
        "steps": steps,
        "rate": steps * (late - early) / samples[-1][1] / (last - first),
        "loading": samples[1][0],
        "seconds": whole,
    }


def window(samples: Sequence[tuple[float, int]]) -> tuple[tuple[float, int], tuple[float, int]]:
    """Return the first and last of ``samples`` (seconds, frames done) between ``FIRST`` and ``LAST`` of all frames."""
    inside = [one for one in samples if FIRST * samples[-1][1] <= one[1] <= LAST * samples[-1][1]]
    return inside[0], inside[-1]


def main(arguments: Sequence[str] | None = None) -> None:
    """Time each number of workers for each cage."""
    parser = flags(__doc__, quick="250 nodes, 12 frames, 2 jobs", device="cpu", seed="of the pawn's Gaussians")
    cores = available_threads()
    powers = [2**power for power in range(cores.bit_length()) if 2**power < cores]
    parser.add_argument(
        "--workers", type=int, nargs="*", default=[*powers, cores], help="numbers of processes, one for each row"
    )
    parser.add_argument(
        "--nodes", type=int, nargs="*", default=list(REQUESTED_NODES), help="requested number of nodes of each cage"
    )
    parser.add_argument("--frames", type=int, default=60, help="frames of each jump (default 60)")
    parser.add_argument("--jobs", type=int, default=3, help="jobs of each worker (default 3)")
    options = parser.parse_args(arguments)
    if options.quick:
        options.nodes, options.frames, options.jobs = options.nodes[:1], 12, 2
    rows: list[Row] = []
    table = Table(nodes="d", workers="d", steps="d", steps_a_second=".1f", of_first=".2f", loading=".1f", seconds=".0f")
    scene = pawn(seed=options.seed, device=options.device)
    for nodes in options.nodes:
        creature = make_creature(scene.cloud, plane=scene.plane, options=CreatureOptions(nodes=nodes))
        # Compile the kernels once here, not in every worker.
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
    """Draw steps per second against the number of processes, with one curve per number of nodes."""
    axes = figure.subplots()
    for nodes in dict.fromkeys(row["nodes"] for row in rows):
        chosen = [row for row in rows if row["nodes"] == nodes]
        axes.plot([row["workers"] for row in chosen], [row["rate"] for row in chosen], "o-", label=f"{nodes} nodes")
    axes.set(xlabel="processes", ylabel="steps a second", ylim=(0.0, None))
    axes.legend()


if __name__ == "__main__":
    main()
