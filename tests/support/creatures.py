"""Coarse bodies with muscles that stand at the start of a motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from egs_warp.assets import pawn
from egs_warp.contact.detection import ContactGeometry
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.body import BodyState, make_body
from egs_warp.geometry.height_field import HeightField
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.settling import settle
from egs_warp.locomotion.stepper import LocomotionStepper
from egs_warp.motions.sequence import Stance
from egs_warp.motions.stance import GroundFrame
from egs_warp.muscles.muscle_set import automatic_muscles
from egs_warp.pipelines.creature import Creature, CreatureOptions, make_creature
from tests.support.meshes import UP
from tests.support.stances import DT, FLOOR


@cache
def coarse_pawn(*, friction: float = 0.8, device: str = "cpu") -> Creature:
    """Return the built-in pawn with few Gaussians, in a cage of about 50 nodes; it is built once per process."""
    scene = pawn(gaussian_count=3000, device=device)
    return make_creature(scene.cloud, plane=scene.plane, options=CreatureOptions(nodes=50, friction=friction))


def sagging(creature: Creature) -> Creature:
    """Return the creature settled with the captured shape as its unloaded shape, so that it sags until most of its base
    touches the ground."""
    stepper = creature.stepper.with_unloaded_shape(creature.body.mesh.nodes)
    return replace(creature, stepper=stepper, start=settle(stepper))


def on_its_rim(geometry: ContactGeometry, count: int = 12) -> ContactGeometry:
    """Return the geometry with only the outermost contact points of the base in ``count`` directions."""
    corners = geometry.mesh.nodes[geometry.mesh.tets[geometry.tet_from_point]]
    places = np.einsum("pw,pwi->pi", geometry.weights, corners)
    heights = geometry.ground_heights(places)
    base = np.flatnonzero(heights < 0.01)
    angles = 2.0 * np.pi * np.arange(count) / count
    reach = (places[base, :2] - places[base, :2].mean(axis=0)) @ np.stack([np.cos(angles), np.sin(angles)])
    chosen = np.unique(base[np.argmax(reach, axis=0)])
    return replace(geometry, tet_from_point=geometry.tet_from_point[chosen], weights=geometry.weights[chosen])


@dataclass(frozen=True)
class CoarseCreature:
    """Coarse creature: a stepper, the stance of its body, and the state of the body in this stance."""

    stepper: LocomotionStepper
    place: Stance
    start: BodyState


def coarse_creature(
    mesh: TetMesh,
    *,
    forward: np.ndarray,
    up: np.ndarray = UP,
    sag: float = 0.05,
    strength: float = 4.0,
    settle_first: bool = True,
    field: HeightField | None = None,
    all_round: bool = False,
) -> CoarseCreature:
    """Build a body of ``mesh`` that stands on its lowest nodes and faces ``forward`` (3,); ``up`` (3,) is opposite to
    gravity.

    Contact points are the nodes of its base. With a ``field`` in place of the floor, they are a grid on its base; with
    ``all_round``, all nodes of its surface.
    """
    body = make_body(mesh, FLOOR, up=up, sag=sag, device="cpu")
    muscles = automatic_muscles(
        mesh, UP, body_weight=body.weight, height=body.height, young_modulus=body.young_modulus, strength=strength
    )
    places = mesh.nodes[mesh.nodes[:, 2] == 0.0]
    if all_round:
        places = mesh.nodes[np.unique(mesh.boundary_faces())]
    elif field is not None:
        sides = [np.linspace(low, high, 11) for low, high in zip(places.min(axis=0), places.max(axis=0), strict=True)]
        places = np.stack(np.meshgrid(*sides[:2], [0.0]), axis=-1).reshape(-1, 3)
    soles = embed_points(mesh, places, device="cpu")
    geometry = ContactGeometry(mesh, (FLOOR,), 0.8, soles.tets.numpy(), soles.weights.numpy(), 0, 0.0, field=field)
    stepper = LocomotionStepper(body, muscles, geometry, device="cpu")
    start = settle(stepper) if settle_first else BodyState(mesh.nodes, np.zeros_like(mesh.nodes))
    ground = GroundFrame.on_plane(FLOOR, forward, body.centre_of_mass(start.positions), up=up)
    touching = stepper.detector.points_within(start.positions, 0.01)
    return CoarseCreature(stepper, Stance(body, ground, start.positions, touching, DT), start)
