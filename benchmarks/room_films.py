"""From photos or a capture to a film, each stage timed: what a user does, with three clicks at most.

``rooms.py --films FOLDER`` runs all of them, ``rooms.py --films FOLDER --one koala`` a single scene, in this process.
Clicks are those of ``clicking.py`` where outlines were drawn, else the ones below. Into a folder of its own go the
film, its contact sheet ``sheet.png`` of twelve frames, the pictures that ``egs-warp animate`` leaves of each step, the
capture that was trained, and ``row.json``.
"""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from annotated_scenes import DrawnScene, read_drawn
from clicking import clicked
from egs_warp.commands.object_flag import read_object
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.inpainting.picture import before_and_after
from egs_warp.io import read_cameras, read_capture
from egs_warp.io.ply import write_ply
from egs_warp.io.run_folder import RunFolder, run_folder
from egs_warp.io.video import write_png
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.facing_direction import mean_view
from egs_warp.pipelines.film import draw_film
from egs_warp.pipelines.ground_coverage import ground_coverage_warning
from egs_warp.pipelines.pictures import picture_cameras, plane_picture, segmentation_picture
from egs_warp.pipelines.prepare_scene import PreparedScene, prepare_scene, viewing_directions
from egs_warp.pipelines.report import GaussianCounts, report_of_run
from egs_warp.pipelines.segmentation_warnings import segmentation_warnings
from egs_warp.pipelines.simulated_run import simulate
from egs_warp.pipelines.train_capture import train
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.training.finetune import TrainingView
from egs_warp.training.photo_colours import photographs_in_colours_of
from harness import Row, data_folder, timed

CLICKS = 3
STAGES = ("load", "train", "plane", "object", "hole", "body", "animate", "film")


@dataclass(frozen=True)
class Filmed:
    """A scene, and what its object is to do."""

    motion: str
    photos: str | None = None
    """Folder of posed photos below ``posed``, where nothing was drawn."""
    clicks: tuple[str, ...] = ()
    """As ``--object`` takes them, where nothing was drawn."""


FILMS: Mapping[str, Filmed] = {
    "bonsai": Filmed("walk 0.3"),
    "mouse": Filmed("jump", "mouse", ("+268,358@59F01D40A7083FB991B8FBE5285F0C94.jpg",)),
    "plush_dog": Filmed("jump", "plush_dog", ("+403,309@IMG_3496.jpg",)),
    "koala": Filmed("jump"),
    "fox": Filmed("jump distance=0.2"),
    "narcissus": Filmed("twist 90"),
    "playbot": Filmed("jump"),
}


def is_here(name: str) -> bool:
    """Whether the data of a scene are."""
    photos = FILMS[name].photos
    return (data_folder() / "posed" / photos).exists() if photos else read_drawn(name).is_here


