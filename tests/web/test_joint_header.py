"""Joint cage of several bodies, which moves each Gaussian as the cage of its own body does."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.web.joint_header import joint_positions, node_starts
from egs_warp.web.recording import arms_of
from egs_warp.web.world_recording import WorldRecording
from tests.support.finished_worlds import FRAMES, NAMES, write_world_run
from tests.support.packets import read_packets


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> WorldRecording:
    return WorldRecording.read(write_world_run(tmp_path_factory.mktemp("world")))


def test_joint_tetrahedra_move_the_gaussians_of_each_body(recording: WorldRecording) -> None:
    facts, arrays, frames = read_packets(recording.bytes())
    assert [part["name"] for part in facts["bodies"]] == list(NAMES) and len(frames) == FRAMES + 1
    nodes = frames[5]["positions"].reshape(-1, 3).astype(float)
    codes = arrays["mean_tets"]
    tets = arrays["tets"][np.where(codes < 0, -1 - codes, codes)]
    rest, now = arrays["rest"].astype(float)[tets], nodes[tets]
    edges = [each[:, 1:] - each[:, :1] for each in (rest, now)]
    arms = arrays["splats_means"].reshape(-1, 3) - rest[:, 0]
    weights = np.linalg.solve(edges[0].transpose(0, 2, 1), arms[..., None])[..., 0]
    moved = now[:, 0] + np.einsum("ni,nij->nj", weights, edges[1])
    for part, run in zip(facts["bodies"], recording.bodies.values(), strict=True):
        first, count = part["splats"]
        means = run.deformer().deform(run.trajectory.positions[run.steps[5]]).cloud.means.numpy()
        # These Gaussians extend over several tetrahedra, which bend differently, so their means are also shifted.
        np.testing.assert_allclose(moved[first : first + count], means, atol=5e-3)
        own = tets[first : first + count]
        assert part["nodes"][0] <= own.min() <= own.max() < sum(part["nodes"])
        node, node_count = part["nodes"]
        surface = arrays["surface"][(arrays["surface"] >= node).all(axis=1)]
        assert ((surface >= node) & (surface < node + node_count)).all(axis=1).any()
    ends, start = arrays["arms"][:, :6], 0
    for part, body in zip(facts["bodies"], recording.page_bodies, strict=True):
        single = arms_of(body.deformer)
        offset = ends[start : start + len(single)] - single[:, :6]
        assert (offset == (0 if part is facts["bodies"][0] else len(recording.page_bodies[0].cage.tets))).all()
        start += len(single)
    assert start == len(ends)
    assert arrays["node_mass"].sum() == pytest.approx(sum(t.node_mass.sum() for t in recording.trajectories), rel=1e-5)


def test_level_set_of_each_body(recording: WorldRecording) -> None:
    facts, arrays, _ = read_packets(recording.bytes())
    start, tet = 0, 0
    for part, body, t in zip(facts["bodies"], recording.page_bodies, recording.trajectories, strict=True):
        lattice, coefficients = part["level_set"], body.level_set.coefficients
        assert lattice["counts"] == list(coefficients.shape) and lattice["spacing"] == body.level_set.spacing
        np.testing.assert_array_equal(lattice["origin"], body.level_set.origin)
        np.testing.assert_array_equal(arrays["level_sets"][start : start + coefficients.size], coefficients.ravel())
        assert part["height"] == t.height and part["tets"] == [tet, len(t.tets)]
        start, tet = start + coefficients.size, tet + len(t.tets)
    assert start == len(arrays["level_sets"]) and tet == len(arrays["tets"])


def test_curves_and_rows_of_each_body(recording: WorldRecording) -> None:
    facts, _, frames = read_packets(recording.bytes())
    assert [curve["body"] for curve in facts["curves"]] == [0] * 5 + [1] * 5
    assert facts["bodies"][1]["result"] == "box-1 fell" and not facts["bodies"][1]["creature"]
    heights = np.array([frame["curves"][5] for frame in frames])
    # The second body falls on the first one.
    assert (np.diff(heights)[:3] < 0.0).all()


def test_positions_of_all_bodies_are_joined(recording: WorldRecording) -> None:
    bodies = recording.page_bodies
    poses = [run.trajectory.positions[0] for run in recording.bodies.values()]
    joint = joint_positions(bodies, poses)
    first, second = node_starts(bodies)
    assert first == 0
    np.testing.assert_array_equal(joint[: len(poses[0])], poses[0])
    np.testing.assert_array_equal(joint[second : second + 4], poses[1])
