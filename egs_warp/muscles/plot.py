"""Image of a body and its muscles, seen from three directions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.atomic import atomic_write
from egs_warp.muscles.fibres import FibreKind
from egs_warp.muscles.muscle_set import MuscleSet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIBRE_COLOURS = {
    FibreKind.LONGITUDINAL: "#d23c3c",
    FibreKind.RADIAL: "#3ca03c",
    FibreKind.CIRCULAR: "#2878c8",
    FibreKind.OBLIQUE_LEFT: "#aa3cbe",
    FibreKind.OBLIQUE_RIGHT: "#f0961e",
    FibreKind.USER: "#5a5a5a",
}
"""Colour of the fibres of each kind."""
_EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
_MARGIN = 0.06
"""Margin around the body, as a fraction of its largest extent."""


def check_picture_name(path: Path) -> None:
    """Check the name of an image file.

    Raises:
        UserError: the ending does not belong to an image format, or the folder does not exist.
    """
    if path.suffix.lower() not in _EXTENSIONS:
        raise UserError(f"{path}: not the name of an image; give a name that ends in one of {', '.join(_EXTENSIONS)}")
    if not path.parent.is_dir():
        raise UserError(f"{path}: its folder does not exist; create {path.parent} first")


def plot_muscles(mesh: TetMesh, muscles: MuscleSet, path: Path, *, up: np.ndarray, front: np.ndarray) -> None:
    """Write an image of the body seen from the front, from its left and from above, with fibres coloured by kind.

    The axes show body heights, measured along the ground from the middle of the body and upwards from its lowest point.

    Args:
        mesh: cage at rest.
        muscles: muscles of the body.
        path: image file.
        up: (3,) up direction.
        front: (3,) direction in which the body faces, not parallel to ``up``.

    Raises:
        UserError: ``path`` cannot be written.
    """
    check_picture_name(path)
    # Imported here because the import takes a quarter of a second.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(19.2, 7.2), dpi=100, layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    local = _BodyAxes(mesh, up=up, front=front)
    # Directions to the right, up and towards the viewer, for each view; each direction is ahead, left or up with
    # respect to the body, or the opposite.
    ahead, left, above = np.eye(3)
    views = {
        "from the front": (left, above, ahead),
        "from its left": (-ahead, above, left),
        "from above": (-left, ahead, above),
    }
    panels = figure.subplots(1, len(views))
    for axes, (title, directions) in zip(panels, views.items(), strict=True):
        _draw_view(axes, local, mesh, muscles, np.stack(directions))
        axes.set_title(title)
    counts = {kind: len(muscles.segments_of_kind(kind)) for kind in FibreKind}
    figure.legend(
        handles=[
            Line2D([], [], color=FIBRE_COLOURS[kind], linewidth=3.0, label=f"{kind.value.replace('_', ' ')} ({count})")
            for kind, count in counts.items()
            if count
        ],
        loc="outside lower center",
        ncols=len(counts),
        frameon=False,
    )
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[..., 2::-1]
    written, data = cv2.imencode(path.suffix, image)
    if not written:
        raise UserError(f"{path}: the image could not be encoded; choose another extension")
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())


class _BodyAxes:
    """Transform from points to the coordinates ahead, left and up with respect to the body, in body heights."""

    def __init__(self, mesh: TetMesh, *, up: np.ndarray, front: np.ndarray) -> None:
        up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
        left = np.cross(up, front)
        left /= np.linalg.norm(left)
        self._axes = np.stack([np.cross(left, up), left, up])
        flat = mesh.nodes @ self._axes.T
        low, high = flat.min(axis=0), flat.max(axis=0)
        self._origin = np.append(0.5 * (low + high)[:2], low[2])
        self._height = float(high[2] - low[2])
        self.low, self.high = self(mesh.nodes).min(axis=0), self(mesh.nodes).max(axis=0)
        """(3,) minimum and maximum coordinates of the body, body heights."""

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Transform ``points`` (..., 3)."""
        return (points @ self._axes.T - self._origin) / self._height


def _draw_view(axes: Axes, local: _BodyAxes, mesh: TetMesh, muscles: MuscleSet, directions: np.ndarray) -> None:
    """Draw one view of the body. The rows of ``directions`` (3, 3) are the directions to the right, up and towards the
    viewer in the coordinates ahead, left and up."""
    from matplotlib.collections import LineCollection, PolyCollection

    # The ticks show these coordinates, so the axis of a coordinate that increases to the left is inverted.
    shown = np.abs(directions)
    corners = local(mesh.nodes[mesh.boundary_faces()])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = normals @ directions[2] / np.linalg.norm(normals, axis=1)
    order = np.argsort(corners.mean(axis=1) @ directions[2], kind="stable")
    order = order[facing[order] > 0.0]
    greys = np.repeat(0.72 + 0.2 * facing[order, None], 3, axis=1)
    axes.add_collection(
        PolyCollection(list(corners[order] @ shown[:2].T), facecolors=greys, edgecolors="0.8", linewidths=0.5)
    )
    ends = local(muscles.end_points(mesh.nodes))[muscles.segments]
    order = np.argsort(ends.mean(axis=1) @ directions[2], kind="stable")
    kinds = [muscles.fibre_kinds[fibre] for fibre in muscles.fibre_from_segment[order]]
    colours = [FIBRE_COLOURS[kind] for kind in kinds]
    lines = ends[order] @ shown[:2].T
    axes.add_collection(LineCollection(list(lines), colors=colours, linewidths=2.0))
    axes.scatter(*lines.reshape(-1, 2).T, s=14.0, c=np.repeat(colours, 2), linewidths=0.0, zorder=3)
    low, high = shown[:2] @ local.low, shown[:2] @ local.high
    half = (0.5 + _MARGIN) * float((local.high - local.low).max())
    middle = 0.5 * (low + high)
    limits = np.stack([middle - half, middle + half], axis=1)
    left_limit, right_limit = limits[0] if directions[0].sum() > 0.0 else limits[0, ::-1]
    axes.set_xlim(left_limit, right_limit)
    axes.set_ylim(limits[1, 0], limits[1, 1])
    axes.set_aspect("equal")
    names = ("ahead", "left", "up")
    axes.set_xlabel(f"{names[int(shown[0].argmax())]}, body heights")
    axes.set_ylabel(f"{names[int(shown[1].argmax())]}, body heights")
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)
