"""Contacts of many worlds equal those of one: selection, frames, and nodal forces."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from egs_warp.contact.batch_contacts import BatchContacts, BatchDetector
from egs_warp.contact.detection import ContactDetector, ContactSet
from egs_warp.contact.selection import ContactSelector
from egs_warp.pipelines.creature import Creature
from tests.support.creatures import coarse_pawn

NEAR, LOWER = 0.02, 0.002
WORLDS = 4


@pytest.fixture(scope="module")
def creature() -> Creature:
    return coarse_pawn()


@pytest.fixture(scope="module")
def points(creature: Creature) -> ContactSelector:
    return ContactSelector(creature.geometry, activation_distance=NEAR, hysteresis=LOWER)


@pytest.fixture(scope="module")
def detector(creature: Creature, points: ContactSelector) -> BatchDetector:
    return BatchDetector(creature.geometry, points, WORLDS, device=torch.device("cpu"))


@pytest.fixture(scope="module")
def positions(creature: Creature) -> np.ndarray:
    """(4, N, 3) positions of a body that stands, leans, lies deep in the ground, and flies."""
    nodes, random = creature.start.positions, np.random.default_rng(0)
    lean = nodes + 0.1 * nodes[:, 2:] * np.array([1.0, 0.0, -0.2])
    deep = nodes + 1e-3 * random.normal(size=nodes.shape) - np.array([0.0, 0.0, 0.02])
    return np.stack([nodes, lean, deep, nodes + np.array([0.0, 0.0, 1.0])])


def points_of(contacts: BatchContacts, world: int) -> np.ndarray:
    return contacts.points[world, : int(contacts.counts[world])].numpy()


def alone(creature: Creature, chosen: list[np.ndarray], positions: np.ndarray) -> list[ContactSet]:
    one = ContactDetector(creature.geometry, device="cpu")
    return [one.contact_set(each, place) for each, place in zip(chosen, positions, strict=True)]


def test_selection_equals_that_of_one_world_in_every_step(
    creature: Creature, points: ContactSelector, detector: BatchDetector, positions: np.ndarray
) -> None:
    """In three steps, points are added, retained because of their load, removed, and joined by deeper ones."""
    random = np.random.default_rng(1)
    before = [np.zeros(0, int)] * WORLDS
    loads, joins = [np.zeros(0)] * WORLDS, 0
    one = ContactDetector(creature.geometry, device="cpu")
    for lifted in (0.0, 0.012, 0.025):
        places = positions + np.array([0.0, 0.0, lifted])
        gaps, faces = detector.gaps(torch.from_numpy(places))
        most = max(map(len, before))
        previous, loaded = torch.zeros((WORLDS, most), dtype=torch.int64), torch.zeros((WORLDS, most), dtype=torch.bool)
        there = torch.arange(most) < torch.tensor([[len(each)] for each in before])
        for world, (its, load) in enumerate(zip(before, loads, strict=True)):
            previous[world, : len(its)], loaded[world, : len(its)] = torch.from_numpy(its), torch.from_numpy(load > 0.0)
        contacts = detector.contacts(detector.select(previous, there, loaded, gaps), gaps, faces)
        for world, place in enumerate(places):
            expected = points.select(before[world], loads[world] > 0.0, one.gaps(place)[0])
            assert np.array_equal(points_of(contacts, world), expected)
        # Without noise, all points of a cell would be equally deep.
        noisy = gaps + 0.01 * torch.from_numpy(random.normal(size=gaps.shape))
        deep = detector.find_deeper(contacts, noisy, 0.005)
        added = detector.contacts(deep, gaps, faces, order=noisy)
        forces = torch.from_numpy(random.uniform(0.1, 1.0, (*contacts.points.shape, 3))) * contacts.valid[:, :, None]
        joined, wide = detector.append_contacts(contacts, forces, added)
        for world in range(WORLDS):
            new = points.find_deeper(points_of(contacts, world), noisy[world].numpy(), 0.005)
            assert np.array_equal(points_of(added, world), new)
            joins += len(new)
            assert np.array_equal(points_of(joined, world), np.concatenate([points_of(contacts, world), new]))
            count = int(contacts.counts[world])
            assert torch.equal(wide[world, :count], forces[world, :count]) and not wide[world, count:].any()
        before = [points_of(joined, world) for world in range(WORLDS)]
        loads = [np.where(random.random(len(each)) < 0.5, 1.0, 0.0) for each in before]
    assert joins > 0 and len(before[0]) > 0 and len({len(each) for each in before}) > 1


def test_frames_speeds_and_pushes_are_those_of_one(
    creature: Creature, detector: BatchDetector, positions: np.ndarray
) -> None:
    gaps, faces = detector.gaps(torch.from_numpy(positions))
    contacts = detector.contacts(gaps < 0.003, gaps, faces)
    sets = alone(creature, [points_of(contacts, world) for world in range(WORLDS)], positions)
    assert sets[3].count == 0 and min(one.count for one in sets[:3]) > 3
    random, nodes = np.random.default_rng(2), positions.shape[1]
    velocities = random.normal(size=(WORLDS, 3 * nodes, 2))
    forces = random.normal(size=(WORLDS, contacts.capacity, 3))
    rows, speeds = (
        contacts.jacobian_transposed(nodes).numpy(),
        contacts.contact_velocities(torch.from_numpy(velocities)).numpy(),
    )
    pushes = contacts.nodal_forces(torch.from_numpy(forces), nodes).numpy()
    ends = contacts.end_gaps(0.1, torch.from_numpy(velocities[:, :, 0].reshape(WORLDS, nodes, 3))).numpy()
    for world, one in enumerate(sets):
        count = one.count
        assert (
            np.array_equal(rows[world, :, : 3 * count], one.dense_jacobian.T) and not rows[world, :, 3 * count :].any()
        )
        np.testing.assert_allclose(
            speeds[world, : 3 * count], one.dense_jacobian @ velocities[world], rtol=0, atol=1e-13
        )
        assert not speeds[world, 3 * count :].any()
        expected = one.dense_jacobian.T @ forces[world, :count].ravel()
        np.testing.assert_allclose(pushes[world].ravel(), expected, rtol=0, atol=1e-12)
        lone = one.end_gaps(0.1, velocities[world, :, 0].reshape(nodes, 3))
        np.testing.assert_allclose(ends[world, :count], lone, rtol=0, atol=1e-13)
        assert np.array_equal(contacts.faces[world, :count].numpy(), one.faces)


def test_forces_follow_their_points(detector: BatchDetector, positions: np.ndarray) -> None:
    gaps, faces = detector.gaps(torch.from_numpy(positions))
    now = detector.contacts(gaps < 0.003, gaps, faces)
    then = detector.contacts(gaps < 0.004, gaps, faces)
    forces = torch.from_numpy(np.random.default_rng(3).normal(size=(WORLDS, then.capacity, 3)))
    matched = detector.transfer_forces(now, then.points, then.valid, forces).numpy()
    for world in range(WORLDS):
        count, last = int(now.counts[world]), int(then.counts[world])
        expected = ContactSelector.transfer_forces(
            points_of(now, world), points_of(then, world), forces[world, :last].numpy()
        )
        assert np.array_equal(matched[world, :count], expected) and not matched[world, count:].any()
