"""Image metrics: SSIM, PSNR and colour matching."""

from __future__ import annotations

import numpy as np
import torch

from egs_warp.errors import UserError


def ssim(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the mean structural similarity of two pictures (H, W, 3) in 0 to 1, with an 11 x 11 Gaussian window, sigma
    1.5 and zero padding."""
    offsets = torch.arange(-5.0, 6.0, dtype=a.dtype, device=a.device)
    line = torch.exp(-(offsets**2) / (2 * 1.5**2))
    line = line / line.sum()
    stack = torch.cat([t.permute(2, 0, 1) for t in (a, b, a * a, b * b, a * b)])[None]
    channels = stack.shape[1]
    blurred = torch.nn.functional.conv2d(stack, line.expand(channels, 1, 1, 11), padding=(0, 5), groups=channels)
    blurred = torch.nn.functional.conv2d(
        blurred, line[:, None].expand(channels, 1, 11, 1), padding=(5, 0), groups=channels
    )
    mean_a, mean_b, aa, bb, ab = blurred[0].reshape(5, 3, *a.shape[:2])
    c1, c2 = 0.01**2, 0.03**2
    covariance = ab - mean_a * mean_b
    variances = aa - mean_a**2 + bb - mean_b**2
    return (
        (2 * mean_a * mean_b + c1) * (2 * covariance + c2) / ((mean_a**2 + mean_b**2 + c1) * (variances + c2))
    ).mean()


def ssim_of(a: np.ndarray, b: np.ndarray, known: np.ndarray | None = None, *, device: str = "cpu") -> float:
    """Return ``ssim`` of two pictures (H, W, 3), with pixels that are not ``known`` (H, W) treated as equal.

    It is computed on ``device``; on a GPU in double precision, because cuDNN may round single precision to TF32.
    """
    if known is not None:
        a = np.where(known[:, :, None], a, b)
    precision = torch.float32 if device == "cpu" else torch.float64
    return float(ssim(*(torch.as_tensor(each, dtype=precision, device=device) for each in (a, b))))


def psnr(a: np.ndarray, b: np.ndarray, known: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio, dB, of two pictures (H, W, 3) in 0 to 1 over the ``known`` (H, W) pixels;
    at most 100."""
    if a.shape != b.shape or a.size == 0:
        raise UserError(f"psnr: the pictures have the shapes {a.shape} and {b.shape}; give two of one shape")
    squared_error = (a.astype(np.float64) - b) ** 2
    return float(-10.0 * np.log10(max(float(np.mean(squared_error if known is None else squared_error[known])), 1e-10)))


def match_tone(photo: np.ndarray, picture: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
    """Return ``picture`` (H, W, 3) after the affine colour map that best fits it to ``photo`` in the ``known`` (H, W)
    pixels.

    The map has twelve coefficients and is fitted to the whole photo. It removes differences in exposure and white
    balance, as is common in the evaluation of held-out photos.
    """
    target, seen = (of.reshape(-1, 3) if known is None else of[known] for of in (photo, picture))
    rows = np.column_stack([seen, np.ones(len(seen))]).astype(np.float64)
    mixing = np.linalg.lstsq(rows.T @ rows, rows.T @ target.astype(np.float64), rcond=None)[0]
    return (picture @ mixing[:3] + mixing[3]).astype(np.float32)
