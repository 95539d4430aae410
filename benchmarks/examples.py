"""Every example as the paper's supplement tabulates its own: sizes of the body, contacts, QPs and milliseconds a frame
by stage.

python benchmarks/examples.py [--quick] [--device cpu] [--json PATH] [--plot PATH]
"""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from harness import Row, Table, flags, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXAMPLES = ("jump", "twist", "hop", "walk")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the examples and tabulate their reports."""
    options = flags(
        __doc__, quick="six frames of each", device="cpu", seed="not used: nothing here is random"
    ).parse_args(arguments)
    rows = []
    for name in EXAMPLES:
        with tempfile.TemporaryDirectory() as folder:
            asked = ["--out", folder, "--device", options.device, *(["--frames", "6"] if options.quick else [])]
            told = example(name).main(asked).to_json()
            with np.load(Path(folder) / "trajectory.npz") as trajectory:
                steps = len(trajectory["time"]) - 1
                contacts = np.bincount(trajectory["contact_step"], minlength=steps)
        rows.append(row_of(name, told, contacts))
    print_rows(rows)
    report(options, rows, aims={}, draw=lambda figure: draw(figure, rows), size=(7.0, 3.0))


def example(name: str) -> ModuleType:
    """A script of ``examples/``, which is no package."""
    path = Path(__file__).resolve().parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def row_of(name: str, told: Row, contacts: np.ndarray) -> Row:
    """One line of the table; ``contacts`` (F,) in each step."""
    return {
        "example": name,
        "nodes": told["cage"]["nodes"],
        "tets": told["cage"]["tets"],
        "fibres": told["muscles"]["fibres"],
        "segments": told["muscles"]["segments"],
        "contacts_mean": float(contacts[contacts > 0].mean()) if contacts.any() else 0.0,
        "contacts_most": int(contacts.max(initial=0)),
        "qps_a_frame": told["qp"]["mean_per_frame"],
        "qps_worst": told["qp"]["worst_per_frame"],
        "milliseconds": {stage: values["mean"] for stage, values in told["timing"].items()},
        "motions": told["motion"],
        "audit": told["audit"],
    }


def stages_of(rows: list[Row]) -> list[str]:
    """Of all examples: some never ask twice for a step."""
    return list(dict.fromkeys(stage for row in rows for stage in row["milliseconds"]))


def print_rows(rows: list[Row]) -> None:
    """The table: in brackets the most in a step or frame; stages in milliseconds a frame."""
    stages = stages_of(rows)
    columns = {"example": "<8", "nodes": "d", "tets": "d", "fibres": "d", "segments": "d"}
    table = Table(**columns, contacts="10s", QPs="10s", **dict.fromkeys(stages, "8.1f"))
    for row in rows:
        table.row(
            *(row[name] for name in columns),
            f"{row['contacts_mean']:.0f} ({row['contacts_most']})",
            f"{row['qps_a_frame']:.1f} ({row['qps_worst']})",
            *(row["milliseconds"].get(stage, 0.0) for stage in stages),
        )
    print("in brackets the most in a step or frame; stages in ms a frame")


def draw(figure: Figure, rows: list[Row]) -> None:
    """Milliseconds a frame by stage, one bar an example."""
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
