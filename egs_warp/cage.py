"""The cage: a coarse tetrahedral mesh around the object's visible volume, flat where it stands on its plane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import warp as wp
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from egs_warp.errors import UserError
from egs_warp.gaussians import GaussianCloud
from egs_warp.kernels.cage import inside_mesh_kernel
from egs_warp.occupancy import Solid, solid_from_gaussians
from egs_warp.plane import Plane
from egs_warp.stuffing import stuff
from egs_warp.surface_mesher import tetwild
from egs_warp.tetmesh import TetMesh

_MIN_DIHEDRAL_DEGREES = 8.0
_ENCLOSED_AIM = 0.9995
_MAX_GROWTH_STEPS = 6
_THIN_RADIUS = 0.56
"""In lattice cells: a rod of this radius cannot slip between the points of a body-centred cubic lattice, whose covering
radius is sqrt(5)/4."""


class CageMethod(Enum):
    """Which mesher makes the tetrahedra."""

    VOXEL = "voxel"
    """Isosurface stuffing of the voxel solid: the same bits in every run, dihedral angles of 10 degrees and more."""
    TETWILD = "tetwild"
    """fTetWild, for thin parts with fewer nodes. It seeds its random numbers from the system, so two runs give two
    meshes; where it fails or leaves a sliver, VOXEL takes its place."""


@dataclass(frozen=True)
class Cage:
    """A tetrahedral mesh around an object, and what it holds."""

    mesh: TetMesh
    """In the capture's units."""
    method: CageMethod
    """The mesher that made it."""
    min_dihedral_degrees: float
    """Smallest dihedral angle of any tetrahedron."""
    enclosed_opacity_mass: float
    """Share, by opacity, of the object's Gaussian means inside the mesh; floaters and means below the plane do not
    count."""
    floater_opacity_mass: float
    """Share, by opacity, of all Gaussians that hang in the air apart from the object."""
    below_plane_opacity_mass: float
    """Share, by opacity, of all Gaussians whose mean lies below the plane."""
    components: int
    """Pieces connected through faces; 1."""
    dilation: float
    """How far the cage was grown around the occupied space, scene units."""

    @property
    def nodes(self) -> int:
        """Node count."""
        return len(self.mesh.nodes)

    @property
    def tets(self) -> int:
        """Tetrahedron count."""
        return len(self.mesh.tets)

    def height(self, plane: Plane) -> float:
        """Body height H above ``plane``, in the mesh's units."""
        return float(plane.heights(self.mesh.nodes).max())

    def scaled(self, factor: float) -> Cage:
        """The same cage after all lengths are multiplied by ``factor``."""
        return replace(self, mesh=TetMesh(self.mesh.nodes * factor, self.mesh.tets), dilation=self.dilation * factor)


def build_cage(
    cloud: GaussianCloud,
    plane: Plane,
    *,
    target_nodes: int = 500,
    dilation: float = 0.005,
    method: CageMethod = CageMethod.VOXEL,
) -> Cage:
    """Cage of about ``target_nodes`` nodes around the opaque part of ``cloud`` above ``plane``, which it never crosses.

    ``dilation`` is in units of the object's longest side; it is raised until all but 0.05 % of the object's opacity
    mass is inside. The same input gives the same bits (``CageMethod.VOXEL``). DESIGN section 4.

    Raises ``UserError`` for an object without volume (flat, tiny, nothing opaque above the plane).
    """
    if not 50 <= target_nodes <= 20000:
        raise UserError(f"cage: {target_nodes} nodes asked; give a number from 50 to 20000")
    solid = solid_from_gaussians(cloud, plane)
    _refuse_flat(solid)
    weights = np.where(solid.belongs, cloud.opacities(), 0.0)
    best: Cage | None = None
    for growth in range(_MAX_GROWTH_STEPS):
        grown = dilation + 0.006 * growth
        mesh, used = _mesh(solid, target_nodes, grown, method)
        inside = _means_inside(cloud, mesh)
        cage = Cage(
            mesh=mesh,
            method=used,
            min_dihedral_degrees=mesh.min_dihedral_degrees(),
            enclosed_opacity_mass=float(np.sum(weights * inside) / np.sum(weights)),
            floater_opacity_mass=_share(cloud, ~solid.belongs & ~solid.below_plane),
            below_plane_opacity_mass=_share(cloud, solid.below_plane),
            components=1,
            dilation=grown * solid.longest_side,
        )
        if best is None or cage.enclosed_opacity_mass > best.enclosed_opacity_mass:
            best = cage
        if best.enclosed_opacity_mass >= _ENCLOSED_AIM:
            break
    assert best is not None
    return best


def _share(cloud: GaussianCloud, chosen: np.ndarray) -> float:
    opacities = cloud.opacities()
    return float(np.sum(opacities[chosen]) / np.sum(opacities))


def _refuse_flat(solid: Solid) -> None:
    """A sheet is at most the lattice's own blur thick, wherever one looks."""
    thickest = float(ndimage.distance_transform_edt(np.pad(solid.inside, 1)[:, :, 1:]).max())
    size = np.ptp(np.argwhere(solid.inside), axis=0) + 1
    if thickest < 2.0 or size.min() < 4:
        raise UserError(
            "object: it is flat (no part is thicker than 1/20 of its longest side), so it has no volume to move; "
            "choose another object, or check --plane and --up"
        )


