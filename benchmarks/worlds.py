"""Time of a step of a world, as a function of the numbers of bodies and of contacts between them.

python benchmarks/worlds.py [--quick] [--bodies N ...] [--nodes N] [--frames N] [--json PATH] [--plot PATH]
python benchmarks/worlds.py --starts chess push [--runs N] [--workers N] [--json PATH]

Copies of the pawn jump together for ``--frames`` frames, in three arrangements: far apart, in a row in which neighbours
touch, and two of them far apart among 30 sleeping props. For each world, the median, mean and largest time of a step
are measured, its mean processor time, and the mean numbers of contacts with the ground and between bodies. Processor
time includes all threads, and depends less than the other times on what else the machine computes. The JSON report also
contains the mean time of each stage. The model t = c bodies^p is fitted to the first two arrangements.

Aims on a CPU: ``apart_cost`` (two bodies that never meet take at most 1.1 times as long as two runs of one body),
``cpu_two_realtime`` (a frame of two creatures with 250 nodes each takes at most 33 ms, even if they touch),
``sleeping_cost`` (two creatures among 30 sleeping props take at most 1.5 times as long as two alone).

With ``--starts``, the named examples are simulated from ``--runs`` random starts instead. Aims: ``chess`` (the
struck piece lies at the end of at least 18 of 20 runs), ``push`` (the box is up the ramp at the end of at least 16).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from egs_warp.assets import pawn
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.world_rollout import world_steps
from egs_warp.locomotion.world_stepper import WorldStepper
from egs_warp.pipelines.animate_world import displacement_text, report_of_body
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from egs_warp.pipelines.prop import Prop, make_prop
from egs_warp.pipelines.simulation import simulate
from egs_warp.pipelines.world import World
from egs_warp.pipelines.world_run import WorldRun
from harness import Row, Table, example, flags, report, rows_of, workers_flag

if TYPE_CHECKING:
    from matplotlib.figure import Figure

APART, TOUCHING, SLEEPING = "apart", "touching", "sleeping props"
APART_SPACING = 3.0
"""Spacing of creatures that never meet, m; they are 1 m tall."""
TOUCHING_SPACING = 0.005
"""Distance in metres between the bases of neighbours that touch when they jump."""
PROPS = 30
MIN_SUCCESS = {"chess": 18 / 20, "push": 16 / 20}
"""Minimum fraction of random starts from which an example succeeds."""
FRAMES = {"chess": 240, "push": 900}
"""Number of frames of each run from a random start."""
LYING_TILT = 60.0
"""Tilt in degrees above which a piece counts as lying."""
MAX_FRAME = 33.0
"""Maximum time of a frame for ``cpu_two_realtime``, ms."""


def make_world(creature: Creature, prop: Prop, arrangement: str, bodies: int) -> World:
    """Return a world of ``bodies`` creatures, among props in the arrangement ``SLEEPING``."""
    world, points = World(), creature.shape.contact_points
    low = points[points[:, 2] < 0.1]
    width = float(np.ptp(low[:, 1]))
    spacing = width + TOUCHING_SPACING if arrangement == TOUCHING else APART_SPACING
    for number in range(bodies):
        world.add(creature, at=(0.0, spacing * number), heading=0.0)
    for number in range(PROPS if arrangement == SLEEPING else 0):
        row, column = divmod(number, 6)
        world.add(prop, at=(3.0 + column, APART_SPACING * 0.5 * row))
    return world


def measure(world: World, arrangement: str, bodies: int, frames: int) -> Row:
    """Time the steps of ``frames`` frames in which all creatures jump."""
    dt, per_frame = world_steps([member.body.body for member in world.members])
    times: list[float] = []
    processor_times: list[float] = []
    stages: dict[str, float] = {}
    counts: list[tuple[int, int]] = []
    advance = WorldStepper.advance

    def timed(self: WorldStepper, *arguments: Any) -> list[list[StepReport]]:
        started, used = time.perf_counter(), time.process_time()
        done = advance(self, *arguments)
        times.append(1e3 * (time.perf_counter() - started))
        processor_times.append(1e3 * (time.process_time() - used))
        # The bodies of an island have the same record of times.
        records = {id(report.milliseconds): report.milliseconds for reports in done for report in reports}
        for name, spent in (pair for record in records.values() for pair in record.items()):
            stages[name] = stages.get(name, 0.0) + spent
        faces = np.concatenate([reports[-1].contacts.faces for reports in done])
        # Each contact between two bodies is in the reports of both.
        counts.append((int((faces >= 0).sum()), int((faces < 0).sum()) // 2))
        return done

    WorldStepper.advance = timed  # pyright: ignore[reportAttributeAccessIssue]
    try:
        motions = {member: "jump" for member in world.members if isinstance(member.body, Creature)}
        simulate(world, motions, frames=frames, get_up=False)
    finally:
        WorldStepper.advance = advance
    ground, between = np.mean(counts, axis=0)
    return {
        **{"arrangement": arrangement, "bodies": bodies, "nodes": len(world.members[0].body.mesh.nodes)},
        **{"dt": dt, "steps_in_frame": per_frame, "ground_contacts": float(ground), "pair_contacts": float(between)},
        **{"median_ms": float(np.median(times)), "mean_ms": float(np.mean(times)), "worst_ms": float(np.max(times))},
        **{"processor_ms": float(np.mean(processor_times))},
        **{"stages": {name: spent / len(times) for name, spent in stages.items()}},
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Time worlds in the three arrangements."""
    parser = flags(__doc__, quick="two bodies, 50 nodes, 6 frames", device="cpu", seed="of the pawn's Gaussians")
    parser.add_argument("--bodies", type=int, nargs="*", default=[1, 2, 4, 8, 16], help="numbers of creatures")
    parser.add_argument("--nodes", type=int, default=175, help="requested number of nodes of each cage (default 175)")
    parser.add_argument("--frames", type=int, default=45, help="frames of each world (default 45)")
    parser.add_argument("--starts", nargs="+", choices=tuple(MIN_SUCCESS), help="examples to run from random starts")
    workers_flag(parser)
    parser.add_argument("--runs", type=int, default=20, help="random starts of each example (default 20)")
    options = parser.parse_args(arguments)
    if options.starts:
        measure_starts(options)
        return
    if options.quick:
        options.bodies, options.nodes, options.frames = [1, 2], 50, 6
    scene = pawn(seed=options.seed, device=options.device)
    creature = make_creature(scene.cloud, plane=scene.plane, options=CreatureOptions(nodes=options.nodes))
    prop = make_prop(scene.cloud, plane=scene.plane)
    cases = [(APART, bodies) for bodies in options.bodies]
    cases += [(TOUCHING, bodies) for bodies in options.bodies if bodies > 1]
    cases += [] if options.quick or 2 not in options.bodies else [(SLEEPING, 2)]
    rows: list[Row] = []
    columns = {"median": ".1f", "mean": ".1f", "worst": ".1f", "processor": ".1f"}
    table = Table(arrangement="<14", bodies="d", nodes="d", ground=".1f", pairs=".1f", **columns)
    # The first world compiles and loads the kernels.
    measure(make_world(creature, prop, TOUCHING, 2), TOUCHING, 2, 4)
    for arrangement, bodies in cases:
        row = measure(make_world(creature, prop, arrangement, bodies), arrangement, bodies, options.frames)
        rows.append(row)
        names = ["arrangement", "bodies", "nodes", "ground_contacts", "pair_contacts"]
        table.row(*(row[name] for name in [*names, *(f"{column}_ms" for column in columns)]))
    exponents = {name: exponent(rows, name) for name in (APART, TOUCHING)}
    for name, value in exponents.items():
        print(f"{name}: " + ("too few worlds for a fit" if value is None else f"bodies^{value:.2f}"))
    report(options, rows, exponents=exponents, draw=lambda figure: draw(figure, rows), **summary(rows))


