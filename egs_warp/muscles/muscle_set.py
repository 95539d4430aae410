"""Muscles (Eq. 7): fibres of segments whose end points are embedded in the body; each segment is one actuator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from egs_warp.errors import UserError
from egs_warp.geometry.tetmesh import TetMesh, mean_edge_length
from egs_warp.muscles.attachments import attachment_rows
from egs_warp.muscles.fibres import Fibre, FibreKind
from egs_warp.muscles.layout import is_legged, lay_fibres
from egs_warp.muscles.skeleton import skeleton

_MIN_AUTOMATIC_EDGES = 0.25
"""An automatic fibre with a segment shorter than this many mean edges is left out: its ends share their nodes."""


@dataclass(frozen=True)
class MuscleSet:
    """All muscle segments of a body. P end points, M segments, F fibres, N nodes."""

    end_rows: sp.csr_matrix
    """(P, N) float64, B: end points are B p; non-negative, each row sums to 1."""
    segments: np.ndarray
    """(M, 2) int32, end points (i, k) of each segment."""
    rest_lengths: np.ndarray
    """(M,) float64, metres, between the weighted centroids at rest."""
    stiffness: np.ndarray
    """(M,) float64, N/m, k_j = F_max / (s_max L_j)."""
    bounds: np.ndarray
    """(M,) float64, metres: |a_j| <= s_max L_j."""
    fibre_from_segment: np.ndarray
    """(M,) int32."""
    fibre_kinds: tuple[FibreKind, ...]
    """(F,)."""
    fibre_names: tuple[str, ...]
    """(F,) unique."""
    fibre_groups: np.ndarray
    """(F,) int32, fibres of one group belong together (one branch of the body)."""
    fibre_partners: np.ndarray
    """(F,) int32, the mirror-image fibre, -1 for none."""

    @property
    def segment_count(self) -> int:
        """M."""
        return len(self.segments)

    @property
    def node_count(self) -> int:
        """N."""
        return self.end_rows.shape[1]  # pyright: ignore[reportOptionalSubscript]

    @property
    def fibre_count(self) -> int:
        """F."""
        return len(self.fibre_names)

    @property
    def max_forces(self) -> np.ndarray:
        """(M,) float64, newtons: the force of each segment at its bound."""
        return self.stiffness * self.bounds

    @cached_property
    def difference_rows(self) -> sp.csr_matrix:
        """(M, N) float64, B_k - B_i of each segment: its extent is (B_k - B_i) p."""
        rows = (self.end_rows[self.segments[:, 1]] - self.end_rows[self.segments[:, 0]]).tocsr()
        rows.sort_indices()
        return rows

    def segments_of_kind(self, *kinds: FibreKind) -> np.ndarray:
        """Indices (int64) of the segments of fibres of the given kinds."""
        chosen = np.array([kind in kinds for kind in self.fibre_kinds], dtype=bool)
        return np.flatnonzero(chosen[self.fibre_from_segment])

    def end_points(self, positions: np.ndarray) -> np.ndarray:
        """(P, 3) metres, B p for node positions (N, 3)."""
        return self.end_rows @ positions

    def lengths(self, positions: np.ndarray) -> np.ndarray:
        """(M,) metres, current length of each segment for node positions (N, 3)."""
        return np.linalg.norm(self.difference_rows @ positions, axis=1)


def attach_fibres(
    mesh: TetMesh, fibres: Sequence[Fibre], *, max_strain: float = 0.3, radius: float | None = None
) -> MuscleSet:
    """Attach fibres to the nodes of ``mesh``: every polyline edge becomes one segment.

    ``max_strain`` is s_max; ``radius`` is the reach of each attachment in metres (default: the mean edge length).
    Raises ``UserError`` if there is no fibre, or a segment's two ends attach to the same place.
    """
    if not fibres:
        raise UserError("muscles: the body has no fibre; give at least one")
    names = [fibre.name for fibre in fibres]
    index_from_name = {name: index for index, name in enumerate(names)}
    if len(index_from_name) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(f'muscles: two fibres are named "{twice}"; give each its own name')
    points, point_from_vertex = np.unique(
        np.concatenate([np.asarray(fibre.points, dtype=np.float64) for fibre in fibres]), axis=0, return_inverse=True
    )
    vertex_starts = np.cumsum([0, *(len(fibre.points) for fibre in fibres)])
    segments = np.concatenate(
        [
            np.stack([point_from_vertex[start : end - 1], point_from_vertex[start + 1 : end]], axis=1)
            for start, end in pairwise(vertex_starts)
        ]
    ).astype(np.int32)
    fibre_from_segment = np.repeat(np.arange(len(fibres)), np.diff(vertex_starts) - 1).astype(np.int32)
    end_rows = attachment_rows(mesh, points, radius=radius)
    ends = end_rows @ mesh.nodes
    rest_lengths = np.linalg.norm(ends[segments[:, 1]] - ends[segments[:, 0]], axis=1)
    for segment in np.flatnonzero(rest_lengths < 1e-3 * mean_edge_length(mesh))[:1]:
        raise UserError(
            f'muscles: a segment of fibre "{names[fibre_from_segment[segment]]}" has no length inside the body; '
            "put its points further apart"
        )
    max_forces = np.concatenate([np.broadcast_to(fibre.max_force, len(fibre.points) - 1) for fibre in fibres])
    bounds = max_strain * rest_lengths
    return MuscleSet(
        end_rows=end_rows,
        segments=segments,
        rest_lengths=rest_lengths,
        stiffness=max_forces / bounds,
        bounds=bounds,
        fibre_from_segment=fibre_from_segment,
        fibre_kinds=tuple(fibre.kind for fibre in fibres),
        fibre_names=tuple(names),
        fibre_groups=np.array([fibre.group for fibre in fibres], dtype=np.int32),
        fibre_partners=np.array([index_from_name.get(fibre.partner or "", -1) for fibre in fibres], dtype=np.int32),
    )


def automatic_muscles(
    mesh: TetMesh,
    plane_normal: np.ndarray,
    *,
    body_weight: float,
    height: float,
    strength: float = 4.0,
    max_strain: float = 0.3,
    young_modulus: float | None = None,
    max_segments: int | None = None,
) -> MuscleSet:
    """Muscles for any body: fibres of every kind along each branch of its curve skeleton (docs/concepts/muscles.md).

    ``plane_normal`` (3,) points away from the ground; ``body_weight`` in newtons; ``height`` in metres along the
    normal; ``strength`` is F_max of a segment in body weights. It is lowered where the body is thin: all longitudinal
    fibres of a section together pull no harder than twice its area times E (``young_modulus``, pascals; default that of
    sag 0.05, body_weight height / (0.05 volume)); of a body on three legs or more, whose legs would crumple, 0.4 times.
    """
    volume = float(mesh.volumes().sum())
    young = young_modulus or body_weight * height / (volume * 0.05)
    branches = skeleton(mesh, plane_normal)
    fibres = lay_fibres(
        mesh,
        branches,
        max_force=strength * body_weight,
        max_stress=(0.4 if is_legged(branches) else 2.0) * young,
        max_segments=max_segments,
    )
    return attach_fibres(mesh, _long_enough(mesh, fibres), max_strain=max_strain)


def _long_enough(mesh: TetMesh, fibres: Sequence[Fibre]) -> list[Fibre]:
    """The fibres whose segments keep their length when their points are spread over nodes."""
    attached = attachment_rows(mesh, np.concatenate([fibre.points for fibre in fibres])) @ mesh.nodes
    polylines = np.split(attached, np.cumsum([len(fibre.points) for fibre in fibres])[:-1])
    shortest = _MIN_AUTOMATIC_EDGES * mean_edge_length(mesh)
    return [
        fibre
        for fibre, points in zip(fibres, polylines, strict=True)
        if np.linalg.norm(np.diff(points, axis=0), axis=1).min() >= shortest
    ]
