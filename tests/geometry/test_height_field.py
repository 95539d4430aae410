"""Uneven ground: its spline, its normals, and the frames of contact points on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.height_field import HeightField, check_grid
from tests.support.waves import LENGTH, wave, wavy_ground

AXES = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()


def tilted(field: HeightField) -> HeightField:
    """Return the same ground, rotated and translated."""
    return HeightField(field.axes @ AXES.T, AXES @ field.origin + [0.3, -2.0, 0.7], field.spacing, field.coefficients)


def scattered(field: HeightField, count: int = 300) -> np.ndarray:
    """Return (count, 3) points within and outside the grid."""
    random = np.random.default_rng(0)
    rows, columns = field.coefficients.shape
    flat = random.uniform(-3.0, 3.0 + max(rows, columns), (count, 2)) * field.spacing
    return field.origin + flat @ field.axes[:2] + random.uniform(-0.2, 0.2, (count, 1)) * field.axes[2]


def test_ground_interpolates_its_nodes_and_follows_waves() -> None:
    """A sine of 16 spacings is reproduced to 0.02 % of its height at the nodes and to 0.5 % between them."""
    field = wavy_ground(1.0, spacing=LENGTH / 16)
    nodes = field.nodes()[3:-3, 3:-3]
    assert np.abs(nodes[..., 2] - wave(nodes[..., :2], 1.0)).max() < 2e-4
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (2000, 3))
    assert np.abs(field.ground_height(points) - wave(points[:, :2], 1.0)).max() < 5e-3


def test_normals_are_the_gradient_of_the_gap() -> None:
    """The normals equal the gradient by central differences: exactly on the ground, and to first order in the height
    above it."""
    field = tilted(wavy_ground(0.05))
    points = scattered(field)
    on = points - field.heights(points)[:, None] * field.normal
    step = 1e-6

    def gradient(at: np.ndarray) -> np.ndarray:
        return np.stack([field.gaps(at + e) - field.gaps(at - e) for e in step * np.eye(3)], axis=1) / (2.0 * step)

    frames = field.frames(on)
    # The second derivative of a quadratic spline jumps between cells.
    assert np.abs(gradient(on) - frames[:, 0]).max() < 1e-5
    lifted = on + 0.01 * field.normal
    assert np.abs(gradient(lifted) - frames[:, 0]).max() < 0.05
    assert np.abs(frames @ frames.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12
    assert np.linalg.det(frames) == pytest.approx(1.0)


def test_frames_rotate_continuously() -> None:
    """Along a line of 4,000 points that crosses many cells and leaves the grid, the axes of neighbouring points differ
    by less than 0.005."""
    field = tilted(wavy_ground(0.05, reach=1.0))
    line = field.origin + np.linspace(-0.3, 2.5, 4000)[:, None] * (field.axes[0] + 0.7 * field.axes[1])
    assert np.abs(np.diff(field.frames(line), axis=0)).max() < 5e-3


def test_flat_ground_is_the_plane() -> None:
    field = tilted(replace(wavy_ground(), coefficients=np.full((101, 101), 0.25)))
    points = scattered(field)
    plane = field.plane
    assert field.heights(points) == pytest.approx(plane.heights(points) - 0.25)
    assert field.gaps(points) == pytest.approx(plane.heights(points) - 0.25)
    assert np.allclose(field.frames(points)[:, 0], plane.normal)


def test_it_is_the_same_ground_in_every_frame() -> None:
    field = tilted(wavy_ground())
    points = scattered(field)
    frame = BodyFrame(Rotation.from_rotvec([1.0, 0.2, -0.5]).as_matrix(), np.array([0.5, 0.1, -0.2]), 3.0)
    there = frame.height_field(field)
    assert there.gaps(frame.points(points)) == pytest.approx(3.0 * field.gaps(points), abs=1e-12)
    assert field.scaled(2.0).gaps(2.0 * points) == pytest.approx(2.0 * field.gaps(points), abs=1e-12)
    shift = np.array([0.3, 0.2, 0.1])
    assert field.moved(shift).gaps(points + shift) == pytest.approx(field.gaps(points), abs=1e-12)


def test_levelled_and_raised_are_inverse() -> None:
    field = tilted(wavy_ground())
    points = scattered(field)
    level = field.flatten(points)
    assert field.plane.heights(level) == pytest.approx(field.heights(points), abs=1e-12)
    assert field.unflatten(level) == pytest.approx(points, abs=1e-12)


def test_top_is_where_a_vertical_line_meets_the_ground() -> None:
    """The ground is wavy and tilted, and the vertical is 20 degrees from its normal."""
    field = tilted(wavy_ground())
    up = Rotation.from_rotvec(np.radians(20.0) * field.axes[0]).apply(field.normal)
    point = field.origin + 2.1 * field.axes[0] + 1.7 * field.axes[1] + 0.4 * field.normal
    way = field.distance_along(point, up)
    assert way < 0.0 and field.heights(point + way * up) == pytest.approx(0.0, abs=1e-9)


def test_coarser_ground_keeps_long_waves() -> None:
    """Waves with a length of 16 new spacings change by at most 3 % of their amplitude; waves with a length of two keep
    at most 35 % of it."""
    field = wavy_ground(0.03, spacing=0.02)
    coarse = field.coarser(0.05)
    assert coarse.spacing == 0.05 and len(coarse.coefficients) < 0.5 * len(field.coefficients)
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (2000, 3))
    assert np.abs(coarse.ground_height(points) - field.ground_height(points)).max() < 0.03 * 0.03
    narrow = replace(field, coefficients=0.03 * np.cos(np.pi * np.arange(251) * 0.02 / 0.05) * np.ones((251, 1)))
    assert np.abs(narrow.coarser(0.05).ground_height(points)).max() < 0.35 * 0.03
    assert field.coarser(0.01) is field


@pytest.mark.parametrize(
    "broken",
    [
        {"coefficients": np.zeros((2, 5))},
        {"coefficients": np.full((5, 5), np.nan)},
        {"spacing": 0.0},
        {"origin": np.array([np.inf, 0.0, 0.0])},
        {"axes": np.ones((3, 3))},
    ],
)
def test_a_grid_that_is_no_ground_is_refused(broken: dict) -> None:
    with pytest.raises(UserError, match="ground: its height field is damaged; make it again with egs-warp segment"):
        check_grid(replace(wavy_ground(), **broken))
