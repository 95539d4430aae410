"""Encoding of a finished run of a world for the page: all bodies are shown in one picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.pipelines.drawn_cage import DrawnCage, drawn_level_set
from egs_warp.pipelines.finished_world import FinishedWorld, check_no_background, is_world_folder
from egs_warp.web.joint_header import PageBody, joint_header, joint_positions
from egs_warp.web.packets import Frame, with_length
from egs_warp.web.recording import CURVES, Recording, body_curves, curve_facts


@dataclass(frozen=True)
class WorldRecording(FinishedWorld):
    """A finished run of a world that can be encoded as packets."""

    @cached_property
    def page_bodies(self) -> tuple[PageBody, ...]:
        """The bodies, each with its row of the report."""
        rows = self.report["bodies"]
        return tuple(
            PageBody(
                name,
                run.creature,
                DrawnCage.of(run.mesh, self.shapes[name]),
                drawn_level_set(self.shapes[name]),
                run.trajectory.height,
                run.trajectory.node_mass,
                self.filmed.bodies[name].deformer,
                {key: str(rows[name].get(key, "")) for key in ("state", "result", "audit")},
            )
            for name, run in self.bodies.items()
        )

    def header(self) -> bytes:
        """Return the header, which contains all data that do not depend on the frame."""
        first = self.first.trajectory
        weights = [float(t.node_mass.sum() * np.linalg.norm(t.gravity)) for t in self.trajectories]
        forward = self.camera.rotation[2, :2]
        curves = [{**curve, "body": index} for index in range(len(self.bodies)) for curve in curve_facts(CURVES)]
        facts = {
            "title": self.title,
            "rate": FRAME_RATE,
            "frames": self.frame_count,
            "height": max(t.height for t in self.trajectories),
            "weight": max(weights),
            "friction": first.friction,
            "front": (-forward / max(float(np.linalg.norm(forward)), 1e-9)).tolist(),
            "flat": not self.solids,
            "curves": curves,
            "audit": {},
            "motion": [],
            "notes": self.report.get("notes", []),
            "failures": self._joint_failures(),
        }
        return joint_header(facts, self.page_bodies, first.planes, scene=self.scene)

    def _joint_failures(self) -> list[str]:
        """Return the lines of the verdict about pairs, joints and the whole world, whose audits are not those of single
        bodies."""
        lines = str(self.report.get("verdict", "")).splitlines()
        return [
            line for line in lines if "FAILED" in line and line.partition(": audit:")[0] not in self.report["bodies"]
        ]

    def frames(self) -> Iterator[Frame]:
        """Yield the frames at 60 Hz."""
        runs = tuple(self.bodies.values())
        curves = [body_curves(t) for t in self.trajectories]
        for index in range(self.frame_count):
            steps = [int(run.steps[index]) for run in runs]
            parts = list(zip(runs, steps, strict=True))
            yield Frame(
                index,
                float(runs[0].trajectory.time[steps[0]]),
                joint_positions(self.page_bodies, [run.trajectory.positions[step] for run, step in parts]),
                np.concatenate([run.activations(step) for run, step in parts]),
                np.concatenate([np.concatenate(run.contacts(step), axis=1) for run, step in parts]),
                np.concatenate([each[step] for each, step in zip(curves, steps, strict=True)]),
            )

    def bytes(self) -> bytes:
        """Return the header and all frames in the format of a file."""
        return b"".join([self.header(), *(with_length(frame.packet()) for frame in self.frames())])


def read_recording(folder: Path, *, background: Path | None = None) -> Recording | WorldRecording:
    """Read the finished run of a single capture or of a world (``read_finished``), for the page."""
    if not is_world_folder(folder):
        return Recording.read(folder, background=background)
    check_no_background(background)
    return WorldRecording.read(folder)