def measure_starts(options: argparse.Namespace) -> None:
    """Simulate examples from random starts and count the runs that succeed."""
    rows: list[Row] = []
    table = Table(example="<10", seed="d", success="<8", creature="<18", prop="<60", seconds=".1f")
    seeds = range(1, (2 if options.quick else options.runs) + 1)
    tasks = [(name, seed) for name in options.starts for seed in seeds]
    for row in rows_of(run_from_start, tasks, options.workers):
        rows.append(row)
        table.row(*row.values())
    aims: dict[str, bool | None] = {}
    for name in options.starts:
        chosen = [row for row in rows if row["example"] == name]
        count, fell = sum(row["success"] == "yes" for row in chosen), sum(row["creature"] == "fallen" for row in chosen)
        print(f"{name}: {count} of {len(chosen)} succeed; the creature falls in {fell}")
        aims[name] = count >= MIN_SUCCESS[name] * len(chosen)
    report(options, rows, aims=aims)


def run_from_start(name: str, seed: int) -> Row:
    """Simulate an example from the random start ``seed``."""
    started, module = time.process_time(), example(name)
    world, motions = module.start(seed)
    run = simulate(world, motions, frames=FRAMES[name], get_up=False)
    mover, prop = run.results
    row: Row = {"example": name, "seed": seed, "success": has_succeeded(module, run)}
    row |= {"creature": report_of_body(mover).state.value, "prop": displacement_text(prop)}
    row["seconds"] = time.process_time() - started
    return row


