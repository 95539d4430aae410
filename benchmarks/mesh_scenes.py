"""Objects with true meshes for Table 1 and Figure 8: solid textures, a ray caster, known deformations, training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp
from scipy import ndimage
from scipy.spatial import Delaunay

from egs_warp.deformation.embedding import CageLocator
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.precision import Vec3
from egs_warp.training.finetune import Densification, FinetuneOptions, TrainingView, finetune
from harness import data_folder
from kernels import trace_kernel

Paint = Callable[[np.ndarray], np.ndarray]
"""Colour (P, 3), 0 to 1, of points (P, 3) of the rest shape: a texture that goes through the solid."""
Motion = Callable[[np.ndarray], np.ndarray]
"""Deformed places (P, 3) of rest points (P, 3)."""


LONGEST_EDGE = 0.02
"""Of an object 1 high: bent by 80 degrees, the middle of such an edge is off by 7e-5."""


@dataclass(frozen=True)
class PaintedMesh:
    """A triangle mesh, z up, on the plane z = 0, 1 high, with a solid texture."""

    name: str
    vertices: np.ndarray
    """(V, 3) float64."""
    faces: np.ndarray
    """(F, 3) int32."""
    paint: Paint


def checkers(cell: float, colours: tuple[tuple[float, ...], ...]) -> Paint:
    """Cubes of side ``cell`` in two colours, tinted with height."""

    def paint(points: np.ndarray) -> np.ndarray:
        parity = np.floor(points / cell + 1e-6).astype(int).sum(axis=1) % 2
        tint = 0.12 * np.sin(7.0 * points[:, 2:3] + np.array([0.0, 2.0, 4.0]))
        return np.clip(np.array(colours)[parity] + tint, 0.0, 1.0)

    return paint


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            corners = [int(word.split("/")[0]) - 1 for word in words[1:]]
            faces += [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]
    return np.array(vertices), np.array(faces, dtype=np.int32)


def _standing(vertices: np.ndarray) -> np.ndarray:
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    return (vertices - [*((lower + upper)[:2] / 2), lower[2]]) / (upper[2] - lower[2])


def _subdivided(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges are halved until none is longer than ``LONGEST_EDGE``:
    a deformed mesh is the truth, and a long straight edge is not.
    """
    while True:
        sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
        long = np.linalg.norm(vertices[sides[..., 0]] - vertices[sides[..., 1]], axis=2) > LONGEST_EDGE
        if not long.any():
            return vertices, faces.astype(np.int32)
        edges, edge_from_side = np.unique(np.sort(sides[long], axis=1), axis=0, return_inverse=True)
        middle = np.full(faces.shape, -1)
        middle[long] = len(vertices) + edge_from_side.ravel()
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
        count = long.sum(axis=1)
        parts = [faces[count == 0]]
        # Turned until the halved side is the first, or the whole one the last.
        for halved in (1, 2, 3):
            chosen = count == halved
            first = {1: long.argmax(axis=1), 2: (~long).argmax(axis=1) + 1, 3: np.zeros(len(faces), dtype=int)}[halved][
                chosen
            ]
            turned = (first[:, None] + np.arange(3)) % 3
            x, y, z = np.take_along_axis(faces[chosen], turned, axis=1).T
            a, b, c = np.take_along_axis(middle[chosen], turned, axis=1).T
            pieces = {
                1: ((x, a, z), (a, y, z)),
                2: ((x, a, z), (a, y, b), (a, b, z)),
                3: ((x, a, c), (a, y, b), (c, b, z), (a, b, c)),
            }[halved]
            parts += [np.stack(piece, axis=1) for piece in pieces]
        faces = np.concatenate(parts)


