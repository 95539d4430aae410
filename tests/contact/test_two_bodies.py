"""Contact between two bodies in a reference step, against closed forms of collision, rest and sliding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.contact.detection import ContactGeometry
from egs_warp.contact.pair_contact import PairBody
from egs_warp.contact.selection import ContactSelector
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.affine_body import VolumeMoments, affine_body
from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.geometry.plane import Plane
from egs_warp.meshing.level_set import level_set_of_surface
from tests.support.meshes import UP, box_mesh
from tests.support.passive import ABYSS
from tests.support.reference_world import ReferenceWorld

FLOOR = Plane(UP, 0.0)
DT = 1 / 120


def surface_grid(size: tuple[float, float, float], count: int = 4) -> np.ndarray:
    axes = [np.linspace(-size[0] / 2, size[0] / 2, count), np.linspace(-size[1] / 2, size[1] / 2, count)]
    axes.append(np.linspace(0.0, size[2], count))
    indices = np.moveaxis(np.indices((count,) * 3), 0, -1).reshape(-1, 3)
    on_surface = ((indices == 0) | (indices == count - 1)).any(axis=1)
    return np.stack([axis[index] for axis, index in zip(axes, indices[on_surface].T, strict=True)], axis=1)


def box(size: tuple[float, float, float], plane: Plane, *, soft: bool = False) -> tuple[SoftBody, PairBody]:
    shape = box_mesh((2, 2, 2), size)
    if soft:
        body = make_body(shape, FLOOR, sag=0.02, device="cpu")
    else:
        body = affine_body(VolumeMoments.of_mesh(shape), size[2], up=UP, device="cpu")
    embedding = embed_points(body.mesh, surface_grid(size), device="cpu")
    geometry = ContactGeometry(body.mesh, (plane,), 0.5, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    selector = ContactSelector(geometry, activation_distance=0.01 * size[2], hysteresis=1e-3 * size[2], device="cpu")
    level_set = level_set_of_surface(shape.nodes, shape.boundary_faces(), cells=64)
    return body, PairBody(geometry, selector, level_set, body.mesh.nodes)


def world(
    parts: list[tuple[SoftBody, PairBody]], shifts: list[list[float]], speeds: list[list[float]], friction: float
) -> ReferenceWorld:
    states = [
        BodyState(body.mesh.nodes + shift, np.tile(speed, (len(body.mesh.nodes), 1)).astype(float))
        for (body, _), shift, speed in zip(parts, shifts, speeds, strict=True)
    ]
    return ReferenceWorld([body for body, _ in parts], [contact for _, contact in parts], states, friction)


@pytest.mark.parametrize("soft", [False, True])
def test_a_collision_conserves_momenta_and_props_do_not_rebound(soft: bool) -> None:
    size, heavier = (0.4, 0.4, 0.4), (0.8, 0.4, 0.4)
    parts = [box(size, ABYSS), box(heavier, ABYSS, soft=soft)]
    parts = [(replace(body, gravity=0.0 * body.gravity), contact) for body, contact in parts]
    offset = 0.05 if soft else 0.0
    meeting = world(parts, [[0.0, 0.0, 0.0], [0.63, 0.0, offset]], [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], 0.4)
    before, has_touched = meeting.momenta(), False
    for _ in range(20):
        meeting.advance(DT)
        assert meeting.residual < 1e-9
        has_touched |= bool((meeting.forces[:, 0] > 0.0).any())
        assert meeting.depth() < 0.01 * size[2]
    assert has_touched
    for old, new in zip(before, meeting.momenta(), strict=True):
        assert np.abs(new - old).max() < 1e-12 * np.linalg.norm(before[0])
    speeds = [b.centre_of_mass(s.velocities)[0] for b, s in zip(meeting.bodies, meeting.states, strict=True)]
    if soft:
        assert 0.0 < speeds[1] - speeds[0] < 1.0
    else:
        assert np.allclose(speeds, 1.0 / 3.0, atol=1e-4)


def test_a_prop_comes_to_rest_on_a_soft_block() -> None:
    low, high = (0.5, 0.5, 0.4), (0.3, 0.3, 0.3)
    parts = [box(low, FLOOR, soft=True), box(high, FLOOR)]
    stack = world(parts, [[0.0, 0.0, 0.0], [0.03, 0.02, 0.402]], [[0.0, 0.0, 0.0], [0.0, 0.0, -0.3]], 0.5)
    for _ in range(120):
        stack.advance(DT)
        assert stack.residual < 1e-9
    assert stack.depth() < 0.01 * high[2]
    assert np.abs(stack.states[1].velocities).max() < 2e-3
    assert stack.pairs is not None
    nodal = (stack.pairs.jacobian.T @ stack.forces.ravel()).reshape(-1, 3)
    carried = nodal[stack.detector.node_starts[1] :].sum(axis=0)
    assert np.allclose(carried, stack.bodies[1].weight * UP, atol=0.01 * stack.bodies[1].weight)
    tilt = stack.bodies[1].best_fit_rotation(stack.states[1].positions)[2, 2]
    assert tilt > 0.9999