def has_succeeded(module: ModuleType, run: WorldRun) -> str:
    """Return "yes" if the struck piece of ``chess`` lies on the ground, or the box of ``push`` is up the ramp, else
    "no"."""
    prop = run.results[1]
    body, positions = prop.body.body, prop.simulation.trajectory.positions
    if hasattr(module, "UP_AT"):
        return "yes" if body.centre_of_mass(positions[-1])[0] > module.UP_AT else "no"
    turn = body.best_fit_rotation(positions[-1]) @ body.best_fit_rotation(positions[0]).T
    return "yes" if turn[2, 2] < np.cos(np.radians(LYING_TILT)) else "no"


def exponent(rows: list[Row], arrangement: str) -> float | None:
    """Return the exponent p of the mean time of a step, fitted to the worlds of an arrangement."""
    chosen = [row for row in rows if row["arrangement"] == arrangement]
    if len(chosen) < 2:
        return None
    logs = np.log([[row["bodies"], row["mean_ms"]] for row in chosen])
    return float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])


def summary(rows: list[Row]) -> dict[str, Any]:
    """Return the aims, and a reason for each aim that is None."""
    means = {(row["arrangement"], row["bodies"]): row["mean_ms"] for row in rows}
    frames = {key: row["mean_ms"] * row["steps_in_frame"] for key, row in zip(means, rows, strict=True)}
    aims: dict[str, bool | None] = {"apart_cost": None, "cpu_two_realtime": None, "sleeping_cost": None}
    why = dict.fromkeys(aims, "needs worlds of one and two bodies in all arrangements")
    if (APART, 1) in means and (APART, 2) in means:
        aims["apart_cost"] = means[APART, 2] <= 1.1 * 2.0 * means[APART, 1]
    if (TOUCHING, 2) in means and rows[0]["nodes"] >= 225:
        aims["cpu_two_realtime"] = max(frames[APART, 2], frames[TOUCHING, 2]) <= MAX_FRAME
    if (SLEEPING, 2) in means:
        # The median is not affected by the first steps, in which the props are not yet asleep.
        medians = {row["arrangement"]: row["median_ms"] for row in rows if row["bodies"] == 2}
        aims["sleeping_cost"] = medians[SLEEPING] <= 1.5 * medians[APART]
    return {"aims": aims, "why_null": {name: why[name] for name, value in aims.items() if value is None}}


def draw(figure: Figure, rows: list[Row]) -> None:
    """Draw the mean time of a step against the number of creatures."""
    axes = figure.subplots()
    for arrangement in (APART, TOUCHING, SLEEPING):
        chosen = [row for row in rows if row["arrangement"] == arrangement]
        axes.loglog([row["bodies"] for row in chosen], [row["mean_ms"] for row in chosen], "o-", label=arrangement)
    axes.set(xlabel="creatures", ylabel="mean time of a step, ms")
    axes.legend()


if __name__ == "__main__":
    main()
