"""Stances of bodies at the start of a motion, and displaced nodes of a standing body."""

from __future__ import annotations

import numpy as np

from egs_warp.contact.terrain import Solid
from egs_warp.fem.body import make_body
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import GroundFrame
from tests.support.meshes import block_mesh

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
FORWARD = np.array([1.0, 0.0, 0.0])
DT = 1 / 60


def block_place(mesh: TetMesh | None = None) -> Stance:
    """Return the stance of a block of 0.4 x 0.4 x 1 m, or of another ``mesh``, that stands on z = 0 and faces +x."""
    mesh = mesh or block_mesh()
    body = make_body(mesh, FLOOR, device="cpu")
    standing = mesh.nodes - [0.0, 0.0, mesh.nodes[:, 2].min()]
    ground = GroundFrame.on_plane(FLOOR, FORWARD, body.centre_of_mass(standing))
    return Stance(body, ground, standing, standing[standing[:, 2] < 1e-9], DT, (Solid((FLOOR,)),))


def standing_stance(mesh: TetMesh) -> Stance:
    """Return the stance at rest of a body of ``mesh``, whose forward direction is +y."""
    body = make_body(mesh, FLOOR, device="cpu")
    ground = GroundFrame.on_plane(FLOOR, np.array([0.0, 1.0, 0.0]), body.centre_of_mass(mesh.nodes))
    return Stance(body, ground, mesh.nodes, mesh.nodes[mesh.nodes[:, 2] < 1e-9], DT)


def moved(place: Stance, angle: float, shift: np.ndarray) -> np.ndarray:
    """Return the nodes (N, 3) of the standing body, rotated by ``angle`` rad about the up axis and translated by
    ``shift`` (3,), m."""
    com = place.body.centre_of_mass(place.standing)
    return com + (place.standing - com) @ place.ground.rotation_about_up(angle).T + shift
