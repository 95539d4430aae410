"""Image of a body and its muscles from three directions."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.atomic import atomic_write
from egs_warp.muscles.fibres import FibreKind
from egs_warp.muscles.muscle_set import MuscleSet

_BGR = {
    FibreKind.LONGITUDINAL: (60, 60, 210),
    FibreKind.RADIAL: (60, 160, 60),
    FibreKind.CIRCULAR: (200, 120, 40),
    FibreKind.OBLIQUE_LEFT: (190, 60, 170),
    FibreKind.OBLIQUE_RIGHT: (30, 150, 240),
    FibreKind.USER: (90, 90, 90),
}
_EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
_PANEL = 640
_MARGIN = 40
_SUPERSAMPLING = 2
"""Factor by which the image is drawn larger before it is averaged down."""
_SUBPIXEL_BITS = 4


def check_picture_name(path: Path) -> None:
    """Check the name of an image file.

    Raises:
        UserError: the extension is not that of an image format, or the folder does not exist.
    """
    if path.suffix.lower() not in _EXTENSIONS:
        raise UserError(f"{path}: not the name of a picture; let it end in one of {', '.join(_EXTENSIONS)}")
    if not path.parent.is_dir():
        raise UserError(f"{path}: its folder does not exist; create {path.parent} first")


def plot_muscles(mesh: TetMesh, muscles: MuscleSet, path: Path, *, up: np.ndarray) -> None:
    """Write an image of the body from the front, the side and above, with fibres coloured by kind.

    Args:
        mesh: cage at rest.
        muscles: its muscles.
        path: image file.
        up: (3,) up direction of the first two views.

    Raises:
        UserError: ``path`` cannot be written.
    """
    check_picture_name(path)
    up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    left, near = orthonormal_basis(up)
    right, away = -left, -near
    views = {"front": (right, up, away), "side": (away, up, -right), "above": (right, away, -up)}
    panels = [_panel(title, np.stack(axes), mesh, muscles) for title, axes in views.items()]
    image = np.concatenate([np.concatenate(panels, axis=1), _legend(muscles, 3 * _PANEL)])
    written, data = cv2.imencode(path.suffix, image)
    if not written:
        raise UserError(f"{path}: the picture could not be encoded; give another ending")
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())


def _panel(title: str, axes: np.ndarray, mesh: TetMesh, muscles: MuscleSet) -> np.ndarray:
    size = _PANEL * _SUPERSAMPLING
    image = np.full((size, size, 3), 255, np.uint8)
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    scale = (_PANEL - 2 * _MARGIN) * _SUPERSAMPLING / float((high - low).max())
    middle = 0.5 * (low + high)

    def pixels(points: np.ndarray) -> np.ndarray:
        flat = (points - middle) @ axes[:2].T * [scale, -scale] + 0.5 * size
        return np.round(flat * 2**_SUBPIXEL_BITS).astype(np.int32)

    faces = mesh.boundary_faces()
    corners = mesh.nodes[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depth = corners.mean(axis=1) @ axes[2]
    brightness = 225 - 40 * np.clip(normals @ axes[2] + 1.0, 0.0, 1.0)
    outlines = pixels(corners)
    for face in np.argsort(-depth, kind="stable"):
        if normals[face] @ axes[2] < 0:
            shade = (int(brightness[face]),) * 3
            cv2.fillConvexPoly(image, outlines[face], shade, cv2.LINE_AA, _SUBPIXEL_BITS)
            cv2.polylines(image, [outlines[face]], True, (200, 200, 200), 1, cv2.LINE_AA, _SUBPIXEL_BITS)
    ends = muscles.end_points(mesh.nodes)
    end_pixels = pixels(ends)
    middles = ends[muscles.segments].mean(axis=1) @ axes[2]
    for segment in np.argsort(-middles, kind="stable"):
        i, k = muscles.segments[segment]
        colour = _BGR[muscles.fibre_kinds[muscles.fibre_from_segment[segment]]]
        first, last = (end_pixels[i].tolist(), end_pixels[k].tolist())
        cv2.line(image, first, last, colour, 2 * _SUPERSAMPLING, cv2.LINE_AA, _SUBPIXEL_BITS)
        for end in (first, last):
            cv2.circle(image, end, 3 * _SUPERSAMPLING * 2**_SUBPIXEL_BITS, colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    image = cv2.resize(image, (_PANEL, _PANEL), interpolation=cv2.INTER_AREA)
    cv2.putText(image, title, (12, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 1, cv2.LINE_AA)
    return image


def _legend(muscles: MuscleSet, width: int) -> np.ndarray:
    strip = np.full((48, width, 3), 255, np.uint8)
    x = 16
    for kind in FibreKind:
        count = len(muscles.segments_of_kind(kind))
        if count:
            text = f"{kind.value} ({count})"
            cv2.line(strip, (x, 24), (x + 32, 24), _BGR[kind], 3, cv2.LINE_AA)
            cv2.putText(strip, text, (x + 40, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
            x += 70 + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1)[0][0]
    return strip
