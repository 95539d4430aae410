"""End-to-end pipeline of a run: from a capture to its simulated and rendered motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np

from egs_warp.checked_calls import Range, Seed, checked_constructor
from egs_warp.errors import ArgumentError
from egs_warp.geometry.frames import Direction, direction_of
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.main_light import MainLight
from egs_warp.geometry.plane import Plane
from egs_warp.io import write_ply
from egs_warp.io.atomic import atomic_write
from egs_warp.io.run_folder import RunFolder, run_folder
from egs_warp.io.video import ffmpeg_program
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.locomotion.strategies import Strategy
from egs_warp.motions.planned_legs import planned_legs
from egs_warp.motions.push import read_pushes
from egs_warp.motions.request import MAX_TARGET, MAX_TURN
from egs_warp.motions.script import Script
from egs_warp.motions.script import motion as script
from egs_warp.motions.style import read_style
from egs_warp.pipelines import render_data
from egs_warp.pipelines.balance import balance_note, unstable_start_notes
from egs_warp.pipelines.creature import CreatureOptions, initial_stance, make_checked_creature
from egs_warp.pipelines.film import Film, draw_film, film_setup, picture_seconds
from egs_warp.pipelines.film_time import FilmTimeNote
from egs_warp.pipelines.finished_run import BACKGROUND, PARTS
from egs_warp.pipelines.ground_coverage import (
    ENDS_OUTSIDE_GROUND,
    ground_coverage_warning,
    overhang_note,
    planned_end_note,
)
from egs_warp.pipelines.plots import draw_plots
from egs_warp.pipelines.progress import preparation_bar, simulation_bar
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.report import GaussianCounts, JsonValue, Report, report_of_run
from egs_warp.pipelines.shot import MAX_SIDE, MIN_SIDE, Shot
from egs_warp.pipelines.simulated_run import check_frames
from egs_warp.pipelines.takes import simulate_takes
from egs_warp.short_repr import short_repr

PREVIEW_GAUSSIANS = 50_000
"""Maximum number of Gaussians in a preview."""
PREVIEW_SIZE = 256
"""Maximum width and height of a preview, pixels."""
BodyHeights: TypeAlias = Annotated[float, Range(0.0, MAX_TARGET, "a number of body heights")]
"""A target of a motion."""


@checked_constructor
@dataclass(frozen=True, kw_only=True)
class AnimateOptions:
    """Options of ``animate``.

    The targets apply to motions that do not specify targets of their own.
    """

    __repr__ = short_repr

    distance: BodyHeights | None = None
    """Target distance, body heights; None uses the default of the motion."""
    height: BodyHeights | None = None
    """Target height, body heights; None uses the default of the motion."""
    heading_degrees: Annotated[float, Range(-MAX_TURN, MAX_TURN, "a number of degrees")] | None = None
    """Target change of heading, degrees to the left; None uses the default of the motion."""
    beats: str | None = None
    """Beats of a dance: a tempo, or the name of a file (``egs_warp.motions.beats``)."""
    style: str | None = None
    """Style of jumps (``egs_warp.motions.style``)."""
    push: str | None = None
    """Pushes during the run (``egs_warp.motions.push``)."""
    get_up: bool = True
    """True to get up and continue if the body falls."""
    retakes: bool = True
    """True to simulate a motion again in a gentler form (``egs_warp.pipelines.takes``) if the body falls and no pushes
    were requested."""
    frames: int | None = None
    """Number of frames at 60 Hz, of which the first shows the body at rest; None simulates until the body rests after
    the last motion."""
    size: Annotated[int, Range(MIN_SIDE, MAX_SIDE, "a number of pixels")] = 512
    """Width and height of the video, pixels, unless ``shot`` has a size or ``preview`` is set."""
    shadow: bool = True
    """True to draw a shadow on the ground under the object."""
    light: MainLight | None = None
    """Main light in the axes of the capture (``prepare_scene``), which relights the creature and casts its shadow. None
    keeps the captured colours and draws the shadow straight below the object."""
    preview: bool = False
    """True to draw at most ``PREVIEW_GAUSSIANS`` Gaussians, and at most ``PREVIEW_SIZE`` pixels along each side if
    ``shot`` has no size."""
    view_from: Direction | None = None
    """(3,) direction from the object to the camera, in the capture's frame, or an axis; from several directions (n, 3),
    the best one is chosen."""
    shot: Shot = field(default_factory=Shot)
    """Camera motion, size, frame rate and background colour of the video."""
    creature: CreatureOptions = field(default_factory=CreatureOptions)
    """Options for body, muscles, ground and solver."""
    seed: Seed = 0
    """Seed that is written into the report. It does not affect the result, because no computation is random."""
    source: str = "capture"
    """Name of the capture in the report."""
    notes: tuple[str, ...] = ()
    """Notes for the report that precede the notes of the run."""

    def __post_init__(self) -> None:
        if self.height == 0.0:
            raise ArgumentError("height", "a jump needs a height above 0 body heights", value=0)
        check_frames(self.frames)
        self.directions_to_camera()
        if self.style is not None:
            read_style(self.style)
        if self.push is not None:
            read_pushes(self.push)

    @property
    def side(self) -> int:
        """Width and height of the video, pixels, if ``shot`` has no size."""
        return min(self.size, PREVIEW_SIZE) if self.preview else self.size

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the video, pixels."""
        return self.shot.size or (self.side, self.side)

    @property
    def overlap(self) -> float:
        """Softness of the parts that stick out, from the options of the creature or from the style."""
        return max(self.creature.overlap, 0.0 if self.style is None else read_style(self.style).overlap)

    def targets(self) -> dict[str, float | None]:
        """Return the targets by the names that ``script`` uses for them."""
        return {"distance": self.distance, "height": self.height, "heading_degrees": self.heading_degrees}

    def directions_to_camera(self) -> np.ndarray | None:
        """Return ``view_from`` as numbers, (3,) or (n, 3)."""
        directions = self.view_from
        if directions is None or (not isinstance(directions, str) and np.ndim(directions) == 2):
            return None if directions is None else np.asarray(directions)
        return direction_of(directions, "view_from")

    def to_json(self, *, up: np.ndarray | None = None, plane: Plane | None = None) -> dict[str, JsonValue]:
        """Return the entry ``asked`` of the report, with ``up`` and ``plane`` of the run; omitted options are null."""
        creature, settings = self.creature, self.creature.settings or LocomotionSettings()
        view_from = self.directions_to_camera()
        return {
            **self.targets(),
            "frames": self.frames,
            "size": list(self.picture_size),
            "seed": self.seed,
            "metres_per_unit": creature.metres_per_unit,
            "friction": creature.friction,
            "nodes": creature.nodes if creature.cage_file is None else None,
            "sag": creature.sag,
            "overlap": self.overlap,
            "shadow": self.shadow,
            "light": self.light is not None,
            "preview": self.preview,
            "get_up": self.get_up,
            "retakes": self.retakes and self.push is None,
            **self.shot.to_json(),
            "up": _numbers(up),
            "plane": None if plane is None else [*map(float, plane.normal), plane.offset],
            "view_from": None if view_from is None or view_from.ndim != 1 else _numbers(view_from),
            "gravity_up": _numbers(creature.gravity_up),
            "front": _numbers(creature.front),
            "push": self.push or None,
            "beats": self.beats or None,
            "style": self.style or None,
            "cage": None if creature.cage_file is None else Path(creature.cage_file).name,
            "muscles": None if creature.muscles_file is None else Path(creature.muscles_file).name,
            "strategy": Strategy(settings.strategy).value,
            "qp": None if settings.qp_solver is None else QpSolver(settings.qp_solver).value,
            "solids": len(creature.solids),
        }


