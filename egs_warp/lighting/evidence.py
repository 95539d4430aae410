"""Evidence for a light: the brightness of the ground around an object, and of the surfaces of the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.cluster.vq import kmeans2

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.main_light import DISPLAY_GAMMA, MainLight
from egs_warp.geometry.plane import Plane
from egs_warp.lighting.surface_normals import surface_normals
from egs_warp.render.shadow import ShadowMap, shadow_blur_radius

_LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear red, green and blue in the luminance of sRGB colours."""
_MIN_COLOUR = 0.02
"""Minimum displayed colour; darker colours are raised to it before a logarithm is taken."""
_SOLID = 0.3
"""Minimum opacity of a Gaussian that is part of a surface."""
_GROUPS = 4
"""Number of groups of surfaces by chromaticity; the surfaces of a group share an albedo."""
_MAX_CASTERS, _MAX_SURFACES = 6_000, 6_000
_REACH = 2.4
"""Radius of the ground that is evaluated, relative to the object's size."""
_CELL = 0.06
"""Side of a cell of the ground, relative to the object's size."""
_ON_GROUND = 0.06
"""Maximum height of ground Gaussians, relative to the object's size."""
_COVERED = 0.35
"""Minimum coverage of a cell by the object seen from above, relative to the most covered cell, at which no photo is
assumed to show the cell."""
_OUTLIER = 2.5
"""Limit to which residuals are clipped, in robust standard deviations."""
_MIN_LIMIT = 1.0
"""Minimum of the limit ``_OUTLIER``, as a difference of the natural logarithm, so that a deep shadow on plain ground is
not clipped."""
_AMBIENT = (0.06, 0.25)
"""Blur radii, in sizes of the object, of the darkening around an object that occurs under any light."""


@dataclass(frozen=True)
class Regression:
    """Values from which the linear contributions of known causes have been removed."""

    basis: np.ndarray
    """(n, k) orthonormal basis of the known causes."""
    residual: np.ndarray
    """(n,) values minus their projection onto the known causes."""
    variance: float

    @classmethod
    def of(cls, values: np.ndarray, causes: np.ndarray) -> Regression:
        """Remove the linear contributions of ``causes`` (n, k) from ``values`` (n,); outliers are clipped."""
        basis, upper = np.linalg.qr(causes)
        basis = basis[:, np.abs(np.diag(upper)) > 1e-9 * np.abs(upper).max(initial=1.0)]
        residual = values - basis @ (basis.T @ values)
        for _ in range(2):
            limit = max(_OUTLIER * 1.4826 * float(np.median(np.abs(residual))), _MIN_LIMIT)
            clipped = np.clip(residual, -limit, limit)
            residual = clipped - basis @ (basis.T @ clipped)
        return cls(basis, residual, float(residual @ residual))

    def judge(self, cause: np.ndarray) -> tuple[float, float]:
        """Return the evidence for an additional ``cause`` (n,), which is the decrease of the logarithm of the variance,
        and the coefficient of the cause."""
        left = cause - self.basis @ (self.basis.T @ cause)
        size = float(left @ left)
        # A cause that is almost a linear combination of the known ones is no evidence.
        if size <= 1e-3 * float(cause @ cause) or self.variance <= 0.0:
            return 0.0, 0.0
        product = float(left @ self.residual)
        explained = min(product * product / (size * self.variance), 1.0 - 1e-9)
        return -float(np.log1p(-explained)), product / size


