"""How a run is filmed: from where, how large, how often, over what."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.frames import box_corners
from egs_warp.io.text import parse_json, read_text
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.trajectory import Trajectory

SMALLEST_SIDE, LARGEST_SIDE = 16, 4096
"""Pixels of a film."""
FASTEST = 1000.0
_SMOOTH = 0.25
"""Seconds: standard deviation of the window over which a camera that follows is slow."""
_ROOM = 1.2
"""Of a camera that follows: how much more than the body it holds."""
_RIM = 0.06
"""Of the shorter side of a picture: left free by a camera that goes around."""
_TURNTABLE = 4.0
"""Seconds of a turn about a body that is held."""


class CameraMove(StrEnum):
    """How a camera moves by itself."""

    FIXED = "fixed"
    FOLLOW = "follow"
    ORBIT = "orbit"


@dataclass(frozen=True)
class Shot:
    """What a user may ask of a film."""

    camera: str = CameraMove.FIXED
    """``fixed``, ``follow``, ``orbit`` (once around in the film), or the name of a JSON file with key cameras."""
    size: tuple[int, int] | None = None
    """Pixels across and down; None: as the film's."""
    fps: float = FRAME_RATE
    """Frames for one second of motion; each shows the nearest solver step."""
    colour: tuple[float, float, float] | None = None
    """0 to 1, behind the creature, its shadow on it; None: the scene, or a floor where there is none."""
    transparent: bool = False
    """Nothing behind the creature but its shadow."""

    def __post_init__(self) -> None:
        if self.size is not None and not all(SMALLEST_SIDE <= side <= LARGEST_SIDE for side in self.size):
            text = "x".join(map(str, self.size))
            advice = f"give pixels from {SMALLEST_SIDE} to {LARGEST_SIDE}, as 512 or 640x360"
            raise ArgumentError("size", advice, value=text)
        if not 1.0 <= self.fps <= FASTEST:
            raise ArgumentError("fps", f"give a number of frames a second from 1 to {FASTEST:g}", value=self.fps)
        if self.camera not in list(CameraMove) and not self.camera.endswith(".json"):
            raise ArgumentError("camera", f"give {', '.join(CameraMove)} or a path.json", value=self.camera)

    def to_json(self) -> dict[str, Any]:
        """For the report."""
        given = {"camera": self.camera, "picture": self.size, "fps": self.fps, "colour": self.colour}
        return given | {"transparent": self.transparent}

    def check(self) -> None:
        """Raise ``UserError`` for a file of key cameras that cannot be read: before any long work."""
        if self.camera not in list(CameraMove):
            _keys(Path(self.camera))

    def cameras(self, camera: Camera, trajectory: Trajectory, steps: np.ndarray) -> list[Camera]:
        """One for each of ``steps`` (n,); ``camera`` is the film's own. Raises ``UserError`` for a bad file of keys."""
        base = resized(camera, *self.size) if self.size is not None else camera
        if self.camera == CameraMove.FIXED:
            return [base] * len(steps)
        if self.camera == CameraMove.FOLLOW:
            return _following(base, trajectory, steps)
        if self.camera == CameraMove.ORBIT:
            return around(base, trajectory.positions[steps])
        return _through_keys(Path(self.camera), base, trajectory, steps)


def nearest_steps(time: np.ndarray, fps: float) -> np.ndarray:
    """(n,) the step that is nearest to each of ``fps`` frames a second, of steps that end at ``time`` (F + 1,) s."""
    frames = np.arange(round(fps * (time[-1] - time[0])) + 1) / fps + time[0]
    return np.searchsorted(0.5 * (time[1:] + time[:-1]), frames)


def turntable(fps: float) -> int:
    """Frames of a turn about a body that is held."""
    return max(2, round(_TURNTABLE * fps))


def resized(camera: Camera, width: int, height: int) -> Camera:
    """``camera`` for pictures of ``width`` x ``height`` pixels that hold at least what its own hold."""
    if (width, height) == (camera.width, camera.height):
        return camera
    scale = min(width / camera.width, height / camera.height)
    return replace(
        camera,
        width=width,
        height=height,
        fx=scale * camera.fx,
        fy=scale * camera.fy,
        cx=0.5 * width + scale * (camera.cx - 0.5 * camera.width),
        cy=0.5 * height + scale * (camera.cy - 0.5 * camera.height),
    )


