"""Records of posed photos, and the checks that all readers of camera poses share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera, has_orthonormal_rows
from egs_warp.geometry.lens import Lens
from egs_warp.io.limits import MAX_COORDINATE, check_pixels, picture_size
from egs_warp.io.origin import COARSE_STEP

_MAX_FOCAL = 1e3
"""Maximum ratio of the focal length to the longer side of the photo; the minimum is its reciprocal."""
_MAX_CENTRE = 10.0
"""Maximum magnitude of a coordinate of the principal point, relative to the longer side of the photo."""
_MAX_OFFSET = 1e3
"""Maximum distance of the cameras from the origin, in radii of the camera path, at which single precision suffices."""

_Entry = TypeVar("_Entry")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class PosedImage:
    """A photo and its camera."""

    name: str
    camera: Camera
    image: Path | None
    """File of the photo; None if it was not found."""
    lens: Lens | None = None
    """Distortion of the photo; ``camera`` is the camera of the undistorted photo of the same size. None for a pinhole
    camera."""
    mask: Path | None = None
    """File of the photo's mask; None if there is none."""
    missing: str = ""
    """Reason why the photo or the mask was not found, for the user; empty if nothing specific is known."""


@dataclass(frozen=True)
class ExcludedPhoto:
    """A photo that is not used."""

    name: str
    reason: str
    """Reason for the exclusion, for the user."""


@dataclass(frozen=True)
class PosedImages:
    """Contents of a file of camera poses."""

    source: Path
    """The file, or the folder of the COLMAP model."""
    images: tuple[PosedImage, ...]
    """Photos with valid poses; at least one."""
    excluded: tuple[ExcludedPhoto, ...] = ()
    """Photos whose pose or camera is invalid."""
    notes: tuple[str, ...] = ()
    """Messages for the user about the choice of the files and their content."""
    origin: np.ndarray | None = None
    """(3,) float64: offset of georeferenced cameras, which was subtracted from their positions (``near_origin``)."""

    def relative_to(self, origin: np.ndarray | None) -> PosedImages:
        """Return the cameras relative to the ``origin`` (3,) of their capture; unchanged if it has none."""
        if origin is None:
            return self
        shift = origin if self.origin is None else origin - self.origin
        return replace(self, images=tuple(_shifted(self.images, shift)), origin=origin)

    @property
    def messages(self) -> tuple[str, ...]:
        """The notes, and a line for each excluded camera."""
        return (*self.notes, *(f"left out camera {one.name}: {one.reason}" for one in self.excluded))


def convert_each(
    entries: Iterable[tuple[str, _Entry]], convert: Callable[[_Entry], _Result], what: str
) -> tuple[list[_Result], list[ExcludedPhoto]]:
    """Convert named entries, excluding those that raise ``UserError``.

    Raises the first of these errors if no entry can be converted, and ``UserError`` with the message ``what`` if there
    are no entries.
    """
    results, excluded, first = [], [], None
    for name, entry in entries:
        try:
            results.append(convert(entry))
        except UserError as error:
            first = first or error
            excluded.append(ExcludedPhoto(name, str(error)))
    if not results:
        raise first or UserError(what)
    return results, excluded


def camera_of_photo(
    what: str,
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> Camera:
    """Return the camera of a photo. Raise ``UserError``, whose message begins with ``what``, for implausible values;
    the other arguments are those of ``Camera``."""
    check_pixels(width, height, what)
    side = max(width, height)
    focal = np.array([fx, fy]) / side
    middle = np.array([cx, cy]) / side
    if not ((focal > 1.0 / _MAX_FOCAL) & (focal < _MAX_FOCAL)).all() or not (abs(middle) < _MAX_CENTRE).all():
        raise UserError(
            f"{what}: focal lengths {fx:g}, {fy:g} and principal point {cx:g}, {cy:g} fit no photo of {width} x"
            f" {height} pixels; export the poses again"
        )
    if not (abs(translation) < MAX_COORDINATE).all():
        raise UserError(f"{what}: it lies more than {MAX_COORDINATE:g} units from the origin; export the poses again")
    if not is_rotation(rotation):
        raise UserError(f"{what}: its rotation is not one; export the poses again")
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, rotation=rotation, translation=translation)


def is_rotation(matrix: np.ndarray) -> bool:
    """Return True if ``matrix`` (3, 3) is a rotation to within three digits."""
    return has_orthonormal_rows(matrix) and bool(np.linalg.det(matrix) > 0.0)


def size_of_photo(image: Path | None, what: str) -> tuple[int, int]:
    """Return width and height of a photo as stored, from its header. Raises ``UserError``, whose message begins with
    ``what``, for a photo that is missing or not readable."""
    size = picture_size(image, f"{image}: it") if image is not None else None
    if size is None:
        raise UserError(f"{what}: the photo cannot be read, and the poses do not contain its size; add a readable copy")
    return size


def near_origin(poses: PosedImages) -> PosedImages:
    """Return poses without the offset of georeferenced cameras, which is too large for single precision; a note reports
    it."""
    middle, radius = _middle_and_radius(poses)
    if np.linalg.norm(middle) <= _MAX_OFFSET * radius or radius == 0.0:
        return poses
    offset = np.round(middle)
    note = (
        f"the cameras are {np.linalg.norm(middle):.0f} units from the origin; {', '.join(f'{x:.0f}' for x in offset)}"
        " was subtracted from their positions"
    )
    return replace(poses, images=tuple(_shifted(poses.images, offset)), notes=(*poses.notes, note), origin=offset)


def with_distance_note(poses: PosedImages) -> PosedImages:
    """Return poses with a note if they are so far from the origin that single precision is too coarse."""
    middle, radius = _middle_and_radius(poses)
    distance = float(np.linalg.norm(middle))
    step = float(np.spacing(np.float32(distance)))
    if step <= COARSE_STEP * radius or radius == 0.0:
        return poses
    note = (
        f"the cameras are {distance:.0f} units from the origin, where single precision has steps of {step:.2g} units,"
        f" {100.0 * step / radius:.2g} % of the radius of the camera path; export the poses with an offset"
    )
    return replace(poses, notes=(*poses.notes, note))


def _middle_and_radius(poses: PosedImages) -> tuple[np.ndarray, float]:
    """Return the median position (3,) of the cameras, and their maximum distance from it."""
    centres = np.array([one.camera.centre for one in poses.images])
    middle = np.median(centres, axis=0)
    return middle, float(np.linalg.norm(centres - middle, axis=1).max())


def _shifted(images: Iterable[PosedImage], shift: np.ndarray) -> Iterator[PosedImage]:
    """Iterate over ``images`` with ``shift`` (3,) subtracted from the positions of their cameras."""
    for one in images:
        camera = one.camera
        yield replace(one, camera=replace(camera, translation=camera.translation + camera.rotation @ shift))
