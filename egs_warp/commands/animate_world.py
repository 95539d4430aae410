"""``egs-warp animate WORLD.yaml``: simulate and film the bodies of a world."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from egs_warp.commands.camera_flags import shot_of
from egs_warp.commands.config import NAME, write_config
from egs_warp.commands.flags import parse_direction
from egs_warp.commands.scene_flags import print_above_bars, print_film, print_note, print_notes, start_device
from egs_warp.errors import UserError

if TYPE_CHECKING:
    from egs_warp.io.run_folder import RunFolder
    from egs_warp.pipelines.scene_obstacles import SceneObstacles
    from egs_warp.pipelines.scene_script import SceneProgress
    from egs_warp.pipelines.surroundings import Surroundings
    from egs_warp.pipelines.world_file import WorldScript

WorldReader: TypeAlias = "Callable[[SceneProgress], WorldScript]"
"""Function that creates a world."""
WORLD_ENDINGS = (".yaml", ".yml")
"""Endings of the names of world files."""
WORLD_FLAGS = (
    *("capture", "out", "overwrite", "device", "camera", "size", "fps", "background", "view_from", "no_shadow"),
    *("frames", "no_get_up", "style", "preview"),
)
"""Flags that also apply to a world."""


def is_world(capture: str) -> bool:
    """Return True if ``capture`` names a world file."""
    return Path(capture).suffix.lower() in WORLD_ENDINGS


def check_flags(
    args: argparse.Namespace,
    allowed: Sequence[str],
    problem: str = "it is for a single capture; a world file describes its bodies; leave it out",
) -> None:
    """Raise ``UserError`` with the text ``problem`` if a flag that is not ``allowed`` differs from its default."""
    for action in args.parser._actions:
        if action.dest in vars(args) and action.dest not in allowed and getattr(args, action.dest) != action.default:
            flag = action.option_strings[0] if action.option_strings else action.dest
            raise UserError(f"{flag}: {problem}")


def animate_world(args: argparse.Namespace) -> bool:
    """Run ``egs-warp animate`` for a world file; return True if the exit status must report a failure. The caller has
    checked the output folder."""
    from egs_warp.pipelines.world_file import read_world_file

    check_flags(args, (*WORLD_FLAGS, "config", "save_collision_mesh"))
    return run_world(
        args,
        lambda progress: read_world_file(Path(args.capture), progress, device=args.device),
    )


def run_world(args: argparse.Namespace, read: WorldReader) -> bool:
    """Create a world with ``read``, simulate and film it; return True if the exit status must report a failure."""
    from egs_warp.io.ply import write_ply
    from egs_warp.io.run_folder import ANIMATE_WORLD, run_folder
    from egs_warp.io.video import ffmpeg_program
    from egs_warp.motions.style import read_style
    from egs_warp.pipelines.animate import PREVIEW_SIZE
    from egs_warp.pipelines.animate_world import write_world
    from egs_warp.pipelines.finished_run import PARTS
    from egs_warp.pipelines.progress import simulation_bar
    from egs_warp.pipelines.scene_pictures import write_object
    from egs_warp.pipelines.scene_script import SceneProgress
    from egs_warp.pipelines.simulated_run import check_frames
    from egs_warp.pipelines.world_run import simulate_world

    shot, background = shot_of(args)
    if background is not None:
        raise UserError("--background: the background of a world must be a colour or transparent; give one of these")
    check_frames(args.frames)
    style = read_style(args.style) if args.style is not None else None
    view_from = None if args.view_from is None else parse_direction("view-from", args.view_from)
    ffmpeg_program()
    start_device(args.device)
    with run_folder(args.out, command=ANIMATE_WORLD, overwrite=args.overwrite, resume=args.resume) as folder:
        folder.begin_with(lambda: write_config(folder.file(NAME), args, args.parser))
        # Write the parts of a scene immediately, so that a later error does not discard minutes of work.
        progress = SceneProgress(
            print_note,
            lambda name, scene: write_object(name, scene, folder),
            lambda background: write_ply(folder.file("background.ply"), background),
            lambda obstacles, surroundings: _write_obstacles(args, folder, obstacles, surroundings),
        )
        scripted = read(progress)
        if args.save_collision_mesh is not None and scripted.parts is None:
            raise UserError("--save-collision-mesh: the world has no scene, so it has no obstacles; leave it out")
        print_notes(scripted.notes)
        with simulation_bar() as show_frames:
            run = simulate_world(
                scripted.world,
                scripted.motions,
                frames=args.frames,
                style=style,
                pushes=scripted.pushes,
                get_up=not args.no_get_up,
                parts=lambda name: _folder_of(folder, name) / PARTS,
                resume=folder.path if folder.resumed else None,
                progress=show_frames,
            )
        report = write_world(
            run,
            folder,
            shot=shot,
            size=PREVIEW_SIZE if args.preview else 512,
            view_from=view_from,
            shadow=not args.no_shadow,
            notes=scripted.notes,
            asked={
                **scripted.text,
                **{"frames": args.frames, "style": args.style, "get_up": not args.no_get_up, "preview": args.preview},
            },
            show_note=print_note,
        )
        folder.finish()
    print_above_bars(report.summary())
    print_film(args.out, str(report.film), "sheet.png and report.json")
    return report.state.is_failure


def _write_obstacles(
    args: argparse.Namespace, folder: RunFolder, obstacles: SceneObstacles, surroundings: Surroundings
) -> None:
    """Write the picture of the obstacles of a scene, and the file of ``--save-collision-mesh``."""
    from egs_warp.io.video import write_png
    from egs_warp.pipelines.scene_collision import write_collision_mesh
    from egs_warp.pipelines.scene_pictures import OBSTACLE_PICTURE, obstacle_picture

    write_png(folder.file(OBSTACLE_PICTURE), obstacle_picture(obstacles, surroundings))
    if args.save_collision_mesh is not None:
        write_collision_mesh(args.save_collision_mesh, obstacles, surroundings.frame)
        print_note(f"collision mesh: {args.save_collision_mesh}")


def _folder_of(folder: RunFolder, name: str) -> Path:
    """Create and return the folder of a body."""
    path = folder.folder(name)
    path.mkdir(exist_ok=True)
    return path