@dataclass(frozen=True)
class GroundEvidence:
    """Brightness of the ground around an object."""

    caster: GaussianCloud | None
    """The object, or a thinned-out subset of its Gaussians; None without ground."""
    plane: Plane
    centre: np.ndarray
    """(3,) point on the plane under the object."""
    size: float
    """Height of the object over the ground, or half of its width if that is larger."""
    points: np.ndarray
    """(n, 3) points on the ground."""
    log_brightness: np.ndarray
    """(n,) natural logarithm of linear luminance."""
    causes: np.ndarray | None
    """(n, k) other causes of brightness: albedo, position, ambient light and slope; None if too little ground is
    visible."""
    regression: Regression | None

    @property
    def cell(self) -> float:
        """Side of a cell, scene units."""
        return _CELL * self.size

    @property
    def max_height(self) -> float:
        """Largest height of Gaussians of the ground, scene units."""
        return _ON_GROUND * self.size

    @classmethod
    def of(cls, object_cloud: GaussianCloud, background: GaussianCloud, ground: Plane | HeightField) -> GroundEvidence:
        """Collect the visible cells of the ground around the object."""
        plane = ground if isinstance(ground, Plane) else ground.plane
        means = object_cloud.means.numpy().astype(np.float64)[object_cloud.visible(_SOLID)]
        if len(means) == 0:
            return cls(None, plane, np.zeros(3), 1.0, np.zeros((0, 3)), np.zeros(0), None, None)
        axes = np.array(plane.tangents())
        low, high = np.quantile(means @ axes.T, [0.02, 0.98], axis=0)
        size = max(float(np.quantile(ground.heights(means), 0.99)), 0.5 * float((high - low).max()))
        centre = 0.5 * (low + high) @ axes - plane.offset * plane.normal
        points, log_brightness, colours = _cells(background, ground, centre, size)
        caster = _thinned(object_cloud, _MAX_CASTERS)
        evidence = cls(caster, plane, centre, size, points, log_brightness, None, None)
        if len(points) < 40:
            return evidence
        flat = (points - centre) @ axes.T / size
        around = [evidence.shadow(None, spread) for spread in _AMBIENT]
        visible = around[0] < _COVERED * max(float(around[0].max(initial=0.0)), 1e-6)
        if visible.sum() < 40:
            return evidence
        x, y = flat.T
        smooth = np.column_stack([x, y, x * x, x * y, y * y, *around])
        if isinstance(ground, HeightField):
            # Shading due to the slopes of the ground.
            smooth = np.column_stack([smooth, ground.frames(points)[:, 0] @ axes.T])
        smooth = smooth[visible]
        causes = np.column_stack([_indicators(albedo_groups(colours[visible])), smooth])
        values = log_brightness[visible]
        return cls(caster, plane, centre, size, points[visible], values, causes, Regression.of(values, causes))

    def judge(self, light: MainLight) -> tuple[float, float]:
        """Return the evidence for the shadow of ``light``, and the decrease of the logarithm of brightness in the
        shadow; both are zero if the ground is brighter in the shadow."""
        if self.regression is None:
            return 0.0, 0.0
        evidence, coefficient = self.regression.judge(self.shadow(light))
        return (evidence, -coefficient) if coefficient < 0.0 else (0.0, 0.0)

    def shadow(self, light: MainLight | None, spread: float = 0.0) -> np.ndarray:
        """Return the object's shadow (n,) on the points of the ground: the shadow that ``light`` casts or, if it is
        None, the occlusion of the sky. It is blurred by ``spread`` times the object's size."""
        return shadow_on(self.points, self.caster, self.plane, self.centre, self.size, light, spread * self.size)


def shadow_on(
    points: np.ndarray,
    caster: GaussianCloud | None,
    plane: Plane,
    centre: np.ndarray,
    size: float,
    light: MainLight | None,
    spread: float = 0.0,
) -> np.ndarray:
    """Return the shadow (n,) float64, 0 to 1, of ``caster`` on ``points`` (n, 3).

    Args:
        points: points on the ground.
        caster: the object.
        plane: ground plane; points over it receive the shadow at their height.
        centre: (3,) point on the plane under the object.
        size: size of the object.
        light: main light; None casts straight down.
        spread: blur radius in addition to the Gaussians' own blur, scene units.
    """
    assert caster is not None
    grain = float(np.hypot(shadow_blur_radius(caster), spread))
    shadow_map = ShadowMap(
        plane,
        centre=centre,
        reach=1.5 * _REACH * size,
        device=caster.device,
        blur_radius=grain,
        height=size,
        light=light,
    )
    texels = wp.array(shadow_map.texels(points), dtype=wp.vec2, device=caster.device)
    strength = wp.full(len(points), 1.0, dtype=wp.float32, device=caster.device)
    return shadow_map.cover(shadow_map.of(caster), texels, strength).numpy().astype(np.float64)


