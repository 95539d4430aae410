"""The main light of a capture: its direction, softness and shadow, and the irradiance on surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from egs_warp.checked_calls import Fraction, Range, checked_constructor
from egs_warp.errors import ArgumentError
from egs_warp.short_repr import short_repr

DISPLAY_GAMMA = 2.2
"""Exponent that converts a displayed colour, 0 to 1, to linear light."""


@checked_constructor
@dataclass(frozen=True)
class MainLight:
    """The strongest light of a capture and the light around it, in the axes of the capture or of the body."""

    __repr__ = short_repr

    direction: Annotated[np.ndarray, 3]
    """(3,) unit vector to the light."""
    half_angle: Annotated[float, Range(0.0, 89.0, above=True)]
    """Half the angular diameter of the light, degrees; it determines the softness of the shadow."""
    shade: Fraction
    """Fraction of the displayed brightness of the ground that the shadow removes, 0 to 1."""
    irradiance: Annotated[np.ndarray, 4, 4]
    """(4, 4) symmetric matrix M of the irradiance E(n) = (n, 1) M (n, 1)^T of a surface with unit normal n, up to a
    factor: spherical harmonics up to order 2 as a quadratic form (Ramamoorthi and Hanrahan 2001, Eq. 11)."""

    def __post_init__(self) -> None:
        if not abs(float(np.linalg.norm(self.direction)) - 1.0) < 1e-3:
            advice = "its length is not 1; give a unit vector to the light"
            raise ArgumentError("direction", advice, value=",".join(f"{x:g}" for x in self.direction))
        if not np.allclose(self.irradiance, self.irradiance.T):
            raise ArgumentError("irradiance", "it is not symmetric; give the matrix M of (n, 1) M (n, 1)^T")
        if not mean_irradiance(self) > 0.0:
            raise ArgumentError("irradiance", "its mean over all normals is not above 0; give another matrix")

    def rotated(self, axes: np.ndarray) -> MainLight:
        """Return the light in other axes, the rows of ``axes`` (3, 3)."""
        whole = np.eye(4)
        whole[:3, :3] = axes
        return replace(self, direction=axes @ self.direction, irradiance=whole @ self.irradiance @ whole.T)


def mean_irradiance(light: MainLight) -> float:
    """Return the mean irradiance over all normals."""
    return float(light.irradiance[3, 3] + np.trace(light.irradiance[:3, :3]) / 3.0)


def normalised(light: MainLight) -> MainLight:
    """Return the light with a mean irradiance of 1 over all normals."""
    return replace(light, irradiance=light.irradiance / mean_irradiance(light))


def irradiance_form(ambient: float, slope: float, up: np.ndarray, key: float, direction: np.ndarray) -> np.ndarray:
    """Return the quadratic form (4, 4) of the irradiance from an ambient light and a distant light.

    The ambient irradiance is linear in n . up. For the distant light, max(n . l, 0) is projected onto spherical
    harmonics up to order 2: 1/4 + c/2 + 5/32 (3 c^2 - 1) with c = n . l.

    Args:
        ambient: irradiance of a vertical surface by the ambient light.
        slope: additional irradiance of a surface that faces up; a surface that faces down receives less by this amount.
        up: (3,) unit vector.
        key: irradiance of a surface that faces the distant light.
        direction: (3,) unit vector to the distant light.
    """
    form = np.zeros((4, 4))
    form[:3, :3] = key * 15.0 / 32.0 * np.outer(direction, direction)
    form[:3, 3] = form[3, :3] = 0.5 * (slope * up + 0.5 * key * direction)
    form[3, 3] = ambient + key * (0.25 - 5.0 / 32.0)
    return form
