"""Films made from photos or a capture with at most three clicks, as a user would; each stage is timed.

``scene_quality.py --films FOLDER`` makes all of them; ``scene_quality.py --films FOLDER --one koala`` makes the film of
a single scene in this process. Annotated scenes use the clicks of ``clicking.py``, other scenes the clicks below. The
folder of a scene receives the film, its contact sheet ``sheet.png`` of twelve frames, the images that ``egs-warp
animate`` writes for each stage, the trained capture, and ``row.json``.
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
from egs_warp.pipelines.film import draw_film, film_setup
from egs_warp.pipelines.ground_coverage import ground_coverage_warning
from egs_warp.pipelines.object_selection import read_object
from egs_warp.pipelines.pictures import picture_cameras, plane_picture, segmentation_picture
from egs_warp.pipelines.prepare_scene import PreparedScene, prepare_scene, viewing_directions
from egs_warp.pipelines.report import GaussianCounts, report_of_run
from egs_warp.pipelines.segmentation_warnings import segmentation_warnings
from egs_warp.pipelines.simulated_run import simulate
from egs_warp.pipelines.train_capture import train
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.training.photo_colours import photographs_in_colours_of
from egs_warp.training.training_view import TrainingView
from harness import Row, data_folder, timed

CLICKS = 3
STAGES = ("load", "train", "plane", "object", "hole", "body", "animate", "film")


@dataclass(frozen=True)
class Filmed:
    """A scene and the motion of its object."""

    motion: str
    photos: str | None = None
    """Folder of posed photos inside ``posed``, for scenes without annotations."""
    clicks: tuple[str, ...] = ()
    """Clicks in the notation of ``--object``, for scenes without annotations."""


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
    """Return True if the data of the scene ``name`` are available on this machine."""
    photos = FILMS[name].photos
    return (data_folder() / "posed" / photos).exists() if photos else read_drawn(name).is_here


def film(
    name: str, out: Path, *, device: str, nodes: int, frames: int | None = None, trained: Path | None = None
) -> Row:
    """Make the film of one scene in the folder ``out``; return the seconds of each stage and the outcome."""
    filmed = FILMS[name]
    seconds: dict[str, float] = {}
    annotated = None if filmed.photos else read_drawn(name)
    photos = data_folder() / "posed" / filmed.photos if filmed.photos else annotated.photos if annotated else None
    with run_folder(out, overwrite=True) as run:
        cloud = _capture(annotated, photos, seconds, device, trained)
        if photos is not None and trained is None:
            write_ply(run.file("capture.ply"), cloud)
        posed, seconds["load"] = timed(read_cameras, photos) if photos else ([], seconds["load"])
        cameras = [one.camera for one in posed]
        spec = (
            clicked(annotated, cloud, cameras, CLICKS)[0]
            if annotated is not None
            else read_object(filmed.clicks, cloud, posed)
        )
        photographs = photographs_in_colours_of(cloud, posed) or None
        scene = _prepare(cloud, spec, cameras, photographs, seconds)
        warnings = _pictures(run, cloud, scene, cameras)
        creature, seconds["body"] = timed(
            make_creature,
            scene.object,
            plane=scene.plane,
            options=CreatureOptions(
                ground=scene.ground, seen_from=mean_view(cameras, scene.located.centre), nodes=nodes
            ),
        )
        performance, seconds["animate"] = timed(simulate, creature, motion(filmed.motion), frames=frames)
        started, directions = time.perf_counter(), viewing_directions(scene, cameras)
        setup = film_setup(performance, size=512, background=scene.background, view_from=directions)
        rendered = draw_film(setup, run, name="film", quiet=True)
        seconds["film"] = 1e3 * (time.perf_counter() - started)
        simulation = performance.simulation
        behind = creature.placed(scene.background)
        coverage_warnings = ground_coverage_warning(
            simulation.trajectory.positions[-1],
            behind,
            creature.solids[0],
            creature.body.height,
            start=simulation.trajectory.positions[0],
        )
        report = report_of_run(
            *(creature, simulation.trajectory, simulation.reports, simulation.frames),
            *(performance.sequence.done, energy_balance(performance.trajectory)),
            gaussians=GaussianCounts.of(creature, split=rendered.splats.count),
            drawing=rendered.milliseconds,
            source=name,
            notes=(*scene.notes, *performance.unfinished_note(), *coverage_warnings),
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
            "messages": [*warnings, *coverage_warnings],
            "notes": list(scene.notes),
        }
        run.file("row.json").write_text(json.dumps(row, indent=1) + "\n")
        run.finish()
    return row


def _capture(
    annotated: DrawnScene | None, photos: Path | None, seconds: dict[str, float], device: str, trained: Path | None
) -> GaussianCloud:
    """Read the capture, or train it from photos as ``egs-warp train`` does on this device."""
    place = trained or (annotated.capture if annotated is not None else None)
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
"""Stage of this benchmark for each stage that ``prepare_scene`` reports."""


def _prepare(
    cloud: GaussianCloud,
    spec: ObjectSpec,
    cameras: Sequence[Camera],
    photographs: list[TrainingView] | None,
    seconds: dict[str, float],
) -> PreparedScene:
    """Call ``prepare_scene`` and add the milliseconds of its stages to ``seconds``."""
    began: dict[str, float] = {}

    def note(stage: str, done: float) -> None:
        began.setdefault(stage, time.perf_counter())

    scene = prepare_scene(cloud, spec, cameras=cameras, photographs=photographs, progress=note)
    ends = [*list(began.values())[1:], time.perf_counter()]
    for (stage, start), end in zip(began.items(), ends, strict=True):
        seconds[_STAGE_OF[stage]] = seconds.get(_STAGE_OF[stage], 0.0) + 1e3 * (end - start)
    return scene


def _pictures(run: RunFolder, cloud: GaussianCloud, scene: PreparedScene, cameras: Sequence[Camera]) -> list[str]:
    """Write the images that ``egs-warp animate`` writes; return the warnings about the segmentation."""
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
