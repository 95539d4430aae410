"""Film of a simulated world: all bodies are deformed and drawn together, with their shadows on the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from egs_warp.deformation.deformer import DeformedGaussians, Deformer
from egs_warp.deformation.joint_deformer import JointDeformer
from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.geometry.camera import Camera
from egs_warp.io.run_folder import RunFolder
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.pipelines.captured_body import points_at_rest
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.film import Filmed, encode_film, path_of, rendered_frames, split_deformer
from egs_warp.pipelines.obstacle_cloud import Obstacles, ObstacleShadows, make_obstacles
from egs_warp.pipelines.shot import Shot, framed, nearest_steps, resized
from egs_warp.pipelines.simulated_run import FIELD_OF_VIEW, BodyResult
from egs_warp.pipelines.world_run import WorldRun
from egs_warp.render.shadow import shadow_blur_radius
from egs_warp.short_repr import short_repr

_ELEVATION = 0.35
"""Ratio of the vertical to the horizontal component of the direction to the camera, higher than for one body so that
the ground between the bodies is visible."""
_VIEWS = 24
"""Number of directions to the camera that are compared."""
_LEVEL_WEIGHT = 0.4
"""Weight of equal distances from the camera: at different distances, bodies of equal size appear unequal."""
_FRAMED_MARGIN = 0.15
"""Distance from the bodies up to which obstacles are in the picture, relative to the extent of the motion."""
_OBSTACLE_MARGIN = 1.0
"""Distance from the bodies up to which obstacles are drawn, relative to the extent of the motion."""
_FACING_WEIGHT = 0.6
"""Weight of creatures that face the camera, relative to that of bodies that do not hide each other."""


@dataclass(frozen=True)
class WorldMotion:
    """Points of all bodies in each frame of a run, for cameras (``FilmedMotion``)."""

    time: np.ndarray
    """(n,) s, time of each frame."""
    positions: np.ndarray
    """(n, N, 3) m, points of all bodies, body after body: nodes of a creature, extreme contact points of a prop."""
    node_mass: np.ndarray
    """(N,) kg, mass of each point; the points of a body share its mass equally."""
    capture_frame: BodyFrame
    """Frame of the world, without scaling, because cameras from a file are in metres and in the axes of the world."""

    @classmethod
    def from_run(cls, run: WorldRun) -> WorldMotion:
        """Return the motion of all bodies of ``run``."""
        parts = [_outline(result) for result in run.results]
        counts = [part.shape[1] for part in parts]
        masses = [np.full(count, each.body.body.mass / count) for count, each in zip(counts, run.results, strict=True)]
        return cls(
            run.time, np.concatenate(parts, axis=1), np.concatenate(masses), BodyFrame(np.eye(3), np.zeros(3), 1.0)
        )


@dataclass(frozen=True)
class WorldFilm:
    """File, Gaussians and camera of the film of a world."""

    __repr__ = short_repr

    file: str
    """Name of the video in the folder of the run."""
    deformers: Mapping[str, Deformer]
    """Deformer of the Gaussians of each body after splitting, by the name of the body."""
    camera: Camera
    """Fixed camera of the film."""


def _outline(result: BodyResult) -> np.ndarray:
    """Return points (n, N, 3) m that bound a body in each frame: the nodes of a creature. The nodes of a prop are not
    near its surface, so its extreme contact points are returned instead."""
    body, simulation = result.body, result.simulation
    positions = simulation.trajectory.positions[simulation.frames]
    if len(body.mesh.tets) > 1:
        return positions
    directions = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    extreme = np.unique(np.argmax(directions @ points_at_rest(body.geometry).T, axis=1))
    return np.einsum("pw,fwi->fpi", body.geometry.weights[extreme], positions[:, body.mesh.tets[0]])


def world_camera(run: WorldRun, size: int, view_from: Sequence[float] | np.ndarray | None = None) -> Camera:
    """Return a fixed camera that shows all bodies, and obstacles near them, during the whole run.

    By default, the camera is where the bodies hide each other least and the creatures face it.

    Args:
        run: The simulated world.
        size: Width and height of the image, pixels.
        view_from: (3,) Direction to the camera in the axes of the world.
    """
    points = WorldMotion.from_run(run).positions.reshape(-1, 3)
    obstacles = _obstacles(run, points)
    if obstacles is not None:
        near = obstacles.cloud.means.numpy().astype(np.float64)
        low, high = points.min(axis=0), points.max(axis=0)
        margin = _FRAMED_MARGIN * float((high - low).max())
        points = np.concatenate([points, near[((near > low - margin) & (near < high + margin)).all(axis=1)]])
    direction = _clearest_view(run) if view_from is None else np.asarray(view_from, float)
    direction = direction / np.linalg.norm(direction)
    low, high = points.min(axis=0), points.max(axis=0)
    middle, distance = 0.5 * (low + high), float(np.linalg.norm(high - low))
    camera = Camera.look_at(
        middle + distance * direction,
        middle,
        np.array([0.0, 1.0, 0.0]) if abs(direction[2]) > 0.9999 else GROUND.normal,
        width=size,
        height=size,
        vertical_fov_degrees=FIELD_OF_VIEW,
    )
    return framed(camera, points)


def draw_world_film(
    run: WorldRun,
    folder: RunFolder,
    *,
    name: str = "world",
    size: int = 512,
    shot: Shot | None = None,
    view_from: Sequence[float] | np.ndarray | None = None,
    shadow: bool = True,
    quiet: bool = False,
) -> WorldFilm:
    """Render a simulated world and write its video and ``sheet.png``.

    Args:
        run: The simulated world.
        folder: Folder for the files.
        name: Name of the video, without the file ending.
        size: Width and height of the video, pixels, if ``shot`` has no size.
        shot: Camera, size, frame rate and background colour.
        view_from: (3,) Direction to the camera in the axes of the world; None chooses it (``world_camera``).
        shadow: Draw the shadows of the bodies on the ground and on obstacles.
        quiet: Show no progress bar.
    """
    shot = shot or Shot()
    motion = WorldMotion.from_run(run)
    steps = np.arange(len(motion.time)) if shot.fps == FRAME_RATE else nearest_steps(motion.time, shot.fps)
    camera = resized(world_camera(run, size, view_from), *(shot.size or (size, size)))
    cameras = shot.cameras(camera, motion, steps, in_scene=run.world.surroundings is not None)
    obstacles = _obstacles(run, motion.positions.reshape(-1, 3))
    scene = None if run.world.surroundings is None else run.world.surroundings.cloud
    deformers = {name: split_deformer(result, in_scene=scene is not None) for name, result in run.bodies.items()}
    deformer = JointDeformer(tuple(deformers.values()), fixed=None if obstacles is None else obstacles.cloud)
    simulations = [result.simulation for result in run.results]
    poses = ([each.trajectory.positions[each.frames[step]] for each in simulations] for step in steps)
    filmed = Filmed(
        np.concatenate([path_of(each.trajectory) for each in simulations]),
        max(each.trajectory.height for each in simulations),
        is_flat=run.world.ground is None,
    )
    deform = deformer.deform
    if obstacles is not None and shadow:
        count = deformer.rest.count - obstacles.cloud.count
        shadows = ObstacleShadows(obstacles, count, blur_radius=shadow_blur_radius(deformer.rest), height=filmed.height)
        deform = partial(_deform_with_shadows, deformer, shadows)
    frames = rendered_frames(deform, deformer.rest, poses, filmed, cameras, shot, scene=scene, shadow=shadow)
    path, _ = encode_film(frames, folder, name, cameras[0], shot, motion.time[steps], quiet=quiet)
    return WorldFilm(path.name, deformers, camera)


def _deform_with_shadows(
    deformer: JointDeformer, shadows: ObstacleShadows, poses: Sequence[np.ndarray]
) -> DeformedGaussians:
    """Deform all bodies and draw their shadows on the obstacles."""
    deformed = deformer.deform(poses)
    shadows.draw(deformed.cloud)
    return deformed


def _obstacles(run: WorldRun, points: np.ndarray) -> Obstacles | None:
    """Return the obstacles near the ``points`` (n, 3) of the bodies; None if there are none to draw."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _OBSTACLE_MARGIN * float((high - low).max())
    device = str(run.results[0].body.cloud.device)
    return make_obstacles(run.world.solids, low - margin, high + margin, device=device)


