"""Finished runs, read from their folders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.arrays import READ_ERRORS
from egs_warp.io.capture import read_capture
from egs_warp.io.run_folder import check_finished
from egs_warp.io.text import parse_json, read_text
from egs_warp.lighting.remaining_shadow import without_shadow
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.locomotion.trajectory_validation import check_trajectory
from egs_warp.pipelines import render_data
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.shot import nearest_steps
from egs_warp.short_repr import short_repr

BACKGROUND = "background.ply"
"""Gaussians behind the creature, in the frame and units of the capture."""
PARTS = "trajectory.parts"
"""Folder into which the steps of a run are written while it is simulated; it is removed when the run has finished."""


def read_trajectory(path: Path) -> Trajectory:
    """Read a run's trajectory from its file, or from the folder of parts of an interrupted run.

    Raises ``UserError`` if the file is missing or is not a trajectory.
    """
    try:
        trajectory = Trajectory.load(path)
        check_trajectory(trajectory)
    except FileNotFoundError as error:
        if not path.is_dir() and (path.parent / PARTS).is_dir():
            raise UserError(
                f"{path}: is missing because the run was interrupted; egs-warp resume {path.parent} continues it"
                f" (its finished steps are in {PARTS})"
            ) from error
        raise UserError(f"{path}: is missing; give the folder that egs-warp animate wrote") from error
    except READ_ERRORS as error:
        raise UserError(
            f"{path}: is not a valid trajectory ({error}); run egs-warp animate again to write it"
        ) from error
    return trajectory


@dataclass(frozen=True)
class FinishedRun:
    """Contents of the folder of a finished run of one capture."""

    __repr__ = short_repr

    folder: Path
    trajectory: Trajectory
    creature: RenderData
    report: dict[str, Any]
    scene: GaussianCloud | None
    """Gaussians behind the creature, in the frame of the body; None if there are none."""

    @classmethod
    def read(cls, folder: Path, *, background: Path | None = None) -> Self:
        """Read the ``folder`` of a run.

        Args:
            folder: Folder that ``egs-warp animate`` wrote.
            background: Capture behind the creature; None uses ``background.ply`` of the folder, if it exists.

        Raises:
            UserError: ``folder`` has no finished run.
        """
        check_finished(folder)
        trajectory = read_trajectory(folder / "trajectory.npz")
        creature = RenderData.load(folder / render_data.FILE, node_count=len(trajectory.rest_positions))
        if len(creature.muscle_bounds) != trajectory.activations.shape[1]:
            advice = "run egs-warp animate again to write both"
            raise UserError(f"{folder / render_data.FILE}: its muscles differ from those of trajectory.npz; {advice}")
        report = parse_json(read_text(folder / "report.json"), folder / "report.json")
        if not isinstance(report, dict):
            raise UserError(f"{folder / 'report.json'}: is not a report; run egs-warp animate again to write it")
        own_background = folder / BACKGROUND
        file = background or (own_background if own_background.is_file() else None)
        scene = None
        if file is not None:
            t = trajectory
            frame = BodyFrame(t.body_axes, t.body_origin, t.metres_per_unit)
            scene = to_body_frame(read_capture(file).cloud, frame)
        return cls(folder, trajectory, creature, report, scene)

    @property
    def title(self) -> str:
        """Name of the capture and of its motions."""
        motions = self.report.get("motion", [])
        names = [str(m.get("name", "")) for m in motions if isinstance(m, dict)] if isinstance(motions, list) else []
        return " \u00b7 ".join(filter(None, [str(self.report.get("source", self.folder.name)), " \u2192 ".join(names)]))

    @cached_property
    def steps(self) -> np.ndarray:
        """(n,) Index of the state that is nearest to each frame at 60 Hz."""
        return nearest_steps(self.trajectory.time, FRAME_RATE)

    def frame_number(self, frame: int, *, argument: str) -> int:
        """Return the number, counted from 0, of ``frame``; negative numbers count from the end.

        Raises ``ArgumentError`` about ``argument`` if the run does not have that frame.
        """
        return checked_frame(frame, self.frame_count, argument=argument)

    @property
    def frame_count(self) -> int:
        """Number of frames at 60 Hz."""
        return len(self.steps)

    @property
    def antialiased(self) -> bool:
        """True if the capture was trained with antialiasing."""
        return self.creature.splats.antialiased

    def splats_of(self) -> Callable[[int], GaussianCloud]:
        """Return the function that computes the creature's splats in a frame; each call overwrites the last result."""
        deformer, t = self.deformer(), self.trajectory
        return lambda frame: deformer.deform(t.positions[self.steps[frame]]).cloud

    @cached_property
    def mesh(self) -> TetMesh:
        """Cage at rest."""
        return TetMesh(self.trajectory.rest_positions, self.trajectory.tets)

    def deformer(self) -> Deformer:
        """Create the deformer that maps node positions to the creature's Gaussians, as in the film."""
        return Deformer(self.creature.splats, embed_gaussians(self.creature.splats, self.mesh))

    def scene_without_shadow(self) -> GaussianCloud | None:
        """Return the scene without the shadow that the object cast in it; None if there is no scene."""
        light = self.creature.light
        if self.scene is None or light is None:
            return self.scene
        return without_shadow(self.scene, self.creature.splats, self.ground, light)

    @property
    def ground(self) -> Plane | HeightField:
        """Ground under the creature, in the frame of the body."""
        t = self.trajectory
        if t.ground_coefficients.size == 0:
            return GROUND
        return HeightField(t.ground_axes, t.ground_origin, t.ground_spacing, t.ground_coefficients)

    @property
    def capture_frame(self) -> BodyFrame:
        """Transform from the frame of the body to the frame and units of the capture."""
        t = self.trajectory
        return BodyFrame(t.body_axes.T, -t.metres_per_unit * t.body_axes @ t.body_origin, 1.0 / t.metres_per_unit)

    def activations(self, step: int) -> np.ndarray:
        """Return the activations (M,), -1 to 1 relative to their bounds, in the step that leads to state ``step``."""
        bounds = np.maximum(self.creature.muscle_bounds, 1e-12)
        return self.trajectory.activations[step - 1] / bounds if step > 0 else np.zeros(len(bounds))

    def contacts(self, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return contact points (m), unit normals and forces on the body (N), (C, 3) each, of the step to ``step``."""
        t = self.trajectory
        # Step number i leads to state i + 1.
        chosen = np.flatnonzero(t.contact_step == step - 1)
        points = np.einsum("cw,cwi->ci", t.contact_weights[chosen], t.positions[step][t.contact_nodes[chosen]])
        return points, t.contact_normal[chosen], t.contact_force[chosen]


def checked_frame(frame: int, count: int, *, argument: str) -> int:
    """Return the number, counted from 0, of ``frame`` among ``count`` frames; negative numbers count from the end.

    Raises ``ArgumentError`` about ``argument`` if there is no such frame.
    """
    if not -count <= frame < count:
        advice = f"the run has {count} frames; give 0 to {count - 1}, or -1 for the last"
        raise ArgumentError(argument, advice, value=frame)
    return frame % count