def around(camera: Camera, positions: np.ndarray, *, count: int | None = None) -> list[Camera]:
    """``count`` cameras once around up (z) through the middle of ``positions`` (f, N, 3), as near as shows all of it
    from every side; one for each frame if no count is given.
    """
    points = positions.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (low + high)
    count = count or len(positions)
    corners = box_corners(low, high)
    forward = camera.rotation[2]
    distance = 0.5 * float(np.linalg.norm(high - low))
    for _ in range(200):
        eye = middle - distance * forward
        turned = [_turned(_moved(camera, eye), middle, 2.0 * np.pi * k / count) for k in range(count)]
        if all(_holds(one, corners) for one in turned[:: max(1, count // 32)]):
            break
        distance *= 1.05
    return turned


def _following(camera: Camera, trajectory: Trajectory, steps: np.ndarray) -> list[Camera]:
    masses = trajectory.node_mass / trajectory.node_mass.sum()
    positions = trajectory.positions[steps]
    path = np.einsum("n,fni->fi", masses, positions)
    reach = float(np.linalg.norm(positions - path[:, None], axis=2).max())
    rate = (len(steps) - 1) / max(float(trajectory.time[steps[-1]] - trajectory.time[steps[0]]), 1e-9)
    smooth = gaussian_filter1d(path, _SMOOTH * rate, axis=0, mode="nearest") if len(path) > 1 else path
    # What the slow camera lags behind must be in the picture, too.
    reach = _ROOM * reach + float(np.linalg.norm(path - smooth, axis=1).max())
    half = min(0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
    distance = reach / np.sin(np.arctan(half))
    return [_moved(camera, middle - distance * camera.rotation[2]) for middle in smooth]


def _moved(camera: Camera, eye: np.ndarray) -> Camera:
    return replace(camera, translation=-camera.rotation @ eye)


def _turned(camera: Camera, middle: np.ndarray, angle: float) -> Camera:
    """``camera`` gone round up through ``middle`` (3,) by ``angle`` radians."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    eye = middle + turn @ (camera.centre - middle)
    rotation = camera.rotation @ turn.T
    return replace(camera, rotation=rotation, translation=-rotation @ eye)


def _holds(camera: Camera, points: np.ndarray) -> bool:
    seen = points @ camera.rotation.T + camera.translation
    if seen[:, 2].min() <= camera.near:
        return False
    u, v = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx, camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
    rim = _RIM * min(camera.width, camera.height)
    return bool(min(u.min(), v.min()) > rim and u.max() < camera.width - rim and v.max() < camera.height - rim)


def _through_keys(path: Path, camera: Camera, trajectory: Trajectory, steps: np.ndarray) -> list[Camera]:
    """Cameras on a smooth line through the keys of ``path`` (docs/guide/film.md), before and after them at rest."""
    rows = _keys(path)
    frame = BodyFrame(trajectory.body_axes, trajectory.body_origin, trajectory.metres_per_unit)
    rows[:, 1:4], rows[:, 4:7] = frame.points(rows[:, 1:4]), frame.points(rows[:, 4:7])
    times = np.clip(trajectory.time[steps] - trajectory.time[0], rows[0, 0], rows[-1, 0])
    line = CubicSpline(rows[:, 0], rows[:, 1:])(times) if len(rows) > 1 else np.repeat(rows[:, 1:], len(times), axis=0)
    cameras = []
    for row in line:
        eye, target = row[:3], row[3:6]
        forward = target - eye
        if np.linalg.norm(np.cross(forward, [0.0, 0.0, 1.0])) < 1e-6 * max(np.linalg.norm(forward), 1e-12):
            raise UserError(f"{path}: its camera looks straight up or down, or at its own place; move a key")
        fov = float(np.clip(row[6], 1.0, 150.0))
        cameras.append(
            Camera.look_at(
                eye,
                target,
                np.array([0.0, 0.0, 1.0]),
                width=camera.width,
                height=camera.height,
                vertical_fov_degrees=fov,
                near=0.01 * float(np.linalg.norm(forward)),
            )
        )
    return cameras


def _keys(path: Path) -> np.ndarray:
    """(n, 8) time, eye, target, fov of each key, in the capture's frame and units."""
    keys = parse_json(read_text(path), path)
    entries = keys.get("keys") if isinstance(keys, dict) else None
    if not isinstance(entries, list) or not entries:
        raise UserError(f'{path}: give {{"keys": [{{"time": 0, "eye": [x, y, z], "target": [x, y, z]}}, ...]}}')
    rows = np.array([_key(path, number, entry) for number, entry in enumerate(entries)])
    if (np.diff(rows[:, 0]) <= 0.0).any():
        raise UserError(f"{path}: the times of its keys do not grow; put them in order")
    return rows


def _key(path: Path, number: int, entry: Any) -> list[float]:
    """time, eye, target, fov."""
    try:
        row = [entry["time"], *entry["eye"], *entry["target"], entry.get("fov", 30.0)]
        row = [float(value) for value in row]
    except (TypeError, KeyError, ValueError, AttributeError):
        row = []
    if len(row) != 8 or not np.isfinite(row).all() or max(map(abs, row)) > 1e12:
        raise UserError(f"{path}: key {number} needs time, eye [x, y, z] and target [x, y, z], finite; correct it")
    if not 1.0 <= row[7] <= 150.0:
        raise UserError(f"{path}: fov of key {number} is {row[7]:g}; give degrees from 1 to 150")
    return row
