"""Limbs and feet of bodies of many shapes. The kind of support follows from the limbs and from the contact with the
ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.meshing.occupancy import LatticeSolid
from egs_warp.motions.feet import SupportKind, find_feet, order_counterclockwise, support_kind_of
from egs_warp.motions.limbs import Sections, find_limbs
from tests.support.meshes import carved, coarse_stool, column, figure, stool

Shape = Callable[[np.ndarray], np.ndarray]
"""Function that returns (n,) bool, True for the points (n, 3) that are inside."""
SIZE = (1.0, 1.0, 1.0)


def legged(count: int, *, radius: float = 0.36, thick: float = 0.09, seat: float = 0.7, turn: float = 0.3) -> Shape:
    """Return a round seat on ``count`` legs."""
    angles = turn + 2.0 * np.pi * np.arange(count) / count
    places = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def holds(p: np.ndarray) -> np.ndarray:
        away = np.linalg.norm(p[:, None, :2] - places, axis=2).min(axis=1)
        return (away < thick) | ((np.linalg.norm(p[:, :2], axis=1) < 0.47) & (p[:, 2] > seat))

    return holds


def ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p - [0.0, 0.0, 0.5], axis=1) < 0.5


def pawn(p: np.ndarray) -> np.ndarray:
    radius = np.linalg.norm(p[:, :2], axis=1)
    return (radius < 0.35) & (p[:, 2] < 0.2) | (radius < 0.15) | (np.linalg.norm(p - [0, 0, 0.8], axis=1) < 0.22)


def mesh_of(shape: Shape, size: tuple[float, float, float] = SIZE, cell: float = 0.05) -> TetMesh:
    return carved(size, cell, shape)


def feet_of(mesh: TetMesh, heights: np.ndarray | None = None) -> tuple[int, SupportKind]:
    heights = mesh.nodes[:, 2] if heights is None else heights
    feet = find_feet(mesh, heights, float(np.ptp(heights)))
    return len(feet), support_kind_of(mesh, heights, len(feet))


SNAKE = carved((2.4, 0.3, 0.2), 0.05, lambda p: np.abs(p[:, 1] - 0.06 * np.sin(6.0 * p[:, 0])) < 0.09)
BODIES = {
    "stool": (stool(), 4, SupportKind.FEET),
    "coarse stool": (coarse_stool(), 4, SupportKind.FEET),
    "figure": (figure(), 2, SupportKind.FEET),
    "column": (column(), 1, SupportKind.SINGLE_BASE),
    "tripod": (mesh_of(legged(3)), 3, SupportKind.FEET),
    "six legs": (mesh_of(legged(6)), 6, SupportKind.FEET),
    "eight legs": (mesh_of(legged(8), cell=0.04), 8, SupportKind.FEET),
    "snake": (SNAKE, 0, SupportKind.LYING),
    "ball": (mesh_of(ball), 1, SupportKind.ROUND_BASE),
    "pawn": (mesh_of(pawn), 1, SupportKind.SINGLE_BASE),
    "block": (mesh_of(lambda p: np.ones(len(p), bool), (0.6, 0.5, 1.0), 0.1), 1, SupportKind.SINGLE_BASE),
}


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("tilt", [0.0, 1.0, -1.0])
def test_support_of_bodies(name: str, tilt: float) -> None:
    """The kind of support and the number of feet are correct for the true plane and for one tilted by a degree."""
    mesh, count, base = BODIES[name]
    normal = Rotation.from_euler("y", tilt, degrees=True).as_matrix()[:, 2]
    heights = mesh.nodes @ normal
    assert feet_of(mesh, heights - heights.min()) == (count, base)


def short_legged(p: np.ndarray) -> np.ndarray:
    """Return True for points inside a table whose leg at +x, +y ends 0.05 above the ground."""
    legs = np.abs(np.abs(p[:, :2]) - 0.35).max(axis=1) < 0.1
    ends = np.where((p[:, :2] > 0.0).all(axis=1), 0.05, 0.0)
    return (legs & (p[:, 2] > ends)) | (p[:, 2] > 0.7)


def test_a_table_with_one_short_leg_has_four_feet() -> None:
    """The short foot and its height above the ground are reported; its sole consists of the lowest nodes of its own
    leg."""
    mesh = mesh_of(short_legged)
    feet = find_feet(mesh, mesh.nodes[:, 2], 1.0)
    assert len(feet) == 4
    short = [foot for foot in feet if foot.height > 0.0]
    assert [foot.height for foot in short] == [pytest.approx(0.05)]
    assert np.all(mesh.nodes[short[0].sole, :2] > 0.0) and np.all(mesh.nodes[short[0].sole, 2] == pytest.approx(0.05))
    assert not any(foot.is_joined for foot in feet)


def test_a_hanging_limb_is_no_foot() -> None:
    """A fifth leg ends a quarter of the height above the ground."""
    mesh = mesh_of(lambda p: short_legged(p) | ((np.abs(p[:, :2]).max(axis=1) < 0.1) & (p[:, 2] > 0.25)))
    assert feet_of(mesh) == (4, SupportKind.FEET)


def melted(thickness: float) -> TetMesh:
    """Return four legs that are joined by a slab at their base."""
    four = legged(4, turn=0.25 * np.pi)
    return mesh_of(lambda p: four(p) | ((np.abs(p[:, :2]).max(axis=1) < 0.4) & (p[:, 2] < thickness)))


def test_legs_joined_at_the_base_are_separated() -> None:
    """Each sole is a quarter of the slab, and each foot is marked as joined."""
    mesh = melted(0.05)
    feet = find_feet(mesh, mesh.nodes[:, 2], 1.0)
    assert len(feet) == 4 and all(foot.is_joined for foot in feet)
    corners = {tuple(np.sign(mesh.nodes[foot.sole, :2].mean(axis=0)).astype(int)) for foot in feet}
    assert corners == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    for foot in feet:
        assert foot.length == pytest.approx(0.7, abs=0.03)
        assert np.all(foot.leg[foot.sole] == 1.0)
    assert len(np.unique(np.concatenate([foot.sole for foot in feet]))) == sum(len(foot.sole) for foot in feet)


def test_legs_on_a_thick_slab_stand_on_one_base() -> None:
    assert feet_of(melted(0.25)) == (1, SupportKind.SINGLE_BASE)


@pytest.mark.parametrize(("length", "count"), [(1.4, 2), (0.8, 4)])
def test_legs_on_runners_stand_on_the_runners(length: float, count: int) -> None:
    """A body on two long runners, such as an armchair, has two feet. If the connected legs are close together, as in a
    chair, the connection may be a flaw of the capture, and four feet are found. Both the mesh and the lattice solid are
    tested."""

    def sledge(p: np.ndarray) -> np.ndarray:
        posts = (np.abs(np.abs(p[:, 0]) - 0.5 * length + 0.1) < 0.1) & (np.abs(np.abs(p[:, 1]) - 0.4) < 0.1)
        runners = (np.abs(np.abs(p[:, 1]) - 0.4) < 0.1) & (p[:, 2] < 0.08) & (np.abs(p[:, 0]) < 0.5 * length)
        return posts | runners | ((p[:, 2] > 0.7) & (np.abs(p[:, 0]) < 0.5 * length))

    mesh = mesh_of(sledge, (1.4, 1.0, 1.0), 0.04)
    assert feet_of(mesh) == (count, SupportKind.FEET)
    spacing = 1.0 / 32.0
    places = np.stack(np.meshgrid(*[np.arange(n) for n in (47, 35, 33)], indexing="ij"), axis=-1)
    inside = sledge((spacing * (places - [23, 17, 0])).reshape(-1, 3)).reshape(places.shape[:3])
    solid = LatticeSolid(inside, np.array([-23, -17, 0]), spacing, 1.0, np.ones(1, bool), np.zeros(1, bool), 0)
    assert find_limbs(Sections.of_solid(solid, mesh), mesh.nodes).count == count


def test_a_raised_tail_carries_nothing() -> None:
    """The tail rises from the same slab as the trunk, so there is a single base."""
    mesh = mesh_of(
        lambda p: (
            (p[:, 2] < 0.1)
            | (np.linalg.norm(p[:, :2] - [0.2, 0.0], axis=1) < 0.25)
            | ((np.linalg.norm(p[:, :2] + [0.35, 0.0], axis=1) < 0.1) & (p[:, 2] < 0.8))
        )
    )
    assert feet_of(mesh) == (1, SupportKind.SINGLE_BASE)


def test_gaps_finer_than_the_cage_are_found_in_the_solid() -> None:
    """Two legs are 0.06 apart, and their cage has no gap there. The finer lattice of the capture resolves the gap; the
    feet are marked as joined."""
    spacing = 1.0 / 64.0
    places = np.stack(np.meshgrid(*[np.arange(n) for n in (49, 33, 65)], indexing="ij"), axis=-1)
    points = spacing * (places - [24, 16, 0])
    inside = (np.abs(points[..., 0]) > 0.03) | (points[..., 2] > 0.4)
    solid = LatticeSolid(inside, np.array([-24, -16, 0]), spacing, 1.0, np.ones(1, bool), np.zeros(1, bool), 0)
    cage = carved((0.8, 0.6, 1.0), 0.1, lambda p: np.ones(len(p), bool))
    assert len(find_feet(cage, cage.nodes[:, 2], 1.0)) == 1
    limbs = find_limbs(Sections.of_solid(solid, cage), cage.nodes)
    feet = find_feet(cage, cage.nodes[:, 2], 1.0, limbs)
    assert limbs.tops == (pytest.approx(0.4, abs=0.03),) * 2
    assert [foot.is_joined for foot in feet] == [True, True]
    sides = sorted(float(cage.nodes[foot.sole, 0].mean()) for foot in feet)
    assert sides[0] < -0.1 and sides[1] > 0.1


def test_feet_are_ordered_counterclockwise_from_straight_ahead() -> None:
    """A foot ten degrees to the right of straight ahead comes first; a foot twenty degrees to the right comes last."""

    def at(*degrees: float) -> np.ndarray:
        return np.stack([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))], axis=1)

    assert order_counterclockwise(at(170.0, 80.0, -10.0, -100.0)).tolist() == [2, 1, 0, 3]
    assert order_counterclockwise(at(160.0, 70.0, -20.0, -110.0)).tolist() == [1, 0, 3, 2]
