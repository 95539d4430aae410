"""Reading of posed photos as training views.

This module imports torch through ``egs_warp.training.finetune``; import it only where a training runs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.cameras import read_posed_images
from egs_warp.io.photo_files import photos_without_pose
from egs_warp.io.photos import read_photo
from egs_warp.io.posed_images import ExcludedPhoto
from egs_warp.training.mask_colours import is_object_black
from egs_warp.training.training_view import TrainingView


@dataclass(frozen=True)
class PhotoSources:
    """Origin of the photos of a training run."""

    poses: str
    """The file of poses, or the folder of a COLMAP model."""
    total: int
    """Number of photos in the file of poses."""
    used: int
    folders: tuple[tuple[str, int], ...]
    """Number of photos used from each folder of photos."""
    masked: int
    """Number of used photos with a mask or an alpha channel."""
    notes: tuple[str, ...]
    """Messages for the user about the choice of the files and their content."""

    def summary(self) -> str:
        """Return a line for the terminal."""
        folders = ", ".join(f"{count} in {folder}" for folder, count in self.folders)
        masks = "none with a mask" if self.masked == 0 else f"{self.masked} with masks"
        return f"photos: {self.used} of {self.total} used ({folders}; poses of {self.poses}), {masks}"


@dataclass(frozen=True)
class PosedPhotos:
    """Photos that belong to one file of poses."""

    views: tuple[TrainingView, ...]
    """Usable photos, undistorted and upright."""
    left_out: tuple[ExcludedPhoto, ...]
    """Photos that cannot be used."""
    sources: PhotoSources


def read_views(posed: Path | str, *, max_side: int | None = None, inverted_masks: bool | None = None) -> PosedPhotos:
    """Read photos and cameras (``read_photo``); photos larger than ``max_side`` pixels are reduced.

    Photos that are missing or unreadable, or do not fit their camera, are excluded. With ``inverted_masks``, the object
    is black in masks; None detects it (``is_object_black``). Raises ``UserError`` if no photo can be used.
    """
    poses = read_posed_images(posed)
    notes = list(poses.notes)
    is_black = is_object_black(poses.images) if inverted_masks is None else inverted_masks
    if is_black and inverted_masks is None:
        notes.append("the object is black in the masks, so they are inverted (docs/guide/photos.md#masks)")
    views, left_out, opaque = [], list(poses.excluded), set()
    folders: Counter[str] = Counter()
    for entry in poses.images:
        try:
            photo = read_photo(entry, max_side=max_side, is_mask_inverted=is_black)
        except UserError as error:
            left_out.append(ExcludedPhoto(entry.name, str(error)))
            continue
        if entry.missing:
            notes.append(f"{entry.name} is used without a mask: {entry.missing}")
        if photo.is_opaque and photo.alpha is None:
            opaque.add(len(views))
        assert entry.image is not None
        folders[_relative(entry.image.parent, Path(posed))] += 1
        weight = None if photo.known is None else photo.known.astype(np.float32)
        views.append(TrainingView(photo.camera, photo.colour, photo.alpha, weight, entry.name))
    if not views:
        raise UserError(f"{posed}: none of its {len(left_out)} photos can be used; the first: {left_out[0].reason}")
    masked = sum(view.alpha is not None for view in views)
    if masked:
        # If other photos are cut out by their alpha, an alpha channel that is opaque everywhere means that the object
        # fills the photo.
        for number in opaque:
            image = views[number].image
            views[number] = replace(views[number], alpha=np.ones(image.shape[:2], np.float32))
        masked += len(opaque)
        if masked < len(views):
            notes.append(
                f"photos without a mask, which show their background: {len(views) - masked} of {len(views)}; add masks,"
                " or remove these photos"
            )
    images = [one.image for one in poses.images if one.image is not None]
    for folder, count in photos_without_pose(images, [one.name for one in poses.excluded]).items():
        notes.append(f"photos in {_relative(folder, Path(posed))} without a pose, not used: {count}")
    sources = PhotoSources(
        poses=_relative(poses.source, Path(posed)),
        total=len(views) + len(left_out),
        used=len(views),
        folders=tuple(sorted(folders.items(), key=lambda one: (-one[1], one[0]))),
        masked=masked,
        notes=tuple(notes),
    )
    return PosedPhotos(tuple(views), tuple(left_out), sources)


def _relative(path: Path, folder: Path) -> str:
    """Return ``path`` relative to the user's ``folder`` if it is inside; otherwise the full path."""
    return path.relative_to(folder).as_posix() if path != folder and path.is_relative_to(folder) else str(path)


def laid_over(view: TrainingView, background: tuple[float, float, float]) -> TrainingView:
    """Composite the picture of ``view`` over a single colour; the result has no alpha."""
    if view.alpha is None:
        return view
    alpha = view.alpha[:, :, None]
    behind = np.asarray(background, dtype=np.float32)
    return replace(view, image=view.image * alpha + (1 - alpha) * behind, alpha=None)


def backdrop_colour(views: Sequence[TrainingView]) -> tuple[float, float, float]:
    """Return the background colour: white if the photos have alpha, otherwise the mean colour along the borders of all
    photos."""
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
