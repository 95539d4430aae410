"""Camera path, size, frame rate and background of a film."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from egs_warp.checked_calls import Fraction, Range, checked_constructor
from egs_warp.errors import ArgumentError, UserError, did_you_mean
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.camera import Camera, fitted_camera
from egs_warp.geometry.frames import box_corners
from egs_warp.io.text import json_excerpt, parse_json, read_text
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.short_repr import short_repr

if TYPE_CHECKING:
    from egs_warp.pipelines.report import JsonValue

MIN_SIDE, MAX_SIDE = 16, 4096
"""Minimum and maximum width and height of a film, pixels."""
MAX_FPS = 1000.0
"""Maximum frame rate, Hz."""
_SMOOTHING_TIME = 0.5
"""Standard deviation, s, of the window that smooths the path of a following camera."""
_SIDES, _TOP, _BOTTOM = 0.86, 0.86, 0.76
"""Maximum extent of the creature from the centre of the picture towards the left and right, top, and bottom edges, as a
fraction of the distance to the edge. The larger margin at the bottom leaves space for the shadow."""
_FOLLOWED_SIZE = 1.15
"""Ratio above which ``auto`` follows the creature: the creature's minimum size in the pictures of a following camera,
divided by its minimum size in the pictures of a fixed camera."""
_ORBIT_MARGIN = 0.06
"""Margin of an orbiting camera, as a fraction of the shorter side of a picture."""
_TURNTABLE_TIME = 4.0
"""Duration of one orbit around a single frame, s."""


class CameraMove(StrEnum):
    """Built-in camera motions."""

    AUTO = "auto"
    """``follow`` if the creature then appears considerably larger and there is no scene, otherwise ``fixed``."""
    FIXED = "fixed"
    FOLLOW = "follow"
    ORBIT = "orbit"


class FilmedMotion(Protocol):
    """Motion that a camera films: a ``Trajectory``, or the motion of all bodies of a world (``WorldMotion``)."""

    @property
    def time(self) -> np.ndarray:
        """(F,) s, time of each state."""
        ...

    @property
    def positions(self) -> np.ndarray:
        """(F, N, 3) m, nodal positions."""
        ...

    @property
    def node_mass(self) -> np.ndarray:
        """(N,) kg, nodal masses."""
        ...

    @property
    def capture_frame(self) -> BodyFrame:
        """Frame of ``positions`` in the capture."""
        ...


@checked_constructor
@dataclass(frozen=True)
class Shot:
    """Options of a film."""

    __repr__ = short_repr

    camera: str = CameraMove.AUTO
    """``auto``, ``fixed``, ``follow`` (along the ground), ``orbit`` (one full circle during the film), or the name of a
    JSON file with key cameras."""
    size: tuple[int, int] | None = None
    """Width and height, pixels; None uses the default of the film."""
    fps: Annotated[float, Range(1.0, MAX_FPS, "a number of frames per second")] = FRAME_RATE
    """Frames per second of simulated time; each frame shows the nearest solver step."""
    colour: tuple[Fraction, Fraction, Fraction] | None = None
    """Background colour, 0 to 1, on which the shadow is drawn; None shows the scene, or a floor if there is no
    scene."""
    transparent: bool = False
    """True for a transparent background that contains only the shadow."""

    def __post_init__(self) -> None:
        if self.size is not None and not all(MIN_SIDE <= side <= MAX_SIDE for side in self.size):
            text = "x".join(map(str, self.size))
            advice = f"give sides from {MIN_SIDE} to {MAX_SIDE} pixels, such as 512 or 640x360"
            raise ArgumentError("size", advice, value=text)
        if self.camera not in list(CameraMove) and not self.camera.endswith(".json"):
            near = did_you_mean(self.camera, CameraMove)
            raise ArgumentError("camera", f"give {', '.join(CameraMove)} or a path.json", value=f"{self.camera}{near}")

    def to_json(self) -> dict[str, JsonValue]:
        """Return the options for the entry ``asked`` of the report."""
        options = {"camera": self.camera, "fps": self.fps, "colour": self.colour}
        return options | {"transparent": self.transparent}

    def check(self) -> None:
        """Raise ``UserError`` if the file of key cameras cannot be read; call it before long computations."""
        if self.camera not in list(CameraMove):
            _keys(Path(self.camera))

    def cameras(
        self, camera: Camera, trajectory: FilmedMotion, steps: np.ndarray, *, in_scene: bool = False
    ) -> list[Camera]:
        """Return the camera of each of the ``steps`` (n,) of a trajectory.

        Args:
            camera: Fixed camera of the film.
            trajectory: Trajectory with the node positions.
            steps: Indices of the states.
            in_scene: True if the creature has a scene around it, for which ``auto`` selects ``fixed``.

        Raises:
            UserError: The file of key cameras is invalid.
        """
        base = camera if self.size is None else reframed(camera, *self.size, trajectory.positions)
        if self.camera == CameraMove.AUTO and not in_scene:
            following, fixed = _following(base, trajectory, steps), [base] * len(steps)
            middles = trajectory.positions[steps].mean(axis=1)
            near, far = (
                max((middle - one.centre) @ one.rotation[2] for one, middle in zip(cameras, middles, strict=True))
                for cameras in (following, fixed)
            )
            return following if far > _FOLLOWED_SIZE * near else fixed
        if self.camera in (CameraMove.FIXED, CameraMove.AUTO):
            return [base] * len(steps)
        if self.camera == CameraMove.FOLLOW:
            return _following(base, trajectory, steps)
        if self.camera == CameraMove.ORBIT:
            return around(base, trajectory.positions[steps])
        return _through_keys(Path(self.camera), base, trajectory, steps)


def nearest_steps(time: np.ndarray, fps: float) -> np.ndarray:
    """Return the index (n,) of the state that is nearest to each frame at ``fps`` Hz. ``time`` (F + 1,) s contains the
    times of the states."""
    frames = np.arange(round(fps * (time[-1] - time[0])) + 1) / fps + time[0]
    return np.searchsorted(0.5 * (time[1:] + time[:-1]), frames)


def turntable(fps: float) -> int:
    """Return the number of frames of one orbit around a single frame."""
    return max(2, round(_TURNTABLE_TIME * fps))


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Return ``camera`` for pictures of ``width`` x ``height`` pixels that show at least its field of view."""
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
    """Return cameras on a circle around the vertical axis through the centre of ``positions`` (f, N, 3).

    The radius of the circle is approximately the minimum at which every camera shows all positions. The number of
    cameras is ``count``, by default f.
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
        rotated = [_rotated(_moved(camera, eye), middle, 2.0 * np.pi * k / count) for k in range(count)]
        if all(_shows(one, corners) for one in rotated[:: max(1, count // 32)]):
            break
        distance *= 1.05
    return rotated


def framed(camera: Camera, points: np.ndarray) -> Camera:
    """Return ``camera``, translated such that the ``points`` (n, 3) fill its picture."""
    return fitted_camera(camera, points, sides=_SIDES, top=_TOP, bottom=_BOTTOM)


def reframed(camera: Camera, width: int, height: int, positions: np.ndarray) -> Camera:
    """Return ``camera`` for pictures of ``width`` x ``height`` pixels, and, if these have another shape than its own
    pictures, translated such that the ``positions`` (f, N, 3) fill them."""
    other = resized(camera, width, height)
    has_same_shape = width * camera.height == height * camera.width
    return other if has_same_shape else framed(other, positions.reshape(-1, 3))


def _following(camera: Camera, trajectory: FilmedMotion, steps: np.ndarray) -> list[Camera]:
    """Return cameras that follow the centre of mass horizontally but not vertically, so that a jump looks high."""
    masses = trajectory.node_mass / trajectory.node_mass.sum()
    positions = trajectory.positions[steps]
    path = np.einsum("n,fni->fi", masses, positions) * [1.0, 1.0, 0.0]
    rate = (len(steps) - 1) / max(float(trajectory.time[steps[-1]] - trajectory.time[steps[0]]), 1e-9)
    smooth = gaussian_filter1d(path, _SMOOTHING_TIME * rate, axis=0, mode="nearest") if len(path) > 1 else path
    start = framed(camera, (positions - smooth[:, None]).reshape(-1, 3))
    return [_moved(start, start.centre + place) for place in smooth]


def _moved(camera: Camera, eye: np.ndarray) -> Camera:
    return replace(camera, translation=-camera.rotation @ eye)


def _rotated(camera: Camera, middle: np.ndarray, angle: float) -> Camera:
    """Return ``camera`` rotated by ``angle`` radians about the vertical axis through ``middle`` (3,)."""
    c, s = np.cos(angle), np.sin(angle)
    rotation_z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    eye = middle + rotation_z @ (camera.centre - middle)
    rotation = camera.rotation @ rotation_z.T
    return replace(camera, rotation=rotation, translation=-rotation @ eye)


def _shows(camera: Camera, points: np.ndarray) -> bool:
    camera_points = points @ camera.rotation.T + camera.translation
    if camera_points[:, 2].min() <= camera.near:
        return False
    u, v = (
        camera.fx * camera_points[:, 0] / camera_points[:, 2] + camera.cx,
        camera.fy * camera_points[:, 1] / camera_points[:, 2] + camera.cy,
    )
    rim = _ORBIT_MARGIN * min(camera.width, camera.height)
    return bool(min(u.min(), v.min()) > rim and u.max() < camera.width - rim and v.max() < camera.height - rim)


def _through_keys(path: Path, camera: Camera, trajectory: FilmedMotion, steps: np.ndarray) -> list[Camera]:
    """Return cameras on a spline through the keys of ``path`` (docs/guide/film.md). Before the first and after the last
    key, the camera does not move."""
    rows = _keys(path)
    frame = trajectory.capture_frame
    rows[:, 1:4], rows[:, 4:7] = frame.points(rows[:, 1:4]), frame.points(rows[:, 4:7])
    times = np.clip(trajectory.time[steps] - trajectory.time[0], rows[0, 0], rows[-1, 0])
    line = CubicSpline(rows[:, 0], rows[:, 1:])(times) if len(rows) > 1 else np.repeat(rows[:, 1:], len(times), axis=0)
    cameras = []
    for time, row in zip(times, line, strict=True):
        eye, target = row[:3], row[3:6]
        forward = target - eye
        if np.linalg.norm(np.cross(forward, [0.0, 0.0, 1.0])) < 1e-6 * max(np.linalg.norm(forward), 1e-12):
            raise UserError(
                f"{path}: at {time:g} s, its camera points straight up or down, or its eye and target coincide; move a"
                " key"
            )
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
    """Return time (s), eye, target and field of view (degrees) of the n keys (n, 8), in the capture's frame."""
    keys = parse_json(read_text(path), path)
    entries = keys.get("keys") if isinstance(keys, dict) else None
    if not isinstance(entries, list) or not entries:
        raise UserError(
            f'{path}: it has no keys; give {{"keys": [{{"time": 0, "eye": [x, y, z], "target": [x, y, z]}}, ...]}}'
        )
    rows = np.array([_key(path, number, entry) for number, entry in enumerate(entries)])
    for number in range(1, len(rows)):
        before, time = rows[number - 1 : number + 1, 0]
        if time <= before:
            raise UserError(
                f"{path}: the time {time:g} s of key {number} is not later than {before:g} s of the key before it; sort"
                " the keys, and give each its own time"
            )
    return rows


def _key(path: Path, number: int, entry: Any) -> list[float]:
    """Return time (s), eye, target and field of view (degrees) of one key. Raises ``UserError`` if the key is
    invalid."""
    try:
        row = [entry["time"], *entry["eye"], *entry["target"], entry.get("fov", 30.0)]
        row = [float(value) for value in row]
    except (TypeError, KeyError, ValueError, AttributeError):
        row = []
    if len(row) != 8 or not np.isfinite(row).all() or max(map(abs, row)) > 1e12:
        raise UserError(
            f"{path}: key {number} is {json_excerpt(entry)}; give a time, an eye [x, y, z], a target"
            " [x, y, z] and, optionally, a fov, each finite and at most 1e12"
        )
    if not 1.0 <= row[7] <= 150.0:
        raise UserError(f"{path}: fov of key {number} is {row[7]:g}; give degrees from 1 to 150")
    return row
