"""Milliseconds per frame of each stage of the demo, from the capture to the encoded video of a jump of the built-in
pawn.

python benchmarks/jump.py [--quick] [--device cpu] [--seed 0] [--json PATH] [--plot PATH]
"""

from __future__ import annotations

import resource
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from egs_warp.assets import pawn
from egs_warp.pipelines.animate import AnimateOptions, animate
from harness import Table, flags, report, timed

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    options = flags(__doc__, quick="30 frames in place of 110", device="cpu").parse_args(arguments)
    frames = 30 if options.quick else 110
    scene = pawn(device=options.device)
    with tempfile.TemporaryDirectory() as folder:
        # The first run compiles the kernels.
        animate(scene.cloud, folder, plane=scene.plane, options=AnimateOptions(frames=2), quiet=True)
        settings = AnimateOptions(frames=frames, seed=options.seed)
        result, milliseconds = timed(
            animate, scene.cloud, folder, plane=scene.plane, options=settings, quiet=True, overwrite=True
        )
    seconds = 1e-3 * milliseconds
    rows = [{"stage": stage, **asdict(time)} for stage, time in result.timing.items()]
    gibibytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    table = Table(stage="<12", mean_ms=".1f", worst_ms=".1f")
    for row in rows:
        table.row(row["stage"], row["mean"], row["worst"])
    print(
        f"{frames} frames at {settings.size} x {settings.size}: {seconds:.1f} s total, peak memory {gibibytes:.2f} GiB"
    )
    full = not options.quick

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.barh([row["stage"] for row in rows], [row["mean"] for row in rows])
        axes.invert_yaxis()
        axes.set_xlabel("milliseconds per frame, mean")

    report(
        options,
        rows,
        seconds=seconds,
        frames=frames,
        peak_gib=gibibytes,
        aims={"under_3_minutes": seconds < 180.0 if full else None, "under_2_gib": gibibytes < 2.0},
        why_null={} if full else {"under_3_minutes": "--quick draws 30 frames, not 110"},
        draw=draw,
    )


if __name__ == "__main__":
    main()