def film(
    name: str, out: Path, *, device: str, nodes: int, frames: int | None = None, trained: Path | None = None
) -> Row:
    """The whole way of one scene into the folder ``out``; seconds of each stage, and how it ended."""
    asked = FILMS[name]
    seconds: dict[str, float] = {}
    drawn = None if asked.photos else read_drawn(name)
    photos = data_folder() / "posed" / asked.photos if asked.photos else drawn.photos if drawn else None
    with run_folder(out, overwrite=True) as run:
        cloud = _capture(drawn, photos, seconds, device, trained)
        if photos is not None and trained is None:
            write_ply(run.file("capture.ply"), cloud)
        posed, seconds["load"] = timed(read_cameras, photos) if photos else ([], seconds["load"])
        cameras = [one.camera for one in posed]
        spec = (
            clicked(drawn, cloud, cameras, CLICKS)[0] if drawn is not None else read_object(asked.clicks, cloud, posed)
        )
        photographs = photographs_in_colours_of(cloud, posed) or None
        scene = _taken_apart(cloud, spec, cameras, photographs, seconds)
        said = _pictures(run, cloud, scene, cameras)
        creature, seconds["body"] = timed(
            make_creature,
            scene.object,
            plane=scene.plane,
            options=CreatureOptions(
                ground=scene.ground, seen_from=mean_view(cameras, scene.located.centre), nodes=nodes
            ),
        )
        performance, seconds["animate"] = timed(simulate, creature, motion(asked.motion), frames=frames)
        made, seconds["film"] = timed(
            draw_film,
            performance,
            run,
            name="film",
            size=512,
            background=scene.background,
            view_from=viewing_directions(scene, cameras),
            quiet=True,
        )
        simulation = performance.simulation
        behind = creature.placed(scene.background)
        left = ground_coverage_warning(
            simulation.trajectory.positions[-1], behind, creature.solids[0], creature.body.height
        )
        report = report_of_run(
            *(creature, simulation.trajectory, simulation.reports, simulation.frames),
            *(performance.sequence.done, energy_balance(performance.trajectory)),
            gaussians=GaussianCounts.of(creature, made.splats.count),
            drawing=made.milliseconds,
            source=name,
            notes=(*scene.notes, *performance.unfinished_note(), *left),
            seed=0,
            asked={},
            ending=performance.ending,
        )
        report.write(run.file("report.json"))
        row: Row = {
            "scene": name,
            "how": "film",
            "gaussians": cloud.count,
            "object": scene.object.count,
            "nodes": len(creature.cage.mesh.nodes),
            "frames": len(simulation.frames),
            "seconds": {stage: 1e-3 * seconds[stage] for stage in STAGES if stage in seconds},
            "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
            "ended": report.state.value,
            "said": [*said, *left],
            "notes": list(scene.notes),
        }
        run.file("row.json").write_text(json.dumps(row, indent=1) + "\n")
        run.finish()
    return row


def _capture(
    drawn: DrawnScene | None, photos: Path | None, seconds: dict[str, float], device: str, trained: Path | None
) -> GaussianCloud:
    """Read, or trained from photos as ``egs-warp train`` does on this device."""
    place = trained or (drawn.capture if drawn is not None else None)
    if place is not None:
        read, seconds["load"] = timed(read_capture, place, device=device)
        return read.cloud
    assert photos is not None
    seconds["load"] = 0.0
    small = device == "cpu"
    result, seconds["train"] = timed(
        train,
        photos,
        iterations=2500 if small else 7000,
        max_gaussians=40_000 if small else 200_000,
        max_side=360 if small else 1600,
        device=device,
    )
    return result.cloud


_STAGE_OF = {"plane": "plane", "ground": "plane", "segment": "object", "inpaint": "hole"}
"""Of the stages that ``prepare_scene`` tells: which of ours each belongs to."""


def _taken_apart(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    cameras: Sequence[Camera],
    photographs: list[TrainingView] | None,
    seconds: dict[str, float],
) -> PreparedScene:
    """By ``prepare_scene``; milliseconds of its stages into ``seconds``."""
    began: dict[str, float] = {}

    def note(stage: str, done: float) -> None:
        began.setdefault(stage, time.perf_counter())

    scene = prepare_scene(cloud, spec, cameras=cameras, photographs=photographs, progress=note)
    ends = [*list(began.values())[1:], time.perf_counter()]
    for (stage, start), end in zip(began.items(), ends, strict=True):
        seconds[_STAGE_OF[stage]] = seconds.get(_STAGE_OF[stage], 0.0) + 1e3 * (end - start)
    return scene


def _pictures(run: RunFolder, cloud: GaussianCloud, scene: PreparedScene, cameras: Sequence[Camera]) -> list[str]:
    """Written as ``egs-warp animate`` does; returns what looks wrong, in words."""
    centre, size = scene.located.centre, scene.located.size
    eyes = picture_cameras(scene.plane, centre, size, cameras)
    words = segmentation_warnings(cloud, scene.located, scene.object, eyes)
    write_png(run.file("plane.png"), plane_picture(cloud, [scene.plane], eyes, centre=centre, size=size))
    write_png(
        run.file("segment.png"), segmentation_picture(cloud, scene.object, scene.background_with_hole, eyes, words)
    )
    if scene.filled is not None:
        write_png(run.file("filled.png"), before_and_after(scene.filled))
    scene.write(run)
    return words
