"""``report.json``: what was asked and reached, the audit, and what it cost. The schema is in docs/guide/report.md."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egs_warp.io.atomic import atomic_write
from egs_warp.locomotion.audit import Audit, audit
from egs_warp.locomotion.ledger import EnergyBalance, EnergyTotals
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.trajectory import MotionOutcome, Trajectory, measure
from egs_warp.motions.sequence import MotionRecord, spans_of
from egs_warp.pipelines.creature import Creature
from egs_warp.pipelines.end_state import EndCause, State
from egs_warp.version import __version__

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SCHEMA_VERSION = 1
MECHANICS = ("warp-lang", "numpy", "scipy", "osqp", "pytetwild")
"""Packages that decide how a body moves."""
NO_METADATA = "no metadata"
"""In place of the version of a package that is missing, or was copied without its ``dist-info``."""


def versions(names: Sequence[str] = MECHANICS) -> dict[str, str]:
    """Of the package, Python and the packages ``names``, which the numbers depend on.

    One whose version is not known is told as ``NO_METADATA``: whoever asks has finished work, which must not be lost.
    """
    return {
        "egs-warp": __version__,
        "python": platform.python_version(),
        **{name: installed_version(name) or NO_METADATA for name in names},
    }


def installed_version(name: str) -> str | None:
    """None where nothing tells it."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


@dataclass(frozen=True)
class MotionReport:
    """One motion: asked, planned, reached."""

    name: str
    asked: Mapping[str, float]
    """Lengths in body heights."""
    planned: DataclassInstance
    """The record of its state machine."""
    reached: MotionOutcome
    state: State
    also_reached: DataclassInstance | None
    """The record of what only such a motion is measured by."""
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """One element of ``motion``."""
        also = asdict(self.also_reached) if self.also_reached is not None else {}
        return {
            "name": self.name,
            "asked": dict(self.asked),
            "planned": asdict(self.planned),
            "reached": {**asdict(self.reached), **also},
            "state": self.state.value,
            "notes": list(self.notes),
        }

    def summary(self) -> list[str]:
        """For the terminal."""
        reached = asdict(self.reached)
        pairs = [
            f"{name} {reached[name]:.3f}" + (f" of {self.asked[name]:g}" if name in self.asked else "")
            for name in ("distance", "height", "heading_degrees")
        ]
        line = (
            f"{self.name}: {', '.join(pairs)}, tilt {self.reached.tilt_degrees:.1f} degrees, "
            f"airborne {self.reached.airborne_frames:.0f} frames (lengths in body heights)"
        )
        return [line, *(f"note: {note}" for note in self.notes)]


@dataclass(frozen=True)
class QpCounts:
    """Quadratic programs solved a frame."""

    mean_per_frame: float
    worst_per_frame: int
    infeasible: int
    """In all."""

    @classmethod
    def of(cls, reports: Sequence[StepReport], frames: np.ndarray) -> QpCounts:
        """Of ``reports``; ``frames`` (n,) are indices into the trajectory's times."""
        counts = np.array([0, *(report.qp_count for report in reports)])
        per_frame = np.diff(np.cumsum(counts)[frames]) if len(frames) > 1 else np.zeros(1)
        infeasible = int(sum(report.qp_infeasible for report in reports))
        return cls(float(per_frame.mean()), int(per_frame.max()), infeasible)


@dataclass(frozen=True)
class StageTime:
    """Milliseconds a frame."""

    mean: float
    worst: float


