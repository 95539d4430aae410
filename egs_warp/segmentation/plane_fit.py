"""Robust fit of a plane to rendered depth, from one or several views (Eq. 18, 19)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.plane import Plane

_MAX_PIXELS = 20_000
"""Maximum number of pixels in all views together; more pixels would not improve a fit of three parameters."""
_MIN_PIXELS = 30
_TRIALS = 300
_TUKEY = 2.0
"""Residual, in standard deviations, above which pixels have zero weight. 4.685 would be more efficient without
outliers, but an object is close to the plane at its foot; with 3.0, the planes of some of 100 scenes are tilted by a
degree."""
_MIN_NOISE = 1e-3
"""Minimum scale of the residuals in the weights, as a fraction of the depth. If a floor consists of a few wide splats,
a plane through three of them has zero error in half of the pixels; without this minimum, all other pixels would then
have zero weight."""
_MIN_SINE = 0.02
"""Minimum sine of the angle between plane and line of sight; at smaller angles the plane is not visible."""


@dataclass(frozen=True)
class PlaneView:
    """One picture in which the plane is visible."""

    camera: Camera
    depth: np.ndarray
    """(H, W) expected z-depth, scene units; 0 where nothing is rendered."""
    mask: np.ndarray
    """(H, W) bool, True where the plane is visible."""


@dataclass(frozen=True)
class PlaneFit:
    """A fitted plane and the quality of the fit."""

    plane: Plane
    """Fitted plane; its normal points to the side of the cameras."""
    noise: float
    """Robust standard deviation of the relative depth error, over the pixels on the plane."""
    inlier_share: float
    """Fraction of the masked pixels that the plane explains, 0 to 1."""
    pixel_count: int
    """Number of pixels with depth inside the masks."""


def plane_depth(plane: Plane, camera: Camera) -> np.ndarray:
    """Return the z-depth D_p (H, W) of the plane along each pixel's ray, Eq. (18); 0 where the ray misses the plane."""
    slope = camera_rays(camera) @ plane.normal
    height = float(plane.heights(camera.centre))
    depth = -height / np.where(slope == 0.0, np.inf, slope)
    return np.where(depth > 0.0, depth, 0.0)


def fit_plane(views: Sequence[PlaneView], *, start: Plane | None = None, seed: int = 0) -> PlaneFit:
    """Fit the plane whose depth agrees with the rendered depth inside the masks, in all views together, Eq. (19).

    The residual of a pixel is its relative error in depth, D_g / D_p - 1, which for one view is linear in m = -N / (N.o
    + d). Up to 40 % of the pixels may be outliers. The initial plane is found by random sampling or, if ``start`` is
    given (in the paper, the view direction with d = 0), by reweighted least squares on inverse depth, beginning
    at ``start``.

    Raises ``UserError`` for masks of the wrong size or without depth, and if no plane explains the pixels.
    """
    pixels = _gather(views, np.random.default_rng(seed))
    guess = _sampled(pixels, np.random.default_rng(seed)) if start is None else _reweighted(pixels, start)
    plane = _refined(pixels, guess, lambda scale: ("soft_l1", scale), rounds=1)
    plane = _refined(pixels, plane, lambda scale: (_tukey, _TUKEY * scale), rounds=6)
    residual = np.abs(pixels.residuals(plane))
    scale = _scale(residual)
    inside = residual < _TUKEY * max(scale, _MIN_NOISE)
    if scale > 0.1 or inside.mean() < 0.4:
        errors, share = (f"{100.0 * value:.0f} %" for value in (scale, inside.mean()))
        fault = f"leaves depth errors of {errors}" if scale > 0.1 else f"explains only {share} of the pixels"
        raise UserError(
            f"plane: none fits the masks: the best one {fault}; mark a flat part of what the object stands on"
        )
    if plane.heights(pixels.origins[0]) < 0.0:
        plane = Plane(-plane.normal, -plane.offset)
    return PlaneFit(plane, scale, float(inside.mean()), len(residual))


@dataclass(frozen=True)
class _Pixels:
    origins: np.ndarray
    """(p, 3) camera centre for each pixel."""
    rays: np.ndarray
    """(p, 3) ray of each pixel, scaled to z-depth 1."""
    depth: np.ndarray
    """(p,) rendered z-depth of each pixel, scene units."""
    first_view: np.ndarray
    """(p,) bool, pixels of the first view."""

    @property
    def points(self) -> np.ndarray:
        """(p, 3) rendered points, in world axes."""
        return self.origins + self.depth[:, None] * self.rays

    def residuals(self, plane: Plane) -> np.ndarray:
        """Return the relative errors (p,) D_g / D_p - 1 = -(height of the rendered point) / (height of the camera),
        with heights over ``plane``."""
        camera = self.origins @ plane.normal + plane.offset
        least = 1e-9 * np.abs(self.depth)
        camera = np.where(np.abs(camera) < least, least, camera)
        return -(self.depth * (self.rays @ plane.normal) + camera) / camera