def _turned_profile(profile: np.ndarray, around: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Surface of revolution of the (radius, z) polyline ``profile`` about z."""
    angle = np.linspace(0.0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.column_stack([r * ring, np.full(around, z)]) for r, z in profile])
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, b + around), (a, b + around, a + around))])
    return vertices, faces.astype(np.int32)


def chair() -> PaintedMesh:
    """The armchair, in checkered cloth."""
    vertices, faces = _read_obj(data_folder() / "meshes" / "armchair" / "armchair.obj")
    vertices, faces = _subdivided(_standing(vertices[:, [0, 2, 1]] * [1, -1, 1]), faces)
    return PaintedMesh("chair", vertices, faces, checkers(0.07, ((0.75, 0.3, 0.2), (0.9, 0.8, 0.6))))


def plant() -> PaintedMesh:
    """The potted aloe: green leaves, a banded pot."""
    parts = [_read_obj(path) for path in sorted((data_folder() / "meshes" / "plant").glob("*.obj"))]
    starts = np.cumsum([0, *[len(v) for v, _ in parts]])
    faces = np.concatenate([f + start for (_, f), start in zip(parts, starts, strict=False)])
    vertices, faces = _subdivided(_standing(np.concatenate([v for v, _ in parts])), faces.astype(np.int32))
    return PaintedMesh("plant", vertices, faces, checkers(0.06, ((0.15, 0.5, 0.2), (0.65, 0.85, 0.4))))


def microphone() -> PaintedMesh:
    """A generated table microphone: round foot, thin stem, ball."""
    foot = [(0.0, 0.0), (0.22, 0.0), (0.22, 0.03), (0.06, 0.06)]
    stem = [(0.03, z) for z in np.linspace(0.08, 0.66, 30)]
    arc = np.linspace(-1.2, np.pi / 2, 24)
    ball = [(0.17 * np.cos(t), 0.83 + 0.17 * np.sin(t)) for t in arc]
    vertices, faces = _subdivided(*_turned_profile(np.array([*foot, *stem, *ball])))
    return PaintedMesh("microphone", vertices, faces, checkers(0.06, ((0.15, 0.15, 0.2), (0.75, 0.75, 0.8))))


def spot() -> PaintedMesh:
    """Keenan Crane's cow."""
    vertices, faces = _read_obj(data_folder() / "meshes" / "spot" / "spot_triangulated.obj")
    vertices, faces = _subdivided(_standing(vertices[:, [0, 2, 1]] * [1, -1, 1]), faces)
    return PaintedMesh("spot", vertices, faces, checkers(0.07, ((0.9, 0.9, 0.85), (0.35, 0.25, 0.2))))


def stool() -> PaintedMesh:
    """The bar stool."""
    vertices, faces = _read_obj(data_folder() / "meshes" / "stool" / "stools_stool_model_0.obj")
    vertices, faces = _subdivided(_standing(vertices), faces)
    return PaintedMesh("stool", vertices, faces, checkers(0.07, ((0.3, 0.35, 0.6), (0.85, 0.75, 0.5))))


def bar() -> PaintedMesh:
    """The checkered bar of Figure 8: a quarter as thick as it is high, in bricks of long sides,
    as long Gaussians want.
    """
    corners = np.array([[x, y, z] for x in (-0.125, 0.125) for y in (-0.125, 0.125) for z in (0.0, 1.0)])
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
        + [[1, 5, 7], [1, 7, 3]],
        dtype=np.int32,
    )
    vertices, faces = _subdivided(corners, faces)

    def paint(points: np.ndarray) -> np.ndarray:
        # Faces lie on borders between cells; looked up a little inside, so that rounding does not choose their colour.
        inside = (points - [0.0, 0.0, 0.5]) * 0.99 + [0.0, 0.0, 0.5]
        parity = np.floor(inside / [0.125, 0.125, 0.25]).astype(int).sum(axis=1) % 2
        return np.where(parity[:, None] == 0, [[0.9, 0.9, 0.85]], [[0.15, 0.2, 0.45]])

    return PaintedMesh("bar", vertices, faces, paint)


def box_cage(vertices: np.ndarray, cells: int) -> TetMesh:
    """Tetrahedra in the box around ``vertices``, a twentieth larger, about ``cells`` along its longest side."""
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
    """The vertical axis bent onto a circle, the top turned by 80 degrees."""
    radius = 1.0 / np.radians(80.0)
    angle = points[:, 2] / radius
    r = radius - points[:, 0]
    return np.stack([radius - r * np.cos(angle), points[:, 1], r * np.sin(angle)], axis=1)


def twist_by(degrees: float) -> Motion:
    """Turned about the vertical axis, by ``degrees`` at the top."""

    def twist(points: np.ndarray) -> np.ndarray:
        angle = np.radians(degrees) * points[:, 2]
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = points.T
        return np.stack([c * x - s * y, s * x + c * y, z], axis=1)

    return twist


def ring(
    vertices: np.ndarray, count: int, size: int, *, elevations: tuple[float, ...], phase: float = 0.0
) -> list[Camera]:
    """Cameras around ``vertices`` (V, 3), which fill their pictures, at each elevation (degrees) in turn."""
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    centre, distance = 0.5 * (lower + upper), 1.5 * float(np.linalg.norm(upper - lower))
    vertical = np.array([0.0, 0.0, 1.0])
    cameras = []
    for index in range(count):
        azimuth = 2 * np.pi * (index + phase) / count
        up = np.radians(elevations[index % len(elevations)])
        eye = centre + distance * np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        wide = Camera.look_at(eye, centre, vertical, width=size, height=size)
        seen = (vertices - eye) @ wide.rotation.T
        fov = 2.0 * np.degrees(np.arctan(1.05 * np.abs(seen[:, :2] / seen[:, 2:]).max()))
        cameras.append(Camera.look_at(eye, centre, vertical, width=size, height=size, vertical_fov_degrees=fov))
    return cameras


