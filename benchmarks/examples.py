"""Table of the examples, as in the paper's supplement: size of the body, contacts, QPs and ms per frame by stage.

python benchmarks/examples.py [--quick] [--device cpu] [--json PATH] [--plot PATH]
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from harness import Row, Table, example, flags, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXAMPLES = ("jump", "twist", "hop", "walk")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the examples and tabulate their reports."""
    options = flags(
        __doc__, quick="six frames of each example", device="cpu", seed="not used: nothing here is random"
    ).parse_args(arguments)
    rows = []
    for name in EXAMPLES:
        with tempfile.TemporaryDirectory() as folder:
            arguments_of_example = [
                "--out",
                folder,
                "--device",
                options.device,
                *(["--frames", "6"] if options.quick else []),
            ]
            summary = example(name).main(arguments_of_example).to_json()
            with np.load(Path(folder) / "trajectory.npz") as trajectory:
                steps = len(trajectory["time"]) - 1
                contacts = np.bincount(trajectory["contact_step"], minlength=steps)
        rows.append(row_of(name, summary, contacts))
    print_rows(rows)
    report(options, rows, aims={}, draw=lambda figure: draw(figure, rows), size=(7.0, 3.0))


def row_of(name: str, summary: Row, contacts: np.ndarray) -> Row:
    """Return one row of the table, from an example's report and the number of ``contacts`` (F,) in each step."""
    return {
        "example": name,
        "nodes": summary["cage"]["nodes"],
        "tets": summary["cage"]["tets"],
        "fibres": summary["muscles"]["fibres"],
        "segments": summary["muscles"]["segments"],
        "contacts_mean": float(contacts[contacts > 0].mean()) if contacts.any() else 0.0,
        "contacts_max": int(contacts.max(initial=0)),
        "qps_a_frame": summary["qp"]["mean_per_frame"],
        "qps_worst": summary["qp"]["worst_per_frame"],
        "milliseconds": {stage: values["mean"] for stage, values in summary["timing"].items()},
        "motions": summary["motion"],
        "audit": summary["audit"],
    }


def stages_of(rows: list[Row]) -> list[str]:
    """Return the stages that occur in at least one example. Some stages, such as replanning, do not occur in all
    examples."""
    return list(dict.fromkeys(stage for row in rows for stage in row["milliseconds"]))


def print_rows(rows: list[Row]) -> None:
    """Print the table, with maxima per step or frame in brackets and stages in ms per frame."""
    stages = stages_of(rows)
    columns = {"example": "<8", "nodes": "d", "tets": "d", "fibres": "d", "segments": "d"}
    table = Table(**columns, contacts="10s", QPs="10s", **dict.fromkeys(stages, "8.1f"))
    for row in rows:
        table.row(
            *(row[name] for name in columns),
            f"{row['contacts_mean']:.0f} ({row['contacts_max']})",
            f"{row['qps_a_frame']:.1f} ({row['qps_worst']})",
            *(row["milliseconds"].get(stage, 0.0) for stage in stages),
        )
    print("maxima per step or frame are in brackets; stages are in ms per frame")


def draw(figure: Figure, rows: list[Row]) -> None:
    """Plot the time per frame by stage, ms, with one bar for each example."""
    axes = figure.subplots()
    left = np.zeros(len(rows))
    for stage in stages_of(rows):
        width = np.array([row["milliseconds"].get(stage, 0.0) for row in rows])
        axes.barh([row["example"] for row in rows], width, left=left, label=stage)
        left += width
    axes.set(xlabel="ms a frame")
    axes.legend(fontsize=7, ncols=2)


if __name__ == "__main__":
    main()
