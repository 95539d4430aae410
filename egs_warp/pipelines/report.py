"""``report.json``: requested and reached values, audit and timing of a run; docs/guide/report.md describes the
schema."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from egs_warp.checked_calls import checked_method
from egs_warp.io.atomic import atomic_write
from egs_warp.locomotion.audit import Audit, audit, end_stretch
from egs_warp.locomotion.ledger import EnergyBalance, EnergyTotals
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import MotionOutcome, Trajectory
from egs_warp.motions.act import ActOutcome
from egs_warp.motions.sequence import MotionRecord, spans_of
from egs_warp.pipelines.captured_body import CapturedBody
from egs_warp.pipelines.end_state import EndCause, State, falls_at_end, first_push
from egs_warp.short_repr import short_repr
from egs_warp.version import __version__

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

JsonValue: TypeAlias = "bool | int | float | str | Sequence[JsonValue] | Mapping[str, JsonValue] | None"
"""Value that can be written as JSON."""
SCHEMA_VERSION = 1
MECHANICS = ("warp-lang", "numpy", "scipy", "osqp", "pytetwild")
"""Packages on which the motion of a body depends."""
_KEYS = {"change": "gained", "target_error": "square_miss"}
"""Map from fields of ``EnergyTotals`` and ``HopOutcome`` to the keys of the report; it is needed because the schema is
fixed."""
NO_METADATA = "no metadata"
"""Version that is reported for a package that is missing or was copied without its ``dist-info``."""


def versions(names: Sequence[str] = MECHANICS) -> dict[str, str]:
    """Return the versions of this package, of Python, and of the packages ``names``, on which results depend.

    An unknown version is reported as ``NO_METADATA`` instead of raising an error, because the caller has finished work
    that must be saved.
    """
    return {
        "egs-warp": __version__,
        "python": platform.python_version(),
        **{name: installed_version(name) or NO_METADATA for name in names},
    }


def _with_keys(record: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    return {_KEYS.get(name, name): value for name, value in record.items()}


def installed_version(name: str) -> str | None:
    """Return the version of an installed package; None if it is unknown."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


@dataclass(frozen=True)
class MotionReport:
    """Requested, planned and reached values of one motion."""

    __repr__ = short_repr

    name: str
    asked: Mapping[str, float]
    """Requested values by name; lengths are in body heights."""
    planned: DataclassInstance
    """Values planned by the motion's state machine."""
    reached: MotionOutcome
    """Measured values that all motions have."""
    state: State
    also_reached: DataclassInstance | None
    """Measured values that are specific to this kind of motion."""
    notes: tuple[str, ...]
    """Notes for the user."""

    def to_json(self) -> dict[str, JsonValue]:
        """Return an element of the report's list ``motion``."""
        also = _with_keys(asdict(self.also_reached)) if self.also_reached is not None else {}
        below = also.pop("below", None)
        also |= _with_keys(below) if isinstance(below, Mapping) else {}
        return {
            "name": self.name,
            "asked": dict(self.asked),
            "planned": asdict(self.planned),
            "reached": {**asdict(self.reached), **also},
            "state": self.state.value,
            "notes": list(self.notes),
        }


def _result(motions: Sequence[MotionReport]) -> str:
    """Return a text for ``motions`` of the same name: reached and requested values, and causes of missed targets."""
    values = []
    for name, unit in (("distance", " body heights"), ("height", " body heights"), ("heading_degrees", " degrees")):
        requested = {motion.asked.get(name, 0.0) for motion in motions}
        if requested != {0.0}:
            reached = _span([getattr(motion.reached, name) for motion in motions])
            values.append(f"{name.partition('_')[0]} {reached} of {_span(sorted(requested))}{unit}")
    outcomes = [motion.also_reached.gestures for motion in motions if isinstance(motion.also_reached, ActOutcome)]
    values += dict.fromkeys(gesture.text.removeprefix(f"{motions[0].name} ") for each in outcomes for gesture in each)
    # A note repeats the values of missed targets.
    stated = {*values, *(f"{motions[0].name} {value}" for value in values)}
    values.append(f"tilt {_span([motion.reached.tilt_degrees for motion in motions], digits=0)} degrees")
    count = f" x{len(motions)}" if len(motions) > 1 else ""
    # Remove the state from the notes, because the line begins with it.
    notes = dict.fromkeys(note.removeprefix(f"{motion.state.value}: ") for motion in motions for note in motion.notes)
    further = [", ".join(part for part in note.split(", ") if part not in stated) for note in notes]
    return "; ".join([f"{motions[0].name}{count}: {', '.join(values)}", *filter(None, further)])