def stage_times(
    reports: Sequence[StepReport], frames: np.ndarray, drawing: Mapping[str, Sequence[float]]
) -> dict[str, StageTime]:
    """By stage; one that a frame does without takes it no time. ``drawing`` holds the milliseconds of each drawn frame
    by stage.
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
    """The simulated mesh."""

    nodes: int
    tets: int
    min_dihedral_degrees: float
    mass: float
    """kg."""


@dataclass(frozen=True)
class MuscleFacts:
    """The muscles."""

    fibres: int
    segments: int


@dataclass(frozen=True)
class GaussianCounts:
    """Gaussians on their way from the capture to the pictures."""

    read: int
    """In the capture."""
    drawn: int
    """In the pictures; splitting has added the rest."""
    left_out_of_contact: int
    left_out_of_contact_opacity: float
    """Share of the opacity mass."""

    @classmethod
    def of(cls, creature: Creature, drawn: int | None = None) -> GaussianCounts:
        """Of pictures with so many ``drawn``; all of the capture, unsplit, if None."""
        read, geometry = creature.cloud.count, creature.geometry
        return cls(read, read if drawn is None else drawn, geometry.excluded_count, geometry.excluded_opacity)

    def to_json(self) -> dict[str, Any]:
        """``gaussians``."""
        return {
            "in": self.read,
            "split": self.drawn - self.read,
            "out": self.drawn,
            "left_out_of_contact": self.left_out_of_contact,
            "left_out_of_contact_opacity": self.left_out_of_contact_opacity,
        }


@dataclass(frozen=True)
class Report:
    """Everything that ``report.json`` says."""

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
    """For the user."""
    device: str
    seed: int
    asked: Mapping[str, Any] = field(default_factory=dict)
    """Everything else that was asked."""
    versions: Mapping[str, str] = field(default_factory=versions)

    @property
    def state(self) -> State:
        """How the run ended."""
        return State.worst(tuple(motion.state for motion in self.motion))

    def to_json(self) -> dict[str, Any]:
        """The whole report, ready for JSON."""
        return {
            "schema": SCHEMA_VERSION,
            "source": self.source,
            "state": self.state.value,
            "asked": dict(self.asked),
            "motion": [motion.to_json() for motion in self.motion],
            "audit": asdict(self.audit),
            "energy": asdict(self.energy),
            "qp": asdict(self.qp),
            "timing": {stage: asdict(time) for stage, time in self.timing.items()},
            "cage": asdict(self.cage),
            "muscles": asdict(self.muscles),
            "gaussians": self.gaussians.to_json(),
            "notes": list(self.notes),
            "versions": dict(self.versions),
            "device": self.device,
            "seed": self.seed,
        }

    def write(self, path: Path) -> None:
        """``report.json``, whole or not at all."""
        write_report(path, self.to_json())

    def summary(self) -> str:
        """A few lines for the terminal."""
        lines = [line for motion in self.motion for line in motion.summary()]
        lines.append(f"muscle work: {self.energy.muscle_work:.2f} of the energy that lifts the body by its height")
        lines.append(verdict(self.audit))
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


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
"""Beyond these a run is not what the equations say (docs/guide/report.md)."""


def verdict(found: Audit) -> str:
    """One line: whether the run obeys its equations, and by how much not."""
    values = asdict(found)
    # Not "value > limit": NaN is beyond, too.
    beyond = {name: value for name, value in values.items() if not value <= AUDIT_LIMITS[name]}
    if beyond:
        said = ", ".join(f"{name} {value:.2g} (at most {AUDIT_LIMITS[name]:g})" for name, value in beyond.items())
        return f"audit: FAILED: {said}"
    return "audit: passed (" + ", ".join(f"{name} {value:.2g}" for name, value in values.items()) + ")"


def report_of_run(
    creature: Creature,
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
    asked: Mapping[str, Any],
    ending: EndCause | None = None,
) -> Report:
    """Of the motions ``done`` on a ``trajectory`` with its ``books``; ``frames`` (n,) are indices into its times.
    ``ending`` says what ended the last motion before its time.

    ``gaussians`` are those of its pictures, ``drawing`` the milliseconds of each by stage.
    """
    mesh = creature.cage.mesh
    return Report(
        source=source,
        motion=_motion_reports(trajectory, done, ending or EndCause()),
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
    )


def _motion_reports(trajectory: Trajectory, done: Sequence[MotionRecord], ending: EndCause) -> tuple[MotionReport, ...]:
    reports = []
    for entry, (first, last) in zip(done, spans_of(done, trajectory.time), strict=True):
        reached = measure(trajectory, first=first, last=last)
        state, why = ending.of(entry, reached, last=entry is done[-1])
        also = entry.motion.outcome_record(trajectory, first, last)
        notes = (*entry.motion.notes(), *why)
        reports.append(MotionReport(entry.name, entry.asked, entry.motion.plan_record(), reached, state, also, notes))
    return tuple(reports)


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """Write ``report`` as indented JSON; the file appears whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(report, indent=2) + "\n")
