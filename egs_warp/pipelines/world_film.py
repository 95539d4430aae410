"""Film of a world: all bodies are deformed and drawn together, with shadows on the ground and on each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from egs_warp.contact.occlusion import BodyShadows, OccludingBody
from egs_warp.contact.terrain import Solid
from egs_warp.deformation.deformer import DeformedGaussians, Deformer
from egs_warp.deformation.joint_deformer import JointDeformer
from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.run_folder import RunFolder
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.locomotion.world_audit import ContactShape
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.film import Filmed, path_of, rendered_frames, split_deformer
from egs_warp.pipelines.film_file import Frame, encode_film, sheet_frames
from egs_warp.pipelines.obstacle_cloud import Obstacles, ObstacleShadows, make_obstacles
from egs_warp.pipelines.shot import Shot, framed, nearest_steps, reframed
from egs_warp.pipelines.simulated_run import FIELD_OF_VIEW
from egs_warp.pipelines.world_run import WorldRun
from egs_warp.render.shadow import shadow_blur_radius
from egs_warp.short_repr import short_repr

_ELEVATION = 0.35
"""Ratio of the vertical to the horizontal component of the direction to the camera. It is larger than for a single
body, so that the ground between the bodies is visible."""
_VIEWS = 24
"""Number of directions to the camera that are compared."""
_LEVEL_WEIGHT = 0.4
"""Weight of the criterion that all bodies have similar distances from the camera, because bodies of equal size appear
unequal at different distances."""
_FRAMED_MARGIN = 0.15
"""Maximum distance from the bodies at which the camera includes obstacles in the picture, relative to the extent of the
motion."""
_OBSTACLE_MARGIN = 1.0
"""Maximum distance from the bodies at which obstacles are drawn, relative to the extent of the motion."""
_FACING_WEIGHT = 0.6
"""Weight of the criterion that creatures face the camera, relative to the criterion that bodies do not hide each
other."""


@dataclass(frozen=True)
class FilmedBody:
    """A body of a world, ready to be drawn."""

    __repr__ = short_repr

    deformer: Deformer
    """Deformer of its Gaussians after splitting."""
    trajectory: Trajectory
    steps: np.ndarray
    """(n,) index of the state of each frame at 60 Hz."""
    shape: ContactShape
    """Contact points and level set."""

    @property
    def outline(self) -> np.ndarray:
        """Points (n, N, 3) m that bound the body in each frame. For a creature, these are its nodes. The nodes of a
        prop are not near its surface, so its extreme contact points are used instead."""
        t, shape = self.trajectory, self.shape
        positions = t.positions[self.steps]
        if len(t.tets) > 1:
            return positions
        directions = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
        extreme = np.unique(np.argmax(directions @ shape.points(t.tets, t.rest_positions).T, axis=1))
        return np.einsum("pw,fwi->fpi", shape.point_weights[extreme], positions[:, t.tets[0]])


@dataclass(frozen=True)
class FilmedWorld:
    """The bodies and obstacles of a simulated or finished world, ready to be drawn."""

    __repr__ = short_repr

    bodies: Mapping[str, FilmedBody]
    """Bodies by name, in the order of the world."""
    solids: tuple[Solid, ...]
    """Obstacles, without the ground."""
    scene: GaussianCloud | None = None
    """Captured scene behind the bodies, in the frame of the world."""
    is_flat: bool = True
    """True if the ground is flat and hides what is below it."""

    @classmethod
    def from_run(cls, run: WorldRun) -> FilmedWorld:
        """Prepare the bodies of a simulated world; their Gaussians are split for their motions."""
        bodies = {}
        scene = None if run.world.surroundings is None else run.world.surroundings.cloud
        for name, result in run.bodies.items():
            body, simulation = result.body, result.simulation
            shape = ContactShape.of(body.geometry, body.shape.level_set, body.mesh.nodes)
            deformer = split_deformer(result, in_scene=scene is not None)
            bodies[name] = FilmedBody(deformer, simulation.trajectory, simulation.frames, shape)
        return cls(bodies, run.world.solids, scene, run.world.ground is None)

    @property
    def time(self) -> np.ndarray:
        """(n,) s, time of each frame at 60 Hz."""
        first = next(iter(self.bodies.values()))
        return first.trajectory.time[first.steps]

    def motion(self) -> WorldMotion:
        """Return the motion of all bodies, for cameras."""
        parts = [body.outline for body in self.bodies.values()]
        masses = [
            np.full(part.shape[1], body.trajectory.node_mass.sum() / part.shape[1])
            for part, body in zip(parts, self.bodies.values(), strict=True)
        ]
        frame = BodyFrame(np.eye(3), np.zeros(3), 1.0)
        return WorldMotion(self.time, np.concatenate(parts, axis=1), np.concatenate(masses), frame)

    def framed_points(self) -> np.ndarray:
        """Return the points (m, 3), m, that a fixed camera shows: those of ``motion``, and obstacles near them."""
        points = self.motion().positions.reshape(-1, 3)
        obstacles = _obstacles(self.solids, points, filmed_device(self))
        if obstacles is None:
            return points
        near = obstacles.cloud.means.numpy().astype(np.float64)
        low, high = points.min(axis=0), points.max(axis=0)
        margin = _FRAMED_MARGIN * float((high - low).max())
        return np.concatenate([points, near[((near > low - margin) & (near < high + margin)).all(axis=1)]])

    def poses(self, frame: int) -> list[np.ndarray]:
        """Return the node positions (N, 3) m of each body in a frame at 60 Hz."""
        return [body.trajectory.positions[body.steps[frame]] for body in self.bodies.values()]

    def joint_deformer(self, fixed: GaussianCloud | None = None) -> JointDeformer:
        """Return the deformer of all bodies into one cloud, followed by the cloud ``fixed``."""
        return JointDeformer([body.deformer for body in self.bodies.values()], fixed=fixed)

    def shadows(self, device: wp.Device) -> BodyShadows:
        """Return the contact shadows of the bodies on each other, for the cloud of ``joint_deformer``."""
        occluding = []
        for body in self.bodies.values():
            t, shape = body.trajectory, body.shape
            mesh = TetMesh(shape.rest_positions, t.tets)
            occluding.append(OccludingBody(mesh, shape.point_tets, shape.point_weights, shape.level_set, t.height))
        return BodyShadows(occluding, [body.deformer.rest.count for body in self.bodies.values()], device)


@dataclass(frozen=True)
class WorldMotion:
    """Points of all bodies in each frame of a run, for cameras (``FilmedMotion``)."""

    time: np.ndarray
    """(n,) s, time of each frame."""
    positions: np.ndarray
    """(n, N, 3) m, points of all bodies, body after body (``FilmedBody.outline``)."""
    node_mass: np.ndarray
    """(N,) kg, mass of each point; the points of a body share its mass equally."""
    capture_frame: BodyFrame
    """Frame of the world, without scaling, because key cameras from a file are in metres and in the axes of the
    world."""


def world_camera(
    run: WorldRun,
    filmed: FilmedWorld,
    size: tuple[int, int],
    view_from: Sequence[float] | np.ndarray | None = None,
) -> Camera:
    """Return a fixed camera that shows all bodies, and obstacles near them, during the whole run.

    By default, the camera is placed where the bodies hide each other least and the creatures face the camera.

    Args:
        run: The simulated world.
        filmed: Its bodies.
        size: Width and height of the image, pixels.
        view_from: (3,) Direction to the camera in the axes of the world.
    """
    points = filmed.framed_points()
    direction = _clearest_view(run) if view_from is None else np.asarray(view_from, float)
    direction = direction / np.linalg.norm(direction)
    low, high = points.min(axis=0), points.max(axis=0)
    middle, distance = 0.5 * (low + high), float(np.linalg.norm(high - low))
    camera = Camera.look_at(
        middle + distance * direction,
        middle,
        np.array([0.0, 1.0, 0.0]) if abs(direction[2]) > 0.9999 else GROUND.normal,
        width=size[0],
        height=size[1],
        vertical_fov_degrees=FIELD_OF_VIEW,
    )
    return framed(camera, points)


def draw_world_film(
    filmed: FilmedWorld,
    camera: Camera,
    folder: RunFolder,
    *,
    name: str = "world",
    shot: Shot | None = None,
    shadow: bool = True,
    quiet: bool = False,
) -> str:
    """Render all bodies of a world and write the video and ``sheet.png``.

    Args:
        filmed: The bodies.
        camera: Fixed camera, as for ``world_frames``.
        folder: Folder for the files.
        name: Name of the video, without the file ending.
        shot: Camera motion, size, frame rate and background colour.
        shadow: True to draw the shadows of the bodies on the ground, on obstacles and on each other.
        quiet: True to show no progress bar.

    Returns:
        The name of the video.
    """
    shot = shot or Shot()
    steps = film_steps(filmed, shot)
    cameras = world_cameras(filmed, camera, shot, steps)
    frames = world_frames(filmed, steps, cameras, shot, shadow=shadow)
    shown = sheet_frames(filmed.motion().positions, steps)
    path, _ = encode_film(frames, folder, name, cameras[0], shot, filmed.time[steps], shown, quiet=quiet)
    return path.name


def world_cameras(filmed: FilmedWorld, camera: Camera, shot: Shot, steps: np.ndarray) -> list[Camera]:
    """Return the camera of each of the frames ``steps`` (m,) of a film; ``camera`` is the fixed camera of the world."""
    if shot.size not in (None, (camera.width, camera.height)):
        camera = reframed(camera, *shot.size, filmed.framed_points())
    return shot.cameras(camera, filmed.motion(), steps, in_scene=filmed.scene is not None)


def film_steps(filmed: FilmedWorld, shot: Shot) -> np.ndarray:
    """Return the frames at 60 Hz (m,) that a film at the frame rate of ``shot`` shows."""
    time = filmed.time
    return np.arange(len(time)) if shot.fps == FRAME_RATE else nearest_steps(time, shot.fps)


def world_frames(
    filmed: FilmedWorld, frames: np.ndarray, cameras: Sequence[Camera], shot: Shot, *, shadow: bool = True
) -> Iterator[Frame]:
    """Render ``frames`` (m,), counted at 60 Hz, each with its camera.

    Args:
        filmed: The bodies.
        frames: Frames to render.
        cameras: Camera of each frame.
        shot: Background colour and transparency.
        shadow: True to draw the shadows of the bodies on the ground, on obstacles and on each other.
    """
    device = filmed_device(filmed)
    obstacles = _obstacles(filmed.solids, filmed.motion().positions.reshape(-1, 3), device)
    deformer = filmed.joint_deformer(None if obstacles is None else obstacles.cloud)
    trajectories = [body.trajectory for body in filmed.bodies.values()]
    extent = Filmed(
        np.concatenate([path_of(t) for t in trajectories]), max(t.height for t in trajectories), filmed.is_flat
    )
    deform = deformer.deform
    if shadow:
        on_obstacles = None
        if obstacles is not None:
            count, blur = deformer.rest.count - obstacles.cloud.count, shadow_blur_radius(deformer.rest)
            on_obstacles = ObstacleShadows(obstacles, count, blur_radius=blur, height=extent.height)
        deform = partial(_deform_with_shadows, deformer, filmed.shadows(deformer.rest.device), on_obstacles)
    poses = map(filmed.poses, frames)
    yield from rendered_frames(deform, deformer.rest, poses, extent, cameras, shot, scene=filmed.scene, shadow=shadow)


def filmed_device(filmed: FilmedWorld) -> str:
    """Return the device of the Gaussians."""
    return str(next(iter(filmed.bodies.values())).deformer.rest.device)


def _deform_with_shadows(
    deformer: JointDeformer,
    on_bodies: BodyShadows,
    on_obstacles: ObstacleShadows | None,
    poses: Sequence[np.ndarray],
) -> DeformedGaussians:
    """Deform all bodies and draw their shadows on each other and on the obstacles."""
    deformed = deformer.deform(poses)
    if on_obstacles is not None:
        on_obstacles.draw(deformed.cloud)
    on_bodies.draw(deformed.cloud, poses)
    return deformed


def _obstacles(solids: Sequence[Solid], points: np.ndarray, device: str) -> Obstacles | None:
    """Return the obstacles near the ``points`` (n, 3) of the bodies; None if there are none to draw."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _OBSTACLE_MARGIN * float((high - low).max())
    return make_obstacles(solids, low - margin, high + margin, device=device)


def _clearest_view(run: WorldRun) -> np.ndarray:
    """Return the direction (3,) to the camera in which the bodies appear most separate and the creatures face the
    camera."""
    simulations = [result.simulation for result in run.results]
    paths = np.stack([path_of(each.trajectory)[each.frames][:, :2] for each in simulations])
    radii = [0.5 * float(np.ptp(each.trajectory.positions[0][:, :2], axis=0).max()) for each in simulations]
    faces = [result.body.front.direction[:2] for result in run.results if isinstance(result.body, Creature)]
    first, second = np.triu_indices(len(simulations), 1)
    between, reach = paths[first] - paths[second], np.array(radii)[first] + np.array(radii)[second]
    angles = 2.0 * np.pi * (np.arange(_VIEWS) + 0.5) / _VIEWS
    surroundings = run.world.surroundings
    if surroundings is not None and surroundings.views is not None:
        # A capture looks best from the directions in which it was photographed.
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