def _span(values: Sequence[float], *, digits: int = 2) -> str:
    """Return the range of ``values`` as text."""
    texts = [f"{value:.{digits}f}" for value in (min(values), max(values))]
    if digits:
        texts = [text.rstrip("0").rstrip(".") for text in texts]
    return " to ".join(dict.fromkeys(texts))


@dataclass(frozen=True)
class QpCounts:
    """Numbers of solved and of infeasible quadratic programs in a run."""

    __repr__ = short_repr

    mean_per_frame: float
    worst_per_frame: int
    infeasible: int
    """Number of infeasible programs in the run."""

    @classmethod
    def of(cls, reports: Sequence[StepReport], frames: np.ndarray) -> QpCounts:
        """Count the programs of ``reports``; ``frames`` (n,) are indices of the trajectory's states."""
        counts = np.array([0, *(report.qp_count for report in reports)])
        per_frame = np.diff(np.cumsum(counts)[frames]) if len(frames) > 1 else np.zeros(1)
        infeasible = int(sum(report.qp_infeasible for report in reports))
        return cls(float(per_frame.mean()), int(per_frame.max()), infeasible)


@dataclass(frozen=True)
class StageTime:
    """Time of one stage, ms per frame."""

    __repr__ = short_repr

    mean: float
    worst: float


def stage_times(
    reports: Sequence[StepReport], frames: np.ndarray, drawing: Mapping[str, Sequence[float]]
) -> dict[str, StageTime]:
    """Return the time of each stage. A stage that does not occur in a frame takes no time in it.

    Args:
        reports: Reports of all steps.
        frames: (n,) indices of the trajectory's states.
        drawing: Time of each rendered frame by stage, ms.
    """
    spans = list(zip(frames[:-1], frames[1:], strict=True))
    spent: dict[str, np.ndarray] = {}
    for frame, (first, last) in enumerate(spans):
        for report in reports[first:last]:
            for stage, value in report.milliseconds.items():
                spent.setdefault(stage, np.zeros(len(spans)))[frame] += value
    return {
        stage: StageTime(float(np.mean(values)), float(np.max(values)))
        for stage, values in {**spent, **drawing}.items()
        if len(values)
    }


@dataclass(frozen=True)
class CageFacts:
    """Properties of the simulated mesh."""

    __repr__ = short_repr

    nodes: int
    tets: int
    min_dihedral_degrees: float
    mass: float
    """Mass of the body, kg."""


@dataclass(frozen=True)
class MuscleFacts:
    """Numbers of muscle fibres and segments."""

    fibres: int
    segments: int


@dataclass(frozen=True)
class GaussianCounts:
    """Numbers of Gaussians, from the capture to the pictures."""

    read: int
    """Number of Gaussians in the capture."""
    split: int
    """Number of Gaussians after splitting."""
    drawn: int
    """Number of Gaussians in the pictures, of which a preview leaves some out."""
    left_out_of_contact: int
    """Number of Gaussians that are not used for contact."""
    left_out_of_contact_opacity: float
    """Fraction of the opacity of the Gaussians that are not used for contact."""

    @classmethod
    def of(cls, creature: CapturedBody, *, split: int | None = None, drawn: int | None = None) -> GaussianCounts:
        """Return the counts for a body. ``split`` is the number of Gaussians after splitting, None if they were not
        split; ``drawn`` is the number of those in the pictures, None for all."""
        read, geometry = creature.cloud.count, creature.geometry
        split = read if split is None else split
        drawn = split if drawn is None else drawn
        return cls(read, split, drawn, geometry.excluded_count, geometry.excluded_opacity)

    def to_json(self) -> dict[str, JsonValue]:
        """Return the entry ``gaussians`` of the report."""
        return {
            "in": self.read,
            "split": self.split - self.read,
            "out": self.drawn,
            "left_out_of_contact": self.left_out_of_contact,
            "left_out_of_contact_opacity": self.left_out_of_contact_opacity,
        }


