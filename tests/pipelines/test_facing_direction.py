"""Facing direction, which is found from the mirror plane and from differences between front and back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.assets import figurine, stool
from egs_warp.assets.object import BuiltInObject
from egs_warp.errors import ArgumentError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.facing_direction import Front, _lean, mean_view
from egs_warp.pipelines.placed_cage import PlacedCage, choose_front, place_cage
from tests.support.frames import Lying
from tests.support.meshes import carved

DOWN = np.array([0.0, -1.0, 0.0])
"""Facing direction of the built-in figures."""


def front_of(
    standing: PlacedCage, front: np.ndarray | None = None, seen_from: np.ndarray | None = None
) -> tuple[Front, np.ndarray]:
    """Return the facing direction, and its vector in the axes of the capture."""
    found = choose_front(standing, front, seen_from=seen_from)
    return found, standing.frame.axes.T @ found.direction


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0))))


@pytest.fixture(
    scope="module", params=[figurine, pytest.param(stool, marks=pytest.mark.slow)], ids=["figurine", "stool"]
)
def thing(request: pytest.FixtureRequest) -> BuiltInObject:
    return request.param(gaussian_count=6000)


@pytest.fixture(scope="module")
def standing(thing: BuiltInObject) -> PlacedCage:
    """Create the cage in the original orientation of the file."""
    return place_cage(thing.cloud, plane=thing.plane, nodes=200)


@pytest.mark.parametrize("turn", [None, [0.7, -1.1, 0.4]])
def test_a_figurine_faces_its_face_and_a_stool_away_from_its_back(
    thing: BuiltInObject, standing: PlacedCage, turn: list[float] | None
) -> None:
    """The facing direction is correct for any orientation of the file; the message states it in these axes."""
    way = DOWN
    if turn is not None:
        axes = Rotation.from_rotvec(turn).as_matrix()
        lying, way = Lying(thing.cloud, thing.plane).turned(axes), axes @ DOWN
        standing = place_cage(lying.cloud, plane=lying.plane, nodes=200)
    found = choose_front(standing)
    assert degrees(standing.frame.axes.T @ found.direction, way) < 8.0
    told = found.description(standing.frame)
    other = "" if found.alternative is None else f", but may be {_numbers(standing.frame.axes.T @ found.alternative)}"
    guess = _numbers(standing.frame.axes.T @ found.direction)
    assert told == f"front is taken to be {guess}{other}; if that is wrong, give the front"
    assert found.reason is not None and "times the detail of its back" in found.reason


def _numbers(vector: np.ndarray) -> str:
    return ",".join(f"{x:.2f}" for x in vector)


def plain_box(width: float, depth: float) -> Lying:
    """Return a grey box with equal sides."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (6000, 3))
    face_of = rng.integers(0, 3, len(points))
    points[np.arange(len(points)), face_of] = np.where(rng.uniform(size=len(points)) < 0.5, -0.5, 0.5)
    points = (points + [0.0, 0.0, 0.5]) * [width, depth, 1.0]
    count = len(points)
    cloud = GaussianCloud.from_numpy(
        points,
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.full((count, 3), np.log(0.02)),
        np.full(count, 4.0),
        np.zeros((count, 1, 3)),
        device="cpu",
    )
    return Lying(cloud, Plane(np.array([0.0, 0.0, 1.0]), 0.0))


@pytest.mark.slow
def test_a_box_without_features_has_an_alternative() -> None:
    """The message names both possible directions."""
    box = plain_box(0.9, 0.5)
    standing = place_cage(box.cloud, plane=box.plane, nodes=60)
    found, _ = front_of(standing)
    assert found.alternative is not None and degrees(found.direction, found.alternative) > 59.0
    other = ",".join(f"{x:.2f}" for x in standing.frame.axes.T @ found.alternative)
    told = found.description(standing.frame)
    assert f", but may be {other}; if that is wrong" in told
    assert found.reason is not None and "not clearly better than the next best direction" in found.reason


