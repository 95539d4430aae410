"""Splats on surfaces: baked light, highlights and frames compared with closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.assets.surface import SurfaceSamples, bake_light, quaternions_from_normals, sh_from_colour
from egs_warp.geometry.gaussians import GaussianCloud


def test_baked_light_against_closed_forms(device: str) -> None:
    """A horizontal disc of radius r at height h above a point of a horizontal surface hides the fraction r^2 / (r^2 +
    h^2) of the point's sky."""
    angle = np.linspace(0.0, 2.0 * np.pi, 129)[:-1]
    radius, height = 0.5, 0.8
    rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(128, height)])
    vertices = np.concatenate([rim, [[0.0, 0.0, height]]])
    faces = np.array([[k, (k + 1) % 128, 128] for k in range(128)])
    points = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    samples = SurfaceSamples(points, np.tile([0.0, 0.0, 1.0], (2, 1)), 0.1)
    light = bake_light(
        samples, vertices, faces, up=np.array([0.0, 0.0, 1.0]), light_direction=np.array([0.0, 0.0, 1.0]), reach=5.0,
        device=device,
    )  # fmt: skip
    hidden = radius**2 / (radius**2 + (height - 0.09) ** 2)
    assert light.sky == pytest.approx([0.12 + 0.88 * (1.0 - hidden), 1.0], abs=0.04)
    assert light.key == pytest.approx([0.0, 1.0])


def test_sh_of_a_highlight() -> None:
    """Seen along the lobe, the highlight adds its strength to the colour; seen from behind, it adds almost nothing."""
    direction = np.array([[0.48, -0.6, 0.64]])
    sh = sh_from_colour(np.full((1, 3), 0.4), direction, np.array([0.2]), lobe_colour=(1.0, 1.0, 1.0))
    from egs_warp.geometry.camera import Camera
    from egs_warp.render import render_gaussians

    cloud = GaussianCloud.from_numpy(
        np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), -1.0), np.array([16.0]), sh
    )

    def seen_from(eye: np.ndarray) -> float:
        camera = Camera.look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0]), width=65, height=65)
        return float(render_gaussians(cloud, camera).colour.numpy().reshape(65, 65, 3)[32, 32].mean())

    # The renderer limits alpha to 0.99, so 0.01 of the colour comes from the white background.
    assert seen_from(10.0 * direction[0]) == pytest.approx(0.99 * 0.6 + 0.01, abs=0.01)
    assert seen_from(-10.0 * direction[0]) == pytest.approx(0.99 * 0.4 + 0.01, abs=0.02)


def test_quaternions_from_normals() -> None:
    """The third axis of the frame equals the normal for any normal, including straight down."""
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals = np.concatenate([normals / np.linalg.norm(normals, axis=1, keepdims=True), [[0, 0, -1.0], [0, 0, 1.0]]])
    w, x, y, z = quaternions_from_normals(normals, np.linspace(0, 6, 52)).T
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    assert np.allclose(third, normals, atol=1e-12)
