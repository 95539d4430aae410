"""Every example as the paper's supplement tabulates its own: sizes of the body, contacts, QPs and milliseconds a frame
by stage.

python benchmarks/examples.py [--quick] [--device cpu] [--json PATH] [--plot PATH]
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import tempfile
from pathlib import Path
from types import ModuleType

import numpy as np

from egs_warp.pipelines.report import versions

EXAMPLES = ("jump", "twist", "hop", "walk")


def main() -> None:
    """Run the examples and tabulate their reports."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="six frames of each")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0, help="not used: nothing here is random")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    rows = []
    for name in EXAMPLES:
        with tempfile.TemporaryDirectory() as folder:
            flags = ["--out", folder, "--device", arguments.device, *(["--frames", "6"] if arguments.quick else [])]
            report = example(name).main(flags)
            with np.load(Path(folder) / "trajectory.npz") as trajectory:
                steps = len(trajectory["time"]) - 1
                contacts = np.bincount(trajectory["contact_step"], minlength=steps)
        rows.append(row_of(name, report, contacts))
    print(table(rows))
    result = {
        "rows": rows,
        "environment": {"device": arguments.device, "seed": arguments.seed, **versions()},
        "aims": {},
    }
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")
    if arguments.plot:
        plot(rows, arguments.plot)


def example(name: str) -> ModuleType:
    """A script of ``examples/``, which is no package."""
    path = Path(__file__).resolve().parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def row_of(name: str, report: dict, contacts: np.ndarray) -> dict:
    """One line of the table; ``contacts`` (F,) in each step."""
    return {
        "example": name,
        "nodes": report["cage"]["nodes"],
        "tets": report["cage"]["tets"],
        "fibres": report["muscles"]["fibres"],
        "segments": report["muscles"]["segments"],
        "contacts_mean": float(contacts[contacts > 0].mean()) if contacts.any() else 0.0,
        "contacts_most": int(contacts.max(initial=0)),
        "qps_a_frame": report["qp"]["mean_per_frame"],
        "qps_worst": report["qp"]["worst_per_frame"],
        "milliseconds": {stage: values["mean"] for stage, values in report["timing"].items()},
        "motions": report["motion"],
        "audit": report["audit"],
    }


def table(rows: list[dict]) -> str:
    """As text."""
    stages = list(rows[0]["milliseconds"])
    head = ["example", "nodes", "tets", "fibres", "segments", "contacts", "QPs", *stages]
    lines = ["".join(f"{word:>11}" for word in head)]
    for row in rows:
        values = [row["example"], row["nodes"], row["tets"], row["fibres"], row["segments"]]
        values += [
            f"{row['contacts_mean']:.0f} ({row['contacts_most']})",
            f"{row['qps_a_frame']:.1f} ({row['qps_worst']})",
        ]
        values += [f"{row['milliseconds'][stage]:.1f}" for stage in stages]
        lines.append("".join(f"{value!s:>11}" for value in values))
    return "\n".join([*lines, "in brackets the most in a step or frame; stages in ms a frame"])


def plot(rows: list[dict], path: Path) -> None:
    """Milliseconds a frame by stage, one bar an example."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3))
    left = np.zeros(len(rows))
    for stage in rows[0]["milliseconds"]:
        width = np.array([row["milliseconds"][stage] for row in rows])
        axes.barh([row["example"] for row in rows], width, left=left, label=stage)
        left += width
    axes.set(xlabel="ms a frame")
    axes.legend(fontsize=7, ncols=2)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
