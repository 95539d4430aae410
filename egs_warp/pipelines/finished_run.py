"""A finished run, read from its folder."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.arrays import READ_ERRORS
from egs_warp.io.capture import read_capture
from egs_warp.io.text import parse_json, read_text
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.locomotion.trajectory_validation import check_trajectory
from egs_warp.pipelines import render_data
from egs_warp.pipelines.render_data import RenderData
from egs_warp.pipelines.shot import nearest_steps

PARTS = "trajectory.parts"
"""Folder that takes the steps of a run as they are done; it goes when the run has finished."""


def read_trajectory(path: Path) -> Trajectory:
    """Read a run's trajectory: its file, or the folder of parts of one that was cut off.

    Raises ``UserError`` where there is none, or another kind of file.
    """
    try:
        trajectory = Trajectory.load(path)
        check_trajectory(trajectory)
    except FileNotFoundError as error:
        if not path.is_dir() and (path.parent / PARTS).is_dir():
            raise UserError(
                f"{path}: is missing, the run was cut off; egs-warp resume {path.parent} goes on"
                f" (what it did is in {PARTS})"
            ) from error
        raise UserError(f"{path}: is missing; give the folder that egs-warp animate wrote") from error
    except READ_ERRORS as error:
        raise UserError(f"{path}: is no trajectory ({error}); run egs-warp animate again, which writes it") from error
    return trajectory


@dataclass(frozen=True)
class FinishedRun:
    """A finished run."""

    folder: Path
    trajectory: Trajectory
    creature: RenderData
    report: dict[str, Any]
    scene: GaussianCloud | None
    """What is behind the creature, in its frame."""

    @classmethod
    def read(cls, folder: Path, *, background: Path | None = None) -> Self:
        """Read the ``folder`` of a run; ``background`` is a capture behind it, else its own ``background.ply``.

        Raises ``UserError`` for a folder that is no run.
        """
        if not folder.is_dir():
            raise UserError(f"{folder}: is no folder; give the one that egs-warp animate wrote")
        trajectory = read_trajectory(folder / "trajectory.npz")
        creature = RenderData.load(folder / render_data.FILE, node_count=len(trajectory.rest_positions))
        if len(creature.muscle_bounds) != trajectory.activations.shape[1]:
            advice = "run egs-warp animate again, which writes both"
            raise UserError(f"{folder / render_data.FILE}: has other muscles than trajectory.npz; {advice}")
        report = parse_json(read_text(folder / "report.json"), folder / "report.json")
        if not isinstance(report, dict):
            raise UserError(f"{folder / 'report.json'}: is no report; run egs-warp animate again, which writes it")
        own = folder / "background.ply"
        file = background or (own if own.is_file() else None)
        scene = None
        if file is not None:
            t = trajectory
            frame = BodyFrame(t.body_axes, t.body_origin, t.metres_per_unit)
            scene = to_body_frame(read_capture(file).cloud, frame)
        return cls(folder, trajectory, creature, report, scene)

    @property
    def title(self) -> str:
        """Capture and motions."""
        motions = self.report.get("motion", [])
        names = [str(m.get("name", "")) for m in motions if isinstance(m, dict)] if isinstance(motions, list) else []
        return " \u00b7 ".join(filter(None, [str(self.report.get("source", self.folder.name)), " \u2192 ".join(names)]))

    @cached_property
    def steps(self) -> np.ndarray:
        """(n,) the step that is nearest to each frame at 60 Hz."""
        return nearest_steps(self.trajectory.time, FRAME_RATE)

    def frame_number(self, frame: int, *, asked_by: str) -> int:
        """From 0, of ``frame``, which may count from the end. Raises ``ArgumentError`` about the argument ``asked_by``
        for one that is not there.
        """
        count = len(self.steps)
        if not -count <= frame < count:
            advice = f"the run has {count} frames; give 0 to {count - 1}, or -1 for the last"
            raise ArgumentError(asked_by, advice, value=frame)
        return frame % count

    @cached_property
    def mesh(self) -> TetMesh:
        """The rest cage."""
        return TetMesh(self.trajectory.rest_positions, self.trajectory.tets)

    def deformer(self) -> Deformer:
        """Carries the creature's splats to node positions of the trajectory, as the film did."""
        return Deformer(self.creature.splats, embed_gaussians(self.creature.splats, self.mesh))

    @property
    def capture_frame(self) -> BodyFrame:
        """Takes what lies in the body's frame to the capture's frame and units."""
        t = self.trajectory
        return BodyFrame(t.body_axes.T, -t.metres_per_unit * t.body_axes @ t.body_origin, 1.0 / t.metres_per_unit)

    def activations(self, step: int) -> np.ndarray:
        """(M,) -1 to 1: what each muscle segment did on the way to the state after ``step`` steps, of the most that it
        can.
        """
        bounds = np.maximum(self.creature.muscle_bounds, 1e-12)
        return self.trajectory.activations[step - 1] / bounds if step > 0 else np.zeros(len(bounds))

    def contacts(self, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points, unit normals and forces on the body, each (C, 3), on the way to the state after ``step`` steps."""
        t = self.trajectory
        # Step i leads to state i + 1.
        chosen = np.flatnonzero(t.contact_step == step - 1)
        points = np.einsum("cw,cwi->ci", t.contact_weights[chosen], t.positions[step][t.contact_nodes[chosen]])
        return points, t.contact_normal[chosen], t.contact_force[chosen]
