"""Independence of the cage and the body frame of the order, unit, position and axes of the file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from egs_warp.assets import pawn, stool
from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import GROUND, BodyFrame, upright_frame
from egs_warp.geometry.plane import Plane
from egs_warp.io import read_capture
from egs_warp.meshing.body_gaussians import body_gaussians, centred, find_body_frame
from egs_warp.meshing.cage import Cage, build_cage, cage_of_body
from egs_warp.segmentation.base_plane import find_base_plane
from tests.support.frames import Lying
from tests.support.properties import examples

UP = np.array([0.0, 0.0, 1.0])


def body_cage(lying: Lying) -> tuple[BodyFrame, Cage]:
    """Return a cage, about one unit tall, in the frame of its body."""
    near, anchor = centred(lying.cloud)
    frame = find_body_frame(near, lying.plane.moved(-anchor))
    return frame.moved(anchor), cage_of_body(body_gaussians(near, frame))


@pytest.fixture(scope="module", params=["pawn", pytest.param("stool", marks=pytest.mark.slow)])
def thing(request: pytest.FixtureRequest) -> Lying:
    """Return a coarse pawn, which is round, or a coarse stool, which has a front."""
    made = {"pawn": pawn, "stool": stool}[request.param](gaussian_count=3000)
    return Lying(made.cloud, made.plane).on_grid()


@pytest.fixture(scope="module")
def its_cage(thing: Lying) -> Cage:
    return body_cage(thing)[1]


@pytest.mark.parametrize(
    "other",
    [
        lambda thing: thing.moved((1000.0, -333.0, 17.0)).shuffled(3).scaled(2.0**-6),
        pytest.param(lambda thing: thing.shuffled(), marks=pytest.mark.slow),
        pytest.param(lambda thing: thing.scaled(2.0**6), marks=pytest.mark.slow),
        pytest.param(lambda thing: thing.scaled(2.0**-3), marks=pytest.mark.slow),
        pytest.param(lambda thing: thing.moved((1000.0, -333.0, 17.0)), marks=pytest.mark.slow),
    ],
    ids=["all three", "shuffled", "x64", "x1/8", "moved"],
)
def test_same_bits_for_any_frame_of_the_file(thing: Lying, its_cage: Cage, other: Callable[[Lying], Lying]) -> None:
    changed = other(thing)
    assert not np.array_equal(changed.cloud.means.numpy(), thing.cloud.means.numpy())
    _, cage = body_cage(changed)
    assert np.array_equal(cage.mesh.nodes, its_cage.mesh.nodes) and np.array_equal(cage.mesh.tets, its_cage.mesh.tets)
    assert cage.enclosed_opacity_mass == its_cage.enclosed_opacity_mass


@pytest.mark.parametrize(
    "other",
    [
        lambda thing: thing.turned().scaled(0.37),
        pytest.param(lambda thing: thing.scaled(0.37), marks=pytest.mark.slow),
        pytest.param(lambda thing: thing.turned(), marks=pytest.mark.slow),
    ],
    ids=["both", "x0.37", "turned"],
)
def test_same_cage_in_any_unit_and_orientation(thing: Lying, its_cage: Cage, other: Callable[[Lying], Lying]) -> None:
    """The tetrahedra are the same, and the nodes differ by less than 1e-5 of the height because of rounding."""
    _, cage = body_cage(other(thing))
    assert np.array_equal(cage.mesh.tets, its_cage.mesh.tets)
    assert np.abs(cage.mesh.nodes - its_cage.mesh.nodes).max() < 1e-5 * its_cage.height(GROUND)


def test_the_cage_transforms_with_the_capture(thing: Lying) -> None:
    cage, turned = build_cage(thing.cloud, thing.plane), thing.turned()
    along = build_cage(turned.cloud, turned.plane)
    turn = np.linalg.lstsq(cage.mesh.nodes, along.mesh.nodes, rcond=None)[0]
    assert np.abs(along.mesh.nodes - cage.mesh.nodes @ turn).max() < 1e-5
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-5)
    assert np.abs(turned.plane.heights(along.mesh.nodes)).min() < 1e-12


def test_the_base_plane_transforms_with_the_capture(thing: Lying) -> None:
    level = find_base_plane(thing.cloud, UP).offset
    assert find_base_plane(thing.shuffled().cloud, UP).offset == level
    assert find_base_plane(thing.scaled(4.0).cloud, UP).offset == 4.0 * level
    assert find_base_plane(thing.moved((8.0, -16.0, 4.0)).cloud, UP).offset == pytest.approx(level - 4.0, abs=1e-14)
    turned = thing.turned()
    assert find_base_plane(turned.cloud, turned.up).offset == pytest.approx(level, abs=1e-5)


@settings(max_examples=examples(40))
@given(
    st.integers(0, 10**6),
    st.floats(1e-3, 1e3),
    st.floats(0.0, 2.0 * np.pi),
    st.lists(st.floats(-100.0, 100.0), min_size=3, max_size=3),
)
def test_the_frame_transforms_with_the_body(seed: int, scale: float, angle: float, shift: list[float]) -> None:
    """The coordinates of random points in the body frame do not change."""
    random = np.random.default_rng(seed)
    points = random.normal(size=(200, 3)) * random.uniform(0.3, 1.0, 3)
    weights = random.uniform(0.1, 1.0, 200)
    turn = Rotation.from_rotvec(angle * UP).as_matrix()
    frame = upright_frame(points, weights, GROUND)
    assert np.allclose(frame.axes @ frame.axes.T, np.eye(3)) and np.linalg.det(frame.axes) > 0.0
    plane = GROUND.scaled(scale).moved(np.array(shift))
    other = scale * points @ turn.T + shift
    seen = upright_frame(other, weights, plane).points(other)
    # With nearly equal moments, rounding could determine the axes; sets of 200 random points have no such moments.
    assert np.abs(seen - frame.points(points)).max() < 1e-6 * np.abs(seen).max()


@pytest.mark.parametrize("sides", [3, 4, 5])
def test_round_bodies_face_along_their_longest_directions(sides: int) -> None:
    """A regular star has no longest axis. The x axis of its frame passes through one of its tips or between two of
    them, and rotates with the star."""
    random = np.random.default_rng(sides)
    azimuth = 2.0 * np.pi * np.repeat(np.arange(sides), 50) / sides + np.tile(random.normal(0.0, 0.1, 50), sides)
    radius = np.tile(random.uniform(0.2, 1.0, 50), sides)
    star = np.column_stack(
        [radius * np.cos(azimuth), radius * np.sin(azimuth), np.tile(random.uniform(0, 1, 50), sides)]
    )
    facing = []
    for angle in (0.0, 0.3):
        turned = star @ Rotation.from_rotvec(angle * UP).as_matrix().T
        x = upright_frame(turned, np.ones(len(star)), GROUND).axes[0]
        facing.append(np.arctan2(x[1], x[0]))
    step = 2.0 * np.pi / sides
    assert (facing[1] - facing[0] - 0.3 + 0.5 * step) % step - 0.5 * step == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("sides", [3, 4, 5, 6])
@pytest.mark.parametrize("turned", [0.0, 0.1])
def test_a_star_is_faced_through_a_tip(sides: int, turned: float) -> None:
    tips = turned + 2.0 * np.pi * np.arange(sides) / sides
    star = np.concatenate([r * np.stack([np.cos(tips), np.sin(tips), 0.0 * tips], axis=1) for r in (0.5, 1.0)])
    x = upright_frame(star, np.ones(len(star)), GROUND).axes[0]
    step = 2.0 * np.pi / sides
    assert (np.arctan2(x[1], x[0]) - turned + 0.5 * step) % step - 0.5 * step == pytest.approx(0.0, abs=1e-9)


def test_corners_do_not_outweigh_a_long_side() -> None:
    """The largest fourth moment of a rectangle's four corners is along its diagonals."""
    corners = np.array([[x, y, 0.3] for x in (-0.5, 0.5) for y in (-0.6, 0.6)])
    frame = upright_frame(corners, np.ones(4), GROUND)
    assert np.abs(frame.axes[0]) == pytest.approx(np.array([0.0, 1.0, 0.0]), abs=1e-9)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_long_body_faces_along_its_length_towards_its_tail(way: float) -> None:
    """The body is denser at the end opposite to the tail, so the tail dominates the third moments about the centre."""
    along = way * np.linspace(0.0, 1.0, 201) ** 1.5
    aside = np.resize([0.05, -0.05], 201)
    points = np.column_stack([0.6 * along - 0.8 * aside, 0.8 * along + 0.6 * aside, np.full(201, 0.3)])
    frame = upright_frame(points, np.ones(201), GROUND)
    assert frame.axes == pytest.approx(way * np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0, 0, way]]), abs=0.02)


