"""Muscles (Eq. 7): fibres that consist of segments with end points embedded in the body; each segment is an
actuator."""

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
from egs_warp.short_repr import short_repr

_MIN_AUTOMATIC_EDGES = 0.25
"""Minimum segment length of an automatic fibre, in mean edge lengths; both ends of a shorter segment would be attached
to the same nodes."""
_MAX_STRESS, _MAX_LEG_STRESS = 2.0, 1.0
"""Maximum total force of the longitudinal fibres of a section per area of the section, in units of E: in general, and
for a body on three legs or more. In slender legs, muscles with a value above 1 crush the leg, and muscles with a value
of 0.4 saturate in the thrust and on landing."""


@dataclass(frozen=True)
class MuscleSet:
    """All muscle segments of a body.

    In the shapes below, P is the number of end points, M the number of segments, F the number of fibres, and N the
    number of nodes.
    """

    __repr__ = short_repr

    end_rows: sp.csr_matrix
    """(P, N) float64, B: the end points are B p for node positions p; non-negative, each row sums to 1."""
    segments: np.ndarray
    """(M, 2) int32, end points (i, k) of each segment."""
    rest_lengths: np.ndarray
    """(M,) float64, m, distances between the end points at rest."""
    stiffness: np.ndarray
    """(M,) float64, N/m, k_j = F_max / (s_max L_j)."""
    bounds: np.ndarray
    """(M,) float64, m, bounds of the activations, |a_j| <= s_max L_j."""
    fibre_from_segment: np.ndarray
    """(M,) int32, fibre of each segment."""
    fibre_kinds: tuple[FibreKind, ...]
    """(F,) kind of each fibre."""
    fibre_names: tuple[str, ...]
    """(F,) unique name of each fibre."""
    fibre_groups: np.ndarray
    """(F,) int32, group of each fibre: a branch of the body, or a group named in the user's file."""
    fibre_partners: np.ndarray
    """(F,) int32, index of the mirror image of each fibre, -1 for none."""

    @property
    def segment_count(self) -> int:
        """Number of segments M."""
        return len(self.segments)

    @property
    def node_count(self) -> int:
        """Number of nodes N."""
        return self.end_rows.shape[1]  # pyright: ignore[reportOptionalSubscript]

    @property
    def fibre_count(self) -> int:
        """Number of fibres F."""
        return len(self.fibre_names)

    @property
    def max_forces(self) -> np.ndarray:
        """(M,) float64, N, force of each segment at the bound of its activation."""
        return self.stiffness * self.bounds

    @cached_property
    def difference_rows(self) -> sp.csr_matrix:
        """(M, N) float64, rows B_k - B_i: the vector of a segment from end i to end k is (B_k - B_i) p."""
        rows = (self.end_rows[self.segments[:, 1]] - self.end_rows[self.segments[:, 0]]).tocsr()
        rows.sort_indices()
        return rows

    def segments_of_kind(self, *kinds: FibreKind) -> np.ndarray:
        """Return the indices (int64) of the segments of fibres of the given kinds."""
        chosen = np.array([kind in kinds for kind in self.fibre_kinds], dtype=bool)
        return np.flatnonzero(chosen[self.fibre_from_segment])

    def end_points(self, positions: np.ndarray) -> np.ndarray:
        """Return the end points B p (P, 3) m for node positions p (N, 3)."""
        return self.end_rows @ positions

    def lengths(self, positions: np.ndarray) -> np.ndarray:
        """Return the length (M,) m of each segment for node positions (N, 3)."""
        return np.linalg.norm(self.difference_rows @ positions, axis=1)


def attach_fibres(
    mesh: TetMesh, fibres: Sequence[Fibre], *, max_strain: float = 0.3, radius: float | None = None
) -> MuscleSet:
    """Attach fibres to the nodes of ``mesh``; every edge of a polyline becomes a segment.

    Args:
        mesh: cage at rest, m.
        fibres: at least one fibre; names are unique.
        max_strain: maximum strain s_max of a segment.
        radius: width of the attachments, m, see ``attachment_rows``; default: the mean edge length.

    Raises:
        UserError: there is no fibre, a name occurs twice, or the attached ends of a segment coincide.
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
    """Create muscles for any body: fibres of every kind along each branch of its skeleton (docs/concepts/muscles.md).

    The strength of the muscles is reduced where the body is thin: the total force of all longitudinal fibres of a
    section is at most ``_MAX_STRESS`` E times the area of the section, or ``_MAX_LEG_STRESS`` E times it for a body on
    three legs or more.

    Args:
        mesh: cage at rest, m.
        plane_normal: (3,) normal of the ground plane, pointing to the body.
        body_weight: weight of the body, N.
        height: extent along the normal, m.
        strength: maximum force F_max of a segment, in body weights.
        max_strain: maximum strain s_max of a segment.
        young_modulus: E, Pa; default: the value for a sag of 0.05, body_weight height / (0.05 volume).
        max_segments: maximum number of segments; default as in ``lay_fibres``.
    """
    volume = float(mesh.volumes().sum())
    young = young_modulus or body_weight * height / (volume * 0.05)
    branches = skeleton(mesh, plane_normal)
    fibres = lay_fibres(
        mesh,
        branches,
        max_force=strength * body_weight,
        max_stress=(_MAX_LEG_STRESS if is_legged(branches) else _MAX_STRESS) * young,
        max_segments=max_segments,
    )
    return attach_fibres(mesh, _long_enough(mesh, fibres), max_strain=max_strain)


def _long_enough(mesh: TetMesh, fibres: Sequence[Fibre]) -> list[Fibre]:
    """Return the fibres whose segments still have the minimum length after their ends have been attached to nodes."""
    attached = attachment_rows(mesh, np.concatenate([fibre.points for fibre in fibres])) @ mesh.nodes
    polylines = np.split(attached, np.cumsum([len(fibre.points) for fibre in fibres])[:-1])
    shortest = _MIN_AUTOMATIC_EDGES * mean_edge_length(mesh)
    return [
        fibre
        for fibre, points in zip(fibres, polylines, strict=True)
        if np.linalg.norm(np.diff(points, axis=0), axis=1).min() >= shortest
    ]
