"""Cost and smoothness of motions: muscle work, energy of deformation, chatter of the ground load and energy balance.

python benchmarks/effort.py [--quick] [--workers 2] [--device cpu] [--seed 0] [--json PATH] [--join PATH] [--plot PATH]

Every body of the sweep performs every motion with default settings. Energies are in m g H, loads in body weights. Work
is the sum over segments and steps of the work that muscles do while they shorten. A reversal is a step in which the
change of the ground's normal load has the opposite sign to the change in the previous step, both by more than 0.02 body
weights; only steps before lift-off are counted, or all steps if the body never lifts off.

Aims, for the standard jump of every body: ``work`` (at most 1.5), ``internal_energy`` (kinetic energy of deformation at
most 0.25), ``chatter`` (reversals in at most 15 % of steps, none above 0.3 body weights); for every run:
``ledger_closes`` (the error of the energy balance is at most 1e-6 per step).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egs_warp.assets import figurine, pawn, stool
from egs_warp.errors import UserError
from egs_warp.io import read_capture
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.trajectory import Trajectory, measure
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import make_creature
from egs_warp.pipelines.simulated_run import simulate
from harness import Row, Table, data_folder, flags, record, report, rows_of, timed, workers_flag
from sweep import CAPTURES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BODIES = ("pawn", "figurine", "stool", "robot", "monkey")
MOTIONS = ("jump", "hop 0.7 0.3 x2", "twist 90", "walk 0.4", "turn 30", "stand 2")
MAX_WORK, MAX_INTERNAL, MAX_REVERSED, MAX_REVERSAL, BALANCE_TOLERANCE = 1.5, 0.25, 0.15, 0.3, 1e-6
MIN_CHANGE = 0.02
"""Minimum change of the load in a reversal, body weights."""


def load(trajectory: Trajectory) -> np.ndarray:
    """Return the ground's normal load (F,) in body weights in every step."""
    t = trajectory
    normal = np.einsum("ci,ci->c", t.contact_force, t.contact_normal)
    weight = float(t.node_mass.sum() * np.linalg.norm(t.gravity))
    return np.bincount(t.contact_step, normal, len(t.dt)) / weight


