"""Flat Gaussians with baked lighting, created from samples of a surface, for built-in objects and environments.

The ray tracing kernel is in ``egs_warp/kernels/assets/baked_light.py``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.kernels.assets.baked_light import bake_light_kernel

# Real spherical harmonics in the INRIA sign convention, bands 1 to 3.
_SH1 = 0.4886025119029199
_SH2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_SH3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


@dataclass(frozen=True)
class SurfaceSamples:
    """Points that are spread evenly over a surface."""

    points: np.ndarray
    """(n, 3) float64, positions, scene units."""
    normals: np.ndarray
    """(n, 3) float64, unit vectors, outward."""
    spacing: float
    """Mean distance between neighbours, scene units."""


@dataclass(frozen=True)
class BakedLight:
    """Light that reaches each sample, 0 to 1, to be multiplied by the albedo."""

    sky: np.ndarray
    """(n,) Cosine-weighted fraction of the hemisphere in which the sky is visible."""
    ground: np.ndarray
    """(n,) Cosine-weighted fraction of the hemisphere in which lit ground is visible."""
    key: np.ndarray
    """(n,) Visible fraction of the key light times the cosine of incidence."""


def bake_light(
    samples: SurfaceSamples,
    occluder_vertices: np.ndarray,
    occluder_faces: np.ndarray,
    *,
    up: np.ndarray,
    light_direction: np.ndarray,
    reach: float,
    ground_height: float | None = 0.0,
    light_softness: float = 0.12,
    device: str | None = None,
) -> BakedLight:
    """Trace ambient and key-light rays against a mesh and level ground.

    Args:
        samples: n surface samples that receive light.
        occluder_vertices: (v, 3) vertices of the mesh that blocks light, scene units.
        occluder_faces: (f, 3) triangles of that mesh.
        up: (3,) unit vector, up direction.
        light_direction: (3,) direction to the key light.
        reach: Length of the ambient rays, and distance over which the object shades the ground, scene units.
        ground_height: Height of the ground along ``up``, scene units; None means no ground.
        light_softness: Tangent of the half angle of the key light, which is a disc.
        device: Warp device; None is the current one.
    """
    mesh = wp.Mesh(
        points=wp.array(np.asarray(occluder_vertices, np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(np.asarray(occluder_faces, np.int32).ravel(), dtype=wp.int32, device=device),
    )
    count = len(samples.points)
    light = np.asarray(light_direction, float) / np.linalg.norm(light_direction)
    outputs = [wp.zeros(count, dtype=wp.float32, device=device) for _ in range(3)]
    wp.launch(
        bake_light_kernel,
        dim=count,
        inputs=[
            mesh.id,
            wp.array(samples.points.astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(samples.normals.astype(np.float32), dtype=wp.vec3, device=device),
            wp.vec3(*map(float, up)),
            0.0 if ground_height is None else float(ground_height),
            0 if ground_height is None else 1,
            float(reach),
            wp.vec3(*map(float, light)),
            float(light_softness),
            48,
            12,
        ],
        outputs=outputs,
        device=device,
    )
    sky, ground, key_visible = (output.numpy().astype(np.float64) for output in outputs)
    # Add a constant for the light that is reflected between the sides of a crease, because rays are not traced further.
    sky = 0.12 + 0.88 * sky
    return BakedLight(sky, ground, key_visible * np.clip(samples.normals @ light, 0.0, None))


def lit_colour(
    albedo: np.ndarray,
    light: BakedLight,
    *,
    key_colour: tuple[float, float, float] = (1.35, 1.22, 1.0),
    sky_colour: tuple[float, float, float] = (0.40, 0.45, 0.54),
    ground_colour: tuple[float, float, float] = (0.26, 0.20, 0.15),
) -> np.ndarray:
    """Return the display colour (n, 3), 0 to 1, of the linear ``albedo`` (n, 3) under the baked light."""
    linear = albedo * (
        light.key[:, None] * np.array(key_colour)
        + light.sky[:, None] * np.array(sky_colour)
        + light.ground[:, None] * np.array(ground_colour)
    )
    # The smooth saturation prevents lit parts from clipping to white.
    return np.clip(1.0 - np.exp(-1.25 * linear), 0.0, 1.0) ** (1.0 / 2.2)


def sh_from_colour(
    colour: np.ndarray,
    lobe_directions: np.ndarray,
    lobe_strength: np.ndarray,
    *,
    lobe_colour: tuple[float, float, float] = (1.0, 0.95, 0.86),
) -> np.ndarray:
    """Return SH coefficients of degree 3 (n, 16, 3): ``colour`` (n, 3) plus a smooth specular highlight.

    The lobe is zonal, with the band weights 1, 0.9, 0.6 and 0.25 of a delta function; its negative ring stays below 6 %
    of the peak.
    SH are evaluated in the direction from the camera to the Gaussian, hence the minus sign.

    Args:
        colour: (n, 3) 0 to 1.
        lobe_directions: (n, 3) unit vectors from the surface to a viewer at the peak of the highlight.
        lobe_strength: (n,) peak of the highlight.
        lobe_colour: Colour of the highlight.
    """
    x, y, z = (-lobe_directions).T
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        np.stack([np.full_like(x, SH_BAND_0)], 1),
        np.stack([-_SH1 * y, _SH1 * z, -_SH1 * x], 1) * 0.9,
        np.stack(
            [
                _SH2[0] * x * y,
                _SH2[1] * y * z,
                _SH2[2] * (2.0 * zz - xx - yy),
                _SH2[3] * x * z,
                _SH2[4] * (xx - yy),
            ],
            1,
        )
        * 0.6,
        np.stack(
            [
                _SH3[0] * y * (3 * xx - yy),
                _SH3[1] * x * y * z,
                _SH3[2] * y * (4 * zz - xx - yy),
                _SH3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                _SH3[4] * x * (4 * zz - xx - yy),
                _SH3[5] * z * (xx - yy),
                _SH3[6] * x * (xx - 3 * yy),
            ],
            1,
        )
        * 0.25,
    ]
    lobe = np.concatenate(bands, axis=1)
    peak = (1.0 + 3 * 0.9 + 5 * 0.6 + 7 * 0.25) / (4.0 * np.pi)
    sh = (lobe * (lobe_strength / peak)[:, None])[:, :, None] * np.array(lobe_colour)
    sh[:, 0] += (colour - 0.5) / SH_BAND_0
    return sh


def highlight_directions(normals: np.ndarray, light_direction: np.ndarray) -> np.ndarray:
    """Return the unit directions (n, 3) into which the surface reflects the key light."""
    light = np.asarray(light_direction, float) / np.linalg.norm(light_direction)
    return 2.0 * (normals @ light)[:, None] * normals - light


def quaternions_from_normals(normals: np.ndarray, spin: np.ndarray) -> np.ndarray:
    """Return unit quaternions (n, 4) wxyz whose third axis is the normal, rotated about it by ``spin`` (n,) radians."""
    x, y, z = normals.T
    # The shortest rotation from +z. For -z it is not unique; any horizontal axis is valid.
    tilt = np.stack([1.0 + z, -y, x, np.zeros_like(x)], axis=1)
    tilt[z < -1.0 + 1e-9] = [0.0, 1.0, 0.0, 0.0]
    tilt /= np.linalg.norm(tilt, axis=1, keepdims=True)
    c, s = np.cos(spin / 2.0), np.sin(spin / 2.0)
    w, a, b, d = tilt.T
    return np.stack([w * c - d * s, a * c + b * s, b * c - a * s, w * s + d * c], axis=1)


def flat_gaussians(
    samples: SurfaceSamples,
    sh: np.ndarray,
    *,
    random: np.random.Generator,
    opacity: float = 0.95,
    width: float = 0.62,
    thickness: float = 0.12,
    device: str | None = None,
) -> GaussianCloud:
    """Create Gaussians that lie on the surface.

    Size, elongation, opacity and depth vary as in a trained capture.

    Args:
        samples: n surface samples.
        sh: (n, k, 3) SH coefficients.
        random: Random generator for the variation of the Gaussians.
        opacity: Opacity, 0 to 1, whose logit is the mean of the logits.
        width: Standard deviation along the surface, in units of the spacing.
        thickness: Standard deviation along the normal, in units of the spacing.
        device: Warp device; None is the current one.
    """
    count = len(samples.points)
    depth = random.normal(0.0, 0.10, count).clip(-0.25, 0.25) * samples.spacing
    stretch = random.uniform(-0.25, 0.25, count)
    size = np.log(width * samples.spacing) + random.normal(0.0, 0.12, count)
    log_scales = np.stack(
        [size + stretch, size - stretch, np.log(thickness * samples.spacing) + random.normal(0.0, 0.3, count)], axis=1
    )
    logit = np.log(opacity / (1.0 - opacity)) + random.normal(0.0, 0.7, count)
    return GaussianCloud.from_numpy(
        samples.points + depth[:, None] * samples.normals,
        quaternions_from_normals(samples.normals, random.uniform(0.0, 2.0 * np.pi, count)),
        log_scales,
        logit,
        sh,
        device=device,
    )
