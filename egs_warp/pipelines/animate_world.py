"""Results of a simulated world: one film, and a trajectory and a report for each body."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from egs_warp.contact.detection import ContactDetector
from egs_warp.contact.terrain import Solid, Surface
from egs_warp.geometry.body_frame import GROUND
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.run_folder import ANIMATE_WORLD, RunFolder, run_folder
from egs_warp.locomotion.world_audit import WorldAudit, audit_world
from egs_warp.motions.stance import REST_SPEED
from egs_warp.notes import prefixed
from egs_warp.pipelines import render_data
from egs_warp.pipelines.finished_run import PARTS
from egs_warp.pipelines.finished_world import SHAPE, scene_facts
from egs_warp.pipelines.ground_coverage import ENDS_OUTSIDE_GROUND, ground_coverage_warning, overhang_note
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.report import AUDIT_LIMITS, JsonValue, Report, write_report
from egs_warp.pipelines.shot import Shot
from egs_warp.pipelines.simulated_run import BodyResult, SimulatedRun, report_of_body
from egs_warp.pipelines.world_film import FilmedWorld, draw_world_film, world_camera
from egs_warp.pipelines.world_report import Penetration, WorldReport
from egs_warp.pipelines.world_run import WorldRun

_SAME_GAP = 1e-6
"""Difference of two equal gaps, in body heights."""


def write_world(
    run: WorldRun,
    out: Path | str | RunFolder,
    *,
    film: bool = True,
    shot: Shot | None = None,
    size: int = 512,
    view_from: Sequence[float] | np.ndarray | None = None,
    shadow: bool = True,
    overwrite: bool = False,
    quiet: bool = False,
    notes: Sequence[str] = (),
    asked: Mapping[str, JsonValue] | None = None,
    show_note: Callable[[str], object] = lambda note: None,
) -> WorldReport:
    """Write the film and the report of a simulated world, and for each body a folder with its trajectory and report.

    Args:
        run: The simulated world (``simulate``).
        out: Folder for the results.
        film: True to write the film.
        shot: Camera, size, frame rate and background colour of the film.
        size: Width and height of the film, pixels, if ``shot`` has no size.
        view_from: (3,) Direction to the camera in the axes of the world; None chooses it (``world_camera``).
        shadow: True to draw the shadows of the bodies.
        overwrite: True to move the files of an earlier run in ``out`` aside.
        quiet: True to show no progress bar.
        notes: Notes for the report.
        asked: Contents of the world file and options of the run, for the report.
        show_note: Called with each note on a motion or a push that did not take place.

    Raises:
        UserError: The folder cannot be written.
    """
    with run_folder(out, command=ANIMATE_WORLD, overwrite=overwrite) as folder:
        reports: dict[str, Report] = {}
        results: dict[str, str] = {}
        for name, result in run.bodies.items():
            # Save the trajectories first, so that an error while rendering does not lose the simulation.
            place = folder.folder(name)
            place.mkdir(exist_ok=True)
            result.trajectory.save(place / "trajectory.npz")
            unfinished = result.unfinished_note() if isinstance(result, SimulatedRun) else []
            for note in unfinished:
                show_note(prefixed(name, note))
            ended_over = _end_of(run, result)
            start = result.simulation.trajectory.positions[0]
            coverage_warning = ground_coverage_warning(*ended_over, start=start)
            edge_notes = (*coverage_warning, *overhang_note(*ended_over, start=start))
            for note in edge_notes:
                show_note(prefixed(name, note))
            report = reports[name] = report_of_body(
                result,
                notes=[*unfinished, *edge_notes],
                unsupported=ENDS_OUTSIDE_GROUND if coverage_warning else None,
            )
            results[name] = report.summary().splitlines()[0] if report.motion else displacement_text(result)
            report.write(place / "report.json")
        filmed = FilmedWorld.from_run(run)
        shot = shot or Shot()
        camera = world_camera(run, filmed, shot.size or (size, size), view_from)
        for name, body in filmed.bodies.items():
            result = run.bodies[name]
            body.shape.save(folder.path / name / SHAPE)
            feet = result.place.feet() if isinstance(result, SimulatedRun) else ()
            render_data_of_body = RenderData.of(body.deformer.rest, camera, result.body.muscles, feet)
            render_data_of_body.save(folder.path / name / render_data.FILE, deformer=body.deformer)
        shapes = [body.shape for body in filmed.bodies.values()]
        joints = [joint.point_joint for joint in run.world.joints]
        self_contact = [index for index, member in enumerate(run.world.members) if member.self_contact]
        trajectories = [result.simulation.trajectory for result in run.results]
        frictions = run.world.frictions
        audit = audit_world(trajectories, shapes, frictions=frictions, joints=joints, self_contact=self_contact)
        video = draw_world_film(filmed, camera, folder, shot=shot, shadow=shadow, quiet=quiet) if film else None
        scene = scene_facts(run.world)
        drawn_with: dict[str, JsonValue] = {"size": [camera.width, camera.height], "shadow": shadow, **shot.to_json()}
        whole = WorldReport(
            *(reports, results, audit, run.stopped, video, tuple(notes), asked or {}),
            video=drawn_with if film else None,
            scene=scene,
            penetrations=_penetrations(run, reports, audit),
        )
        write_report(folder.file("report.json"), whole.to_json())
        for name in run.bodies:
            shutil.rmtree(folder.path / name / PARTS, ignore_errors=True)
        if not isinstance(out, RunFolder):
            folder.finish()
    return whole


def _end_of(run: WorldRun, result: BodyResult) -> tuple[np.ndarray, GaussianCloud | None, Surface, float]:
    """Return the first four arguments of ``ground_coverage_warning`` for a body of a world at the end of its run."""
    surroundings = run.world.surroundings
    return (
        result.simulation.trajectory.positions[-1],
        None if surroundings is None else surroundings.cloud,
        run.world.ground or Solid((GROUND,)),
        result.body.body.height,
    )


def _penetrations(run: WorldRun, reports: Mapping[str, Report], audit: WorldAudit) -> dict[str, Penetration]:
    """Return the deepest penetration of each body for which it exceeds the limit. It is between two bodies if the gap
    to the ground and to obstacles is larger in this state; the other body is the one whose pair with this body has the
    largest penetration in ``audit``, and there is none if this is the pair of the body with itself."""
    found = {}
    names, heights = list(run.bodies), [result.trajectory.height for result in run.bodies.values()]
    for name, report in reports.items():
        if report.audit.penetration <= AUDIT_LIMITS["penetration"]:
            continue
        t, geometry = run.bodies[name].trajectory, run.bodies[name].body.geometry
        state = int(t.min_gap.argmin())
        gap, time, bodies = float(t.min_gap[state]), float(t.time[state]), (name,)
        if ContactDetector(geometry).gaps(t.positions[state])[0].min() > gap + _SAME_GAP * t.height:
            depths = {
                pair.bodies: pair.penetration * min(heights[k] for k in pair.bodies)
                for pair in audit.pairs
                if names.index(name) in pair.bodies and pair.penetration > 0.0
            }
            deepest = max(depths, key=lambda pair: depths[pair], default=())
            bodies = (name, *(names[k] for k in deepest if names[k] != name))
        found[name] = Penetration(bodies, time, -gap)
    return found


def displacement_text(result: BodyResult) -> str:
    """Return one line about the motion of a body: the displacement of its centre of mass, and its tilt at the end."""
    t, body = result.simulation.trajectory, result.body.body
    moved = body.centre_of_mass(t.positions[-1]) - body.centre_of_mass(t.positions[0])
    turn = body.best_fit_rotation(t.positions[-1]) @ body.best_fit_rotation(t.positions[0]).T
    tilt = np.degrees(np.arccos(np.clip(turn[2, 2], -1.0, 1.0)))
    speed = float(np.linalg.norm(t.velocities[-1], axis=1).max())
    rest = "at rest" if speed < REST_SPEED * body.speed_unit else f"still moving at {speed:.2g} m/s"
    return f"moved by {np.hypot(*moved[:2]):.2f} m, tilted by {tilt:.0f} degrees, {rest}"
