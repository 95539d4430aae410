"""Prop: a captured object as a stiff body without muscles, for a world of several bodies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import scipy.sparse as sparse

from egs_warp.checked_calls import checked_constructor
from egs_warp.contact.detection import ContactGeometry, contact_geometry
from egs_warp.contact.flat_top import FlatTop
from egs_warp.contact.terrain import Solid
from egs_warp.deformation.rigid import to_body_frame
from egs_warp.errors import ArgumentError
from egs_warp.fem.affine_body import VolumeMoments, affine_body
from egs_warp.geometry.body_frame import GROUND, BodyFrame
from egs_warp.geometry.frames import Direction, direction_of
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.settings import LocomotionSettings
from egs_warp.locomotion.settling import settle
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.meshing.level_set import MAX_CELLS
from egs_warp.meshing.occupancy import solid_from_gaussians
from egs_warp.muscles.muscle_set import MuscleSet
from egs_warp.pipelines.captured_body import CapturedBody, CapturedShape, Friction, points_at_rest
from egs_warp.pipelines.placed_cage import check_height, estimated_up, place_cage, simulation_device
from egs_warp.segmentation.flat_surface import bounded_by_surface
from egs_warp.short_repr import short_repr

MIN_DENSITY, MAX_DENSITY = 1.0, 30_000.0
"""Minimum and maximum density of a prop, kg/m^3; other values are rejected, because they probably result from a mistake
in the units."""
_CAGE_NODES = 250
"""Approximate number of nodes of the cage in which the contact points of a prop are found."""
_CONTACT_GRID = 2.0**-10
"""Rounding step of contact points, as a fraction of the height; it is the same as for a creature."""


@checked_constructor
@dataclass(frozen=True)
class Footprint:
    """Place in a capture on which another object stood."""

    __repr__ = short_repr

    plane: Plane
    """Plane under the object that stood there, in the capture."""
    points: Annotated[np.ndarray, "points", 3]
    """(k, 3) points of the lowest part of this object, in the capture."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Prop(CapturedBody):
    """A stiff body that consists of one tetrahedron without muscles and has the mass and the inertia of the captured
    object."""


def make_prop(
    cloud: GaussianCloud,
    *,
    up: Direction | None = None,
    plane: Plane | None = None,
    metres_per_unit: float | None = None,
    height: float | None = None,
    density: float = 1000.0,
    friction: Friction = 0.8,
    footprints: Sequence[Footprint] = (),
    settings: LocomotionSettings | None = None,
    progress: Callable[[str], object] = lambda stage: None,
) -> Prop:
    """Create a prop from a capture of a single object, at rest on the ground (docs/guide/worlds.md).

    Args:
        cloud: The capture.
        up: (3,) Up direction in the capture, or an axis such as ``"-y"``; None uses the up direction of the file or
            estimates it, as ``make_creature`` does.
        plane: Ground plane in the capture; None uses the base of the object, orthogonal to ``up``.
        metres_per_unit: Length of one unit of the capture, m; None uses ``height``.
        height: Height of the prop, m; None makes it 1 m tall.
        density: Density, kg/m^3.
        friction: Coulomb coefficient of the ground.
        footprints: Places on which other objects stood: the surface of the prop around them is flat.
        settings: Contact settings; None uses the default.
        progress: Called with the name of each stage as it starts.

    Raises:
        UserError: An argument is invalid, or no body can be made from the capture.
    """
    if not MIN_DENSITY <= density <= MAX_DENSITY:
        raise ArgumentError("density", f"give kg/m^3 from {MIN_DENSITY:g} to {MAX_DENSITY:g}", value=density)
    check_height(height, metres_per_unit)
    notes: tuple[str, ...] = ()
    up = None if up is None else direction_of(up, "up")
    if plane is None and up is None:
        up, note = estimated_up(cloud, advice="pass another up direction")
        notes = (note,)
    progress("cage")
    standing = place_cage(cloud, up=up, plane=plane, metres_per_unit=metres_per_unit, height=height, nodes=_CAGE_NODES)
    device, mesh = simulation_device(cloud), standing.cage.mesh
    progress("contact")
    solid = solid_from_gaussians(standing.gaussians, resolution=MAX_CELLS)
    # Fragments beside the solid are not part of the body, so they touch nothing.
    gaussians = standing.gaussians.subset(solid.is_near(standing.gaussians.means.numpy().astype(np.float64)))
    geometry = contact_geometry(
        gaussians,
        mesh,
        (GROUND,),
        friction=friction,
        tops=[_flat_top(gaussians, standing.frame, each, solid.spacing) for each in footprints],
        grid=_CONTACT_GRID * standing.cage.height(GROUND),
        device=device,
    )
    shape = CapturedShape(gaussians, points_at_rest(geometry))
    progress("body and level set")
    body = affine_body(
        VolumeMoments.of_solid(shape.solid), _height(shape), up=GROUND.normal, density=density, device=device
    )
    stepper = LocomotionStepper(
        body, no_muscles(len(body.mesh.nodes)), embedded_in(body.mesh, geometry), settings=settings, device=device
    )
    progress("stand")
    return Prop(
        frame=standing.frame,
        cloud=to_body_frame(cloud, standing.frame),
        stepper=stepper,
        start=settle(stepper),
        solids=(Solid((GROUND,)),),
        shape=shape,
        notes=notes,
    )


def _flat_top(gaussians: GaussianCloud, frame: BodyFrame, footprint: Footprint, band: float) -> FlatTop:
    """Return the flat top of a prop around a footprint. Gaussians at most ``band`` (m) from its plane belong to it."""
    plane = frame.plane(footprint.plane)
    return FlatTop(plane, bounded_by_surface(gaussians, plane, frame.points(footprint.points), band), band)


def _height(shape: CapturedShape) -> float:
    """Return the height of the contact points above the ground, m."""
    return float(GROUND.heights(shape.contact_points).max())


def embedded_in(mesh: TetMesh, geometry: ContactGeometry) -> ContactGeometry:
    """Embed all contact points of ``geometry``, including those outside it, in a ``mesh`` of one tetrahedron."""
    points = points_at_rest(geometry)
    corners = np.vstack([mesh.nodes[mesh.tets[0]].T, np.ones(4)])
    weights = np.linalg.solve(corners, np.vstack([points.T, np.ones(len(points))])).T
    return replace(
        geometry, mesh=mesh, tet_from_point=np.zeros(len(points), np.int32), weights=np.ascontiguousarray(weights)
    )


def no_muscles(node_count: int) -> MuscleSet:
    """Return an empty set of muscles for a body with ``node_count`` nodes."""
    return MuscleSet(
        end_rows=sparse.csr_matrix((0, node_count)),
        segments=np.zeros((0, 2), np.int32),
        rest_lengths=np.zeros(0),
        stiffness=np.zeros(0),
        bounds=np.zeros(0),
        fibre_from_segment=np.zeros(0, np.int32),
        fibre_kinds=(),
        fibre_names=(),
        fibre_groups=np.zeros(0, np.int32),
        fibre_partners=np.zeros(0, np.int32),
    )