def test_a_head_leans_ahead_and_a_back_leans_behind() -> None:
    """The centre of the top part is ahead for a body with a head, like a cow, and behind for a chair with a back."""

    def cow(centres: np.ndarray) -> np.ndarray:
        x, y, z = centres.T
        legs = (np.abs(np.abs(x) - 0.6) < 0.1) & (z < 0.4)
        return legs | ((np.abs(y) < 0.1) & (z > 0.4) & (z < 0.8)) | ((x > 0.55) & (z > 0.8))

    def chair(centres: np.ndarray) -> np.ndarray:
        return (centres[:, 2] < 0.5) | (centres[:, 0] < -0.2)

    def filled(mesh: TetMesh) -> np.ndarray:
        cells = mesh.nodes[mesh.tets].mean(axis=1)
        # All tetrahedra have the same volume.
        assert np.ptp(mesh.volumes()) < 1e-9
        return cells * [1.0, 1.0, 1.0 / cells[:, 2].max()]

    upper, top = (_lean(filled(carved((1.6, 0.4, 1.0), 0.1, cow)), height) for height in (0.7, 0.85))
    assert 0.1 < upper[0] < 0.5 < top[0] < 0.8 and np.abs([upper[1], top[1]]).max() < 0.01
    for height in (0.7, 0.85):
        ahead, left = _lean(filled(carved((0.6, 0.6, 1.0), 0.1, chair)), height)
        assert ahead == pytest.approx(0.25, abs=0.01) and abs(left) < 0.01


@pytest.mark.slow
def test_photos_from_one_side_determine_the_front() -> None:
    """A box without features faces the side from which it was photographed."""
    box = plain_box(0.9, 0.5)
    standing = place_cage(box.cloud, plane=box.plane, nodes=200)
    for side in (1.0, -1.0):
        way = side * np.array([0.0, 1.0, 0.0])
        cameras = [
            Camera.look_at(5.0 * (way + [x, 0.0, 0.3]), np.zeros(3), np.array([0.0, 0.0, 1.0]), width=8, height=8)
            for x in (-0.6, 0.0, 0.6)
        ]
        found, front = front_of(standing, seen_from=mean_view(cameras, np.zeros(3)))
        assert degrees(front, way) < 15.0
        assert "it was photographed from the front" in str(found.reason)


def test_cameras_all_around_determine_no_front() -> None:
    angles = np.arange(12) * np.pi / 6.0
    eyes = np.stack([np.cos(angles), np.sin(angles), np.full(12, 0.4)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    seen = mean_view([Camera.look_at(eye, np.zeros(3), up, width=8, height=8) for eye in eyes], np.zeros(3))
    assert seen is not None and np.abs(seen[:2]).max() < 1e-12
    assert mean_view([], np.zeros(3)) is None


def test_a_given_front_is_projected_onto_the_ground(standing: PlacedCage) -> None:
    found, front = front_of(standing, np.array([1.0, 1.0, 3.0]))
    np.testing.assert_allclose(front, np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0), atol=1e-12)
    assert found.reason is None


def test_a_front_that_points_up_is_refused_before_any_work(thing: BuiltInObject) -> None:
    with pytest.raises(ArgumentError, match="front 0,0,-2: points up or down; give a direction along the ground"):
        make_creature(thing.cloud, plane=thing.plane, options=CreatureOptions(front=np.array([0.0, 0.0, -2.0])))


def test_the_estimate_does_not_depend_on_the_number_of_cage_nodes() -> None:
    """``live`` and ``animate`` use different cages of the same capture, and must face the same direction."""
    made = figurine(gaussian_count=6000)
    coarse, fine = (choose_front(place_cage(made.cloud, plane=made.plane, height=1.0, nodes=n)) for n in (60, 400))
    assert degrees(coarse.direction, fine.direction) < 0.2
    assert coarse.reason == fine.reason
