"""``egs-warp animate``: a capture comes to life."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egs_warp.commands.camera_flags import add_camera_flags, shot_of
from egs_warp.commands.config import NAME, add_config_flag, changed_capture, write_config
from egs_warp.commands.flags import (
    Commands,
    add_inpainter_flags,
    add_qp_flag,
    chosen_inpainter,
    guessed_up,
    named_path,
    parse_direction,
    parse_up,
)
from egs_warp.commands.scene_flags import add_flat_flag, add_object_flags, add_overwrite_flag, print_note, start_device
from egs_warp.commands.segment import add_straddling_flag, clearing_of
from egs_warp.errors import UserError

if TYPE_CHECKING:
    from egs_warp.commands.scene_input import SceneInput
    from egs_warp.io.run_folder import RunFolder
    from egs_warp.pipelines.animate import AnimateOptions
    from egs_warp.pipelines.prepare_scene import PreparedScene
    from egs_warp.pipelines.report import Report


FALLEN = 3
"""Exit status of a run that has written its files, but whose body has fallen or could not be simulated on."""
_WRITES = (NAME, "trajectory.npz", "plots.png", "cage.vtu", "sheet.png", "creature.npz", "report.json")
"""Among others, whose names hang on the motion."""
EXAMPLES = (
    "pawn.ply --up z --out out/jump",
    'scan.spz --motion "hop x3, twist 180" --camera follow --size 1280x720 --out out/hop',
    "room.ply --object 0,0,0.5 --up=-y --motion walk --out out/walk",
    "thing.ply --up z --background transparent --out out/cut_out",
    "--config out/jump/run.yaml --friction 0.4 --out out/slippery",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    animate = commands.add_parser("animate", help="bring a capture to life")
    animate.add_argument("capture", help=".ply, compressed .ply, .spz, .splat, .sog, .glb or an unbundled SOG folder")
    animate.add_argument("--out", required=True, type=named_path, help="folder for video, sheet, report and trajectory")
    add_overwrite_flag(animate, "--out")
    add_config_flag(animate)
    animate.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    add_qp_flag(animate)
    animate.add_argument("--seed", type=int, help="recorded in the report; a jump has nothing random (0)")
    motion = animate.add_argument_group("motion")
    motion.add_argument(
        "--motion",
        default="jump",
        help='jump (default), hop, twist, walk, run, dance, get up, several as "hop x3, twist 180", or a script.json',
    )
    motion.add_argument("--no-get-up", action="store_true", help="leave a body that has fallen lying, and end")
    motion.add_argument("--distance", type=float, help="body heights: jump (0.5), hop (0.7), twist (0), walk (0.4)")
    motion.add_argument(
        "--height",
        type=float,
        help="rise of the centre of mass, body heights: of a jump (0.2), hop (0.3) or twist (0.3)",
    )
    motion.add_argument("--heading-degrees", type=float, help="of a twist, counter-clockwise from above (180)")
    motion.add_argument(
        "--push",
        help='what hits it: seconds, impulse (m sqrt(g H)), way, part of the height: "0.5 0.1 left, 1-2 0.3 back 0.8"',
    )
    motion.add_argument(
        "--beats", help='of a dance: beats a minute, "90", or with the seconds of the first, "90 0.5", or a file'
    )
    motion.add_argument(
        "--style", help="of what jumps: light, heavy, rubbery, or anticipation=, squash=, timing=, times the usual"
    )
    motion.add_argument("--frames", type=int, help="pictures at 60 Hz, the first at rest (until the body rests)")
    body = animate.add_argument_group("body and ground")
    body.add_argument("--up", help="axis that points up: x, y, z or with a minus, as --up=-y; else it is guessed")
    body.add_argument("--front", help="x,y,z or an axis: the way it faces and moves, as --front=-x; else it is guessed")
    body.add_argument(
        "--plane", help="nx,ny,nz,d of the ground n.x + d = 0 in the capture's units, or a plane.json; else it is found"
    )
    add_flat_flag(body)
    body.add_argument("--gravity-up", help="x,y,z or an axis: against gravity, if the ground is a slope")
    body.add_argument(
        "--terrain", type=named_path, help="JSON with steps and walls: solids as lists of faces [nx,ny,nz,d]"
    )
    body.add_argument("--friction", type=float, help="Coulomb coefficient (0.8)")
    body.add_argument("--metres-per-unit", type=float, help="true scale; else the body is 1 m tall")
    body.add_argument(
        "--muscles",
        type=named_path,
        help="JSON with fibres (docs/motions/muscles.md); else they are made automatically",
    )
    scene = animate.add_argument_group("an object in a scene")
    add_object_flags(scene)
    add_straddling_flag(scene)
    add_inpainter_flags(scene, default=None)
    scene.add_argument("--no-inpaint", action="store_true", help="leave the floor under the object as captured")
    camera = animate.add_argument_group("camera")
    add_camera_flags(camera, size="512")
    camera.add_argument(
        "--view-from", help="x,y,z or an axis: from the object to the camera of the video, capture's frame"
    )
    camera.add_argument("--no-shadow", action="store_true", help="no shadow on the ground under the object")
    animate.set_defaults(run=_animate, parser=animate, resume=False)


def _animate(chosen: argparse.Namespace) -> int:
    from egs_warp.io.run_folder import check_run_folder

    check_run_folder(chosen.out, overwrite=chosen.overwrite, writes=_WRITES)
    if chosen.config is not None and changed_capture(chosen.config, chosen.capture):
        print_note(f"{chosen.capture} is not the file that the run of {chosen.config} had; the result will be another")
    return run_animate(chosen)


def run_animate(chosen: argparse.Namespace) -> int:
    """What ``egs-warp animate`` does once ``chosen.out`` is known to be free, or a run in it to go on; its status."""
    try:
        report, more = _animate_scene(chosen) if chosen.object is not None else _animate_capture(chosen)
    except BaseException as error:
        # What lies there may still be the earlier run, which is not this one.
        if not chosen.overwrite and (chosen.out / NAME).is_file():
            error.add_note(f"egs-warp resume {chosen.out} goes on")
        raise
    print(report.summary())
    print(f"wrote the video, sheet.png, plots.png, report.json, trajectory.npz{more} into {chosen.out}")
    return FALLEN if report.state.is_failure else 0


def _animate_capture(chosen: argparse.Namespace) -> tuple[Report, str]:
    """A capture that is the object alone; returns the report, and what was written besides."""
    from egs_warp.commands.scene_input import ground_of, plane_of
    from egs_warp.io import read_capture
    from egs_warp.io.run_folder import run_folder
    from egs_warp.io.video import ffmpeg_program
    from egs_warp.pipelines.animate import animate

    for name in ("cameras", "view", "mask_model", "straddling", "inpainter", "trust", "no_inpaint"):
        if getattr(chosen, name) not in (None, False):
            raise UserError(f"--{name.replace('_', '-')}: needs --object, which says what to take out of a scene")
    options = _options(chosen)
    shot, behind = shot_of(chosen)
    ffmpeg_program()
    start_device(chosen.device)
    up = parse_up(chosen.up) if chosen.up is not None else None
    plane = plane_of(chosen.plane) if chosen.plane is not None else None
    view_from = parse_direction("view-from", chosen.view_from) if chosen.view_from is not None else None
    capture = read_capture(chosen.capture, device=chosen.device)
    background = read_capture(behind, device=chosen.device).cloud if behind is not None else None
    notes = capture.notes
    if plane is None and up is None:
        up, note = guessed_up(capture)
        notes = (*notes, note)
        print_note(note)
    with run_folder(chosen.out, overwrite=chosen.overwrite, resume=chosen.resume) as run:
        run.begin_with(lambda: write_config(run.file(NAME), chosen, chosen.parser))
        report = animate(
            capture.cloud,
            run,
            motion=chosen.motion,
            up=up,
            plane=plane,
            background=background,
            options=replace(
                options,
                shot=shot,
                view_from=view_from,
                notes=notes,
                creature=replace(options.creature, ground=ground_of(chosen.plane, flat=chosen.flat)),
            ),
        )
        run.finish()
    return report, f", {NAME}"


def _animate_scene(chosen: argparse.Namespace) -> tuple[Report, str]:
    """The object of a scene, cut out of it, over the rest of the scene."""
    from egs_warp.commands.scene_input import read_scene
    from egs_warp.io.run_folder import run_folder
    from egs_warp.io.video import ffmpeg_program
    from egs_warp.pipelines.animate import animate
    from egs_warp.pipelines.facing_direction import mean_view
    from egs_warp.pipelines.prepare_scene import SceneOptions, viewing_directions

    shot, behind = shot_of(chosen)
    if behind is not None:
        raise UserError("--background: with --object the rest of the scene is behind the object; leave one of them out")
    if chosen.inpainter is not None and chosen.no_inpaint:
        raise UserError("--inpainter: --no-inpaint leaves the floor as captured; leave one of them out")
    options = _options(chosen)
    ffmpeg_program()
    start_device(chosen.device)
    inpainter = chosen_inpainter(chosen)
    view_from = parse_direction("view-from", chosen.view_from) if chosen.view_from is not None else None
    given = read_scene(chosen)
    scene_options = SceneOptions(
        clearing=clearing_of(chosen), flat=chosen.flat, inpaint=not chosen.no_inpaint, inpainter=inpainter
    )
    with run_folder(chosen.out, overwrite=chosen.overwrite, resume=chosen.resume) as run:
        run.begin_with(lambda: write_config(run.file(NAME), chosen, chosen.parser))
        scene = given.prepared(scene_options)
        # Whatever goes wrong later, the minutes that these took are not lost.
        scene.write(run)
        pictures = _write_pictures(run, given, scene)
        for note in scene.notes:
            print_note(note)
        report = animate(
            scene.object,
            run,
            motion=chosen.motion,
            plane=scene.plane,
            background=scene.background,
            options=replace(
                options,
                shot=shot,
                view_from=view_from if view_from is not None else viewing_directions(scene, given.cameras),
                notes=(*given.notes, *scene.notes),
                creature=replace(
                    options.creature,
                    ground=scene.ground,
                    seen_from=mean_view(given.cameras, scene.located.centre),
                ),
            ),
        )
        run.finish()
    return report, ", ".join(["", NAME, "object.ply", "background.ply", "plane.json", *pictures])


def _write_pictures(run: RunFolder, given: SceneInput, scene: PreparedScene) -> list[str]:
    """Pictures that show whether each step has worked, as the steps' own commands write them; returns their names."""
    from egs_warp.inpainting.picture import before_and_after
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.pictures import picture_cameras, plane_picture, segmentation_picture
    from egs_warp.pipelines.segmentation_warnings import segmentation_warnings

    centre, size = scene.located.centre, scene.located.size
    cameras = picture_cameras(scene.plane, centre, size, given.cameras)
    words = segmentation_warnings(given.cloud, scene.located, scene.object, cameras)
    for line in words:
        print_note(f"the object {line}")
    pictures = {
        "plane.png": plane_picture(given.cloud, [scene.plane], cameras, centre=centre, size=size),
        "segment.png": segmentation_picture(given.cloud, scene.object, scene.background_with_hole, cameras, words),
    }
    if scene.filled is not None:
        pictures["filled.png"] = before_and_after(scene.filled)
    for name, picture in pictures.items():
        write_png(run.file(name), picture)
    return list(pictures)