@dataclass(frozen=True)
class Take:
    """One simulation of a run."""

    change: str | None
    """Description of the gentler form of a motion, for messages; None in the first take."""
    state: State
    """State of the first motion that failed; if none failed, the worst state of all motions."""
    note: str
    """Reason for a failure; empty if no motion failed."""

    def to_json(self) -> dict[str, JsonValue]:
        """Return an element of the report's list ``takes``."""
        return {"change": self.change, "state": self.state.value, "note": self.note}


@dataclass(frozen=True)
class Report:
    """Contents of ``report.json``."""

    source: str
    """Name of the capture."""
    motion: tuple[MotionReport, ...]
    audit: Audit
    energy: EnergyTotals
    qp: QpCounts
    timing: Mapping[str, StageTime]
    cage: CageFacts
    muscles: MuscleFacts
    gaussians: GaussianCounts
    notes: tuple[str, ...]
    """Notes for the user."""
    device: str
    seed: int
    asked: Mapping[str, JsonValue] = field(default_factory=dict)
    """Requested options of the run, ready for JSON."""
    versions: Mapping[str, str] = field(default_factory=versions)
    film: str | None = None
    """Name of the video in the folder of the run; None if it was not filmed."""
    takes: tuple[Take, ...] = ()
    """Simulations of the run in order; empty if it was simulated once (``egs_warp.pipelines.takes``)."""

    def __repr__(self) -> str:
        return f"Report({self.source!r}, {self.summary().splitlines()[0]!r})"

    @property
    def state(self) -> State:
        """State in which the run ended."""
        return State.worst(tuple(motion.state for motion in self.motion))

    def to_json(self) -> dict[str, JsonValue]:
        """Return the whole report, ready for JSON."""
        return {
            "schema": SCHEMA_VERSION,
            "source": self.source,
            "state": self.state.value,
            "asked": dict(self.asked),
            "motion": [motion.to_json() for motion in self.motion],
            "audit": written_audit(self.audit),
            "energy": _with_keys(asdict(self.energy)),
            "qp": asdict(self.qp),
            "timing": {stage: asdict(time) for stage, time in self.timing.items()},
            "cage": asdict(self.cage),
            "muscles": asdict(self.muscles),
            "gaussians": self.gaussians.to_json(),
            "notes": list(self.notes),
            "versions": dict(self.versions),
            "device": self.device,
            "seed": self.seed,
            "film": self.film,
            "takes": [take.to_json() for take in self.takes],
        }

    @checked_method
    def write(self, path: Path) -> None:
        """Write ``report.json`` atomically."""
        write_report(path, self.to_json())

    def summary(self) -> str:
        """Return two lines for the terminal: reached and requested values, and the verdict of the audit."""
        groups = [list(group) for _, group in groupby(self.motion, key=lambda motion: motion.name)]
        result = ", then ".join(map(_result, groups)) or "no motion began"
        state = "" if self.state is State.DONE else f"{self.state.value}: "
        shown = retakes = ""
        if self.takes and self.takes[-1].state is State.FALLEN:
            retakes = f"; {len(self.takes)} takes fell, this is the first"
        elif self.takes:
            shown = f"take {len(self.takes)} ({self.takes[-1].change}): "
        return f"{state}{shown}{result}{retakes}\n{verdict(self.audit)}"


AUDIT_LIMITS = {
    "momentum_residual": 1e-5,
    "angular_momentum_residual": 1e-4,
    "energy_residual": 1e-6,
    "cone_violation": 1e-4,
    "friction_gap": 1e-5,
    "contact_velocity": 1e-6,
    "penetration": 1e-2,
    "complementarity_gap": 1e-4,
    "inverted_elements": 0,
    "newton_unconverged": 0,
}
"""Upper limits of the values of the audit. A run that exceeds one of them does not satisfy the equations
(docs/guide/report.md)."""


