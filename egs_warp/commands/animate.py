"""``egs-warp animate``: simulate the motions of a captured object and film them."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egs_warp.commands.animate_scene import animate_scene_world, named_objects
from egs_warp.commands.animate_world import animate_world, is_world
from egs_warp.commands.camera_flags import add_camera_flags, shot_of
from egs_warp.commands.config import NAME, add_config_flag, changed_capture, write_config
from egs_warp.commands.flags import (
    Commands,
    add_inpainter_flags,
    add_out_flag,
    add_planning_flags,
    capture_name,
    chosen_inpainter,
    guessed_up,
    input_path,
    named_path,
    parse_direction,
    parse_up,
)
from egs_warp.commands.scene_flags import (
    add_flat_flag,
    add_object_flags,
    add_overwrite_flag,
    check_no_scene_flags,
    print_above_bars,
    print_film,
    print_note,
    print_notes,
    start_device,
)
from egs_warp.commands.segment import add_straddling_flag, clearing_of
from egs_warp.errors import UserError
from egs_warp.notes import Problem

if TYPE_CHECKING:
    import numpy as np

    from egs_warp.commands.scene_input import SceneInput
    from egs_warp.geometry.gaussians import GaussianCloud
    from egs_warp.geometry.plane import Plane
    from egs_warp.io.run_folder import RunFolder
    from egs_warp.pipelines.animate import AnimateOptions
    from egs_warp.pipelines.prepare_scene import PreparedScene
    from egs_warp.pipelines.report import Report

EXIT_NOT_AS_REQUESTED = 3
"""Exit status of a run that has written its files but did not achieve the requested motion (``State.is_failure``)."""
_WRITES = (NAME, "trajectory.npz", "plots.png", "cage.vtu", "sheet.png", "creature.npz", "report.json")
"""Files that every run writes. The names of other files depend on the motion."""
EXAMPLES = (
    "pawn.ply --up z --out out/jump",
    'scan.spz --motion "hop x3, twist 180" --camera follow --size 1280x720 --out out/hop',
    "room.ply --object 0,0,0.5 --up=-y --motion walk --out out/walk",
    "room.ply --object picked.json --out out/picked",
    'room.ply --object bear=0,0,0.5 --object box=1,0,0.5 --prop box --motion "bear: jump to box" --out out/two',
    "thing.ply --up z --background transparent --out out/cut_out",
    "--config out/jump/run.yaml --friction 0.4 --out out/slippery",
)


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    animate = commands.add_parser(
        "animate", help="bring a capture to life", usage="%(prog)s capture --out FOLDER [flags]"
    )
    animate.add_argument(
        "capture",
        type=capture_name,
        help=".ply, compressed .ply, .spz, .splat, .sog, .glb, an unbundled SOG folder, or a world.yaml with several"
        " bodies (docs/guide/worlds.md)",
    )
    common = animate.add_argument_group("most used")
    add_out_flag(common, "folder for the video, contact sheet, report and trajectory", metavar="FOLDER")
    common.add_argument("--up", help="axis that points up: x, y, z, -x, -y or -z, as --up=-y (default: estimated)")
    common.add_argument(
        "--motion",
        default="jump",
        help='motion (jump), several as "hop x3, twist 180", with a gesture as "walk 1 + nod", a script.json, or, for'
        ' several objects, "NAME: MOTION; NAME: MOTION" (docs/motions/index.md)',
    )
    motion = animate.add_argument_group("motion")
    body = animate.add_argument_group("body and ground")
    scene = animate.add_argument_group("object in a scene")
    camera = animate.add_argument_group("video")
    add_object_flags(scene, common=common)
    add_camera_flags(camera, size="512", common=common)
    common.add_argument(
        "--preview", action="store_true", help="film with fewer pixels and Gaussians; the motion is the same"
    )
    common.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    motion.add_argument(
        "--distance",
        type=float,
        help="distance of each motion in body heights",
    )
    motion.add_argument(
        "--height",
        type=float,
        help="rise of the centre of mass in body heights",
    )
    motion.add_argument(
        "--heading-degrees",
        type=float,
        help="rotation in degrees, counter-clockwise seen from above",
    )
    motion.add_argument(
        "--push",
        help="pushes, each as time in s, impulse in m sqrt(g H), direction and, optionally, part of the body height: "
        '"0.5 0.1 left, 1-2 0.3 back 0.8"',
    )
    motion.add_argument(
        "--beats",
        help='beats of a dance: beats per minute, "90", optionally with the time of the first beat in s, "90 0.5"; or '
        "a file",
    )
    motion.add_argument(
        "--style",
        help="style of jumps",
    )
    motion.add_argument(
        "--frames", type=int, help="number of frames at 60 Hz, the first at rest (default: until the body is at rest)"
    )
    motion.add_argument("--no-get-up", action="store_true", help="end the run if the body falls")
    motion.add_argument(
        "--no-retakes",
        action="store_true",
        help="if the body falls, show that instead of simulating a gentler motion (docs/motions/retakes.md)",
    )
    body.add_argument(
        "--front",
        help="direction in which the body faces and moves: x,y,z or an axis, as --front=-x (default: estimated)",
    )
    body.add_argument(
        "--plane",
        help="ground plane n.x + d = 0 as nx,ny,nz,d in the capture's units, or a plane.json (default: estimated)",
    )
    add_flat_flag(body)
    body.add_argument(
        "--gravity-up", help="direction against gravity if the ground is a slope: x,y,z or an axis, as --gravity-up=-y"
    )
    body.add_argument(
        "--terrain",
        type=input_path,
        help="JSON file with steps and walls: solids as lists of faces [nx,ny,nz,d] (docs/motions/ground.md)",
    )
    body.add_argument("--friction", type=float, help="Coulomb friction coefficient (0.8)")
    body.add_argument(
        "--metres-per-unit", type=float, help="scale of the capture (default: such that the body is 1 m tall)"
    )
    body.add_argument(
        "--cage",
        type=input_path,
        help="tetrahedra around the object, .mesh, .msh or .vtu (docs/concepts/cage.md; default: made automatically)",
    )
    body.add_argument(
        "--nodes",
        type=int,
        help="approximate number of cage nodes; fewer are faster; a cage that must be finer to enclose the body and "
        "its thin parts has up to about four times as many (500)",
    )
    body.add_argument(
        "--muscles",
        type=input_path,
        help="JSON file with muscle fibres (docs/motions/muscles.md; default: placed automatically)",
    )
    add_straddling_flag(scene)
    add_inpainter_flags(scene, default=None)
    scene.add_argument(
        "--prop",
        action="append",
        metavar="NAME",
        help="with --object NAME=..., the object NAME is a stiff prop without muscles (repeat the flag for several)",
    )
    scene.add_argument(
        "--collision-mesh",
        type=input_path,
        metavar="FILE.glb",
        help="with --object NAME=..., read the obstacles from this mesh, in the frame of the capture",
    )
    scene.add_argument(
        "--save-collision-mesh",
        type=named_path,
        metavar="FILE.glb",
        help="with --object NAME=..., write ground and obstacles as a mesh, in the frame of the capture",
    )
    scene.add_argument("--no-inpaint", action="store_true", help="leave the floor under the object as captured")
    camera.add_argument(
        "--view-from",
        help="direction from the object to the camera, in the capture's frame: x,y,z or an axis, as --view-from=-y",
    )
    camera.add_argument("--no-shadow", action="store_true", help="draw no shadow under the object")
    camera.add_argument(
        "--no-light",
        action="store_true",
        help="keep the captured colours and draw a soft shadow straight below the object, also where the capture shows"
        " a main light (docs/concepts/light.md)",
    )
    run = animate.add_argument_group("run and solver")
    add_overwrite_flag(run, "--out")
    add_config_flag(run)
    add_planning_flags(run)
    run.add_argument("--seed", type=int, help="seed written to the report (0); no motion uses random numbers")
    animate.set_defaults(run=_animate, parser=animate, resume=False)


def complete_help(parser: argparse.ArgumentParser) -> None:
    """Write the names and default values of the registry into the help texts."""
    from egs_warp.motions.repertoire import MOTIONS, motion_names
    from egs_warp.motions.style import MAX_FACTOR, MAX_OVERLAP, MIN_FACTOR, PRESETS, Style

    factors = " ".join(f"{name}=1.2" for name in vars(Style()) if name != "overlap")
    added = {
        "motion": f"one of {', '.join(motion_names())}",
        "style": f"{', '.join(PRESETS)}, or factors from {MIN_FACTOR:g} to {MAX_FACTOR:g}, as {factors};"
        f" overlap=0.1 (0 to {MAX_OVERLAP:g}) makes ears, arms and tails soft",
    }
    for target in ("distance", "height", "heading_degrees"):
        defaults = [
            f"{name} ({value.default:g})"
            for name, kind in MOTIONS.items()
            for value in kind.parameters
            if value.name == target
        ]
        added[target] = ", ".join(defaults)
    for action in parser._actions:
        if action.dest in added and action.help is not None and added[action.dest] not in action.help:
            action.help = f"{action.help}: {added[action.dest]}"


def _animate(args: argparse.Namespace) -> int:
    from egs_warp.io.run_folder import check_run_folder

    if is_world(args.capture) or named_objects(args.object):
        check_run_folder(args.out, overwrite=args.overwrite, writes=(NAME, "sheet.png", "report.json"))
        return run_animate(args)
    for flag in ("prop", "collision_mesh", "save_collision_mesh"):
        if getattr(args, flag) is not None:
            raise UserError(f"--{flag.replace('_', '-')}: it is for objects with names; give --object NAME=... as well")
    check_run_folder(args.out, overwrite=args.overwrite, writes=_WRITES)
    if args.config is not None and changed_capture(args.config, args.capture):
        print_note(f"{args.capture} differs from the capture of the run in {args.config}; the result will differ")
    return run_animate(args)


def run_animate(args: argparse.Namespace) -> int:
    """Run ``egs-warp animate`` with the output folder already checked; return the exit status."""
    try:
        if is_world(args.capture):
            return EXIT_NOT_AS_REQUESTED if animate_world(args) else 0
        if objects := named_objects(args.object):
            return EXIT_NOT_AS_REQUESTED if animate_scene_world(args, objects) else 0
        report = _animate_scene(args) if args.object is not None else _animate_capture(args)
    except BaseException as error:
        # With --overwrite, the folder may still contain an earlier run, which must not be mistaken for this one and
        # resumed.
        if not args.overwrite and (args.out / NAME).is_file():
            error.add_note(f"egs-warp resume {args.out} continues it")
        raise
    print_above_bars(report.summary())
    print_film(args.out, str(report.film), "sheet.png, plots.png and report.json")
    return EXIT_NOT_AS_REQUESTED if report.state.is_failure else 0


def _animate_capture(args: argparse.Namespace) -> Report:
    """Animate a capture that contains only the object."""
    check_no_scene_flags(args)
    options = animate_options(args)
    from egs_warp.commands.scene_hint import scene_notes
    from egs_warp.commands.scene_input import ground_of, light_of, plane_of
    from egs_warp.io import read_capture
    from egs_warp.io.video import ffmpeg_program

    shot, background_path = shot_of(args)
    ffmpeg_program()
    start_device(args.device)
    up = parse_up(args.up) if args.up is not None else None
    plane = plane_of(args.plane) if args.plane is not None else None
    view_from = parse_direction("view-from", args.view_from) if args.view_from is not None else None
    capture = read_capture(args.capture, device=args.device)
    background = None
    if background_path is not None:
        background = read_capture(background_path, device=args.device).cloud_aligned_with(capture)
    notes = capture.notes
    if plane is None and up is None:
        up, note = guessed_up(capture)
        notes = (*notes, note)
    notes = (*notes, *scene_notes(capture.cloud, plane.normal if plane is not None else up))
    options = replace(
        options,
        shot=shot,
        view_from=view_from,
        notes=notes,
        creature=replace(options.creature, ground=ground_of(args.plane, flat=args.flat)),
        light=None if args.no_light else light_of(args.plane),
    )
    return _animate_whole(args, capture.cloud, options, up=up, plane=plane, background=background)


def _animate_scene(args: argparse.Namespace) -> Report:
    """Animate an object that is segmented from a scene, with the rest of the scene as background."""
    if args.background is not None:
        raise UserError("--background: with --object the rest of the scene is the background; leave one of them out")
    if args.inpainter is not None and args.no_inpaint:
        raise UserError("--inpainter: --no-inpaint leaves the floor as captured; leave one of them out")
    options = animate_options(args)
    from egs_warp.commands.scene_input import read_scene
    from egs_warp.io.run_folder import run_folder
    from egs_warp.io.video import ffmpeg_program
    from egs_warp.pipelines.animate import animate
    from egs_warp.pipelines.facing_direction import mean_view
    from egs_warp.pipelines.prepare_scene import SceneOptions, viewing_directions

    shot, _ = shot_of(args)
    ffmpeg_program()
    start_device(args.device)
    inpainter = chosen_inpainter(args)
    view_from = parse_direction("view-from", args.view_from) if args.view_from is not None else None
    scene_input = read_scene(args)
    front = options.creature.front if options.creature.front is not None else scene_input.front
    options = replace(options, shot=shot, creature=replace(options.creature, front=front))
    alone = scene_input.object_alone
    if alone is not None:
        options = replace(options, view_from=view_from, notes=scene_input.notes)
        return _animate_whole(args, alone, options, up=scene_input.up, plane=scene_input.plane)
    scene_options = SceneOptions(
        clearing=clearing_of(args), flat=args.flat, inpaint=not args.no_inpaint, inpainter=inpainter
    )
    with run_folder(args.out, overwrite=args.overwrite, resume=args.resume) as run:
        run.begin_with(lambda: write_config(run.file(NAME), args, args.parser))
        scene = scene_input.prepared(scene_options)
        # Write the scene first, so that a later error does not discard minutes of work.
        scene.write(run)
        notes = (*scene_input.notes, *scene.notes, *_write_pictures(run, scene_input, scene))
        print_notes(notes)
        report = animate(
            scene.object,
            run,
            motion=args.motion,
            plane=scene.plane,
            background=scene.background,
            options=replace(
                options,
                view_from=view_from if view_from is not None else viewing_directions(scene, scene_input.cameras),
                notes=notes,
                light=None if args.no_light else scene.light,
                creature=replace(
                    options.creature,
                    ground=scene.ground,
                    seen_from=mean_view(scene_input.cameras, scene.located.centre),
                ),
            ),
            show_note=print_note,
        )
        run.finish()
    return report


def _animate_whole(
    args: argparse.Namespace,
    cloud: GaussianCloud,
    options: AnimateOptions,
    *,
    up: np.ndarray | None,
    plane: Plane | None,
    background: GaussianCloud | None = None,
) -> Report:
    """Animate ``cloud``, which contains only the object."""
    from egs_warp.io.run_folder import run_folder
    from egs_warp.pipelines.animate import animate

    print_notes(options.notes)
    with run_folder(args.out, overwrite=args.overwrite, resume=args.resume) as run:
        run.begin_with(lambda: write_config(run.file(NAME), args, args.parser))
        report = animate(
            cloud,
            run,
            motion=args.motion,
            up=up,
            plane=plane,
            background=background,
            options=options,
            show_note=print_note,
        )
        run.finish()
    return report


def _write_pictures(run: RunFolder, scene_input: SceneInput, scene: PreparedScene) -> list[Problem]:
    """For checking, write the images that the commands ``plane``, ``segment`` and ``inpaint`` write as well; return
    what is probably wrong with the object."""
    from egs_warp.inpainting.picture import before_and_after
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.pictures import picture_cameras, plane_picture, segmentation_picture
    from egs_warp.pipelines.segmentation_warnings import segmentation_warnings

    centre, size = scene.located.centre, scene.located.size
    cameras = picture_cameras(scene.plane, centre, size, scene_input.cameras)
    warnings = segmentation_warnings(scene_input.cloud, scene.located, scene.object, cameras)
    pictures = {
        "plane.png": plane_picture(scene_input.cloud, [scene.plane], cameras, centre=centre, size=size),
        "segment.png": segmentation_picture(
            scene_input.cloud, scene.object, scene.background_with_hole, cameras, warnings
        ),
    }
    if scene.filled is not None:
        pictures["filled.png"] = before_and_after(scene.filled)
    for name, picture in pictures.items():
        write_png(run.file(name), picture)
    return [Problem(f"the object {warning}") for warning in warnings]


def animate_options(args: argparse.Namespace) -> AnimateOptions:
    """Return the options that depend only on the flags, not on the capture. Raises ``UserError`` for invalid flags."""
    from egs_warp.motions.names import check_names

    # First, because the other modules take seconds to import.
    check_names(args.motion)
    from egs_warp.contact.terrain import read_terrain
    from egs_warp.io.text import parse_json, read_text
    from egs_warp.locomotion.settings import LocomotionSettings
    from egs_warp.meshing.cage import check_nodes
    from egs_warp.meshing.cage_file import read_cage_mesh
    from egs_warp.motions.push import read_pushes
    from egs_warp.motions.script import motion
    from egs_warp.pipelines.animate import AnimateOptions
    from egs_warp.pipelines.creature import CreatureOptions

    def flags(*names: str) -> dict[str, Any]:
        return {name: getattr(args, name) for name in names if getattr(args, name) is not None}

    options = AnimateOptions(
        **flags("distance", "height", "heading_degrees", "beats", "style", "push", "frames", "seed"),
        shadow=not args.no_shadow,
        preview=args.preview,
        get_up=not args.no_get_up,
        retakes=not args.no_retakes,
        source=Path(args.capture).name,
        creature=CreatureOptions(**flags("metres_per_unit", "friction")),
    )
    # This also reads the files of key frames.
    script = motion(args.motion, beats=args.beats, **options.targets())
    script.frames()
    script.style(args.style)
    if args.push is not None:
        read_pushes(args.push)
    if args.cage is not None:
        read_cage_mesh(args.cage)
    if args.nodes is not None:
        check_nodes(args.nodes)
    if args.muscles is not None:
        parse_json(read_text(args.muscles), args.muscles)
    creature = replace(
        options.creature,
        front=parse_direction("front", args.front) if args.front is not None else None,
        gravity_up=parse_direction("gravity-up", args.gravity_up) if args.gravity_up is not None else None,
        nodes=options.creature.nodes if args.nodes is None else args.nodes,
        cage_file=args.cage,
        muscles_file=args.muscles,
        solids=read_terrain(args.terrain) if args.terrain else (),
        settings=LocomotionSettings(qp_solver=args.qp, strategy=args.strategy),
    )
    return replace(options, creature=creature)