def _options(chosen: argparse.Namespace) -> AnimateOptions:
    """Return the options that the flags define without the capture. Raises ``UserError`` for invalid flags."""
    from egs_warp.contact.terrain import read_terrain
    from egs_warp.io.text import parse_json, read_text
    from egs_warp.locomotion.settings import LocomotionSettings
    from egs_warp.motions.push import read_pushes
    from egs_warp.motions.script import motion
    from egs_warp.pipelines.animate import AnimateOptions
    from egs_warp.pipelines.creature import CreatureOptions

    def given(*names: str) -> dict[str, Any]:
        return {name: getattr(chosen, name) for name in names if getattr(chosen, name) is not None}

    options = AnimateOptions(
        **given("distance", "height", "heading_degrees", "beats", "style", "push", "frames", "seed"),
        shadow=not chosen.no_shadow,
        get_up=not chosen.no_get_up,
        source=Path(chosen.capture).name,
        creature=CreatureOptions(**given("metres_per_unit", "friction")),
    )
    # The files of key frames are read, too.
    asked = motion(chosen.motion, beats=chosen.beats, **options.targets())
    asked.frames()
    asked.style(chosen.style)
    if chosen.push is not None:
        read_pushes(chosen.push)
    if chosen.muscles is not None:
        parse_json(read_text(chosen.muscles), chosen.muscles)
    creature = replace(
        options.creature,
        front=parse_direction("front", chosen.front) if chosen.front is not None else None,
        gravity_up=parse_direction("gravity-up", chosen.gravity_up) if chosen.gravity_up is not None else None,
        muscles_file=chosen.muscles,
        solids=read_terrain(chosen.terrain) if chosen.terrain else (),
        settings=LocomotionSettings(qp_solver=chosen.qp),
    )
    return replace(options, creature=creature)
