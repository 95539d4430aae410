"""Proxy of the lego model of NeRF-synthetic: an object with a true mesh, built from the surface and colours of a
capture.

The photos have no geometry, so the true appearance of the bent model is unknown. Therefore a capture is trained from
the photos. Its surface (``capture_surface``) is the mesh, and its colours, in voxels near that surface, are the solid
texture. A cage deforms this proxy exactly, and Table 1 uses it like any other mesh.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from capture_surface import capture_surface
from egs_warp.geometry.gaussians import SH_BAND_0
from egs_warp.pipelines.train_capture import train
from harness import data_folder, timed
from painted_meshes import Paint, PaintedMesh, standing, subdivided

VOXELS = 256
"""Number of voxels along the height."""
REACH = 3
"""Maximum distance from the surface, voxels, at which the texture is defined."""


def lego(*, gaussians: int, iterations: int, seed: int, device: str, cache: Path | None) -> PaintedMesh:
    """Read the proxy from ``cache`` if that file exists; otherwise build it and write it to ``cache``, if given."""
    if cache is not None and cache.exists():
        with np.load(cache) as arrays:
            return _painted(**arrays)
    posed = data_folder() / "posed" / "lego"
    result, milliseconds = timed(train, posed, iterations=iterations, max_gaussians=gaussians, seed=seed, device=device)
    cloud = result.cloud
    surface = capture_surface(cloud)
    faces = surface.faces[_largest_part(surface.faces, len(surface.vertices))]
    used = np.unique(faces)
    corners, faces = surface.vertices[used], np.searchsorted(used, faces).astype(np.int32)
    middle, scale = standing(corners)
    vertices, faces = subdivided((corners - middle) * scale, faces)
    cells = np.floor(vertices * VOXELS).astype(int)
    low = cells.min(axis=0) - REACH
    shape = tuple(np.ptp(cells, axis=0) + 2 * REACH + 1)
    near = np.zeros(shape, bool)
    near[tuple((cells - low).T)] = True
    for axis in range(3):
        near = np.any([np.roll(near, step, axis) for step in range(-REACH, REACH + 1)], axis=0)
    at = np.argwhere(near)
    opaque = cloud.opacities() > 0.3
    _, nearest = KDTree((cloud.means.numpy()[opaque] - middle) * scale).query((at + low + 0.5) / VOXELS)
    colours = np.clip(0.5 + SH_BAND_0 * cloud.sh.numpy()[opaque, 0][nearest], 0.0, 1.0)
    voxels = np.full((*shape, 3), 128, np.uint8)
    voxels[near] = np.rint(255.0 * colours)
    arrays = {"vertices": vertices, "faces": faces, "voxels": voxels, "low": low}
    print(f"lego: proxy of {len(faces)} triangles, trained in {1e-3 * milliseconds:.0f} s", flush=True)
    if cache is not None:
        np.savez_compressed(cache, **arrays)
    return _painted(**arrays)


def _painted(vertices: np.ndarray, faces: np.ndarray, voxels: np.ndarray, low: np.ndarray) -> PaintedMesh:
    last = np.array(voxels.shape[:3]) - 1
    paint: Paint = lambda points: voxels[tuple(np.clip(np.floor(points * VOXELS).astype(int) - low, 0, last).T)] / 255.0  # noqa: E731
    return PaintedMesh("lego", vertices, faces, paint)


def _largest_part(faces: np.ndarray, count: int) -> np.ndarray:
    """Return (F,) bool, True for triangles of the largest connected component."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, part = connected_components(graph, directed=False)
    return part[faces[:, 0]] == np.argmax(np.bincount(part[faces[:, 0]]))
