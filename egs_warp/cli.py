"""The command ``egs-warp``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError

_AXES = {"x": 0, "y": 1, "z": 2}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; bad input prints one line and returns 2."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    try:
        return chosen.run(chosen)
    except UserError as error:
        print(f"egs-warp: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="egs-warp", description="Still objects in 3DGS captures walk, jump and twist."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    animate = commands.add_parser("animate", help="bring a capture to life")
    animate.add_argument("capture", help=".ply, compressed .ply, .spz, .splat, .sog or an unbundled SOG folder")
    animate.add_argument("--motion", default="jump", help="jump (default)")
    animate.add_argument("--out", required=True, type=Path, help="folder for video, sheet, report and trajectory")
    animate.add_argument("--up", help="axis that points up: x, y, z or with a minus, as --up=-y; else it is guessed")
    animate.add_argument(
        "--plane", help="nx,ny,nz,d of the ground n.x + d = 0 in the capture's units; else it is found"
    )
    animate.add_argument("--distance", type=float, help="of the jump, body heights (0.5)")
    animate.add_argument("--height", type=float, help="rise of the centre of mass, body heights (0.2)")
    animate.add_argument("--frames", type=int, help="length of the video at 60 Hz (120)")
    animate.add_argument("--size", type=int, help="pixels, both sides (512)")
    animate.add_argument("--seed", type=int, help="recorded in the report; a jump has nothing random (0)")
    animate.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    animate.add_argument("--metres-per-unit", type=float, help="true scale; else the body is 1 m tall")
    animate.add_argument("--friction", type=float, help="Coulomb coefficient (0.8)")
    animate.set_defaults(run=_animate)
    return parser


def parse_up(text: str) -> np.ndarray:
    """(3,) unit vector of an axis name such as ``-y``. Raises ``UserError`` otherwise."""
    name = text.strip().lower().lstrip("+-")
    if name not in _AXES:
        raise UserError(f"--up {text}: give one of x, y, z, -x, -y, -z (write --up=-y)")
    up = np.zeros(3)
    up[_AXES[name]] = -1.0 if text.strip().startswith("-") else 1.0
    return up


def parse_plane(text: str):
    """Plane from ``nx,ny,nz,d``. Raises ``UserError`` otherwise."""
    from egs_warp.plane import Plane

    try:
        nx, ny, nz, d = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(f"--plane {text}: give four numbers nx,ny,nz,d") from error
    return Plane.from_coefficients(nx, ny, nz, d)


def _animate(chosen: argparse.Namespace) -> int:
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    from egs_warp.animation import animate, as_options, summary
    from egs_warp.base_plane import guess_up
    from egs_warp.io import read_capture

    options = as_options(
        distance=chosen.distance,
        height=chosen.height,
        frames=chosen.frames,
        size=chosen.size,
        seed=chosen.seed,
        metres_per_unit=chosen.metres_per_unit,
        friction=chosen.friction,
    )
    if chosen.device not in [str(device) for device in wp.get_devices()]:
        known = ", ".join(str(device) for device in wp.get_devices())
        raise UserError(f"--device {chosen.device}: this machine has {known}")
    up = parse_up(chosen.up) if chosen.up else None
    plane = parse_plane(chosen.plane) if chosen.plane else None
    capture = read_capture(chosen.capture, device=chosen.device)
    notes = list(capture.notes)
    if capture.infinite_opacities:
        notes.append(f"{capture.infinite_opacities} infinite opacities were read as 0 or 1")
    if plane is None and up is None:
        up, reason = guess_up(capture.cloud, capture.up)
        axis = "xyz"[int(np.argmax(np.abs(up)))]
        notes.append(f"up is taken to be {'-' if up.sum() < 0 else '+'}{axis} ({reason}); if not, give --up")
        print(f"egs-warp: {notes[-1]}", file=sys.stderr)
    report = animate(
        capture.cloud,
        chosen.out,
        motion=chosen.motion,
        up=up,
        plane=plane,
        options=options,
        source=Path(chosen.capture).name,
        notes=tuple(notes),
    )
    print(summary(report))
    print(f"wrote {chosen.out}/{chosen.motion}.mp4, sheet.png, report.json, trajectory.npz")
    return 0


if __name__ == "__main__":
    sys.exit(main())
