"""Is the time left true that the progress bars of a scene and of a simulation tell?

The built-in pawn is taken out of its room, and jumps, hops, twists and walks. Each time that the bar is drawn, what it
says is left is compared with what turns out to be left, where that is 5 s or more: the bar tells whole seconds.

python benchmarks/time_left.py [--quick] [--device cpu] [--seed 0] [--json PATH] [--plot PATH]
"""

from __future__ import annotations

import io
import re
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, TextIO

import numpy as np

from egs_warp.assets import pawn, scene
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import Creature, make_creature
from egs_warp.pipelines.prepare_scene import SceneOptions, prepare_scene
from egs_warp.pipelines.progress import scene_bar, simulation_bar
from egs_warp.pipelines.simulated_run import simulate
from egs_warp.segmentation.object_spec import ObjectSpec
from harness import Row, Table, flags, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCRIPTS = ("jump", "hop x2", "twist", "walk 0.2")
LEAST = 5.0
"""Seconds."""


class Watched(io.StringIO):
    """A stream that keeps when the bar was drawn, and the seconds left that it told."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[tuple[float, float]] = []

    def write(self, text: str, /) -> int:
        """Reads what the user would see."""
        if found := re.search(r"<(?:(\d+):)?(\d+):(\d+)", text):
            hours, minutes, seconds = (float(part or 0) for part in found.groups())
            self.told.append((time.perf_counter(), 3600.0 * hours + 60.0 * minutes + seconds))
        return len(text)


def measured(name: str, run: Callable[[TextIO], int]) -> Row:
    """Of a ``run`` that draws its bar on what it is given, and returns how many frames it made."""
    stream = Watched()
    began = time.perf_counter()
    frames = run(stream)
    ended = time.perf_counter()
    at, said = np.array(stream.told).T
    far = ended - at >= LEAST
    return {
        "run": name,
        "frames": frames,
        "seconds": ended - began,
        "past": list(at[far] - began),
        "ratios": list(said[far] / (ended - at[far])),
    }


def simulated(creature: Creature, script: str, file: TextIO) -> int:
    """The creature moves."""
    with simulation_bar(file=file) as told:
        return len(simulate(creature, motion(script), progress=told).frames) - 1


def taken_out(room: GaussianCloud, file: TextIO) -> int:
    """The pawn of a room, clicked on."""
    options = SceneOptions()
    with scene_bar(options.stages, file=file) as told:
        prepare_scene(room, ObjectSpec(point=np.array([0.0, 0.0, 0.5])), options=options, progress=told)
    return 0


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print, write."""
    parser = flags(
        __doc__, quick="the room, the jump and the walk alone", device="cpu", seed="not used: nothing here is random"
    )
    options = parser.parse_args(arguments)
    made = pawn(device=options.device)
    creature = make_creature(made.cloud, plane=made.plane)
    # The first frames compile the kernels.
    simulate(creature, motion("jump"), frames=2)
    table = Table(
        run="<10", frames="6d", seconds="7.0f", told="5d", least=".2f", median=".2f", most=".2f", within=".0%"
    )
    room = scene("pawn", device=options.device).whole()[0]
    runs = {"room": partial(taken_out, room)}
    runs |= {script: partial(simulated, creature, script) for script in (SCRIPTS[::3] if options.quick else SCRIPTS)}
    rows = []
    for name, run in runs.items():
        row = measured(name, run)
        rows.append(row)
        ratios = np.array(row["ratios"])
        within = float(np.mean((ratios >= 0.5) & (ratios <= 2.0)))
        numbers = (ratios.min(), float(np.median(ratios)), ratios.max())
        table.row(name, row["frames"], row["seconds"], len(ratios), *numbers, within)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for row in rows:
            axes.plot(np.array(row["past"]) / row["seconds"], row["ratios"], label=row["run"])
        axes.axhspan(0.5, 2.0, alpha=0.1)
        axes.set(xlabel="of the run", ylabel="time left, told over true")
        axes.legend()

    every = np.concatenate([row["ratios"] for row in rows])
    report(options, rows, aims={"within_two": bool(((every >= 0.5) & (every <= 2.0)).mean() >= 0.95)}, draw=draw)


if __name__ == "__main__":
    main()
