"""Continuation of an interrupted run: recorded steps are replayed without solving, then the solver continues.

A step passes only the state, the ``WarmStart`` and the history of the motion to the next step. State and warm start are
recorded. The history is rebuilt, because the motion receives the recorded steps and requests the same objectives again.
So nothing else has to be saved, and a continued run is bit-identical to an uninterrupted run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sparse

from egs_warp.contact.contact_set import ContactSet
from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.fem.joints import JointForces
from egs_warp.io.arrays import READ_ERRORS
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.recorder import REPORTED
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import FIRST_PART, part_paths, read_arrays


class Replay:
    """Reader of the steps in the folder of a ``Recorder``, which returns one requested step after the other."""

    def __init__(self, folder: Path, start: Mapping[str, np.ndarray]) -> None:
        """Open a recording.

        Args:
            folder: folder of the recorder.
            start: first part that the continued run would write.

        Raises:
            UserError: the recorded run started differently, or its first part is damaged.
        """
        self._folder = folder
        recorded = _read(folder / FIRST_PART)
        if recorded.keys() != start.keys() or any(recorded[key].tobytes() != start[key].tobytes() for key in start):
            raise _other_run(folder)
        self._steps = self._recorded(len(start["rest_positions"]))

    def step(self, request_digest: int) -> list[StepReport]:
        """Return the reports of the next requested step, one for each step into which it was divided; an empty list at
        the end of the recording.

        Args:
            request_digest: ``digest`` of the objectives and prescribed values of the step.

        Raises:
            UserError: the recorded step had other objectives, or the part that contains it is damaged.
        """
        recorded_digest, reports = next(self._steps, (request_digest, []))
        if recorded_digest != request_digest:
            raise _other_run(self._folder)
        return reports

    def _recorded(self, node_count: int) -> Iterator[tuple[int, list[StepReport]]]:
        """Yield the digest and the reports of each requested step of a body with ``node_count`` nodes."""
        count = 0
        for path in part_paths(self._folder):
            part = _read(path)
            try:
                reports = _reports(part, node_count, count)
                ends = [*(np.flatnonzero(np.diff(part["asked_step"])) + 1), len(reports)]
                digests = [int(part["asked_digest"][end - 1]) for end in ends]
            except READ_ERRORS as error:
                raise _damaged(path, error) from error
            for part_digest, first, end in zip(digests, [0, *ends], ends, strict=False):
                yield part_digest, reports[first:end]
            count += len(reports)


def _reports(part: Mapping[str, np.ndarray], node_count: int, count: int) -> list[StepReport]:
    """Return the reports of a part after ``count`` steps of a body with ``node_count`` nodes."""
    reports = []
    nodes = part["contact_nodes"]
    if (
        part["positions"].shape[1:] != (node_count, 3)
        or not 0 <= nodes.min(initial=0) <= nodes.max(initial=0) < node_count
    ):
        raise ValueError("its nodes are not those of the body")
    stages = part["stages"].tolist()
    drives = dict(zip(part["drive_row"].tolist(), part["drive_velocity"], strict=True))
    bounds = np.searchsorted(part["contact_step"], np.arange(count, count + len(part["dt"]) + 1))
    joint_bounds = np.searchsorted(part["joint_step"], np.arange(count, count + len(part["dt"]) + 1))
    for row, (first, end) in enumerate(zip(bounds[:-1], bounds[1:], strict=True)):
        laps = zip(stages, part["milliseconds"][row].tolist(), strict=True)
        contacts = ContactSet(
            part["contact_point"][first:end],
            nodes[first:end],
            part["contact_weights"][first:end],
            part["contact_axes"][first:end],
            part["contact_start_gap"][first:end],
            part["contact_plane"][first:end],
            node_count,
        )
        of_joints = slice(joint_bounds[row], joint_bounds[row + 1])
        joint_arrays = [part[f"joint_{name}"][of_joints] for name in ("index", "nodes", "weights", "force")]
        report = StepReport(
            state=BodyState(part["positions"][row], part["velocities"][row], float(part["time"][row])),
            dt=float(part["dt"][row]),
            contacts=contacts,
            forces=part["contact_load"][first:end],
            end_gaps=part["contact_gap"][first:end],
            min_gap=float(part["min_gap"][row]),
            activations=part["activations"][row],
            **{name: part[name][row].item() for name in REPORTED},
            drive=drives.get(row),
            joints=JointForces(*joint_arrays) if len(joint_arrays[0]) else None,
            milliseconds={stage: lap for stage, lap in laps if not np.isnan(lap)},
        )
        reports.append(report)
    return reports


def digest(objectives: Sequence[AnyObjective | np.ndarray]) -> int:
    """Return a 64-bit hash of the objectives of a step, and of its prescribed velocities and activations."""
    hasher = hashlib.blake2b(digest_size=8)

    def feed(value: Any) -> None:
        if is_dataclass(value):
            for field in fields(value):
                feed(getattr(value, field.name))
        elif sparse.issparse(value):
            feed(sparse.csr_matrix(value).indices)
            feed(sparse.csr_matrix(value).data)
        else:
            array = np.ascontiguousarray(value)
            assert array.dtype != object, "an objective may contain only numbers, names and arrays"
            hasher.update(array.tobytes())

    for objective in objectives:
        feed(objective)
    return int.from_bytes(hasher.digest(), "big")


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        return read_arrays(path)
    except READ_ERRORS as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> UserError:
    """Return the error for a part that is missing or cannot be read."""
    missing = isinstance(error, FileNotFoundError)
    what = "is missing" if missing else f"is damaged ({error})"
    removed = "the parts after it" if missing else "it and the parts after it"
    remedy = "begin the run again" if path.name == FIRST_PART else f"remove {removed} to continue from there"
    return UserError(f"{path}: {what}; {remedy}")


def _other_run(folder: Path) -> UserError:
    """Return the error for a recording of another run."""
    return UserError(
        f"{folder}: belongs to another run: capture, flags, program or machine have changed; begin the run again"
    )
