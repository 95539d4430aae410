"""Encoding of a finished run for the page: trajectory, creature, report and background scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.geometry.main_light import normalised
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.planes import light_to_json
from egs_warp.lighting.surface_normals import surface_normals
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
"""Name, title on the page, and unit of each curve."""


@dataclass(frozen=True)
class CageArrays:
    """Cage of N nodes and T tetrahedra, and the embedding of n' Gaussians."""

    rest: np.ndarray
    """(N, 3) m, nodes at rest."""
    tets: np.ndarray
    """(T, 4) nodes of the tetrahedra."""
    surface: np.ndarray
    """(B, 3) nodes of the surface triangles."""
    mean_tets: np.ndarray
    """(n',) tetrahedron of the mean of each Gaussian; see ``Deformer.plan``."""
    arms: np.ndarray
    """(r, 15) arms of the r Gaussians that extend over several tetrahedra (``arms_of``)."""


@dataclass(frozen=True)
class Recording(FinishedRun):
    """A finished run that can be encoded as packets."""

    def header(self) -> bytes:
        """Return the header, which contains all data that do not depend on the frame."""
        t, report = self.trajectory, self.report
        facts = {
            "title": self.title,
            "rate": FRAME_RATE,
            "frames": len(self.steps),
            "height": t.height,
            "weight": float(t.node_mass.sum() * np.linalg.norm(t.gravity)),
            "friction": t.friction,
            "front": t.front[:2].tolist(),
            "flat": len(t.planes) == 1 and t.ground_coefficients.size == 0,
            "curves": curve_facts(CURVES),
            "audit": report.get("audit", {}),
            "motion": report.get("motion", []),
            "notes": report.get("notes", []),
        }
        plan = {"plan": t.planned_com[self.steps].astype(np.float32)} if len(t.planned_com) else {}
        deformer = self.deformer()
        return creature_header(
            facts | {"max_stretch": deformer.max_stretch},
            self.creature,
            cage=cage_arrays(self.mesh, deformer),
            node_mass=t.node_mass,
            planes=t.planes,
            scene=self.scene_without_shadow(),
            more=plan,
        )

    def frames(self) -> Iterator[Frame]:
        """Yield the frames at 60 Hz."""
        t = self.trajectory
        curves = body_curves(t)
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
        """Return the header and all frames in the format of a file."""
        return b"".join([self.header(), *(with_length(frame.packet()) for frame in self.frames())])


def curve_facts(curves: Sequence[tuple[str, str, str]]) -> list[dict[str, str]]:
    """Return ``curves`` in the format of the header."""
    return [{"name": name, "title": title, "unit": unit} for name, title, unit in curves]


def creature_header(
    facts: Mapping[str, Any],
    render_data: RenderData,
    *,
    cage: CageArrays,
    node_mass: np.ndarray,
    planes: np.ndarray,
    scene: GaussianCloud | None,
    more: Mapping[str, np.ndarray] | None = None,
) -> bytes:
    """Return the header of a creature, or of several bodies (``joint_header``).

    Args:
        facts: JSON values of the run; the values of the muscles and the camera are added.
        render_data: Gaussians, muscles, feet and camera.
        cage: cage and embedding.
        node_mass: (N,) kg, mass of each node.
        planes: (P, 4) rows n, d of the ground planes.
        scene: background, without the shadow of the object if there is a main light; None if there is no background.
        more: further arrays, by name.
    """
    camera = render_data.camera
    facts = {
        **facts,
        "fibres": [
            {"name": n, "kind": k} for n, k in zip(render_data.fibre_names, render_data.fibre_kinds, strict=True)
        ],
        "camera": {
            "position": camera.centre.tolist(),
            "forward": camera.rotation[2].tolist(),
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.height / camera.fy))),
        },
        "degree": {"splats": render_data.splats.sh_degree, "scene": scene.sh_degree if scene else 0},
        "antialiased": render_data.splats.antialiased,
    }
    arrays = {
        "rest": cage.rest.astype(np.float32),
        "tets": cage.tets.astype(np.int32),
        "node_mass": node_mass.astype(np.float32),
        "planes": planes.astype(np.float32),
        "surface": cage.surface.astype(np.int32),
        "edges": _edges(cage.surface),
        "muscle_end_starts": render_data.muscle_ends.indptr.astype(np.int32),
        "muscle_end_nodes": render_data.muscle_ends.indices.astype(np.int32),
        "muscle_end_weights": render_data.muscle_ends.data.astype(np.float32),
        "muscle_segments": render_data.muscle_segments.astype(np.int32),
        "fibre_from_segment": render_data.fibre_from_segment.astype(np.int32),
        "foot_from_node": render_data.foot_from_node.astype(np.int32),
        "mean_tets": cage.mean_tets,
        "arms": cage.arms,
        **splat_arrays("splats", render_data.splats),
        **(more or {}),
    }
    if scene is not None:
        arrays |= splat_arrays("scene", scene)
    light = render_data.light
    if light is not None:
        facts["light"] = light_to_json(normalised(light))
        arrays["splats_normals"] = np.rint(128.0 + 127.0 * surface_normals(render_data.splats)).astype(np.uint8)
    return header(facts, arrays)


