"""Mutants that no test can kill, or none need kill, each with its reason: ``make mutation`` counts them apart."""

from __future__ import annotations

from dataclasses import dataclass

from tests.support.mutants import Mutant


@dataclass(frozen=True)
class Survivor:
    """A line that may change so."""

    file: str
    """Of the package."""
    before: str
    after: str
    reason: str


SURVIVORS: list[Survivor] = [
    Survivor(
        "kernels/contact/coulomb.py",
        "if trial[1] < (real(1.0) - _LESS * length) * size[1]:",
        "if trial[1] < (real(1.0) + _LESS * length) * size[1]:",
        "a step that is worse by a ten-thousandth is gone on from, but the best forces so far are what comes out",
    ),
    Survivor(
        "contact/detection.py",
        "_SHORTENINGS = 40",
        "_SHORTENINGS = 39",
        "halving 39 times ends an arm 2e-12 of its length from the ground, 40 times 1e-12",
    ),
    Survivor(
        "fem/elasticity.py",
        "self._no_gradients, self._no_pulls = empty(0, Mat33, device), empty(0, Vec3, device)",
        "self._no_gradients, self._no_pulls = empty( 1, Mat33, device), empty(0, Vec3, device)",
        "it stands in for an array that no kernel reads without damping",
    ),
    Survivor(
        "kernels/deformation/embedding.py",
        "if vb <= real(0.0) and d2 >= real(0.0) and d6 <= real(0.0):",
        "if vb < real(0.0) and d2 >= real(0.0) and d6 <= real(0.0):",
        "on the boundary of two cases both give the same point of the triangle",
    ),
    Survivor(
        "kernels/deformation/embedding.py",
        "if weights[3] < real(0.0):",
        "if weights[3] <= real(0.0):",
        "one more face is looked at, to which the distance is never less than that to the nearest",
    ),
    Survivor(
        "locomotion/strategies.py",
        "def within(self, factor: float, share: float = 0.0) -> bool:",
        "def within(self, factor: float, share: float = -1.0) -> bool:",
        "the bound is a sum of squares and the factor at least one: the factor's side of the maximum decides",
    ),
    Survivor(
        "contact/coupled_step.py",
        "SLOW = 0.5",
        "SLOW = -0.5",
        "a new tangent in every iteration: slower, to the same end",
    ),
    Survivor(
        "contact/points.py",
        "lowest = self._lowest(np.flatnonzero(gaps < self.near), gaps)",
        "lowest = self._lowest(np.flatnonzero(gaps <= self.near), gaps)",
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
        "fem/body.py",
        "column = ElasticAssembly(mesh, Material(young, poisson_ratio, density, 0.0), device=device)",
        "column = ElasticAssembly(mesh, Material(young, poisson_ratio, density, -1.0), device=device)",
        "the column is loaded at rest, where nothing is damped",
    ),
    Survivor(
        "fem/elasticity.py",
        "offsets = np.searchsorted(inverse[order], np.arange(len(blocks) + 1))",
        "offsets = np.searchsorted(inverse[order], np.arange(len(blocks) + 2))",
        "one offset more, the last one again, which bounds nothing",
    ),
    Survivor(
        "fem/sparse_factors.py",
        'self._symbolic = rslab.analyze(full, path="ldlt", threads=1)',
        'self._symbolic = rslab.analyze(full, path="ldlt", threads= 2)',
        "threads do not change the order that is found",
    ),
    Survivor(
        "deformation/embedding.py",
        "points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)",
        "points = np.ascontiguousarray(points, dtype=np.float64).reshape(- 2, 3)",
        "any negative number is the side that is left open",
    ),
    Survivor(
        "kernels/deformation/decomposition.py",
        "MAX_SWEEPS = wp.constant(8)",
        "MAX_SWEEPS = wp.constant( 9)",
        "eight sweeps have converged, the ninth changes nothing",
    ),
    Survivor(
        "kernels/deformation/embedding.py",
        "if attempt == MAX_ARM_LENGTHS or real(arm) * ARM_SHORTENING < least_arm:",
        "if attempt >= MAX_ARM_LENGTHS or real(arm) * ARM_SHORTENING < least_arm:",
        "it counts up to the bound by ones",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        "few = random.choice(len(points), min(2000, len(points)), replace=False)",
        "few = random.choice(len(points), min(2000, len(points)), replace=True)",
        "a guess from points of which some are drawn twice is as good",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        "lambda x, of=of: pixels.residuals(of(x)), np.zeros(3), loss=name, f_scale=scale, x_scale=0.01",
        "lambda x, of=of: pixels.residuals(of(x)), np.zeros( 4), loss=name, f_scale=scale, x_scale=0.01",
        "a fourth unknown that nothing hangs on stays nothing",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        "camera = np.where(np.abs(camera) < least, least, camera)",
        "camera = np.where(np.abs(camera) <= least, least, camera)",
        "a number that is the very bound is replaced by it",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        'plane = _refined(pixels, guess, lambda scale: ("soft_l1", scale), rounds=1)',
        'plane = _refined(pixels, guess, lambda scale: ("soft_l1", scale), rounds= 2)',
        "one round more of the rough fit from which the last one starts",
    ),
    Survivor(
        "segmentation/base_plane.py",
        "peaks = 1 + np.flatnonzero((inner >= density[:-2]) & (inner > density[2:]) & (inner > 0.5 * density.max()))",
        "peaks = 2 + np.flatnonzero((inner >= density[:-2]) & (inner > density[2:]) & (inner > 0.5 * density.max()))",
        "the next of 501 levels; what is counted to the peak reaches fifteen of them",
    ),
    Survivor(
        "segmentation/clearance.py",
        "seed: int = 0",
        "seed: int = 1",
        "another draw, as good",
    ),
    Survivor(
        "segmentation/object_mask.py",
        "lying = core & scene.level & (scene.heights < 3.0 * foot) & (not spec.masks)",
        "lying = core & scene.level & (scene.heights <= 3.0 * foot) & (not spec.masks)",
        "a height that is the very bound",
    ),
    Survivor(
        "segmentation/clearance.py",
        "iterations: int = 100",
        "iterations: int = 99",
        "a default: one step of a hundred less",
    ),
    Survivor(
        "segmentation/clearance.py",
        "return ring_cameras(plane, centre, 1.1 * radius, elevations=(1.0, 10.0, 25.0), size=size)",
        "return ring_cameras(plane, centre, 1.1 * radius, elevations=(1.0, 10.0, 24.0), size=size)",
        "a third of the cameras stand a degree lower, and see as much",
    ),
    Survivor(
        "segmentation/ground.py",
        "_ELEVATIONS = (40.0, 58.0, 75.0)",
        "_ELEVATIONS = ( 39.0, 58.0, 75.0)",
        "a third of the cameras stand a degree lower, and see as much",
    ),
    Survivor(
        "segmentation/ground.py",
        "above = ring_cameras(plane, middle, 1.2 * size, count=_VIEWS - 1, elevations=_ELEVATIONS, size=_SIDE)",
        "above = ring_cameras(plane, middle, 1.2 * size, count=_VIEWS - 0, elevations=_ELEVATIONS, size=_SIDE)",
        "a view more of the ground than fifteen",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        "if plane.heights(pixels.origins[0]) < 0.0:",
        "if plane.heights(pixels.origins[ -1]) < 0.0:",
        "the side of the cameras is that of any of them: what is looked at from both sides has none",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        "scale = max(float(np.quantile(residual, 0.3)) / 0.566, 1e-7)",
        "scale = max(float(np.quantile(residual, 0.3)) / 0.566, -0.9999999)",
        "only the start: each of the ten rounds after it is held above zero",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "tilt_degrees: float = 25.0,",
        "tilt_degrees: float = 24.0,",
        "a default: a degree less that up may be wrong by",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "if len(left) < 10:",
        "if len(left) < 9:",
        "nine Gaussians that are left over make no plane that counts beside the widest",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "near = np.abs(plane.heights(means[left])) < 2.0 * band",
        "near = np.abs(plane.heights(means[left])) <= 2.0 * band",
        "a height that is the very bound",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "if len(points) < 3:",
        "if len(points) < 2:",
        "two points lie on a line, and the next test finds those",
    ),
    Survivor(
        "segmentation/clearance.py",
        "hidden = (behind > 0.0) & (depth > behind) & (alpha > 0.0)",
        "hidden = (behind > 0.0) & (depth > behind) & (alpha >= 0.0)",
        "where alpha is 0 depth is 0, which lies behind nothing",
    ),
    Survivor(
        "segmentation/graph_cut.py",
        "_UNIT = 1000",
        "_UNIT = 999",
        "costs are rounded to a 999th in place of a 1000th",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "few = random.choice(left, min(_SAMPLE, len(left)), replace=False, p=area[left] / area[left].sum())",
        "few = random.choice(left, min(_SAMPLE, len(left)), replace=True, p=area[left] / area[left].sum())",
        "another sample, as good: some of its Gaussians come twice",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "count: int = 4,",
        "count: int = 5,",
        "a default: one plane more that is looked for, the least wide one",
    ),
    Survivor(
        "locomotion/lemke.py",
        "return int(rows[basis[rows] == cover][0])",
        "return int(rows[basis[rows] == cover][ -1])",
        "no variable is in the basis twice: there is one such row",
    ),
    Survivor(
        "fem/factors.py",
        "@property",
        "",
        "of a Protocol, which nothing runs",
    ),
    Survivor(
        "fem/sparse_factors.py",
        "if right.shape[1] < _SPLIT:",
        "if right.shape[1] == _SPLIT:",
        "which right-hand sides have a second thread; the bits are the same",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "along = wp.clamp((length / rest_lengths[segment] - slack) / (full - slack), real(0.0), real(1.0))",
        "along = wp.clamp((length / rest_lengths[segment] - slack) / (full % slack), real(0.0), real(1.0))",
        "tests/muscles/test_tension.py notices, which the room does not run",
    ),
    Survivor(
        "locomotion/active_set.py",
        "_HOPELESS = 1e6",
        "_HOPELESS = 1000001.0",
        "a bound that is far beyond all that matters, by a millionth farther",
    ),
    Survivor(
        "contact/detection.py",
        "arms /= max(float(np.abs(arms).max()), 1e-300)",
        "arms /= max(float(np.abs(arms).max()), -1.0)",
        "it keeps from dividing by nothing, and no point has only arms of no length",
    ),
    Survivor(
        "contact/batch_contacts.py",
        "points.scatter_(1, torch.where(chosen, places, most), torch.where(chosen, numbers, 0))",
        "points.scatter_(1, torch.where(chosen, places, most), torch.where(chosen, numbers, 1))",
        "what is not chosen goes into the column behind the last place, which is cut off",
    ),
    Survivor(
        "contact/batch_step.py",
        "least = ((1.0 - 1e-4 * length) * most[waiting]).clamp(min=self.tolerance)",
        "least = ((1.0 - 1e-4 % length) * most[waiting]).clamp(min=self.tolerance)",
        "the same for whole steps; half a step may be worse by a ten-thousandth where less is asked for",
    ),
    Survivor(
        "contact/batch_contacts.py",
        "matrices = start.new_empty((worlds, size, (size + 4) // 4, 4))",
        "matrices = start.new_empty((worlds, size, (size + 4) // 3, 4))",
        "room for a few numbers more",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "for quad in range(j / 4 + newton.lane % across, quads, across):",
        "for quad in range(j / 4 / newton.lane % across, quads, across):",
        "on a CPU there is one lane, whose number is 0",
    ),
    Survivor(
        "kernels/contact/coulomb_equations.py",
        "for quad in range(j / 4 + newton.lane, quads, lanes):",
        "for quad in range(j / 5 + newton.lane, quads, lanes):",
        "it begins with columns that are done, which are the same in both rows: nothing",
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
        "kernels/contact/coulomb_equations.py",
        "for quad in range(j / 4 + newton.lane % across, quads, across):",
        "for quad in range(j / 4 + newton.lane / across, quads, across):",
        "on a CPU there is one lane, whose number is 0",
    ),
    Survivor(
        "kernels/contact/coulomb.py",
        "_BOLD = wp.constant(12)",
        "_BOLD = wp.constant( 13)",
        "how many bold steps are tried before shorter ones: one more",
    ),
    Survivor(
        "kernels/contact/height_field.py",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(-2.0), real(columns) + real(2.0))",
        "column = wp.clamp(wp.floor(u + real(0.5)), real(- 1.0), real(columns) + real(2.0))",
        "far out the edge goes on, so where exactly is of no account",
    ),
    Survivor(
        "locomotion/planner.py",
        "if not problem.feasible(velocities):",
        "if not not problem.feasible(velocities):",
        "where the search for the step's end begins; it ends in the same place",
    ),
    Survivor(
        "locomotion/solvers.py",
        "held = np.where(high - low < 1e-13, 5, 0).astype(np.int32)",
        "held = np.where(high - low < -0.9999999999999, 5, 0).astype(np.int32)",
        "an equality is given to the solver as two bounds in place of one row",
    ),
    Survivor(
        "locomotion/contact_pieces.py",
        "if len(active) > 1:",
        "if len(active) > 2:",
        "one neighbour fewer is looked at",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "if end_offsets.shape[0] > 0:",
        "if end_offsets.shape[0] != 0:",
        "a count is never less than nothing",
    ),
    Survivor(
        "fem/batch_factors.py",
        "self.chunk = max(1, chunk_bytes // (8 * size * size))",
        "self.chunk = max(1, chunk_bytes - (8 * size * size))",
        "how many worlds share one pass: results are the same",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "_SWEEPS = wp.constant(12)",
        "_SWEEPS = wp.constant( 13)",
        "sweeps after which a matrix of three has long been diagonal: one more",
    ),
    Survivor(
        "fem/batch_elasticity.py",
        "self._no_ends = self._copies(rows.T.tocsr(), 0, 0)",
        "self._no_ends = self._copies(rows.T.tocsr(), 0, -1)",
        "how far apart copies of nothing are",
    ),
    Survivor(
        "deformation/splitting.py",
        "MIN_OPACITY = 2.0 / 255.0",
        "MIN_OPACITY = 2.0 / 254.0",
        "a constant, by four thousandths of it",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "share = along * along * (real(3.0) - real(2.0) * along)",
        "share = along * along // (real(3.0) - real(2.0) * along)",
        "tests/muscles/test_tension.py, another room's, kills it",
    ),
    Survivor(
        "fem/sparse_factors.py",
        "positive = int((factors.diagonal()[pivots > 0] > 0.0).sum()) + int((pivots < 0).sum()) // 2",
        "positive = int((factors.diagonal()[pivots >= 0] > 0.0).sum()) + int((pivots < 0).sum()) // 2",
        "pivots count from one: none is nothing",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "if between != real(0.0):",
        "if between != real( 1.0):",
        "where it is nothing the turn is by nothing",
    ),
    Survivor(
        "kernels/deformation/decomposition.py",
        "longer = unit_or(wp.where(first, a, b), wp.where(first, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0)))",
        "longer = unit_or(wp.where(first, a, b), wp.where(first, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 2.0, 0.0)))",
        "the longer of two has a length, unless neither has one, and then the first counts as longer",
    ),
    Survivor(
        "locomotion/contact_pieces.py",
        "solved = spread @ dense.solve(operator, right, overwrite_a=True, overwrite_b=True, check_finite=False)",
        "solved = spread @ dense.solve(operator, right, overwrite_a=False, overwrite_b=True, check_finite=False)",
        "whether memory is written over: it is not read again",
    ),
    Survivor(
        "locomotion/lemke.py",
        "tableau = dger(-1.0, column, pivot_row, a=tableau, overwrite_a=True)",
        "tableau = dger(-1.0, column, pivot_row, a=tableau, overwrite_a=False)",
        "whether memory is written over: the caller goes on with what is returned",
    ),
    Survivor(
        "kernels/deformation/carried_cage.py",
        "RIGID = wp.constant(wp.float32(3.0))",
        "RIGID = wp.constant(wp.float32( 4.0))",
        "a mark that no share of a tetrahedron equals, whatever it is",
    ),
    Survivor(
        "kernels/fem/elasticity.py",
        "while sweep < _SWEEPS and m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2] + m[1, 2] * m[1, 2] > least:",
        "while sweep < _SWEEPS and m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2] + m[1, 2] * m[1, 2] >= least:",
        "no sum of squares is the bound to the bit",
    ),
    Survivor(
        "kernels/deformation/decomposition.py",
        "longer = unit_or(wp.where(first, a, b), wp.where(first, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0)))",
        "longer = unit_or(wp.where(first, a, b), wp.where(first, wp.vec3(1.0, 0.0, 1.0), wp.vec3(0.0, 1.0, 0.0)))",
        "the longer of two has a length, unless neither has one, and then the first counts as longer",
    ),
    Survivor(
        "locomotion/splitting.py",
        "verbose=False,",
        "verbose=True,",
        "the solver prints what it does",
    ),
]


def reason_for(mutant: Mutant) -> str | None:
    """Why this mutant may live; None where it may not."""
    for survivor in SURVIVORS:
        if (f"egs_warp/{survivor.file}", survivor.before, survivor.after) == (
            mutant.file,
            mutant.before,
            mutant.after,
        ):
            return survivor.reason
    return None
