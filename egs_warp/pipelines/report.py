"""``report.json``: what was asked and reached, the audit, and what it cost. The schema is in docs/report.md."""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import numpy as np

import egs_warp
from egs_warp.io.atomic import atomic_write
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import Audit, Reached

SCHEMA_VERSION = 1
MECHANICS = ("warp-lang", "numpy", "scipy", "osqp", "qdldl", "pytetwild")
"""Packages that decide how a body moves."""


def motion_entry(
    name: str, asked: dict, planned: dict, reached: Reached, notes: Sequence[str], also_reached: dict | None = None
) -> dict:
    """One element of ``motion``."""
    measures = {**asdict(reached), **(also_reached or {})}
    return {"name": name, "asked": asked, "planned": planned, "reached": measures, "notes": list(notes)}


def qp_summary(reports: Sequence[StepReport], frames: np.ndarray) -> dict:
    """Quadratic programs solved a frame; ``frames`` (n,) are indices into the trajectory's times."""
    counts = np.array([0, *(report.qp_count for report in reports)])
    per_frame = np.diff(np.cumsum(counts)[frames]) if len(frames) > 1 else np.zeros(1)
    return {
        "mean_per_frame": float(per_frame.mean()),
        "worst_per_frame": int(per_frame.max()),
        "infeasible": int(sum(report.qp_infeasible for report in reports)),
    }


def timing_summary(reports: Sequence[StepReport], frames: np.ndarray, drawing: dict[str, list[float]]) -> dict:
    """Milliseconds a frame by stage: mean and worst.
    ``drawing`` holds the milliseconds of each drawn frame by stage.
    """
    stages: dict[str, list[float]] = {}
    for first, last in zip(frames[:-1], frames[1:], strict=True):
        sums: dict[str, float] = {}
        for report in reports[first:last]:
            for stage, value in report.milliseconds.items():
                sums[stage] = sums.get(stage, 0.0) + value
        for stage, value in sums.items():
            stages.setdefault(stage, []).append(value)
    return {
        stage: {"mean": float(np.mean(values)), "worst": float(np.max(values))}
        for stage, values in {**stages, **drawing}.items()
        if values
    }


def versions(names: Sequence[str] = MECHANICS) -> dict[str, str]:
    """Of the package, Python and the packages ``names``, which the numbers depend on."""
    return {
        "egs-warp": egs_warp.__version__,
        "python": platform.python_version(),
        **{name: version(name) for name in names},
    }


def build_report(
    *,
    motion: list[dict],
    audit: Audit,
    qp: dict,
    timing: dict,
    cage: dict,
    muscles: dict,
    gaussians: dict,
    device: str,
    seed: int,
    source: str,
    notes: Sequence[str],
) -> dict:
    """The whole report, ready for JSON."""
    return {
        "schema": SCHEMA_VERSION,
        "source": source,
        "motion": motion,
        "audit": asdict(audit),
        "qp": qp,
        "timing": timing,
        "cage": cage,
        "muscles": muscles,
        "gaussians": gaussians,
        "notes": list(notes),
        "versions": versions(),
        "device": device,
        "seed": seed,
    }


def write_report(path: Path, report: dict) -> None:
    """Write ``report`` as indented JSON; the file appears whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(report, indent=2) + "\n")


def summary(report: dict) -> str:
    """A few lines for the terminal."""
    lines = []
    for entry in report["motion"]:
        reached, asked = entry["reached"], entry["asked"]
        pairs = [
            f"{name} {reached[name]:.3f} of {asked[name]:g}" if name in asked else f"{name} {reached[name]:.3f}"
            for name in ("distance", "height", "heading_degrees")
        ]
        lines.append(
            f"{entry['name']}: {', '.join(pairs)}, tilt {reached['tilt_degrees']:.1f} degrees, "
            f"airborne {reached['airborne_frames']:.0f} frames (lengths in body heights)"
        )
        lines += [f"note: {note}" for note in entry["notes"]]
    lines.append("audit: " + ", ".join(f"{name} {value:.2g}" for name, value in report["audit"].items()))
    return "\n".join([*lines, *(f"note: {note}" for note in report["notes"])])
