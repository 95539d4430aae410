"""Automatic layout of fibres along the branches of a body's curve skeleton."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.geometry.frames import orthonormal_basis
from egs_warp.geometry.tetmesh import TetMesh, mean_edge_length
from egs_warp.muscles.branch_cylinder import BranchCylinder, FibreDensity, Surface
from egs_warp.muscles.fibres import Fibre, FibreKind
from egs_warp.muscles.skeleton import Branch, Skeleton

_DETAILS = (
    FibreDensity(8, 5, 4, 4, 2, 2),
    FibreDensity(8, 4, 3, 2, 1, 2),
    FibreDensity(4, 3, 2, 2, 1, 2),
    FibreDensity(4, 2, 1, 2, 1, 2),
    FibreDensity(4, 2, 1, 2, 1, 1),
    FibreDensity(4, 1, 1, 2, 1, 1),
)
"""Fibre densities, in descending order of the number of segments."""
_LEG_DETAILS = (FibreDensity(4, 4, 1, 2, 1, 1), FibreDensity(4, 3, 1, 1, 1, 1), *_DETAILS[-2:])
"""Fibre densities for each leg of a body with at least ``_MIN_LEGS`` legs, in descending order.

To move a foot forward and set it down flat, a leg bends in opposite directions in its upper and lower parts, which
needs three segments on each of its sides.
"""
_MIN_LEGS = 3
_MAX_SEGMENTS, _MAX_LEGGED_SEGMENTS = 112, 120


def is_legged(skeleton: Skeleton) -> bool:
    """Return True if the body stands on at least ``_MIN_LEGS`` legs."""
    return sum(branch.starts_on_ground for branch in skeleton.branches) >= _MIN_LEGS


def lay_fibres(
    mesh: TetMesh, skeleton: Skeleton, *, max_force: float, max_stress: float, max_segments: int | None = None
) -> list[Fibre]:
    """Lay longitudinal, radial, circular and oblique fibres on every branch.

    If there are too many branches for the maximum number of segments, the branches with the smallest volume get no
    fibres.

    Args:
        mesh: cage at rest, m.
        skeleton: curve skeleton of the mesh.
        max_force: maximum force of a segment, N.
        max_stress: maximum total force of the longitudinal fibres of a section per area of the section, Pa.
        max_segments: maximum number of segments; default: 112, or 120 for a body on three legs or more.
    """
    edge = mean_edge_length(mesh)
    surface = Surface(mesh)
    forward = _principal_horizontal(mesh, skeleton.up)
    fibres: list[Fibre] = []
    for group, (branch, detail) in enumerate(_share_segments(skeleton, edge, max_segments)):
        tube = BranchCylinder(branch, skeleton.up, forward, surface, edge, detail)
        name = "trunk" if group == 0 else f"limb {group}"
        fibres += tube.fibres(name, group, max_force=max_force, max_stress=max_stress)
    return _with_partners(fibres, _centre(mesh), skeleton.up, forward, tolerance=0.75 * edge)


def _share_segments(skeleton: Skeleton, edge: float, budget: int | None) -> list[tuple[Branch, FibreDensity]]:
    """Return the branches with their fibre densities; similar branches, such as the four legs of a stool, have the
    same density."""
    legged = is_legged(skeleton)
    budget = budget or (_MAX_LEGGED_SEGMENTS if legged else _MAX_SEGMENTS)
    families: list[list[Branch]] = []
    for branch in skeleton.branches:
        like = families[-1][0] if families else None
        if legged and like and like.starts_on_ground != branch.starts_on_ground:
            like = None
        if like and branch.volume > 0.7 * like.volume and 0.75 < branch.length / like.length < 1.33:
            families[-1].append(branch)
        else:
            families.append([branch])
    levels = [0] * len(families)
    ladders = [_LEG_DETAILS if legged and family[0].starts_on_ground else _DETAILS for family in families]

    def detail(family: int) -> FibreDensity:
        chosen = ladders[family][levels[family]]
        shortest = min(branch.length for branch in families[family])
        return replace(chosen, intervals=int(np.clip(round(shortest / (1.2 * edge)), 1, chosen.intervals)))

    def count(family: int) -> int:
        return len(families[family]) * detail(family).segment_count()

    def reduction_priority(family: int) -> tuple[bool, float]:
        """Return the sort key by which the families of branches are chosen for reduction: number of segments divided by
        the square root of the volume.

        The volume of legs counts twice, because only legs act on the ground; the legs of a body on many legs are
        reduced last.
        """
        volume = sum(branch.volume * (2.0 if branch.starts_on_ground else 1.0) for branch in families[family])
        return ladders[family] is _DETAILS, count(family) / volume**0.5

    while sum(count(family) for family in range(len(families))) > budget:
        reducible = [family for family in range(len(families)) if levels[family] < len(ladders[family]) - 1]
        if reducible:
            levels[max(reducible, key=reduction_priority)] += 1
        elif len(families) > 1:
            families.pop()
            levels.pop()
        else:
            break
    return [(branch, detail(index)) for index, family in enumerate(families) for branch in family]


def _centre(mesh: TetMesh) -> np.ndarray:
    return np.average(mesh.nodes, axis=0, weights=mesh.lumped_masses(1.0))


def _principal_horizontal(mesh: TetMesh, up: np.ndarray) -> np.ndarray:
    """Return the horizontal unit vector (3,) along which the body is widest, or a fixed one for a round body.

    The sign of the vector is chosen such that it does not depend on rounding.
    """
    plane = np.stack(orthonormal_basis(up))
    flat = (mesh.nodes - _centre(mesh)) @ plane.T
    second_moments = (flat * mesh.lumped_masses(1.0)[:, None]).T @ flat
    values, vectors = np.linalg.eigh(second_moments)
    if values[1] < 1.1 * values[0]:
        return plane[0]
    widest = vectors[:, 1] @ plane
    return widest * (1.0 if widest[int(np.argmax(np.abs(widest)))] > 0 else -1.0)


_MIRRORED = {FibreKind.OBLIQUE_LEFT: FibreKind.OBLIQUE_RIGHT, FibreKind.OBLIQUE_RIGHT: FibreKind.OBLIQUE_LEFT}


def _with_partners(
    fibres: list[Fibre], centre: np.ndarray, up: np.ndarray, forward: np.ndarray, *, tolerance: float
) -> list[Fibre]:
    """Return the fibres with their mirror images as partners. Of the two vertical principal planes, the mirror plane is
    the one in which more fibres have a mirror image."""
    best: dict[str, str] = {}
    for normal in (forward, np.cross(up, forward)):
        images: dict[str, str] = {}
        for fibre in fibres:
            image = fibre.points - 2.0 * ((fibre.points - centre) @ normal)[:, None] * normal
            candidates = [
                (distance, other.name)
                for other in fibres
                if other.kind is _MIRRORED.get(fibre.kind, fibre.kind)
                and (distance := _polyline_distance(image, other.points)) < tolerance
            ]
            if candidates:
                images[fibre.name] = min(candidates)[1]
        mutual = {name: other for name, other in images.items() if images.get(other) == name}
        if len(mutual) > len(best):
            best = mutual
    return [replace(fibre, partner=best.get(fibre.name)) for fibre in fibres]


def _polyline_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return the symmetric Hausdorff distance, m, of the vertices of two polylines; infinite if their numbers
    differ."""
    if len(first) != len(second):
        return float("inf")
    apart = np.linalg.norm(first[:, None] - second[None], axis=2)
    return float(max(apart.min(axis=0).max(), apart.min(axis=1).max()))
