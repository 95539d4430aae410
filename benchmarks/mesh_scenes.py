"""Scenes with ground truth for Table 1 and Figure 8: cages, known deformations, ray casting and training."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp
from scipy import ndimage
from scipy.spatial import Delaunay

from egs_warp.deformation.embedding import CageLocator
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.precision import Vec3
from egs_warp.training.finetune import Densification, FinetuneOptions, finetune
from egs_warp.training.training_view import TrainingView
from kernels import trace_kernel
from painted_meshes import PaintedMesh

Motion = Callable[[np.ndarray], np.ndarray]
"""Map from rest points (P, 3) to deformed points (P, 3)."""


def box_cage(vertices: np.ndarray, cells: int) -> TetMesh:
    """Build a cage of tetrahedra in a box slightly larger than ``vertices``, with about ``cells`` cells along its
    longest side."""
    lower, upper = vertices.min(axis=0) - 0.025, vertices.max(axis=0) + 0.025
    size = upper - lower
    counts = np.maximum(2, np.round(cells * size / size.max()).astype(int))
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(lower, upper, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    jitter = np.random.default_rng(0).uniform(-0.05, 0.05, nodes.shape) * size / counts
    inner = (nodes > lower + 1e-9) & (nodes < upper - 1e-9)
    nodes = nodes + np.where(inner, jitter, 0.0)
    tets = Delaunay(nodes).simplices
    corners = nodes[tets]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    return TetMesh.oriented(nodes, tets[volumes > 1e-2 * np.prod(size / counts)])


def bend(points: np.ndarray) -> np.ndarray:
    """Bend the vertical axis onto a circle, with the top rotated by 80 degrees."""
    radius = 1.0 / np.radians(80.0)
    angle = points[:, 2] / radius
    r = radius - points[:, 0]
    return np.stack([radius - r * np.cos(angle), points[:, 1], r * np.sin(angle)], axis=1)


def twist_by(degrees: float) -> Motion:
    """Return a twist about the vertical axis that reaches ``degrees`` at height 1."""

    def twist(points: np.ndarray) -> np.ndarray:
        angle = np.radians(degrees) * points[:, 2]
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = points.T
        return np.stack([c * x - s * y, s * x + c * y, z], axis=1)

    return twist


def ring(
    vertices: np.ndarray, count: int, size: int, *, elevations: tuple[float, ...], phase: float = 0.0
) -> list[Camera]:
    """Return cameras around ``vertices`` (V, 3), at each elevation (degrees) in turn; the vertices fill the images."""
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    centre, distance = 0.5 * (lower + upper), 1.5 * float(np.linalg.norm(upper - lower))
    vertical = np.array([0.0, 0.0, 1.0])
    cameras = []
    for index in range(count):
        azimuth = 2 * np.pi * (index + phase) / count
        up = np.radians(elevations[index % len(elevations)])
        eye = centre + distance * np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        wide = Camera.look_at(eye, centre, vertical, width=size, height=size)
        local = (vertices - eye) @ wide.rotation.T
        fov = 2.0 * np.degrees(np.arctan(1.05 * np.abs(local[:, :2] / local[:, 2:]).max()))
        cameras.append(Camera.look_at(eye, centre, vertical, width=size, height=size, vertical_fov_degrees=fov))
    return cameras


def photograph(
    mesh: PaintedMesh, vertices: np.ndarray, cameras: list[Camera], device: str, *, samples: int = 3
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Ray-cast the mesh at ``vertices``; return colour (H, W, 3) on white and coverage (H, W) for each camera."""
    with wp.ScopedDevice(device):
        solid = wp.Mesh(wp.array(vertices, dtype=wp.vec3), wp.array(mesh.faces.ravel(), dtype=wp.int32))
        rest = wp.array(mesh.vertices, dtype=wp.vec3)
        turns = wp.array(face_rotations(mesh, vertices).transpose(0, 2, 1), dtype=wp.mat33)
        pictures = []
        for camera in cameras:
            count = camera.width * camera.height
            where = wp.zeros((count, samples**2), dtype=wp.vec3)
            hit = wp.zeros((count, samples**2), dtype=wp.bool)
            light, gloss = wp.zeros_like(where), wp.zeros_like(where)
            wp.launch(
                trace_kernel,
                dim=(count, samples**2),
                inputs=[
                    solid.id,
                    rest,
                    turns,
                    wp.mat33(*camera.rotation.T.ravel()),
                    wp.vec3(*camera.centre),
                    wp.vec2(camera.fx, camera.fy),
                    wp.vec2(camera.cx, camera.cy),
                    camera.width,
                    samples,
                ],
                outputs=[where, hit, light, gloss],
            )
            hits = np.asarray(hit.numpy(), dtype=bool)
            # Most pixels miss the mesh, so only the samples that hit it are stored.
            pixels = np.flatnonzero(hits.any(axis=1))
            covered = hits[pixels]
            sampled = np.ones((len(pixels), samples**2, 3))
            painted = mesh.paint(where.numpy()[pixels][covered].astype(np.float64))
            if mesh.glossy:
                lit, shone = (one.numpy()[pixels][covered] for one in (light, gloss))
                painted = np.clip(painted * lit + shone, 0.0, 1.0)
            sampled[covered] = painted
            colour, coverage = np.ones((count, 3)), np.zeros(count)
            colour[pixels], coverage[pixels] = sampled.mean(axis=1), covered.mean(axis=1)
            shape = (camera.height, camera.width)
            pictures.append((colour.reshape(*shape, 3), coverage.reshape(shape)))
    return pictures


