"""A soft body dropped on the floor: the simulated deformation "fall" of Table 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from egs_warp.contact.detection import contact_geometry
from egs_warp.fem.assembly_topology import Material
from egs_warp.fem.body import GRAVITY, BodyState, SoftBody
from egs_warp.fem.elasticity import ElasticAssembly
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.stepper import LocomotionStepper, WarmStart
from egs_warp.muscles.muscle_set import automatic_muscles

TIME_STEP = 1.0 / 120.0
"""Step size, s."""

NEAREST = 12
"""Number of nodes from which the displacement of a point is fitted."""


@dataclass(frozen=True)
class Drop:
    """Recorded fall of a soft body."""

    frames: np.ndarray
    """(F, N, 3) m, node positions at every step."""
    energies: np.ndarray
    """(F,) J, elastic energy."""

    rest: np.ndarray
    """(N, 3) m, nodes at rest."""

    def at_impact(self, points: np.ndarray) -> np.ndarray:
        """Return ``points`` (P, 3) m of the rest shape, deformed as in the frame with the largest elastic energy.

        The deformation at a point is the affine map that best fits the nearest nodes, with weights that decay smoothly
        to zero (moving least squares). It extrapolates to points that a coarse cage does not cover.
        """
        count = min(NEAREST, len(self.rest))
        distance, near = (np.asarray(result) for result in KDTree(self.rest).query(points, k=count))
        weights = (1.0 - distance / (1.001 * distance[:, -1:])) ** 2
        weights /= weights.sum(axis=1, keepdims=True)
        before, after = self.rest[near], self.frames[int(np.argmax(self.energies))][near]
        from_centre, to_centre = (np.einsum("pk,pki->pi", weights, x)[:, None] for x in (before, after))
        moments = np.einsum("pk,pki,pkj->pij", weights, before - from_centre, before - from_centre)
        mixed = np.einsum("pk,pki,pkj->pij", weights, after - to_centre, before - from_centre)
        # Coplanar nodes do not determine the gradient normal to their plane; the regularisation bounds it.
        spread = np.einsum("pii->p", moments)[:, None, None] * np.eye(3)
        gradient = mixed @ np.linalg.inv(moments + 1e-3 * spread)
        return to_centre[:, 0] + np.einsum("pij,pj->pi", gradient, points - from_centre[:, 0])


def simulated_drop(
    mesh: TetMesh, cloud: GaussianCloud, *, sag: float, height: float, tilt_degrees: float, seconds: float
) -> Drop:
    """Tilt ``mesh``, drop it from ``height`` m above the floor z = 0 and record ``seconds`` s from just before impact.

    With a ``sag`` of 0.1 or more, the body crumples.

    Args:
        mesh: cage of the body, m, standing on z = 0.
        cloud: Gaussians of the body, from which its contact points are taken.
        sag: ratio rho g H / E, which sets Young's modulus E.
        height: height of the fall, m.
        tilt_degrees: tilt about x; the tilt about y is 0.6 times as large.
        seconds: duration of the recording.
    """
    plane = Plane.from_coefficients(0.0, 0.0, 1.0, 0.0)
    density, body_height = 1000.0, float(np.ptp(mesh.nodes[:, 2]))
    material = Material(density * GRAVITY * body_height / sag, 0.4, density, 0.01)
    assembly = ElasticAssembly(mesh, material, device="cpu")
    gravity = -GRAVITY * plane.normal
    body = SoftBody(mesh, assembly, mesh.lumped_masses(density), gravity, body_height)
    geometry = contact_geometry(cloud, mesh, (plane,), friction=0.8, device="cpu")
    muscles = automatic_muscles(
        mesh, plane.normal, body_weight=body.weight, height=body.height, young_modulus=body.young_modulus
    )
    stepper = LocomotionStepper(body, muscles, geometry, device="cpu")
    rotated = mesh.nodes @ Rotation.from_euler("xy", [tilt_degrees, 0.6 * tilt_degrees], degrees=True).as_matrix().T
    rotated[:, 2] += height - rotated[:, 2].min()
    state = BodyState(rotated, np.tile(np.sqrt(2.0 * GRAVITY * height) * gravity / GRAVITY, (len(rotated), 1)))
    # Free flight does not deform the body, so start just above the floor at the impact velocity.
    state.positions[:, 2] -= height - 0.01 * body_height
    memory = stepper.initial_memory()
    frames, energies = [state.positions], [0.0]
    for _ in range(round(seconds / TIME_STEP)):
        result = stepper.passive_step(state, memory, TIME_STEP)
        end = state.positions + TIME_STEP * result.velocities
        state = BodyState(end, result.velocities, state.time + TIME_STEP)
        memory = WarmStart(result.contacts.points, result.forces, memory.activations)
        frames.append(end)
        energies.append(assembly.energy(end))
    return Drop(np.stack(frames), np.array(energies), mesh.nodes)
