"""Photos with poses, read as training views.

Imports torch through ``egs_warp.training.finetune``, so import it only where a training runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.cameras import read_cameras
from egs_warp.io.photos import read_photo
from egs_warp.training.finetune import TrainingView


@dataclass(frozen=True)
class ExcludedPhoto:
    """A photo that is not used."""

    name: str
    reason: str
    """Reason, for the user."""


@dataclass(frozen=True)
class PosedPhotos:
    """Photos that belong to a file of poses."""

    views: tuple[TrainingView, ...]
    """Usable photos, undistorted and upright."""
    left_out: tuple[ExcludedPhoto, ...]
    """Photos that cannot be used."""


def read_views(posed: Path | str, *, max_side: int | None = None) -> PosedPhotos:
    """Read photos and cameras (``read_photo``); photos larger than ``max_side`` pixels are reduced.

    Photos that are missing, unreadable or of another shape than their camera are excluded. Raises ``UserError`` if none
    can be used.
    """
    views, left_out = [], []
    for entry in read_cameras(posed):
        try:
            photo = read_photo(entry, max_side=max_side)
        except UserError as error:
            left_out.append(ExcludedPhoto(entry.name, str(error)))
            continue
        weight = None if photo.known is None else photo.known.astype(np.float32)
        views.append(TrainingView(photo.camera, photo.colour, photo.alpha, weight, entry.name))
    if not views:
        raise UserError(f"{posed}: none of its {len(left_out)} photos can be used; the first: {left_out[0].reason}")
    return PosedPhotos(tuple(views), tuple(left_out))


def laid_over(view: TrainingView, background: tuple[float, float, float]) -> TrainingView:
    """Composite the picture of ``view`` over one colour; the result has no alpha."""
    if view.alpha is None:
        return view
    alpha = view.alpha[:, :, None]
    behind = np.asarray(background, dtype=np.float32)
    return replace(view, image=view.image * alpha + (1 - alpha) * behind, alpha=None)


def backdrop_colour(views: Sequence[TrainingView]) -> tuple[float, float, float]:
    """Return white for photos with alpha, else the mean colour along the borders of all photos."""
    if any(view.alpha is not None for view in views):
        return (1.0, 1.0, 1.0)
    rims = []
    for view in views:
        known = np.ones(view.image.shape[:2], bool) if view.weight is None else view.weight > 0
        rim = [(of[0], of[-1], of[:, 0], of[:, -1]) for of in (view.image, known)]
        chosen = np.concatenate(rim[0])[np.concatenate(rim[1])]
        rims.append((chosen if len(chosen) else view.image[known]).mean(axis=0))
    red, green, blue = np.mean(rims, axis=0).tolist()
    return (red, green, blue)