def face_rotations(mesh: PaintedMesh, vertices: np.ndarray) -> np.ndarray:
    """Return the rotation (F, 3, 3) of each face from rest to ``vertices`` (V, 3).

    The rotation is the polar factor of the face's deformation gradient, which maps the unit normal at rest to the
    deformed one.
    """

    def frames(points: np.ndarray) -> np.ndarray:
        a, b, c = points[mesh.faces].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        return np.stack([b - a, c - a, normal], axis=2)

    before, after = frames(mesh.vertices), frames(vertices)
    # A degenerate face has no well-defined rotation and is invisible.
    sound = (np.linalg.det(before) > 1e-14) & (np.linalg.det(after) > 1e-14)
    turns = np.tile(np.eye(3), (len(mesh.faces), 1, 1))
    u, _, v = np.linalg.svd(after[sound] @ np.linalg.inv(before[sound]))
    turns[sound] = u @ v
    return turns


def carried_vertices(mesh: PaintedMesh, cage: TetMesh, nodes: np.ndarray, device: str) -> np.ndarray:
    """Return the vertices (V, 3) of the mesh, deformed by the cage whose nodes are at ``nodes`` (N, 3)."""
    locator = CageLocator(cage, device=device)
    places = locator.locate(wp.array(mesh.vertices, dtype=Vec3, device=device))
    return places.interpolate(wp.array(nodes, dtype=Vec3, device=device)).numpy()


def surface_points(mesh: PaintedMesh, count: int, seed: int) -> np.ndarray:
    """Return points (count, 3) that are uniformly distributed over the surface."""
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(corners), count, p=areas / areas.sum())]
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return chosen[:, 0] + u * (chosen[:, 1] - chosen[:, 0]) + v * (chosen[:, 2] - chosen[:, 0])


def surface_cloud(mesh: PaintedMesh, count: int, *, device: str) -> GaussianCloud:
    """Return small opaque isotropic Gaussians, uniformly distributed over the surface."""
    points = surface_points(mesh, count, seed=0)
    return GaussianCloud.from_numpy(
        points,
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.full((count, 3), np.log(0.006)),
        np.full(count, 3.0),
        np.zeros((count, 1, 3)),
        device=device,
    )


def trained(
    mesh: PaintedMesh,
    *,
    size: int,
    views: int,
    gaussians: int,
    iterations: int,
    seed: int,
    device: str,
    degree: int = 0,
) -> GaussianCloud:
    """Train Gaussians from ``views`` photographs of the mesh at rest, with the project's own trainer."""
    return trained_on(
        mesh, photographs(mesh, size, views, device), gaussians, iterations, seed=seed, degree=degree, device=device
    )


def photographs(mesh: PaintedMesh, size: int, views: int, device: str) -> list[TrainingView]:
    """Render views of the mesh at rest from all around, without background."""
    # Some views are from below and from above, because a deformation exposes surfaces that are hidden from the side at
    # rest.
    cameras = ring(mesh.vertices, views, size, elevations=(15.0, 50.0, -15.0, 75.0, -50.0))
    photos = photograph(mesh, mesh.vertices, cameras, device)
    return [
        TrainingView(camera, (colour - (1.0 - cover[..., None])) / np.maximum(cover[..., None], 1e-6), cover)
        for camera, (colour, cover) in zip(cameras, photos, strict=True)
    ]


def trained_on(
    mesh: PaintedMesh,
    photos: list[TrainingView],
    gaussians: int,
    iterations: int,
    *,
    seed: int,
    degree: int,
    device: str,
) -> GaussianCloud:
    """Train ``gaussians`` Gaussians of SH ``degree`` from ``photos``, starting from points on the true surface."""
    points = surface_points(mesh, gaussians, seed)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    sh = np.zeros((gaussians, (degree + 1) ** 2, 3))
    sh[:, 0] = (mesh.paint(points) - 0.5) / SH_BAND_0
    cloud = GaussianCloud.from_numpy(
        points,
        np.tile([1.0, 0.0, 0.0, 0.0], (gaussians, 1)),
        np.full((gaussians, 3), np.log(0.6 * np.sqrt(area / gaussians))),
        np.full(gaussians, 0.5),
        sh,
        device=device,
    )
    options = FinetuneOptions(
        iterations=iterations,
        densification=Densification.RELOCATION if iterations >= 1000 else Densification.NONE,
        max_gaussians=gaussians,
        # On a white background alone, white haze around the object would have no error in training, but a deformation
        # would expose it.
        background=None,
        seed=seed,
    )
    return finetune(cloud, photos, options=options).cloud


def outside(alpha: np.ndarray, coverage: np.ndarray, threshold: float = 0.1) -> float:
    """Return the fraction of pixels that are drawn outside the silhouette dilated by one pixel."""
    allowed = np.asarray(ndimage.binary_dilation(coverage > 0, structure=np.ones((3, 3))), dtype=bool)
    return float(np.mean((alpha > threshold) & ~allowed))
