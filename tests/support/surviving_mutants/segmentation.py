"""Surviving mutants of ``segmentation`` and its kernels."""

from __future__ import annotations

from tests.support.surviving_mutants.survivor import Survivor

SEGMENTATION = [
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
        "lying = core & scene.is_level & (scene.heights < 3.0 * foot) & (not spec.masks)",
        "lying = core & scene.is_level & (scene.heights <= 3.0 * foot) & (not spec.masks)",
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
        "segmentation/clicks.py",
        "pixel: tuple[float, float] = (0.0, 0.0)",
        "pixel: tuple[float, float] = ( -1.0, 0.0)",
        "of a click in no picture, where nothing reads it",
    ),
    Survivor(
        "segmentation/mask_model.py",
        "whole = cv2.resize(masks[0, 0, best].astype(np.float32), (SIDE, SIDE))[:height, :width]",
        "whole = cv2.resize(masks[ -1, 0, best].astype(np.float32), (SIDE, SIDE))[:height, :width]",
        "there is one, or the answer is refused before",
    ),
    Survivor(
        "segmentation/object_spec.py",
        "return ~(self.object_mask | self.buried_mask | self.floater_mask)",
        "return ~(self.object_mask | self.buried_mask ^ self.floater_mask)",
        "no Gaussian is both buried and a floater",
    ),
    Survivor(
        "segmentation/selection_masks.py",
        "render_gaussians(painted, camera, background=(0.0, 0.0, 0.0)).colour.numpy()[..., 0] > 0.5,",
        "render_gaussians(painted, camera, background=(0.0, 0.0, 0.0)).colour.numpy()[..., -1] > 0.5,",
        "what is painted is grey: its three colours are the same",
    ),
]