def animate(
    cloud: GaussianCloud,
    out: Path | str | RunFolder,
    *,
    motion: Script | str = "jump",
    up: Direction | None = None,
    plane: Plane | None = None,
    background: GaussianCloud | None = None,
    options: AnimateOptions | None = None,
    overwrite: bool = False,
    resume: bool = False,
    quiet: bool = False,
    show_note: Callable[[str], object] = lambda note: None,
) -> Report:
    """Animate a capture, and write video, contact sheet, plots, report and trajectory into ``out``.

    A folder belongs to one run (``egs_warp.io.run_folder``): without ``overwrite`` or ``resume``, a folder with an
    earlier run is rejected.

    Args:
        cloud: The capture of a single object, scene units.
        out: Folder for the files.
        motion: One motion, several in a row, the name of a JSON script, or a script (``egs_warp.motions.script``).
        up: (3,) Up in the capture's frame, or an axis (``make_creature``).
        plane: Ground plane in the capture's frame (``make_creature``).
        background: Gaussians behind the object, in the capture's frame and units; None draws a plain floor.
        options: Targets, video and creature; None uses the default.
        overwrite: True to move an earlier run in ``out`` aside.
        resume: True to continue the interrupted run in ``out``; with equal arguments, the result is bitwise equal to
            that of an uninterrupted run.
        quiet: True to show no progress bars.
        show_note: Called once with each note for the user that is not in ``options.notes``, as soon as it is known.

    Returns:
        The contents of ``report.json`` (docs/guide/report.md).

    Raises:
        UserError: An argument is invalid; files of an earlier run stay unchanged.
    """
    options = options or AnimateOptions()
    options.shot.check()
    view_from = options.directions_to_camera()
    up = None if up is None else direction_of(up, "up")
    requested_motion = _requested(motion, options)
    requested_motion.frames()  # This reads the files that the motions name.
    jump_style = requested_motion.style(options.style)
    pushes = read_pushes(options.push) if options.push is not None else ()
    ffmpeg_program()
    with run_folder(out, overwrite=overwrite, resume=resume) as run:
        with preparation_bar(quiet=quiet) as begin_stage:
            creature_options = replace(options.creature, overlap=options.overlap)
            creature = make_checked_creature(
                cloud,
                up=up,
                plane=plane,
                options=creature_options,
                progress=begin_stage,
                check=partial(requested_motion.check_shape, style=jump_style),
            )
            balance = None
            if options.creature.muscles_file is not None:
                begin_stage("balance")
                balance = balance_note(creature)
        placed_background = creature.placed(background) if background is not None else None
        stance = initial_stance(creature)
        planned = planned_end_note(planned_legs(requested_motion), stance, placed_background, creature.solids[0])
        notes = [
            *creature.notes,
            *([] if balance is None else [balance]),
            *unstable_start_notes(stance),
            *planned,
        ]
        for note in notes:
            show_note(note)

        def add_note(note: str) -> None:
            notes.append(note)
            show_note(note)

        film_note = None
        if not options.preview and creature.cloud.count > PREVIEW_GAUSSIANS:
            seconds = picture_seconds(creature, size=options.picture_size, shadow=options.shadow)
            film_note = FilmTimeNote(seconds, options.shot.fps / FRAME_RATE, show_note)
        with simulation_bar(quiet=quiet) as show_frames:

            def show_progress(done: int, expected: int) -> None:
                show_frames(done, expected)
                if film_note is not None:
                    film_note.update(done, expected)

            performance, takes = simulate_takes(
                creature,
                requested_motion,
                retakes=options.retakes,
                frames=options.frames,
                style=jump_style,
                pushes=pushes,
                get_up=options.get_up,
                parts=lambda: run.file(PARTS),
                resume=run.path / PARTS if run.resumed else None,
                show_note=add_note,
                progress=show_progress,
            )
        # Save the trajectory first, so that an error while rendering does not lose the simulation.
        performance.trajectory.save(run.file("trajectory.npz"))
        if background is not None and not run.has(BACKGROUND):
            # The background is stored for other films, pages and exports of the finished run.
            write_ply(run.file(BACKGROUND), background)
        energy = energy_balance(performance.trajectory)
        draw_plots(run.file("plots.png"), performance.trajectory, energy)
        with atomic_write(run.file("cage.vtu")) as temporary:
            creature.cage.mesh.write_vtu(temporary)
        setup = film_setup(
            performance,
            size=options.side,
            shot=options.shot,
            background=background,
            view_from=view_from,
            shadow=options.shadow,
            light=options.light,
            max_gaussians=PREVIEW_GAUSSIANS if options.preview else None,
        )
        film = draw_film(setup, run, name=requested_motion.file_stem, quiet=quiet)
        light = None if options.light is None else options.light.rotated(creature.frame.axes)
        render_data_of_run = RenderData.of(
            film.splats, film.camera, creature.muscles, performance.place.feet(), light=light
        )
        render_data_of_run.save(run.file(render_data.FILE), deformer=film.deformer)
        simulation = performance.simulation
        first_nodes, last_nodes = (simulation.trajectory.positions[index] for index in (0, -1))
        ended_over = (last_nodes, placed_background, creature.solids[0], creature.body.height)
        coverage_warning = ground_coverage_warning(*ended_over, start=first_nodes)
        edge_notes = (*coverage_warning, *overhang_note(*ended_over, start=first_nodes))
        for note in (last_notes := (*performance.unfinished_note(), *edge_notes, *_preview_note(options, film))):
            show_note(note)
        report = report_of_run(
            *(creature, simulation.trajectory, simulation.reports, simulation.frames),
            *(performance.sequence.done, energy),
            gaussians=GaussianCounts.of(creature, split=film.splats.count, drawn=film.drawn),
            drawing=film.milliseconds,
            source=options.source,
            notes=(*options.notes, *notes, *last_notes),
            seed=options.seed,
            asked=options.to_json(up=up, plane=plane),
            ending=replace(performance.ending, unsupported=ENDS_OUTSIDE_GROUND if coverage_warning else None),
            film=film.file,
            takes=takes,
        )
        report.write(run.file("report.json"))
        if not isinstance(out, RunFolder):
            run.finish()
    return report


def _requested(motion: Script | str, options: AnimateOptions) -> Script:
    """Return the script of ``animate``.

    Raises ``ArgumentError`` if targets are given together with a ``Script``, which has targets of its own.
    """
    given = {"beats": options.beats, **options.targets()}
    if isinstance(motion, str):
        return script(motion, **given)
    for name, value in given.items():
        if value is not None:
            raise ArgumentError(
                name, "the motion is a script, which contains its own targets; leave this argument out", value=value
            )
    return motion


def _preview_note(options: AnimateOptions, film: Film) -> tuple[str, ...]:
    """Return a note about the Gaussians that a preview leaves out."""
    if not options.preview:
        return ()
    width, height = options.picture_size
    return (
        f"preview: {film.drawn} of {film.splats.count} Gaussians at {width}x{height} pixels; egs-warp render draws"
        " the run in full",
    )


def _numbers(vector: Direction | None) -> tuple[float, ...] | None:
    return None if vector is None else tuple(map(float, direction_of(vector, "direction")))
