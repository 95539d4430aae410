"""Contacts of many worlds, with their frames and products with their Jacobians, which equal those of a single world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.contact.selection import ACTIVATION_DEPTH, ContactSelector
from tests.support.creatures import coarse_pawn
from tests.support.waves import wavy_ground

NEAR, LOWER = 0.02, 0.002
WORLDS = 4


@pytest.fixture(scope="module", params=["flat", "waves"])
def geometry(request: pytest.FixtureRequest) -> ContactGeometry:
    field = wavy_ground(0.004) if request.param == "waves" else None
    return replace(coarse_pawn().geometry, field=field)


@pytest.fixture(scope="module")
def points(geometry: ContactGeometry) -> ContactSelector:
    return ContactSelector(geometry, activation_distance=NEAR, hysteresis=LOWER, device="cpu")


@pytest.fixture(scope="module")
def detector(geometry: ContactGeometry) -> ContactDetector:
    return ContactDetector(geometry, device="cpu")


@pytest.fixture(scope="module")
def positions() -> np.ndarray:
    """Return node positions (4, N, 3), m, of a body that stands, leans, penetrates the ground, and flies."""
    nodes, random = coarse_pawn().start.positions, np.random.default_rng(0)
    lean = nodes + 0.1 * nodes[:, 2:] * np.array([1.0, 0.0, -0.2])
    deep = nodes + 1e-3 * random.normal(size=nodes.shape) - np.array([0.0, 0.0, 0.02])
    return np.stack([nodes, lean, deep, nodes + np.array([0.0, 0.0, 1.0])])


def points_of(contacts: ContactSet, world: int) -> np.ndarray:
    return contacts.points[world, : int(contacts.counts[world])].numpy()


def contacts_within(detector: ContactDetector, positions: np.ndarray, distance: float) -> ContactSet:
    """Return the contacts of all points less than ``distance`` m above the ground."""
    places = torch.from_numpy(positions)
    gaps, faces = detector.gaps_of_worlds(places)
    order = torch.argsort((gaps >= distance).int(), dim=1, stable=True).int()
    return detector.contact_sets(order, (gaps < distance).sum(dim=1).int(), places, (gaps, faces))


def test_selection_equals_that_of_one_world_in_every_step(
    points: ContactSelector, detector: ContactDetector, positions: np.ndarray
) -> None:
    """The selection and the points that penetrate during a step equal those of single worlds in three steps, in which
    points are added, retained because of their load, and removed."""
    random = np.random.default_rng(1)
    before = [np.zeros(0, int)] * WORLDS
    loads, joins = [np.zeros(0)] * WORLDS, 0
    for lifted in (0.0, 0.012, 0.025):
        places = positions + np.array([0.0, 0.0, lifted])
        start = detector.gaps_of_worlds(torch.from_numpy(places))
        gaps, _ = start
        most = max(map(len, before))
        previous, loaded = torch.zeros((WORLDS, most), dtype=torch.int32), torch.zeros((WORLDS, most), dtype=torch.bool)
        counts = torch.tensor([len(each) for each in before], dtype=torch.int32)
        for world, (its, load) in enumerate(zip(before, loads, strict=True)):
            previous[world, : len(its)], loaded[world, : len(its)] = torch.from_numpy(its), torch.from_numpy(load > 0.0)
        chosen = points.select_in_worlds((previous, counts, loaded.int()), gaps)
        contacts = detector.contact_sets(*chosen, torch.from_numpy(places), start)
        for world, place in enumerate(places):
            expected = points.select(before[world], loads[world] > 0.0, detector.gaps(place)[0])
            assert np.array_equal(points_of(contacts, world), expected)
        # Noise is added, because otherwise all points of a cell would be equally deep.
        noisy = gaps + 0.01 * torch.from_numpy(random.normal(size=gaps.shape))
        tolerance = 0.005 / ACTIVATION_DEPTH
        lowest = points.find_penetrating_in_worlds(contacts, (noisy, gaps), tolerance)
        more = points.append_in_worlds(contacts, lowest, noisy)
        joined = detector.contact_sets(*more, torch.from_numpy(places), start)
        for world in range(WORLDS):
            its = points_of(contacts, world)
            new = points.find_penetrating(its, noisy[world].numpy(), gaps[world].numpy(), tolerance)
            joins += len(new)
            assert np.array_equal(points_of(joined, world), np.concatenate([its, new]))
        before = [points_of(joined, world) for world in range(WORLDS)]
        loads = [np.where(random.random(len(each)) < 0.5, 1.0, 0.0) for each in before]
    assert joins > 0 and len(before[0]) > 0 and len({len(each) for each in before}) > 1


def test_frames_speeds_and_pushes_are_those_of_one(detector: ContactDetector, positions: np.ndarray) -> None:
    contacts = contacts_within(detector, positions, 0.003)
    sets: list[ContactSet] = [detector.contact_set(points_of(contacts, w), positions[w]) for w in range(WORLDS)]
    assert sets[3].count == 0 and min(one.count for one in sets[:3]) > 3
    random, nodes = np.random.default_rng(2), positions.shape[1]
    velocities = random.normal(size=(WORLDS, 3 * nodes, 2))
    forces = random.normal(size=(WORLDS, contacts.capacity, 3))
    rows, speeds = (
        contacts.jacobian_transposed().numpy(),
        contacts.contact_velocities(torch.from_numpy(velocities)).numpy(),
    )
    pushes = contacts.nodal_forces(torch.from_numpy(forces)).numpy()
    ends = contacts.end_gaps(0.1, torch.from_numpy(velocities[:, :, 0].reshape(WORLDS, nodes, 3))).numpy()
    for world, one in enumerate(sets):
        count = one.count
        assert (
            np.array_equal(rows[world, :, : 3 * count], one.jacobian.toarray().T)
            and not rows[world, :, 3 * count :].any()
        )
        np.testing.assert_allclose(speeds[world, : 3 * count], one.jacobian @ velocities[world], rtol=0, atol=1e-13)
        assert not speeds[world, 3 * count :].any()
        expected = one.jacobian.T @ forces[world, :count].ravel()
        np.testing.assert_allclose(pushes[world].ravel(), expected, rtol=0, atol=1e-12)
        lone = one.end_gaps(0.1, velocities[world, :, 0].reshape(nodes, 3))
        np.testing.assert_allclose(ends[world, :count], lone, rtol=0, atol=1e-13)
        assert np.array_equal(contacts.faces[world, :count].numpy(), one.faces)


def test_padding_of_contacts_is_zero(detector: ContactDetector, positions: np.ndarray) -> None:
    contacts = contacts_within(detector, positions, 0.003)
    wide = contacts.with_capacity(contacts.capacity + 2)
    assert wide.gaps[wide.valid].all() and int(wide.valid.sum()) == int(wide.counts.sum())
    for values in (wide.weights, wide.axes, wide.gaps, wide.faces, wide.nodes):
        assert not values[~wide.valid].any()


def test_forces_follow_their_points_in_one_world(detector: ContactDetector, positions: np.ndarray) -> None:
    before, forces = np.array([7, 3, 11]), np.arange(9.0).reshape(3, 3)
    matched = detector.contact_set(np.array([3, 5, 7]), positions[0]).transferred_forces(before, forces)
    assert np.array_equal(matched, [[3, 4, 5], [0, 0, 0], [0, 1, 2]])


def test_forces_follow_their_points(detector: ContactDetector, positions: np.ndarray) -> None:
    now = contacts_within(detector, positions, 0.003)
    then = contacts_within(detector, positions, 0.004)
    forces = torch.from_numpy(np.random.default_rng(3).normal(size=(WORLDS, then.capacity, 3)))
    matched = now.transferred_forces(then.points, forces, then.counts).numpy()
    for world in range(WORLDS):
        count, last = int(now.counts[world]), int(then.counts[world])
        alone = now.download()[world]
        expected = alone.transferred_forces(points_of(then, world), forces[world, :last].numpy())
        assert np.array_equal(matched[world, :count], expected) and not matched[world, count:].any()
