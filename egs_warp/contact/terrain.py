"""What there is to stand on: uneven ground, and solid things beside it that a body can touch (steps, walls, tilted
floors, each an intersection of half spaces).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.plane import Plane
from egs_warp.io.text import parse_json, read_text

MOST_FACES = 64


class Surface(Protocol):
    """Something to stand on: a ``Solid`` or a ``HeightField``."""

    def distance_along(self, point: np.ndarray, up: np.ndarray) -> float:
        """How far along ``up`` (3,) from ``point`` (3,) it ends; -inf where it is not above or below the point."""
        ...


@dataclass(frozen=True)
class Solid:
    """Everything behind all of its faces; one face is a half space, as a floor or a wall."""

    faces: tuple[Plane, ...]
    """Normals point out of the solid."""

    def scaled(self, factor: float) -> Solid:
        """The same solid after all lengths are multiplied by ``factor``."""
        return Solid(tuple(face.scaled(factor) for face in self.faces))

    def distance_along(self, point: np.ndarray, up: np.ndarray) -> float:
        """How far along ``up`` (3,) from ``point`` (3,) the solid ends;
        -inf where it is not above or below the point.
        """
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
    """A step of ``height`` on ``ground`` that begins at the point ``edge`` (3,) and goes on ``forward`` (3,)."""
    flat = forward - (forward @ ground.normal) * ground.normal
    flat = flat / np.linalg.norm(flat)
    return Solid((Plane(ground.normal, ground.offset - height), Plane(-flat, float(flat @ edge))))


def read_terrain(path: Path) -> tuple[Solid, ...]:
    """Solids from JSON, in the units of the capture: a list of solids, each a list of faces [nx, ny, nz, d].

    A point is inside where n.x + d < 0 for every face. Raises ``UserError`` for the first malformed entry, with its
    place.
    """
    entries = parse_json(read_text(path), path)
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{path}: give a list of solids, each a list of faces [nx, ny, nz, d]")
    solids = []
    for number, faces in enumerate(entries, start=1):
        if not isinstance(faces, list) or not faces or not all(_is_face(face) for face in faces):
            raise UserError(f"{path}, solid {number}: give a list of faces, each four numbers [nx, ny, nz, d]")
        try:
            solids.append(Solid(tuple(Plane.from_coefficients(*face) for face in faces)))
        except UserError as error:
            raise UserError(f"{path}, solid {number}: {error}") from None
    count = sum(len(solid.faces) for solid in solids)
    if count > MOST_FACES:
        raise UserError(f"{path}: {count} faces; at most {MOST_FACES} are handled")
    return tuple(solids)


def _is_face(face: object) -> bool:
    return (
        isinstance(face, list)
        and len(face) == 4
        and all(isinstance(value, int | float) and not isinstance(value, bool) for value in face)
    )


def surface_above(solids: Sequence[Surface], point: np.ndarray, up: np.ndarray) -> float:
    """How far along ``up`` (3,) from ``point`` (3,) the highest surface is; -inf over nothing."""
    return max((solid.distance_along(point, up) for solid in solids), default=-np.inf)