def _gather(views: Sequence[PlaneView], random: np.random.Generator) -> _Pixels:
    if not views:
        raise UserError("plane: there are no views; give at least one picture with its camera and mask")
    most = _MAX_PIXELS // len(views)
    origins, rays, depths, first = [], [], [], []
    for number, view in enumerate(views):
        shape = (view.camera.height, view.camera.width)
        for name, values in (("depth", view.depth), ("mask", view.mask)):
            if np.shape(values) != shape:
                raise UserError(
                    f"plane: {name} of view {number} has {np.shape(values)[::-1]} pixels, but the picture of its camera"
                    f" has {shape[::-1]}; resize it"
                )
        valid = view.mask & (view.depth > 0.0) & np.isfinite(view.depth)
        chosen = np.flatnonzero(valid)
        if len(chosen) > most:
            chosen = np.sort(random.choice(chosen, most, replace=False))
        rays.append(camera_rays(view.camera).reshape(-1, 3)[chosen])
        depths.append(np.asarray(view.depth, float).ravel()[chosen])
        origins.append(np.broadcast_to(view.camera.centre, (len(chosen), 3)))
        first.append(np.full(len(chosen), number))
    depth = np.concatenate(depths)
    if len(depth) < _MIN_PIXELS:
        raise UserError(
            f"plane: only {len(depth)} pixels inside the masks have a depth, fewer than {_MIN_PIXELS}; "
            "mark a larger part of the plane, or check the cameras"
        )
    number = np.concatenate(first)
    return _Pixels(np.concatenate(origins), np.concatenate(rays), depth, number == number[0])


def _sampled(pixels: _Pixels, random: np.random.Generator) -> Plane:
    """Return the plane with the smallest median residual (Rousseeuw 1984) among planes through three rendered
    points."""
    points = pixels.points
    few = random.choice(len(points), min(2000, len(points)), replace=False)
    subset = _Pixels(pixels.origins[few], pixels.rays[few], pixels.depth[few], pixels.first_view[few])
    best, least = None, np.inf
    for _ in range(_TRIALS):
        a, b, c = points[random.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12 * np.linalg.norm(b - a) * np.linalg.norm(c - a) or length == 0.0:
            continue
        plane = Plane(normal / length, float(-a @ normal / length))
        sight = np.abs(subset.rays @ plane.normal) / np.linalg.norm(subset.rays, axis=1)
        if np.median(sight) < _MIN_SINE:
            continue
        # The quantile is slightly below the median, so that half of the pixels may be outliers.
        cost = float(np.quantile(np.abs(subset.residuals(plane)), 0.45))
        if cost < least:
            best, least = plane, cost
    if best is None:
        raise UserError(
            "plane: the masked points lie on a line, or the plane is seen edge-on; mark a wider part of the plane"
        )
    return best


def _reweighted(pixels: _Pixels, start: Plane) -> Plane:
    """Improve ``start`` in the first view by least squares on inverse depth, with weights 1 / |residual|."""
    rays, depth = pixels.rays[pixels.first_view], pixels.depth[pixels.first_view]
    origin = pixels.origins[pixels.first_view][0]
    rows = depth[:, None] * rays
    height = float(start.heights(origin))
    # The paper's start plane may pass through the camera, where inverse depth is infinite.
    m = -start.normal / (height if abs(height) > 1e-9 else 1e-9)
    for _ in range(50):
        residual = rows @ m - 1.0
        weight = 1.0 / np.maximum(np.abs(residual), 1e-4)
        m = np.linalg.lstsq(rows * np.sqrt(weight)[:, None], np.sqrt(weight), rcond=None)[0]
    length = float(np.linalg.norm(m))
    normal = -m / length
    return Plane(normal, 1.0 / length - float(normal @ origin))


def _refined(pixels: _Pixels, start: Plane, loss: Callable[[float], tuple], *, rounds: int) -> Plane:
    """Fit two tilts and the offset of the plane by robust least squares, in all views together, in ``rounds``
    iterations."""
    plane = start
    for _ in range(rounds):
        first, second = plane.tangents()
        base = plane
        # The tilts are about the centre of the points, so that the three unknowns are nearly uncorrelated.
        middle = np.median(pixels.points, axis=0)
        reach = max(float(np.median(np.linalg.norm(pixels.points - middle, axis=1))), 1e-12)

        def of(
            x: np.ndarray,
            base: Plane = base,
            first: np.ndarray = first,
            second: np.ndarray = second,
            middle: np.ndarray = middle,
            reach: float = reach,
        ) -> Plane:
            normal = base.normal + x[0] * first + x[1] * second
            normal = normal / np.linalg.norm(normal)
            return Plane(normal, float(-(middle @ normal) + base.heights(middle) + x[2] * reach))

        name, scale = loss(max(_scale(np.abs(pixels.residuals(plane))), _MIN_NOISE))
        found = least_squares(
            lambda x, of=of: pixels.residuals(of(x)), np.zeros(3), loss=name, f_scale=scale, x_scale=0.01
        )
        plane = of(found.x)
    return plane


def _scale(residual: np.ndarray) -> float:
    """Return the standard deviation of the inliers among absolute residuals; it is never 0.

    The median alone would overestimate it by 50 % if 30 % of the pixels are outliers. Therefore the estimate starts
    from a lower quantile, and then uses the median of the residuals below two standard deviations, which is 0.638
    standard deviations.
    """
    scale = max(float(np.quantile(residual, 0.3)) / 0.566, 1e-7)
    for _ in range(10):
        scale = max(float(np.median(residual[residual <= 2.0 * scale])) / 0.638, 1e-7)
    return scale


def _tukey(z: np.ndarray) -> np.ndarray:
    """Return Tukey's biweight for ``least_squares``: its value, and two derivatives with respect to z = (residual /
    scale)^2."""
    left = np.clip(1.0 - z, 0.0, None)
    return np.stack([(1.0 - left**3) / 3.0, left**2, -2.0 * left])
