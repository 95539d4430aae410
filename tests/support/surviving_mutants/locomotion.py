"""Surviving mutants of ``locomotion`` and its kernels."""

from __future__ import annotations

from tests.support.surviving_mutants.survivor import Survivor

LOCOMOTION = [
    Survivor(
        "locomotion/strategies.py",
        "def is_within_gap(self, factor: float, share: float = 0.0) -> bool:",
        "def is_within_gap(self, factor: float, share: float = -1.0) -> bool:",
        "the bound is a sum of squares and the factor at least one: the factor's side of the maximum decides",
    ),
    Survivor(
        "locomotion/lemke.py",
        "return int(rows[basis[rows] == cover][0])",
        "return int(rows[basis[rows] == cover][ -1])",
        "no variable is in the basis twice: there is one such row",
    ),
    Survivor(
        "locomotion/active_set.py",
        "_HOPELESS = 1e6",
        "_HOPELESS = 1000001.0",
        "a bound that is far beyond all that matters, by a millionth farther",
    ),
    Survivor(
        "locomotion/planner.py",
        "if not problem.is_inversion_free(velocities):",
        "if not not problem.is_inversion_free(velocities):",
        "where the search for the step's end begins; it ends in the same place",
    ),
    Survivor(
        "locomotion/solvers.py",
        "held = np.where(high - low < 1e-13, 5, 0).astype(np.int32)",
        "held = np.where(high - low < -0.9999999999999, 5, 0).astype(np.int32)",
        "an equality is given to the solver as two bounds in place of one row",
    ),
    Survivor(
        "locomotion/contact_modes.py",
        "if len(active) > 1:",
        "if len(active) > 2:",
        "one neighbour fewer is looked at",
    ),
    Survivor(
        "locomotion/lemke.py",
        "tableau = dger(-1.0, column, pivot_row, a=tableau, overwrite_a=True)",
        "tableau = dger(-1.0, column, pivot_row, a=tableau, overwrite_a=False)",
        "whether memory is written over: the caller goes on with what is returned",
    ),
    Survivor(
        "locomotion/operator_splitting.py",
        "verbose=False,",
        "verbose=True,",
        "the solver prints what it does",
    ),
    Survivor(
        "kernels/locomotion/active_set.py",
        "for row in range(search.side.shape[0]):",
        "for row in range(search.side.shape[ 1]):",
        "reached only where rounding takes the factor from a part of rows that have one together",
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
        "it goes round once more and finds as little to do",
    ),
    Survivor(
        "locomotion/lemke.py",
        "rows = rows[ratios <= low + 1e-12 * max(1.0, abs(low))]",
        "rows = rows[ratios <= low + 1e-12 * max( 0.0, abs(low))]",
        "what ties at nothing: of 1,950 degenerate problems each ends in the same solution",
    ),
    Survivor(
        "locomotion/solvers.py",
        "low, high = at - below < -multipliers, above - at < multipliers",
        "low, high = at - below < -multipliers, above - at != multipliers",
        "a guess: the search from any other ends at the same optimum",
    ),
    Survivor(
        "locomotion/synergies.py",
        "if muscles.segment_count <= most:",
        "if muscles.segment_count < most:",
        "as many groups as muscles: each is one of its own either way",
    ),
    Survivor(
        "locomotion/threads.py",
        "@cache",
        "",
        "the libraries are looked for again each time, for some milliseconds, and are the same",
    ),
]