def test_the_origin_is_under_the_centre_and_the_unit_is_the_median_distance() -> None:
    """The points are on a sphere above a tilted plane."""
    random = np.random.default_rng(0)
    half = random.normal(size=(500, 3))
    points = 2.0 * np.concatenate([half, -half]) / np.linalg.norm(np.concatenate([half, half]), axis=1)[:, None]
    plane = Plane.from_coefficients(0.0, 0.6, 0.8, 5.0)
    middle = np.array([1.0, 2.0, 3.0])
    frame = upright_frame(points + middle, np.ones(1000), plane)
    assert frame.scale == pytest.approx(0.5)
    assert frame.axes[2] == pytest.approx(np.array([0.0, 0.6, 0.8]))
    assert plane.heights(frame.origin) == pytest.approx(0.0, abs=1e-12)
    assert np.cross(middle - frame.origin, plane.normal) == pytest.approx(np.zeros(3), abs=1e-9)


def test_strays_do_not_turn_the_frame() -> None:
    random = np.random.default_rng(0)
    points = random.normal(size=(2000, 3)) * [1.0, 0.5, 0.8]
    strays = np.concatenate([points, [[80.0, 90.0, 0.0], [1e4, -1e4, 50.0]]])
    clean = upright_frame(points, np.ones(2000), GROUND)
    dirty = upright_frame(strays, np.ones(2002), GROUND)
    assert abs(clean.axes[0] @ dirty.axes[0]) > 0.9999
    assert np.linalg.norm(clean.origin - dirty.origin) < 0.01
    with pytest.raises(UserError, match="object: all of its 5 Gaussians are at one point, so it has no volume"):
        upright_frame(np.ones((5, 3)), np.ones(5), GROUND)