def before_lift_off(loads: np.ndarray) -> int:
    """Return the number of steps before the longest flight phase, or of all steps if no flight phase lasts three
    steps."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], loads <= 0.0, [0]])))
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts)) if len(starts) else 0
    return int(starts[longest]) if len(starts) and ends[longest] - starts[longest] >= 3 else len(loads)


def reversals(loads: np.ndarray) -> np.ndarray:
    """Return the size (F-2,) in body weights of the reversal of the load at each inner step.

    The size is the magnitude of the smaller of two consecutive changes with opposite signs, or 0 if the signs agree.
    """
    changes = np.diff(loads)
    turned = changes[1:] * changes[:-1] < 0.0
    return np.where(turned, np.minimum(np.abs(changes[1:]), np.abs(changes[:-1])), 0.0)


def run(body: str, name: str, *, device: str, seed: int, frames: int | None = None) -> Row:
    """Simulate one motion of one body and return its row. The entry ``stopped`` contains the reason if the motion
    failed."""
    judged, milliseconds = timed(_run, body, name, device=device, seed=seed, frames=frames)
    return {"body": body, "motion": name, **judged, "seconds": 1e-3 * milliseconds}


def _run(body: str, name: str, *, device: str, seed: int, frames: int | None) -> Row:
    subject: dict[str, Any]
    if body in CAPTURES:
        file, up = CAPTURES[body]
        subject = {"cloud": read_capture(data_folder() / "objects" / file, device=device).cloud, "up": np.array(up)}
    else:
        built_in = {"pawn": pawn, "figurine": figurine, "stool": stool}[body](seed=seed, device=device)
        subject = {"cloud": built_in.cloud, "plane": built_in.plane}
    try:
        performance = simulate(make_creature(**subject), motion(name), frames=frames, get_up=False)
    except (UserError, ArithmeticError, np.linalg.LinAlgError) as error:
        return {"stopped": str(error)}
    trajectory = performance.trajectory
    balance, loads = energy_balance(trajectory), load(trajectory)
    turned = reversals(loads[: before_lift_off(loads)])
    return {
        "stopped": performance.fallen or None,
        "reached": {key: float(value) for key, value in vars(measure(trajectory)).items()},
        "steps": len(trajectory.dt),
        "work": float(balance.muscle_work.sum() / balance.energy_unit),
        "peak_elastic": float(balance.elastic.max() / balance.energy_unit),
        "peak_deformation": float(balance.kinetic_deformation.max() / balance.energy_unit),
        "reversed": float(np.mean(turned > MIN_CHANGE)),
        "largest_reversal": float(turned.max(initial=0.0)),
        "largest_load": float(loads.max()),
        "energy_residual": balance.max_residual,
        "load": loads.tolist(),
        "time": trajectory.time[1:].tolist(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all bodies and motions."""
    parser = flags(__doc__, quick="the pawn's jump", device="cpu", seed="seed of the Gaussians of the built-in bodies")
    workers_flag(parser)
    parser.add_argument("--join", type=Path, help="JSON of an earlier run of the same code: its rows are not run again")
    options = parser.parse_args(arguments)
    rows: list[Row] = json.loads(options.join.read_text())["rows"] if options.join else []
    known = {(row["body"], row["motion"]) for row in rows}
    chosen = [("pawn", "jump")] if options.quick else [(body, name) for name in MOTIONS for body in BODIES]
    one = partial(run, device=options.device, seed=options.seed)
    # Compile the kernels once here, not in every worker.
    one("pawn", "jump", frames=4)
    table = Table(
        **{"body": "<8", "motion": "<14", "work": ".2f", "elastic": ".2f", "deformation": ".3f", "reversed": ".1%"},
        **{"largest": ".2f", "residual": ".0e", "seconds": ".0f", "stopped": "<8"},
    )
    for row in rows_of(one, [case for case in chosen if case not in known], options.workers):
        rows.append(row)
        figures = ("work", "peak_elastic", "peak_deformation", "reversed", "largest_reversal", "energy_residual")
        table.row(row["body"], row["motion"], *map(row.get, figures), row["seconds"], row["stopped"] or "")
        record(options, **summary(rows))
    report(options, **summary(rows), draw=lambda figure: draw(figure, rows), size=(8.0, 7.0))


def summary(rows: list[Row]) -> dict[str, Any]:
    """Return the rows and aims, as arguments of ``report``."""
    jumps = [row for row in rows if row["motion"] == "jump" and "work" in row]
    whole = {row["body"] for row in jumps} == set(BODIES)
    aims = {
        "work": all(row["work"] <= MAX_WORK for row in jumps),
        "internal_energy": all(row["peak_deformation"] <= MAX_INTERNAL for row in jumps),
        "chatter": all(row["reversed"] <= MAX_REVERSED and row["largest_reversal"] <= MAX_REVERSAL for row in jumps),
    }
    missing = "the standard jump was not run for every body"
    return {
        "rows": rows,
        "aims": {name: value if whole else None for name, value in aims.items()}
        | {"ledger_closes": all(row["energy_residual"] <= BALANCE_TOLERANCE for row in rows if "work" in row)},
        "why_null": {} if whole else dict.fromkeys(aims, missing),
    }


def draw(figure: Figure, rows: list[Row]) -> None:
    """Draw the load over time, one row of plots for each motion."""
    bodies = [body for body in BODIES if any(row["body"] == body for row in rows)]
    motions = [name for name in MOTIONS if any(row["motion"] == name for row in rows)]
    axes = figure.subplots(len(motions), len(bodies), squeeze=False, sharey=True)
    for row in rows:
        if "load" in row:
            one = axes[motions.index(row["motion"])][bodies.index(row["body"])]
            one.plot(row["time"], row["load"], linewidth=0.7)
            one.set_title(f"{row['body']}, {row['motion']}", fontsize=6)
            one.tick_params(labelsize=5)
    figure.supxlabel("s", fontsize=7)
    figure.supylabel("normal load, body weights", fontsize=7)


if __name__ == "__main__":
    main()
