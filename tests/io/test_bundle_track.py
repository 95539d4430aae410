"""Node tracks of bundles: exact round trips, bounded errors, and small residuals of smooth motions."""

from __future__ import annotations

import numpy as np
import pytest

from egs_warp.io.bundle_track import NodeTrack, TrackPredictor, whole_steps
from tests.support.meshes import block_mesh

REST = block_mesh(4, 3, 6).nodes.astype(np.float32)


def _swing(frames: int) -> np.ndarray:
    """Return node positions (frames, N, 3) of a block that travels, bends and twists."""
    time = np.arange(frames)[:, None] / 60.0
    z = REST[:, 2]
    angles = 0.3 * np.sin(5.0 * time) * z
    x = np.cos(angles) * REST[:, 0] - np.sin(angles) * REST[:, 1] + 3.0 * time + 0.1 * np.sin(9.0 * time) * z**2
    y = np.sin(angles) * REST[:, 0] + np.cos(angles) * REST[:, 1]
    return np.stack([x, y, z + 0.0 * time], axis=2)


def test_displacements_are_decoded_exactly() -> None:
    """The displacements are random, some of them need 32 bits, and the predictor was fitted to others."""
    rng = np.random.default_rng(0)
    track = NodeTrack.fitted(REST, _swing(30))
    displacements = rng.integers(-300, 300, (7, len(REST), 3))
    displacements[3, 5] = (1_000_000, -70_000, 2)
    predictor = TrackPredictor.from_arrays(track.predictor.arrays())
    packed = track.predictor.residuals(displacements)
    assert packed.stored.dtype == np.uint32
    np.testing.assert_array_equal(predictor.displacements(packed), displacements)


def test_positions_are_within_half_a_step_of_the_diagonal() -> None:
    nodes = _swing(90)
    track = NodeTrack.fitted(REST, nodes)
    positions = track.step * (whole_steps(REST, track.step) + np.cumsum(track.displacements, axis=0))
    error = np.linalg.norm(positions - nodes, axis=2).max()
    assert error == pytest.approx(track.error)
    assert error <= 0.5 * np.linalg.norm(np.ptp(REST, axis=0)) / 65535


def test_residuals_of_a_smooth_motion_are_near_the_rounding_of_the_positions() -> None:
    """Displacements of hundreds of quantisation steps leave residuals of a few steps; only the first nodes have larger
    ones."""
    track = NodeTrack.fitted(REST, _swing(120))
    stored = track.predictor.residuals(track.displacements).stored.reshape(120, -1, 3)
    assert np.abs(track.displacements).mean() > 300.0
    assert np.abs((stored[1:, 20:] + 1) // 2).mean() < 3.0


def test_coincident_nodes_are_stored() -> None:
    rest = np.repeat(REST[:2], 3, axis=0)
    nodes = rest + np.linspace(0.0, 1.0, 9)[:, None, None]
    track = NodeTrack.fitted(rest, nodes)
    assert sorted(track.predictor.order) == list(range(6))
    packed = track.predictor.residuals(track.displacements)
    np.testing.assert_array_equal(track.predictor.displacements(packed), track.displacements)
