"""Largest push, and largest gust of one second, that a standing body withstands or from which it recovers.

python benchmarks/pushes.py [--quick] [--nodes N] [--bodies NAME ...] [--pushes LINE ...] [--json PATH]

A body recovers from a push if it does not fall and ends at rest within 5 degrees of upright, wherever its feet then
stand. It withstands the push if, in addition, no sole moves by 0.05 body heights or more at any time. Sizes are
multiples of 0.05 m sqrt(g H), up to 3.15; the size of a gust is its total impulse. They are found by bisection, which
assumes that a body that withstands a push, or recovers from it, does the same for smaller ones.
"""

from __future__ import annotations

from collections.abc import Sequence

from egs_warp.assets import scene
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.trajectory import measure
from egs_warp.motions.push import read_pushes
from egs_warp.motions.script import motion
from egs_warp.motions.stand import StandOutcome
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from egs_warp.pipelines.simulated_run import simulate
from harness import Row, Table, flags, record, report, timed
from sweep import bounds_broken

KINDS = ("0.3 {} ahead", "0.3 {} left", "0.3 {} left 0.8", "0.3-1.3 {} left")
STEP, MAX_STEPS = 0.05, 63
"""Spacing of the sizes, m sqrt(g H), and the largest size as a multiple of it."""
STAND = "stand 2"
MAX_SHIFT, MAX_TILT = 0.05, 5.0
"""Maximum displacement of a sole (body heights) and maximum tilt (degrees)."""


def stood(creature: Creature, line: str) -> Row:
    """Simulate one push and judge the result."""
    performance = simulate(creature, motion(STAND), pushes=read_pushes(line), get_up=False)
    trajectory = performance.trajectory
    balance = energy_balance(trajectory)
    (done,) = performance.sequence.done
    reached = done.motion.outcome_record(trajectory, 0, len(trajectory.dt))
    assert isinstance(reached, StandOutcome)
    tilt = measure(trajectory).tilt_degrees
    is_upright = performance.fallen is None and done.motion.is_at_rest and tilt < MAX_TILT
    unconverged = sum(not one.converged for one in performance.simulation.reports)
    return {
        "push": line,
        "withstood": is_upright and reached.sole_shift < MAX_SHIFT,
        "recovered": is_upright,
        "fallen": performance.fallen,
        "resting": done.motion.is_at_rest,
        "sole_shift": reached.sole_shift,
        "lean": reached.lean,
        "tilt_degrees": tilt,
        "work": float(balance.pushes.sum() / balance.energy_unit),
        "muscle_work": float(balance.muscle_work.sum() / balance.energy_unit),
        "energy_residual": balance.max_residual,
        "broken": bounds_broken(vars(audit(trajectory, energy=balance, newton_unconverged=unconverged))),
    }


def largest(
    creature: Creature, kind: str, result: str = "withstood", *, minimum: float = 0.0
) -> tuple[float, list[Row]]:
    """Return the strongest push of ``kind`` with a ``result``, "withstood" or "recovered", and the rows of all pushes
    that were tried; a push of ``minimum`` m sqrt(g H) is known to have this result."""
    low, high, tried = round(minimum / STEP), MAX_STEPS + 1, []
    while high - low > 1:
        middle = (low + high) // 2
        tried.append(stood(creature, kind.format(f"{middle * STEP:.2f}")))
        low, high = (middle, high) if tried[-1][result] else (low, middle)
    return low * STEP, tried


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="only the pawn, only pushed ahead", device="cpu", seed="not used: nothing is random")
    parser.add_argument("--nodes", type=int, default=400, help="approximate number of nodes of the cage (default 400)")
    parser.add_argument("--bodies", nargs="*", default=["pawn", "stool"], help="built-in scenes (default pawn stool)")
    parser.add_argument(
        "--pushes", nargs="*", default=KINDS, help=f"lines with {{}} in place of the size (default {', '.join(KINDS)})"
    )
    options = parser.parse_args(arguments)
    table = Table(body="<8", push="<18", largest=".2f", recovered=".2f", runs="d", seconds=".0f", residual=".0e")
    rows: list[Row] = []
    for name in options.bodies[:1] if options.quick else options.bodies:
        built = scene(name, device=options.device)
        creature = make_creature(built.object, plane=built.plane, options=CreatureOptions(nodes=options.nodes))
        for kind in options.pushes[:1] if options.quick else options.pushes:
            (size, tried), milliseconds = timed(largest, creature, kind)
            (recovered, more), longer = timed(largest, creature, kind, "recovered", minimum=size)
            tried, milliseconds = [*tried, *more], milliseconds + longer
            rows.append({"body": name, "kind": kind, "largest": size, "recovered": recovered, "tried": tried})
            worst = max(row["energy_residual"] for row in tried)
            table.row(name, kind.format("S"), size, recovered, len(tried), 1e-3 * milliseconds, worst)
            record(options, rows, aims=aims(rows))
    report(options, rows, aims=aims(rows))


def aims(rows: Sequence[Row]) -> dict[str, bool]:
    """Return the aims: every run passed the audit, and every body withstands a push of 0.1 m sqrt(g H)."""
    return {
        "audit": all(run["broken"] is None for row in rows for run in row["tried"]),
        "bear_0.1": all(row["largest"] >= 0.1 for row in rows),
    }


if __name__ == "__main__":
    main()
