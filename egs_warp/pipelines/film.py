"""A finished simulation, drawn: the capture carried by its cage, frame after frame, over what is behind it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp
from tqdm import tqdm

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.deformation.splitting import split_for_motion
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.run_folder import RunFolder
from egs_warp.io.video import VideoWriter, contact_sheet, write_png
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.shot import Shot, nearest_steps, resized
from egs_warp.pipelines.simulated_run import SimulatedRun
from egs_warp.render.backdrop import Backdrop, captured_scene, grid_floor, plain_colour
from egs_warp.render.compositing import RenderedImage
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.render.shadow import ContactShadow, shadow_blur_radius

SHEET_FRAMES = 12
SPLIT_KEY_FRAMES = 24


@dataclass(frozen=True)
class Film:
    """What was drawn, and what it cost."""

    splats: GaussianCloud
    """What was drawn, at rest, splits among them."""
    camera: Camera
    """As it stands where it does not move."""
    milliseconds: dict[str, list[float]]
    """Of each frame, by stage; the splits, made once, are shared out among the frames."""


@dataclass(frozen=True)
class Frame:
    """One picture of a film."""

    image: RenderedImage
    """Over what is behind it; over black where the shot is transparent."""
    shade: wp.array | None
    """(H, W) float32: how much the shadow hides of what will be behind it, where the shot is transparent."""
    milliseconds: tuple[float, float]
    """To deform and to render."""

    def picture(self) -> np.ndarray:
        """(H, W, 3) uint8; of a transparent shot (H, W, 4), colours not multiplied by alpha."""
        if self.shade is None:
            return self.image.colour_srgb8()
        alpha = self.image.alpha.numpy()
        whole = alpha + (1.0 - alpha) * self.shade.numpy()
        straight = self.image.colour.numpy() / np.maximum(whole, 1e-6)[..., None]
        return np.rint(255.0 * np.clip(np.dstack([straight, whole]), 0.0, 1.0)).astype(np.uint8)


def draw_film(
    performance: SimulatedRun,
    run: RunFolder,
    *,
    name: str,
    size: int,
    shot: Shot | None = None,
    background: GaussianCloud | None = None,
    view_from: np.ndarray | None = None,
    shadow: bool = True,
    quiet: bool = False,
) -> Film:
    """Write ``name``.mp4 and sheet.png, ``size`` pixels both ways, into the folder of ``run``; a transparent ``shot``
    is ``name``.mov.

    ``background`` (scene units) is drawn behind the object instead of the plain floor; ``view_from`` (3,) points from
    the object to the camera, both in the capture's frame; of several (n, 3) the best is chosen.
    """
    creature, simulation = performance.creature, performance.simulation
    trajectory, shot = simulation.trajectory, shot or Shot()
    steps = simulation.frames if shot.fps == FRAME_RATE else nearest_steps(trajectory.time, shot.fps)
    scene = creature.placed(background) if background is not None else None
    camera = resized(performance.camera(size, view_from, scene=scene), *(shot.size or (size, size)))
    cameras = shot.cameras(camera, trajectory, steps)
    # The whole motion is known, so what it will bend is split before the first frame, and nothing can pop.
    started = time.perf_counter()
    keys = simulation.frames[:: max(1, len(simulation.frames) // SPLIT_KEY_FRAMES)]
    embedding = embed_gaussians(creature.cloud, creature.cage.mesh)
    split = split_for_motion(creature.cloud, embedding, [trajectory.positions[step] for step in keys])
    splitting = 1e3 * (time.perf_counter() - started)
    frames = drawn_frames(
        Deformer(split.cloud, split.embedding),
        trajectory,
        steps,
        cameras,
        shot,
        scene=scene,
        shadow=shadow,
    )
    milliseconds: dict[str, list[float]] = {"deform": [], "render": [], "encode": []}
    kept: list[np.ndarray] = []
    wanted = np.unique(np.linspace(0, len(steps) - 1, SHEET_FRAMES).round().astype(int))
    path = run.file(f"{name}.{'mov' if shot.transparent else 'mp4'}")
    with (
        _writer(path, cameras[0], shot) as video,
        tqdm(total=len(steps), desc="render", unit="frame", disable=quiet) as bar,
    ):
        for index, frame in enumerate(frames):
            started = time.perf_counter()
            image = frame.picture()
            video.write(image)
            if index in wanted:
                kept.append(_over_white(image))
            encoding = 1e3 * (time.perf_counter() - started)
            for stage, spent in zip(milliseconds, (*frame.milliseconds, encoding), strict=True):
                milliseconds[stage].append(spent)
            bar.update()
    labels = [f"{trajectory.time[steps[i]]:.2f} s" for i in wanted]
    write_png(run.file("sheet.png"), contact_sheet(kept, 4, labels))
    milliseconds["split"] = [splitting / len(steps)]
    return Film(split.cloud, camera, milliseconds)


def drawn_frames(
    deformer: Deformer,
    trajectory: Trajectory,
    steps: np.ndarray,
    cameras: Sequence[Camera],
    shot: Shot,
    *,
    scene: GaussianCloud | None = None,
    shadow: bool = True,
) -> Iterator[Frame]:
    """A picture for each of ``steps`` (n,) of the trajectory through each of the n ``cameras``; what does not change
    from one to the next is made once. ``scene`` lies in the body's frame.
    """
    path = np.einsum("n,fni->fi", trajectory.node_mass, trajectory.positions) / trajectory.node_mass.sum()
    grain, device = shadow_blur_radius(deformer.rest), deformer.rest.device
    behind: Backdrop | None = None
    for index, (step, camera) in enumerate(zip(steps, cameras, strict=True)):
        marks = [time.perf_counter()]
        deformed = deformer.deform(trajectory.positions[step])
        marks.append(time.perf_counter())
        cloud = deformed.cloud
        if behind is None or camera is not cameras[index - 1]:
            behind = _behind(path, trajectory.height, camera, scene, shot, grain=grain, shadow=shadow, device=device)
        shade = behind.shadow_opacity(cloud) if shot.transparent else None
        backdrop = behind.background(cloud) if shade is None else (0.0, 0.0, 0.0)
        image = render_gaussians(cloud, camera, background=backdrop)
        wp.synchronize_device(cloud.device)
        marks.append(time.perf_counter())
        deforming, rendering = (1e3 * np.diff(marks)).tolist()
        yield Frame(image, shade, (deforming, rendering))


def _writer(path: Path, camera: Camera, shot: Shot) -> VideoWriter:
    return VideoWriter(path, camera.width, camera.height, frames_per_second=shot.fps, alpha=shot.transparent)


def _over_white(image: np.ndarray) -> np.ndarray:
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:] / 255.0
    return np.rint(alpha * image[..., :3] + 255.0 * (1.0 - alpha)).astype(np.uint8)


def _behind(
    path: np.ndarray,
    height: float,
    camera: Camera,
    scene: GaussianCloud | None,
    shot: Shot,
    *,
    grain: float,
    shadow: bool,
    device: wp.Device,
) -> Backdrop:
    """``path`` (F+1, 3) is that of the centre of mass of a body ``height`` tall."""
    com = path.mean(axis=0)
    centre = com * [1.0, 1.0, 0.0]
    reach = 2.2 * (height + float(np.linalg.norm(np.ptp(path, axis=0))))
    plain = shot.transparent or shot.colour is not None
    if scene is not None and not plain:
        return captured_scene(
            scene, camera, GROUND, centre=centre, reach=reach, grain=grain, height=height, shadow=shadow
        )
    ground = ContactShadow(camera, GROUND, centre=centre, reach=reach, device=device, grain=grain, height=height)
    if plain:
        return plain_colour(ground, shot.colour or (0.0, 0.0, 0.0), shadow=shadow)
    return grid_floor(ground, cell=0.25 * height, shadow=shadow)