def photograph(
    mesh: PaintedMesh, vertices: np.ndarray, cameras: list[Camera], device: str, *, samples: int = 3
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Picture (H, W, 3) on white and coverage (H, W) of the mesh with its vertices at ``vertices``, for each camera."""
    with wp.ScopedDevice(device):
        solid = wp.Mesh(wp.array(vertices, dtype=wp.vec3), wp.array(mesh.faces.ravel(), dtype=wp.int32))
        rest = wp.array(mesh.vertices, dtype=wp.vec3)
        pictures = []
        for camera in cameras:
            count = camera.width * camera.height
            where = wp.zeros((count, samples**2), dtype=wp.vec3)
            hit = wp.zeros((count, samples**2), dtype=wp.bool)
            wp.launch(
                trace_kernel,
                dim=(count, samples**2),
                inputs=[
                    solid.id,
                    rest,
                    wp.mat33(*camera.rotation.T.ravel()),
                    wp.vec3(*camera.centre),
                    wp.vec2(camera.fx, camera.fy),
                    wp.vec2(camera.cx, camera.cy),
                    camera.width,
                    samples,
                ],
                outputs=[where, hit],
            )
            covered = np.asarray(hit.numpy(), dtype=bool)
            colour = np.ones((count, samples**2, 3))
            colour[covered] = mesh.paint(where.numpy()[covered].astype(np.float64))
            shape = (camera.height, camera.width)
            pictures.append((colour.mean(axis=1).reshape(*shape, 3), covered.mean(axis=1).reshape(shape)))
    return pictures


def carried_vertices(mesh: PaintedMesh, cage: TetMesh, nodes: np.ndarray, device: str) -> np.ndarray:
    """Vertices of the mesh as the cage carries them to node positions ``nodes``."""
    locator = CageLocator(cage, device=device)
    places = locator.locate(wp.array(mesh.vertices, dtype=Vec3, device=device))
    return places.interpolate(wp.array(nodes, dtype=Vec3, device=device)).numpy()


def surface_points(mesh: PaintedMesh, count: int, seed: int) -> np.ndarray:
    """(count, 3) points spread evenly over the surface."""
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(corners), count, p=areas / areas.sum())]
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return chosen[:, 0] + u * (chosen[:, 1] - chosen[:, 0]) + v * (chosen[:, 2] - chosen[:, 0])


def surface_cloud(mesh: PaintedMesh, count: int, *, device: str) -> GaussianCloud:
    """Small opaque round Gaussians spread evenly over the surface."""
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
    mesh: PaintedMesh, *, size: int, views: int, gaussians: int, iterations: int, seed: int, device: str
) -> GaussianCloud:
    """Gaussians trained from ``views`` photographs of the mesh at rest, by the project's own trainer."""
    points = surface_points(mesh, gaussians, seed)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    cloud = GaussianCloud.from_numpy(
        points,
        np.tile([1.0, 0.0, 0.0, 0.0], (gaussians, 1)),
        np.full((gaussians, 3), np.log(0.6 * np.sqrt(area / gaussians))),
        np.full(gaussians, 0.5),
        ((mesh.paint(points) - 0.5) / 0.28209479177387814)[:, None],
        device=device,
    )
    # From below and from above too: a deformation turns what was hidden towards the eye.
    cameras = ring(mesh.vertices, views, size, elevations=(15.0, 50.0, -15.0, 75.0, -50.0))
    photos = photograph(mesh, mesh.vertices, cameras, device)
    # Before white alone, white haze around the object would cost nothing, and a deformation would show it.
    training = [
        TrainingView(camera, (colour - (1.0 - cover[..., None])) / np.maximum(cover[..., None], 1e-6), cover)
        for camera, (colour, cover) in zip(cameras, photos, strict=True)
    ]
    options = FinetuneOptions(
        iterations=iterations,
        densification=Densification.RELOCATION if iterations >= 1000 else Densification.NONE,
        max_gaussians=gaussians,
        background=None,
        seed=seed,
    )
    return finetune(cloud, training, options=options).cloud


def outside(alpha: np.ndarray, coverage: np.ndarray, threshold: float = 0.1) -> float:
    """Share of pixels that are drawn outside the silhouette dilated by one pixel."""
    allowed = np.asarray(ndimage.binary_dilation(coverage > 0, structure=np.ones((3, 3))), dtype=bool)
    return float(np.mean((alpha > threshold) & ~allowed))
