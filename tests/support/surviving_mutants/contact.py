"""Surviving mutants of ``contact`` and its kernels."""

from __future__ import annotations

from tests.support.surviving_mutants.survivor import Survivor

CONTACT = [
    Survivor(
        "kernels/contact/coulomb.py",
        "elif trial[1] < (real(1.0) - _MIN_DECREASE * length) * residual[1]:",
        "elif trial[1] < (real(1.0) + _MIN_DECREASE * length) * residual[1]:",
        "a step that is worse by a ten-thousandth is gone on from, but the best forces so far are what comes out",
    ),
    Survivor(
        "contact/detection.py",
        "_BISECTIONS = 40",
        "_BISECTIONS = 39",
        "halving 39 times ends an arm 2e-12 of its length from the ground, 40 times 1e-12",
    ),
    Survivor(
        "contact/selection.py",
        "lowest = self._lowest(gaps < self.activation_distance, gaps)",
        "lowest = self._lowest(gaps <= self.activation_distance, gaps)",
        "a gap that is the very bound is as near",
    ),
    Survivor(
        "kernels/contact/coulomb.py",
        "sweeps = _FEW_SWEEPS",
        "sweeps = - _FEW_SWEEPS",
        "whether sweeps lead to Newton's start changes the way, not the forces at the end",
    ),
    Survivor(
        "kernels/contact/gaps.py",
        "if gap > solid_gap:",
        "if gap >= solid_gap:",
        "a point that is as high above two faces may be held to either",
    ),
    Survivor(
        "contact/detection.py",
        "if len(members) > 8:",
        "if len(members) > 7:",
        "the hull of eight points has the deepest of them, as the eight have",
    ),
    Survivor(
        "contact/detection.py",
        "low = np.where(field.heights(means + arms) >= 0.0, 1.0, low)",
        "low = np.where(field.heights(means + arms) >= 1.0, 1.0, low)",
        "an arm that ends less than a metre up is halved to within 1e-12 of its whole length",
    ),
    Survivor(
        "contact/detection.py",
        "arms /= max(float(np.abs(arms).max()), 1e-300)",
        "arms /= max(float(np.abs(arms).max()), -1.0)",
        "it keeps from dividing by nothing, and no point has only arms of no length",
    ),
    Survivor(
        "contact/batch_contacts.py",
        "points.scatter_(1, torch.where(selected, columns, capacity), torch.where(selected, numbers, 0))",
        "points.scatter_(1, torch.where(selected, columns, capacity), torch.where(selected, numbers, 1))",
        "what is not chosen goes into the column behind the last place, which is cut off",
    ),
    Survivor(
        "contact/batch_step.py",
        "limit = ((1.0 - 1e-4 * length) * maximum[waiting]).clamp(min=self.tolerance)",
        "limit = ((1.0 - 1e-4 % length) * maximum[waiting]).clamp(min=self.tolerance)",
        "the same for whole steps; half a step may be worse by a ten-thousandth where less is asked for",
    ),
    Survivor(
        "contact/batch_contacts.py",
        "matrices = start.new_empty((worlds, size, (size + 4) // 4, 4))",
        "matrices = start.new_empty((worlds, size, (size + 4) // 3, 4))",
        "room for a few numbers more",
    ),
    Survivor(
        "kernels/contact/height_field.py",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(-2.0), real(columns) + real(2.0))",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(-2.0), real(columns) + real( 1.0))",
        "far out the edge goes on, so where exactly is of no account",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "trace = contacts.delassus[n, n] + contacts.delassus[n + 1, n + 1] + contacts.delassus[n + 2, n + 2]",
        "trace = contacts.delassus[n, n] + contacts.delassus[n / 1, n + 1] + contacts.delassus[n + 2, n + 2]",
        "a scale by which forces are projected: any does",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "first = forces[n + 1] - rate * newton.velocities[n + 1]",
        "first = forces[n + 1] - rate * newton.velocities[n * 1]",
        "it is only asked whether both are nothing, as they are where a contact has never borne",
    ),
    Survivor(
        "kernels/contact/coulomb.py",
        "_FULL_STEPS = wp.constant(12)",
        "_FULL_STEPS = wp.constant( 13)",
        "how many bold steps are tried before shorter ones: one more",
    ),
    Survivor(
        "kernels/contact/height_field.py",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(-2.0), real(columns) + real(2.0))",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(- 1.0), real(columns) + real(2.0))",
        "far out the edge goes on, so where exactly is of no account",
    ),
    Survivor(
        "contact/batch_step.py",
        "sinking = torch.where(gaps < task.start_gaps - allowed, gaps, 0.0)",
        "sinking = torch.where(gaps < task.start_gaps - allowed, gaps, 1.0)",
        "what does not sink joins neither at 0 nor at a metre: only what is deep does",
    ),
    Survivor(
        "contact/batch_step.py",
        "slow = self._newton_step(part, search, response.subset(active), first=iteration == 1)",
        "slow = self._newton_step(part, search, response.subset(active), first=iteration == 0)",
        "in the first iteration there is no residual to undercut yet: any finite one is less",
    ),
    Survivor(
        "contact/batch_step.py",
        "while length > MIN_STEP_LENGTH and len(waiting) > 0:",
        "while length > MIN_STEP_LENGTH and len(waiting) != 0:",
        "a count is never less than nothing",
    ),
    Survivor(
        "contact/coulomb.py",
        "scratch_shapes = ((1, 5, size), real), ((1, 2, size), int), ((1, size, (size + 4) // 4), Vec4)",
        "scratch_shapes = ((1, 5, size), real), (( 2, 2, size), int), ((1, size, (size + 4) // 4), Vec4)",
        "room for numbers that nothing reads",
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
        "3 sweeps and 16 steps in the first attempt, or 20 and 12: the way changes, not the forces at the end",
    ),
    Survivor(
        "kernels/contact/coulomb.py",
        "break",
        "continue",
        "more attempts where one has found the forces: slower, to the same end",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "if forces[n] <= real(0.0) and first * first + second * second > real(0.0):",
        "if forces[n] <= real(0.0) and first * first + second * second > real( 1.0):",
        "whether tangents of a contact that bears nothing are known at once or solved for with the rest: the same step",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "if forces[n] <= real(0.0) and first * first + second * second > real(0.0):",
        "if forces[n] <= real(0.0) and first ** first + second * second > real(0.0):",
        "whether tangents of a contact that bears nothing are known at once or solved for with the rest: the same step",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "newton.step[n + 1] = real(0.0)",
        "newton.step[n * 1] = real(0.0)",
        "a contact that opens is left to the sweeps of the next attempt: of 1,720 problems 22 stay unsolved, not 21",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "newton.step[n + 2] = real(0.0)",
        "newton.step[n + 1] = real(0.0)",
        "no step is left where the next one is sought: it is nothing already",
    ),
]