@dataclass(frozen=True)
class ShadingEvidence:
    """Brightness and normals of an object's surfaces."""

    normals: np.ndarray
    """(n, 3) unit normals of the surfaces."""
    log_brightness: np.ndarray
    """(n,) natural logarithm of linear luminance."""
    groups: np.ndarray
    """(n,) group of equal albedo."""
    regression: Regression | None

    @classmethod
    def of(cls, object_cloud: GaussianCloud, up: np.ndarray) -> ShadingEvidence:
        """Collect the opaque Gaussians of the object."""
        cloud = _thinned(object_cloud, _MAX_SURFACES)
        normals = surface_normals(cloud)
        colours = displayed(cloud)
        known = (np.linalg.norm(normals, axis=1) > 0.5) & (colours.min(axis=1) > 2.0 * _MIN_COLOUR)
        known &= colours.max(axis=1) < 0.98
        normals, colours = normals[known], colours[known]
        if len(normals) < 40:
            return cls(np.zeros((0, 3)), np.zeros(0), np.zeros(0, int), None)
        groups, values = albedo_groups(colours), log_luminance(colours)
        heights = cloud.means.numpy().astype(np.float64)[known] @ up
        heights = (heights - heights.mean()) / max(float(heights.std()), 1e-9)
        # Light from above, and darkness near the ground, occur even without a main light.
        causes = np.column_stack([_indicators(groups), normals @ up, heights])
        return cls(normals, values, groups, Regression.of(values, causes))

    def judge(self, direction: np.ndarray) -> float:
        """Return the evidence for a light in ``direction`` (3,); zero if the surfaces that it would light are
        darker."""
        if self.regression is None:
            return 0.0
        evidence, coefficient = self.regression.judge(np.clip(self.normals @ direction, 0.0, None))
        return evidence if coefficient > 0.0 else 0.0


def displayed(cloud: GaussianCloud) -> np.ndarray:
    """Return the displayed colours (n, 3), averaged over all directions and raised to a minimum."""
    return np.clip(0.5 + SH_BAND_0 * cloud.sh.numpy()[:, 0].astype(np.float64), _MIN_COLOUR, 1.0)


def log_luminance(colours: np.ndarray) -> np.ndarray:
    """Return the natural logarithm (n,) of the linear luminance of displayed ``colours`` (n, 3)."""
    return np.log(colours**DISPLAY_GAMMA @ np.array(_LUMINANCE))


def albedo_groups(colours: np.ndarray) -> np.ndarray:
    """Return a group (n,) of similar chromaticity for each of the displayed ``colours`` (n, 3).

    White light changes the brightness of a surface and not its chromaticity.
    """
    chroma = np.log(colours[:, [0, 2]] / colours[:, 1:2])
    count = min(_GROUPS, len(np.unique(chroma, axis=0)))
    return np.unique(kmeans2(chroma, count, minit="++", rng=0)[1], return_inverse=True)[1]


def _indicators(groups: np.ndarray) -> np.ndarray:
    """Return a matrix (n, k) float64 with 1 in the column of each item's group, otherwise 0."""
    return (groups[:, None] == np.unique(groups)).astype(np.float64)


def _thinned(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Return every k-th opaque Gaussian, at most ``count`` in all, enlarged by the square root of k."""
    chosen = np.flatnonzero(cloud.visible(_SOLID))
    every = max(1, -(-len(chosen) // count))
    if len(chosen) == 0:
        return cloud
    part = cloud.subset(chosen[::every])
    if every == 1:
        return part
    scales = part.log_scales.numpy() + 0.5 * np.log(every)
    return GaussianCloud.from_numpy(
        part.means.numpy(),
        part.rotations.numpy(),
        scales,
        part.opacity_logits.numpy(),
        part.sh.numpy(),
        device=str(cloud.device),
    )


def _cells(
    background: GaussianCloud, ground: Plane | HeightField, centre: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions (n, 3), log brightness (n,) and displayed colours (n, 3) of the cells of the ground."""
    means, opacities = background.means.numpy().astype(np.float64), background.opacities()
    axes = np.array(ground.tangents())
    flat = (means - centre) @ axes.T / size
    near = (np.abs(ground.heights(means)) < _ON_GROUND * size) & background.visible(_SOLID)
    near &= np.linalg.norm(flat, axis=1) < _REACH
    means, flat = means[near], flat[near]
    if len(means) == 0:
        return np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
    weights = opacities[near] * np.minimum(background.breadths(np.flatnonzero(near)) / (_CELL * size), 1.0) ** 2
    colours = displayed(background)[near]
    side = int(np.ceil(2.0 * _REACH / _CELL))
    column, row = np.floor((flat + _REACH) / _CELL).astype(int).T
    _, cell = np.unique(row * side + column, return_inverse=True)
    total = np.bincount(cell, weights)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.column_stack([np.bincount(cell, weights * one) for one in values.T]) / total[:, None]

    colour = mean(colours)
    return mean(means), log_luminance(colour), colour