def test_round_trip() -> None:
    frame = BodyFrame(Rotation.from_rotvec([0.2, 0.5, -1.0]).as_matrix(), np.array([3.0, -1.0, 2.0]), 2.5)
    points = np.random.default_rng(0).normal(size=(20, 3))
    plane = Plane.from_coefficients(0.1, 0.9, -0.3, 0.7)
    assert np.allclose(frame.capture_points(frame.points(points)), points)
    assert np.allclose(frame.plane(plane).heights(frame.points(points)), 2.5 * plane.heights(points))
    assert np.allclose(frame.moved(np.ones(3)).points(points + 1.0), frame.points(points))


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("name", "up"), [("monkey.ply", (0, 1, 0)), ("plush_dog.ply", (0, -1, 0))])
def test_real_captures(data_dir: Path, name: str, up: tuple[int, int, int]) -> None:
    """Shuffling, or scaling by a power of two, gives the same bits; rotating and scaling by any factor gives the same
    tetrahedra."""
    cloud = read_capture(data_dir / "objects" / name).cloud
    lying = Lying(cloud, find_base_plane(cloud, np.array(up, float)))
    _, cage = body_cage(lying)
    for other in (lying.shuffled(), lying.scaled(0.25)):
        nodes = body_cage(other)[1].mesh.nodes
        assert np.array_equal(nodes, cage.mesh.nodes)
    _, turned = body_cage(lying.turned().scaled(0.37))
    assert np.array_equal(turned.mesh.tets, cage.mesh.tets)
    assert np.abs(turned.mesh.nodes - cage.mesh.nodes).max() < 1e-5 * cage.height(GROUND)
