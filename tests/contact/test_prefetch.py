"""Contact points selected on the device, which equal those of the host on every kind of ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")
import torch
import warp as wp

from egs_warp.contact.contact_set import ContactSet
from egs_warp.contact.detection import ContactDetector, ContactGeometry
from egs_warp.contact.prefetch import ContactPrefetch
from egs_warp.contact.selection import ACTIVATION_DEPTH, MAX_CREEP, MAX_SINK, ContactSelector
from egs_warp.deformation.embedding import embed_points
from egs_warp.fem.cuda_graphs import GraphStream
from egs_warp.geometry.plane import Plane
from egs_warp.precision import Vec3
from tests.support.meshes import block_mesh
from tests.support.waves import wavy_ground

NEAR, TOLERANCE = 0.01, 2e-3
FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
WALL = Plane(np.array([-1.0, 0.0, 0.0]), 0.205)


def ground(kind: str) -> ContactGeometry:
    """Create a block with many contact points on its base and its sides, on ground of the given ``kind``."""
    mesh = block_mesh()
    half = mesh.nodes[:, 0].max()
    side = np.linspace(-half, half, 15)
    points = np.array([[x, y, z] for x in side for y in side for z in (0.0, 0.004 * (1 + x), 0.3)])
    embedding = embed_points(mesh, points, device="cpu")
    flat = ContactGeometry(mesh, (FLOOR,), 0.8, embedding.tets.numpy(), embedding.weights.numpy(), 0, 0.0)
    if kind == "corner":
        return replace(flat, planes=(FLOOR, WALL))
    return replace(flat, field=wavy_ground(0.004)) if kind == "waves" else flat


def assert_alike(there: ContactSet, here: ContactSet) -> None:
    for name in ("points", "nodes", "faces"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
    for name in ("weights", "axes", "gaps"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["flat", "corner", "waves"])
def test_selected_points_equal_those_of_the_host(kind: str, device: str) -> None:
    """A body approaches the ground, leans, slides to the wall and leaves it. Each selection starts from the previous
    points, some of which are loaded. Penetrating points that are not in contact are counted."""
    geometry = ground(kind)
    nodes, random = geometry.mesh.nodes, np.random.default_rng(0)
    detector = ContactDetector(geometry, device=device)
    points = ContactSelector(geometry, activation_distance=NEAR, hysteresis=1e-3, device=device)
    sight = ContactPrefetch(detector, points, GraphStream(torch.device(device)), TOLERANCE)
    start, ends = (wp.zeros(len(nodes), dtype=Vec3, device=device) for _ in range(2))
    before, changed, sunk = np.zeros(0, int), 0, 0

    def wait() -> None:
        # In a run, the workspaces synchronise with their graph; in this test, the download needs its own
        # synchronisation.
        if torch.device(device).type == "cuda":
            torch.cuda.synchronize()

    for lean, lift in ((0.0, 0.004), (0.0, 0.0), (0.03, -0.003), (-0.02, -0.004), (0.0, 0.05), (0.01, 0.0)):
        at = nodes + [lean, 0.0, lift] + 0.002 * random.standard_normal(nodes.shape)
        then = at + np.column_stack([np.zeros((len(nodes), 2)), lean * nodes[:, 0] - 0.002])
        start.assign(at)
        ends.assign(then)
        loaded = random.random(len(before)) < 0.5
        gaps, _ = detector.gaps(then)
        here = detector.contact_set(points.select(before, loaded, gaps), at)
        sight.start(start, ends, before, loaded)
        wait()
        there = sight.contacts(len(before))
        assert_alike(there, here)
        changed += len(before) > 0 and here.count > 0 and not np.array_equal(before, here.points)
        taken = there.points[::2]
        seen, least = torch.zeros((2, 1), dtype=torch.float64, device=device)
        places = torch.as_tensor(np.append(taken, [0] * 5).astype(np.int32), device=device)
        count = torch.tensor([len(taken)], dtype=torch.int32, device=device)
        sight.enqueue_penetration(ends, places, count, seen)
        allowed = np.where(gaps < -TOLERANCE, MAX_CREEP, MAX_SINK) * TOLERANCE
        sinks = (gaps < -ACTIVATION_DEPTH * TOLERANCE) & (gaps < detector.gaps(at)[0] - allowed)
        sinks[taken] = False
        sight.enqueue_min_gap(least[0])
        assert seen.item() == sinks.sum() and least.item() == pytest.approx(gaps.min(), abs=1e-12)
        sunk += sinks.any()
        joining = points.find_penetrating(taken, gaps, detector.gaps(at)[0], TOLERANCE)
        # The next step starts from the end of this one.
        after = then + 0.002 * random.standard_normal(nodes.shape)
        next_ends = wp.array(after, dtype=Vec3, device=device)
        loads = torch.as_tensor(np.append(random.normal(size=len(taken)), [1.0] * 5), device=device)
        sight.enqueue_next((start, ends), next_ends, places, count, loads)
        sight.advance()
        wait()
        assert_alike(sight.deepest(len(places)), detector.contact_set(joining, at))
        expected = points.select(taken, loads.cpu().numpy()[: len(taken)] > 0.0, detector.gaps(after)[0])
        assert_alike(sight.contacts(len(places)), detector.contact_set(expected, then))
        sight.enqueue_penetration(next_ends, places, count, seen)
        later = detector.gaps(after)[0]
        allowed = np.where(later < -TOLERANCE, MAX_CREEP, MAX_SINK) * TOLERANCE
        sinks = (later < -ACTIVATION_DEPTH * TOLERANCE) & (later < gaps - allowed)
        sinks[taken] = False
        assert seen.item() == sinks.sum()
        before = here.points
    assert changed > 1 and sunk > 1
