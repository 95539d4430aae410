"""Steps per second of many parallel worlds on one device, as a function of the number of worlds.

python benchmarks/many_worlds.py [--quick] [--planned] [--worlds B ...] [--nodes N ...] [--steps N] [--alone N]
    [--panel N] [--chunk-bytes N] [--matrices B] [--device cuda:0] [--json PATH] [--plot PATH]

The pawn's jump is recorded once with each cage. Then each of the ``--worlds`` repeats the first ``--steps`` steps of
the jump with its own friction coefficient (0.4 to 1.2) and with the recorded activations times its own factor (0.7 to
1). ``LocomotionStepper`` also runs a number ``--alone`` of the worlds one by one; ``apart`` is the largest distance
between the positions of a node in the two runs, in body heights. Time by stage is measured over a few steps from the
middle, in which every stage synchronises the device.

With ``--planned``, each world plans a jump over its own distance (0.2 to 0.7 body heights) in a closed loop instead:
``MotionBatch`` computes the objectives of each step from the states at its start. The stage ``objectives`` is the time
of the motions and the transfers that they need; the rate without this stage is stored, too.

``--matrices B`` also measures, in ms, the factorisation of B dense matrices of the size of each cage, with panels of
several widths and with the Cholesky factorisation of PyTorch, and solutions for 1 and 96 right-hand sides.

Aims: ``many_planned`` (``--planned`` on one GPU, 2,500 steps per second with 250 nodes and 700 with 568),
``many_2000`` (on one GPU, 2,000 steps per second with 250 nodes and 600 with 568), ``many_alike`` (on any device,
runs at most 1e-9 body heights apart after 30 steps or more).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sparse
import torch

from egs_warp.assets import pawn
from egs_warp.fem.panel_cholesky import PanelCholesky
from egs_warp.locomotion.batch import BatchStepper
from egs_warp.locomotion.rollout import solver_steps
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport
from egs_warp.motions.motion_batch import MotionBatch
from egs_warp.motions.script import motion
from egs_warp.motions.sequence import MotionSequence
from egs_warp.pipelines.creature import Creature, CreatureOptions, initial_stance, make_creature
from egs_warp.pipelines.simulated_run import simulate
from harness import Row, Table, flags, record, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REQUESTED_NODES = (175, 500)
"""Default values of ``--nodes``, for which the pawn's cages have 253 and 568 nodes."""
AIMS = {250: 2000.0, 568: 600.0}
"""Required steps per second with given activations, by number of nodes."""
PLANNED_AIMS = {250: 2500.0, 568: 700.0}
"""Required steps per second with planned activations, by number of nodes."""
NODE_TOLERANCE = 0.1
"""Maximum relative difference between the number of nodes of a cage and that of an aim for which the cage counts."""
MAX_DISTANCE, MIN_STEPS = 1e-9, 30
STAGES = ("detect", "elasticity", "factor", "substitute", "coulomb", "program", "search", "objectives")
PANELS = (32, 64, 96, 128, 192)
_SPLIT = 3
"""Number of steps whose time is measured by stage."""


@dataclass
class Stopwatch:
    """Stopwatch that sums the seconds of each stage while ``on`` is True."""

    device: torch.device
    on: bool = False
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Measure the stage ``name``; implements ``StageTimer``."""
        started = self.now() if self.on else 0.0
        yield
        if self.on:
            self.seconds[name] += self.now() - started

    def now(self) -> float:
        """Synchronise the device and return the time, s."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


