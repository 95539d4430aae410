"""Surviving mutants of ``segmentation`` and its kernels."""

from __future__ import annotations

from tests.support.surviving_mutants.survivor import Survivor

SEGMENTATION = [
    Survivor(
        "segmentation/plane_fit.py",
        "few = random.choice(len(points), min(2000, len(points)), replace=False)",
        "few = random.choice(len(points), min(2000, len(points)), replace=True)",
        "an initial guess from points with repetitions is equally good",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        "lambda x, of=of: pixels.residuals(of(x)), np.zeros(3), loss=name, f_scale=scale, x_scale=0.01",
        "lambda x, of=of: pixels.residuals(of(x)), np.zeros( 4), loss=name, f_scale=scale, x_scale=0.01",
        "a fourth unknown without influence stays zero",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        "camera = np.where(np.abs(camera) < least, least, camera)",
        "camera = np.where(np.abs(camera) <= least, least, camera)",
        "a number equal to the bound is replaced by it",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        'plane = _refined(pixels, guess, lambda scale: ("soft_l1", scale), rounds=1)',
        'plane = _refined(pixels, guess, lambda scale: ("soft_l1", scale), rounds= 2)',
        "one more round of the rough fit that the last one starts from",
    ),
    Survivor(
        "segmentation/base_plane.py",
        "peaks = 1 + np.flatnonzero((inner >= density[:-2]) & (inner > density[2:]) & (inner > 0.5 * density.max()))",
        "peaks = 2 + np.flatnonzero((inner >= density[:-2]) & (inner > density[2:]) & (inner > 0.5 * density.max()))",
        "the next of 501 levels; a peak covers fifteen of them",
    ),
    Survivor(
        "segmentation/clearance.py",
        "seed: Seed = 0",
        "seed: Seed = 1",
        "another random sample, equally good",
    ),
    Survivor(
        "segmentation/object_mask.py",
        "lying = core & scene.is_level & (scene.heights < 3.0 * foot) & (not spec.masks)",
        "lying = core & scene.is_level & (scene.heights <= 3.0 * foot) & (not spec.masks)",
        "a height equal to the bound",
    ),
    Survivor(
        "segmentation/clearance.py",
        "iterations: PositiveCount = 100",
        "iterations: PositiveCount = 99",
        "a default: 99 steps instead of 100",
    ),
    Survivor(
        "segmentation/clearance.py",
        "return ring_cameras(plane, centre, 1.1 * radius, elevations=(1.0, 10.0, 25.0), size=size)",
        "return ring_cameras(plane, centre, 1.1 * radius, elevations=(1.0, 10.0, 24.0), size=size)",
        "a third of the cameras are one degree lower, with equivalent views",
    ),
    Survivor(
        "segmentation/ground.py",
        "_ELEVATIONS = (40.0, 58.0, 75.0)",
        "_ELEVATIONS = ( 39.0, 58.0, 75.0)",
        "a third of the cameras are one degree lower, with equivalent views",
    ),
    Survivor(
        "segmentation/ground.py",
        "above = ring_cameras(plane, middle, 1.2 * size, count=_VIEWS - 1, elevations=_ELEVATIONS, size=_SIDE)",
        "above = ring_cameras(plane, middle, 1.2 * size, count=_VIEWS - 0, elevations=_ELEVATIONS, size=_SIDE)",
        "sixteen views of the ground instead of fifteen",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        "if plane.heights(pixels.origins[0]) < 0.0:",
        "if plane.heights(pixels.origins[ -1]) < 0.0:",
        "all cameras are on one side, which any of them gives; with cameras on both sides the side is undefined",
    ),
    Survivor(
        "segmentation/plane_fit.py",
        "scale = max(float(np.quantile(residual, 0.3)) / 0.566, 1e-7)",
        "scale = max(float(np.quantile(residual, 0.3)) / 0.566, -0.9999999)",
        "only the initial value: it is bounded above zero in each of the ten rounds after it",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "tilt_degrees: float = 25.0,",
        "tilt_degrees: float = 24.0,",
        "a default: one degree less tolerance of the up direction",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "if len(rest) < 10:",
        "if len(rest) < 9:",
        "nine remaining Gaussians form no plane that counts compared with the widest",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "near = np.abs(plane.heights(means[rest])) < 2.0 * band",
        "near = np.abs(plane.heights(means[rest])) <= 2.0 * band",
        "a height equal to the bound",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "if len(points) < 3:",
        "if len(points) < 2:",
        "two points are collinear, which the next test rejects",
    ),
    Survivor(
        "segmentation/clearance.py",
        "hidden = (behind > 0.0) & (depth > behind) & (alpha > 0.0)",
        "hidden = (behind > 0.0) & (depth > behind) & (alpha >= 0.0)",
        "where alpha is 0 the depth is 0, which is never behind a surface",
    ),
    Survivor(
        "segmentation/graph_cut.py",
        "_UNIT = 1000",
        "_UNIT = 999",
        "costs are rounded to a 999th instead of a 1000th",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "few = random.choice(rest, min(_SAMPLE, len(rest)), replace=False, p=area[rest] / area[rest].sum())",
        "few = random.choice(rest, min(_SAMPLE, len(rest)), replace=True, p=area[rest] / area[rest].sum())",
        "another sample, equally good, with some Gaussians twice",
    ),
    Survivor(
        "segmentation/plane_search.py",
        "count: int = 4,",
        "count: int = 5,",
        "a default: one more plane is searched for, the narrowest one",
    ),
    Survivor(
        "segmentation/clicks.py",
        "pixel: tuple[Finite, Finite] = (0.0, 0.0)",
        "pixel: tuple[Finite, Finite] = ( -1.0, 0.0)",
        "the pixel of a click without an image, which nothing reads",
    ),
    Survivor(
        "segmentation/mask_model.py",
        "whole = cv2.resize(masks[0, 0, best].astype(np.float32), (SIDE, SIDE))[:height, :width]",
        "whole = cv2.resize(masks[ -1, 0, best].astype(np.float32), (SIDE, SIDE))[:height, :width]",
        "there is exactly one batch entry; any other output has already been rejected",
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
        "the painted colours are grey: the three channels are equal",
    ),
]
