"""Getting up: bodies that lie on the ground, tilted by 80, 90 and 95 degrees about two axes.

python benchmarks/get_up.py [--quick] [--workers 2] [--nodes 150] [--bodies NAME ...] [--json PATH]

A body starts at rest, lying just above the ground, with the motion ``get up``. It succeeds if it ends at rest within 15
degrees of upright. Work is the muscles' work over all attempts, in m g H. Times are measured from the start, in
sqrt(H/g).
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from typing import Any

import numpy as np
import warp as wp

from benchmark_bodies import body
from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.rollout import rollout_steps, run_with
from egs_warp.motions.get_up import GetUp, lie_down
from egs_warp.pipelines.creature import initial_stance
from gaits import creature_of
from harness import Row, Table, flags, record, report, timed
from modelled import MODELLED, UNSEEN, modelled
from sweep import bounds_broken

BODIES = ("pawn", "bottle", "biped", "box", "stool")
DEGREES = (80.0, 90.0, 95.0)
SIDES = {"front": 1, "side": 0}
"""Index of the ground axis about which the body is tilted: 1 points to its left, 0 to its front."""
MAX_TIME = 60.0
"""Maximum time, sqrt(H / g)."""
MAX_MEDIAN_WORK = 10.0
"""Maximum median work, m g H."""


def run(name: str, degrees: float, side: str, nodes: int) -> Row:
    """Lay one body down, simulate ``get up`` and return the row of the result."""
    wp.config.log_level = wp.LOG_WARNING
    outcome, milliseconds = timed(_run, name, degrees, side, nodes)
    return {"body": name, "degrees": degrees, "side": side, **outcome, "seconds": 1e-3 * milliseconds}


def _run(name: str, degrees: float, side: str, nodes: int) -> Row:
    one = modelled(name) if name in MODELLED or name in UNSEEN else body(name)
    creature = creature_of(one, nodes)
    place = initial_stance(creature)
    laid = lie_down(place, degrees, place.ground.axes[SIDES[side]])
    motion = GetUp(place)
    unit = creature.body.time_unit
    try:
        steps = rollout_steps(
            creature.stepper,
            BodyState(laid, np.zeros_like(laid)),
            motion,
            frames=round(60.0 * MAX_TIME * unit),
            place=creature.frame,
            finished=lambda: motion.is_at_rest,
        )
        simulation = run_with(creature.stepper, steps)
    except (UserError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return {"up": False, "tries": motion.tries, "reason": f"stopped: {error}"}
    trajectory = simulation.trajectory
    balance = energy_balance(trajectory)
    checked = asdict(audit(trajectory, newton_unconverged=sum(not r.converged for r in simulation.reports)))
    up = motion.is_up and motion.is_at_rest
    return {
        "up": up,
        "tries": motion.tries,
        "work": float(balance.muscle_work.sum() / balance.energy_unit),
        "time": float(trajectory.time[-1]) / unit,
        "reason": None if up else "; ".join(motion.notes()) or f"not within {MAX_TIME:g} sqrt(H/g)",
        "audit": bounds_broken(checked),
    }


def summary(rows: list[Row]) -> dict[str, Any]:
    """Return the aims, computed from the rows that are available so far."""
    works = [row["work"] for row in rows if row["up"]]
    is_complete = {row["body"] for row in rows} >= set(BODIES)
    aims = {
        "all_get_up": all(row["up"] for row in rows) if is_complete else None,
        "calm": (float(np.median(works)) <= MAX_MEDIAN_WORK if works else False) if is_complete else None,
        "audit": all(row.get("audit") is None for row in rows),
    }
    return {"aims": aims, "why_null": {name: "not all bodies were run" for name, aim in aims.items() if aim is None}}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the cells and print the table."""
    parser = flags(__doc__, quick="three bodies, tilted by 90 degrees", device="cpu")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--nodes", type=int, default=150, help="approximate number of nodes of the cages")
    parser.add_argument("--bodies", nargs="*", help="run only these bodies")
    parser.add_argument("--degrees", nargs="*", type=float, help="run only these tilts")
    options = parser.parse_args(arguments)
    chosen = options.bodies or (BODIES[:3] if options.quick else BODIES)
    angles = options.degrees or ((90.0,) if options.quick else DEGREES)
    cells = [(name, degrees, side) for name in chosen for degrees in angles for side in SIDES]
    os.environ["OMP_NUM_THREADS"] = "1"
    rows: list[Row] = []
    table = Table(body="<10", degrees=".0f", side="<5", tries="d", work=".1f", time=".1f", seconds=".0f", outcome="<7")
    with ProcessPoolExecutor(options.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for future in as_completed([pool.submit(run, *cell, options.nodes) for cell in cells]):
            rows.append(row := future.result())
            outcome = row["reason"] or row["audit"] or "up"
            figures = [row.get(key) for key in ("work", "time", "seconds")]
            table.row(row["body"], row["degrees"], row["side"], row["tries"], *figures, outcome)
            record(options, rows, **summary(rows))
    print(f"{sum(row['up'] for row in rows)} of {len(rows)} get up")
    report(options, rows, **summary(rows))


if __name__ == "__main__":
    main()
