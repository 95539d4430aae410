"""A run that was cut off goes on: what it has recorded is done again without solving, then the solver takes over.

All that lasts from step to step is the state, the ``StepMemory`` and what the motion has seen. The first two are in the
record; the motion sees the recorded steps again and asks for the same ones. So nothing else is ever saved, and a run
that goes on has the bits of one that was never cut off.
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
    """The steps in the folder of a ``Recorder``, one after the other as they were asked for."""

    def __init__(self, folder: Path, start: Mapping[str, np.ndarray], detector: ContactDetector) -> None:
        """``start``: the first part as the run that goes on would write it; ``detector``: of its contacts.

        Raises ``UserError`` where the recorded run began otherwise, or its first part is damaged.
        """
        self._folder, self._detector = folder, detector
        recorded = _read(folder / FIRST_PART)
        if recorded.keys() != start.keys() or any(recorded[key].tobytes() != start[key].tobytes() for key in start):
            raise _other(folder)
        self._steps = self._recorded(start["positions"][0])

    def step(self, asked: int) -> list[StepReport]:
        """The next recorded step, in the parts it was divided into; none once all are done. ``asked`` is the ``digest``
        of what is asked of it.

        Raises ``UserError`` where something else was asked of it, or its part is damaged.
        """
        then, reports = next(self._steps, (asked, []))
        if then != asked:
            raise _other(self._folder)
        return reports

    def _recorded(self, positions: np.ndarray) -> Iterator[tuple[int, list[StepReport]]]:
        count = 0
        for path in part_paths(self._folder):
            part = _read(path)
            try:
                reports = self._reports(part, positions, count)
                ends = [*(np.flatnonzero(np.diff(part["asked_step"])) + 1), len(reports)]
                digests = [int(part["asked_digest"][end - 1]) for end in ends]
            except READ_ERRORS as error:
                raise _damaged(path, error) from error
            for digest_then, first, end in zip(digests, [0, *ends], ends, strict=False):
                yield digest_then, reports[first:end]
            count, positions = count + len(reports), reports[-1].state.positions

    def _reports(self, part: Mapping[str, np.ndarray], positions: np.ndarray, count: int) -> list[StepReport]:
        """Of a part that begins at ``positions`` (N, 3), after ``count`` steps."""
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
    """64 bits that tell what is asked of a step, and what is given to its nodes from outside, from anything else."""
    found = hashlib.blake2b(digest_size=8)

    def feed(value: Any) -> None:
        if is_dataclass(value):
            for field in fields(value):
                feed(getattr(value, field.name))
        elif sparse.issparse(value):
            feed(sparse.csr_matrix(value).indices)
            feed(sparse.csr_matrix(value).data)
        else:
            array = np.ascontiguousarray(value)
            assert array.dtype != object, "objectives are numbers and names"
            found.update(array.tobytes())

    for objective in objectives:
        feed(objective)
    return int.from_bytes(found.digest(), "big")


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        return read_arrays(path)
    except READ_ERRORS as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> UserError:
    missing = isinstance(error, FileNotFoundError)
    what = "is missing" if missing else f"is damaged ({error})"
    gone = "the parts after it" if missing else "it and the parts after it"
    cure = "begin the run again" if path.name == FIRST_PART else f"remove {gone} to go on from there"
    return UserError(f"{path}: {what}; {cure}")


def _other(folder: Path) -> UserError:
    return UserError(
        f"{folder}: does not fit the run that is to go on: capture, flags, program or machine have changed; begin the"
        " run again"
    )
