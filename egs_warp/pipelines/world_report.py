"""``report.json`` of a world: the state of each body, and the audit of each body and of each pair of bodies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from egs_warp.locomotion.joint_audit import JointAudit
from egs_warp.locomotion.world_audit import PairAudit, WorldAudit
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.report import AUDIT_LIMITS, JsonValue, Report, exceeded_limits, versions
from egs_warp.short_repr import short_repr

SCHEMA_VERSION = 2
WORLD_AUDIT_LIMITS = {
    "momentum_residual": 1e-6,
    "angular_momentum_residual": 1e-6,
    "unmatched_contacts": 0,
    "force_residual": 1e-6,
    "torque_residual": 1e-6,
    "cone_violation": 1e-4,
    "friction_gap": 1e-5,
    "complementarity_gap": 1e-4,
    "gap_error": 1e-6,
    "normal_error": 1e-6,
    "penetration": 1e-2,
    "gap": 1e-6,
    "unmatched_forces": 0,
    "work_residual": 1e-6,
}
"""Upper limits of the values of ``WorldAudit``, ``PairAudit`` and ``JointAudit``; works have no limits. Errors of
contacts between bodies have the same limits as those of contacts with the ground (``AUDIT_LIMITS``)."""


@dataclass(frozen=True)
class Penetration:
    """Deepest penetration of a body."""

    bodies: tuple[str, ...]
    """Names of the body and, if it is inside another body and not below the ground, of that body."""
    time: float
    """Time of the state, s."""
    depth: float
    """Depth, m."""

    @property
    def advice(self) -> str:
        """Time and depth, and what to do, for messages."""
        return (
            f"{100.0 * self.depth:.2g} cm deep at {self.time:.2f} s; look at the film there, and if it shows, change"
            " the motion or the distance of the bodies"
        )


@dataclass(frozen=True)
class WorldReport:
    """Contents of the ``report.json`` of a world, and the report of each body."""

    __repr__ = short_repr

    bodies: Mapping[str, Report]
    """Reports by the names of the bodies."""
    results: Mapping[str, str]
    """One line for each body: the values that the motions of a creature have reached, or the displacement of a prop."""
    audit: WorldAudit
    """Audit of the contacts and joints between the bodies and of the momentum of the world."""
    stopped: bool
    """True if the run ended at a step that could not be solved."""
    film: str | None = None
    """Name of the video in the folder of the run; None if there is no film."""
    notes: tuple[str, ...] = ()
    """Notes for the user."""
    asked: Mapping[str, JsonValue] = field(default_factory=dict)
    """Contents of the world file and options of the run, ready for JSON."""
    video: Mapping[str, JsonValue] | None = None
    """Options with which the video was drawn; None if there is no film."""
    scene: Mapping[str, JsonValue] | None = None
    """Frame of the world in the capture of its scene, and number of drawn obstacles; None for a world without a
    scene."""
    penetrations: Mapping[str, Penetration] = field(default_factory=dict)
    """Deepest penetration of each body for which it exceeds the limit."""

    @property
    def state(self) -> State:
        """Worst state of all bodies."""
        states = tuple(report.state for report in self.bodies.values())
        return State.STOPPED if self.stopped else State.worst(states)

    def pair_names(self, pair: PairAudit) -> tuple[str, str]:
        """Return the names of the two bodies of a pair; they are equal for a body with itself."""
        names = list(self.bodies)
        first, second = pair.bodies
        return names[first], names[second]

    def _pair_text(self, pair: PairAudit) -> str:
        first, second = self.pair_names(pair)
        return f"{first} and {'itself' if first == second else second}"

    def joint_names(self, joint: JointAudit) -> tuple[str, ...]:
        """Return the names of the bodies of a joint."""
        names = list(self.bodies)
        return tuple(names[body] for body in joint.bodies)

    def to_json(self) -> dict[str, JsonValue]:
        """Return the whole report, ready for JSON."""
        audit, (audits, _) = asdict(self.audit), self._audits_of_bodies()
        for pair, entry in zip(self.audit.pairs, audit["pairs"], strict=True):
            entry["bodies"] = list(self.pair_names(pair))
        for joint, entry in zip(self.audit.joints, audit["joints"], strict=True):
            entry["bodies"] = list(self.joint_names(joint))
        return {
            "schema": SCHEMA_VERSION,
            "state": self.state.value,
            "bodies": {
                name: {
                    "state": report.state.value,
                    "result": self.results[name],
                    "audit": audits[name],
                    "report": f"{name}/report.json",
                }
                for name, report in self.bodies.items()
            },
            "audit": {**audit, "pairs": list(audit["pairs"]), "joints": list(audit["joints"])},
            "verdict": self.verdict(),
            "film": self.film,
            "video": None if self.video is None else dict(self.video),
            "scene": None if self.scene is None else dict(self.scene),
            "notes": list(self.notes),
            "asked": dict(self.asked),
            "versions": versions(),
        }

    def _audits_of_bodies(self) -> tuple[dict[str, str], dict[frozenset[str], tuple[float, str]]]:
        """Return the verdict about each body without its penetration of another body of a pair; and the largest such
        penetration of each pair, in body heights, with its advice."""
        pairs = {frozenset(self.pair_names(pair)) for pair in self.audit.pairs}
        audits: dict[str, str] = {}
        between: dict[frozenset[str], tuple[float, str]] = {}
        for name, report in self.bodies.items():
            values, advice = asdict(report.audit), ""
            if (found := self.penetrations.get(name)) is not None:
                advice, names = f", {found.advice}", frozenset(found.bodies)
                if len(names) > 1 and names in pairs:
                    between[names] = max(between.get(names, (0.0, "")), (values.pop("penetration"), advice))
                    advice = ""
            audits[name] = _verdict(values, AUDIT_LIMITS) + advice
        return audits, between

    def failures(self) -> list[str]:
        """Return one line for each body, pair or joint whose audit has failed, and one for the world if its audit has
        failed. The penetration of two bodies, which the audits of both contain, is in the line of the pair."""
        audits, between = self._audits_of_bodies()
        parts = list(audits.items())
        parts.append(("world", _verdict(asdict(self.audit), WORLD_AUDIT_LIMITS)))
        for pair in self.audit.pairs:
            values = asdict(pair)
            depth, advice = between.get(frozenset(self.pair_names(pair)), (0.0, ""))
            values["penetration"] = max(values["penetration"], depth)
            parts.append((self._pair_text(pair), _verdict(values, WORLD_AUDIT_LIMITS) + advice))
        parts += [
            (
                f"joint {joint.joint + 1} of {' and '.join(self.joint_names(joint))}",
                _verdict(asdict(joint), WORLD_AUDIT_LIMITS),
            )
            for joint in self.audit.joints
        ]
        return [f"{name}: {text}" for name, text in parts if text != _PASSED]

    def verdict(self) -> str:
        """Return ``audit: passed``, or the lines about failed audits."""
        return "\n".join(self.failures()) or _PASSED

    def summary(self) -> str:
        """Return one line for each body, and the verdict of the audit."""
        return "\n".join([*(f"{name}: {result}" for name, result in self.results.items()), self.verdict()])


_PASSED = "audit: passed"


def _verdict(values: Mapping[str, float], limits: Mapping[str, float]) -> str:
    exceeded = exceeded_limits(values, limits)
    return f"audit: FAILED: {', '.join(exceeded)}" if exceeded else _PASSED
