"""Success rates over bodies x motions x friction x sag x step size, and of targets, hops, slopes, scripts and sizes.

python benchmarks/sweep.py [--quick] [--workers 2] [--device cpu] [--seed 0] [--json PATH] [--join PATH] [--plot PATH]

A run succeeds if the motion reaches its target (distance and height within 15 %, a hop's feet within 15 % of its
distance, a twist's heading within 10 degrees and its drift within 0.1 body heights, a walk's distance within 10 % and
the slip of its feet below 2 % of a stride), the body ends upright (tilt below 10 degrees) and the run passes the audit.
Each failure is listed with its reason.
Captures are used if they are available on this machine (in ``EGS_WARP_DATA``, by default ../shared/data).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from egs_warp.assets import figurine, pawn, stool
from egs_warp.errors import UserError
from egs_warp.fem.body import DEFAULT_SAG
from egs_warp.geometry.body_frame import GROUND
from egs_warp.io import read_capture
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import CreatureOptions, initial_stance, make_creature
from egs_warp.pipelines.placed_cage import place_cage
from egs_warp.pipelines.simulated_run import simulate
from harness import Row, Table, data_folder, flags, record, report, rows_of, timed, workers_flag

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRICTIONS = (0.3, 0.6, 1.0)
SAGS = (0.01, 0.03, 0.08)
STEPS = (1 / 30, 1 / 60, 1 / 120)
CAPTURES = {"robot": ("robot.spz", (0.0, 1.0, 0.0)), "monkey": ("monkey.ply", (0.0, 1.0, 0.0))}
BOUNDS = {
    "momentum_residual": 1e-5,
    "angular_momentum_residual": 1e-4,
    "energy_residual": 1e-6,
    "cone_violation": 1e-4,
    "friction_gap": 1e-5,
    "contact_velocity": 1e-6,
    "complementarity_gap": 1e-4,
    "penetration": 0.01,
    "inverted_elements": 0,
    "newton_unconverged": 0,
}
"""Upper bounds of the audit's measures in a successful run."""


@dataclass(frozen=True)
class Case:
    """One run of the sweep."""

    body: str
    motion: str
    friction: float
    sag: float
    step: float
    """Step size, s."""
    slope: float = 0.0
    """Slope of the ground, rising ahead, degrees."""
    height: float = 1.0
    """Height of the body, m."""


def cases(quick: bool) -> list[Case]:
    """Return all runs; ``quick`` gives three."""
    if quick:
        return [Case("pawn", "jump", friction, 0.05, 1 / 60) for friction in FRICTIONS]
    captures = [name for name, (file, _) in CAPTURES.items() if (data_folder() / "objects" / file).exists()]
    bodies = ["pawn", "figurine", "stool", *captures]
    runs = [Case(body, "jump", *rest) for body in bodies[:2] for rest in product(FRICTIONS, SAGS, STEPS)]
    runs += [
        Case(body, "jump", friction, sag, 1 / 60) for body in bodies[2:] for friction, sag in product(FRICTIONS, SAGS)
    ]
    runs += [
        Case(body, "twist 180", f, sag, 1 / 60) for body in ("pawn", "figurine") for f, sag in product(FRICTIONS, SAGS)
    ]
    runs += [Case("stool", "walk", friction, sag, 1 / 60) for friction in FRICTIONS[1:] for sag in (0.03, 0.05)]
    return runs + further(captures)


def further(captures: Sequence[str]) -> list[Case]:
    """Return runs with other targets, slopes, scripts and sizes, at the default friction, sag and step size."""

    def default(body: str, motion: str, **rest: float) -> Case:
        return Case(body, motion, 0.8, DEFAULT_SAG, 1 / 60, **rest)

    runs = [
        default(body, f"jump {distance} {height}")
        for body in ("pawn", "figurine")
        for distance in (0.2, 0.6, 1.0)
        for height in (0.1, 0.2, 0.4)
    ]
    runs += [default(body, "hop 0.7 0.3 x2") for body in ("pawn", "figurine", *captures)]
    runs += [default(body, "jump", slope=slope) for body in ("pawn", "stool", *captures) for slope in (-8.0, 8.0)]
    runs += [default(body, "jump, twist 90, jump 0.3 0.15") for body in ("pawn", "figurine", *captures)]
    runs += [default(body, "jump", height=height) for body in ("pawn", "stool", *captures) for height in (0.1, 3.0)]
    return runs


def run(case: Case, *, device: str, seed: int, frames: int | None = None) -> Row:
    """Simulate the first ``frames`` frames of one case and judge it; ``seed`` selects the Gaussians of built-in
    bodies."""
    wp.config.log_level = wp.LOG_WARNING
    judged, milliseconds = timed(_run, case, device=device, seed=seed, frames=frames)
    return {**asdict(case), **judged, "seconds": 1e-3 * milliseconds}


