"""Finished runs of worlds, read from their folders."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from egs_warp.contact.terrain import Solid
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io.capture import read_capture
from egs_warp.io.run_folder import check_finished
from egs_warp.io.text import parse_json, read_text
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.locomotion.world_audit import ContactShape
from egs_warp.pipelines.finished_run import FinishedRun, checked_frame
from egs_warp.pipelines.report import JsonValue
from egs_warp.pipelines.world import World
from egs_warp.pipelines.world_film import FilmedBody, FilmedWorld
from egs_warp.short_repr import short_repr

SHAPE = "contact_shape.npz"
"""Name of the file with the contact points and the level set of a body, in the folder of the body."""


def is_world_folder(folder: Path) -> bool:
    """Return True if ``folder`` contains the finished run of a world."""
    path = folder / "report.json"
    if not path.is_file():
        return False
    report = parse_json(read_text(path), path)
    return isinstance(report, dict) and isinstance(report.get("bodies"), dict)


@dataclass(frozen=True)
class FinishedWorld:
    """Contents of the folder of a finished run of a world."""

    __repr__ = short_repr

    folder: Path
    bodies: Mapping[str, FinishedRun]
    """Run of each body by its name, in the order of the world; each run is in the frame of its body."""
    shapes: Mapping[str, ContactShape]
    """Contact points and level set of each body."""
    report: Mapping[str, Any]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the ``folder`` of the run of a world. Raises ``UserError`` if it has no finished run of a world."""
        check_finished(folder)
        path = folder / "report.json"
        report = parse_json(read_text(path), path)
        names = report.get("bodies") if isinstance(report, dict) else None
        if not isinstance(names, dict) or not names or any(Path(name).name != name for name in names):
            raise UserError(f"{path}: is not the report of a world; run egs-warp animate again to write it")
        bodies = {name: FinishedRun.read(folder / name) for name in names}
        shapes = {name: ContactShape.load(folder / name / SHAPE) for name in names}
        for name, run in bodies.items():
            t, shape = run.trajectory, shapes[name]
            if len(shape.rest_positions) != len(t.rest_positions) or shape.point_tets.max(initial=0) >= len(t.tets):
                advice = "run egs-warp animate again to write both"
                raise UserError(f"{folder / name / SHAPE}: does not belong to the cage of trajectory.npz; {advice}")
        return cls(folder, bodies, shapes, report)

    @property
    def title(self) -> str:
        """Names of the bodies."""
        return " \u00b7 ".join(self.bodies)

    @property
    def first(self) -> FinishedRun:
        """Run of the first body."""
        return next(iter(self.bodies.values()))

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """Trajectories of all bodies."""
        return tuple(run.trajectory for run in self.bodies.values())

    @property
    def camera(self) -> Camera:
        """Camera of the film."""
        return self.first.creature.camera

    @property
    def frame_count(self) -> int:
        """Number of frames at 60 Hz."""
        # The step sizes of the bodies may be halved differently, so their last times may differ by rounding.
        return min(run.frame_count for run in self.bodies.values())

    def frame_number(self, frame: int, *, argument: str) -> int:
        """Return the number of ``frame``; see ``FinishedRun.frame_number``."""
        return checked_frame(frame, self.frame_count, argument=argument)

    @property
    def capture_frame(self) -> BodyFrame:
        """Frame of exported splats, which is the frame of the world, in metres."""
        return BodyFrame(np.eye(3), np.zeros(3), 1.0)

    @property
    def antialiased(self) -> bool:
        """True if any of the captures was trained with antialiasing."""
        return any(run.antialiased for run in self.bodies.values())

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """Obstacles, without the ground."""
        t = self.first.trajectory
        groups = t.solid_from_plane
        planes = [Plane(row[:3], float(row[3])) for row in t.planes]
        return tuple(
            Solid(tuple(planes[index] for index in np.flatnonzero(groups == solid)))
            for solid in range(1, int(groups.max(initial=0)) + 1)
        )

    @cached_property
    def scene(self) -> GaussianCloud | None:
        """Captured scene behind the bodies (``background.ply``), in the frame of the world; None if there is none."""
        file, facts = self.folder / "background.ply", self.report.get("scene")
        if facts is None or not file.is_file():
            return None
        try:
            frame = BodyFrame(np.array(facts["axes"]), np.array(facts["origin"]), float(facts["metres_per_unit"]))
        except (KeyError, TypeError, ValueError) as error:
            path = self.folder / "report.json"
            raise UserError(f"{path}: its scene is invalid; run egs-warp animate again to write it") from error
        return to_body_frame(read_capture(file).cloud, frame)

    @cached_property
    def filmed(self) -> FilmedWorld:
        """The bodies, ready to be drawn. A captured scene already shows its own obstacles, so only additional obstacles
        are drawn."""
        count = self.frame_count
        solids = self.solids if self.scene is None else self.solids[: int(self.report["scene"]["drawn_obstacles"])]
        bodies = {
            name: FilmedBody(run.deformer(), run.trajectory, run.steps[:count], self.shapes[name])
            for name, run in self.bodies.items()
        }
        return FilmedWorld(bodies, solids, self.scene, self.first.trajectory.ground_coefficients.size == 0)

    def splats_of(self) -> Callable[[int], GaussianCloud]:
        """Return the function that computes the splats of all bodies in a frame; each call overwrites the last
        result."""
        filmed = self.filmed
        deformer = filmed.joint_deformer()
        return lambda frame: deformer.deform(filmed.poses(frame)).cloud


def scene_facts(world: World) -> dict[str, JsonValue] | None:
    """Return the facts of the report with which ``FinishedWorld.scene`` places the scene of a world; None for a world
    without a scene."""
    if world.surroundings is None:
        return None
    frame = world.surroundings.frame
    return {
        "axes": frame.axes.tolist(),
        "origin": frame.origin.tolist(),
        "metres_per_unit": float(frame.scale),
        "drawn_obstacles": len(world.solids),
    }


def read_finished(folder: Path, *, background: Path | None = None) -> FinishedRun | FinishedWorld:
    """Read the finished run of a single capture or of a world. Raises ``UserError`` if ``folder`` contains
    neither."""
    if not is_world_folder(folder):
        return FinishedRun.read(folder, background=background)
    check_no_background(background)
    return FinishedWorld.read(folder)


def check_no_background(background: Path | None) -> None:
    """Raise ``ArgumentError`` if a background is given for the run of a world."""
    if background is not None:
        raise ArgumentError(
            "background", "a scene behind the body is for the run of a single capture; leave it out", value=background
        )