def _mesh(solid: Solid, target_nodes: int, dilation: float, method: CageMethod) -> tuple[TetMesh, CageMethod]:
    if method is CageMethod.TETWILD:
        mesh = tetwild(_Field(solid, dilation, thin_radius=0.0), target_nodes)
        if mesh is not None and mesh.min_dihedral_degrees() >= _MIN_DIHEDRAL_DEGREES:
            main = _main_piece(mesh.nodes, mesh.tets)
            return TetMesh.oriented(solid.world(main[0]), main[1]), CageMethod.TETWILD
    return _stuffed(solid, target_nodes, dilation), CageMethod.VOXEL


def _stuffed(solid: Solid, target_nodes: int, dilation: float) -> TetMesh:
    """The lattice mesh whose node count comes nearest to the target; bisection on the cell size."""
    volume = float(np.count_nonzero(solid.inside))
    # Two nodes a cell inside, about as many again on the surface.
    cell = (4.0 * volume / target_nodes) ** (1.0 / 3.0)
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for _ in range(7):
        field = _Field(solid, dilation, thin_radius=_THIN_RADIUS * cell)
        nodes, tets = stuff(field, *field.bounds(), cell)
        if len(tets) == 0:
            cell *= 0.7
            continue
        nodes, tets = _main_piece(nodes, tets)
        miss = abs(np.log(len(nodes) / target_nodes))
        if best is None or miss < best[0]:
            best = (miss, nodes, tets)
        if miss < 0.05:
            break
        cell *= (len(nodes) / target_nodes) ** 0.45
    if best is None:
        raise UserError("object: it is too thin to be given a volume; choose another object")
    return TetMesh.oriented(solid.world(best[1]), best[2])


class _Field:
    """Smooth signed distance of the solid, in lattice spacings: negative inside; layer 0 mirrored below the plane."""

    def __init__(self, solid: Solid, dilation: float, *, thin_radius: float) -> None:
        """``dilation`` in longest sides; parts thinner than ``thin_radius`` (spacings) are thickened to it."""
        pad = int(np.ceil(thin_radius + dilation * solid.longest_side / solid.spacing)) + 4
        mirrored = np.concatenate([solid.inside[:, :, :0:-1], solid.inside], axis=2)
        mirrored = np.pad(mirrored, pad)
        distance = ndimage.distance_transform_edt(~mirrored) - ndimage.distance_transform_edt(mirrored)
        distance -= 0.5 * np.sign(distance)
        smooth = ndimage.gaussian_filter(distance, 0.9)
        value = np.minimum(smooth, distance + 0.3) - dilation * solid.longest_side / solid.spacing
        if thin_radius > 0.0:
            # Medial points of thin parts: the distance to the surface has a crest there (it has none at corners).
            crest = (smooth < -0.2) & (smooth <= ndimage.minimum_filter(smooth, 3)) & (-value < thin_radius)
            if crest.any():
                value = np.minimum(value, ndimage.distance_transform_edt(~crest) - thin_radius)
        self._value = value[:, :, value.shape[2] // 2 - 1 :]
        self._offset = np.array([pad, pad, 1.0])
        self.solid = solid

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(self._value, (points + self._offset).T, order=1, mode="nearest", prefilter=False)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Box (3,), (3,) of the solid, in lattice spacings."""
        where = np.argwhere(self._value < 0.0) - self._offset
        return where.min(axis=0) - 1.0, where.max(axis=0) + 1.0

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """The lattice of values from layer 0 up, and the position (3,) of its first point."""
        return self._value[:, :, 1:], np.append(-self._offset[:2], 0.0)


def _main_piece(nodes: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest part (by volume) that hangs together through faces; loose crumbs are dropped."""
    faces = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    _, face = np.unique(faces, axis=0, return_inverse=True)
    order = np.argsort(face, kind="stable")
    shared = face[order][1:] == face[order][:-1]
    a, b = order[:-1][shared] // 4, order[1:][shared] // 4
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(tets), len(tets)))
    _, label = connected_components(graph, directed=False)
    x = nodes[tets]
    volume = np.abs(np.einsum("ti,ti->t", x[:, 1] - x[:, 0], np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 0])))
    tets = tets[label == np.argmax(np.bincount(label, weights=volume))]
    used, compact = np.unique(tets, return_inverse=True)
    return nodes[used], compact.reshape(-1, 4)


def _means_inside(cloud: GaussianCloud, mesh: TetMesh) -> np.ndarray:
    """(n,) bool: Gaussian means inside the mesh."""
    centre = mesh.nodes.mean(axis=0)
    size = float(np.ptp(mesh.nodes, axis=0).max())
    surface = wp.Mesh(
        points=wp.array(((mesh.nodes - centre) / size).astype(np.float32), dtype=wp.vec3, device=cloud.device),
        indices=wp.array(mesh.boundary_faces().ravel(), dtype=wp.int32, device=cloud.device),
        support_winding_number=True,
    )
    inside = wp.zeros(cloud.count, dtype=wp.uint8, device=cloud.device)
    wp.launch(
        inside_mesh_kernel,
        dim=cloud.count,
        inputs=[surface.id, cloud.means, wp.vec3(*centre), 1.0 / size],
        outputs=[inside],
        device=cloud.device,
    )
    return inside.numpy().astype(bool)
