"""Estimate of the main light of a capture from the shadow of its object on the ground and from the object's shading.

For each candidate direction of the light, the shadow that the object would cast on the ground and the surfaces that
would be lit are compared with the logarithm of the captured brightness by linear regression.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.main_light import DISPLAY_GAMMA, MainLight, irradiance_form
from egs_warp.geometry.plane import Plane
from egs_warp.lighting.evidence import GroundEvidence, ShadingEvidence

_AZIMUTHS = 16
_ELEVATIONS = (22.0, 38.0, 54.0, 70.0)
"""Elevations of the first candidates, degrees; each is combined with ``_AZIMUTHS`` azimuths."""
_HALF_ANGLES = (2.0, 6.0, 14.0)
"""Candidate half angles of the light, degrees."""
_FIRST_HALF_ANGLE = 6.0
_STEPS = (10.0, 5.0, 2.5)
"""Step sizes of the refinement of the direction, degrees."""
_ELEVATION_RANGE = (12.0, 80.0)
_APART = 60.0
"""Minimum difference of azimuth between the best candidate and a rival, degrees."""
_MIN_EVIDENCE = 0.18
"""Minimum evidence of a clear light, from ground and object together: decrease of the logarithm of the unexplained
variance."""
_MAX_RIVAL = 0.80
"""Maximum evidence of a rival, relative to the best candidate. If a rival has more, no light is clear."""
_MIN_AGREEMENT = 0.7
"""Minimum evidence of the best candidate, relative to the sum of the largest evidence of the ground alone and of the
object alone. Each term is limited to 1, because the evidence of a capture without noise is unbounded."""
_WEAK, _MAX_ANGLE, _MIN_ALONE = 0.4, 45.0, 0.05
"""Evidence below which a light is weak; maximum angle, degrees, between the best directions by ground and by object for
a weak light; and evidence that both directions must exceed for this limit to apply."""
_MIN_SHADE = 0.04
"""Minimum fraction of the displayed brightness that a cast shadow removes; a weaker shadow is not drawn."""
_KEY_WEIGHT = 2.0
"""Weight of the depth of the shadow on the ground in the fit of the irradiance, relative to all surfaces of the object
together."""


@dataclass(frozen=True)
class LightEstimate:
    """Result of ``estimate_light``."""

    light: MainLight | None
    """The main light; None if no light is clear."""
    note: str
    """One line for the user."""


@dataclass(frozen=True)
class _Candidate:
    """A candidate for the direction of the light, and its evidence."""

    azimuth: float
    elevation: float
    half_angle: float
    direction: np.ndarray
    ground: float
    shading: float
    depth: float
    """Decrease of the natural logarithm of linear brightness from full light to full shadow."""

    @property
    def evidence(self) -> float:
        return self.ground + self.shading


def estimate_light(
    object_cloud: GaussianCloud, background: GaussianCloud, ground: Plane | HeightField
) -> LightEstimate:
    """Estimate the main light of a capture.

    Args:
        object_cloud: the object.
        background: the rest of the capture, still with the shadow of the object and the hole under it.
        ground: ground under the object.
    """
    on_ground = GroundEvidence.of(object_cloud, background, ground)
    shading = ShadingEvidence.of(object_cloud, ground.normal)
    search = _Search(on_ground, shading, ground)
    first = [
        search.candidate(azimuth, elevation, _FIRST_HALF_ANGLE)
        for elevation in _ELEVATIONS
        for azimuth in np.arange(_AZIMUTHS) * 360.0 / _AZIMUTHS
    ]
    best = max(first, key=lambda one: one.evidence)
    rival = max((one.evidence for one in first if _azimuth_between(one, best) >= _APART), default=0.0)
    if best.evidence < _MIN_EVIDENCE:
        return LightEstimate(None, "light: no main light is clear; the shadow stays soft and below the creature")
    by_ground, by_shading = (max(first, key=lambda one, by=by: getattr(one, by)) for by in ("ground", "shading"))
    if _is_conflict(best, by_ground, by_shading) or rival > _MAX_RIVAL * best.evidence:
        return LightEstimate(
            None,
            "light: shadow and shading do not agree on one direction; the shadow stays soft and below the creature",
        )
    best = search.refined(best)
    shade = 1.0 - float(np.exp(-best.depth / DISPLAY_GAMMA))
    shade = shade if shade >= _MIN_SHADE else 0.0
    form = _fitted_irradiance(shading, ground.normal, best.direction, 1.0 - np.exp(-best.depth) if shade else None)
    light = MainLight(best.direction, best.half_angle, shade, form)
    cast = f"its shadow darkens the ground by {100.0 * shade:.0f} %" if shade else "it casts no clear shadow"
    return LightEstimate(light, f"light: {best.elevation:.0f} degrees above the ground; {cast}")


class _Search:
    """Candidates of a light and their evidence."""

    def __init__(self, ground: GroundEvidence, shading: ShadingEvidence, plane: Plane | HeightField) -> None:
        self._ground, self._shading = ground, shading
        self._axes = np.array([*plane.tangents(), plane.normal])

    def candidate(self, azimuth: float, elevation: float, half_angle: float) -> _Candidate:
        a, e = np.radians([azimuth, elevation])
        direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]) @ self._axes
        light = MainLight(direction, half_angle, 1.0, np.eye(4))
        ground, depth = self._ground.judge(light)
        return _Candidate(
            azimuth, elevation, half_angle, direction, ground, self._shading.judge(light.direction), depth
        )

    def refined(self, best: _Candidate) -> _Candidate:
        """Return the best candidate near ``best``: a search over direction and half angle with decreasing steps."""
        low, high = _ELEVATION_RANGE
        for step in _STEPS:
            around = [
                self.candidate(
                    best.azimuth + across * step / max(np.cos(np.radians(best.elevation)), 0.3),
                    float(np.clip(best.elevation + along * step, low, high)),
                    best.half_angle,
                )
                for across, along in ((-1, 0), (1, 0), (0, -1), (0, 1))
            ]
            best = max([best, *around], key=lambda one: one.evidence)
            softer = [self.candidate(best.azimuth, best.elevation, angle) for angle in _HALF_ANGLES]
            best = max([best, *softer], key=lambda one: one.evidence)
        return best


def _is_conflict(best: _Candidate, by_ground: _Candidate, by_shading: _Candidate) -> bool:
    """Return True if the best candidates according to the ground and according to the object contradict each other."""
    angle = np.degrees(np.arccos(np.clip(by_ground.direction @ by_shading.direction, -1.0, 1.0)))
    is_apart = best.evidence < _WEAK and angle > _MAX_ANGLE and min(by_ground.ground, by_shading.shading) > _MIN_ALONE
    reached = min(best.ground, 1.0) + min(best.shading, 1.0)
    alone = min(by_ground.ground, 1.0) + min(by_shading.shading, 1.0)
    return bool(is_apart) or reached < _MIN_AGREEMENT * alone


def _azimuth_between(first: _Candidate, second: _Candidate) -> float:
    return abs((first.azimuth - second.azimuth + 180.0) % 360.0 - 180.0)


def _fitted_irradiance(
    shading: ShadingEvidence, up: np.ndarray, direction: np.ndarray, key_fraction: float | None
) -> np.ndarray:
    """Return the quadratic form (4, 4) of the irradiance that fits the object's shading best.

    The irradiance is the sum of a distant light and an ambient light that changes with height, all non-negative. The
    fit alternates with a fit of one albedo for each group of surfaces. ``key_fraction`` is the main light's fraction of
    the irradiance on the ground, computed from the depth of its shadow; None if it is unknown.
    """
    rise, cosine = shading.normals @ up, np.clip(shading.normals @ direction, 0.0, None)
    # Ambient light from above and from below, and the main light.
    terms = np.column_stack([0.5 + 0.5 * rise, 0.5 - 0.5 * rise, cosine])
    albedo = np.ones(len(terms))
    brightness = np.exp(shading.log_brightness)
    strengths = np.array([0.5, 0.5, 0.0])
    for _ in range(8):
        irradiance = np.maximum(terms @ strengths, 1e-6)
        for group in np.unique(shading.groups):
            inside = shading.groups == group
            albedo[inside] = np.median(brightness[inside] / irradiance[inside])
        rows, right = terms, brightness / np.maximum(albedo, 1e-6)
        limit = 3.0 * np.median(np.abs(right - irradiance)) + 1e-6
        right = np.clip(right, irradiance - limit, irradiance + limit)
        if key_fraction is not None:
            # On the ground, the main light contributes the fraction f of the irradiance: (1 - f) key sin(elevation) = f
            # ambient.
            known = np.array([-key_fraction, 0.0, (1.0 - key_fraction) * max(float(direction @ up), 0.0)])
            rows = np.vstack([rows, _KEY_WEIGHT * np.sqrt(len(terms)) * known])
            right = np.append(right, 0.0)
        strengths = nnls(rows, right)[0]
        strengths /= max(float(strengths @ [0.5, 0.5, 0.25]), 1e-6)
    above, below, key = strengths.tolist()
    return irradiance_form(0.5 * (above + below), 0.5 * (above - below), up, key, direction)
