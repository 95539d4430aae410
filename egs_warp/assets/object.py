"""What a built-in object is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.assets.surface import (
    SurfaceSamples,
    bake_light,
    flat_gaussians,
    highlight_directions,
    lit_colour,
    sh_from_colour,
)
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane

KEY_LIGHT = np.array([-0.55, -0.62, 0.95])
"""Towards the key light of every built-in scene."""


@dataclass(frozen=True)
class BuiltInObject:
    """A Gaussian object standing on its plane."""

    name: str
    cloud: GaussianCloud
    """Scene units."""
    plane: Plane
    """What it rests on, scene units."""

    @property
    def up(self) -> np.ndarray:
        """(3,) unit."""
        return self.plane.normal


def shade_gaussians(
    samples: SurfaceSamples,
    vertices: np.ndarray,
    faces: np.ndarray,
    albedo: np.ndarray,
    gloss: np.ndarray,
    *,
    random: np.random.Generator,
    device: str | None = None,
) -> GaussianCloud:
    """Gaussians of an object on z = 0: ``samples`` of its surface, its triangles for shadows, linear ``albedo`` (n, 3)
    and ``gloss`` (n,) 0 to 1."""
    up = np.array([0.0, 0.0, 1.0])
    light = bake_light(samples, vertices, faces, up=up, light_direction=KEY_LIGHT, reach=0.35, device=device)
    # The unseen underside sits a little inside, so that only its fuzz pokes through the plane.
    lift = (
        0.22 * samples.spacing * np.clip(-samples.normals[:, 2:], 0.0, 1.0) * (samples.points[:, 2:] < samples.spacing)
    )
    samples = replace(samples, points=samples.points + lift * up)
    sh = sh_from_colour(
        lit_colour(albedo, light),
        highlight_directions(samples.normals, KEY_LIGHT),
        0.30 * gloss * np.sqrt(np.clip(light.key, 0.0, 1.0)) + 0.03,
    )
    return flat_gaussians(samples, sh, random=random, device=device)
