"""Effect of numerical choices within a step, measured in every step of the pawn's jump.

python benchmarks/step.py [--quick] [--device cpu] [--seed 0] [--json PATH] [--plot PATH]

There are three tables. Newton iterations: their number in the jump and, with the true and with the projected Hessian of
the elements, in the same steps repeated with the known activations. Contact velocities: the difference between the
velocities linearised for a step's activations and the solved velocities, with the tangent at the rigid initial guess
and at the predicted end (rms and maximum over the loaded contacts of all steps, m/s; the pawn is 1 m tall). Factors:
the time to factor a step's matrix and to solve for one right-hand side per muscle and contact row, with our
factorisation and with SciPy's SuperLU. This benchmark has no aim.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

from egs_warp.assets import pawn
from egs_warp.contact.newton import ContactLinearization
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.fem.multifrontal import MultifrontalLdl
from egs_warp.fem.step_problem import StepProblem
from egs_warp.locomotion.stepper import StepReport, WarmStart
from egs_warp.motions.script import motion
from egs_warp.muscles.tension import MuscleEnergy
from egs_warp.pipelines.creature import Creature, make_creature
from egs_warp.pipelines.simulated_run import simulate
from harness import Row, Table, flags, median_ms, report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLACES = ("ground", "flight")


def iterations(creature: Creature, before: StepReport, step: StepReport) -> Row:
    """Count the Newton iterations of one step with each Hessian."""

    def repeated() -> int:
        memory = memory_of(before)
        report = creature.stepper.step_with_activations(before.state, memory, step.activations, step.dt)
        return report.newton_iterations

    hessian_entries = ElasticAssembly.hessian_entries

    def projected(assembly: ElasticAssembly, *arguments: Any, **options: Any) -> np.ndarray:
        return hessian_entries(assembly, *arguments, **{**options, "projected": True})

    figures = {"in the jump": step.newton_iterations, "true": repeated()}
    with patch.object(ElasticAssembly, "hessian_entries", projected):
        return {**figures, "projected": repeated()}


def memory_of(step: StepReport) -> WarmStart:
    """Return the warm start that a step provides for the next one."""
    return WarmStart(step.contacts.points, step.forces, step.activations)


def contact_errors(creature: Creature, before: StepReport, step: StepReport) -> dict[str, np.ndarray]:
    """Return the errors (3k,), m/s, of the linearised velocities of the k loaded contacts, for each point of
    linearisation."""
    stepper, contacts, muscles = creature.stepper, step.contacts, creature.muscles
    problem = StepProblem(creature.body, before.state, step.dt)
    predicted = stepper.predict(stepper.step_inputs(problem, contacts, memory_of(before))).velocities
    factors = MultifrontalLdl(creature.body.assembly.upper_pattern)
    now = MuscleEnergy.of(muscles, step.activations)
    loaded = np.repeat(step.forces[:, 0] > 0.0, 3)
    errors = {}
    for place, velocities in (("rigid start", problem.rigid_guess), ("predicted end", predicted)):
        tangent = problem.tangent(factors, velocities, None)
        response = ContactLinearization.of(tangent, contacts)
        free = velocities.ravel() - tangent.solve(problem.residual(velocities, now).ravel())
        shift = stepper.solver.normal_bias(contacts, step.dt)
        forces, _ = response.solve_coulomb(
            contacts.contact_velocities(free), shift, creature.geometry.friction, step.forces
        )
        expected = free + response.columns @ forces.ravel()
        errors[place] = (contacts.jacobian @ (expected - step.state.velocities.ravel()))[loaded]
    return errors


def factor_times(creature: Creature, repeats: int) -> list[Row]:
    """Time the factorisation and solution of a step's matrix, ms, with our factorisation and with SuperLU."""
    assembly, body = creature.body.assembly, creature.body
    entries = assembly.hessian_entries(creature.start.positions, factor=(1.0 / 60.0) ** 2)
    entries[assembly.diagonal_entries] += np.repeat(body.node_mass, 3)
    upper = assembly.matrix(entries)
    full = (upper + sparse.triu(upper, 1).T).tocsc()
    right = np.random.default_rng(0).standard_normal((full.shape[0], creature.muscles.segment_count + 3 * 32))
    ours, theirs = MultifrontalLdl(assembly.upper_pattern), splu(full)
    ours.factor(entries)
    milliseconds = median_ms(
        {
            "ours factor": lambda: ours.factor(entries),
            "ours solve": lambda: ours.solve(right),
            "SuperLU factor": lambda: splu(full),
            "SuperLU solve": lambda: theirs.solve(right),
        },
        repeats=repeats,
    )
    return [
        {
            "solver": solver,
            "unknowns": full.shape[0],
            "right_hand_sides": right.shape[1],
            "factor": milliseconds[f"{solver} factor"],
            "solve": milliseconds[f"{solver} solve"],
        }
        for solver in ("ours", "SuperLU")
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    options = flags(
        __doc__, quick="every fourth step", device="cpu", seed="not used: nothing here is random"
    ).parse_args(arguments)
    scene = pawn(device=options.device)
    creature = make_creature(scene.cloud, plane=scene.plane)
    reports = simulate(creature, motion("jump")).simulation.reports
    pairs = list(pairwise(reports))[:: 4 if options.quick else 1]
    counts = [(step.contacts.count == 0, iterations(creature, before, step)) for before, step in pairs]
    rows: list[Row] = []
    table = Table(Hessian="<10", ground_mean=".1f", ground_worst="d", flight_mean=".1f", flight_worst="d")
    for hessian in counts[0][1]:
        counts_by_place = {
            place: [one[hessian] for flies, one in counts if flies == (place == "flight")] for place in PLACES
        }
        row: Row = {"hessian": hessian}
        for place, numbers in counts_by_place.items():
            row |= {f"{place}_mean": float(np.mean(numbers)), f"{place}_worst": max(numbers)}
        rows.append(row)
        table.row(*row.values())
    errors = [contact_errors(creature, before, step) for before, step in pairs if step.contacts.count > 0]
    speeds: list[Row] = []
    table = Table(tangent_at="<14", rms=".1e", largest=".1e")
    for place in errors[0]:
        error = np.concatenate([one[place] for one in errors])
        rms = float(np.sqrt(np.mean(error**2)))
        speeds.append({"tangent_at": place, "rms": rms, "largest": float(np.abs(error).max())})
        table.row(*speeds[-1].values())
    factors = factor_times(creature, 5 if options.quick else 20)
    table = Table(solver="<8", unknowns="d", right_hand_sides="d", factor_ms=".1f", solve_ms=".1f")
    for row in factors:
        table.row(*row.values())

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for hessian in counts[0][1]:
            axes.plot([one[hessian] for _, one in counts], label=hessian)
        axes.set(xlabel="step", ylabel="Newton iterations")
        axes.legend()

    report(options, rows, contact_speeds=speeds, factors=factors, aims={}, draw=draw)


if __name__ == "__main__":
    main()
