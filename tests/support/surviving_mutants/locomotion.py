"""Surviving mutants of ``locomotion`` and its kernels."""

from __future__ import annotations

from tests.support.surviving_mutants.survivor import Survivor

LOCOMOTION = [
    Survivor(
        "locomotion/active_set.py",
        "_INFEASIBLE_COST = 1e6",
        "_INFEASIBLE_COST = 1000001.0",
        "a bound far outside the relevant range, changed by a millionth",
    ),
    Survivor(
        "locomotion/planner.py",
        "if not problem.is_inversion_free(velocities):",
        "if not not problem.is_inversion_free(velocities):",
        "it changes the start of the search for the step's end, not its result",
    ),
    Survivor(
        "locomotion/solvers.py",
        "held = np.where(high - low < 1e-13, 5, 0).astype(np.int32)",
        "held = np.where(high - low < -0.9999999999999, 5, 0).astype(np.int32)",
        "an equality is passed to the solver as two bounds instead of one row",
    ),
    Survivor(
        "locomotion/operator_splitting.py",
        "verbose=False,",
        "verbose=True,",
        "the solver prints its progress",
    ),
    Survivor(
        "locomotion/audit.py",
        "if len(points) == 0:",
        "if len(points) <= 0:",
        "a count is never negative",
    ),
    Survivor(
        "locomotion/batch.py",
        "break",
        "continue",
        "one more iteration, which changes nothing",
    ),
    Survivor(
        "locomotion/solvers.py",
        "low, high = at - below < -multipliers, above - at < multipliers",
        "low, high = at - below < -multipliers, above - at != multipliers",
        "an initial guess: the search from any other ends at the same optimum",
    ),
    Survivor(
        "locomotion/synergies.py",
        "if muscles.segment_count <= max_count:",
        "if muscles.segment_count < max_count:",
        "with as many groups as muscles each muscle is its own group in both cases",
    ),
    Survivor(
        "locomotion/threads.py",
        "@cache",
        "",
        "the libraries are searched again each time, in a few milliseconds, with the same result",
    ),
]
