"""The cage: a coarse tetrahedral mesh around the object's visible volume, with a flat bottom on its plane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import warp as wp
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from egs_warp.checked_calls import Range
from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.geometry.unique_rows import distinct_rows
from egs_warp.kernels.meshing.occupancy import inside_mesh_kernel
from egs_warp.meshing.body_gaussians import body_gaussians, centred, find_body_frame
from egs_warp.meshing.occupancy import LatticeSolid, mass_quantiles, solid_from_gaussians
from egs_warp.meshing.stuffing import isosurface_stuffing
from egs_warp.meshing.tetwild import tetwild
from egs_warp.short_repr import short_repr

_MIN_DIHEDRAL_DEGREES = 8.0
_MIN_ENCLOSED_FRACTION = 0.9993
_MIN_COMPLETE_FRACTION = 0.98
"""Minimum fraction of the object's opacity mass inside a cage in which no part, such as a leg, is missing."""
_MIN_OWN_ENCLOSED_FRACTION = 0.5
"""Minimum fraction of the object's opacity mass inside a user's mesh; a smaller fraction indicates wrong
coordinates."""
MIN_NODES, MAX_NODES = 50, 20_000
"""Minimum and maximum number of nodes of a cage."""
NODE_COUNTS = Range(MIN_NODES, MAX_NODES)
"""Numbers of nodes that can be requested."""
_MAX_THICKENING = 2.5
"""Maximum ``Cage.thickening``; an object whose cage would be thicker is rejected."""
_MAX_GROWTH_STEPS = 6
_GROWTH_SAMPLE = 20000
_REFINEMENT_PER_STEP = 0.15
_REFINEMENTS_FOR_THIN_PARTS = (2.0, 2.8, 4.0)
"""Factors on the number of nodes with which a cage is built again while a part of the object is missing."""
_THIN_RADIUS = 0.56
"""Radius, in lattice cells, above which a rod contains points of the body-centred cubic lattice wherever it lies. The
covering radius of the lattice is sqrt(5)/4."""

_CELL_SIZES_PER_OCTAVE = 16
"""Number of allowed cell sizes per factor of 2. Because of this rounding, the cell size does not change if a few
lattice points are added or removed."""


class CageMethod(Enum):
    """Method that generates the tetrahedra."""

    VOXEL = "voxel"
    """Isosurface stuffing of the voxel solid, bitwise equal in every run. Dihedral angles are at least 10 degrees,
    except where the surface meets the floor (at least 7.6 degrees in 400 random solids)."""
    TETWILD = "tetwild"
    """fTetWild, which resolves thin parts with fewer nodes. Its random numbers are seeded by the system, so two runs
    give different meshes. If it fails or produces slivers, VOXEL is used instead."""


@dataclass(frozen=True)
class Cage:
    """Tetrahedral mesh around an object, and measures of its quality."""

    __repr__ = short_repr

    mesh: TetMesh
    """Tetrahedral mesh in the units and axes of the input cloud."""
    method: CageMethod | None
    """Method that generated the mesh; None for a user's mesh."""
    min_dihedral_degrees: float
    """Minimum dihedral angle of all tetrahedra, degrees."""
    enclosed_opacity_mass: float
    """Fraction of the object's opacity in Gaussians whose means are inside the mesh. Floaters and Gaussians below the
    plane do not belong to the object."""
    floater_opacity_mass: float
    """Fraction of the total opacity in floaters: Gaussians in the air, detached from the object."""
    below_plane_opacity_mass: float
    """Fraction of the total opacity in Gaussians whose means are below the plane."""
    dilation: float
    """Distance by which the cage extends beyond the occupied space, in the units of the mesh."""
    thickening: float
    """Maximum ratio, over the axes of the body's frame, of the extent of the cage to the extent of the object's
    Gaussians. The ratio is above 1 for a thin object, because elements have a minimum thickness."""

    def height(self, plane: Plane) -> float:
        """Return the body height H above ``plane``, in the units of the mesh."""
        return float(plane.heights(self.mesh.nodes).max())

    def scaled(self, factor: float) -> Cage:
        """Return the same cage with all lengths multiplied by ``factor``."""
        return replace(self, mesh=TetMesh(self.mesh.nodes * factor, self.mesh.tets), dilation=self.dilation * factor)


