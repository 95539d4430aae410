"""A finished run as the page is sent it: ``trajectory.npz``, ``creature.npz``, ``report.json`` and the scene behind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.render_data import RenderData
from egs_warp.web.packets import Frame, header, with_length

CURVES = (
    ("height", "Centre of mass", "H"),
    ("force", "Ground force", "m g"),
    ("friction", "Friction used", "of the cone"),
    ("gap", "Smallest gap", "H"),
    ("residual", "Momentum residual", "m g"),
)
"""Name, what the page calls it, and its unit."""


@dataclass(frozen=True)
class Recording(FinishedRun):
    """A finished run as packets."""

    def header(self) -> bytes:
        """All that does not change from frame to frame."""
        t, report = self.trajectory, self.report
        facts = {
            "title": self.title,
            "rate": FRAME_RATE,
            "frames": len(self.steps),
            "height": t.height,
            "weight": float(t.node_mass.sum() * np.linalg.norm(t.gravity)),
            "friction": t.friction,
            "curves": curve_facts(CURVES),
            "audit": report.get("audit", {}),
            "motion": report.get("motion", []),
            "notes": report.get("notes", []),
        }
        plan = {"plan": t.planned_com[self.steps].astype(np.float32)} if len(t.planned_com) else {}
        made = (self.creature, self.mesh, t.node_mass, t.planes, self.deformer(), self.scene)
        return creature_header(facts, *made, more=plan)

    def frames(self) -> Iterator[Frame]:
        """At 60 Hz."""
        t = self.trajectory
        curves = _curves(t)
        for index, step in enumerate(self.steps):
            yield Frame(
                index,
                float(t.time[step]),
                t.positions[step],
                self.activations(step),
                np.concatenate(self.contacts(step), axis=1),
                curves[step],
            )

    def bytes(self) -> bytes:
        """The whole run in one piece."""
        return b"".join([self.header(), *(with_length(frame.packet()) for frame in self.frames())])


def curve_facts(curves: Sequence[tuple[str, str, str]]) -> list[dict[str, str]]:
    """``curves`` as a header tells them."""
    return [{"name": name, "title": title, "unit": unit} for name, title, unit in curves]


def creature_header(
    facts: Mapping[str, Any],
    made: RenderData,
    mesh: TetMesh,
    node_mass: np.ndarray,
    planes: np.ndarray,
    deformer: Deformer,
    scene: GaussianCloud | None,
    *,
    more: Mapping[str, np.ndarray] | None = None,
) -> bytes:
    """The header of a creature that is drawn as ``made``: its ``facts`` with those of muscles and camera.

    ``mesh`` is the rest cage; ``planes`` (P, 4) are rows n, d; ``deformer`` carries the splats; ``scene`` is behind;
    ``more``: further arrays.
    """
    camera = made.camera
    facts = {
        **facts,
        "fibres": [{"name": n, "kind": k} for n, k in zip(made.fibre_names, made.fibre_kinds, strict=True)],
        "camera": {
            "position": camera.centre.tolist(),
            "forward": camera.rotation[2].tolist(),
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.height / camera.fy))),
        },
        "degree": {"splats": made.splats.sh_degree, "scene": scene.sh_degree if scene else 0},
    }
    arrays = {
        "rest": mesh.nodes.astype(np.float32),
        "tets": mesh.tets.astype(np.int32),
        "node_mass": node_mass.astype(np.float32),
        "planes": planes.astype(np.float32),
        "surface": mesh.boundary_faces().astype(np.int32),
        "edges": _edges(mesh.boundary_faces()),
        "muscle_end_starts": made.muscle_ends.indptr.astype(np.int32),
        "muscle_end_nodes": made.muscle_ends.indices.astype(np.int32),
        "muscle_end_weights": made.muscle_ends.data.astype(np.float32),
        "muscle_segments": made.muscle_segments.astype(np.int32),
        "fibre_from_segment": made.fibre_from_segment.astype(np.int32),
        "foot_from_node": made.foot_from_node.astype(np.int32),
        "mean_tets": deformer.plan.mean_tets.numpy(),
        "arms": _arms(deformer),
        **_splat_arrays("splats", made.splats),
        **(more or {}),
    }
    if scene is not None:
        arrays |= _splat_arrays("scene", scene)
    return header(facts, arrays)


def _edges(faces: np.ndarray) -> np.ndarray:
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0).astype(np.int32)


def _arms(deformer: Deformer) -> np.ndarray:
    """(n', 15) float32: six tetrahedra, six shares and three bulges of those Gaussians that no one tetrahedron carries
    alone, in their order.
    """
    plan = deformer.plan
    rows = plan.mean_tets.numpy() < 0
    parts = (plan.end_tets.numpy(), plan.inside_fractions.numpy(), plan.smoothing_lengths.numpy())
    return np.concatenate([part[:, rows].T for part in parts], axis=1).astype(np.float32)


def _splat_arrays(name: str, cloud: GaussianCloud) -> dict[str, np.ndarray]:
    """Higher bands of the colour as bytes: 128 + 127 v over the largest of all splats for each coefficient."""
    sh = cloud.sh.numpy()
    rest = sh[:, 1:]
    scale = np.maximum(np.abs(rest).max(axis=(0, 2), initial=0.0), 1e-6).astype(np.float32)
    return {
        f"{name}_means": cloud.means.numpy(),
        f"{name}_rotations": cloud.rotations.numpy(),
        f"{name}_scales": np.exp(cloud.log_scales.numpy()),
        f"{name}_opacities": cloud.opacities().astype(np.float32),
        f"{name}_colours": 0.5 + np.float32(SH_BAND_0) * sh[:, 0],
        f"{name}_bands": np.rint(128.0 + 127.0 * rest / scale[:, None]).astype(np.uint8),
        f"{name}_band_scales": scale,
    }


def _curves(t: Trajectory) -> np.ndarray:
    """(F+1, K) in the order of ``CURVES``; definitions in docs/guide/report.md."""
    mass = float(t.node_mass.sum())
    gravity = float(np.linalg.norm(t.gravity))
    weight, steps = mass * gravity, len(t.time) - 1
    up = -t.gravity / gravity
    com = np.einsum("n,fni->fi", t.node_mass, t.positions) / mass
    normal = np.einsum("ci,ci->c", t.contact_force, t.contact_normal)
    tangent = np.linalg.norm(t.contact_force - normal[:, None] * t.contact_normal, axis=1)
    force = np.zeros((steps, 3))
    np.add.at(force, t.contact_step, t.contact_force)
    kicked = np.zeros((steps, 3))
    if len(t.kick_step):
        np.add.at(kicked, t.kick_step, np.einsum("n,kni->ki", t.node_mass, t.kick_velocity) / t.dt[t.kick_step, None])
    pressed, rubbed = np.zeros(steps), np.zeros(steps)
    np.add.at(pressed, t.contact_step, normal)
    np.add.at(rubbed, t.contact_step, tangent)
    momentum = np.einsum("n,fni->fi", t.node_mass, t.velocities)
    outside = mass * t.gravity + force + kicked - t.drag * momentum[1:]
    residual = np.diff(momentum, axis=0) / np.diff(t.time)[:, None] - outside
    used = rubbed / np.maximum(t.friction * pressed, 1e-9 * weight)
    of_steps = np.stack(
        [np.linalg.norm(force, axis=1) / weight, used, np.linalg.norm(residual, axis=1) / weight], axis=1
    )
    # The first state has no step before it.
    padded = np.concatenate([of_steps[:1] if steps else np.zeros((1, 3)), of_steps])
    return np.stack([com @ up / t.height, padded[:, 0], padded[:, 1], t.min_gap / t.height, padded[:, 2]], axis=1)
