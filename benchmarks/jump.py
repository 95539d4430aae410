"""Milliseconds a frame by stage of the demo: the built-in pawn jumps, from capture to encoded video.

python benchmarks/jump.py [--quick] [--device cpu] [--seed 0] [--json PATH] [--plot PATH]
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path

from egs_warp.assets import pawn
from egs_warp.pipelines.animate import AnimateOptions, animate
from egs_warp.pipelines.report import versions


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="30 frames in place of 110")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    frames = 30 if arguments.quick else 110
    scene = pawn(device=arguments.device)
    with tempfile.TemporaryDirectory() as folder:
        # The first run compiles the kernels.
        animate(scene.cloud, folder, plane=scene.plane, options=AnimateOptions(frames=1), quiet=True)
        options = AnimateOptions(frames=frames, seed=arguments.seed)
        start = time.perf_counter()
        report = animate(scene.cloud, folder, plane=scene.plane, options=options, quiet=True)
        seconds = time.perf_counter() - start
    rows = [{"stage": stage, **values} for stage, values in report["timing"].items()]
    gibibytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{'stage':<12}{'mean ms':>10}{'worst ms':>10}")
    for row in rows:
        print(f"{row['stage']:<12}{row['mean']:>10.1f}{row['worst']:>10.1f}")
    print(
        f"{frames} frames at {options.size} x {options.size}: {seconds:.1f} s in all, peak memory {gibibytes:.2f} GiB"
    )
    full = not arguments.quick
    aims = {"under_3_minutes": seconds < 180.0 if full else None, "under_2_gib": gibibytes < 2.0}
    result = {
        "rows": rows,
        "seconds": seconds,
        "frames": frames,
        "peak_gib": gibibytes,
        "environment": {"device": arguments.device, **versions()},
        "aims": aims,
        "why_null": {} if full else {"under_3_minutes": "--quick draws 30 frames, not 110"},
    }
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")
    if arguments.plot:
        _plot(rows, arguments.plot)


def _plot(rows: list[dict], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3.5))
    axes.barh([row["stage"] for row in rows], [row["mean"] for row in rows])
    axes.invert_yaxis()
    axes.set_xlabel("milliseconds a frame, mean")
    figure.tight_layout()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
