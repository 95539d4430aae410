"""Photographs in the colours of a capture."""

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
    from egs_warp.training.finetune import TrainingView

_PHOTO_SIDE = 320
"""Pixels: enough for the few Gaussians at an object's foot."""
_OPAQUE = 0.98
"""Where less of the capture covers a pixel, it does not tell the photo's colours."""
_MATCHING_ROUNDS, _MATCHED_PIXELS = 20, 10_000
"""Of choosing the pixels that agree, when a photo's colours are matched to the capture's, and out of how many."""
_OPEN = 1e-5
"""Pull of the mixing matrix towards that of the gains alone."""


def photographs_in_colours_of(cloud: GaussianCloud, posed: Sequence[PosedImage]) -> list[TrainingView]:
    """The photos beside the cameras ``posed``, reduced to ``_PHOTO_SIDE`` pixels and in the colours of ``cloud``; none
    without PyTorch."""
    if not has_torch():
        return []
    from egs_warp.training.finetune import TrainingView

    views = []
    for one in posed:
        try:
            picture = read_photo(one)
        except UserError:
            # Whoever wants to know why asks ``train``.
            continue
        small = downscale(picture.camera, _PHOTO_SIDE)
        size = (small.width, small.height)
        whole = np.rint(picture.colour * 255.0).astype(np.uint8)
        # Blocks of whole pixels, as the camera has them: stretched to all of the photo it would be off by a pixel.
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
    """(H, W, 3) float32: ``photo`` (H, W, 3) with the exposure and white balance of ``reference`` (H, W, 3), as the
    pixels ``shared`` (H, W) bool tell them: what is trained against it must not change colour beside what is not.

    The three channels are mixed linearly, by least squares over the three quarters that agree best; without 100 shared
    pixels nothing changes.
    """
    if shared.sum() < 100:
        return photo
    few = slice(None, None, -(-int(shared.sum()) // _MATCHED_PIXELS))
    seen, wanted = photo[shared][few], reference[shared][few]
    rows = np.column_stack([seen, np.ones(len(seen))])
    gain = np.median(wanted, axis=0) / np.maximum(np.median(seen, axis=0), 1e-3)
    plain = np.concatenate([np.diag(gain), np.zeros((1, 3))])
    mixing = plain
    for _ in range(_MATCHING_ROUNDS):
        off = np.linalg.norm(rows @ mixing - wanted, axis=1)
        agreeing = off <= np.quantile(off, 0.75)
        chosen, rest = rows[agreeing], wanted[agreeing] - rows[agreeing] @ plain
        # What few colours leave open stays with the gain of each channel.
        mixing = plain + np.linalg.solve(chosen.T @ chosen + _OPEN * len(chosen) * np.eye(4), chosen.T @ rest)
    return np.clip(photo @ mixing[:3] + mixing[3], 0.0, 1.0).astype(np.float32)
