"""Terrain in addition to the ground plane: solids that a body can touch (steps, walls, tilted floors), each an
intersection of half spaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from egs_warp.checked_calls import checked_constructor
from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.plane import Plane
from egs_warp.io.text import json_excerpt, parse_json, read_text
from egs_warp.short_repr import short_repr

MAX_FACES = 64
"""Maximum number of faces in a terrain file."""


class Surface(Protocol):
    """Protocol of the surfaces that a body can stand on: ``Solid`` and ``HeightField``."""

    def distance_along(self, point: np.ndarray, up: np.ndarray) -> float:
        """Return the signed distance along ``up`` (3,) from ``point`` (3,) to the top of the surface; -inf if the line
        through the point does not meet the surface."""
        ...


@checked_constructor
@dataclass(frozen=True)
class Solid:
    """Convex solid, the intersection of the half spaces behind its faces. One face makes a half space, such as a floor
    or a wall."""

    __repr__ = short_repr

    faces: tuple[Plane, ...]
    """Faces with outward normals."""

    def __post_init__(self) -> None:
        if not self.faces:
            raise ArgumentError("faces", "the list is empty; give at least one Plane")

    def scaled(self, factor: float) -> Solid:
        """Return the solid with all lengths multiplied by ``factor``."""
        return Solid(tuple(face.scaled(factor) for face in self.faces))

    def contains(self, point: np.ndarray) -> bool:
        """Return True if ``point`` (3,) is in the solid."""
        return all(float(face.heights(point)) <= 0.0 for face in self.faces)

    def distance_along(self, point: np.ndarray, up: np.ndarray) -> float:
        """Return the signed distance along ``up`` (3,) from ``point`` (3,) to the top of the solid; -inf if the line
        through the point does not meet the solid, or the solid has no top."""
        low, high = -np.inf, np.inf
        for face in self.faces:
            height, slope = float(face.heights(point)), float(face.normal @ up)
            if slope > 1e-9:
                high = min(high, -height / slope)
            elif slope < -1e-9:
                low = max(low, -height / slope)
            elif height > 0.0:
                return -np.inf
        return high if low <= high < np.inf else -np.inf


def step(ground: Plane, edge: np.ndarray, forward: np.ndarray, height: float) -> Solid:
    """Create a stair step that extends without limit behind its edge.

    Args:
        ground: ground plane.
        edge: (3,) point on the front edge.
        forward: (3,) direction in which the step extends.
        height: height above the ground.
    """
    flat = forward - (forward @ ground.normal) * ground.normal
    flat = flat / np.linalg.norm(flat)
    return Solid((Plane(ground.normal, ground.offset - height), Plane(-flat, float(flat @ edge))))


def read_terrain(path: Path) -> tuple[Solid, ...]:
    """Read solids from JSON, in the units of the capture: a list of solids, each a list of faces [nx, ny, nz, d].

    A point is inside where n.x + d < 0 for every face.

    Raises:
        UserError: the file has no solids or too many faces, or a solid is malformed; the message gives its number.
    """
    entries = parse_json(read_text(path), path)
    if not isinstance(entries, list) or not entries:
        found = json_excerpt(entries)
        raise UserError(f"{path}: it contains {found}; give a list of solids, each a list of faces [nx, ny, nz, d]")
    solids = []
    for number, faces in enumerate(entries, start=1):
        if not isinstance(faces, list) or not faces or not all(_is_face(face) for face in faces):
            wrong = next((face for face in faces if not _is_face(face)), faces) if isinstance(faces, list) else faces
            raise UserError(
                f"{path}, solid {number}: it contains {json_excerpt(wrong)}; give a list of faces, each four"
                " numbers [nx, ny, nz, d]"
            )
        try:
            solids.append(Solid(tuple(Plane.from_coefficients(*face) for face in faces)))
        except UserError as error:
            raise UserError(f"{path}, solid {number}: {error}") from None
    count = sum(len(solid.faces) for solid in solids)
    if count > MAX_FACES:
        raise UserError(f"{path}: the solids have {count} faces, the limit is {MAX_FACES}; simplify them")
    return tuple(solids)


def _is_face(face: object) -> bool:
    return (
        isinstance(face, list)
        and len(face) == 4
        and all(isinstance(value, int | float) and not isinstance(value, bool) for value in face)
    )


def surface_above(solids: Sequence[Surface], point: np.ndarray, up: np.ndarray) -> float:
    """Return the signed distance along ``up`` (3,) from ``point`` (3,) to the highest surface; -inf if there is
    none."""
    return max((solid.distance_along(point, up) for solid in solids), default=-np.inf)
