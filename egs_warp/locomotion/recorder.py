"""Recorder that writes a simulation to disk while it runs, so that a killed run loses only its last steps.

Each part contains the arrays of a trajectory and all fields of ``StepReport``, which ``Replay`` reads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from egs_warp.contact.detection import ContactGeometry
from egs_warp.fem.body import BodyState, SoftBody
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.io.atomic import writable_folder
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import FIRST_PART, Trajectory, part_name, write_arrays
from egs_warp.muscles.muscle_set import MuscleSet

_MIN_STEPS_PER_PART = 10
"""Minimum number of steps in a part."""
REPORTED = ("qp_count", "qp_infeasible", "newton_iterations", "converged", "added_spin")
"""Fields of ``StepReport`` that become arrays of a part, with one row per step."""


class Recorder:
    """Collector of the steps of one body; writes each part to a folder when it is full."""

    def __init__(
        self,
        body: SoftBody,
        muscles: MuscleSet,
        geometry: ContactGeometry,
        start: BodyState,
        start_gap: float,
        *,
        drag: float,
        frame: BodyFrame | None = None,
        front: np.ndarray | None = None,
        folder: Callable[[], Path] | None = None,
        world_index: int | None = None,
    ) -> None:
        """Record the start of a run.

        Args:
            body: the body.
            muscles: its muscles.
            geometry: ground and contact points.
            start: first state.
            start_gap: minimum gap at ``start``, m.
            drag: alpha of the Rayleigh damping, 1/s.
            frame: placement of the body in its capture.
            front: (3,) unit vector of the direction in which the body faces; None is its x axis.
            folder: function that returns the folder for the parts of the recording, called after the first step; a
                missing folder is created. None keeps all parts in memory.
            world_index: index of the body in its world; None for a body that has no contact with itself.
        """
        self._folder, self._path = folder, None
        self._steps = self._written = self._requested_steps = 0
        self._reports: list[StepReport] = []
        self._requests: list[tuple[int, int]] = []
        self._kicks: list[tuple[int, np.ndarray]] = []
        material = body.assembly.material
        part = {
            "time": np.array([start.time]),
            "positions": start.positions[None],
            "velocities": start.velocities[None],
            "min_gap": np.array([start_gap]),
            "rest_positions": body.mesh.nodes,
            "unloaded_positions": body.assembly.mesh.nodes,
            "tets": body.mesh.tets,
            "node_mass": body.node_mass,
            "gravity": body.gravity,
            "planes": np.array([[*plane.normal, plane.offset] for plane in geometry.planes]),
            "solid_from_plane": geometry.solid_of_each_plane,
            "friction": np.float64(geometry.friction),
            "drag": np.float64(drag),
            "young_modulus": np.float64(material.young_modulus),
            "poisson_ratio": np.float64(material.poisson_ratio),
            "damping_time": np.float64(material.damping_time),
            "height": np.float64(body.height),
            "muscle_end_starts": muscles.end_rows.indptr.astype(np.int32),
            "muscle_end_nodes": muscles.end_rows.indices.astype(np.int32),
            "muscle_end_weights": muscles.end_rows.data,
            "muscle_segments": muscles.segments,
            "muscle_rest_lengths": muscles.rest_lengths,
            "muscle_stiffness": muscles.stiffness,
            "dt": np.zeros(0),
            "activations": np.zeros((0, muscles.segment_count)),
            "contact_step": np.zeros(0, np.int32),
            "contact_nodes": np.zeros((0, 4), np.int32),
            "contact_weights": np.zeros((0, 4)),
            "contact_plane": np.zeros(0, np.int32),
            "contact_normal": np.zeros((0, 3)),
            "contact_force": np.zeros((0, 3)),
            "contact_gap": np.zeros(0),
            "joint_step": np.zeros(0, np.int32),
            "joint_index": np.zeros(0, np.int32),
            "joint_nodes": np.zeros((0, 4), np.int32),
            "joint_weights": np.zeros((0, 4)),
            "joint_force": np.zeros((0, 3)),
            "kick_step": np.zeros(0, np.int32),
            "kick_velocity": np.zeros((0, *start.positions.shape)),
        }
        if geometry.field is not None:
            part |= {
                "ground_axes": geometry.field.axes,
                "ground_origin": geometry.field.origin,
                "ground_spacing": np.float64(geometry.field.spacing),
                "ground_coefficients": geometry.field.coefficients,
            }
        if material.relative_stiffness is not None:
            part["relative_stiffness"] = material.relative_stiffness
        if frame is not None:
            part |= {"body_axes": frame.axes, "body_origin": frame.origin, "metres_per_unit": np.float64(frame.scale)}
        if front is not None:
            part["front"] = front
        if world_index is not None:
            part["world_index"] = np.int64(world_index)
        self.start = part
        """Arrays of the first part: the first state, and all constant data of the run."""
        self._parts = [self.start]

    def add(self, reports: Sequence[StepReport], *, request_digest: int = 0, kick: np.ndarray | None = None) -> None:
        """Add the steps into which one requested step was divided.

        Args:
            reports: their reports, in order.
            request_digest: ``replay.digest`` of the objectives and of ``kick``; only read when a run is continued.
            kick: (N, 3) m/s, velocities that external pushes added to the nodes at the start of the step. The
                velocities that drives added, which the reports contain, are recorded as kicks, too.
        """
        if kick is not None:
            self._kicks.append((self._steps + len(self._reports), kick))
        drives = enumerate(report.drive for report in reports)
        first = self._steps + len(self._reports)
        self._kicks += [(first + index, drive) for index, drive in drives if drive is not None]
        self._reports += reports
        self._requests += [(self._requested_steps, request_digest)] * len(reports)
        self._requested_steps += 1
        if len(self._reports) >= _MIN_STEPS_PER_PART:
            self._parts.append(self._part())
        self._write()

    def trajectory(self) -> Trajectory:
        """Return the trajectory of all steps so far."""
        if self._reports:
            self._parts.append(self._part())
        if self._path is None:
            return Trajectory.from_parts(self._parts)
        self._write()
        return Trajectory.load(self._path)

    def _write(self) -> None:
        """Write the complete parts to the folder; the first call creates the folder and writes the first part."""
        if self._folder is None:
            return
        if self._path is None:
            self._path = writable_folder(self._folder())
            write_arrays(self._path / FIRST_PART, self._parts.pop(0))
        for part in self._parts:
            write_arrays(self._path / part_name(self._written), part)
            self._written += 1
        self._parts.clear()

    def _part(self) -> dict[str, np.ndarray]:
        """Return the arrays of the steps since the last part."""
        reports, self._reports = self._reports, []
        requests, self._requests = self._requests, []
        kicks, self._kicks = self._kicks, []
        counts = [report.contacts.count for report in reports]
        part = {
            "time": np.array([report.state.time for report in reports]),
            "positions": np.stack([report.state.positions for report in reports]),
            "velocities": np.stack([report.state.velocities for report in reports]),
            "min_gap": np.array([report.min_gap for report in reports]),
            "dt": np.array([report.dt for report in reports]),
            "activations": np.stack([report.activations for report in reports]),
            "contact_step": np.repeat(np.arange(self._steps, self._steps + len(reports)), counts).astype(np.int32),
            "contact_nodes": np.concatenate([report.contacts.nodes for report in reports]).astype(np.int32),
            "contact_weights": np.concatenate([report.contacts.weights for report in reports]),
            "contact_plane": np.concatenate([report.contacts.faces for report in reports]).astype(np.int32),
            "contact_normal": np.concatenate([report.contacts.axes[:, 0] for report in reports]),
            "contact_force": np.concatenate([np.einsum("na,nai->ni", r.forces, r.contacts.axes) for r in reports]),
            "contact_gap": np.concatenate([report.end_gaps for report in reports]),
            "contact_point": np.concatenate([report.contacts.points for report in reports]),
            "contact_load": np.concatenate([report.forces for report in reports]),
            **_joints(reports, self._steps),
            **(_frames(reports) if self._folder is not None else {}),
            "kick_step": np.array([step for step, _ in kicks], np.int32),
            "kick_velocity": np.array([kick for _, kick in kicks]).reshape(-1, *reports[0].state.positions.shape),
            "asked_step": np.array([step for step, _ in requests]),
            "asked_digest": np.array([number for _, number in requests], np.uint64),
            **{name: np.array([getattr(report, name) for report in reports]) for name in REPORTED},
            **_laps(reports),
        }
        self._steps += len(reports)
        return part


def _joints(reports: Sequence[StepReport], first: int) -> dict[str, np.ndarray]:
    """Return the joint forces of the ``reports``, the first of which is that of step ``first``."""
    steps = [(step, report.joints) for step, report in enumerate(reports, first) if report.joints is not None]
    return {
        "joint_step": np.array([step for step, joints in steps for _ in joints.joints], np.int32),
        "joint_index": np.concatenate([np.zeros(0), *(joints.joints for _, joints in steps)]).astype(np.int32),
        "joint_nodes": np.concatenate([np.zeros((0, 4)), *(joints.nodes for _, joints in steps)]).astype(np.int32),
        "joint_weights": np.concatenate([np.zeros((0, 4)), *(joints.weights for _, joints in steps)]),
        "joint_force": np.concatenate([np.zeros((0, 3)), *(joints.forces for _, joints in steps)]),
    }


def _frames(reports: Sequence[StepReport]) -> dict[str, np.ndarray]:
    """Return the arrays that only a continued run reads.

    These are the frames (n, 3, 3) of all contacts, their gaps (n,) m at the start of each step, the drives (d, N, 3)
    m/s, and the numbers ``drive_row`` (d,) of their steps in the part.
    """
    driven = [(row, report.drive) for row, report in enumerate(reports) if report.drive is not None]
    return {
        "contact_axes": np.concatenate([report.contacts.axes for report in reports]),
        "contact_start_gap": np.concatenate([report.contacts.gaps for report in reports]),
        "drive_row": np.array([row for row, _ in driven], np.int32),
        "drive_velocity": np.array([drive for _, drive in driven]).reshape(-1, *reports[0].state.positions.shape),
    }


def _laps(reports: Sequence[StepReport]) -> dict[str, np.ndarray]:
    """Return the names of the ``stages`` (S,) and their ``milliseconds`` (n, S); NaN where a step did not have a
    stage."""
    stages = list(dict.fromkeys(stage for report in reports for stage in report.milliseconds))
    laps = [[report.milliseconds.get(stage, np.nan) for stage in stages] for report in reports]
    return {"stages": np.array(stages, str), "milliseconds": np.array(laps)}