def _clearest_view(run: WorldRun) -> np.ndarray:
    """Return the direction (3,) to the camera from which the bodies look most separate and the creatures face it."""
    simulations = [result.simulation for result in run.results]
    paths = np.stack([path_of(each.trajectory)[each.frames][:, :2] for each in simulations])
    radii = [0.5 * float(np.ptp(each.trajectory.positions[0][:, :2], axis=0).max()) for each in simulations]
    faces = [result.body.front.direction[:2] for result in run.results if isinstance(result.body, Creature)]
    first, second = np.triu_indices(len(simulations), 1)
    between, reach = paths[first] - paths[second], np.array(radii)[first] + np.array(radii)[second]
    angles = 2.0 * np.pi * (np.arange(_VIEWS) + 0.5) / _VIEWS
    surroundings = run.world.surroundings
    if surroundings is not None and surroundings.views is not None:
        # A capture looks best from where it was photographed.
        angles = np.arctan2(surroundings.views[:, 1], surroundings.views[:, 0])
    best, best_score = angles[0], -np.inf
    for angle in angles:
        towards, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        apart = np.abs(between @ across)
        separation = float(np.minimum(apart / reach[:, None], 1.0).mean()) if len(first) else 1.0
        level = float((apart / np.maximum(np.linalg.norm(between, axis=2), 1e-9)).mean()) if len(first) else 1.0
        # A three-quarter view shows a face best.
        facing = float(np.minimum(np.array(faces) @ towards, 0.8).mean()) if faces else 0.0
        score = separation + _LEVEL_WEIGHT * level + _FACING_WEIGHT * facing
        if score > best_score:
            best, best_score = angle, score
    return np.array([np.cos(best), np.sin(best), _ELEVATION])
