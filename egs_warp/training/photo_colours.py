"""Conversion of photos to the colours of a capture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import downscale
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.cameras import PosedImage
from egs_warp.io.photos import read_photo
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.training import has_torch

if TYPE_CHECKING:
    from egs_warp.training.training_view import TrainingView

_PHOTO_SIDE = 320
"""Longer side to which photos are reduced, in pixels; it suffices for the few Gaussians at an object's foot."""
_OPAQUE = 0.98
"""Minimum opacity of the capture at pixels whose colours are matched."""
_MATCHING_ROUNDS, _MATCHED_PIXELS = 20, 10_000
"""Number of rounds in which the best-matching pixels are selected, and maximum number of pixels, for fitting the
colours of a photo to the colours of the capture."""
_REGULARIZATION = 1e-5
"""Weight of the distance of the mixing matrix from the diagonal matrix that contains the separate gains of the
channels."""


def photographs_in_colours_of(cloud: GaussianCloud, posed: Sequence[PosedImage]) -> list[TrainingView]:
    """Read the photos of the cameras ``posed``, reduced to ``_PHOTO_SIDE`` pixels and converted to the colours of
    ``cloud``. The list is empty if PyTorch is not installed."""
    if not has_torch():
        return []
    from egs_warp.training.training_view import TrainingView

    views = []
    for one in posed:
        try:
            picture = read_photo(one)
        except UserError:
            # ``egs-warp train`` reports the reason why a photo cannot be read.
            continue
        small = downscale(picture.camera, _PHOTO_SIDE)
        size = (small.width, small.height)
        whole = np.rint(picture.colour * 255.0).astype(np.uint8)
        # Average blocks of whole pixels, like the reduced camera; resizing the whole photo would shift it by up to a
        # pixel.
        block = picture.camera.width // small.width
        used = np.ix_(range(block * small.height), range(block * small.width))
        photo = cv2.resize(whole[used], size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
        known = np.ones(photo.shape[:2], bool)
        if picture.known is not None:
            known = cv2.resize(picture.known[used].astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
        image = render_gaussians(cloud, small, background=(0.0, 0.0, 0.0))
        shared = (image.alpha.numpy() > _OPAQUE) & known
        matched = in_colours_of(np.clip(image.colour.numpy(), 0.0, 1.0), photo, shared)
        views.append(TrainingView(small, matched, weight=None if known.all() else known.astype(np.float32)))
    return views


def in_colours_of(reference: np.ndarray, photo: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return ``photo`` (H, W, 3) as float32, converted to the exposure and white balance of ``reference`` (H, W, 3).
    The conversion is fitted to the pixels selected by ``shared`` (H, W) bool.

    It is needed because training against the photo must not change colours relative to Gaussians that are not trained.
    The conversion is a linear mixing of the three channels, fitted by least squares to the three quarters of the pixels
    that agree best. With fewer than 100 shared pixels, the photo is returned unchanged.
    """
    if shared.sum() < 100:
        return photo
    few = slice(None, None, -(-int(shared.sum()) // _MATCHED_PIXELS))
    observed, target = photo[shared][few], reference[shared][few]
    rows = np.column_stack([observed, np.ones(len(observed))])
    gain = np.median(target, axis=0) / np.maximum(np.median(observed, axis=0), 1e-3)
    plain = np.concatenate([np.diag(gain), np.zeros((1, 3))])
    mixing = plain
    for _ in range(_MATCHING_ROUNDS):
        residual = np.linalg.norm(rows @ mixing - target, axis=1)
        agreeing = residual <= np.quantile(residual, 0.75)
        chosen, rest = rows[agreeing], target[agreeing] - rows[agreeing] @ plain
        # If there are too few different colours to determine the mixing, the separate gains of the channels remain.
        mixing = plain + np.linalg.solve(chosen.T @ chosen + _REGULARIZATION * len(chosen) * np.eye(4), chosen.T @ rest)
    return np.clip(photo @ mixing[:3] + mixing[3], 0.0, 1.0).astype(np.float32)
