"""Projection of a Gaussian cloud to the screen-space ellipses of one camera."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.kernels.render.projection import NOT_FINITE, View, project_kernel
from egs_warp.kernels.render.projection_cpu import BLOCK, project_block_kernel
from egs_warp.launching import device_of, empty, empty_pooled, launch_rows


@dataclass(frozen=True)
class ProjectedGaussians:
    """Screen-space ellipses of all Gaussians; the entries of Gaussians that reach no tile are undefined."""

    ellipse: wp.array
    """(n,) vec4: centre x, y in pixels, then a and shear of -ln(alpha / opacity) = a (dx + shear dy)^2 + v dy^2."""
    falloff: wp.array
    """(n,) vec2: coefficient v and ln(opacity) of the same equation."""
    colour_depth: wp.array
    """(n,) vec4: red, green, blue (display-referred, at least 0) and z-depth."""
    slot_end: wp.array
    """(n,) int64, cumulative number of tiles reached by the Gaussians, inclusive."""
    count_slots: Callable[[], int]
    """Function that computes ``slot_count``."""

    @cached_property
    def slot_count(self) -> int:
        """Number of (Gaussian, tile) pairs. On a GPU the first access blocks.

        Raises:
            UserError: a Gaussian has a non-finite value (the message names the first one), or there are too many pairs.
        """
        return self.count_slots()


def view_from_camera(camera: Camera) -> Any:
    """Return the camera in single precision, with limits for the Jacobian of the projection.

    The result is shared between equal cameras and must not be modified.

    Raises:
        UserError: the camera is invalid.
    """
    rotation = np.asarray(camera.rotation, dtype=np.float64)
    translation = np.asarray(camera.translation, dtype=np.float64)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.near, camera.far)
    return _view(camera.width, camera.height, lens, rotation.tobytes(), translation.tobytes())


@lru_cache(maxsize=1024)
def _view(width: int, height: int, lens: tuple[float, ...], rotation: bytes, translation: bytes) -> Any:
    """Build the view. The result is cached, because filling the struct takes longer than a kernel launch."""
    fx, fy, cx, cy, near, far = lens
    turn, shift = np.frombuffer(rotation), np.frombuffer(translation)
    view = View()
    view.rotation = wp.mat33(*turn.tolist())
    view.translation = wp.vec3(*shift.tolist())
    view.centre = wp.vec3(*(-turn.reshape(3, 3).T @ shift).tolist())
    view.fx, view.fy, view.cx, view.cy = fx, fy, cx, cy
    view.near, view.far = near, min(far, 3.4e38)
    view.width, view.height = width, height
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    view.slope_low = wp.vec2(-cx / fx - margin_x, -cy / fy - margin_y)
    view.slope_high = wp.vec2((width - cx) / fx + margin_x, (height - cy) / fy + margin_y)
    return view


def project(cloud: GaussianCloud, view: Any, *, antialiased: bool, threads: int) -> ProjectedGaussians:
    """Project every Gaussian of ``cloud``. Gaussians that are outside the view, or fainter than 1/255 everywhere, reach
    no tile."""
    device, count = cloud.device, cloud.count
    ellipse, falloff, colour_depth, tile_count = empty_pooled(
        device, (count, wp.vec4), (count, wp.vec2), (count, wp.vec4), (count, wp.int64)
    )
    kernel, rows, work = project_kernel, count, None
    if device.is_cpu:
        kernel, rows = project_block_kernel, -(-count // int(BLOCK))
        work = np.ones(rows)
    launch_rows(
        kernel,
        rows,
        inputs=[view, int(antialiased), *(getattr(cloud, name) for name in ARRAYS)],
        outputs=[ellipse, falloff, colour_depth, tile_count],
        device=device,
        threads=threads,
        work=work,
    )
    wp.utils.array_scan(tile_count, tile_count, inclusive=True)
    last = _fetch_last(tile_count)

    def count_slots() -> int:
        slot_count = last()
        if not 0 <= slot_count < 2**30:
            raise _too_many(cloud, view, tile_count.numpy())
        return slot_count

    return ProjectedGaussians(ellipse, falloff, colour_depth, tile_count, count_slots)


class _ReadBack:
    """One number in page-locked memory, to which a GPU copies twice as fast as to pageable memory, and an event that
    marks the end of the copy."""

    def __init__(self, device: wp.Device) -> None:
        self.array = empty(1, wp.int64, "cpu", pinned=True)
        self.values = self.array.numpy()
        self.copied = wp.Event(device)


class _ReadBacks(threading.local):
    """Unused read-back buffers of the current thread, by device."""

    def __init__(self) -> None:
        self.unused: defaultdict[str, list[_ReadBack]] = defaultdict(list)


_read_backs = _ReadBacks()


def _fetch_last(values: wp.array) -> Callable[[], int]:
    """Start the download of the last element of ``values`` (n,) int64. The returned function, which must be called
    once, waits for the element and returns it."""
    device = device_of(values)
    if device.is_cpu:
        return lambda: int(values.numpy()[-1])
    unused = _read_backs.unused[device.alias]
    read_back = unused.pop() if unused else _ReadBack(device)
    wp.copy(read_back.array, values, src_offset=len(values) - 1, count=1)
    device.stream.record_event(read_back.copied)

    def last() -> int:
        wp.synchronize_event(read_back.copied)
        number = int(read_back.values[0])
        unused.append(read_back)
        return number

    return last


def _too_many(cloud: GaussianCloud, view: Any, slot_end: np.ndarray) -> UserError:
    """Return the error for too many tiles, which is caused by a Gaussian that is not finite or by Gaussians that are
    too large."""
    bad = np.flatnonzero(np.diff(slot_end, prepend=0) >= int(NOT_FINITE))
    if len(bad) == 0:
        return UserError(
            f"render: {cloud.count} Gaussians form {slot_end[-1]} (Gaussian, tile) pairs at {view.width} x"
            f" {view.height} pixels, more than 2^30; render a smaller image or fewer Gaussians"
        )
    finite = {name: bool(np.isfinite(getattr(cloud, name).numpy()[bad[0]]).all()) for name in ARRAYS}
    # Finite coefficients may still sum to a non-finite colour.
    attribute = next((name for name, is_finite in finite.items() if not is_finite), "sh")
    return UserError(f"render: {attribute} of Gaussian {bad[0]} is not finite; repair or remove it")
