"""End-to-end pipeline of a run: from a capture to its simulated and rendered motion."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.contact.terrain import Solid
from egs_warp.errors import ArgumentError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.io.atomic import atomic_write
from egs_warp.io.run_folder import RunFolder, run_folder
from egs_warp.io.video import ffmpeg_program
from egs_warp.locomotion.ledger import energy_balance
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.solvers import QpSolver
from egs_warp.motions.push import read_pushes
from egs_warp.motions.request import LARGEST_TARGET, LARGEST_TURN
from egs_warp.motions.script import motion as script
from egs_warp.pipelines import render_data
from egs_warp.pipelines.capture_warnings import capture_warnings
from egs_warp.pipelines.creature import make_creature
from egs_warp.pipelines.film import draw_film
from egs_warp.pipelines.finished_run import PARTS
from egs_warp.pipelines.ground_coverage import ground_coverage_warning
from egs_warp.pipelines.plots import draw_plots
from egs_warp.pipelines.progress import preparation_bar, simulation_bar
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.report import GaussianCounts, Report, report_of_run
from egs_warp.pipelines.shot import MAX_SIDE, MIN_SIDE, Shot
from egs_warp.pipelines.simulated_run import check_frames, simulate

MAX_FRICTION = 10.0


@dataclass(frozen=True)
class AnimateOptions:
    """Options of a run.

    The targets apply to motions that do not specify their own.
    """

    distance: float | None = None
    """Body heights; None is the default of the motion."""
    height: float | None = None
    """Body heights; None is the default of the motion."""
    heading_degrees: float | None = None
    """Degrees to the left; None is the default of the motion."""
    frames: int | None = None
    """Frames at 60 Hz, the first at rest; None runs until the last motion has come to rest."""
    size: int = 512
    """Width and height of the video, pixels."""
    seed: int = 0
    """Written to the report. No computation is random, so it changes no result."""
    metres_per_unit: float | None = None
    """Length of one unit of the capture, m; None makes the body 1 m tall."""
    friction: float = 0.8
    """Coulomb coefficient of the ground."""
    shadow: bool = True
    """Draw a shadow on the ground under the object."""
    get_up: bool = True
    """If the body falls, get up and continue."""

    def __post_init__(self) -> None:
        for name, value in (("distance", self.distance), ("height", self.height)):
            if value is not None and not (0.0 <= value <= LARGEST_TARGET):
                raise ArgumentError(name, f"give a number of body heights from 0 to {LARGEST_TARGET:g}", value=value)
        if self.height == 0.0:
            raise ArgumentError("height", "a jump needs a height above 0 body heights", value=0)
        turn = self.heading_degrees
        if turn is not None and not abs(turn) <= LARGEST_TURN:
            span = f"from -{LARGEST_TURN:g} to {LARGEST_TURN:g}"
            raise ArgumentError("heading_degrees", f"give a number of degrees {span}", value=turn)
        check_frames(self.frames)
        if not MIN_SIDE <= self.size <= MAX_SIDE:
            advice = f"give a number of pixels from {MIN_SIDE} to {MAX_SIDE}"
            raise ArgumentError("size", advice, value=self.size)
        if not 0.0 <= self.friction <= MAX_FRICTION:
            advice = f"give a Coulomb coefficient from 0 to {MAX_FRICTION:g}"
            raise ArgumentError("friction", advice, value=self.friction)
        if self.metres_per_unit is not None and not 1e-9 <= self.metres_per_unit <= 1e9:
            # Single precision does not represent other lengths; ``make_body`` checks which of these fit the body.
            advice = "give a positive number, from 1e-9 to 1e9"
            raise ArgumentError("metres_per_unit", advice, value=self.metres_per_unit)

    def targets(self) -> dict[str, float | None]:
        """Return the targets by the names that ``script`` uses."""
        return {"distance": self.distance, "height": self.height, "heading_degrees": self.heading_degrees}


@dataclass(frozen=True)
class RequestedOptions:
    """Requested options of a run besides the capture and the motion; frame and units of the capture."""

    options: AnimateOptions
    shot: Shot
    up: tuple[float, ...]
    plane: tuple[float, ...] | None
    """Unit normal nx, ny, nz and offset d."""
    view_from: tuple[float, ...]
    gravity_up: tuple[float, ...]
    front: tuple[float, ...]
    push: str | None
    beats: str | None
    style: str | None
    muscles: str | None
    """Name of the muscle file."""
    qp: str | None
    """Name of the QP solver."""
    solids: int
    """Number of solids beside the ground."""

    def to_json(self) -> dict[str, Any]:
        """Return ``asked`` of the report; options that were not given are null."""
        values = {
            name: value or None for name, value in vars(self).items() if name not in ("options", "shot", "solids")
        }
        return {**asdict(self.options), **self.shot.to_json(), **values, "solids": self.solids}


def animate(
    cloud: GaussianCloud,
    out: Path | str | RunFolder,
    *,
    motion: str = "jump",
    push: str | None = None,
    beats: str | None = None,
    style: str | None = None,
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    ground: HeightField | None = None,
    background: GaussianCloud | None = None,
    view_from: np.ndarray | None = None,
    muscles_file: Path | None = None,
    solids: tuple[Solid, ...] = (),
    gravity_up: np.ndarray | None = None,
    front: np.ndarray | None = None,
    seen_from: np.ndarray | None = None,
    settings: LocomotionSettings | None = None,
    options: AnimateOptions | None = None,
    shot: Shot | None = None,
    source: str = "capture",
    notes: tuple[str, ...] = (),
    overwrite: bool = False,
    resume: bool = False,
    quiet: bool = False,
) -> Report:
    """Bring ``cloud`` (scene units) to life and write video, contact sheet, plots, report and trajectory into ``out``.

    ``motion``: one motion or several in a row, or the name of a JSON script (``egs_warp.motions.script``).
    ``push``: what hits it meanwhile (``egs_warp.motions.push``); ``beats``: those of a dance, a tempo or a file;
    ``style``: how it jumps (``egs_warp.motions.style``).
    ``background`` (scene units) is drawn behind the object instead of the plain floor; ``view_from`` (3,) points from
    the object to the camera, of several (n, 3) the best is chosen; ``shot``: how it is filmed. ``ground``,
    ``muscles_file``, ``solids``, ``gravity_up``, ``front``, ``seen_from``, ``settings``: see ``make_creature``. Returns
    what it wrote as ``report.json`` (docs/guide/report.md). A folder belongs to one run (``egs_warp.io.run_folder``):
    one with an earlier run is refused, or that run moved aside (``overwrite``), or gone on with if it was cut off
    (``resume``): with the same arguments to the same bits. Raises ``UserError`` for bad input, before any file of an
    earlier run is touched.
    """
    options, shot = options or AnimateOptions(), shot or Shot()
    shot.check()
    requested_motion = script(motion, beats=beats, **options.targets())
    requested_motion.frames()  # Reads the files that the motions name.
    jump_style = requested_motion.style(style)
    pushes = read_pushes(push) if push is not None else ()
    ffmpeg_program()
    with run_folder(out, overwrite=overwrite, resume=resume) as run:
        with preparation_bar(quiet=quiet) as begin_stage:
            creature = make_creature(
                cloud,
                up=up,
                plane=plane,
                ground=ground,
                metres_per_unit=options.metres_per_unit,
                friction=options.friction,
                muscles_file=muscles_file,
                solids=solids,
                gravity_up=gravity_up,
                front=front,
                seen_from=seen_from,
                settings=settings,
                progress=begin_stage,
            )
        if front is None:
            notes = (*notes, creature.front.told(creature.frame))
        notes = (*notes, *capture_warnings(creature.cloud, creature.cage.mesh, creature.body.height))
        with simulation_bar(quiet=quiet) as show_progress:
            performance = simulate(
                creature,
                requested_motion,
                frames=options.frames,
                style=jump_style,
                pushes=pushes,
                get_up=options.get_up,
                parts=lambda: run.file(PARTS),
                resume=_recorded(run),
                progress=show_progress,
            )
        # Saved first: an error while rendering does not lose the simulation.
        performance.trajectory.save(run.file("trajectory.npz"))
        energy = energy_balance(performance.trajectory)
        draw_plots(run.file("plots.png"), performance.trajectory, energy)
        with atomic_write(run.file("cage.vtu")) as temporary:
            creature.cage.mesh.write_vtu(temporary)
        film = draw_film(
            performance,
            run,
            name=requested_motion.name,
            size=options.size,
            shot=shot,
            background=background,
            view_from=view_from,
            shadow=options.shadow,
            quiet=quiet,
        )
        render_data_of_run = RenderData.of(film.splats, film.camera, creature.muscles, performance.place.feet())
        render_data_of_run.save(run.file(render_data.FILE))
        requested = RequestedOptions(
            options,
            shot,
            up=_numbers(up),
            plane=None if plane is None else (*_numbers(plane.normal), plane.offset),
            view_from=_numbers(view_from if view_from is None or np.asarray(view_from).ndim == 1 else None),
            gravity_up=_numbers(gravity_up),
            front=_numbers(front),
            push=push,
            beats=beats,
            style=style,
            muscles=None if muscles_file is None else Path(muscles_file).name,
            qp=None if settings is None or settings.qp_solver is None else QpSolver(settings.qp_solver).value,
            solids=len(solids),
        )
        simulation = performance.simulation
        placed_background = creature.placed(background) if background is not None else None
        coverage_warning = ground_coverage_warning(
            simulation.trajectory.positions[-1], placed_background, creature.solids[0], creature.body.height
        )
        notes = (*notes, *performance.cut_short(), *coverage_warning)
        report = report_of_run(
            *(creature, simulation.trajectory, simulation.reports, simulation.frames),
            *(performance.sequence.done, energy),
            gaussians=GaussianCounts.of(creature, film.splats.count),
            drawing=film.milliseconds,
            source=source,
            notes=notes,
            seed=options.seed,
            asked=requested.to_json(),
            ending=performance.ending,
        )
        report.write(run.file("report.json"))
        if not isinstance(out, RunFolder):
            run.finish()
    return report


def _recorded(run: RunFolder) -> Path | None:
    """Return the folder with the finished steps of a resumed run; None if there are none."""
    folder = run.path / PARTS
    return folder if run.resumed and any(folder.glob("*.npz")) else None


def _numbers(vector: np.ndarray | None) -> tuple[float, ...]:
    return () if vector is None else tuple(float(x) for x in vector)
