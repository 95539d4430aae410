"""Relighting, which scales the colours of rotated Gaussians by a ratio of irradiances and leaves the others
unchanged."""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.main_light import MainLight, irradiance_form
from egs_warp.lighting.relighting import Relighter
from egs_warp.lighting.surface_normals import surface_normals
from tests.support.lit_scenes import AMBIENT, RADIUS, direction, lit_ball

UP = np.array([0.0, 0.0, 1.0])
LIGHT = direction(30.0, 35.0)


def relit(ball: GaussianCloud, turn: Rotation, light: np.ndarray = LIGHT) -> np.ndarray:
    """Return the SH coefficients (n, K, 3) of the ball after it is rotated by ``turn`` and relit."""
    form = irradiance_form(AMBIENT, 0.0, UP, 1.0 - AMBIENT, light)
    quaternion = np.tile(turn.as_quat()[[3, 0, 1, 2]], (ball.count, 1)).astype(np.float32)
    relighter = Relighter(ball, MainLight(light, 5.0, 0.3, form))
    return relighter.relight(ball, wp.array(quaternion, dtype=wp.vec4, device=ball.device)).sh.numpy()


def test_normals_of_a_ball_point_outward() -> None:
    """The normals of noisy flat Gaussians on a ball are radial within a few degrees."""
    ball = lit_ball(LIGHT)
    radial = (ball.means.numpy() - [0.0, 0.0, RADIUS]) / RADIUS
    cosine = np.einsum("ni,ni->n", surface_normals(ball), radial / np.linalg.norm(radial, axis=1)[:, None])
    assert np.degrees(np.arccos(np.quantile(cosine, 0.01))) < 8.0


def test_a_still_creature_has_the_same_bits() -> None:
    """Rotations of up to 0.9 degrees, as of a body that vibrates at rest, change no bit; slightly larger ones change
    the colours slightly."""
    ball = lit_ball(LIGHT)
    captured = ball.sh.numpy()
    for degrees in (0.0, 0.9):
        np.testing.assert_array_equal(relit(ball, Rotation.from_euler("y", degrees, degrees=True)), captured)
    slight = np.abs(relit(ball, Rotation.from_euler("y", 1.1, degrees=True)) - captured).max()
    assert 0.0 < slight < 2e-3


def test_a_turned_ball_is_lit_from_the_same_side() -> None:
    """A lit ball that is turned and relit looks like the ball at rest, because colours then depend only on the normal
    in space."""
    ball = lit_ball(LIGHT)
    normals = (ball.means.numpy() - [0.0, 0.0, RADIUS]) / RADIUS
    turn = Rotation.from_euler("z", 120.0, degrees=True)
    linear = 0.5 * (AMBIENT + (1.0 - AMBIENT) * np.clip(turn.apply(normals) @ LIGHT, 0.0, None))
    truth = linear ** (1.0 / 2.2)
    after = 0.5 + SH_BAND_0 * relit(ball, turn)[:, 0, 0]
    before = 0.5 + SH_BAND_0 * ball.sh.numpy()[:, 0, 0]
    error = np.sqrt(np.mean((after - truth) ** 2))
    assert error < 0.02 < 4.0 * error < np.sqrt(np.mean((before - truth) ** 2))


def test_the_form_of_a_light_rotates_with_its_axes() -> None:
    """The rotated quadratic form of the irradiance at R n equals the original one at n. The form approximates ambient
    light plus a clamped cosine to second order."""
    light = MainLight(LIGHT, 5.0, 0.3, irradiance_form(0.4, 0.1, UP, 0.6, LIGHT))
    turn = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix()
    normals = np.random.default_rng(0).normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def level(form: np.ndarray, n: np.ndarray) -> np.ndarray:
        whole = np.column_stack([n, np.ones(len(n))])
        return np.einsum("ni,ij,nj->n", whole, form, whole)

    np.testing.assert_allclose(
        level(light.rotated(turn).irradiance, normals @ turn.T), level(light.irradiance, normals)
    )
    exact = 0.4 + 0.1 * normals[:, 2] + 0.6 * np.clip(normals @ LIGHT, 0.0, None)
    assert np.abs(level(light.irradiance, normals) - exact).max() < 0.07
    assert abs((level(light.irradiance, normals) - exact).mean()) < 3e-3
