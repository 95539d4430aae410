"""Motions of many bodies with one setting for all: walk ahead, walk to a point, turn, twist, jump, stand and be pushed.

python benchmarks/gaits.py [--quick] [--workers 2] [--nodes 500] [--bodies NAME ...] [--cells NAME ...] [--unseen]
    [--captures FOLDER] [--json PATH] [--join PATH]

A cell is one body with one motion. A walk succeeds if it ends upright within 0.1 body heights and 10 degrees of the
target, within 60 sqrt(H/g); a twist succeeds if it ends within 10 degrees after at most two jumps; a standard jump
succeeds if its height and distance are within 15 % of the request. A body that stands and is pushed by 0.1 m sqrt(g H)
from the side succeeds if it ends upright and no sole was ever more than 0.1 body heights from its initial position. A
body that is pushed by 1 m sqrt(g H) at 0.8 of its height succeeds if it stands at the end, possibly after getting up.
Slip is the displacement of a foot while it is on the ground, divided by the stride. Cost of transport is the muscles'
work divided by m g times the distance.

If a body falls, the motion is simulated again in a gentler form, as with ``egs-warp animate``. A cell that succeeds
only in a later take counts for ``success_rate_with_retakes``, not for ``success_rate``, and the table names the take.

A motion that is rejected with an error is counted as a failure; getting up is counted separately and has no aim. A ball
is judged by its position and, if it does not roll, by its heading. Captures are included if they are available on this
machine. ``--unseen`` runs five bodies that were not used during the development of the motions, ``--captures`` runs the
bodies of a folder written by ``trained_bodies.py``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmark_bodies import NAMES, Body, body
from egs_warp.errors import ArgumentError, UserError
from egs_warp.io import read_capture
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.trajectory import measure
from egs_warp.motions.feet import SupportKind
from egs_warp.motions.push import read_pushes
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from egs_warp.pipelines.simulated_run import SimulatedRun
from egs_warp.pipelines.takes import simulate_takes
from egs_warp.segmentation.base_plane import find_base_plane
from harness import Row, Table, flags, record, report, rows_of, timed, workers_flag
from modelled import MODELLED, UNSEEN, modelled
from sweep import bounds_broken, judge

CELLS = {
    "walk": "walk 2",
    "walk to": "walk to 0.75,1.299",
    "turn": "turn 90",
    "twist": "twist 90",
    "jump": "jump",
    "push": "stand 2",
    "get up": "stand 1",
}
QUICK = {"walk": "walk 0.3", "turn": "turn 30"}
PUSHES = {"push": "0.5 0.1 left", "get up": "0.2 1 left 0.8"}
CAPTURED = ("plush dog", "monkey", "robot", "koala", "fox", "armchair", "cat", "spot")
POSITION_TOLERANCE, ANGLE_TOLERANCE, MAX_TIME = 0.1, 10.0, 60.0
"""Maximum errors of the position (body heights) and of angles (degrees), and maximum time (sqrt(H / g))."""
MAX_RISEN_TILT = 15.0
"""Maximum tilt of a body that has got up, degrees."""


def names() -> list[str]:
    """Return the names of the bodies that are available on this machine."""
    return ["pawn", "figurine", "stool", *(name for name in CAPTURED if name in NAMES), *MODELLED]


def run(name: str, cell: str, text: str, nodes: int, captures: Path | None) -> Row:
    """Simulate one cell and judge it; with ``captures`` the body is read from that folder."""
    wp.config.log_level = wp.LOG_WARNING
    judged, milliseconds = timed(_run, name, cell, text, nodes, captures)
    return {"body": name, "cell": cell, "motion": text, **judged, "seconds": 1e-3 * milliseconds}


def _run(name: str, cell: str, text: str, nodes: int, captures: Path | None) -> Row:
    try:
        one = _body(name, captures)
        creature = creature_of(one, nodes)
        unit = float(np.sqrt(creature.body.height / np.linalg.norm(creature.body.gravity)))
        performance, takes = simulate_takes(
            creature,
            motion(text),
            pushes=read_pushes(PUSHES[cell]) if cell in PUSHES else (),
            get_up=cell == "get up",
            max_seconds=(MAX_TIME + 1.0) * unit,
        )
    except (UserError, FileNotFoundError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return {"success": False, "reason": f"stopped: {error}"}
    trajectory, place = performance.trajectory, performance.place
    feet = place.feet()
    stands = place.base()
    height, gravity = creature.body.height, float(np.linalg.norm(creature.body.gravity))
    balance = energy_balance(trajectory)
    work = float(balance.muscle_work.sum() / balance.energy_unit)
    moved = _moved(performance)
    distance = float(np.linalg.norm(moved[:2]))
    (done,) = performance.sequence.done[:1]
    own = done.motion.outcome_record(trajectory, 0, len(trajectory.time) - 1)
    reached: dict[str, Any] = asdict(measure(trajectory)) | (asdict(own) if own is not None else {})
    if stands is SupportKind.ROUND_BASE:
        # A ball has no upright pose, and a heading only while it does not roll.
        reached["tilt_degrees"] = 0.0
        moved[2] = moved[2] if cell in ("turn", "twist") else 0.0
    checked = asdict(audit(trajectory, newton_unconverged=sum(not r.converged for r in performance.simulation.reports)))
    time = float(trajectory.time[-1]) * float(np.sqrt(gravity / height))
    reason = f"fell: {performance.fallen}" if performance.fallen else bounds_broken(checked)
    if cell == "get up":
        reason = reason or _get_up_failure(performance, reached)
    elif cell == "push":
        reason = reason or _push_failure(reached)
    elif cell in ("twist", "jump"):
        reason = reason or judge(cell, {"distance": 0.0, "height": 0.2, **done.asked}, reached)
    else:
        reason = reason or _walk_failure(dict(done.asked), moved, reached, time)
    return {
        "success": reason is None and not takes,
        "success_with_retakes": reason is None,
        "take": takes[-1].change if takes else None,
        "reason": reason,
        "stands_on": f"{len(feet)} feet" if stands is SupportKind.FEET else stands.value,
        "moved": moved.tolist(),
        "time": time,
        "tilt_degrees": reached["tilt_degrees"],
        "slip": reached.get("slip") if stands is SupportKind.FEET else None,
        "work": work,
        "cost_of_transport": work / distance if cell in ("walk", "walk to") and distance > POSITION_TOLERANCE else None,
        "fallen": performance.fallen
        or next((entry.fall_note for entry in performance.sequence.done if entry.fall_note is not None), None),
        "got_up": [entry.fall_note for entry in performance.sequence.done if entry.got_up],
    }


def _body(name: str, captures: Path | None) -> Body:
    if captures is not None:
        cloud = read_capture(captures / f"{name}.ply", device="cpu").cloud
        return Body(name, cloud, find_base_plane(cloud, np.array([0.0, 0.0, 1.0])), str(captures))
    return modelled(name) if name in MODELLED or name in UNSEEN else body(name)


def creature_of(one: Body, nodes: int) -> Creature:
    """Build the creature with a cage of ``nodes`` nodes, or of twice as many if no such cage can be built."""
    try:
        return make_creature(one.cloud, plane=one.plane, options=CreatureOptions(nodes=nodes))
    except ArgumentError:
        return make_creature(one.cloud, plane=one.plane, options=CreatureOptions(nodes=2 * nodes))


def _moved(performance: SimulatedRun) -> np.ndarray:
    """Return (3,): the displacement of the centre of mass ahead and to the left in body heights, and the rotation in
    degrees."""
    trajectory, place, body_ = performance.trajectory, performance.place, performance.creature.body
    first, last = (body_.centre_of_mass(place.ground.local(trajectory.positions[k])) for k in (0, -1))
    return np.array([*((last - first)[:2] / body_.height), measure(trajectory).heading_degrees])


def _walk_failure(requested: dict[str, float], moved: np.ndarray, reached: dict[str, Any], time: float) -> str | None:
    goal = np.array([requested.get("ahead", requested["distance"]), requested.get("left", 0.0)])
    miss = float(np.linalg.norm(moved[:2] - goal))
    if reached["tilt_degrees"] >= ANGLE_TOLERANCE:
        return f"leans: tilt {reached['tilt_degrees']:.0f} degrees"
    if miss > POSITION_TOLERANCE:
        return f"{miss:.2f} body heights from the target"
    heading = requested.get("heading_degrees", 0.0 if "ahead" not in requested else None)
    if heading is not None and abs((moved[2] - heading + 180.0) % 360.0 - 180.0) > ANGLE_TOLERANCE:
        return f"turned {moved[2]:.0f} degrees"
    return f"took {time:.0f} sqrt(H/g)" if time > MAX_TIME else None


def _get_up_failure(performance: SimulatedRun, reached: dict[str, Any]) -> str | None:
    if reached["tilt_degrees"] >= MAX_RISEN_TILT:
        return f"leans: tilt {reached['tilt_degrees']:.0f} degrees"
    rose = all(entry.got_up for entry in performance.sequence.done if entry.fall_note is not None)
    return None if rose and performance.sequence.is_finished else "it did not get up in time"


def _push_failure(reached: dict[str, Any]) -> str | None:
    if reached["tilt_degrees"] >= ANGLE_TOLERANCE:
        return f"leans: tilt {reached['tilt_degrees']:.0f} degrees"
    return (
        f"a sole was {reached['sole_shift']:.2f} body heights off"
        if reached["sole_shift"] > POSITION_TOLERANCE
        else None
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the cells and print the table."""
    parser = flags(__doc__, quick="three bodies, short distances", device="cpu")
    workers_flag(parser)
    parser.add_argument("--nodes", type=int, default=500, help="approximate number of nodes of the cages")
    parser.add_argument("--bodies", nargs="*", help="run only these bodies")
    parser.add_argument("--unseen", action="store_true", help="run only the five held-out bodies")
    parser.add_argument("--captures", type=Path, metavar="FOLDER", help="run only its bodies NAME.ply, z up")
    parser.add_argument("--cells", nargs="*", help=f"run only these cells of {', '.join(CELLS)}")
    parser.add_argument("--join", type=Path, help="JSON of an earlier run of the same code: its rows are not run again")
    options = parser.parse_args(arguments)
    rows: list[Row] = json.loads(options.join.read_text())["rows"] if options.join else []
    cells_of_run = QUICK if options.quick else CELLS
    default = ["pawn", "stool", "biped"] if options.quick else names()
    captured = sorted(path.stem for path in options.captures.glob("*.ply")) if options.captures else []
    if options.captures and not captured:
        parser.error(f"--captures {options.captures}: contains no NAME.ply; trained_bodies.py writes such files")
    chosen = options.bodies or captured or (list(UNSEEN) if options.unseen else default)
    cells = [
        (name, cell, text)
        for cell, text in cells_of_run.items()
        for name in chosen
        if cell in (options.cells or cells_of_run)
    ]
    known = {(row["body"], row["cell"], row["motion"]) for row in rows}
    table = Table(body="<10", cell="<8", seconds=".0f", time=".0f", slip=".1%", cost=".1f", outcome="<7")
    new = [(*cell, options.nodes, options.captures) for cell in cells if cell not in known]
    for row in rows_of(run, new, options.workers):
        rows.append(row)
        figures = [row.get(key) for key in ("time", "slip", "cost_of_transport")]
        taken = f"success in the take {row['take']}" if row.get("take") else "success"
        table.row(row["body"], row["cell"], row["seconds"], *figures, row["reason"] or taken)
        record(options, rows, **summary(rows, whole=not options.quick))
    good = sum(row["success"] for row in rows)
    print(f"{good} of {len(rows)} cells succeed")
    report(options, rows, **summary(rows, whole=not options.quick))


