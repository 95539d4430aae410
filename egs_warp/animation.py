"""The paper on one page: from a capture to a moving, rendered one."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from tqdm import tqdm

from egs_warp.base_plane import find_base_plane
from egs_warp.body import DEFAULT_SAG, BodyState, SoftBody, make_body
from egs_warp.cage import Cage, build_cage
from egs_warp.camera import Camera
from egs_warp.contact import ContactGeometry, contact_geometry
from egs_warp.deformation import Deformer
from egs_warp.embedding import embed_gaussians
from egs_warp.errors import UserError
from egs_warp.fibre_files import read_muscles
from egs_warp.gaussians import GaussianCloud
from egs_warp.io.atomic import writable_folder
from egs_warp.locomotion import LocomotionStepper
from egs_warp.muscles import MuscleSet, automatic_muscles
from egs_warp.plane import Plane
from egs_warp.render.ground import Behind, CapturedScene, Floor
from egs_warp.render.rasteriser import render
from egs_warp.render.video import VideoWriter, contact_sheet, write_png
from egs_warp.repertoire import also_reached, longest, parts_of
from egs_warp.report import build_report, motion_entry, qp_summary, timing_summary, write_report
from egs_warp.script import LARGEST_TARGET, LARGEST_TURN, parse_script
from egs_warp.sequence import MotionSequence, Place
from egs_warp.simulation import FRAME_RATE, Simulation, settle, simulate, steps_per_frame
from egs_warp.splitting import split_for_motion
from egs_warp.stance import Ground
from egs_warp.terrain import Solid
from egs_warp.trajectory import audit, measure

SHEET_FRAMES = 12
SPLIT_KEY_FRAMES = 24
SMALLEST_SAG = 0.004
"""A body is not made stiffer than this column's sag, whatever it bends."""


@dataclass(frozen=True)
class AnimateOptions:
    """What a user may ask; lengths of targets are in body heights. Targets hold for motions that do not say their own."""

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
        for name, value, least in (("frames", self.frames, 1), ("size", self.size, 16)):
            if value is not None and value < least:
                raise UserError(f"--{name} {value}: give a whole number of at least {least}")
        if self.metres_per_unit is not None and not (np.isfinite(self.metres_per_unit) and self.metres_per_unit > 0.0):
            raise UserError(f"--metres-per-unit {self.metres_per_unit}: give a positive number")


@dataclass(frozen=True)
class Creature:
    """A capture with a cage, a body, muscles and a ground, standing; metres."""

    cloud: GaussianCloud
    plane: Plane
    metres_per_unit: float
    cage: Cage
    stepper: LocomotionStepper
    """Body, muscles and contact."""
    start: BodyState
    """At rest on the ground."""
    solids: tuple[Solid, ...]
    """All that there is to stand on, the ground first."""

    @property
    def body(self) -> SoftBody:
        """The soft body."""
        return self.stepper.body

    @property
    def muscles(self) -> MuscleSet:
        """Its muscles."""
        return self.stepper.muscles

    @property
    def geometry(self) -> ContactGeometry:
        """Its contact points and planes."""
        return self.stepper.geometry


def make_creature(
    cloud: GaussianCloud,
    *,
    up: np.ndarray | None = None,
    plane: Plane | None = None,
    metres_per_unit: float | None = None,
    friction: float = 0.8,
    sag: float = DEFAULT_SAG,
    muscles_file: Path | None = None,
    solids: tuple[Solid, ...] = (),
    gravity_up: np.ndarray | None = None,
) -> Creature:
    """Give a capture (scene units) a body that stands on ``plane``, or on its own base, square to ``up`` (3,).

    ``muscles_file``: see ``body_muscles``. ``solids`` (scene units) are steps and walls beside the ground; ``gravity_up`` (3,) is
    against gravity if the ground is a slope.
    The body is as stiff as makes it sag by ``sag`` of its height; one that its weight would bend out of shape is made stiffer.
    """
    if plane is None:
        if up is None:
            raise UserError("animate: neither up nor a plane is known; give --up or --plane")
        plane = find_base_plane(cloud, up)
    device = str(cloud.device)
    cage = build_cage(cloud, plane)
    scale = metres_per_unit or 1.0 / cage.height(plane)
    cloud, plane, cage = cloud.scaled(scale), plane.scaled(scale), cage.scaled(scale)
    solids = tuple(solid.scaled(scale) for solid in solids)
    geometry = contact_geometry(cloud, cage.mesh, (plane,), solids=solids, friction=friction, device=device)
    while True:
        body = make_body(cage.mesh, plane, up=gravity_up, sag=sag, device=device)
        muscles = body_muscles(body, plane, muscles_file, metres_per_unit=scale)
        stepper = LocomotionStepper(body, muscles, geometry, device=device)
        start = settle(stepper)
        if sag < SMALLEST_SAG or _stands(stepper, start):
            return Creature(cloud, plane, scale, cage, stepper, start, (Solid((plane,)), *solids))
        sag *= 0.5


