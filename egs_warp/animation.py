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
from egs_warp.gaussians import GaussianCloud
from egs_warp.io.atomic import writable_folder
from egs_warp.locomotion import LocomotionStepper
from egs_warp.motions import Jump, JumpTarget
from egs_warp.muscles import MuscleSet, automatic_muscles
from egs_warp.plane import Plane
from egs_warp.render.ground import Floor
from egs_warp.render.rasteriser import render
from egs_warp.render.video import VideoWriter, contact_sheet, write_png
from egs_warp.report import build_report, motion_entry, qp_summary, timing_summary, write_report
from egs_warp.simulation import FRAME_RATE, Simulation, settle, simulate, steps_per_frame
from egs_warp.splitting import split_for_motion
from egs_warp.stance import Ground
from egs_warp.trajectory import audit, measure

SHEET_FRAMES = 12
SPLIT_KEY_FRAMES = 24
SMALLEST_SAG = 0.004
"""A body is not made stiffer than this column's sag, whatever it bends."""
LARGEST_TARGET = 10.0
"""Body heights; a larger target is refused as a slip of the pen."""


@dataclass(frozen=True)
class AnimateOptions:
    """What a user may ask; lengths of targets are in body heights."""

    distance: float = 0.5
    height: float = 0.2
    frames: int = 120
    size: int = 512
    """Pixels, both sides."""
    seed: int = 0
    """Written to the report; nothing in a jump is random, so it changes no result."""
    metres_per_unit: float | None = None
    """None: such that the body is 1 m tall."""
    friction: float = 0.8

    def __post_init__(self) -> None:
        for name, value in (("distance", self.distance), ("height", self.height)):
            if not np.isfinite(value) or value < 0.0 or value > LARGEST_TARGET:
                raise UserError(f"--{name} {value}: give a number of body heights from 0 to {LARGEST_TARGET:g}")
        if self.height == 0.0:
            raise UserError("--height 0: a jump needs a height above 0 body heights")
        for name, value, least in (("frames", self.frames, 1), ("size", self.size, 16)):
            if value < least:
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
) -> Creature:
    """Give a capture (scene units) a body that stands on ``plane``, or on its own base, square to ``up`` (3,).

    A body that its own weight would bend out of shape is made stiffer until it stands.
    """
    if plane is None:
        if up is None:
            raise UserError("animate: neither up nor a plane is known; give --up or --plane")
        plane = find_base_plane(cloud, up)
    device = str(cloud.device)
    cage = build_cage(cloud, plane)
    scale = metres_per_unit or 1.0 / cage.height(plane)
    cloud, plane, cage = cloud.scaled(scale), plane.scaled(scale), cage.scaled(scale)
    geometry = contact_geometry(cloud, cage.mesh, (plane,), friction=friction, device=device)
    sag = DEFAULT_SAG
    while True:
        body = make_body(cage.mesh, plane, sag=sag, device=device)
        muscles = automatic_muscles(
            cage.mesh,
            plane.normal,
            body_weight=body.weight,
            height=body.height,
            strength=4.0 * body.stiffening,
            young_modulus=body.young_modulus,
        )
        stepper = LocomotionStepper(body, muscles, geometry, device=device)
        start = settle(stepper)
        if sag < SMALLEST_SAG or _stands(stepper, start):
            return Creature(cloud, plane, scale, cage, stepper, start)
        sag *= 0.5


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
    options: AnimateOptions | None = None,
    source: str = "capture",
    notes: tuple[str, ...] = (),
    quiet: bool = False,
) -> dict:
    """Bring ``cloud`` (scene units) to life and write video, contact sheet, report and trajectory into ``out``.

    ``background`` is drawn behind the object instead of the plain floor. Returns the report (docs/report.md).
    Raises ``UserError`` for bad input, before any file of an earlier run is touched.
    """
    if motion != "jump":
        raise UserError(f"--motion {motion}: known motions are: jump")
    options = options or AnimateOptions()
    folder = writable_folder(out)
    with tqdm(total=1, desc="prepare", unit="capture", disable=quiet) as bar:
        creature = make_creature(
            cloud, up=up, plane=plane, metres_per_unit=options.metres_per_unit, friction=options.friction
        )
        bar.update()
        stepper, start = creature.stepper, creature.start
    ground = Ground.on(creature.plane, _forward(creature), creature.body.centre_of_mass(start.positions))
    height = creature.body.height
    jump = Jump(
        creature.body,
        ground,
        start.positions,
        JumpTarget(options.distance * height, options.height * height),
        touching=stepper.detector.points_within(start.positions, 0.01 * height),
        step=1.0 / (FRAME_RATE * steps_per_frame(creature.body)),
    )
    with tqdm(total=options.frames, desc="simulate", unit="frame", disable=quiet) as bar:
        simulation = simulate(
            stepper, creature.geometry, start, jump, frames=options.frames, progress=lambda _: (bar.update(), None)[1]
        )
    drawing, split_count = _draw(creature, simulation, ground, folder, motion, options, background, quiet)
    reached = measure(simulation.trajectory)
    unconverged = sum(not report.converged for report in simulation.reports)
    report = build_report(
        motion=[
            motion_entry(
                motion,
                {"distance": options.distance, "height": options.height},
                jump.planned(),
                reached,
                jump.notes(),
            )
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


def view_of(simulation: Simulation, ground: Ground, size: int) -> Camera:
    """A fixed camera in front of the jump's side that holds the whole motion."""
    local = ground.local(simulation.trajectory.positions).reshape(-1, 3)
    low, high = local.min(axis=0), local.max(axis=0)
    low[2] = min(low[2], 0.0)
    middle = 0.5 * (low + high)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    direction = np.array([0.35, -1.0, 0.22])
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
    creature, simulation, ground, folder, motion, options, background, quiet
) -> tuple[dict[str, list[float]], int]:
    trajectory = simulation.trajectory
    camera = view_of(simulation, ground, options.size)
    device = creature.cloud.device
    height = creature.body.height
    com = trajectory.node_mass @ trajectory.positions[:, :, :].mean(axis=0) / trajectory.node_mass.sum()
    floor = Floor(
        camera,
        creature.plane,
        centre=com - creature.plane.heights(com) * creature.plane.normal,
        reach=2.2 * height * (1.0 + options.distance),
        cell=0.25 * height,
    )
    behind = render(background.scaled(creature.metres_per_unit), camera) if background is not None else None
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
            means = deformed.cloud.means.numpy()
            backdrop = (
                behind.colour if behind is not None else floor.background(means, cloud.opacities(), height=height)
            )
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
    entry = report["motion"][0]
    reached, asked = entry["reached"], entry["asked"]
    return (
        f"{entry['name']}: distance {reached['distance']:.3f} of {asked['distance']:g}, "
        f"height {reached['height']:.3f} of {asked['height']:g} body heights, "
        f"tilt {reached['tilt_degrees']:.1f} degrees, airborne {reached['airborne_frames']:.0f} frames\n"
        + "audit: "
        + ", ".join(f"{name} {value:.2g}" for name, value in report["audit"].items())
        + "".join(f"\nnote: {note}" for note in (*entry["notes"], *report["notes"]))
    )


def as_options(**values: Any) -> AnimateOptions:
    """Options from keyword values, ignoring those that are None."""
    known = asdict(AnimateOptions())
    return AnimateOptions(**{name: value for name, value in values.items() if value is not None and name in known})
