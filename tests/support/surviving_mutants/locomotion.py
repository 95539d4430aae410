"""Surviving mutants of ``locomotion`` and its kernels."""

from __future__ import annotations

from tests.support.surviving_mutants.survivor import Survivor

LOCOMOTION = [
    Survivor(
        "locomotion/strategies.py",
        "def is_within_gap(self, factor: float, share: float = 0.0) -> bool:",
        "def is_within_gap(self, factor: float, share: float = -1.0) -> bool:",
        "the bound is a sum of squares and the factor at least one, so the term with the factor is the maximum",
    ),
    Survivor(
        "locomotion/lemke.py",
        "return int(rows[basis[rows] == cover][0])",
        "return int(rows[basis[rows] == cover][ -1])",
        "no variable is in the basis twice, so there is one such row",
    ),
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
        "locomotion/contact_modes.py",
        "if len(active) > 1:",
        "if len(active) > 2:",
        "one neighbour fewer is tested",
    ),
    Survivor(
        "locomotion/lemke.py",
        "tableau = dger(-1.0, column, pivot_row, a=tableau, overwrite_a=True)",
        "tableau = dger(-1.0, column, pivot_row, a=tableau, overwrite_a=False)",
        "it only changes whether memory is overwritten: the caller uses the returned array",
    ),
    Survivor(
        "locomotion/operator_splitting.py",
        "verbose=False,",
        "verbose=True,",
        "the solver prints its progress",
    ),
    Survivor(
        "kernels/locomotion/active_set.py",
        "for row in range(search.side.shape[0]):",
        "for row in range(search.side.shape[ 1]):",
        "reached only if rounding makes the factor of a subset of rows fail that have one together",
    ),
    Survivor(
        "locomotion/audit.py",
        "if len(points) == 0:",
        "if len(points) <= 0:",
        "a count is never less than nothing",
    ),
    Survivor(
        "locomotion/batch.py",
        "break",
        "continue",
        "one more iteration, which has nothing to do",
    ),
    Survivor(
        "locomotion/lemke.py",
        "rows = rows[ratios <= low + 1e-12 * max(1.0, abs(low))]",
        "rows = rows[ratios <= low + 1e-12 * max( 0.0, abs(low))]",
        "it changes ties at zero: 1,950 degenerate problems all have the same solution",
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
        "the libraries are searched again each time, in some milliseconds, with the same result",
    ),
]