def body_muscles(body: SoftBody, plane: Plane, file: Path | None, *, metres_per_unit: float) -> MuscleSet:
    """The muscles that ``file`` (JSON, ``egs_warp.fibre_files``) gives a body on ``plane``; without one, automatic ones."""
    if file is not None:
        return read_muscles(file, body.mesh, body_weight=body.weight, metres_per_unit=metres_per_unit)
    return automatic_muscles(
        body.mesh,
        plane.normal,
        body_weight=body.weight,
        height=body.height,
        strength=4.0 * body.stiffening,
        young_modulus=body.young_modulus,
    )


def _stands(stepper: LocomotionStepper, start: BodyState) -> bool:
    body = stepper.body
    moved = body.centre_of_mass(start.positions) - body.centre_of_mass(body.mesh.nodes)
    turn = body.best_fit_rotation(start.positions)
    gaps, _ = stepper.detector.gaps(start.positions)
    upright = np.trace(turn) > 1.0 + 2.0 * np.cos(np.radians(10.0))
    return bool(np.linalg.norm(moved) < 0.04 * body.height and upright and gaps.min() > -0.01 * body.height)


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
    options: AnimateOptions | None = None,
    source: str = "capture",
    notes: tuple[str, ...] = (),
    quiet: bool = False,
) -> dict:
    """Bring ``cloud`` (scene units) to life and write video, contact sheet, report and trajectory into ``out``.

    ``motion``: one motion or several in a row, or the name of a JSON script (``egs_warp.script``). ``background`` (scene
    units) is drawn behind the object instead of the plain floor; ``view_from`` (3,) points from the object to the camera.
    ``muscles_file``, ``solids`` and ``gravity_up``: see ``make_creature``; ``forward`` (3,): see ``first_place``. Returns the report
    (docs/report.md). Raises ``UserError`` for bad input, before any file of an earlier run is touched.
    """
    options = options or AnimateOptions()
    flags = {"distance": options.distance, "height": options.height, "heading_degrees": options.heading_degrees}
    requests = parse_script(motion, defaults=flags)
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
        )
        bar.update()
    place = first_place(creature, forward)
    sequence = MotionSequence(place, parts_of(requests, creature.body.height))
    frames = options.frames or cut_off
    with tqdm(total=frames, desc="simulate", unit="frame", disable=quiet) as bar:
        simulation = simulate(
            creature.stepper,
            creature.geometry,
            creature.start,
            sequence,
            frames=frames,
            finished=lambda: options.frames is None and sequence.finished,
            progress=lambda _: (bar.update(), None)[1],
        )
    name = requests[0].name if len({request.name for request in requests}) == 1 else "motions"
    drawing, split_count = _draw(
        creature, simulation, place.ground, folder, name, options, background, view_from, quiet
    )
    unconverged = sum(not report.converged for report in simulation.reports)
    report = build_report(
        motion=[
            motion_entry(
                entry.name,
                entry.asked,
                entry.motion.planned(),
                measure(simulation.trajectory, first=first, last=last),
                entry.motion.notes(),
                also_reached(entry.motion, simulation.trajectory, first, last),
            )
            for entry, (first, last) in zip(sequence.done, sequence.spans(simulation.trajectory.time), strict=True)
        ],
        audit=audit(simulation.trajectory, newton_unconverged=unconverged),
        qp=qp_summary(simulation.reports, simulation.frames),
        timing=timing_summary(simulation.reports, simulation.frames, drawing),
        cage={
            "nodes": len(creature.cage.mesh.nodes),
            "tets": len(creature.cage.mesh.tets),
            "min_dihedral_degrees": creature.cage.mesh.min_dihedral_degrees(),
            "mass": creature.body.mass,
        },
        muscles={"fibres": creature.muscles.fibre_count, "segments": creature.muscles.segment_count},
        gaussians={
            "in": cloud.count,
            "split": split_count,
            "out": cloud.count + split_count,
            "left_out_of_contact": creature.geometry.left_out,
            "left_out_of_contact_opacity": creature.geometry.left_out_opacity,
        },
        device=str(creature.cloud.device),
        seed=options.seed,
        source=source,
        notes=notes,
    )
    simulation.trajectory.save(folder / "trajectory.npz")
    creature.cage.mesh.write_vtu(folder / "cage.vtu")
    write_report(folder / "report.json", report)
    return report