def _run(case: Case, *, device: str, seed: int, frames: int | None) -> Row:
    subject: dict[str, Any]
    if case.body in CAPTURES:
        file, up = CAPTURES[case.body]
        subject = {"cloud": read_capture(data_folder() / "objects" / file, device=device).cloud, "up": np.array(up)}
    else:
        built_in = {"pawn": pawn, "figurine": figurine, "stool": stool}[case.body](seed=seed, device=device)
        subject = {"cloud": built_in.cloud, "plane": built_in.plane}
    options = CreatureOptions(friction=case.friction, sag=case.sag)
    try:
        if case.height != 1.0:
            options = replace(options, metres_per_unit=case.height * place_cage(**subject).frame.scale)
        if case.slope:
            level = make_creature(**subject, options=options)
            ahead = initial_stance(level).ground.axes[0]
            angle = np.radians(case.slope)
            tilted = np.cos(angle) * GROUND.normal + np.sin(angle) * ahead
            options = replace(options, gravity_up=level.frame.axes.T @ tilted)
        creature = make_creature(**subject, options=options)
        performance = simulate(creature, motion(case.motion), frames=frames, step=case.step, get_up=False)
    except (UserError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return {"success": False, "reason": f"stopped: {error}"}
    trajectory, sequence = performance.trajectory, performance.sequence
    reports = performance.simulation.reports
    checked = asdict(audit(trajectory, newton_unconverged=sum(not r.converged for r in reports)))
    reason = bounds_broken(checked)
    parts: list[dict[str, float]] = []
    for done, (first, last) in zip(sequence.done, sequence.spans(trajectory.time), strict=True):
        reached = asdict(done.measured(trajectory, first, last))
        if (also := done.motion.outcome_record(trajectory, first, last)) is not None:
            reached |= asdict(also)
        parts.append({name: float(value) for name, value in reached.items()})
        requested = {"distance": 0.0, "height": 0.2, **done.asked}
        reason = reason or judge(done.name, requested, reached, metres=case.height, rests=done is sequence.done[-1])
    reason = reason or (f"{left[0]}" if (left := sequence.unfinished_note()) and frames is None else None)
    if reason and friction_spent(trajectory) > 0.5:
        reason += "; friction was at its limit for over half of the time on the ground"
    return {
        "success": reason is None,
        "reason": reason,
        "requested": [dict(done.asked) for done in sequence.done],
        "reached": parts,
        "audit": {name: float(value) for name, value in checked.items()},
        "young_modulus": float(creature.body.young_modulus),
        "notes": [note for done in sequence.done for note in done.motion.notes()],
    }


def bounds_broken(checked: dict[str, float]) -> str | None:
    """Return the first measure of the audit whose bound a run exceeds, or None."""
    for name, bound in BOUNDS.items():
        if not checked[name] <= bound:
            return f"audit: {name} {checked[name]:.2g}"
    return None


def judge(
    motion: str, requested: dict[str, float], reached: dict[str, float], *, metres: float = 1.0, rests: bool = True
) -> str | None:
    """Return the reason why a motion of a body ``metres`` tall failed; None for a success.

    A hop is judged by the distance of its feet from their target. If another hop follows (``rests`` is False), the body
    is still landing when the hop ends, so its tilt is not judged.
    """
    is_hop = motion == "hop"
    if reached["tilt_degrees"] >= 10.0 and (rests or not is_hop):
        return f"fell or leans: tilt {reached['tilt_degrees']:.0f} degrees"
    if motion == "walk":
        if reached["slip"] >= 0.02:
            return f"a foot slipped {reached['slip']:.1%} of the stride"
        wrong = abs(reached["distance"] - requested["distance"]) > 0.1 * requested["distance"]
        return f"walked {reached['distance']:.3f}, requested {requested['distance']:.3f}" if wrong else None
    free_flight = 60.0 * 2.0 * np.sqrt(2.0 * requested["height"] * metres / 9.81)
    if reached["airborne_frames"] < free_flight / 3.0:
        return f"barely left the ground: {reached['airborne_frames']:.0f} frames"
    if abs(reached["height"] - requested["height"]) > 0.15 * requested["height"]:
        return f"rose {reached['height']:.3f}, requested {requested['height']:.3f}"
    if motion == "twist":
        short = abs((reached["heading_degrees"] - requested["heading_degrees"] + 180.0) % 360.0 - 180.0)
        if short > 10.0:
            return f"turned {short:.0f} degrees too little or too much"
        return f"drifted {reached['distance']:.3f}" if reached["distance"] > 0.1 else None
    if is_hop:
        missed = reached["target_error"]
        return f"feet missed their target by {missed:.0%} of the distance" if missed > 0.15 else None
    if abs(reached["distance"] - requested["distance"]) > 0.15 * requested["distance"]:
        return f"went {reached['distance']:.3f}, requested {requested['distance']:.3f}"
    return None


def friction_spent(trajectory: Trajectory) -> float:
    """Return the fraction of the steps with contact in which the friction force is within 1 % of its limit."""
    normal = np.einsum("ci,ci->c", trajectory.contact_force, trajectory.contact_normal)
    tangential = np.linalg.norm(trajectory.contact_force - normal[:, None] * trajectory.contact_normal, axis=1)
    steps = len(trajectory.time) - 1
    used = np.bincount(trajectory.contact_step, tangential, steps)
    limit = np.bincount(trajectory.contact_step, trajectory.friction * normal, steps)
    loaded = limit > 1e-6 * limit.max(initial=0.0)
    return float(np.mean(used[loaded] > 0.99 * limit[loaded])) if loaded.any() else 0.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all cases and print the summary."""
    parser = flags(__doc__, quick="three runs", device="cpu", seed="of the Gaussians of the built-in bodies")
    workers_flag(parser)
    parser.add_argument("--join", type=Path, help="JSON of an earlier run of the same code: its rows are not run again")
    options = parser.parse_args(arguments)
    rows = json.loads(options.join.read_text())["rows"] if options.join else []
    known = [Case(**{name: row[name] for name in Case.__dataclass_fields__}) for row in rows]
    runs = [case for case in cases(options.quick) if case not in known]
    # Compile the kernels once here, not in every worker.
    one = partial(run, device=options.device, seed=options.seed)
    one(Case("pawn", "jump", 0.6, 0.05, 1 / 60), frames=4)
    print(f"{len(runs) + len(known)} runs, {len(known)} of them from --join")
    table = Table(
        **{"run": "d", "body": "<8", "motion": "<16", "friction": "g", "sag": "g", "slope": "g", "height": "g"},
        **{"step_rate": ".0f", "seconds": ".0f", "outcome": "<7"},
    )
    for row in rows_of(one, [(case,) for case in runs], options.workers):
        rows.append(row)
        case = [row[name] for name in ("body", "motion", "friction", "sag", "slope", "height")]
        table.row(len(rows), *case, 1 / row["step"], row["seconds"], row["reason"] or "success")
        record(options, **summary(rows))
    result = summary(rows)
    print_summary(result)
    report(options, **result, draw=lambda figure: draw(figure, rows), size=(7.0, 4.0))


def summary(rows: list[Row]) -> dict[str, Any]:
    """Return success rates by every factor, the worst audit values of the successes, and the aims, as arguments of
    ``report``."""
    good = [row for row in rows if row["success"]]
    rates = {
        factor: {
            str(value): [sum(row["success"] for row in rows if row[factor] == value), count]
            for value, count in sorted(Counter(row[factor] for row in rows).items())
        }
        for factor in ("body", "motion", "friction", "sag", "step", "slope", "height")
    }
    rate = len(good) / len(rows)
    is_complete = len(rows) >= 100
    return {
        "rows": rows,
        "success_rate": rate,
        "successes_of_runs": rates,
        "worst_audit_of_successes": {
            name: max((row["audit"][name] for row in good if "audit" in row), default=None) for name in BOUNDS
        },
        "failures": [
            {key: row[key] for key in (*Case.__dataclass_fields__, "reason")} for row in rows if not row["success"]
        ],
        "aims": {
            "ninety_five_percent_succeed": rate >= 0.95 if is_complete else None,
            "every_success_meets_the_audit": all(
                row["audit"][name] <= bound for row in good if "audit" in row for name, bound in BOUNDS.items()
            ),
        },
        "why_null": {} if is_complete else {"ninety_five_percent_succeed": f"{len(rows)} runs, not 100"},
    }


def print_summary(result: dict[str, Any]) -> None:
    """Print the summary as text."""
    print(f"{result['success_rate']:.0%} of {len(result['rows'])} runs succeed")
    for factor, values in result["successes_of_runs"].items():
        shares = "  ".join(f"{value}: {good}/{count}" for value, (good, count) in values.items())
        print(f"  {factor:<9}{shares}")
    table = Table(worst_audit_of_a_success="<28", value=".2g")
    for name, value in result["worst_audit_of_successes"].items():
        table.row(name, value)


def draw(figure: Figure, rows: list[Row]) -> None:
    """Draw the tilt against the distance of successes and failures."""
    axes = figure.subplots()
    for success, colour in ((True, "tab:green"), (False, "tab:red")):
        chosen = [row for row in rows if row["success"] is success and "reached" in row]
        x, y = ([row["reached"][-1][name] for row in chosen] for name in ("distance", "tilt_degrees"))
        axes.scatter(x, y, s=14, color=colour, label=f"{'success' if success else 'failure'} ({len(chosen)})")
    axes.set(xlabel="distance reached / H", ylabel="tilt at the end, degrees", title=f"{len(rows)} runs")
    axes.legend()


if __name__ == "__main__":
    main()
