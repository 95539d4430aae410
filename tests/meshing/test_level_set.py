"""Level sets: distances of a box, gradients compared with finite differences, the fit to outer points of a ball, and
the surfaces of real captures.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from egs_warp.contact.detection import contact_geometry
from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import GROUND
from egs_warp.io.capture import read_capture
from egs_warp.meshing.level_set import (
    EXPOSURE_RADIUS,
    LevelSet,
    level_set_of_body,
    level_set_of_surface,
    outer_points,
    thin_parts,
)
from egs_warp.meshing.occupancy import LatticeSolid
from egs_warp.pipelines.captured_body import CapturedShape
from egs_warp.pipelines.placed_cage import place_cage
from tests.support.meshes import box_mesh


@pytest.fixture(scope="module")
def box() -> LevelSet:
    mesh = box_mesh((1, 1, 1), (1.0, 0.5, 0.3))
    return level_set_of_surface(mesh.nodes, mesh.boundary_faces(), cells=64)


def lattice_solid(inside: np.ndarray, spacing: float) -> LatticeSolid:
    corner = np.array([-(inside.shape[0] // 2), -(inside.shape[1] // 2), 0])
    nothing = np.zeros(0, bool)
    return LatticeSolid(inside, corner, spacing, spacing * max(inside.shape), nothing, nothing, 0)


def test_distances_of_a_box(box: LevelSet) -> None:
    points = np.random.default_rng(0).uniform([-0.55, -0.3, -0.07], [0.55, 0.3, 0.37], (2000, 3))
    away = np.abs(points - [0.0, 0.0, 0.15]) - [0.5, 0.25, 0.15]
    exact = np.linalg.norm(np.maximum(away, 0.0), axis=1) + np.minimum(away.max(axis=1), 0.0)
    values, gradients = box.evaluate(points)
    assert np.abs(values - exact).max() < 0.35 * box.spacing
    # Away from the edges and the medial surface, the distance of a box is a linear function.
    ordered = np.sort(away, axis=1)
    flat = (np.abs(ordered[:, 2]) < 4.0 * box.spacing) & (ordered[:, 1] < -10.0 * box.spacing)
    assert flat.sum() > 50
    assert np.abs(values - exact)[flat].max() < 1e-3 * box.spacing
    assert np.abs(np.linalg.norm(gradients, axis=1)[flat] - 1.0).max() < 2e-3


def test_gradient_is_the_derivative_also_outside_of_the_lattice(box: LevelSet) -> None:
    points, step = np.random.default_rng(1).uniform(-0.9, 0.9, (300, 3)), 1e-5
    values, gradients = box.evaluate(points)
    shifts = step * np.eye(3)
    measured = [(box.evaluate(points + s)[0] - box.evaluate(points - s)[0]) / (2.0 * step) for s in shifts]
    assert np.allclose(np.stack(measured, axis=1), gradients, atol=1e-4)
    places = (points - box.origin) / box.spacing
    inside = np.all((places > 1.0) & (places < np.array(box.coefficients.shape) - 2.0), axis=1)
    coefficients = box.coefficients.astype(float)
    reference = ndimage.map_coordinates(coefficients, places[inside].T, order=2, prefilter=False)
    assert inside.sum() > 10 and np.allclose(reference, values[inside], atol=1e-12)


def test_a_coarser_lattice_has_about_the_same_distances_and_domain(box: LevelSet) -> None:
    coarse = box.resampled(32)
    assert coarse.coefficients.size < box.coefficients.size / 8
    # Near the surface, away from the edges of the box, and beyond both lattices.
    points = np.array([[0.0, 0.0, 0.32], [0.2, 0.1, 0.29], [0.53, 0.05, 0.15], [0.1, -0.27, 0.1], [0.0, 0.0, 0.9]])
    (values, gradients), (close, near) = box.evaluate(points), coarse.evaluate(points)
    np.testing.assert_allclose(close, values, atol=2e-3)
    np.testing.assert_allclose(near, gradients, atol=0.02)


def test_the_surface_passes_through_outer_points_that_were_not_fitted() -> None:
    """The body is a ball of radius 1 on z = 0, whose lattice solid is half a cell too large."""
    spacing, centre = 1.0 / 20.0, np.array([0.0, 0.0, 1.0])
    indices = np.moveaxis(np.indices((45, 45, 43)), 0, -1) - [22, 22, 0]
    inside = np.linalg.norm(spacing * indices - centre, axis=-1) < 1.0 + 0.5 * spacing
    arms = np.random.default_rng(2).normal(size=(3000, 3))
    arms /= np.linalg.norm(arms, axis=1, keepdims=True)
    points = np.concatenate([centre + arms[:2000], centre + 0.8 * arms[:500]])
    exposed = outer_points(points, EXPOSURE_RADIUS * spacing)
    assert exposed[:2000].all() and not exposed[2000:].any()
    fitted = level_set_of_body(lattice_solid(inside, spacing), points)
    values, gradients = fitted.evaluate(centre + arms[2000:])
    assert np.quantile(np.abs(values), 0.95) < 0.1 * spacing
    cosines = (gradients * arms[2000:]).sum(axis=1) / np.linalg.norm(gradients, axis=1)
    assert np.quantile(cosines, 0.05) > 0.98
    assert np.abs(fitted.evaluate(points[2000:])[0] + 0.2).max() < 0.2 * spacing


def test_points_beyond_the_lattice_are_ignored() -> None:
    inside = np.ones((24, 16, 16), bool)
    faces = np.argwhere(inside ^ ndimage.binary_erosion(inside)) - [12, 8, 0]
    points, stray = 0.05 * faces, np.array([[0.0, 0.0, 1.6], [-1.6, 0.0, 0.4]])
    solid = lattice_solid(inside, 0.05)
    alone, fitted = level_set_of_body(solid, points), level_set_of_body(solid, np.concatenate([points, stray]))
    np.testing.assert_allclose(fitted.evaluate(points)[0], alone.evaluate(points)[0], atol=1e-4)


def test_parts_thinner_than_two_cells_are_reported() -> None:
    inside = np.zeros((20, 20, 30), bool)
    inside[5:15, 5:15, :10] = True
    inside[9:10, 9:10, 10:30] = True
    inside[2:4, 2:4, 0:8] = True
    thin = thin_parts(lattice_solid(inside, 0.1))
    assert thin.thickness == 0.2 and len(thin.centres) == 1
    assert np.allclose(thin.centres[0], [-0.1, -0.1, 1.95])
    assert thin.fraction == 20 / inside.sum()
    np.testing.assert_allclose(thin.lengths, 2.0)


def test_a_body_that_is_thin_everywhere_is_reported_with_its_extent() -> None:
    inside = np.zeros((20, 3, 30), bool)
    inside[:, 1, :] = True
    thin = thin_parts(lattice_solid(inside, 0.1))
    assert thin.fraction == 1.0
    np.testing.assert_allclose(thin.lengths, [3.0])


def test_invalid_surfaces_are_refused() -> None:
    mesh = box_mesh((1, 1, 1), (1.0, 1.0, 1.0))
    with pytest.raises(UserError, match="7 cells are requested; give a number from 64 to 96"):
        level_set_of_surface(mesh.nodes, mesh.boundary_faces(), cells=7)
    with pytest.raises(UserError, match="no extent"):
        level_set_of_surface(0.0 * mesh.nodes, mesh.boundary_faces())


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "up"),
    [("monkey.ply", 1.0), ("plush_dog.ply", -1.0), ("plush_dog.compressed.ply", -1.0), ("robot.spz", 1.0)],
)
def test_outer_points_of_a_capture_lie_on_its_level_set(data_dir: Path, name: str, up: float) -> None:
    cloud = read_capture(data_dir / "objects" / name).cloud
    standing = place_cage(cloud, up=np.array([0.0, up, 0.0]), nodes=250)
    height, mesh = standing.cage.height(GROUND), standing.cage.mesh
    geometry = contact_geometry(standing.gaussians, mesh, (GROUND,), grid=2.0**-10 * height, device="cpu")
    corners = mesh.nodes[mesh.tets[geometry.tet_from_point]]
    points = np.einsum("pw,pwi->pi", geometry.weights, corners)
    shape = CapturedShape(standing.gaussians, points)
    outer = points[outer_points(points, EXPOSURE_RADIUS * shape.solid.spacing)]
    assert len(outer) > 2000
    assert np.mean(np.abs(shape.level_set.evaluate(outer)[0]) < 0.005 * height) >= 0.95
