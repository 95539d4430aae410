"""Editing of captures before they are written: merging, cropping, cleaning, rotating, scaling and decimation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.capture import Capture
from egs_warp.io.decimation import decimated
from egs_warp.io.origin import relative_positions
from egs_warp.segmentation.connectivity import connected_parts

Y_UP = np.array([0.0, 1.0, 0.0])
"""Up direction in the formats and viewers that define it."""
_CELLS = 128
"""Number of cells along the longest side of a capture, in the grid that defines which Gaussians are connected."""
_FLOATER_SHARE = 0.01
"""Share of the opacity of the largest part below which a part is a floater."""


@dataclass(frozen=True)
class CaptureEdits:
    """Changes to a capture, in the order of their application; the defaults change nothing."""

    box: np.ndarray | None = None
    """(2, 3) Opposite corners of a box in the frame and units of the file; Gaussians whose means are outside are
    removed."""
    drop_floaters: bool = False
    """True to remove small parts that are not connected to the rest."""
    up: np.ndarray | None = None
    """(3,) Up direction of the capture, which is rotated to +y; None leaves it as it is."""
    rotation: np.ndarray | None = None
    """(3,) Angles of rotations about the x axis, then y, then z, degrees; applied after the rotation of ``up``. The up
    direction of the capture is rotated as well."""
    scale: float = 1.0
    """Factor on all lengths, positive."""
    translation: np.ndarray | None = None
    """(3,) Displacement, in units of the scaled capture."""
    count: int | None = None
    """Number of Gaussians that remain after neighbours have been merged (``decimated``); None merges none."""

    def __post_init__(self) -> None:
        if not 1e-9 <= self.scale <= 1e9:
            raise ArgumentError("scale", "give a positive number, from 1e-9 to 1e9", value=self.scale)
        if self.count is not None and self.count < 1:
            raise ArgumentError("count", "give a number of at least 1", value=self.count)

    @property
    def moves(self) -> bool:
        """True if the edits change positions."""
        return self.scale != 1.0 or any(x is not None for x in (self.up, self.rotation, self.translation))

    def frame(self) -> BodyFrame:
        """Return the transform to the edited capture."""
        # Rotate about x if that suffices, so that y-down and z-up captures keep their left and right.
        upright = Rotation.identity() if self.up is None else _shortest_turn(self.up)
        axes = (self._turn() * upright).as_matrix()
        shift = np.zeros(3) if self.translation is None else self.translation
        return BodyFrame(axes, -(shift @ axes) / self.scale, self.scale)

    def _turn(self) -> Rotation:
        """Return the rotation by the angles ``rotation``, which is applied after the rotation of ``up`` to +y."""
        if self.rotation is None:
            return Rotation.identity()
        return Rotation.from_euler("xyz", self.rotation, degrees=True)

    def turned_up(self, up: np.ndarray | None, vertical_axis: int | None) -> tuple[np.ndarray | None, int | None]:
        """Return the up direction (3,) and the vertical axis (``Capture``) after the edits; the arguments are the
        values before the edits."""
        if self.up is not None:
            up, vertical_axis = Y_UP, None
        turn = self._turn()
        if vertical_axis is not None:
            line = np.abs(turn.apply(np.eye(3)[vertical_axis]))
            vertical_axis = int(np.argmax(line)) if line.max() > 1.0 - 1e-9 else None
        return None if up is None else turn.apply(up), vertical_axis


def _shortest_turn(up: np.ndarray) -> Rotation:
    """Return the shortest rotation of ``up`` (3,) to +y; a rotation by half a turn is about x."""
    direction = up / np.linalg.norm(up)
    axis = np.cross(direction, Y_UP)
    sine, cosine = float(np.linalg.norm(axis)), float(direction @ Y_UP)
    axis = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    return Rotation.from_rotvec(np.arctan2(sine, cosine) * axis)


def merge_captures(captures: Sequence[Capture]) -> Capture:
    """Return one capture with the Gaussians of all ``captures`` in turn.

    Lower SH degrees are padded with zeros. Properties in which the captures differ (up, antialiasing) are dropped, with
    a note.
    """
    first = captures[0]
    if len(captures) == 1:
        return first
    clouds = [capture.cloud for capture in captures]
    coefficients = max(cloud.sh.shape[1] for cloud in clouds)
    rotations, log_scales, logits = (
        np.concatenate([getattr(cloud, name).numpy() for cloud in clouds])
        for name in ("rotations", "log_scales", "opacity_logits")
    )
    sh = [np.pad(cloud.sh.numpy(), ((0, 0), (0, coefficients - cloud.sh.shape[1]), (0, 0))) for cloud in clouds]
    means, origin, notes = relative_positions(np.concatenate([_file_positions(capture) for capture in captures]))
    notes = (*(f"{capture.source}: {note}" for capture in captures for note in capture.notes), *notes)
    up, vertical_axis = first.up, first.vertical_axis
    antialiased = all(capture.antialiased for capture in captures)
    if not all(_same(capture.up, up) and capture.vertical_axis == vertical_axis for capture in captures):
        up, vertical_axis = None, None
        notes = (*notes, "the captures have different up directions; they were merged in their own axes")
    if antialiased != any(capture.antialiased for capture in captures):
        notes = (*notes, "only some of the captures were trained with antialiasing; the tag is dropped")
    cloud = GaussianCloud.from_numpy(
        *(means, rotations, log_scales, logits, np.concatenate(sh)),
        antialiased=antialiased,
        device=str(first.cloud.device),
    )
    return first.with_cloud(cloud, origin=origin, up=up, vertical_axis=vertical_axis, notes=notes, rows=None)


def _file_positions(capture: Capture) -> np.ndarray:
    """Return the positions (n, 3) in the file's coordinates: means plus ``origin``, or the float32 means if there is no
    origin."""
    means = capture.cloud.means.numpy()
    return means if capture.origin is None else means + capture.origin


def _same(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return a is b if a is None or b is None else np.allclose(a, b)


def edit_capture(capture: Capture, edits: CaptureEdits) -> tuple[Capture, tuple[str, ...]]:
    """Return the changed capture, and a line about each change for the user.

    Raises ``UserError`` if no Gaussian is left.
    """
    cloud, lines, origin = capture.cloud, [], capture.origin
    if edits.box is not None:
        low, high = edits.box.min(axis=0), edits.box.max(axis=0)
        means = _file_positions(capture)
        inside = np.all((means >= low) & (means <= high), axis=1)
        if not inside.any():
            bounds = " to ".join(
                ",".join(f"{x:.6g}" for x in corner) for corner in (means.min(axis=0), means.max(axis=0))
            )
            raise ArgumentError("box", f"none of the {cloud.count} Gaussians lies in it; they extend from {bounds}")
        lines.append(f"box: {cloud.count - int(inside.sum())} of {cloud.count} Gaussians left out")
        cloud = cloud.subset(inside)
    if edits.drop_floaters:
        stays = ~floaters(cloud)
        lines.append(f"floaters: {cloud.count - int(stays.sum())} of {cloud.count} Gaussians left out")
        cloud = cloud.subset(stays)
    if edits.moves:
        frame = edits.frame()
        if origin is not None:
            # Add the displacement to the offset, which has double precision.
            origin = frame.points(origin)
            frame = replace(frame, origin=np.zeros(3))
            origin = origin if origin.any() else None
        cloud = to_body_frame(cloud, frame)
    if edits.count is not None and edits.count < cloud.count:
        before = cloud.count
        cloud, moved = decimated(cloud, edits.count)
        lines.append(f"decimated: {before} Gaussians merged to {cloud.count}, moved by {moved:.2g} units (RMS)")
    up, vertical_axis = edits.turned_up(capture.up, capture.vertical_axis)
    edited = capture.with_cloud(cloud, origin=origin, up=up, vertical_axis=vertical_axis, rows=None)
    return edited, tuple(lines)


def floaters(cloud: GaussianCloud) -> np.ndarray:
    """Return the mask (n,) bool of floaters: connected parts with less than 1 % of the opacity of the largest part."""
    means = cloud.means.numpy().astype(np.float64)
    low, high = np.quantile(means, (0.01, 0.99), axis=0)
    size = float((high - low).max())
    if not size > 0.0:
        return np.zeros(cloud.count, bool)
    everywhere = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    parts = connected_parts(cloud, np.arange(cloud.count), cell=size / _CELLS, plane=everywhere, above=-np.inf)
    masses = np.bincount(parts, weights=cloud.opacities())
    return masses[parts] < _FLOATER_SHARE * masses.max()
