"""Boxes as bodies of a world: props of one tetrahedron, or soft blocks without muscles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sparse

from egs_warp.contact.detection import ContactGeometry
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.affine_body import VolumeMoments, affine_body
from egs_warp.fem.body import BodyState, make_body
from egs_warp.fem.joints import BodyPoint, PointJoint
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.stepper import LocomotionStepper, StepReport, WarmStart
from egs_warp.locomotion.world_stepper import WorldBody, WorldStepper
from egs_warp.meshing.level_set import level_set_of_surface
from egs_warp.muscles.muscle_set import MuscleSet
from tests.support.meshes import UP, box_mesh, u_bar
from tests.support.passive import ABYSS

FLOOR = Plane(UP, 0.0)


def no_muscles(node_count: int) -> MuscleSet:
    """Return a set without muscles for a body with ``node_count`` nodes."""
    none, indices = np.zeros(0), np.zeros(0, np.int32)
    rows, pairs = sparse.csr_matrix((0, node_count)), np.zeros((0, 2), np.int32)
    return MuscleSet(rows, pairs, none, none, none, indices, (), (), indices, indices)


def moments_of(mesh: TetMesh) -> VolumeMoments:
    """Return the exact moments of tetrahedra."""
    volumes, corners = mesh.volumes(), mesh.nodes[mesh.tets]
    volume = float(volumes.sum())
    centre = volumes @ corners.mean(axis=1) / volume
    offsets = corners - centre
    total = offsets.sum(axis=1)
    second = np.einsum("t,tki,tkj->ij", volumes, offsets, offsets) + np.einsum("t,ti,tj->ij", volumes, total, total)
    return VolumeMoments(volume, centre, second / (20.0 * volume))


def surface_grid(size: tuple[float, float, float], count: int = 4) -> np.ndarray:
    """Return points (n, 3), m, on the surface of a box that stands on z = 0, on a grid with ``count`` points along each
    edge."""
    axes = [np.linspace(-size[0] / 2, size[0] / 2, count), np.linspace(-size[1] / 2, size[1] / 2, count)]
    axes.append(np.linspace(0.0, size[2], count))
    indices = np.moveaxis(np.indices((count,) * 3), 0, -1).reshape(-1, 3)
    on_surface = ((indices == 0) | (indices == count - 1)).any(axis=1)
    return np.stack([axis[index] for axis, index in zip(axes, indices[on_surface].T, strict=True)], axis=1)


def box_body(
    size: tuple[float, float, float],
    *,
    plane: Plane = FLOOR,
    up: np.ndarray = UP,
    friction: float = 0.5,
    soft: bool = False,
    density: float = 1000.0,
) -> WorldBody:
    """Make a box of ``size`` m that stands on z = 0."""
    shape = box_mesh((2, 2, 2), size)
    if soft:
        body = make_body(shape, FLOOR, sag=0.02, device="cpu")
    else:
        body = affine_body(moments_of(shape), size[2], up=up, density=density, device="cpu")
    embedding = embed_points(body.mesh, surface_grid(size), device="cpu")
    geometry = ContactGeometry(body.mesh, (plane,), friction, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    stepper = LocomotionStepper(body, no_muscles(len(body.mesh.nodes)), geometry, device="cpu")
    level_set = level_set_of_surface(shape.nodes, shape.boundary_faces(), cells=64)
    return WorldBody(stepper, level_set, body.mesh.nodes)


def soft_body(mesh: TetMesh, *, plane: Plane = FLOOR, sag: float = 0.02, self_contact: bool = False) -> WorldBody:
    """Make a soft body without muscles. Its contact points are the corners of its surface and the midpoints of the
    edges between them."""
    body = make_body(mesh, FLOOR, sag=sag, device="cpu")
    faces = mesh.boundary_faces()
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    points = np.concatenate([mesh.nodes[np.unique(faces)], mesh.nodes[edges].mean(axis=1)])
    embedding = embed_points(mesh, points, device="cpu")
    geometry = ContactGeometry(mesh, (plane,), 0.5, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    stepper = LocomotionStepper(body, no_muscles(len(mesh.nodes)), geometry, device="cpu")
    return WorldBody(stepper, level_set_of_surface(mesh.nodes, faces, cells=64), mesh.nodes, None, self_contact)


def point_at(
    body: int, world_body: WorldBody, place: np.ndarray, shift: Sequence[float] = (0.0, 0.0, 0.0)
) -> BodyPoint:
    """Return the point of a body (index ``body`` in its world) that is at ``place`` m if the body is at rest, moved by
    ``shift`` m."""
    mesh = world_body.stepper.body.mesh
    embedding = embed_points(mesh, np.subtract(place, shift)[None], device="cpu")
    return BodyPoint(body, mesh.tets[int(embedding.tets.numpy()[0])], embedding.weights.numpy()[0])


def prongs_in_flight(self_contact: bool) -> RunningWorld:
    """Return a world of one tumbling body with two prongs, whose tips approach each other at 6 m/s."""
    body = soft_body(u_bar(), plane=ABYSS, self_contact=self_contact)
    world, nodes = RunningWorld([body], [(0.0, 0.0, 0.0)]), body.rest_positions
    share, sides = np.maximum(nodes[:, 2] - 0.2, 0.0) / 0.6, np.sign(nodes[:, 0])
    velocities = np.cross([0.3, 0.5, 1.0], nodes) + (share * sides)[:, None] * [-3.0, 0.3, 0.0]
    world.states = [BodyState(nodes, velocities)]
    return world


class RunningWorld:
    """World whose bodies have no objectives, with the states of the bodies and the reports of the last step."""

    def __init__(
        self,
        bodies: Sequence[WorldBody],
        shifts: Sequence[Sequence[float]],
        speeds: Sequence[Sequence[float]] = (),
        frictions: np.ndarray | None = None,
        joints: Sequence[PointJoint] = (),
    ) -> None:
        self.stepper = WorldStepper(bodies, frictions=frictions, joints=joints)
        self.bodies = [each.stepper.body for each in bodies]
        self.states = [
            BodyState(
                body.mesh.nodes + np.asarray(shift, float), np.tile(np.asarray(speed, float), (len(body.mesh.nodes), 1))
            )
            for body, shift, speed in zip(self.bodies, shifts, speeds or [(0.0, 0.0, 0.0)] * len(bodies), strict=True)
        ]
        self.memories, self.min_gap = self.stepper.initial_memories(), np.inf
        self.reports: list[list[StepReport]] = []

    def advance(self, dt: float) -> None:
        """Advance by one step of ``dt`` s."""
        self.reports = self.stepper.advance(self.states, self.memories, [()] * len(self.states), dt)
        assert all(report.converged for reports in self.reports for report in reports)
        self.states = [reports[-1].state for reports in self.reports]
        self.memories = [WarmStart.from_report(reports[-1]) for reports in self.reports]
        self.min_gap = min([self.min_gap, *(report.min_gap for reports in self.reports for report in reports)])

    def centres(self) -> np.ndarray:
        """Return the centres of mass (k, 3), m."""
        parts = zip(self.bodies, self.states, strict=True)
        return np.array([body.centre_of_mass(state.positions) for body, state in parts])

    def momenta(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the linear momentum (3,), kg m/s, of the world, and its angular momentum (3,), kg m^2/s, about the
        origin."""
        parts = [
            (body.node_mass[:, None], s.positions, s.velocities)
            for body, s in zip(self.bodies, self.states, strict=True)
        ]
        linear = sum((mass * velocities).sum(axis=0) for mass, _, velocities in parts)
        angular = sum((mass * np.cross(positions, velocities)).sum(axis=0) for mass, positions, velocities in parts)
        return np.asarray(linear), np.asarray(angular)
