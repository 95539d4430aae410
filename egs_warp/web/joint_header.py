"""Header of a page that shows several bodies: their cages, muscles and splats are concatenated, as if they belonged to
one creature.

Indices of nodes, tetrahedra, ends of muscles, fibres and feet are shifted, so that every layer of the page draws all
bodies. The entry ``bodies`` of the facts lists the part of each body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import numpy as np
import scipy.sparse as sp

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.joint_deformer import JointDeformer
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.meshing.level_set import LevelSet
from egs_warp.pipelines.drawn_cage import DrawnCage
from egs_warp.pipelines.render_data import RenderData
from egs_warp.short_repr import short_repr
from egs_warp.web.recording import CageArrays, arms_of, creature_header


@dataclass(frozen=True)
class PageBody:
    """A body of a page with several bodies."""

    __repr__ = short_repr

    name: str
    render_data: RenderData
    """Gaussians and muscles of the body."""
    cage: DrawnCage
    """Cage with the surface that is drawn."""
    level_set: LevelSet
    """Level set at rest, from which the page computes the body's contact shadows on other bodies."""
    height: float
    """Height of the body, m."""
    node_mass: np.ndarray
    """(C,) kg, masses of the nodes of the cage that the solver uses."""
    deformer: Deformer
    facts: Mapping[str, Any]
    """Further facts about the body for the page, such as its row of the report."""

    @property
    def is_creature(self) -> bool:
        """True if the body has muscles."""
        return len(self.render_data.muscle_segments) > 0


def node_starts(bodies: Sequence[PageBody]) -> list[int]:
    """Return the index of the first joint node of each body."""
    return _starts([len(body.cage.nodes) for body in bodies])


def joint_header(
    facts: Mapping[str, Any],
    bodies: Sequence[PageBody],
    planes: np.ndarray,
    *,
    scene: GaussianCloud | None = None,
    more: Mapping[str, np.ndarray] | None = None,
) -> bytes:
    """Return the header of several bodies.

    Args:
        facts: JSON values of the run, as for ``creature_header``.
        bodies: The bodies.
        planes: (P, 4) rows n, d of the ground planes.
        scene: Gaussians of the background; None if there is none.
        more: Further arrays by name.
    """
    nodes, counts = node_starts(bodies), [len(body.cage.nodes) for body in bodies]
    splats = [body.render_data.splats.count for body in bodies]
    tets = _starts([len(body.cage.tets) for body in bodies])
    parts = [
        {
            **body.facts,
            "name": body.name,
            "creature": body.is_creature,
            "nodes": [node, count],
            "splats": [splat, splat_count],
            "tets": [tet, len(body.cage.tets)],
            "height": body.height,
            "level_set": {
                "origin": body.level_set.origin.tolist(),
                "spacing": body.level_set.spacing,
                "counts": list(body.level_set.coefficients.shape),
            },
        }
        for body, node, count, splat, splat_count, tet in zip(
            bodies, nodes, counts, _starts(splats), splats, tets, strict=True
        )
    ]
    joint = JointDeformer([body.deformer for body in bodies])
    data = _joint_render_data(bodies, nodes, counts)
    mean_tets, arms = [], []
    for body, tet in zip(bodies, tets, strict=True):
        codes = body.deformer.plan.mean_tets.numpy()
        # A splat with arms has the code -1 - t for the tetrahedron t.
        mean_tets.append(np.where(codes < 0, codes - tet, codes + tet).astype(np.int32))
        rows = arms_of(body.deformer)
        rows[:, :6] += tet
        arms.append(rows)
    return creature_header(
        {**facts, "bodies": parts, "max_stretch": bodies[0].deformer.max_stretch},
        replace(data, splats=joint.rest),
        cage=CageArrays(
            rest=np.concatenate([body.cage.nodes for body in bodies]),
            tets=np.concatenate([body.cage.tets + node for body, node in zip(bodies, nodes, strict=True)]),
            surface=np.concatenate([body.cage.surface + node for body, node in zip(bodies, nodes, strict=True)]),
            mean_tets=np.concatenate(mean_tets),
            arms=np.concatenate(arms),
        ),
        node_mass=np.concatenate([_padded(body.node_mass, count) for body, count in zip(bodies, counts, strict=True)]),
        planes=planes,
        scene=scene,
        more={"level_sets": np.concatenate([body.level_set.coefficients.ravel() for body in bodies]), **(more or {})},
    )


def _joint_render_data(bodies: Sequence[PageBody], nodes: Sequence[int], counts: Sequence[int]) -> RenderData:
    """Return the muscles and feet of all bodies; the Gaussians of the result are those of the first body."""
    all_data = [body.render_data for body in bodies]
    end_counts = [len(data.muscle_ends.indptr) - 1 for data in all_data]
    ends = _starts(end_counts)
    fibres = _starts([len(data.fibre_names) for data in all_data])
    feet = _starts([int(data.foot_from_node.max(initial=-1)) + 1 for data in all_data])
    widened = [
        sp.csr_matrix((data.muscle_ends.data, data.muscle_ends.indices, data.muscle_ends.indptr), (rows, count))
        for data, count, rows in zip(all_data, counts, end_counts, strict=True)
    ]
    foot_from_node = [
        _padded(np.where(data.foot_from_node >= 0, data.foot_from_node + foot, -1), count, -1)
        for data, foot, count in zip(all_data, feet, counts, strict=True)
    ]
    return replace(
        all_data[0],
        muscle_ends=sp.csr_matrix(sp.block_diag(widened)),
        muscle_segments=np.concatenate([d.muscle_segments + end for d, end in zip(all_data, ends, strict=True)]),
        muscle_bounds=np.concatenate([data.muscle_bounds for data in all_data]),
        fibre_from_segment=np.concatenate(
            [data.fibre_from_segment + fibre for data, fibre in zip(all_data, fibres, strict=True)]
        ),
        fibre_names=tuple(f"{body.name}: {name}" for body in bodies for name in body.render_data.fibre_names),
        fibre_kinds=tuple(kind for data in all_data for kind in data.fibre_kinds),
        foot_from_node=np.concatenate(foot_from_node),
    )


def joint_positions(bodies: Sequence[PageBody], poses: Sequence[np.ndarray]) -> np.ndarray:
    """Return the positions (N, 3) m of all joint nodes, for the nodal positions ``poses`` (C, 3) m of each body."""
    return np.concatenate([body.cage.positions(pose) for body, pose in zip(bodies, poses, strict=True)])


def _starts(counts: Sequence[int]) -> list[int]:
    return list(accumulate(counts, initial=0))[:-1]


def _padded(values: np.ndarray, count: int, value: float = 0) -> np.ndarray:
    """Return ``values`` (n,), extended to ``count`` entries by repetitions of ``value``."""
    return np.concatenate([values, np.full(count - len(values), value, values.dtype)])
