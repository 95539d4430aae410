"""Props: stiff bodies that deform affinely, as a soft body of one tetrahedron.

Each of the four nodes has a quarter of the mass, and together they have the second moment of the body. So mass, centre
of mass, inertia and the kinetic energy of every affine motion are exact. Young's modulus of the element is scaled by
the ratio of the volumes of body and element, so the elastic energy of every affine deformation is exact too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy.linalg as linalg

from egs_warp.errors import ArgumentError
from egs_warp.fem.assembly_topology import Material
from egs_warp.fem.body import GRAVITY, MAX_HEIGHT, MIN_HEIGHT, SoftBody
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.meshing.occupancy import LatticeSolid

PROP_SAG = 1e-5
"""Default ratio rho g H / E of a prop: about 1 GPa for a height of 1 m."""
_MIN_MOMENT_RATIO = 1e-6
"""Minimum ratio of the principal second moments of a body that has a volume."""
_CORNERS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
"""(4, 3) corners of a regular tetrahedron. Unit masses at the corners have the second moment 4 I."""
_RIGID_MODES = 6


@dataclass(frozen=True)
class VolumeMoments:
    """Moments of a body of uniform density."""

    volume: float
    """Volume, m^3."""
    centre: np.ndarray
    """(3,) m, centre of mass."""
    second_moment: np.ndarray
    """(3, 3) m^2, mean of d d^T over the volume with the offsets d from the centre."""

    @classmethod
    def of_solid(cls, solid: LatticeSolid) -> Self:
        """Return the moments of a captured solid: a cube around each lattice point, cut at the plane z = 0."""
        cells = np.argwhere(solid.inside)
        points, spacing = solid.points(cells), solid.spacing
        heights = np.full(len(cells), spacing)
        on_plane = cells[:, 2] == 0
        heights[on_plane] *= 0.5
        points[on_plane, 2] += 0.25 * spacing
        volumes = spacing**2 * heights
        volume = float(volumes.sum())
        centre = volumes @ points / volume
        second = (points - centre).T @ ((points - centre) * (volumes / volume)[:, None])
        second += np.diag([spacing**2, spacing**2, float(volumes @ heights**2) / volume]) / 12.0
        return cls(volume, centre, second)


def affine_body(
    moments: VolumeMoments,
    height: float,
    *,
    up: np.ndarray,
    sag: float = PROP_SAG,
    poisson_ratio: float = 0.4,
    density: float = 1000.0,
    damping_ratio: float = 0.05,
    device: str | None = None,
) -> SoftBody:
    """Make a prop: a body of one tetrahedron with the mass, the inertia and the stiffness of the whole body.

    Args:
        moments: volume, centre and second moment of the body at rest.
        height: m, extent of the body along ``up``.
        up: (3,) unit vector opposite to gravity.
        sag: ratio rho g H / E, as in ``make_body``. A column shortens by half of this fraction.
        poisson_ratio: Poisson's ratio nu.
        density: kg/m^3.
        damping_ratio: damping ratio of the slowest deformation mode of the free body.
        device: Warp device of the assembly; default: Warp's current device.

    Raises:
        UserError: the height is outside ``MIN_HEIGHT`` to ``MAX_HEIGHT``, or the body is flat.
    """
    if not MIN_HEIGHT <= height <= MAX_HEIGHT:
        raise ArgumentError("height", f"give a height of {MIN_HEIGHT:g} to {MAX_HEIGHT:g} m", value=height)
    squares, axes = np.linalg.eigh(moments.second_moment)
    if not (moments.volume > 0.0 and squares[0] > _MIN_MOMENT_RATIO * squares[-1]):
        raise ArgumentError("moments", "the body is flat or has no volume; give one with a volume")
    root = (axes * np.sqrt(squares)) @ axes.T
    mesh = TetMesh.oriented(moments.centre + _CORNERS @ root, np.array([[0, 1, 2, 3]]))
    node_mass = np.full(4, 0.25 * density * moments.volume)
    # The volume of the element differs from the volume of the body; the factor corrects the elastic energy for it.
    young = density * GRAVITY * height / sag * moments.volume / float(mesh.volumes()[0])
    undamped = ElasticAssembly(mesh, Material(young, poisson_ratio, density, 0.0), device=device)
    frequency = _slowest_deformation(undamped, node_mass)
    damped = Material(young, poisson_ratio, density, 2.0 * damping_ratio / frequency)
    assembly = ElasticAssembly(mesh, damped, device=device)
    return SoftBody(mesh, assembly, node_mass, -GRAVITY * np.asarray(up, float), height)


def _slowest_deformation(assembly: ElasticAssembly, node_mass: np.ndarray) -> float:
    """Return the smallest angular frequency of the free body's deformation modes, rad/s."""
    upper = assembly.matrix(assembly.hessian_entries(assembly.mesh.nodes)).toarray()
    stiffness = upper + np.triu(upper, 1).T
    squares = linalg.eigh(stiffness, np.diag(np.repeat(node_mass, 3)), eigvals_only=True)
    return float(np.sqrt(squares[_RIGID_MODES]))
