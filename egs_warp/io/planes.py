"""Planes on disk: ``plane.json``, which every step of the way from a scene to an animation reads."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.plane import Plane
from egs_warp.io.atomic import atomic_write
from egs_warp.io.text import whole_number


def write_planes(path: Path | str, planes: Sequence[Plane], *, facts: Sequence[Mapping[str, object]] = ()) -> None:
    """Write ``planes`` (capture's units), the first being the one that the object rests on.

    ``facts`` are further entries of each, such as how well it fits.
    """
    entries = [
        {"normal": plane.normal.tolist(), "offset": plane.offset, **(facts[k] if k < len(facts) else {})}
        for k, plane in enumerate(planes)
    ]
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({"planes": entries}, indent=1))


def read_planes(path: Path | str) -> list[Plane]:
    """The planes of a ``plane.json``. Raises ``UserError`` for anything else."""
    return [plane for plane, _ in read_planes_and_facts(path)]


def read_planes_and_facts(path: Path | str) -> list[tuple[Plane, dict[str, Any]]]:
    """The planes of a ``plane.json``, each with its further entries. Raises ``UserError`` for anything else."""
    try:
        tree = json.loads(Path(path).read_bytes(), parse_int=whole_number)
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file; make it with egs-warp plane, or give nx,ny,nz,d") from error
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: not readable JSON; make it with egs-warp plane") from error
    entries = tree.get("planes") if isinstance(tree, dict) else None
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{path}: it has no planes; make it with egs-warp plane")
    read = []
    for number, entry in enumerate(entries):
        try:
            normal = np.array(entry["normal"], dtype=float).reshape(3)
            offset = float(entry["offset"])
        except (TypeError, KeyError, ValueError) as error:
            raise UserError(f"{path}: plane {number} needs normal [x, y, z] and offset; make it again") from error
        facts = {name: value for name, value in entry.items() if name not in ("normal", "offset")}
        nx, ny, nz = normal.tolist()
        read.append((Plane.from_coefficients(nx, ny, nz, offset), facts))
    return read
