"""Planes on disk: ``plane.json``, which all stages from a scene to an animation read."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.height_field import HeightField, check_grid
from egs_warp.geometry.main_light import MainLight
from egs_warp.geometry.plane import Plane
from egs_warp.io.atomic import atomic_write
from egs_warp.io.limits import MAX_COORDINATE, MAX_TEXT_BYTES, read_bytes
from egs_warp.io.text import load_json, whole_number

_MAX_TEXELS = 1 << 13
"""Maximum number of rows or columns of the window of a hole."""


@dataclass(frozen=True)
class HoleOutline:
    """A hole in a plane, described by outlines in a window on the plane."""

    centre: np.ndarray
    """(3,) centre of the window, scene units."""
    texel: float
    """Side of a texel, scene units."""
    texels: tuple[int, int]
    """Rows and columns of the window."""
    outlines: tuple[np.ndarray, ...]
    """Polygons (k, 2) int32 around the hole; columns and rows in texels."""

    def to_json(self) -> dict[str, Any]:
        """Return the hole as the entry ``hole`` of a plane."""
        return {
            "centre": self.centre.tolist(),
            "texel": self.texel,
            "texels": list(self.texels),
            "outlines": [outline.tolist() for outline in self.outlines],
        }

    @classmethod
    def from_json(cls, entry: Any, path: Path) -> HoleOutline:
        """Convert from JSON; inverse of ``to_json``. Raises ``UserError`` for invalid data."""
        try:
            rows, columns = (int(count) for count in entry["texels"])
            outlines = tuple(np.array(outline, np.int32).reshape(-1, 2) for outline in entry["outlines"])
            centre, texel = np.array(entry["centre"], dtype=float).reshape(3), float(entry["texel"])
            inside = all((outline >= 0).all() and (outline < [columns, rows]).all() for outline in outlines)
            if not (1 <= rows <= _MAX_TEXELS and 1 <= columns <= _MAX_TEXELS and inside):
                raise ValueError
            if not (0.0 < texel < np.inf and np.isfinite(centre).all()):
                raise ValueError
            return cls(centre, texel, (rows, columns), outlines)
        except (TypeError, KeyError, ValueError, OverflowError, AttributeError) as error:
            raise UserError(f"{path}: its hole is not valid; write the file again with egs-warp segment") from error


@dataclass(frozen=True)
class PlaneRecord:
    """A plane and its known properties, in scene units."""

    plane: Plane
    centre: np.ndarray | None = None
    """(3,) centre of the object on the plane."""
    size: float | None = None
    """Diagonal of the object's bounding box."""
    noise: float | None = None
    """Relative noise of the depth to which the plane was fitted."""
    inlier_share: float | None = None
    pixels: int | None = None
    """Number of pixels to which the plane was fitted."""
    support: float | None = None
    """Share of the visible surface that lies on the plane."""
    hole: HoleOutline | None = None
    """Hole that the removed object leaves in the plane; None if there is none."""
    ground: HeightField | None = None
    """Height field of the ground if it is uneven; None if the plane is the ground."""
    others: Mapping[str, Any] = field(default_factory=dict)
    """Other entries of the file; they are written back unchanged."""
    light: MainLight | None = None
    """Main light of the capture; None if its estimate is uncertain."""

    def merged_with(self, known: PlaneRecord) -> PlaneRecord:
        """Return this plane, with missing properties taken from ``known``."""
        facts = {name: value for name in _FACTS if (value := getattr(self, name)) is not None}
        earlier = {name: getattr(known, name) for name in _FACTS}
        return PlaneRecord(self.plane, **(earlier | facts), others={**known.others, **self.others})

    def to_json(self) -> dict[str, Any]:
        """Return the plane as an entry of ``planes``."""
        facts = {name: value for name in _FACTS if (value := getattr(self, name)) is not None}
        if self.centre is not None:
            facts["centre"] = self.centre.tolist()
        if self.hole is not None:
            facts["hole"] = self.hole.to_json()
        if self.ground is not None:
            facts["ground"] = _ground_to_json(self.ground)
        if self.light is not None:
            facts["light"] = light_to_json(self.light)
        return {"normal": self.plane.normal.tolist(), "offset": self.plane.offset, **facts, **self.others}

    @classmethod
    def from_json(cls, entry: Any, path: Path, number: int) -> PlaneRecord:
        """Convert from JSON; inverse of ``to_json``. Raises ``UserError`` for invalid data."""
        try:
            normal = np.array(entry["normal"], dtype=float).reshape(3)
            offset = float(entry["offset"])
        except (TypeError, KeyError, ValueError, OverflowError) as error:
            raise UserError(f"{path}: plane {number} needs normal [x, y, z] and offset; make it again") from error
        nx, ny, nz = normal.tolist()
        plane = Plane.from_coefficients(nx, ny, nz, offset)
        if abs(plane.offset) > MAX_COORDINATE:
            raise UserError(
                f"{path}: plane {number} lies {abs(plane.offset):g} units from the origin, the limit is"
                f" {MAX_COORDINATE:g}; make it again"
            )
        try:
            centre = np.array(entry["centre"], dtype=float).reshape(3) if "centre" in entry else None
            numbers = {name: float(entry[name]) for name in _NUMBERS if name in entry}
            if not np.isfinite([*numbers.values(), *(() if centre is None else centre)]).all():
                raise ValueError
            return cls(
                plane,
                centre=centre,
                **numbers,
                pixels=int(entry["pixels"]) if "pixels" in entry else None,
                hole=HoleOutline.from_json(entry["hole"], path) if "hole" in entry else None,
                ground=_ground_from_json(entry["ground"], path) if "ground" in entry else None,
                light=_light_of_entry(entry["light"], path) if "light" in entry else None,
                others={name: value for name, value in entry.items() if name not in ("normal", "offset", *_FACTS)},
            )
        except (TypeError, ValueError, OverflowError) as error:
            if isinstance(error, UserError):
                raise
            raise UserError(f"{path}: the properties of plane {number} are damaged; make it again") from error


