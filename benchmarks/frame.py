"""Cost of a step by stage, as a function of the numbers of cage nodes and of contacts.

python benchmarks/frame.py [--quick] [--nodes N ...] [--frames N] [--old FOLDER] [--json PATH] [--plot PATH]

The pawn jumps with cages of about 250 to 4,000 nodes. For each of the first steps, the times of its stages and its
numbers of nodes and contacts are recorded. The model t = c nodes^p contacts^q is fitted to all records of a stage
(steps with contact, least squares of the logarithms). ``--old`` is the folder of a checkout of commit 3848750. The jump
example of that commit is timed in the same run, and the jumps of the available captures (plush dog, monkey, robot) are
timed with both versions, each with its own number of nodes. Run the benchmark on two idle cores (``taskset -c 0,1``).

On a GPU the jump is timed once more with 1,000,000 Gaussians on about 1,000 nodes, if ``--nodes`` includes that cage.
Each frame consists of a step and its image of 1920 x 1080, which is rendered during the next step and downloaded after
it.

Aims on a CPU: ``cpu_541`` (mean at most 60 ms, worst step at most 5 times the mean), ``cpu_10x`` (at most a tenth of
the old commit's time, for the pawn and each capture), ``cpu_250_realtime`` (mean at most 16.7 ms). On a GPU:
``gpu_541`` (mean at most 8 ms, worst step at most 16 ms), ``gpu_1000`` (14 ms and 28 ms), ``gpu_frame_60hz`` (mean of a
step and its image at most 16.7 ms).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from egs_warp.assets import pawn
from egs_warp.io import read_capture
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.simulated_run import simulate
from egs_warp.render.async_render import AsyncRenderer
from frame_time import Studio
from harness import Row, Table, data_folder, flags, record, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from egs_warp.pipelines.creature import Creature

REQUESTED_NODES = (175, 500, 800, 1700, 3500)
"""Values of ``--nodes`` that give the pawn cages of about 250, 541, 1,000, 2,000 and 4,000 nodes."""
BINS = ((1, 8), (9, 16), (17, 32), (33, 64))
"""Ranges of the number of contacts of a step."""
OLD_STAGES = ("detect", "predict", "linearise", "qp", "correct", "audit")
CAPTURES = {"plush dog": ("plush_dog.ply", "-y"), "monkey": ("monkey.ply", "y"), "robot": ("robot.spz", "y")}
"""Captures that are also timed with the old commit: file and up direction."""
_ANIMATE = "from egs_warp.cli import main; main()"
_PICTURELESS = ("--no-shadow", "--size", "64")


GAUSSIANS, SIZE = 1_000_000, (1920, 1080)
"""Number of Gaussians and image size of the frames that are rendered during the steps."""


def measure(nodes_requested: int, frames: int, *, device: str, seed: int) -> list[Row]:
    """Measure each step of the first ``frames`` frames of a jump.

    Kernels are compiled and loaded, and GPU graphs are recorded, before the measurement.
    """
    scene = pawn(seed=seed, device=device)
    creature = make_creature(scene.cloud, plane=scene.plane, options=CreatureOptions(nodes=nodes_requested))
    if device != "cpu":
        # The first run of a graph executes its work directly, the second records it.
        simulate(creature, motion("jump"), frames=frames)
    return _steps(creature, frames, before=2 if device == "cpu" else frames)


def measure_pictures(nodes_requested: int, frames: int, *, device: str, seed: int) -> Row:
    """Time the frames of a jump with images.

    Returns:
        ms per frame in total ("frame") and by stage: the step ("step"), the wait for the bytes of the previous image
            ("bytes") and the start of the new image ("picture").
    """
    scene = pawn(gaussian_count=GAUSSIANS, seed=seed, device=device)
    plain = make_creature(scene.cloud, plane=scene.plane, options=CreatureOptions(nodes=nodes_requested))
    stepper = _RenderingStepper(plain, SIZE)
    creature = replace(plain, stepper=stepper)
    for _ in range(2):
        simulate(creature, motion("jump"), frames=frames)
    stepper.pictures.result()
    stepper.stages = {}
    started = time.perf_counter()
    simulate(creature, motion("jump"), frames=frames)
    stepper.pictures.result()
    whole = 1e3 * (time.perf_counter() - started)
    means = {name: float(np.sum(spent)) / (frames - 1) for name, spent in stepper.stages.items()}
    return {"nodes": len(plain.body.mesh.nodes), "gaussians": plain.cloud.count, **means, "frame": whole / (frames - 1)}


class _RenderingStepper(LocomotionStepper):
    """Stepper that renders an image of each step during the next step."""

    def __init__(self, creature: Creature, size: tuple[int, int]) -> None:
        vars(self).update(vars(creature.stepper))
        self.stages: dict[str, list[float]] = {}
        self.pictures = AsyncRenderer(*size, creature.cloud.device)
        wp.synchronize_device(creature.cloud.device)
        with self.pictures.stream_context():
            self._studio = Studio(creature, size)

    def advance(self, *arguments: Any) -> Any:
        """Advance one step and start its image."""
        studio, marks = self._studio, [time.perf_counter()]
        result = super().advance(*arguments)
        marks.append(time.perf_counter())
        self.pictures.result()
        marks.append(time.perf_counter())
        self.pictures.submit(lambda: studio.enqueue(studio.deform(result[0].positions)))
        marks.append(time.perf_counter())
        for name, spent in zip(("step", "bytes", "picture"), 1e3 * np.diff(marks), strict=True):
            self.stages.setdefault(name, []).append(float(spent))
        return result


def _steps(creature: Creature, frames: int, *, before: int = 2) -> list[Row]:
    simulate(creature, motion("jump"), frames=before)
    started = time.perf_counter()
    performance = simulate(creature, motion("jump"), frames=frames)
    reports = performance.simulation.reports
    wall = 1e3 * (time.perf_counter() - started) / len(reports)
    nodes = len(creature.body.mesh.nodes)
    return [
        {
            **{"nodes": nodes, "contacts": int(one.contacts.count), "wall_ms": wall},
            "stages": {name: float(value) for name, value in one.milliseconds.items()},
            "total": float(sum(one.milliseconds.values())),
        }
        for one in reports
    ]


def by_contacts(records: list[Row]) -> list[Row]:
    """Return rows with the means over all steps of one cage, and over the steps in each range of the number of
    contacts."""
    rows = []
    for low, high in ((0, 10**6), *BINS):
        chosen = [one for one in records if low <= one["contacts"] <= high]
        if chosen:
            totals = [one["total"] for one in chosen]
            stages = {
                name: float(np.mean([one["stages"].get(name, 0.0) for one in chosen])) for name in _stages(chosen)
            }
            rows.append(
                {
                    **{"nodes": chosen[0]["nodes"], "contacts": "all" if low == 0 else f"{low}-{high}"},
                    **{"steps": len(chosen), "stages": stages, "mean": float(np.mean(totals))},
                    **{"worst": float(max(totals)), "wall_ms": chosen[0]["wall_ms"]},
                }
            )
    return rows


def _stages(records: list[Row]) -> list[str]:
    return list(dict.fromkeys(name for one in records for name in one["stages"]))


def exponents(records: list[Row]) -> dict[str, list[float]]:
    """Return the exponents p and q of the model c nodes^p contacts^q, for each stage and for the total."""
    chosen = [one for one in records if one["contacts"] > 0]
    if len({one["nodes"] for one in chosen}) < 2:
        return {}
    rows = np.array([[1.0, np.log(one["nodes"]), np.log(one["contacts"])] for one in chosen])

    def fitted(values: list[float]) -> list[float]:
        known = np.array(values) > 0.0
        solution = np.linalg.lstsq(rows[known], np.log(np.array(values)[known]), rcond=None)[0]
        return [float(solution[1]), float(solution[2])]

    fits = {name: fitted([one["stages"].get(name, 0.0) for one in chosen]) for name in _stages(chosen)}
    return fits | {"total": fitted([one["total"] for one in chosen])}


def old_step(folder: Path, frames: int, *capture: str) -> float:
    """Return the time per step, in ms, of a jump with the code in ``folder``, read from the report of the run.

    Args:
        folder: checkout of the old commit.
        frames: number of frames.
        capture: arguments of its ``animate`` command; without them its example ``jump.py`` runs.
    """
    script = ["-c", _ANIMATE, "animate", *capture, *_PICTURELESS] if capture else ["examples/jump.py"]
    with tempfile.TemporaryDirectory() as place:
        command = [sys.executable, *script, "--out", place, "--frames", str(frames)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}
        subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
        timing = json.loads((Path(place) / "report.json").read_text())["timing"]
    return float(sum(timing[name]["mean"] for name in OLD_STAGES))


def old_captures(folder: Path, frames: int, *, device: str) -> list[Row]:
    """Time the jumps of the available captures with the code in ``folder`` and with this code."""
    rows: list[Row] = []
    for name, (file, up) in CAPTURES.items():
        path = data_folder().resolve() / "objects" / file
        if not path.exists():
            continue
        axis = np.array([0.0, -1.0 if up == "-y" else 1.0, 0.0])
        records = _steps(make_creature(read_capture(path, device=device).cloud, up=axis), frames)
        mean = by_contacts(records)[0]["mean"]
        old = old_step(folder, frames, str(path), f"--up={up}")
        rows.append({"body": name, "nodes": records[0]["nodes"], "mean": mean, "old_ms": old})
        times = f"{mean:.1f} ms a step, {old:.1f} ms at commit 3848750: {old / mean:.1f} times faster"
        print(f"{name}: {records[0]['nodes']} nodes, {times}")
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="250 nodes, 20 frames", device="cpu", seed="seed of the pawn's Gaussians")
    parser.add_argument("--nodes", type=int, nargs="*", default=list(REQUESTED_NODES), help="nodes requested of a cage")
    parser.add_argument("--frames", type=int, default=60, help="frames of each jump (default 60)")
    parser.add_argument("--old", type=Path, help="checkout of commit 3848750")
    options = parser.parse_args(arguments)
    frames, chosen = (20, list(REQUESTED_NODES[:1])) if options.quick else (options.frames, options.nodes)
    old = old_step(options.old.resolve(), frames) if options.old else None
    captures: list[Row] = []
    if old is not None:
        print(f"commit 3848750: {old:.1f} ms a step")
        captures = old_captures(options.old.resolve(), frames, device=options.device)
    records: list[Row] = []
    table: Table | None = None
    for nodes_requested in chosen:
        new_records = measure(nodes_requested, frames, device=options.device, seed=options.seed)
        records += new_records
        if table is None:
            stages = {name: ".1f" for name in _stages(new_records)}
            table = Table(**{"nodes": "d", "contacts": "<8", "steps": "d", **stages, "mean": ".1f", "worst": ".1f"})
        for row in by_contacts(new_records):
            figures = [row["stages"].get(name, 0.0) for name in stages]
            table.row(row["nodes"], row["contacts"], row["steps"], *figures, row["mean"], row["worst"])
        record(options, **summary(records, old, options.device, captures))
    pictures = None
    if options.device != "cpu" and REQUESTED_NODES[2] in chosen:
        pictures = measure_pictures(REQUESTED_NODES[2], frames, device=options.device, seed=options.seed)
        print(", ".join(f"{name} {value:.1f}" for name, value in pictures.items()))
    result = summary(records, old, options.device, captures, pictures)
    for name, (p, q) in result["exponents"].items():
        print(f"{name:<10} nodes^{p:.2f} contacts^{q:.2f}")
    report(options, **result, draw=lambda figure: draw(figure, result["rows"]))


def summary(
    records: list[Row],
    old: float | None,
    device: str,
    captures: Sequence[Row] = (),
    pictures: Row | None = None,
) -> dict[str, Any]:
    """Return the rows, exponents and aims, as arguments of ``report``."""
    cages = [by_contacts([one for one in records if one["nodes"] == n]) for n in sorted({r["nodes"] for r in records})]
    whole = [rows[0] for rows in cages]
    small, usual, large = (
        next((row for row in whole if low <= row["nodes"] <= high), None)
        for low, high in ((200, 300), (500, 620), (900, 1200))
    )

    def within(row: Row | None, mean: float, worst: float) -> bool | None:
        return row["mean"] <= mean and row["worst"] <= worst if row else None

    host = device == "cpu"
    pairs = None
    if host and usual and old is not None:
        pairs = [(usual["mean"], old), *((row["mean"], row["old_ms"]) for row in captures)]
    aims = {
        "cpu_541": within(usual, 60.0, 5.0 * usual["mean"]) if host and usual else None,
        "cpu_10x": None if pairs is None else all(10.0 * mean <= before for mean, before in pairs),
        "cpu_250_realtime": within(small, 1e3 / 60.0, np.inf) if host else None,
        "gpu_541": None if host else within(usual, 8.0, 16.0),
        "gpu_1000": None if host else within(large, 14.0, 28.0),
        "gpu_frame_60hz": pictures["frame"] <= 1e3 / 60.0 if pictures else None,
    }
    elsewhere = "not measured on this device, or no cage of this size"
    nulls = dict.fromkeys(aims, elsewhere) | {
        "cpu_10x": f"{elsewhere}, or no --old",
        "gpu_frame_60hz": elsewhere,
    }
    return {
        "rows": [row for rows in cages for row in rows],
        "exponents": exponents(records),
        "old_ms": old,
        "captures": list(captures),
        "pictures": pictures,
        "aims": aims,
        "why_null": {name: why for name, why in nulls.items() if aims[name] is None},
    }


def draw(figure: Figure, rows: list[Row]) -> None:
    """Draw ms against nodes, by stage."""
    axes = figure.subplots()
    whole = [row for row in rows if row["contacts"] == "all"]
    for name in whole[0]["stages"]:
        axes.loglog([row["nodes"] for row in whole], [row["stages"][name] for row in whole], marker="o", label=name)
    axes.loglog([row["nodes"] for row in whole], [row["mean"] for row in whole], marker="o", color="k", label="step")
    axes.set(xlabel="nodes", ylabel="ms, mean of a step")
    axes.legend(fontsize=7)


if __name__ == "__main__":
    main()
