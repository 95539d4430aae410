"""How hard can a standing body be pushed? The largest push, and gust of one second, under which it keeps its feet.

python benchmarks/pushes.py [--quick] [--nodes N] [--bodies NAME ...] [--pushes LINE ...] [--json PATH]

A body keeps its feet where it has not fallen, no sole was ever 0.05 body heights from where it stood, and it ends calm
and within 5 degrees of upright. Sizes are multiples of 0.05 m sqrt(g H), the whole impulse of a gust, too, up to
3.15, found by halving: one that is kept is taken to say that smaller ones are.
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
STEP, MOST = 0.05, 63
"""m sqrt(g H), and how many of it are tried at most."""
STAND = "stand 2"
SHIFT, TILT = 0.05, 5.0
"""Body heights, degrees."""


def stood(creature: Creature, line: str) -> Row:
    """One push, and how the body stood it."""
    performance = simulate(creature, motion(STAND), pushes=read_pushes(line), get_up=False)
    trajectory = performance.trajectory
    books = energy_balance(trajectory)
    (done,) = performance.sequence.done
    reached = done.motion.outcome_record(trajectory, 0, len(trajectory.dt))
    assert isinstance(reached, StandOutcome)
    tilt = measure(trajectory).tilt_degrees
    kept = performance.fallen is None and done.motion.is_at_rest and reached.sole_shift < SHIFT and tilt < TILT
    unconverged = sum(not one.converged for one in performance.simulation.reports)
    return {
        "push": line,
        "kept": kept,
        "fallen": performance.fallen,
        "resting": done.motion.is_at_rest,
        "sole_shift": reached.sole_shift,
        "lean": reached.lean,
        "tilt_degrees": tilt,
        "work": float(books.pushes.sum() / books.energy_unit),
        "muscle_work": float(books.muscle_work.sum() / books.energy_unit),
        "energy_residual": books.max_residual,
        "broken": bounds_broken(vars(audit(trajectory, energy=books, newton_unconverged=unconverged))),
    }


def largest(creature: Creature, kind: str) -> tuple[float, list[Row]]:
    """The largest size of pushes of a ``kind`` that is kept, and all that were tried."""
    low, high, tried = 0, MOST + 1, []
    while high - low > 1:
        middle = (low + high) // 2
        tried.append(stood(creature, kind.format(f"{middle * STEP:.2f}")))
        low, high = (middle, high) if tried[-1]["kept"] else (low, middle)
    return low * STEP, tried


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print, write."""
    parser = flags(__doc__, quick="the pawn, pushed ahead alone", device="cpu", seed="not used: nothing is random")
    parser.add_argument("--nodes", type=int, default=400, help="of the cage, about (400)")
    parser.add_argument("--bodies", nargs="*", default=["pawn", "stool"], help="built-in scenes (pawn stool)")
    parser.add_argument("--pushes", nargs="*", default=KINDS, help=f"with {{}} for the size ({', '.join(KINDS)})")
    options = parser.parse_args(arguments)
    table = Table(body="<8", push="<18", largest=".2f", runs="d", seconds=".0f", residual=".0e")
    rows: list[Row] = []
    for name in options.bodies[:1] if options.quick else options.bodies:
        made = scene(name, device=options.device)
        creature = make_creature(made.object, plane=made.plane, options=CreatureOptions(nodes=options.nodes))
        for kind in options.pushes[:1] if options.quick else options.pushes:
            (size, tried), milliseconds = timed(largest, creature, kind)
            rows.append({"body": name, "kind": kind, "largest": size, "tried": tried})
            worst = max(row["energy_residual"] for row in tried)
            table.row(name, kind.format("S"), size, len(tried), 1e-3 * milliseconds, worst)
            record(options, rows, aims=aims(rows))
    report(options, rows, aims=aims(rows))


def aims(rows: Sequence[Row]) -> dict[str, bool]:
    """Whether every run passed the audit, and every body bears a push of 0.1 m sqrt(g H)."""
    return {
        "audit": all(run["broken"] is None for row in rows for run in row["tried"]),
        "bear_0.1": all(row["largest"] >= 0.1 for row in rows),
    }


if __name__ == "__main__":
    main()
