"""Contact selection of the lowest point of each cell, stable from step to step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egs_warp.contact.detection import ContactGeometry
from egs_warp.contact.selection import ACTIVATION_DEPTH, MAX_CELLS_AT_REST, MAX_CREEP, MAX_SINK, ContactSelector
from egs_warp.deformation.embedding import embed_points
from egs_warp.geometry.plane import Plane
from tests.support.meshes import block_mesh

NEAR = 0.01


@pytest.fixture(scope="module")
def geometry() -> ContactGeometry:
    """Create a block with a fine grid of contact points on its base and some on its sides."""
    mesh = block_mesh()
    half = mesh.nodes[:, 0].max()
    side = np.linspace(-half, half, 15)
    points = np.array([[x, y, z] for x in side for y in side for z in (0.0, 0.004 * (1 + x))])
    embedding = embed_points(mesh, points, device="cpu")
    floor = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    return ContactGeometry(mesh, (floor,), 0.8, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)


def gaps_of(geometry: ContactGeometry, tilt: float = 0.0) -> np.ndarray:
    corners = geometry.mesh.nodes[geometry.mesh.tets[geometry.tet_from_point]]
    places = np.einsum("pw,pwi->pi", geometry.weights, corners)
    return places[:, 2] + tilt * places[:, 0]


def test_few_points_one_a_cell(geometry: ContactGeometry) -> None:
    points = ContactSelector(geometry, activation_distance=NEAR, hysteresis=1e-3)
    gaps = gaps_of(geometry)
    chosen = points.select(np.zeros(0, int), np.zeros(0, bool), gaps)
    assert 4 <= len(chosen) <= MAX_CELLS_AT_REST
    cells = points.cell_from_point[chosen]
    assert len(np.unique(cells)) == len(cells)
    for point, cell in zip(chosen, cells, strict=True):
        assert gaps[point] == gaps[points.cell_from_point == cell].min()


def test_loaded_points_stay_and_others_follow_the_lowest(geometry: ContactGeometry) -> None:
    points = ContactSelector(geometry, activation_distance=NEAR, hysteresis=1e-3)
    first = points.select(np.zeros(0, int), np.zeros(0, bool), gaps_of(geometry))
    tilted = gaps_of(geometry, 0.02)
    again = points.select(first, np.ones(len(first), bool), tilted)
    assert np.isin(first[tilted[first] < 2.0 * NEAR], again).all()
    loose = points.select(first, np.zeros(len(first), bool), tilted)
    lowest = {cell: tilted[points.cell_from_point == cell].min() for cell in points.cell_from_point[loose]}
    assert all(tilted[p] <= lowest[points.cell_from_point[p]] + 1e-3 for p in loose)
    lifted = points.select(first, np.ones(len(first), bool), gaps_of(geometry) + 3.0 * NEAR)
    assert len(lifted) == 0


def test_deep_points_are_added(geometry: ContactGeometry) -> None:
    points = ContactSelector(geometry, activation_distance=NEAR, hysteresis=1e-3)
    gaps = gaps_of(geometry) - 0.006
    deep = points.find_penetrating(np.array([int(np.argmin(gaps))]), gaps, gaps + 1.0, 0.005 / ACTIVATION_DEPTH)
    assert len(deep) and (gaps[deep] < -0.005).all() and int(np.argmin(gaps)) not in deep


def test_the_number_of_cells_does_not_depend_on_the_ground_height() -> None:
    """A wide body that starts above the ground has the same cells under it as where it stands."""
    mesh = block_mesh(7, 7, 3, (1.2, 1.2, 0.4))
    side = np.linspace(-0.6, 0.6, 30)
    embedding = embed_points(mesh, np.array([[x, y, 0.0] for x in side for y in side]), device="cpu")
    points = [
        ContactSelector(
            ContactGeometry(mesh, (floor,), 0.8, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0),
            activation_distance=NEAR,
            hysteresis=1e-3,
        )
        for floor in (Plane(np.array([0.0, 0.0, 1.0]), 0.0), Plane(np.array([0.0, 0.0, 1.0]), 0.3))
    ]
    assert 0.5 * MAX_CELLS_AT_REST < len(np.unique(points[0].cell_from_point)) <= MAX_CELLS_AT_REST
    assert np.array_equal(points[0].cell_from_point, points[1].cell_from_point)


def test_rounding_changes_neither_cells_nor_points(geometry: ContactGeometry) -> None:
    """Rounding errors of weights and gaps, which differ between machines, do not change the selection: of points with
    equal gaps, the one closest to the centre of its cell is selected."""
    random = np.random.default_rng(0)
    weights = geometry.weights + 1e-15 * random.standard_normal(geometry.weights.shape)
    other = ContactSelector(replace(geometry, weights=weights), activation_distance=NEAR, hysteresis=1e-3)
    points, gaps = ContactSelector(geometry, activation_distance=NEAR, hysteresis=1e-3), gaps_of(geometry)
    assert np.array_equal(points.cell_from_point, other.cell_from_point)
    none = np.zeros(0, int), np.zeros(0, bool)
    chosen = points.select(*none, gaps)
    for _ in range(5):
        shaken = gaps + 1e-15 * random.standard_normal(gaps.shape)
        assert np.array_equal(other.select(*none, shaken), chosen)
        deep = [points.find_penetrating(chosen, each - 0.02, each, 0.01 / ACTIVATION_DEPTH) for each in (shaken, gaps)]
        assert np.array_equal(deep[0], deep[1]) and len(deep[0]) > 0


def test_selection_follows_its_rules_in_random_steps(geometry: ContactGeometry, device: str) -> None:
    """Both selections equal a loop over the cells, in 20 steps that start from the points of the step before."""
    points = ContactSelector(geometry, activation_distance=NEAR, hysteresis=1e-3, device=device)
    random, sunk, depth = np.random.default_rng(1), 0, 0.002
    previous, loaded, start = np.zeros(0, int), np.zeros(0, bool), gaps_of(geometry)
    for _ in range(20):
        gaps = gaps_of(geometry, random.uniform(-0.05, 0.05)) + random.normal(0.004, 0.004, len(start))
        chosen, deepest = [], []
        for cell in range(points.cell_count):
            members = np.flatnonzero(points.cell_from_point == cell)
            lowest = members[np.argmin(gaps[members])]
            low = gaps[lowest] if gaps[lowest] < NEAR else np.inf
            mine = [(p, load) for p, load in zip(previous, loaded, strict=True) if p in members]
            held = [p for p, load in mine if gaps[p] < 2.0 * NEAR and (load or gaps[p] <= low + 1e-3)]
            chosen += held or [lowest] * int(low < np.inf)
        found = points.select(previous, loaded, gaps)
        assert found.tolist() == sorted(chosen)
        allowed = np.where(gaps < -depth, MAX_CREEP, MAX_SINK) * depth
        sinks = (gaps < -ACTIVATION_DEPTH * depth) & (gaps < start - allowed) & ~np.isin(np.arange(len(gaps)), found)
        for cell in range(points.cell_count):
            members = np.flatnonzero(sinks & (points.cell_from_point == cell))
            deepest += members[np.argsort(gaps[members])][:1].tolist()
        joining = points.find_penetrating(found, gaps, start, depth)
        assert joining.tolist() == sorted(deepest, key=lambda point: gaps[point])
        sunk += len(joining)
        previous, loaded, start = found, random.random(len(found)) < 0.5, gaps
    assert sunk > 20