def written_audit(result: Audit) -> dict[str, JsonValue]:
    """Return the values of an audit for JSON; None for those that are not finite."""
    return {name: value if np.isfinite(value) else None for name, value in asdict(result).items()}


def exceeded_limits(values: Mapping[str, float], limits: Mapping[str, float]) -> list[str]:
    """Return a text for each of the ``values`` that exceeds its limit; values without a limit are not checked."""
    exceeded = []
    for name, value in values.items():
        limit = limits.get(name)
        # The condition is not "value > limit", because NaN must count as exceeding the limit, too.
        if limit is not None and not value <= limit:
            exceeded.append(f"{name} {value / limit:,.1f} times its limit" if limit else f"{name} {value}, not 0")
    return exceeded


def verdict(result: Audit) -> str:
    """Return one line that says whether the run satisfies its equations, or which values exceed their limits."""
    exceeded = exceeded_limits(asdict(result), AUDIT_LIMITS)
    return f"audit: FAILED: {', '.join(exceeded)}" if exceeded else "audit: passed"


def report_of_run(
    creature: CapturedBody,
    trajectory: Trajectory,
    steps: Sequence[StepReport],
    frames: np.ndarray,
    done: Sequence[MotionRecord],
    energy: EnergyBalance,
    *,
    gaussians: GaussianCounts,
    drawing: Mapping[str, Sequence[float]],
    source: str,
    notes: Sequence[str],
    seed: int,
    asked: Mapping[str, JsonValue],
    ending: EndCause | None = None,
    film: str | None = None,
    takes: tuple[Take, ...] = (),
) -> Report:
    """Create the report of a run.

    Args:
        creature: The creature or the prop.
        trajectory: All states of the run.
        steps: Reports of all steps.
        frames: (n,) indices of the trajectory's states.
        done: The motions that were started.
        energy: Energy balance of ``trajectory``.
        gaussians: Numbers of Gaussians.
        drawing: Time of each rendered frame by stage, ms.
        source: Name of the capture.
        notes: Notes for the user.
        seed: Seed of the run.
        asked: Requested options.
        ending: Cause that ended the last motion early.
        film: Name of the video.
        takes: Simulations of the run, if there were several.
    """
    mesh = creature.mesh
    return Report(
        source=source,
        motion=motion_reports(trajectory, done, ending or EndCause()),
        audit=audit(trajectory, energy=energy, newton_unconverged=sum(not step.converged for step in steps)),
        energy=EnergyTotals.of(energy),
        qp=QpCounts.of(steps, frames),
        timing=stage_times(steps, frames, drawing),
        cage=CageFacts(len(mesh.nodes), len(mesh.tets), mesh.min_dihedral_degrees(), creature.body.mass),
        muscles=MuscleFacts(creature.muscles.fibre_count, creature.muscles.segment_count),
        gaussians=gaussians,
        notes=tuple(notes),
        device=str(creature.cloud.device),
        seed=seed,
        asked=asked,
        film=film,
        takes=takes,
    )


def motion_reports(trajectory: Trajectory, done: Sequence[MotionRecord], ending: EndCause) -> tuple[MotionReport, ...]:
    """Return the reports of the started motions ``done``; ``ending`` is the cause that ended the last one early."""
    if ending.unsupported is None and falls_at_end(trajectory):
        ending = replace(ending, unsupported="it ends in the air, and nothing supports it")
    ending = replace(ending, end_stretch=end_stretch(trajectory))
    pushed, reports = first_push(trajectory), []
    for entry, (first, last) in zip(done, spans_of(done, trajectory.time), strict=True):
        reached = entry.measured(trajectory, first, last)
        also = entry.motion.outcome_record(trajectory, first, last)
        is_pushed = ending.is_pushed or (pushed is not None and pushed < last)
        state, why = replace(ending, is_pushed=is_pushed).of(entry, reached, also, last=entry is done[-1])
        notes = (*entry.motion.notes(), *why)
        reports.append(MotionReport(entry.name, entry.asked, entry.motion.plan_record(), reached, state, also, notes))
    return tuple(reports)


def write_report(path: Path, report: Mapping[str, JsonValue]) -> None:
    """Write ``report`` as indented JSON, atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(report, indent=2) + "\n")
