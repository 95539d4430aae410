"""The type of a built-in object, and the shading that all of them share."""

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
"""(3,) Direction to the key light of every built-in scene, not normalised."""


@dataclass(frozen=True)
class BuiltInObject:
    """A Gaussian object standing on its plane."""

    name: str
    cloud: GaussianCloud
    """Gaussians of the object, scene units."""
    plane: Plane
    """Ground plane, scene units."""

    @property
    def up(self) -> np.ndarray:
        """(3,) Unit normal of the plane."""
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
    """Create the Gaussians of an object on z = 0, with baked light.

    Args:
        samples: n samples of its surface.
        vertices: (v, 3) vertices of the mesh that casts shadows, scene units.
        faces: (f, 3) triangles of that mesh.
        albedo: (n, 3) linear albedo of the samples.
        gloss: (n,) gloss of the samples, 0 to 1.
        random: Random generator for the variation of the Gaussians.
        device: Warp device; None is the current one.
    """
    up = np.array([0.0, 0.0, 1.0])
    light = bake_light(samples, vertices, faces, up=up, light_direction=KEY_LIGHT, reach=0.35, device=device)
    # Move the hidden underside a little inside, so that only the tails of its Gaussians cross the plane.
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