def summary(rows: list[Row], *, whole: bool) -> dict[str, Any]:
    """Return the aims from the rows."""
    requested = [row["success"] for row in rows if row["cell"] != "get up"]
    rate = float(np.mean(requested)) if requested else 0.0
    retaken = [row.get("success_with_retakes", row["success"]) for row in rows if row["cell"] != "get up"]
    risen = [row["success"] for row in rows if row["cell"] == "get up"]
    slips = [row["slip"] for row in rows if row.get("slip") is not None and row["cell"] in ("walk", "walk to", "turn")]
    costs = [row["cost_of_transport"] for row in rows if row.get("cost_of_transport") is not None]
    fell = [row for row in rows if row.get("tilt_degrees", 0.0) > 60.0]
    pushed = [row["success"] for row in rows if row["cell"] == "push"]
    bodies = {row["body"] for row in rows}
    # Held-out bodies have aims of their own.
    is_complete = whole and (len(bodies) >= 14 or bodies == set(UNSEEN))
    why = "" if is_complete else "not all cells of 14 bodies, or of the unseen ones, were run"
    aims = {
        "succeed_90": rate >= 0.9 if is_complete else None,
        "slip": (max(slips) <= 0.03 if slips else None) if is_complete else None,
        "cost_of_transport": (max(costs) <= 3.0 if costs else None) if is_complete else None,
        "falls_reported": all(row["fallen"] for row in fell),
        "pushes": (all(pushed) if pushed else None) if is_complete else None,
    }
    nulls = {name: why or "no such cells were run" for name, value in aims.items() if value is None}
    return {
        "success_rate": rate,
        "success_rate_with_retakes": float(np.mean(retaken)) if retaken else 0.0,
        "got_up": sum(risen),
        "thrown_over": len(risen),
        "aims": aims,
        "why_null": nulls,
    }


if __name__ == "__main__":
    main()