def cage_arrays(mesh: TetMesh, deformer: Deformer) -> CageArrays:
    """Return the arrays of one cage and its embedded Gaussians."""
    return CageArrays(mesh.nodes, mesh.tets, mesh.boundary_faces(), deformer.plan.mean_tets.numpy(), arms_of(deformer))


def _edges(faces: np.ndarray) -> np.ndarray:
    """Return the (E, 2) int32 edges of triangles (F, 3)."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0).astype(np.int32)


def arms_of(deformer: Deformer) -> np.ndarray:
    """Return an array (r, 15) float32: tetrahedra and inside fractions of the six axis ends, and three smoothing
    lengths.

    There is one row for each of the r Gaussians that extend over several tetrahedra, in the order of the Gaussians.
    """
    plan = deformer.plan
    rows = plan.mean_tets.numpy() < 0
    parts = (plan.end_tets.numpy(), plan.inside_fractions.numpy(), plan.smoothing_lengths.numpy())
    return np.concatenate([part[:, rows].T for part in parts], axis=1).astype(np.float32)


def splat_arrays(name: str, cloud: GaussianCloud) -> dict[str, np.ndarray]:
    """Return the arrays of ``cloud``, with names that begin with ``name``.

    SH coefficients v of degree 1 and above are stored as bytes 128 + 127 v / s, where s is the maximum magnitude of
    that coefficient over all Gaussians and colours.
    """
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


def body_curves(t: Trajectory) -> np.ndarray:
    """Return the curves (F+1, K), in the order of ``CURVES``; docs/guide/report.md defines them."""
    mass = float(t.node_mass.sum())
    gravity = float(np.linalg.norm(t.gravity))
    weight, steps = mass * gravity, len(t.time) - 1
    up = -t.gravity / gravity
    com = np.einsum("n,fni->fi", t.node_mass, t.positions) / mass
    normal = np.einsum("ci,ci->c", t.contact_force, t.contact_normal)
    tangent = np.linalg.norm(t.contact_force - normal[:, None] * t.contact_normal, axis=1)
    force = np.zeros((steps, 3))
    np.add.at(force, t.contact_step, t.contact_force)
    by_joints, kicked = np.zeros((steps, 3)), np.zeros((steps, 3))
    np.add.at(by_joints, t.joint_step, t.joint_force)
    if len(t.kick_step):
        np.add.at(kicked, t.kick_step, np.einsum("n,kni->ki", t.node_mass, t.kick_velocity) / t.dt[t.kick_step, None])
    normal_force, tangential_force = np.zeros(steps), np.zeros(steps)
    external = ~t.is_self_contact
    np.add.at(normal_force, t.contact_step[external], normal[external])
    np.add.at(tangential_force, t.contact_step[external], tangent[external])
    momentum = np.einsum("n,fni->fi", t.node_mass, t.velocities)
    external_force = mass * t.gravity + by_joints + force + kicked - t.drag * momentum[1:]
    residual = np.diff(momentum, axis=0) / np.diff(t.time)[:, None] - external_force
    used = tangential_force / np.maximum(t.friction * normal_force, 1e-9 * weight)
    per_step = np.stack(
        [np.linalg.norm(force, axis=1) / weight, used, np.linalg.norm(residual, axis=1) / weight], axis=1
    )
    # No step leads to the initial state, so it gets the values of the first step.
    padded = np.concatenate([per_step[:1] if steps else np.zeros((1, 3)), per_step])
    return np.stack([com @ up / t.height, padded[:, 0], padded[:, 1], t.min_gap / t.height, padded[:, 2]], axis=1)