def build_cage(
    cloud: GaussianCloud,
    plane: Plane,
    *,
    target_nodes: int = 500,
    dilation: float = 0.005,
    method: CageMethod = CageMethod.VOXEL,
) -> Cage:
    """Build the cage of the part of ``cloud`` above ``plane``, in the axes and units of the capture (``cage_of_body``).

    The mesh is generated in the frame of the body, so its shape does not depend on the frame and unit of the capture.
    """
    near, anchor = centred(cloud)
    frame = find_body_frame(near, plane.moved(-anchor))
    cage = cage_of_body(body_gaussians(near, frame), target_nodes=target_nodes, dilation=dilation, method=method)
    frame = frame.moved(anchor)
    return replace(
        cage,
        mesh=TetMesh(frame.capture_points(cage.mesh.nodes), cage.mesh.tets),
        dilation=cage.dilation / frame.scale,
    )


def check_nodes(nodes: int) -> None:
    """Raise ``ArgumentError``, before any long computation, if a cage cannot have this number of ``nodes``."""
    if nodes not in NODE_COUNTS:
        raise ArgumentError("nodes", f"give {NODE_COUNTS.described('a whole number')}", value=nodes)


def cage_of_body(
    cloud: GaussianCloud,
    *,
    target_nodes: int = 500,
    dilation: float = 0.005,
    method: CageMethod = CageMethod.VOXEL,
    solid: LatticeSolid | None = None,
) -> Cage:
    """Build a cage around the opaque part of ``cloud`` above z = 0. The cage does not cross z = 0.

    The dilation is increased, and the mesh refined (up to 1.75 times the nodes), until all but 0.07 % of the object's
    opacity mass is inside. If more than 2 % remains outside, a thin part such as a leg is severed from the mesh, and it
    is refined up to 4 times the nodes until the part is connected. With ``CageMethod.VOXEL``, equal inputs give bitwise
    equal cages. See docs/concepts/cage.md.

    Args:
        cloud: Gaussians in the frame of the body (``body_gaussians``), whose axes and origin the lattice shares.
        target_nodes: approximate number of nodes.
        dilation: initial dilation, as a fraction of the object's longest side.
        method: method that generates the tetrahedra.
        solid: solid of ``cloud`` (``solid_from_gaussians``); None computes it.

    Raises:
        UserError: the object has no volume (it is flat or tiny, or nothing opaque lies above the plane).
    """
    if not MIN_NODES <= target_nodes <= MAX_NODES:
        raise UserError(f"cage: {target_nodes} nodes are requested; give a number from {MIN_NODES} to {MAX_NODES}")
    solid = solid or solid_from_gaussians(cloud)
    _check_thickness(solid)
    weights = np.where(solid.belongs, cloud.opacities(), 0.0)
    distance = _Distance(solid)
    # The body-centred cubic lattice has two nodes per cell, and there are about as many nodes on the surface as inside.
    cell = _rounded_cell((4.0 * np.count_nonzero(solid.inside) / target_nodes) ** (1.0 / 3.0))
    # While the dilation grows, a large capture is evaluated on a regular sample; the final value uses all Gaussians.
    sample = np.arange(0, cloud.count, max(1, cloud.count // _GROWTH_SAMPLE))
    best: tuple[float, float, TetMesh, CageMethod] | None = None
    # Dilation alone does not enclose the tips of thin curled parts, but a finer lattice does.
    sizes = [(1.0 + _REFINEMENT_PER_STEP * step, dilation + 0.006 * step) for step in range(_MAX_GROWTH_STEPS)]
    sizes += [(refinement, sizes[-1][1]) for refinement in _REFINEMENTS_FOR_THIN_PARTS]
    for number, (refinement, grown) in enumerate(sizes):
        if number >= _MAX_GROWTH_STEPS and best is not None and best[0] >= _MIN_COMPLETE_FRACTION:
            break
        mesh, used, cell = _mesh(solid, distance, round(refinement * target_nodes), grown, method, cell)
        enclosed = _enclosed_share(cloud, mesh, weights, sample)
        if best is None or enclosed > best[0]:
            best = (enclosed, grown, mesh, used)
        if enclosed >= _MIN_ENCLOSED_FRACTION:
            break
    if best is None:
        raise UserError("cage: no mesh could be built; choose another object")
    _, grown, mesh, used = best
    thickening = _thickening(cloud, solid, mesh)
    if thickening > _MAX_THICKENING:
        raise _too_thin(f"its elements would make it {thickening:.2g} times as thick")
    return Cage(
        mesh=mesh,
        method=used,
        min_dihedral_degrees=mesh.min_dihedral_degrees(),
        enclosed_opacity_mass=_enclosed_share(cloud, mesh, weights, np.arange(cloud.count)),
        floater_opacity_mass=_share(cloud, ~solid.belongs & ~solid.below_plane),
        below_plane_opacity_mass=_share(cloud, solid.below_plane),
        dilation=grown * solid.longest_side,
        thickening=thickening,
    )


def cage_of_mesh(cloud: GaussianCloud, mesh: TetMesh, solid: LatticeSolid) -> Cage:
    """Return the cage that consists of a user's ``mesh``.

    Args:
        cloud: Gaussians in the frame of the body, as for ``cage_of_body``.
        mesh: tetrahedra in the same frame, above z = 0.
        solid: solid of ``cloud``.

    Raises:
        UserError: the mesh encloses less than half of the object.
    """
    everything = np.arange(cloud.count)
    enclosed = _enclosed_share(cloud, mesh, np.where(solid.belongs, cloud.opacities(), 0.0), everything)
    if enclosed < _MIN_OWN_ENCLOSED_FRACTION:
        raise UserError(
            f"cage: the mesh encloses {100.0 * enclosed:.0f} % of the object; give a mesh that encloses it, in the"
            " coordinates of the capture",
            check=("up", "plane"),
        )
    return Cage(
        mesh=mesh,
        method=None,
        min_dihedral_degrees=mesh.min_dihedral_degrees(),
        enclosed_opacity_mass=enclosed,
        floater_opacity_mass=_share(cloud, ~solid.belongs & ~solid.below_plane),
        below_plane_opacity_mass=_share(cloud, solid.below_plane),
        dilation=0.0,
        thickening=_thickening(cloud, solid, mesh),
    )


def _too_thin(why: str) -> UserError:
    return UserError(
        f"object: it is too thin for its elements ({why}); choose a thicker object, or cut out a piece whose"
        " longest side is at most 20 times its thickness",
        check=("plane", "up"),
    )


def _thickening(cloud: GaussianCloud, solid: LatticeSolid, mesh: TetMesh) -> float:
    """Return the maximum ratio of an extent of the cage to the same extent of the object (``Cage.thickening``).

    The extent of the object along an axis excludes the outermost 0.2 % of its opacity. If the cage is larger, a typical
    standard deviation is added at either end.
    """
    means = cloud.means.numpy()[solid.belongs].astype(np.float64)
    low, high = mass_quantiles(means, cloud.opacities()[solid.belongs], 0.001, 0.999)
    extents, sizes = (
        high - np.append(low[:2], 0.0),
        np.append(np.ptp(mesh.nodes[:, :2], axis=0), mesh.nodes[:, 2].max()),
    )
    if np.any(sizes > extents):
        quaternions = cloud.rotations.numpy()[solid.belongs][:, [1, 2, 3, 0]]
        scales = np.exp(cloud.log_scales.numpy()[solid.belongs].astype(np.float64))
        along = Rotation.from_quat(quaternions).as_matrix() * scales[:, None, :]
        extents += 2.0 * np.median(np.sqrt(np.einsum("nij,nij->ni", along, along)), axis=0)
    return float((sizes / np.maximum(extents, 1e-6 * sizes)).max())


def _share(cloud: GaussianCloud, chosen: np.ndarray) -> float:
    opacities = cloud.opacities()
    return float(np.sum(opacities[chosen]) / np.sum(opacities))


def _check_thickness(solid: LatticeSolid) -> None:
    """Raise ``UserError`` if the object is a sheet, nowhere thicker than the blur of the lattice."""
    thickest = float(_edt(np.pad(solid.inside, 1)[:, :, 1:]).max())
    size = np.ptp(np.argwhere(solid.inside), axis=0) + 1
    if thickest < 2.0 or size.min() < 4:
        raise _too_thin("it is flat: no part is thicker than 1/20 of its longest side")


def _mesh(
    solid: LatticeSolid, distance: _Distance, target_nodes: int, dilation: float, method: CageMethod, cell: float
) -> tuple[TetMesh, CageMethod, float]:
    """Return the mesh, the method that generated it, and the size of its lattice cells, which is ``cell`` if the method
    uses no lattice."""
    if method is CageMethod.TETWILD:
        mesh = tetwild(_Field(distance, dilation, thin_radius=0.0), target_nodes)
        if mesh is not None and mesh.min_dihedral_degrees() >= _MIN_DIHEDRAL_DEGREES:
            nodes, tets = _largest_part(mesh.nodes, mesh.tets)
            return TetMesh.oriented(solid.points(nodes), tets), CageMethod.TETWILD, cell
    nodes, tets, cell = _lattice_mesh(distance, target_nodes, dilation, cell)
    return TetMesh.oriented(solid.points(nodes), tets), CageMethod.VOXEL, cell


def _lattice_mesh(
    distance: _Distance, target_nodes: int, dilation: float, cell: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the lattice mesh whose number of nodes is nearest to the target: nodes (N, 3) in lattice spacings,
    tetrahedra (T, 4) and cell size.

    The cell size is found by the secant method, starting at ``cell``, and is rounded in each step.
    """
    best: tuple[float, np.ndarray, np.ndarray, float] | None = None
    for _ in range(6):
        field = _Field(distance, dilation, thin_radius=_THIN_RADIUS * cell)
        nodes, tets = isosurface_stuffing(field, *field.bounds(), cell)
        if len(tets) == 0:
            cell = _rounded_cell(0.7 * cell)
            continue
        nodes, tets = _largest_part(nodes, tets)
        deviation = abs(float(np.log(len(nodes) / target_nodes)))
        if best is None or deviation < best[0]:
            best = (deviation, nodes, tets, cell)
        next_cell = _rounded_cell(cell * (len(nodes) / target_nodes) ** 0.45)
        if deviation < 0.08 or next_cell == cell:
            break
        cell = next_cell
    if best is None:
        raise UserError("object: it is too thin to have a volume; choose another object")
    return best[1:]


def _rounded_cell(cell: float) -> float:
    """Round ``cell`` to one of the ``_CELL_SIZES_PER_OCTAVE`` sizes per factor of 2."""
    return float(2.0 ** (np.rint(_CELL_SIZES_PER_OCTAVE * np.log2(cell)) / _CELL_SIZES_PER_OCTAVE))


class _Distance:
    """Distance fields of the solid together with its mirror image below the plane, without the dilation."""

    def __init__(self, solid: LatticeSolid) -> None:
        self.pad = int(np.ceil(0.25 * solid.longest_side / solid.spacing))
        mirrored = np.pad(np.concatenate([solid.inside[:, :, :0:-1], solid.inside], axis=2), self.pad)
        sharp = _edt(~mirrored) - _edt(mirrored)
        self.sharp = sharp - 0.5 * np.sign(sharp)
        """(nx, ny, nz) signed distance, in lattice spacings."""
        self.smooth = np.asarray(ndimage.gaussian_filter(self.sharp, 0.9))
        """(nx, ny, nz) smoothed signed distance, without the steps of the lattice."""
        self.medial = (self.smooth < -0.2) & (self.smooth <= ndimage.minimum_filter(self.smooth, 3))
        """(nx, ny, nz) bool, ridges of the depth, which lie in the middle of thin parts; corners have no ridges."""
        self.longest_side = solid.longest_side / solid.spacing
        """Longest side of the object, in lattice spacings."""
        self.middle = -solid.corner[:2]
        """(2,) lattice indices of the frame's origin, about which the cells are placed symmetrically."""


class _Field:
    """Smooth signed distance of the dilated solid, in lattice spacings; negative inside."""

    def __init__(self, distance: _Distance, dilation: float, *, thin_radius: float) -> None:
        """Compute the field. ``dilation`` is a fraction of the longest side; parts with a radius below ``thin_radius``
        (lattice spacings) are thickened to this radius."""
        # The solid is mirrored in z = 0, so the ridge nearest to a point above the plane lies above the plane, too.
        above = np.s_[:, :, distance.smooth.shape[2] // 2 :]
        value = np.minimum(distance.smooth[above], distance.sharp[above] + 0.3) - dilation * distance.longest_side
        if thin_radius > 0.0:
            crest = distance.medial[above] & (-value < thin_radius)
            if crest.any():
                value = np.minimum(value, _edt(~crest) - thin_radius)
        self._value = np.concatenate([value[:, :, 1:2], value], axis=2)
        self._offset = np.array([distance.pad, distance.pad, 1.0])
        self._middle = distance.middle

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(self._value, (points + self._offset).T, order=1, mode="nearest", prefilter=False)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner (3,) of a box about the frame's origin that contains the solid, in
        lattice spacings."""
        where = np.argwhere(self._value < 0.0) - self._offset
        low, high = where.min(axis=0) - 1.0, where.max(axis=0) + 1.0
        half = np.maximum(self._middle - low[:2], high[:2] - self._middle)
        return np.append(self._middle - half, low[2]), np.append(self._middle + half, high[2])

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the values (nx, ny, nz) of the lattice from layer 0 up, and the position (3,) of its first point."""
        return self._value[:, :, 1:], np.append(-self._offset[:2], 0.0)


def _edt(mask: np.ndarray) -> np.ndarray:
    """Return the distance of each True point of ``mask`` to the nearest False point, in lattice spacings."""
    return np.asarray(ndimage.distance_transform_edt(mask))


def _largest_part(nodes: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and tetrahedra of the part with the largest volume among those that are connected through faces."""
    faces = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    _, face = distinct_rows(faces)
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


def _enclosed_share(cloud: GaussianCloud, mesh: TetMesh, weights: np.ndarray, sample: np.ndarray) -> float:
    """Return the fraction of ``weights`` (n,) inside the mesh, estimated from the means with indices ``sample``
    (m,)."""
    centre = mesh.nodes.mean(axis=0)
    size = float(np.ptp(mesh.nodes, axis=0).max())
    surface = wp.Mesh(
        points=wp.array(((mesh.nodes - centre) / size).astype(np.float32), dtype=wp.vec3, device=cloud.device),
        indices=wp.array(mesh.boundary_faces().ravel(), dtype=wp.int32, device=cloud.device),
        support_winding_number=True,
    )
    sample = sample[weights[sample] > 0.0]
    if len(sample) == 0:
        return 0.0
    inside = wp.zeros(len(sample), dtype=wp.uint8, device=cloud.device)
    points = ((cloud.means.numpy()[sample] - centre) / size).astype(np.float32)
    wp.launch(
        inside_mesh_kernel,
        dim=len(sample),
        inputs=[surface.id, wp.array(points, dtype=wp.vec3, device=cloud.device)],
        outputs=[inside],
        device=cloud.device,
    )
    return float(np.sum(weights[sample] * inside.numpy()) / np.sum(weights[sample]))