def _ground_to_json(ground: HeightField) -> dict[str, Any]:
    # Round to a thousandth of the node spacing, which is far below the accuracy of depth.
    digits = max(0, 3 - int(np.floor(np.log10(ground.spacing))))
    return {
        "axes": ground.axes.tolist(),
        "origin": ground.origin.tolist(),
        "spacing": ground.spacing,
        "coefficients": np.round(ground.coefficients, digits).tolist(),
    }


def _ground_from_json(entry: Any, path: Path) -> HeightField:
    """Convert from JSON; inverse of ``_ground_to_json``. Raises ``UserError`` for invalid data."""
    try:
        ground = HeightField(
            np.array(entry["axes"], dtype=float).reshape(3, 3),
            np.array(entry["origin"], dtype=float).reshape(3),
            float(entry["spacing"]),
            np.atleast_2d(np.array(entry["coefficients"], dtype=float)),
        )
        check_grid(ground)
    except (TypeError, KeyError, ValueError, OverflowError, AttributeError, UserError) as error:
        raise UserError(f"{path}: its ground is damaged; write the file again with egs-warp segment") from error
    return ground


def light_to_json(light: MainLight) -> dict[str, Any]:
    """Return a light as a JSON object, the form in which ``plane.json``, bundles and pages store it."""
    return {
        "direction": light.direction.tolist(),
        "half_angle": light.half_angle,
        "shade": light.shade,
        "irradiance": light.irradiance.tolist(),
    }


def light_from_json(entry: Any) -> MainLight:
    """Convert from JSON; inverse of ``light_to_json``. Raises ``ValueError`` for invalid data."""
    try:
        return MainLight(
            np.array(entry["direction"], dtype=float).reshape(3),
            float(entry["half_angle"]),
            float(entry["shade"]),
            np.array(entry["irradiance"], dtype=float).reshape(4, 4),
        )
    except (TypeError, KeyError, ValueError, OverflowError, AttributeError) as error:
        raise ValueError("the direction, angle, shade or irradiance of the light is invalid") from error


def _light_of_entry(entry: Any, path: Path) -> MainLight:
    """Return the light of an entry of ``planes``. Raises ``UserError`` for invalid data."""
    try:
        return light_from_json(entry)
    except ValueError as error:
        raise UserError(f"{path}: its light is damaged; write the file again with egs-warp segment") from error


_NUMBERS = ("size", "noise", "inlier_share", "support")
_FACTS = tuple(one.name for one in fields(PlaneRecord) if one.name not in ("plane", "others"))


def write_planes(path: Path | str, planes: Sequence[PlaneRecord]) -> None:
    """Write ``planes``, in units of the capture; the object rests on the first one."""
    entries = [known.to_json() for known in planes]
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({"planes": entries}, indent=1))


def read_planes(path: Path | str) -> list[PlaneRecord]:
    """Read the planes of a ``plane.json``. Raises ``UserError`` if the file is missing, is not a ``plane.json`` or has
    no planes."""
    path = Path(path)
    try:
        data = read_bytes(path, at_most=MAX_TEXT_BYTES, missing="make it with egs-warp plane, or give nx,ny,nz,d")
        tree = load_json(data, parse_int=whole_number)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"{path}: not readable JSON; make it with egs-warp plane") from error
    entries = tree.get("planes") if isinstance(tree, dict) else None
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{path}: it has no planes; make it with egs-warp plane")
    return [PlaneRecord.from_json(entry, path, number) for number, entry in enumerate(entries)]
