"""Reading of flags that several commands share."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from egs_warp.errors import UserError

if TYPE_CHECKING:
    from egs_warp.geometry.plane import Plane
    from egs_warp.io.capture import Capture

Commands: TypeAlias = "argparse._SubParsersAction[Any]"
"""What a command adds its parser to."""

_AXES = {"x": 0, "y": 1, "z": 2}


def parse_up(text: str) -> np.ndarray:
    """(3,) unit vector of an axis name such as ``-y``. Raises ``UserError`` otherwise."""
    name = text.strip().lower().lstrip("+-")
    if name not in _AXES:
        raise UserError(f"--up {text}: give one of x, y, z, -x, -y, -z")
    up = np.zeros(3)
    up[_AXES[name]] = -1.0 if text.strip().startswith("-") else 1.0
    return up


def parse_direction(flag: str, text: str) -> np.ndarray:
    """(3,) unit vector from ``x,y,z``, or of an axis name such as ``-y``. Raises ``UserError`` otherwise."""
    if text.strip().lower().lstrip("+-") in _AXES:
        return parse_up(text)
    try:
        direction = np.array([float(part) for part in text.split(",")])
    except ValueError:
        direction = np.zeros(0)
    length = float(np.linalg.norm(direction))
    if len(direction) != 3 or not np.isfinite(length) or length == 0.0:
        raise UserError(f"--{flag} {text}: give three numbers x,y,z or an axis as -y")
    return direction / length


def parse_plane(text: str) -> Plane:
    """Plane from ``nx,ny,nz,d``. Raises ``UserError`` otherwise."""
    from egs_warp.geometry.plane import Plane

    try:
        nx, ny, nz, d = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(f"--plane {text}: give four numbers nx,ny,nz,d") from error
    return Plane.from_coefficients(nx, ny, nz, d)


def check_device(name: str) -> None:
    """Raises ``UserError`` where Warp sees no such device."""
    import warp as wp

    if name not in (devices := [str(device) for device in wp.get_devices()]):
        raise UserError(f"--device {name}: this machine has {', '.join(devices)}")


def guessed_up(capture: Capture) -> tuple[np.ndarray, str]:
    """(3,) up of a ``Capture`` whose file cannot tell, and what to say about it."""
    from egs_warp.segmentation.base_plane import guess_up

    up, reason = guess_up(capture.cloud, capture.up)
    axis = "xyz"[int(np.argmax(np.abs(up)))]
    return up, f"up is taken to be {'-' if up.sum() < 0 else '+'}{axis} ({reason}); if not, give --up"