def first_place(creature: Creature, forward: np.ndarray | None = None, *, step: float | None = None) -> Place:
    """Where the creature stands at the start; ``forward`` (3,) is the way of its motions, else the long axis of its footprint.

    ``step``: seconds of a solver step, if not the usual (DESIGN 4).
    """
    body, start = creature.body, creature.start
    up = -body.gravity / np.linalg.norm(body.gravity)
    if forward is None:
        forward = _forward(creature)
    if np.linalg.norm(np.cross(forward, up)) < 1e-3 * np.linalg.norm(forward):
        raise UserError(
            f"--forward {','.join(f'{x:g}' for x in forward)}: points up or down; give a way along the ground"
        )
    return Place(
        body,
        Ground.on(creature.plane, forward, body.centre_of_mass(start.positions), up=up),
        start.positions,
        creature.stepper.detector.points_within(start.positions, 0.01 * body.height),
        step or 1.0 / (FRAME_RATE * steps_per_frame(body)),
        creature.solids,
        creature.geometry.friction,
    )


def _forward(creature: Creature) -> np.ndarray:
    """(3,) the long axis of the footprint: the direction in which the body is least likely to tip."""
    local = creature.cage.mesh.nodes
    sole = local[creature.plane.heights(local) < 0.06 * creature.body.height]
    first, second = creature.plane.tangents()
    flat = np.stack([(sole - sole.mean(axis=0)) @ first, (sole - sole.mean(axis=0)) @ second], axis=1)
    values, vectors = np.linalg.eigh(flat.T @ flat)
    axis = vectors[:, 1] if values[1] > 1.2 * values[0] else np.array([1.0, 0.0])
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return axis[0] * first + axis[1] * second


def view_of(simulation: Simulation, ground: Ground, size: int, view_from: np.ndarray | None = None) -> Camera:
    """A fixed camera that holds the whole motion: in front of the jump's side, or in the direction ``view_from`` (3,)."""
    local = ground.local(simulation.trajectory.positions).reshape(-1, 3)
    low, high = local.min(axis=0), local.max(axis=0)
    low[2] = min(low[2], 0.0)
    middle = 0.5 * (low + high)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    direction = np.array([0.35, -1.0, 0.22]) if view_from is None else ground.axes @ np.asarray(view_from, float)
    direction /= np.linalg.norm(direction)
    world = lambda point: ground.origin + point @ ground.axes  # noqa: E731
    distance = float(np.linalg.norm(high - low))
    for _ in range(60):
        camera = Camera.look_at(
            world(middle + distance * direction),
            world(middle),
            ground.axes[2],
            width=size,
            height=size,
            vertical_fov_degrees=30.0,
            near=0.01 * distance,
        )
        seen = world(corners) @ camera.rotation.T + camera.translation
        reach = np.abs(seen[:, :2] / seen[:, 2:]).max() * camera.fx / (0.5 * size)
        if seen[:, 2].min() > 0 and reach < 0.86:
            break
        distance *= 1.05
    return camera


