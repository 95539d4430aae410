"""Accuracy of the remaining time that the progress bars of scene preparation and of simulations show.

The built-in pawn, and koala and fox if the data folder contains them, are separated from their scenes. The pawn jumps,
hops, twists and walks. At each update of the bar, the displayed remaining time is compared with the true remaining
time, if that is at least 5 s, because the bar shows whole seconds.

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
from egs_warp.io.capture import read_capture
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import Creature, make_creature
from egs_warp.pipelines.prepare_scene import SceneOptions, prepare_scene
from egs_warp.pipelines.progress import scene_bar, simulation_bar
from egs_warp.pipelines.simulated_run import simulate
from egs_warp.segmentation.object_spec import ObjectSpec
from harness import Row, Table, data_folder, flags, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCRIPTS = ("jump", "hop x2", "twist", "walk 0.2")
CAPTURES = {"koala.ply": ((0.1, -0.7, 0.15), "-y"), "fox.ply": ((0.0, 0.0, 0.7), "z")}
"""Point on the object and up direction of each captured scene in the data folder."""
MIN_REMAINING = 5.0
"""Minimum true remaining time, s, at which the two times are compared."""


class Watched(io.StringIO):
    """Stream that records, for each update of the bar, the time of the update and the displayed remaining seconds."""

    def __init__(self) -> None:
        super().__init__()
        self.updates: list[tuple[float, float]] = []

    def write(self, text: str, /) -> int:
        """Record the remaining time in seconds that a line of the progress bar shows."""
        if match := re.search(r"<(?:(\d+):)?(\d+):(\d+)", text):
            hours, minutes, seconds = (float(part or 0) for part in match.groups())
            self.updates.append((time.perf_counter(), 3600.0 * hours + 60.0 * minutes + seconds))
        return len(text)


def measured(name: str, run: Callable[[TextIO], int]) -> Row:
    """Measure ``run``, which draws its progress bar on the given stream and returns a number of frames."""
    stream = Watched()
    began = time.perf_counter()
    frames = run(stream)
    ended = time.perf_counter()
    at, said = np.array(stream.updates).T
    far = ended - at >= MIN_REMAINING
    return {
        "run": name,
        "frames": frames,
        "seconds": ended - began,
        "past": list(at[far] - began),
        "ratios": list(said[far] / (ended - at[far])),
    }


def simulated(creature: Creature, script: str, file: TextIO) -> int:
    """Simulate the creature; return the number of frames."""
    with simulation_bar(file=file) as progress:
        return len(simulate(creature, motion(script), progress=progress).frames) - 1


def segmented(scene_cloud: GaussianCloud, point: Sequence[float], up: str, file: TextIO) -> int:
    """Prepare the scene of the object at ``point`` (3,)."""
    options = SceneOptions()
    spec = ObjectSpec(point=np.array(point))
    with scene_bar(options.costs(scene_cloud.count), file=file) as bar:
        prepare_scene(scene_cloud, spec, up=up, options=options, progress=bar.update, expect_costs=bar.expect)
    return 0


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(
        __doc__, quick="only the scenes, the jump and the walk", device="cpu", seed="not used: nothing here is random"
    )
    options = parser.parse_args(arguments)
    built = pawn(device=options.device)
    creature = make_creature(built.cloud, plane=built.plane)
    # The first frames compile the kernels.
    simulate(creature, motion("jump"), frames=2)
    table = Table(
        run="<10", frames="6d", seconds="7.0f", updates="5d", min=".2f", median=".2f", max=".2f", within=".0%"
    )
    scene_cloud = scene("pawn", device=options.device).whole()[0]
    runs = {"scene": partial(segmented, scene_cloud, (0.0, 0.0, 0.5), "z")}
    for file, (point, up) in CAPTURES.items():
        path = data_folder() / "scenes" / file
        if path.is_file():
            runs[path.stem] = partial(segmented, read_capture(path, device=options.device), point, up)
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
        axes.set(xlabel="fraction of the run", ylabel="time left, shown / true")
        axes.legend()

    every = np.concatenate([row["ratios"] for row in rows])
    report(options, rows, aims={"within_two": bool(((every >= 0.5) & (every <= 2.0)).mean() >= 0.95)}, draw=draw)


if __name__ == "__main__":
    main()