def recorded(creature: Creature, steps: int) -> np.ndarray:
    """Return the activations (steps, M), m, of the first ``steps`` steps of a jump."""
    frames = -(-steps // solver_steps(creature.body)[1])
    return simulate(creature, motion("jump"), frames=frames + 1).trajectory.activations[:steps]


def measure(creature: Creature, jump: np.ndarray, worlds: int, *, alone: int, panel: int, chunk_bytes: int) -> Row:
    """Measure the rate of ``worlds`` worlds, the time by stage, and how far ``alone`` of the worlds deviate from single
    runs."""
    device = torch.device(str(creature.body.assembly.device))
    watch = Stopwatch(device)
    dt, _ = solver_steps(creature.body)
    frictions, shares = np.linspace(0.4, 1.2, worlds), np.random.default_rng(0).uniform(0.7, 1.0, worlds)
    stepper = BatchStepper(
        *(creature.body, creature.muscles, creature.geometry, frictions),
        panel=panel,
        chunk_bytes=chunk_bytes,
        stages=watch,
    )
    start = stepper.start([creature.start] * worlds)
    activations = torch.as_tensor(jump[:, None] * shares[:, None], device=device)
    stepper.advance_with_activations(start, activations[0], dt)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    state, middle, halved = start, start, 0
    started = watch.now()
    for number, row in enumerate(activations):
        middle = state if number == len(activations) // 2 else middle
        state, done, failed = stepper.advance_with_activations(state, row, dt)
        if bool(failed.any()):
            raise RuntimeError(f"{int(failed.sum())} worlds of {worlds} could not be solved in step {number}")
        halved += worlds - int(torch.as_tensor(done[0].report.converged).sum()) if done[0].report.dt == dt else worlds
    seconds = watch.now() - started
    result = {
        "nodes": len(creature.body.mesh.nodes),
        "worlds": worlds,
        "steps": len(activations),
        "rate": worlds * len(activations) / seconds,
        "halved": halved,
        "gib": torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else None,
    }
    watch.on, started = True, watch.now()
    for row in activations[len(activations) // 2 :][:_SPLIT]:
        middle, _, _ = stepper.advance_with_activations(middle, row, dt)
    whole = watch.now() - started
    split = {name: 1e3 * value / _SPLIT for name, value in watch.seconds.items()}
    split["rest"] = 1e3 * whole / _SPLIT - sum(split.values())
    ends = state.positions.cpu().numpy()
    chosen = np.linspace(0, worlds - 1, alone).astype(int).tolist()
    apart = [_apart(creature, jump * shares[one], float(frictions[one]), dt, ends[one]) for one in chosen]
    return {**result, "stages": split, "apart": max(apart, default=None)}


def measure_planned(creature: Creature, worlds: int, *, steps: int, alone: int, panel: int, chunk_bytes: int) -> Row:
    """Measure ``steps`` steps of ``worlds`` worlds that each plan a jump: their rate, the time by stage, and how far
    ``alone`` of the worlds deviate from single runs."""
    device = torch.device(str(creature.body.assembly.device))
    watch = Stopwatch(device, on=True)
    dt, _ = solver_steps(creature.body)
    frictions, distances = np.linspace(0.4, 1.2, worlds), np.linspace(0.2, 0.7, worlds)
    single = _planning_stepper(creature, float(frictions[0]))
    stepper = BatchStepper(
        *(creature.body, creature.muscles, creature.geometry, frictions),
        settings=single.settings,
        panel=panel,
        chunk_bytes=chunk_bytes,
        stages=watch,
        planner=single.planner,
    )
    motions = MotionBatch(creature.body, [_jump(creature, distance) for distance in distances], device)
    state = stepper.start([creature.start] * worlds)
    halved, started, first = 0, watch.now(), 0.0
    for number in range(steps):
        with watch("objectives"):
            objectives = motions.objectives(state, dt)
        state, done, failed = stepper.advance(state, objectives, dt)
        if bool(failed.any()):
            raise RuntimeError(f"{int(failed.sum())} worlds of {worlds} could not be solved in step {number}")
        halved += worlds - int(torch.as_tensor(done[0].report.converged).sum()) if done[0].report.dt == dt else worlds
        with watch("objectives"):
            motions.finish_step(done)
        if number == 0:
            # The first step allocates memory.
            first = watch.now() - started
            watch.seconds = dict.fromkeys(STAGES, 0.0)
    measured = steps - 1
    seconds = watch.now() - started - first
    stages = {name: 1e3 * value / measured for name, value in watch.seconds.items()}
    stages["rest"] = 1e3 * seconds / measured - sum(stages.values())
    ends = state.positions.cpu().numpy()
    chosen = np.linspace(0, worlds - 1, alone).astype(int).tolist()
    apart = [
        _planned_apart(creature, float(distances[one]), float(frictions[one]), dt, steps, ends[one]) for one in chosen
    ]
    return {
        "nodes": len(creature.body.mesh.nodes),
        "worlds": worlds,
        "steps": steps,
        "planned": True,
        "rate": worlds * measured / seconds,
        "rate_without_objectives": worlds * measured / (seconds - watch.seconds["objectives"]),
        "halved": halved,
        "gib": torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else None,
        "stages": stages,
        "apart": max(apart, default=None),
    }


def _planning_stepper(creature: Creature, friction: float) -> LocomotionStepper:
    """Return a stepper of one world that searches contact modes with the kernel of the batch."""
    geometry, device = replace(creature.geometry, friction=friction), str(creature.body.assembly.device)
    settings = LocomotionSettings(qp_solver="admm")
    return LocomotionStepper(creature.body, creature.muscles, geometry, settings=settings, device=device)


def _jump(creature: Creature, distance: float) -> MotionSequence:
    """Return a jump over ``distance`` body heights."""
    script, place = motion(f"jump {distance:.6f}"), initial_stance(creature)
    script.check(place)
    return MotionSequence(place, script.parts(creature.body.height))


def _planned_apart(
    creature: Creature, distance: float, friction: float, dt: float, steps: int, end: np.ndarray
) -> float:
    """Run a planned jump with ``LocomotionStepper``. Return the largest difference of a node coordinate from ``end``
    (N, 3), in body heights."""
    stepper, jump = _planning_stepper(creature, friction), _jump(creature, distance)
    state, memory = creature.start, stepper.initial_memory()
    report: StepReport | None = None
    for _ in range(steps):
        state, memory, done = stepper.advance(state, memory, jump.objectives(state, report, dt), dt)
        report = done[-1]
    return float(np.abs(state.positions - end).max()) / creature.body.height


def _apart(creature: Creature, activations: np.ndarray, friction: float, dt: float, end: np.ndarray) -> float:
    """Run the steps with ``LocomotionStepper``; return the largest distance of a node from ``end`` (N, 3), in body
    heights."""
    device = str(creature.body.assembly.device)
    geometry = replace(creature.geometry, friction=friction)
    stepper = LocomotionStepper(creature.body, creature.muscles, geometry, device=device)
    state, memory = creature.start, stepper.initial_memory()
    for row in activations:
        state, memory, _ = stepper.advance_with_activations(state, memory, row, dt)
    return float(np.abs(state.positions - end).max()) / creature.body.height


def matrices(size: int, count: int, device: torch.device) -> list[Row]:
    """Time the factorisation of ``count`` matrices (size, size) and solutions with their factors."""
    watch = Stopwatch(device)
    half = torch.randn((count, size, 8), dtype=torch.float64, device=device)
    matrix = half @ half.mT + size * torch.eye(size, dtype=torch.float64, device=device)
    slots = torch.arange(count, device=device)

    def took(action: Callable[..., object], *arguments: object) -> float:
        best = np.inf
        for _ in range(3):
            started = watch.now()
            action(*arguments)
            best = min(best, 1e3 * (watch.now() - started))
        return float(best)

    upper = sparse.csc_array(np.triu(np.ones((size, size))))
    entries = matrix[:, upper.indices, np.repeat(np.arange(size), np.diff(upper.indptr))]
    zero = torch.zeros(size, dtype=torch.float64, device=device)
    rows: list[Row] = [{"size": size, "panel": None, "factor": took(torch.linalg.cholesky_ex, matrix)}]
    for panel in PANELS:
        factors = PanelCholesky(upper, count, device, panel=panel)
        row: Row = {"size": size, "panel": panel, "factor": took(factors.factor, entries, zero, slots)}
        for columns in (1, 96):
            right = torch.ones((count, size, columns), dtype=torch.float64, device=device)
            row[f"solve_{columns}"] = took(factors.solve, right, slots)
        rows.append(row)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure each number of worlds with each cage."""
    parser = flags(__doc__, quick="250 nodes, 4 worlds, 3 steps", seed="of the pawn's Gaussians")
    parser.add_argument(
        "--worlds", type=int, nargs="*", default=[64, 256, 1024], help="numbers of parallel worlds, one for each row"
    )
    parser.add_argument(
        "--nodes", type=int, nargs="*", default=list(REQUESTED_NODES), help="requested number of nodes of each cage"
    )
    parser.add_argument("--planned", action="store_true", help="let each world plan a jump in a closed loop")
    parser.add_argument("--steps", type=int, default=30, help="steps of each world (default 30)")
    parser.add_argument("--alone", type=int, default=3, help="number of worlds that are also run alone (default 3)")
    parser.add_argument("--panel", type=int, default=96, help="columns that are factored at a time (default 96)")
    parser.add_argument(
        "--chunk-bytes",
        type=int,
        default=2**31,
        help="bytes of the matrices that are factored at a time (default 2^31)",
    )
    parser.add_argument("--matrices", type=int, help="number of dense matrices for a comparison of factorisations")
    options = parser.parse_args(arguments)
    if options.quick:
        options.nodes, options.worlds, options.steps = options.nodes[:1], [4], 3
    rows: list[Row] = []
    stages = dict.fromkeys((*STAGES, "rest"), ".1f")
    table = Table(nodes="d", worlds="d", steps_a_second="8.1f", halved="d", gib=".1f", apart="8.1e", **stages)
    scene = pawn(seed=options.seed, device=options.device)
    for nodes in options.nodes:
        creature = make_creature(scene.cloud, plane=scene.plane, options=CreatureOptions(nodes=nodes))
        jump = np.zeros((0, 0)) if options.planned else recorded(creature, options.steps)
        memory = {"panel": options.panel, "chunk_bytes": options.chunk_bytes}
        if options.planned and options.device.startswith("cuda"):
            # Later steps need kernels that the first one does not; they are compiled here.
            measure_planned(creature, min(options.worlds), steps=options.steps, alone=0, **memory)
        for worlds in options.worlds:
            alone = min(options.alone, worlds)
            if options.planned:
                row = measure_planned(creature, worlds, steps=options.steps, alone=alone, **memory)
            else:
                row = measure(creature, jump, worlds, alone=alone, **memory)
            rows.append(row)
            figures = [row[name] for name in ("nodes", "worlds", "rate", "halved", "gib", "apart")]
            table.row(*figures, *row["stages"].values())
            record(options, rows, **summary(rows, options.device))
    compared: list[Row] = []
    for size in dict.fromkeys(3 * row["nodes"] for row in rows) if options.matrices else ():
        compared += matrices(size, options.matrices, torch.device(options.device))
    for row in compared:
        print("  ".join(f"{name} {value:.4g}" if value is not None else "torch's own" for name, value in row.items()))
    report(options, rows, matrices=compared, **summary(rows, options.device), draw=lambda figure: draw(figure, rows))


def summary(rows: list[Row], device: str) -> dict[str, Any]:
    """Return the aims, and a reason for each aim that is None."""
    aims: dict[str, bool | None] = {"many_2000": None, "many_planned": None, "many_alike": None}
    why: dict[str, str] = {}
    for name, required, planned in (("many_2000", AIMS, False), ("many_planned", PLANNED_AIMS, True)):
        chosen = [row for row in rows if row.get("planned", False) is planned]
        best = {
            nodes: max([0.0, *(row["rate"] for row in chosen if abs(row["nodes"] / nodes - 1.0) <= NODE_TOLERANCE)])
            for nodes in required
        }
        why[name] = "needs a GPU" if device == "cpu" else "needs runs of both cages"
        if device != "cpu" and min(best.values()) > 0:
            aims[name] = all(rate >= required[nodes] for nodes, rate in best.items())
    apart = [row["apart"] for row in rows if row["apart"] is not None and row["steps"] >= MIN_STEPS]
    if apart:
        aims["many_alike"] = max(apart) <= MAX_DISTANCE
    else:
        why["many_alike"] = f"no world was run alone for {MIN_STEPS} steps"
    return {"aims": aims, "why_null": {name: why[name] for name, value in aims.items() if value is None}}


def draw(figure: Figure, rows: list[Row]) -> None:
    """Draw steps per second against the number of worlds, with one curve per number of nodes."""
    axes = figure.subplots()
    for nodes in dict.fromkeys(row["nodes"] for row in rows):
        chosen = [row for row in rows if row["nodes"] == nodes]
        axes.loglog([row["worlds"] for row in chosen], [row["rate"] for row in chosen], "o-", label=f"{nodes} nodes")
    axes.set(xlabel="worlds", ylabel="steps a second")
    axes.legend()


if __name__ == "__main__":
    main()
