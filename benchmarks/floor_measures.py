"""Similarity of an inpainted hole to the true floor: per pixel, after a blur, and by the energy of its gradients.

The self-similarity of the true floor is an upper bound for the score of any inpainting with sharp texture.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from egs_warp.training.metrics import psnr

COARSE = 0.05
"""Standard deviation of the blur for ``coarse_psnr``, relative to the hole's side."""
SHIFTS = np.array([(r * np.cos(t), r * np.sin(t)) for r in (0.5, 0.75, 1.0) for t in np.radians(np.arange(0, 360, 15))])
"""(72, 2) offsets from the hole at which the true floor is sampled, in units of the hole's side."""


def similarity(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the SSIM (H, W) of two images: Gaussian window of 11 x 11, sigma 1.5, mean over channels."""

    def blur(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values.astype(np.float64), (11, 11), 1.5)

    mean_a, mean_b = blur(a), blur(b)
    covariance = blur(a * b) - mean_a * mean_b
    variances = blur(a * a) - mean_a**2 + blur(b * b) - mean_b**2
    c1, c2 = 0.01**2, 0.03**2
    return (
        (2 * mean_a * mean_b + c1) * (2 * covariance + c2) / ((mean_a**2 + mean_b**2 + c1) * (variances + c2))
    ).mean(axis=2)


def coarse_psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Return the PSNR (dB) in ``mask`` (H, W) of two images (H, W, 3) after a blur within the mask."""
    sigma = COARSE * np.sqrt(mask.sum())

    def blurred(picture: np.ndarray) -> np.ndarray:
        weighted = ndimage.gaussian_filter(picture * mask[..., None].astype(float), (sigma, sigma, 0.0))
        return (
            np.asarray(weighted)[mask] / np.asarray(ndimage.gaussian_filter(mask.astype(float), sigma))[mask][:, None]
        )

    return psnr(blurred(image), blurred(truth))


def gradient_energy(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Return the mean squared gradient of ``image`` in ``mask`` (H, W), divided by the mean squared gradient of
    ``truth``.

    A rim of three pixels, which contains the seam, is excluded. Values below 1 mean that the image is too smooth, above
    1 that it has too much detail.
    """
    inner = np.asarray(ndimage.binary_erosion(mask, iterations=3), dtype=bool)

    def energy(picture: np.ndarray) -> float:
        down, right = (np.gradient(picture.astype(np.float64), axis=axis) for axis in (0, 1))
        return float(((down**2 + right**2)[inner]).mean())

    return energy(image) / energy(truth)


def moved_floor_scores(truth: np.ndarray, known: np.ndarray, hole: np.ndarray) -> list[tuple[float, float]]:
    """Score shifted copies of the true floor, from half a side to a full side of the hole away, in place of an
    inpainting.

    Args:
        truth: (rows, columns, 3) colours of the floor.
        known: (rows, columns) bool, pixels that show floor.
        hole: (rows, columns) bool.

    Returns:
        PSNR and PSNR after a blur, dB, for each shift whose source is floor.
    """
    rows, columns = np.nonzero(hole)
    side = max(np.ptp(rows), np.ptp(columns)) + 1
    scores: list[tuple[float, float]] = []
    for down, right in np.rint(SHIFTS * side).astype(int).tolist():
        y, x = rows + down, columns + right
        if min(y.min(), x.min()) < 0 or y.max() >= hole.shape[0] or x.max() >= hole.shape[1]:
            continue
        if known[y, x].mean() > 0.98:
            moved = truth.copy()
            moved[rows, columns] = truth[y, x]
            scores.append((psnr(moved[hole], truth[hole]), coarse_psnr(moved, truth, hole)))
    return scores
