"""A finished simulation, drawn: the capture carried by its cage, frame after frame, over what is behind it."""

from __future__ import annotations

import time
from dataclasses import dataclass

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
from egs_warp.locomotion.rollout import Simulation
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.performance import Performance
from egs_warp.render.backdrop import Behind, CapturedScene, Floor
from egs_warp.render.rasteriser import render_gaussians

SHEET_FRAMES = 12
SPLIT_KEY_FRAMES = 24


@dataclass(frozen=True)
class Film:
    """What was drawn, and what it cost."""

    splats: GaussianCloud
    """What was drawn, at rest, splits among them."""
    camera: Camera
    milliseconds: dict[str, list[float]]
    """Of each frame, by stage; the splits, made once, are shared out among the frames."""


def draw_film(
    performance: Performance,
    run: RunFolder,
    *,
    name: str,
    size: int,
    background: GaussianCloud | None = None,
    view_from: np.ndarray | None = None,
    shadow: bool = True,
    quiet: bool = False,
) -> Film:
    """Write ``name``.mp4 and sheet.png, ``size`` pixels both ways, into the folder of ``run``.

    ``background`` (scene units) is drawn behind the object instead of the plain floor; ``view_from`` (3,) points from
    the object to the camera, both in the capture's frame.
    """
    creature, simulation = performance.creature, performance.simulation
    trajectory, frames = simulation.trajectory, simulation.frames
    camera = performance.camera(size, view_from)
    behind = _behind(creature, simulation, camera, background, shadow=shadow)
    # The whole motion is known, so what it will bend is split before the first frame, and nothing can pop.
    started = time.perf_counter()
    keys = frames[:: max(1, len(frames) // SPLIT_KEY_FRAMES)]
    embedding = embed_gaussians(creature.cloud, creature.cage.mesh)
    split = split_for_motion(creature.cloud, embedding, [trajectory.positions[step] for step in keys])
    splitting = 1e3 * (time.perf_counter() - started)
    deformer = Deformer(split.cloud, split.embedding)
    milliseconds: dict[str, list[float]] = {"deform": [], "render": [], "encode": []}
    kept: list[np.ndarray] = []
    wanted = np.unique(np.linspace(0, len(frames) - 1, SHEET_FRAMES).round().astype(int))
    with (
        VideoWriter(run.file(f"{name}.mp4"), size, size) as video,
        tqdm(total=len(frames), desc="render", unit="frame", disable=quiet) as bar,
    ):
        for index, step in enumerate(frames):
            marks = [time.perf_counter()]
            deformed = deformer.deform(trajectory.positions[step])
            marks.append(time.perf_counter())
            backdrop = behind.background(deformed.cloud, height=creature.body.height)
            image = render_gaussians(deformed.cloud, camera, background=backdrop).colour_srgb8()
            wp.synchronize_device(creature.cloud.device)
            marks.append(time.perf_counter())
            video.write(image)
            if index in wanted:
                kept.append(image)
            marks.append(time.perf_counter())
            for stage, spent in zip(milliseconds, np.diff(marks), strict=True):
                milliseconds[stage].append(1e3 * float(spent))
            bar.update()
    labels = [f"{trajectory.time[frames[i]]:.2f} s" for i in wanted]
    write_png(run.file("sheet.png"), contact_sheet(kept, 4, labels))
    milliseconds["split"] = [splitting / len(frames)]
    return Film(split.cloud, camera, milliseconds)


def _behind(
    creature: Creature, simulation: Simulation, camera: Camera, background: GaussianCloud | None, *, shadow: bool
) -> Behind:
    trajectory, height = simulation.trajectory, creature.body.height
    path = np.einsum("n,fni->fi", trajectory.node_mass, trajectory.positions) / trajectory.node_mass.sum()
    com = path.mean(axis=0)
    centre = com * [1.0, 1.0, 0.0]
    reach = 2.2 * (height + float(np.linalg.norm(np.ptp(path, axis=0))))
    if background is None:
        return Floor(camera, GROUND, centre=centre, reach=reach, cell=0.25 * height, shadow=shadow)
    scene = creature.placed(background)
    return CapturedScene(scene, camera, GROUND, centre=centre, reach=reach, shadow=shadow)
