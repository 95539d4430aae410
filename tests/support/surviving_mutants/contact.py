"""Surviving mutants of ``contact`` and its kernels."""

from __future__ import annotations

from tests.support.surviving_mutants.survivor import Survivor

CONTACT = [
    Survivor(
        "kernels/contact/coulomb.py",
        "elif trial[1] < (real(1.0) - _MIN_DECREASE * length) * residual[1]:",
        "elif trial[1] < (real(1.0) + _MIN_DECREASE * length) * residual[1]:",
        "a step that is worse by a ten-thousandth is accepted, but the best forces so far are returned",
    ),
    Survivor(
        "contact/detection.py",
        "_BISECTIONS = 40",
        "_BISECTIONS = 39",
        "39 bisections end an arm within 2e-12 of its length from the ground, 40 within 1e-12",
    ),
    Survivor(
        "kernels/contact/coulomb.py",
        "sweeps = _FEW_SWEEPS",
        "sweeps = - _FEW_SWEEPS",
        "without sweeps Newton's method starts elsewhere and ends at the same forces",
    ),
    Survivor(
        "kernels/contact/gaps.py",
        "if gap > solid_gap:",
        "if gap >= solid_gap:",
        "a point at the same height above two faces may be assigned to either",
    ),
    Survivor(
        "contact/detection.py",
        "if len(members) > 8:",
        "if len(members) > 7:",
        "the deepest of eight points is also a vertex of their hull",
    ),
    Survivor(
        "contact/detection.py",
        "low = np.where(field.heights(means + arms) >= 0.0, 1.0, low)",
        "low = np.where(field.heights(means + arms) >= 1.0, 1.0, low)",
        "an arm that ends less than a metre above the ground is bisected to within 1e-12 of its full length",
    ),
    Survivor(
        "contact/detection.py",
        "arms /= max(float(np.abs(arms).max()), 1e-300)",
        "arms /= max(float(np.abs(arms).max()), -1.0)",
        "the bound only avoids a division by zero, but no tetrahedron has all its points at their mean",
    ),
    Survivor(
        "contact/coulomb.py",
        "matrices = start.new_empty((worlds, size, (size + 4) // 4, 4))",
        "matrices = start.new_empty((worlds, size, (size + 4) // 3, 4))",
        "capacity for a few more numbers",
    ),
    Survivor(
        "kernels/contact/height_field.py",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(-2.0), real(columns) + real(2.0))",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(-2.0), real(columns) + real( 1.0))",
        "far outside, the edge value extends without limit, so the clamp changes nothing",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "trace = contacts.delassus[n, n] + contacts.delassus[n + 1, n + 1] + contacts.delassus[n + 2, n + 2]",
        "trace = contacts.delassus[n, n] + contacts.delassus[n / 1, n + 1] + contacts.delassus[n + 2, n + 2]",
        "it scales the projection rate, and any rate is valid",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "first = forces[n + 1] - rate * newton.velocities[n + 1]",
        "first = forces[n + 1] - rate * newton.velocities[n * 1]",
        "only the test whether both are zero uses it, as they are for a contact that was never loaded",
    ),
    Survivor(
        "kernels/contact/coulomb.py",
        "_FULL_STEPS = wp.constant(12)",
        "_FULL_STEPS = wp.constant( 13)",
        "one more full step is tried in an attempt",
    ),
    Survivor(
        "kernels/contact/height_field.py",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(-2.0), real(columns) + real(2.0))",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(- 1.0), real(columns) + real(2.0))",
        "far outside, the edge value extends without limit, so the clamp changes nothing",
    ),
    Survivor(
        "contact/coulomb.py",
        "scratch_shapes = ((1, 5, size), real), ((1, 2, size), int), ((1, size, (size + 4) // 4), Vec4)",
        "scratch_shapes = ((1, 5, size), real), (( 2, 2, size), int), ((1, size, (size + 4) // 4), Vec4)",
        "capacity for numbers that nothing reads",
    ),
    Survivor(
        "kernels/contact/coulomb.py",
        "if newton.lane == 0:",
        "if newton.lane >= 0:",
        "on a CPU there is one lane, whose number is 0",
    ),
    Survivor(
        "kernels/contact/coulomb.py",
        "if attempt == 0:",
        "if attempt == -1:",
        "3 sweeps and 16 steps in the first attempt, or 20 and 12: the iterates change, the forces at the end do not",
    ),
    Survivor(
        "kernels/contact/coulomb.py",
        "break",
        "continue",
        "more attempts after one has converged: slower, with the same result",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "if forces[n] <= real(0.0) and first * first + second * second > real(0.0):",
        "if forces[n] <= real(0.0) and first * first + second * second > real( 1.0):",
        "tangents of an unloaded contact are set directly or solved for with the rest: the same step",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "if forces[n] <= real(0.0) and first * first + second * second > real(0.0):",
        "if forces[n] <= real(0.0) and first ** first + second * second > real(0.0):",
        "tangents of an unloaded contact are set directly or solved for with the rest: the same step",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "newton.step[n + 1] = real(0.0)",
        "newton.step[n * 1] = real(0.0)",
        "a contact that opens is left to the sweeps of the next attempt: 22 of 1,720 problems stay unsolved, not 21",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "newton.step[n + 2] = real(0.0)",
        "newton.step[n + 1] = real(0.0)",
        "the step is already zero before the next one is computed",
    ),
]
