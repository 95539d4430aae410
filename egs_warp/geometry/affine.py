"""Affine transformation of Gaussians and their colours, including reflections and non-uniform scales."""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.kernels.deformation.spherical_harmonics import rotate_sh_kernel
from egs_warp.launching import device_of, launch_rows

_SIMILAR = 1e-6
"""Maximum relative difference of the singular values of a matrix that is considered a similarity."""
_BLOCK_ROWS = 1 << 18


def is_proper_similarity(matrix: np.ndarray) -> bool:
    """Return True if ``matrix`` (3, 3) is a rotation times a positive scale."""
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return bool(sizes[0] - sizes[2] <= _SIMILAR * sizes[0]) and float(np.linalg.det(matrix)) > 0.0


def rotated_colours(sh: wp.array, rotation: Rotation) -> wp.array:
    """Return the SH coefficients ``sh`` (n, K) vec3 of Gaussians that are rotated by ``rotation``, in the INRIA
    convention."""
    count, coefficients = sh.shape
    if coefficients == 1:
        return sh
    rotated, device = wp.clone(sh), device_of(sh)
    x, y, z, w = rotation.as_quat()
    launch_rows(
        rotate_sh_kernel,
        count,
        inputs=[
            wp.full(count, wp.vec4(w, x, y, z), dtype=wp.vec4, device=device),
            sh.contiguous(),
            round(coefficients**0.5) - 1,
        ],
        outputs=[rotated],
        device=device,
    )
    return rotated


def transformed_shapes(
    rotations: np.ndarray, log_scales: np.ndarray, matrix: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions (n, 4) and log scales (n, 3) float32 of the covariances M Sigma M^T, where M is ``matrix``.

    With the singular value decomposition M R S = U D V^T, U gives the quaternions and D the scales; a similarity only
    rotates R and scales S. Reflections are represented exactly, because the sign of an axis of a Gaussian is arbitrary.

    Args:
        rotations: (n, 4) quaternions w, x, y, z.
        log_scales: (n, 3) logarithms of the standard deviations.
        matrix: (3, 3), not singular.
    """
    sizes = np.linalg.svd(matrix, compute_uv=False)
    turned, stretched = np.empty((len(rotations), 4), np.float32), np.empty((len(rotations), 3), np.float32)
    for start in range(0, len(rotations), _BLOCK_ROWS):
        rows = slice(start, start + _BLOCK_ROWS)
        quaternions = rotations[rows][:, [1, 2, 3, 0]].astype(np.float64)
        quaternions[~quaternions.any(axis=1), 3] = 1.0
        axes = Rotation.from_quat(quaternions).as_matrix()
        logs = log_scales[rows].astype(np.float64)
        if sizes[0] - sizes[2] <= _SIMILAR * sizes[0]:
            sign = np.sign(np.linalg.det(matrix))
            axes = (sign / sizes[0]) * matrix @ axes
            logs = logs + np.log(sizes[0])
        else:
            # Divide by the largest scale, because distant or tiny Gaussians can exceed the range of floats.
            largest = logs.max(axis=1, keepdims=True)
            axes, lengths, _ = np.linalg.svd(matrix @ axes * np.exp(logs - largest)[:, None])
            axes[np.linalg.det(axes) < 0.0, :, 2] *= -1.0
            with np.errstate(divide="ignore"):
                logs = np.log(lengths) + largest
        turned[rows] = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
        stretched[rows] = logs
    return turned, stretched


def transformed_colours(sh: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return (n, K, 3) float32 SH coefficients of Gaussians transformed by ``matrix`` (3, 3), not singular.

    The colours are transformed by the orthogonal factor Q of the polar decomposition of ``matrix``. For a reflection,
    -Q is a rotation, and the remaining point inversion negates the odd bands.
    """
    first, _, second = np.linalg.svd(matrix)
    orthogonal = first @ second
    sign = np.sign(np.linalg.det(orthogonal))
    values = wp.array(np.ascontiguousarray(sh, np.float32), dtype=wp.vec3, device="cpu")
    colours = rotated_colours(values, Rotation.from_matrix(sign * orthogonal)).numpy()
    if sign < 0.0:
        colours = colours.copy()
        colours[:, 1:4] *= -1.0
        colours[:, 9:16] *= -1.0
    return colours
