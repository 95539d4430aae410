"""Round trips of bundles: the values that are read equal those that were written, within the stated errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from egs_warp.io.bundle import read_bundle, write_bundle
from tests.support.bundles import FRAMES, bundle_bytes, small_bundle, text_of


def test_reading_returns_what_was_written(tmp_path: Path) -> None:
    made = small_bundle()
    write_bundle(tmp_path / "a.egs", made)
    read, text = read_bundle(tmp_path / "a.egs"), text_of(bundle_bytes())
    assert (read.rate, read.frames, read.facts["title"]) == (60.0, FRAMES, "block")
    assert read.facts.items() >= made.facts.items()
    for body, written, facts in zip(read.bodies, made.bodies, text["bodies"], strict=True):
        entries, cloud, rest = facts["arrays"], body.splats, written.splats
        assert body.name == written.name and cloud.sh_degree == rest.sh_degree
        for name, slack in (("means", 1e-6), ("log_scales", 1e-6)):
            off = np.abs(getattr(cloud, name).numpy() - getattr(rest, name).numpy()).max()
            assert off <= entries[name]["error"] + slack <= 0.51 * max(entries[name]["step"]) + slack
        # Quaternions of opposite sign are the same rotation.
        cosines = np.abs(np.einsum("ni,ni->n", cloud.rotations.numpy(), rest.rotations.numpy()))
        assert np.degrees(2.0 * np.arccos(np.minimum(cosines, 1.0))).max() < 0.15
        assert np.abs(cloud.opacities() - rest.opacities()).max() <= 0.5 / 255.0 + 1e-6
        assert np.abs(cloud.sh.numpy()[:, 0] - rest.sh.numpy()[:, 0]).max() < 4e-3
        assert np.abs(cloud.sh.numpy()[:, 1:] - rest.sh.numpy()[:, 1:]).max() <= entries["bands"]["error"] + 1e-6
    (block, _), (own, _) = ([body.cage for body in bundle.bodies] for bundle in (read, made))
    assert block is not None and block.level_set is not None and own is not None and own.level_set is not None
    assert (block.level_set.spacing, block.level_set.height) == (0.5, 1.0)
    np.testing.assert_array_equal(block.level_set.origin, own.level_set.origin)
    error = text["bodies"][0]["arrays"]["level_set"]["error"]
    assert error <= 0.5 * 1.3 / 255.0
    np.testing.assert_allclose(block.level_set.coefficients, own.level_set.coefficients, atol=error + 1e-9)


def test_the_error_of_the_nodes_does_not_grow_with_the_distance(tmp_path: Path) -> None:
    made = small_bundle()
    write_bundle(tmp_path / "a.egs", made)
    (body, _), (written, _) = read_bundle(tmp_path / "a.egs").bodies, made.bodies
    assert body.cage is not None and written.cage is not None
    facts, _ = text_of(bundle_bytes())["bodies"]
    assert [block["frames"] for block in facts["blocks"]] == [60, 60, 10]
    assert np.ptp(written.cage.nodes[:, :, 0]) > 40.0
    off = np.linalg.norm(body.cage.nodes - written.cage.nodes, axis=2).max()
    assert off <= facts["node_error"] * (1.0 + 1e-9) < 2e-5
    for name in ("rest_nodes", "cage_tets", "surface", "tets", "carriers", "arm_tets"):
        np.testing.assert_array_equal(getattr(body.cage, name), getattr(written.cage, name))
    np.testing.assert_allclose(body.cage.arm_shares, written.cage.arm_shares, atol=0.5 / 255.0)
    np.testing.assert_allclose(body.cage.arm_lengths, written.cage.arm_lengths, atol=2e-4)


def test_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    write_bundle(tmp_path / "a.egs", small_bundle())
    assert (tmp_path / "a.egs").read_bytes() == bundle_bytes()


def test_the_parts_of_the_file_are_in_the_order_in_which_a_player_needs_them() -> None:
    block, scene = text_of(bundle_bytes())["bodies"]
    starts = [max(entry["offset"] for entry in body["arrays"].values()) for body in (block, scene)]
    starts += [part["arrays"]["residuals"]["offset"] for part in block["blocks"]]
    assert starts == sorted(starts)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 3.0, np.pi])
def test_rotations_of_any_angle_survive(angle: float, tmp_path: Path) -> None:
    made = small_bundle()
    axis = np.array([0.6, 0.0, -0.8])
    turned = np.array([[np.cos(angle / 2), *(np.sin(angle / 2) * axis)]] * 7, np.float32)
    body = made.bodies[1]
    cloud = replace(body.splats, rotations=wp.array(-turned, dtype=wp.vec4, device="cpu"))
    write_bundle(tmp_path / "a.egs", replace(made, bodies=(replace(body, splats=cloud),)))
    read = read_bundle(tmp_path / "a.egs").bodies[0].splats.rotations.numpy()
    assert np.abs(np.abs(read @ turned[0]) - 1.0).max() < 1e-6
