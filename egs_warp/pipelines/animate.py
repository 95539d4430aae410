"""The paper on one page: from a capture to a moving, rendered one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from egs_warp.contact.terrain import Solid
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.atomic import writable_folder
from egs_warp.locomotion.rollout import Simulation, simulate
from egs_warp.locomotion.stepper import LocomotionSettings
from egs_warp.locomotion.trajectory import audit, measure
from egs_warp.motions.repertoire import also_reached, check_possible, longest, parts_of
from egs_warp.motions.script import LARGEST_TARGET, LARGEST_TURN, parse_script
from egs_warp.motions.sequence import MotionSequence
from egs_warp.pipelines.creature import Creature, first_place, make_creature
from egs_warp.pipelines.film import Film, draw_film
from egs_warp.pipelines.report import build_report, motion_entry, qp_summary, timing_summary, write_report

LARGEST_SIZE = 4096
LARGEST_FRICTION = 10.0


@dataclass(frozen=True)
class AnimateOptions:
    """What a user may ask; lengths of targets are in body heights.
    Targets hold for motions that do not say their own.
    """

    distance: float | None = None
    height: float | None = None
    heading_degrees: float | None = None
    frames: int | None = None
    """None: until the last motion has come to rest."""
    size: int = 512
    """Pixels, both sides."""
    seed: int = 0
    """Written to the report; nothing in a jump is random, so it changes no result."""
    metres_per_unit: float | None = None
    """None: such that the body is 1 m tall."""
    friction: float = 0.8
    shadow: bool = True
    """On the ground, under the object."""

    def __post_init__(self) -> None:
        for name, value in (("distance", self.distance), ("height", self.height)):
            if value is not None and not (0.0 <= value <= LARGEST_TARGET):
                raise UserError(f"--{name} {value}: give a number of body heights from 0 to {LARGEST_TARGET:g}")
        if self.height == 0.0:
            raise UserError("--height 0: a jump needs a height above 0 body heights")
        turn = self.heading_degrees
        if turn is not None and not abs(turn) <= LARGEST_TURN:
            raise UserError(
                f"--heading-degrees {turn}: give a number of degrees from -{LARGEST_TURN:g} to {LARGEST_TURN:g}"
            )
        if self.frames is not None and self.frames < 1:
            raise UserError(f"--frames {self.frames}: give a whole number of at least 1")
        if not 16 <= self.size <= LARGEST_SIZE:
            raise UserError(f"--size {self.size}: give a number of pixels from 16 to {LARGEST_SIZE}")
        if not 0.0 <= self.friction <= LARGEST_FRICTION:
            raise UserError(f"--friction {self.friction}: give a Coulomb coefficient from 0 to {LARGEST_FRICTION:g}")
        if self.metres_per_unit is not None and not 1e-9 <= self.metres_per_unit <= 1e9:
            # Single precision holds no lengths far beyond; ``make_body`` says which of these fit the body.
            raise UserError(f"--metres-per-unit {self.metres_per_unit}: give a positive number, from 1e-9 to 1e9")

    def targets(self) -> dict[str, float | None]:
        """By the names that a script gives them."""
        return {"distance": self.distance, "height": self.height, "heading_degrees": self.heading_degrees}


def animate(
    cloud: GaussianCloud,
    out: Path | str,
    *,
    motion: str = "jump",
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    background: GaussianCloud | None = None,
    view_from: np.ndarray | None = None,
    muscles_file: Path | None = None,
    solids: tuple[Solid, ...] = (),
    gravity_up: np.ndarray | None = None,
    forward: np.ndarray | None = None,
    settings: LocomotionSettings | None = None,
    options: AnimateOptions | None = None,
    source: str = "capture",
    notes: tuple[str, ...] = (),
    quiet: bool = False,
) -> dict:
    """Bring ``cloud`` (scene units) to life and write video, contact sheet, report and trajectory into ``out``.

    ``motion``: one motion or several in a row, or the name of a JSON script (``egs_warp.motions.script``).
    ``background`` (scene units) is drawn behind the object instead of the plain floor; ``view_from`` (3,) points from
    the object to the camera. ``muscles_file``, ``solids``, ``gravity_up`` and ``settings``: see ``make_creature``;
    ``forward`` (3,): see ``first_place``. Returns the report (docs/report.md). Raises ``UserError`` for bad input,
    before any file of an earlier run is touched.
    """
    options = options or AnimateOptions()
    requests = parse_script(motion, defaults=options.targets())
    cut_off = longest(requests)
    folder = writable_folder(out)
    with tqdm(total=1, desc="prepare", unit="capture", disable=quiet) as bar:
        creature = make_creature(
            cloud,
            up=up,
            plane=plane,
            metres_per_unit=options.metres_per_unit,
            friction=options.friction,
            muscles_file=muscles_file,
            solids=solids,
            gravity_up=gravity_up,
            settings=settings,
        )
        bar.update()
    place = first_place(creature, forward)
    parts = parts_of(requests, creature.body.height)
    check_possible(parts, place)
    sequence = MotionSequence(place, parts)
    frames = options.frames or cut_off
    with tqdm(total=frames, desc="simulate", unit="frame", disable=quiet) as bar:
        simulation = simulate(
            creature.stepper,
            creature.geometry,
            creature.start,
            sequence,
            frames=frames,
            finished=lambda: options.frames is None and sequence.finished,
            progress=lambda _: bar.update(),
        )
    film = draw_film(
        creature,
        simulation,
        place.ground,
        folder,
        name=requests[0].name if len({request.name for request in requests}) == 1 else "motions",
        size=options.size,
        background=background,
        view_from=view_from,
        shadow=options.shadow,
        quiet=quiet,
    )
    report = _report(
        creature, simulation, sequence, film, seed=options.seed, source=source, notes=(*notes, *sequence.cut_short())
    )
    simulation.trajectory.placed(creature.frame).save(folder / "trajectory.npz")
    creature.cage.mesh.write_vtu(folder / "cage.vtu")
    write_report(folder / "report.json", report)
    return report


def _report(
    creature: Creature,
    simulation: Simulation,
    sequence: MotionSequence,
    film: Film,
    *,
    seed: int,
    source: str,
    notes: tuple[str, ...],
) -> dict:
    trajectory, reports = simulation.trajectory, simulation.reports
    mesh, count = creature.cage.mesh, creature.cloud.count
    spans = sequence.spans(trajectory.time)
    return build_report(
        motion=[
            motion_entry(
                entry.name,
                entry.asked,
                entry.motion.planned(),
                measure(trajectory, first=first, last=last),
                entry.motion.notes(),
                also_reached(entry.motion, trajectory, first, last),
            )
            for entry, (first, last) in zip(sequence.done, spans, strict=True)
        ],
        audit=audit(trajectory, newton_unconverged=sum(not report.converged for report in reports)),
        qp=qp_summary(reports, simulation.frames),
        timing=timing_summary(reports, simulation.frames, film.milliseconds),
        cage={
            "nodes": len(mesh.nodes),
            "tets": len(mesh.tets),
            "min_dihedral_degrees": mesh.min_dihedral_degrees(),
            "mass": creature.body.mass,
        },
        muscles={"fibres": creature.muscles.fibre_count, "segments": creature.muscles.segment_count},
        gaussians={
            "in": count,
            "split": film.gaussian_count - count,
            "out": film.gaussian_count,
            "left_out_of_contact": creature.geometry.left_out,
            "left_out_of_contact_opacity": creature.geometry.left_out_opacity,
        },
        device=str(creature.cloud.device),
        seed=seed,
        source=source,
        notes=notes,
    )
