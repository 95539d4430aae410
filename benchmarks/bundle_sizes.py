"""Sizes of a bundle, of numbered .ply, .sog and .spz files, and of one USD stage, for finished runs.

The numbered files of a run differ little in size, so three of them are written, and their mean size is multiplied by
the number of frames. A USD stage grows by the same size with each frame, so two stages with few frames are written, and
the difference of their sizes is multiplied. Bundles are written completely.

Aims: ``fiftieth_of_sog`` (every bundle takes at most 1/50 of the size of numbered .sog files), ``second_is_a_fiftieth``
(each additional second of film takes at most 1/50 of its size in numbered .sog files).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from egs_warp.io.bundle_file import read_valid_file
from egs_warp.launching import use_device
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.pipelines.bundle import export_bundle
from egs_warp.pipelines.export import export_splats
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.usd import export_usd
from harness import Row, Table, flags, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NUMBERED = ("ply", "sog", "spz")
FORMATS = (*NUMBERED, "usd", "bundle")


def numbered_size(run: FinishedRun, kind: str, folder: Path) -> float:
    """Return the size in bytes of all frames of ``run`` in numbered files, extrapolated from three files."""
    count = len(run.steps)
    sizes = []
    for frame in (0, count // 2, count - 1):
        path = folder / f"{frame}.{kind}"
        export_splats(run, path, kind, frame=frame, quiet=True)
        sizes.append(path.stat().st_size)
    return count * sum(sizes) / len(sizes)


def stage_size(run: FinishedRun, folder: Path) -> float:
    """Return the size in bytes of a USD stage with all frames of ``run``, extrapolated from two shorter stages."""
    count = len(run.steps)
    numbers, sizes = [], []
    for every in (count // 2, count // 5):
        path = folder / f"every{every}.usdc"
        export_usd(run, path, every=every, quiet=True)
        numbers.append(len(range(0, count, every)))
        sizes.append(path.stat().st_size)
    per_frame = (sizes[1] - sizes[0]) / (numbers[1] - numbers[0])
    return sizes[0] + (count - numbers[0]) * per_frame


def sizes_of(run: FinishedRun) -> Row:
    """Return the sizes of ``run`` in all formats, in MB."""
    count = len(run.steps)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export_bundle(run, folder / "all.egs")
        body = read_valid_file(folder / "all.egs").text["bodies"][0]
        motion = sum(entry["bytes"] for block in body["blocks"] for entry in block["arrays"].values())
        row: Row = {kind: numbered_size(run, kind, folder) / 1e6 for kind in NUMBERED}
        row |= {"usd": stage_size(run, folder) / 1e6, "bundle": (folder / "all.egs").stat().st_size / 1e6}
    splats = run.creature.splats
    return {
        "run": run.title,
        "gaussians": splats.count,
        "degree": splats.sh_degree,
        "nodes": len(run.trajectory.rest_positions),
        "frames": count,
        **row,
        "second": motion / count * FRAME_RATE / 1e6,
        "seconds": count / FRAME_RATE,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the runs and print the table."""
    parser = flags(__doc__, quick="measure only the first run", device="cpu")
    parser.add_argument("runs", type=Path, nargs="*", default=[Path("out/jump")], help="run folders (out/jump)")
    options = parser.parse_args(arguments)
    use_device(options.device)
    sizes = {f"{kind}_MB": "8.2f" for kind in FORMATS}
    table = Table(
        run="<24", gaussians="7d", nodes="5d", frames="6d", **sizes, MB_a_second="7.2f", sog_over_bundle=".1f"
    )
    rows = []
    for folder in options.runs[:1] if options.quick else options.runs:
        row = sizes_of(FinishedRun.read(folder))
        rows.append(row)
        counts = (row["gaussians"], row["nodes"], row["frames"])
        part = row["sog"] / row["bundle"]
        table.row(row["run"], *counts, *(row[kind] for kind in FORMATS), row["second"], part)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for kind in FORMATS:
            axes.semilogy([row["run"] for row in rows], [row[kind] for row in rows], "o", label=kind)
        axes.set(ylabel="MB")
        axes.tick_params(axis="x", labelsize=6)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

    whole = all(50.0 * row["bundle"] <= row["sog"] for row in rows)
    second = all(50.0 * row["second"] <= row["sog"] / row["frames"] * FRAME_RATE for row in rows)
    report(options, rows, aims={"fiftieth_of_sog": whole, "second_is_a_fiftieth": second}, draw=draw)


if __name__ == "__main__":
    main()
