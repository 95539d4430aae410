"""Rendering of a finished simulation: each frame shows the capture, deformed by its cage, over its background."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import TypeVar

import numpy as np
import warp as wp

from egs_warp.deformation.deformer import DeformedGaussians, Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.deformation.splitting import split_for_motion
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.camera import FILMED_FROM, Camera
from egs_warp.geometry.camera_ring import ring_camera
from egs_warp.geometry.frames import Direction, direction_of
from egs_warp.geometry.gaussians import GaussianCloud, cut_at, hidden_below, most_visible
from egs_warp.geometry.main_light import MainLight
from egs_warp.io.run_folder import RunFolder
from egs_warp.lighting.relighting import Relighter
from egs_warp.lighting.remaining_shadow import without_shadow
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.film_file import Frame, encode_film, sheet_frames
from egs_warp.pipelines.shot import Shot, framed, nearest_steps, reframed, resized
from egs_warp.pipelines.simulated_run import FIELD_OF_VIEW, BodyResult, SimulatedRun
from egs_warp.render.backdrop import Backdrop, captured_scene, plain_colour, studio_floor
from egs_warp.render.compositing import RenderedImage
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.render.shadow import SHADOW_REACH, ContactShadow, shadow_blur_radius
from egs_warp.short_repr import short_repr

Pose = TypeVar("Pose")
SPLIT_KEY_FRAMES = 24
"""Number of frames whose deformation determines which Gaussians are split."""
_SHADOW_MARGIN = 0.7
"""Width of the soft edge of the shadow straight below a body, in body heights: four standard deviations of the blur of
the highest layer (``egs_warp/render/shadow.py``), plus a texel."""
_BELOW_GROUND = 0.005
"""Depth below flat ground, in body heights, below which the Gaussians of a capture without a scene are hidden."""


@dataclass(frozen=True)
class Film:
    """A rendered film: its file, Gaussians and camera, and the times that it took."""

    __repr__ = short_repr

    file: str
    """Name of the video in the folder of the run."""
    deformer: Deformer
    """Deformer of all Gaussians after splitting, even if only a subset of them was drawn."""
    drawn: int
    """Number of Gaussians that were drawn."""
    camera: Camera
    """Fixed camera of the film; a moving camera is derived from it."""
    milliseconds: dict[str, list[float]]
    """Time of each frame by stage, ms. The time for splitting Gaussians is distributed over all frames."""

    @property
    def splats(self) -> GaussianCloud:
        """Gaussians at rest, after splitting."""
        return self.deformer.rest


@dataclass(frozen=True)
class FilmSetup:
    """Gaussians, cameras and surroundings of a film, before its first frame is drawn."""

    deformer: Deformer
    """Deformer of all Gaussians after splitting."""
    drawn: Deformer
    """Deformer of the Gaussians that are drawn."""
    trajectory: Trajectory
    steps: np.ndarray
    """(n,) index of the state of each frame."""
    camera: Camera
    """Fixed camera; those of a moving camera are derived from it."""
    shot: Shot
    scene: GaussianCloud | None
    """Gaussians behind the creature, in the frame of the body; None for a plain floor."""
    shadow: bool
    light: MainLight | None
    """Main light, in the axes of the body."""
    splitting: float
    """Time for splitting Gaussians, ms."""

    @cached_property
    def cameras(self) -> Sequence[Camera]:
        """Camera of each frame."""
        return self.shot.cameras(self.camera, self.trajectory, self.steps, in_scene=self.scene is not None)

    def frames(self) -> Iterator[Frame]:
        """Render the frames one by one."""
        return drawn_frames(
            self.drawn,
            self.trajectory,
            self.steps,
            self.cameras,
            self.shot,
            scene=self.scene,
            shadow=self.shadow,
            light=self.light,
        )


def render_frames(
    run: SimulatedRun,
    size: int = 512,
    *,
    background: GaussianCloud | None = None,
    light: MainLight | None = None,
    shot: Shot | None = None,
    view_from: Direction | None = None,
    shadow: bool = True,
) -> Iterator[np.ndarray]:
    """Render the frames of a simulated run one by one, with the look of a film that ``animate`` writes.

    Args:
        run: The simulated run.
        size: Width and height of a frame, pixels, if ``shot`` has no size.
        background: Gaussians behind the object, in the capture's frame and units; None draws a plain floor.
        light: Main light in the axes of the capture, which relights the creature and casts its shadow; None keeps the
            captured colours and draws the shadow straight below the creature.
        shot: Camera, size, frame rate and background colour; None uses the default.
        view_from: (3,) Direction from the object to the camera, in the capture's frame, or an axis.
        shadow: True to draw a shadow on the ground.

    Returns:
        Iterator of frames (H, W, 3) uint8, or (H, W, 4) with straight alpha if ``shot`` is transparent.

    Raises:
        UserError: An argument is invalid.
    """
    shot = shot or Shot()
    shot = shot if shot.size is not None else replace(shot, size=(size, size))
    shot.check()
    direction = None if view_from is None else direction_of(view_from, "view_from")
    setup = film_setup(
        run, size=size, shot=shot, background=background, view_from=direction, shadow=shadow, light=light
    )
    return (frame.picture() for frame in setup.frames())


def film_setup(
    performance: SimulatedRun,
    *,
    size: int,
    shot: Shot | None = None,
    background: GaussianCloud | None = None,
    view_from: np.ndarray | None = None,
    shadow: bool = True,
    light: MainLight | None = None,
    max_gaussians: int | None = None,
) -> FilmSetup:
    """Prepare the film of a simulated run.

    Args:
        performance: The simulated run.
        size: Width and height of the video, pixels, if ``shot`` has no size.
        shot: Camera, size, frame rate and background colour.
        background: Gaussians behind the object, in the capture's frame and units; None draws a plain floor.
        view_from: Direction (3,) from the object to the camera, in the capture's frame; the best is chosen from several
            directions (n, 3).
        shadow: True to draw a shadow on the ground.
        light: Main light in the axes of the capture, which relights the creature and casts its shadow; None keeps the
            captured colours and draws the shadow straight below the creature.
        max_gaussians: Maximum number of Gaussians of the creature, of which only the most visible are drawn; None draws
            all.
    """
    creature, simulation = performance.creature, performance.simulation
    trajectory, shot = simulation.trajectory, shot or Shot()
    steps = simulation.frames if shot.fps == FRAME_RATE else nearest_steps(trajectory.time, shot.fps)
    placed_light = None if light is None else light.rotated(creature.frame.axes)
    scene = creature.placed(background) if background is not None else None
    if scene is not None and placed_light is not None and shadow:
        scene = without_shadow(scene, creature.cloud, creature.geometry.field or GROUND, placed_light)
    camera = performance.camera(size, view_from, scene=scene)
    camera = reframed(camera, *(shot.size or (size, size)), trajectory.positions)
    # Because the whole motion is known, Gaussians are split before the first frame, so that no frame shows a sudden
    # change.
    started = perf_counter()
    deformer = drawn = split_deformer(performance, in_scene=scene is not None)
    if max_gaussians is not None and deformer.rest.count > max_gaussians:
        visible = most_visible(deformer.rest, max_gaussians)
        drawn = Deformer(visible, embed_gaussians(visible, creature.cage.mesh))
    splitting = 1e3 * (perf_counter() - started)
    return FilmSetup(deformer, drawn, trajectory, steps, camera, shot, scene, shadow, placed_light, splitting)


def draw_film(setup: FilmSetup, run: RunFolder, *, name: str, quiet: bool = False) -> Film:
    """Render a film and write its video and ``sheet.png`` into the folder of ``run``.

    Args:
        setup: The prepared film (``film_setup``).
        run: Folder for the files.
        name: Name of the video: ``name``.mp4, or ``name``.mov if the shot is transparent.
        quiet: True to show no progress bar.
    """
    first, time = setup.cameras[0], setup.trajectory.time[setup.steps]
    shown = sheet_frames(setup.trajectory.positions, setup.steps)
    path, milliseconds = encode_film(setup.frames(), run, name, first, setup.shot, time, shown, quiet=quiet)
    milliseconds["split"] = [setup.splitting / len(setup.steps)]
    return Film(path.name, setup.deformer, setup.drawn.rest.count, setup.camera, milliseconds)


def split_deformer(performance: BodyResult, *, in_scene: bool = False) -> Deformer:
    """Return the deformer of the Gaussians of a body. Its Gaussians are split for the motion, except those of props,
    which move affinely.

    Args:
        performance: The simulated body.
        in_scene: True if a captured scene is drawn around the body.
    """
    body, simulation = performance.body, performance.simulation
    trajectory, cloud, mesh = simulation.trajectory, body.cloud, body.mesh
    hides_ground = not in_scene and trajectory.ground_coefficients.size == 0
    if hides_ground:
        cloud = above_ground(cloud, trajectory.height)
    if len(mesh.tets) == 1:
        return Deformer(cloud, embed_gaussians(cloud, mesh))
    keys = simulation.frames[:: max(1, len(simulation.frames) // SPLIT_KEY_FRAMES)]
    embedding = embed_gaussians(cloud, mesh)
    split = split_for_motion(cloud, embedding, [trajectory.positions[step] for step in keys])
    parts = below_ground_hidden(split.cloud, trajectory.height) if hides_ground else split.cloud
    return Deformer(parts, split.embedding)


def above_ground(cloud: GaussianCloud, height: float) -> GaussianCloud:
    """Return ``cloud`` without the haze of the captured ground, and cut at the ground: what is below the ground would
    otherwise be visible under a jumping creature. ``height`` is the height of the creature, m."""
    return cut_at(below_ground_hidden(cloud, height), GROUND)


def below_ground_hidden(cloud: GaussianCloud, height: float) -> GaussianCloud:
    """Return ``cloud`` with the Gaussians below the ground made transparent, because parts of split Gaussians may be
    below it. ``height`` is the height of the creature, m."""
    return hidden_below(cloud, GROUND, margin=_BELOW_GROUND * height)


def drawn_frames(
    deformer: Deformer,
    trajectory: Trajectory,
    steps: np.ndarray,
    cameras: Sequence[Camera],
    shot: Shot,
    *,
    scene: GaussianCloud | None = None,
    shadow: bool = True,
    light: MainLight | None = None,
) -> Iterator[Frame]:
    """Render one frame for each of the ``steps``. The backdrop is reused while the camera stays the same.

    Args:
        deformer: Deformer of the Gaussians.
        trajectory: Trajectory with the node positions.
        steps: (n,) indices of the states to render.
        cameras: n cameras.
        shot: Background colour and transparency.
        scene: Gaussians behind the creature, in the frame of the body.
        shadow: True to draw a shadow on the ground.
        light: Main light, in the axes of the body; None as for ``film_setup``.
    """
    # The shape of uneven ground is not drawn, and its plane must not hide a creature in a hollow.
    is_flat = trajectory.ground_coefficients.size == 0
    path = path_of(trajectory)
    centres = path[steps]
    # Use one state at a time, because a copy of all states of a long run can exceed the memory.
    radius = max(
        float(np.linalg.norm((trajectory.positions[step] - centre)[:, :2], axis=1).max())
        for step, centre in zip(steps, centres, strict=True)
    )
    filmed = Filmed(path, trajectory.height, is_flat, centres, radius + _SHADOW_MARGIN * trajectory.height)
    poses = (trajectory.positions[step] for step in steps)
    return rendered_frames(
        deformer.deform, deformer.rest, poses, filmed, cameras, shot, scene=scene, shadow=shadow, light=light
    )


@dataclass(frozen=True)
class Filmed:
    """Extent of a filmed motion, which defines the extent of the drawn ground and shadow."""

    path: np.ndarray
    """(n, 3) m, centres of mass of all bodies at all times."""
    height: float
    """Height of the highest body, m."""
    is_flat: bool = True
    """True if the ground is flat and hides what is below it."""
    centres: np.ndarray | None = None
    """(n, 3) m, centre of mass of the body in each frame; None for several bodies."""
    body_reach: float | None = None
    """Radius of a disc around each of the ``centres`` that contains the shadow straight below the body, m; None for
    several bodies."""


def path_of(trajectory: Trajectory) -> np.ndarray:
    """Return the path (F + 1, 3) m of the centre of mass."""
    return np.einsum("n,fni->fi", trajectory.node_mass, trajectory.positions) / trajectory.node_mass.sum()


def rendered_frames(
    deform: Callable[[Pose], DeformedGaussians],
    rest: GaussianCloud,
    poses: Iterable[Pose],
    filmed: Filmed,
    cameras: Sequence[Camera],
    shot: Shot,
    *,
    scene: GaussianCloud | None = None,
    shadow: bool = True,
    light: MainLight | None = None,
) -> Iterator[Frame]:
    """Render one frame for each pose.

    Args:
        deform: Function that deforms the Gaussians ``rest`` to a pose.
        rest: Gaussians at rest.
        poses: Pose of each frame.
        filmed: Extent of the motion.
        cameras: Camera of each frame.
        shot, scene, shadow, light: As for ``drawn_frames``.
    """
    grain, device = shadow_blur_radius(rest), rest.device
    relighter = None if light is None else Relighter(rest, light)
    setting: Backdrop | None = None
    for index, (pose, camera) in enumerate(zip(poses, cameras, strict=True)):
        marks = [perf_counter()]
        deformed = deform(pose)
        cloud = deformed.cloud if relighter is None else relighter.relight(deformed.cloud, deformed.rotations)
        marks.append(perf_counter())
        if setting is None or camera is not cameras[index - 1]:
            setting = _backdrop_of(filmed, camera, scene, shot, grain=grain, shadow=shadow, light=light, device=device)
        centre = None if filmed.centres is None else filmed.centres[index]
        image, shade = _rendered(cloud, setting, centre, transparent=shot.transparent, has_floor=filmed.is_flat)
        marks.append(perf_counter())
        deforming, rendering = (1e3 * np.diff(marks)).tolist()
        yield Frame(image, shade, (deforming, rendering))


def _rendered(
    cloud: GaussianCloud, setting: Backdrop, centre: np.ndarray | None, *, transparent: bool, has_floor: bool
) -> tuple[RenderedImage, wp.array | None]:
    """Return the image of ``cloud`` over its backdrop, and the opacity of its shadow if the shot is transparent."""
    shade = setting.shadow_opacity(cloud, centre) if transparent else None
    backdrop = setting.background(cloud, centre) if shade is None else (0.0, 0.0, 0.0)
    depth = setting.floor_depth if has_floor else None
    image = render_gaussians(cloud, setting.shadow.camera, background=backdrop, max_depth=depth)
    wp.synchronize_device(cloud.device)
    return image, shade


def picture_seconds(creature: Creature, *, size: tuple[int, int], shadow: bool = True) -> float:
    """Measure the time for drawing the creature at rest on a plain floor, s.

    Args:
        creature: The creature.
        size: Width and height of the picture, pixels.
        shadow: True to draw a shadow on the ground.
    """
    positions, height = creature.start.positions, creature.body.height
    middle = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    camera = ring_camera(
        np.array(FILMED_FROM), middle, height, GROUND.normal, size=size[0], vertical_fov_degrees=FIELD_OF_VIEW
    )
    camera = framed(resized(camera, *size), positions)
    deformer = Deformer(creature.cloud, embed_gaussians(creature.cloud, creature.cage.mesh))
    grain, filmed = shadow_blur_radius(creature.cloud), Filmed(creature.body.centre_of_mass(positions)[None], height)
    setting = _backdrop_of(
        filmed, camera, None, Shot(), grain=grain, shadow=shadow, light=None, device=creature.cloud.device
    )
    spent = []
    # Discard the first picture, because it may compile kernels.
    for _ in range(2):
        started = perf_counter()
        image, shade = _rendered(deformer.deform(positions).cloud, setting, None, transparent=False, has_floor=True)
        Frame(image, shade, (0.0, 0.0)).picture()
        spent.append(perf_counter() - started)
    return spent[-1]


def _backdrop_of(
    filmed: Filmed,
    camera: Camera,
    scene: GaussianCloud | None,
    shot: Shot,
    *,
    grain: float,
    shadow: bool,
    light: MainLight | None,
    device: wp.Device,
) -> Backdrop:
    """Return the backdrop of a shot.

    Args:
        filmed: Extent of the motion.
        camera: Camera of the frame.
        scene: Gaussians behind the creature, in the frame of the body.
        shot: Background colour and transparency.
        grain: Blur radius that hides single Gaussians in the shadow, m.
        shadow: True to draw a shadow on the ground.
        light: Main light, in the axes of the body; None for a shadow straight down.
        device: Warp device.
    """
    path, height = filmed.path, filmed.height
    com = path.mean(axis=0)
    centre = com * [1.0, 1.0, 0.0]
    reach = SHADOW_REACH * (height + float(np.linalg.norm(np.ptp(path, axis=0))))
    is_plain = shot.transparent or shot.colour is not None
    if scene is not None and not is_plain:
        return captured_scene(
            *(scene, camera, GROUND),
            centre=centre,
            reach=reach,
            blur_radius=grain,
            height=height,
            body_reach=filmed.body_reach,
            light=light,
            shadow=shadow,
        )
    ground = ContactShadow(
        camera,
        GROUND,
        centre=centre,
        reach=reach,
        device=device,
        blur_radius=grain,
        height=height,
        body_reach=filmed.body_reach,
        light=light,
    )
    if is_plain:
        return plain_colour(ground, shot.colour or (0.0, 0.0, 0.0), shadow=shadow)
    return studio_floor(ground, cell=0.25 * height, shadow=shadow)
