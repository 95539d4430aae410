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
