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

from egs_warp.contact.detection import ContactDetector
from egs_warp.errors import UserError
from egs_warp.fem.body import BodyState
from egs_warp.io.arrays import READ_ERRORS
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.recorder import REPORTED
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import FIRST_PART, part_paths, read_arrays


class Replay:
    """Reader of the steps in the folder of a ``Recorder``, which returns one requested step after the other."""

    def __init__(self, folder: Path, start: Mapping[str, np.ndarray], detector: ContactDetector) -> None:
        """Open a recording.

        Args:
            folder: folder of the recorder.
            start: first part that the continued run would write.
            detector: detector that rebuilds the contacts.

        Raises:
            UserError: the recorded run started differently, or its first part is damaged.
        """
        self._folder, self._detector = folder, detector
        recorded = _read(folder / FIRST_PART)
        if recorded.keys() != start.keys() or any(recorded[key].tobytes() != start[key].tobytes() for key in start):
            raise _other_run(folder)
        self._steps = self._recorded(start["positions"][0])

    def step(self, request_digest: int) -> list[StepReport]:
        """Return the reports of the next requested step, one for each step into which it was divided; an empty list at
        the end of the recording.

        Args:
            request_digest: ``digest`` of the objectives and prescribed values of the step.

        Raises:
            UserError: the recorded step had other objectives, or its part is damaged.
        """
        recorded_digest, reports = next(self._steps, (request_digest, []))
        if recorded_digest != request_digest:
            raise _other_run(self._folder)
        return reports

    def _recorded(self, positions: np.ndarray) -> Iterator[tuple[int, list[StepReport]]]:
        """Yield the digest and the reports of each requested step. The first one starts at ``positions`` (N, 3) m."""
        count = 0
        for path in part_paths(self._folder):
            part = _read(path)
            try:
                reports = self._reports(part, positions, count)
                ends = [*(np.flatnonzero(np.diff(part["asked_step"])) + 1), len(reports)]
                digests = [int(part["asked_digest"][end - 1]) for end in ends]
            except READ_ERRORS as error:
                raise _damaged(path, error) from error
            for part_digest, first, end in zip(digests, [0, *ends], ends, strict=False):
                yield part_digest, reports[first:end]
            count, positions = count + len(reports), reports[-1].state.positions

    def _reports(self, part: Mapping[str, np.ndarray], positions: np.ndarray, count: int) -> list[StepReport]:
        """Return the reports of a part that starts at ``positions`` (N, 3), after ``count`` steps."""
        reports = []
        stages = part["stages"].tolist()
        bounds = np.searchsorted(part["contact_step"], np.arange(count, count + len(part["dt"]) + 1))
        for row, (first, end) in enumerate(zip(bounds[:-1], bounds[1:], strict=True)):
            laps = zip(stages, part["milliseconds"][row].tolist(), strict=True)
            report = StepReport(
                state=BodyState(part["positions"][row], part["velocities"][row], float(part["time"][row])),
                dt=float(part["dt"][row]),
                contacts=self._detector.contact_set(part["contact_point"][first:end], positions),
                forces=part["contact_load"][first:end],
                end_gaps=part["contact_gap"][first:end],
                min_gap=float(part["min_gap"][row]),
                activations=part["activations"][row],
                **{name: part[name][row].item() for name in REPORTED},
                milliseconds={stage: lap for stage, lap in laps if not np.isnan(lap)},
            )
            reports.append(report)
            positions = report.state.positions
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