def _draw(
    creature, simulation, ground, folder, motion, options, background, view_from, quiet
) -> tuple[dict[str, list[float]], int]:
    trajectory = simulation.trajectory
    camera = view_of(simulation, ground, options.size, view_from)
    device = creature.cloud.device
    height = creature.body.height
    path = np.einsum("n,fni->fi", trajectory.node_mass, trajectory.positions) / trajectory.node_mass.sum()
    com = path.mean(axis=0)
    where = {
        "centre": com - creature.plane.heights(com) * creature.plane.normal,
        "reach": 2.2 * (height + float(np.linalg.norm(np.ptp(path, axis=0)))),
        "shadow": options.shadow,
    }
    behind: Behind = (
        Floor(camera, creature.plane, cell=0.25 * height, **where)
        if background is None
        else CapturedScene(background.scaled(creature.metres_per_unit), camera, creature.plane, **where)
    )
    # The whole motion is known, so what it will bend is split before the first frame, and nothing can pop.
    started = time.perf_counter()
    keys = simulation.frames[:: max(1, len(simulation.frames) // SPLIT_KEY_FRAMES)]
    split = split_for_motion(
        creature.cloud,
        embed_gaussians(creature.cloud, creature.cage.mesh),
        [trajectory.positions[step] for step in keys],
    )
    milliseconds: dict[str, list[float]] = {"deform": [], "render": [], "encode": []}
    splitting = 1e3 * (time.perf_counter() - started)
    cloud, deformer = split.cloud, Deformer(split.cloud, split.embedding)
    kept: list[np.ndarray] = []
    wanted = np.unique(np.linspace(0, len(simulation.frames) - 1, SHEET_FRAMES).round().astype(int))
    with (
        VideoWriter(folder / f"{motion}.mp4", options.size, options.size) as video,
        tqdm(total=len(simulation.frames), desc="render", unit="frame", disable=quiet) as bar,
    ):
        for index, step in enumerate(simulation.frames):
            marks = [time.perf_counter()]
            deformed = deformer.deform(trajectory.positions[step])
            marks.append(time.perf_counter())
            backdrop = behind.background(deformed.cloud, height=height)
            image = render(deformed.cloud, camera, background=backdrop).colour_srgb8()
            wp.synchronize_device(device)
            marks.append(time.perf_counter())
            video.write(image)
            if index in wanted:
                kept.append(image)
            marks.append(time.perf_counter())
            for stage, spent in zip(milliseconds, np.diff(marks), strict=True):
                milliseconds[stage].append(1e3 * float(spent))
            bar.update()
    labels = [f"{trajectory.time[simulation.frames[i]]:.2f} s" for i in wanted]
    write_png(folder / "sheet.png", contact_sheet(kept, 4, labels))
    milliseconds["split"] = [splitting / len(simulation.frames)]
    return milliseconds, cloud.count - creature.cloud.count


def summary(report: dict) -> str:
    """A few lines for the terminal."""
    lines = []
    for entry in report["motion"]:
        reached, asked = entry["reached"], entry["asked"]
        pairs = [
            f"{name} {reached[name]:.3f} of {asked[name]:g}" if name in asked else f"{name} {reached[name]:.3f}"
            for name in ("distance", "height", "heading_degrees")
        ]
        lines.append(
            f"{entry['name']}: {', '.join(pairs)}, tilt {reached['tilt_degrees']:.1f} degrees, "
            f"airborne {reached['airborne_frames']:.0f} frames (lengths in body heights)"
        )
        lines += [f"note: {note}" for note in entry["notes"]]
    lines.append("audit: " + ", ".join(f"{name} {value:.2g}" for name, value in report["audit"].items()))
    return "\n".join([*lines, *(f"note: {note}" for note in report["notes"])])


def as_options(**values: Any) -> AnimateOptions:
    """Options from keyword values, ignoring those that are None."""
    known = asdict(AnimateOptions())
    return AnimateOptions(**{name: value for name, value in values.items() if value is not None and name in known})
