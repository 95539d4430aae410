"""Parts of a body that are softer than the rest, so that they lag behind its motion and settle after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from egs_warp.fem.body import SoftBody, first_frequency
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.muscles.muscle_set import MuscleSet

MIN_RELATIVE_STIFFNESS = 0.02
"""Minimum Young's modulus of a part, relative to Young's modulus of the body."""
_CANTILEVER = 12.362 / 8.0
"""w^2 d / g of a uniform cantilever with first frequency w whose tip sags by d under its weight: 1.875^4 / 8."""


def bending_frequency(sag: float, length: float, gravity: float) -> float:
    """Return the first angular frequency, rad/s, of a uniform cantilever.

    Args:
        sag: deflection of its tip under its own weight, as a fraction of its length.
        length: m.
        gravity: m/s^2.
    """
    return float(np.sqrt(_CANTILEVER * gravity / (sag * length)))


def with_soft_parts(body: SoftBody, parts: Sequence[np.ndarray], frequencies: Sequence[float]) -> SoftBody:
    """Return ``body`` with softer parts.

    The elements that touch a part get a smaller Young's modulus, so that the part has the requested first frequency if
    all other nodes are clamped. A part whose frequency is already lower is not changed. Damping is proportional to
    stiffness, so the damping ratio of a part equals ``damping_ratio`` of ``make_body``, times the frequency of the part
    divided by the first frequency of the body.

    Args:
        body: the body.
        parts: (k,) indices of the nodes of each part.
        frequencies: rad/s, for each part.
    """
    assembly, mesh = body.assembly, body.assembly.mesh
    relative = np.ones(len(mesh.tets))
    for part, frequency in zip(parts, frequencies, strict=True):
        free = np.zeros(len(mesh.nodes), dtype=bool)
        free[part] = True
        stiffness = (frequency / first_frequency(assembly, body.node_mass, free)) ** 2
        elements = free[mesh.tets].any(axis=1)
        relative[elements] = np.minimum(relative[elements], np.clip(stiffness, MIN_RELATIVE_STIFFNESS, 1.0))
    if (relative == 1.0).all():
        return body
    material = replace(assembly.material, relative_stiffness=relative)
    return replace(body, assembly=ElasticAssembly(mesh, material, device=str(assembly.device)))


def stiffness_at_nodes(body: SoftBody) -> np.ndarray:
    """Return the mean relative stiffness (N,) of the elements around each node, weighted by their volumes."""
    relative, mesh = body.assembly.material.relative_stiffness, body.mesh
    if relative is None:
        return np.ones(len(mesh.nodes))
    corners, volumes = mesh.tets.ravel(), np.repeat(mesh.volumes(), 4)
    weighted = np.bincount(corners, volumes * np.repeat(relative, 4), len(mesh.nodes))
    return weighted / np.bincount(corners, volumes, len(mesh.nodes))


def stiffness_at_segments(body: SoftBody, muscles: MuscleSet) -> np.ndarray:
    """Return the relative stiffness (M,) of the material on which each muscle segment pulls.

    The nodes of an end are independent springs that share the force by their weights w, so the compliance of the end
    relative to stiff material is sum w^2 / k divided by sum w^2. The two ends of a segment are springs in series. So a
    segment is weak if only one of its ends is in a soft part, which it would otherwise tear out of its shape.
    """
    squares = muscles.end_rows.power(2)
    compliance = squares @ (1.0 / stiffness_at_nodes(body)) / (squares @ np.ones(len(body.node_mass)))
    return 1.0 / compliance[muscles.segments].mean(axis=1)
