"""Random soft bodies, poses and motions for property tests with Hypothesis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from egs_warp.fem.body import BodyState, SoftBody, make_body
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from tests.support.meshes import block_mesh
from tests.support.passive import PassiveBody, passive_body

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


@dataclass(frozen=True)
class Shape:
    """Block with a flat base on z = 0, a wider or narrower top and perturbed nodes, and its material."""

    counts: tuple[int, int, int]
    """Number of nodes along x, y and z."""
    size: tuple[float, float, float]
    """Size along x, y and z, m."""
    taper: float
    """Width of the top divided by the width of the base."""
    sag: float
    poisson_ratio: float
    damping_ratio: float
    seed: int

    def mesh(self) -> TetMesh:
        """Return the mesh, which has no mirror symmetry."""
        block = block_mesh(*self.counts, self.size)
        nodes = block.nodes.copy()
        high = nodes[:, 2] > 0.0
        cell = np.array(self.size) / (np.array(self.counts) - 1)
        nodes[high] += cell * np.random.default_rng(self.seed).uniform(-0.1, 0.1, nodes[high].shape)
        nodes[:, :2] *= 1.0 + (self.taper - 1.0) * nodes[:, 2:] / self.size[2]
        return TetMesh.oriented(nodes, block.tets)

    def body(self, *, device: str = "cpu", mirrored: bool = False, up: np.ndarray | None = None) -> SoftBody:
        """Return the body, optionally mirrored in x = 0 node by node; ``up`` (3,) is opposite to gravity."""
        mesh = self.mesh()
        if mirrored:
            mesh = TetMesh.oriented(mesh.nodes * [-1.0, 1.0, 1.0], mesh.tets)
        matter = {"sag": self.sag, "poisson_ratio": self.poisson_ratio, "damping_ratio": self.damping_ratio}
        return make_body(mesh, FLOOR, up=up, device=device, **matter)


def shapes(*, stiff: bool = False) -> st.SearchStrategy[Shape]:
    """Return a strategy for blocks of 8 to 36 nodes that are half to three times as high as wide. ``stiff`` blocks are
    flat, so that they do not tip over."""
    side = st.floats(0.25, 0.5)
    return st.builds(
        Shape,
        counts=st.tuples(st.integers(2, 3), st.integers(2, 3), st.integers(2, 4)),
        size=st.tuples(side, side, st.floats(0.08, 0.12) if stiff else st.floats(0.25, 0.75)),
        taper=st.floats(0.6, 1.3),
        sag=st.just(0.002) if stiff else st.sampled_from([0.005, 0.02, 0.05]),
        poisson_ratio=st.floats(0.1, 0.45),
        damping_ratio=st.just(0.3) if stiff else st.sampled_from([0.0, 0.05, 0.3]),
        seed=st.integers(0, 2**31),
    )


@dataclass(frozen=True)
class Throw:
    """Pose and motion: rotation, strain, random displacements of the nodes, velocity and angular velocity."""

    turn: tuple[float, float, float]
    """Rotation vector, rad."""
    strain: tuple[float, float, float]
    velocity: tuple[float, float, float]
    """Velocity in units of sqrt(g H)."""
    spin: tuple[float, float, float]
    """Angular velocity in units of sqrt(g / H)."""
    noise: float
    seed: int

    def state(self, body: SoftBody, *, lift: float | None = None) -> BodyState:
        """Return the state of ``body``, with its lowest node at ``lift`` body heights above the floor if ``lift`` is
        given."""
        random, nodes = np.random.default_rng(self.seed), body.mesh.nodes
        turn = Rotation.from_rotvec(self.turn)
        x = turn.apply((nodes - body.centre_of_mass(nodes)) * (1.0 + np.array(self.strain)))
        x = x + 0.02 * self.noise * body.height * random.uniform(-1.0, 1.0, x.shape)
        if lift is not None:
            x[:, 2] += lift * body.height - x[:, 2].min()
        spin = np.array(self.spin) / body.time_unit
        v = body.speed_unit * (np.array(self.velocity) + 0.1 * self.noise * random.uniform(-1.0, 1.0, x.shape))
        return BodyState(x, v + np.cross(spin, x - body.centre_of_mass(x)))


def throws(*, turn: float = 3.0, fastest: float = 0.5) -> st.SearchStrategy[Throw]:
    """Return a strategy for throws with velocities up to ``fastest`` sqrt(g H) in each direction and rotations up to
    ``turn`` rad about each axis."""

    def three(limit: float) -> st.SearchStrategy[tuple[float, float, float]]:
        return st.tuples(*[st.floats(-limit, limit)] * 3)

    return st.builds(
        Throw,
        turn=three(turn),
        strain=three(0.05),
        velocity=three(fastest),
        spin=three(1.5),
        noise=st.floats(0.0, 1.0),
        seed=st.integers(0, 2**31),
    )


def standing(body: SoftBody, friction: float, state: BodyState, *, device: str = "cpu") -> PassiveBody:
    """Place ``body`` over the floor, with contact points at the nodes of its base and at its highest nodes."""
    nodes = body.mesh.nodes
    places = np.concatenate([nodes[nodes[:, 2] == 0.0], nodes[nodes[:, 2] > 0.8 * nodes[:, 2].max()]])
    return passive_body(body, places, plane=FLOOR, friction=friction, state=state, device=device)
