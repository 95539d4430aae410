"""Visibility of a split: image error of every rule as a function of opacity and viewing direction, and optimal
opacities.

A needle with a circular cross-section (thickness 0.3 of its length) is rendered whole and as children, from seven
directions spread over the sphere. The error is the root mean square over directions and pixels, in percent of the
opacity. The last columns are the opacities of the outer and the middle child of the MEASURED rule that minimise the
error: the table in egs_warp/deformation/splitting.py.

Aims: ``table_is_optimal`` (no opacity of the table deviates by more than 0.002 from the optimum computed here),
``measured_beats_paper`` (at every opacity).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares

from egs_warp.deformation.splitting import SplitRule, child_layout, child_opacities
from harness import Row, Table, flags, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

THICKNESS = 0.3
TILTS = np.radians([90.0, 75.0, 60.0, 45.0, 30.0, 15.0, 4.0])
ALONG, ACROSS = np.linspace(-4.0, 4.0, 81), np.linspace(0.0, 3.0, 16)


def image_error(opacity: float, rule: SplitRule, peaks: np.ndarray, tilt: float) -> np.ndarray:
    """Return the difference between the images of the children and of the parent, divided by the opacity, on a grid
    (16, 81).

    Args:
        opacity: peak opacity of the parent.
        rule: layout of the children.
        peaks: peak opacities of the children.
        tilt: angle of the axis to the line of sight, rad.
    """
    offsets, shrink = child_layout(rule)

    def width(length: float) -> float:
        return float(np.hypot(length * np.sin(tilt), THICKNESS * np.cos(tilt)))

    x = ALONG * width(1.0)
    across = np.exp(-0.5 * ACROSS[:, None] ** 2)
    passed = np.ones((len(ACROSS), len(x)))
    for offset, peak in zip(offsets, peaks, strict=True):
        passed *= 1.0 - peak * np.exp(-0.5 * ((x - offset * np.sin(tilt)) / width(shrink)) ** 2) * across
    return (1.0 - passed - opacity * np.exp(-0.5 * (x / width(1.0)) ** 2) * across) / opacity


def all_errors(opacity: float, rule: SplitRule, peaks: np.ndarray) -> np.ndarray:
    """Return the errors of all directions, weighted by the square root of their share of the sphere.

    The error of a rule is the norm of these values.
    """
    shares = np.sin(TILTS) / np.sin(TILTS).sum()
    parts = [image_error(opacity, rule, peaks, tilt).ravel() for tilt in TILTS]
    return np.concatenate([np.sqrt(share / part.size) * part for share, part in zip(shares, parts, strict=True)])


def best_opacities(opacity: float) -> np.ndarray:
    """Return the outer and the middle peak opacity (2,) of the three children that minimise the error."""

    def residuals(logits: np.ndarray) -> np.ndarray:
        outer, middle = 1.0 / (1.0 + np.exp(-logits))
        return all_errors(opacity, SplitRule.MEASURED, np.array([outer, middle, outer]))

    start = np.clip(opacity * np.array([0.35, 0.7]), 1e-3, 0.95)
    return 1.0 / (1.0 + np.exp(-least_squares(residuals, np.log(start / (1.0 - start))).x))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    options = flags(
        __doc__,
        quick="no effect: the full run takes seconds",
        device="cpu",
        seed="not used: nothing here is random or runs on a device",
    ).parse_args(arguments)
    rows: list[Row] = []
    columns = {f"{rule.value}_{what}": "8.2%" for rule in SplitRule for what in ("rms", "side-on", "end-on")}
    table = Table(opacity=".2f", **columns, best_outer=".5f", middle=".5f")
    for opacity in (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99):
        row: Row = {"opacity": opacity, "best": best_opacities(opacity).tolist()}
        for rule in SplitRule:
            peaks = child_opacities(np.array([opacity]), rule)[0]
            row[rule.value] = {
                "rms": float(np.linalg.norm(all_errors(opacity, rule, peaks))),
                "side_on": float(np.abs(image_error(opacity, rule, peaks, np.pi / 2)).max()),
                "end_on": float(np.abs(image_error(opacity, rule, peaks, 0.0)).max()),
                "opacities": peaks.tolist(),
            }
        rows.append(row)
        errors = (row[rule.value][what] for rule in SplitRule for what in ("rms", "side_on", "end_on"))
        table.row(opacity, *errors, *row["best"])

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for rule in SplitRule:
            axes.plot([r["opacity"] for r in rows], [100 * r[rule.value]["rms"] for r in rows], label=rule.value)
        axes.set(xlabel="opacity", ylabel="image error, % of opacity")
        axes.legend()

    best = [np.allclose(row["best"], row["measured"]["opacities"][:2], atol=2e-3) for row in rows]
    report(
        options,
        rows,
        aims={
            "table_is_optimal": all(best),
            "measured_beats_paper": all(row["measured"]["rms"] < row["paper"]["rms"] for row in rows),
        },
        draw=draw,
        size=(5.0, 3.0),
    )


if __name__ == "__main__":
    main()
