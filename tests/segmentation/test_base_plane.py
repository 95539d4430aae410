"""Base plane, and estimate of the up direction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egs_warp.assets import pawn
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io import read_capture
from egs_warp.meshing.body_gaussians import centred
from egs_warp.segmentation.base_plane import (
    _support_level,
    _support_shape,
    _Underside,
    _underside,
    find_base_plane,
    guess_up,
)

_OBJECTS = [("monkey.ply", (0, 1, 0)), ("plush_dog.ply", (0, -1, 0)), ("robot.spz", (0, 1, 0))]


def _with_strays(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Return the cloud with opaque stray Gaussians up to half of its height below the object."""
    strays = np.random.default_rng(5).uniform([-0.4, -0.4, -0.5], [0.4, 0.4, 0.0], (count, 3))
    join = np.concatenate
    return GaussianCloud.from_numpy(
        join([cloud.means.numpy(), strays]),
        join([cloud.rotations.numpy(), cloud.rotations.numpy()[:count]]),
        join([cloud.log_scales.numpy(), cloud.log_scales.numpy()[:count]]),
        join([cloud.opacity_logits.numpy(), cloud.opacity_logits.numpy()[:count]]),
        join([cloud.sh.numpy(), cloud.sh.numpy()[:count]]),
    )


def test_plane_of_the_pawn() -> None:
    """The plane is found within 0.3 % of the height, also with 1 % opaque strays below it."""
    thing = pawn()
    assert find_base_plane(thing.cloud, thing.up).offset == pytest.approx(0.0, abs=0.003)
    plane = find_base_plane(_with_strays(thing.cloud, 200), thing.up)
    assert np.array_equal(plane.normal, thing.up)
    assert plane.offset == pytest.approx(0.0, abs=0.003)


@pytest.mark.parametrize("scale", [0.1, 3.0])
def test_plane_is_scale_free(scale: float) -> None:
    """The plane of a scaled object is the scaled plane of the object."""
    thing = pawn(gaussian_count=6000)
    plane = find_base_plane(thing.cloud, thing.up)
    scaled = find_base_plane(thing.cloud.scaled(scale), thing.up)
    assert scaled.offset == pytest.approx(scale * plane.offset, abs=1e-3 * scale)


def test_the_length_of_up_does_not_matter() -> None:
    cloud, way = pawn(gaussian_count=3000).cloud, np.array([0.1, -0.2, 1.0])
    plane, longer = find_base_plane(cloud, way), find_base_plane(cloud, 5.0 * way)
    np.testing.assert_allclose(plane.normal, way / np.linalg.norm(way))
    assert np.allclose(longer.normal, plane.normal) and longer.offset == pytest.approx(plane.offset)


@pytest.mark.data
@pytest.mark.parametrize(("name", "up"), _OBJECTS)
def test_planes_of_real_captures(data_dir: Path, name: str, up: tuple[int, int, int]) -> None:
    """Few Gaussians are below the plane, and there is visible support within 1.5 % of the height."""
    cloud = read_capture(data_dir / "objects" / name).cloud
    plane = find_base_plane(cloud, np.array(up, float))
    heights, opacities = plane.heights(cloud.means.numpy()), cloud.opacities()
    assert np.array_equal(plane.normal, up)
    assert opacities[heights < 0].sum() <= 0.0151 * opacities.sum()
    size = np.quantile(heights, 0.995)
    support = (np.abs(heights) < 0.015 * size) & (opacities > 0.3)
    assert opacities[support].sum() >= 0.0025 * opacities.sum()


@pytest.mark.data
@pytest.mark.parametrize(("name", "up"), _OBJECTS)
def test_up_of_real_captures(data_dir: Path, name: str, up: tuple[int, int, int]) -> None:
    """The estimate is correct for every real object and comes with a reason."""
    guessed, reason = guess_up(read_capture(data_dir / "objects" / name).cloud, None)
    assert np.array_equal(guessed, up)
    assert "support polygon" in reason and "points" in reason


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_up_of_a_turned_pawn(axis: int, sign: float) -> None:
    """The up direction of a pawn along any axis follows from its base."""
    cloud = pawn(gaussian_count=6000).cloud
    means = np.roll(cloud.means.numpy(), axis - 2, axis=1)
    means[:, axis] *= sign
    turned = GaussianCloud.from_numpy(
        means, cloud.rotations.numpy(), cloud.log_scales.numpy(), cloud.opacity_logits.numpy(), cloud.sh.numpy()
    )
    expected = np.zeros(3)
    expected[axis] = sign
    assert np.array_equal(guess_up(turned)[0], expected)


def test_up_of_the_format_wins() -> None:
    """The up direction of a format that defines one is used."""
    up, reason = guess_up(pawn(gaussian_count=500).cloud, np.array([0.0, -1.0, 0.0]))
    assert np.array_equal(up, [0.0, -1.0, 0.0])
    assert reason == "the file defines it"


def test_no_height() -> None:
    """A sheet orthogonal to up has no base plane."""
    cloud = pawn(gaussian_count=500).cloud
    flat = GaussianCloud.from_numpy(
        cloud.means.numpy() * [1, 1, 0],
        cloud.rotations.numpy(),
        cloud.log_scales.numpy(),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
    )
    with pytest.raises(UserError, match="have no height along the up direction, so no plane can be found; check up"):
        find_base_plane(flat, np.array([0.0, 0.0, 1.0]))


def test_a_bevel_above_the_sole_is_not_the_support() -> None:
    """The lower of two levels of the underside is found, although more columns end at the higher one."""
    random = np.random.default_rng(0)
    bottoms = np.concatenate([random.normal(0.0, 0.001, 60), random.normal(0.08, 0.001, 100)])
    heights = np.concatenate([bottoms, random.uniform(0.1, 1.0, 2000)])
    columns = np.stack(np.divmod(np.arange(160), 16), axis=1)
    seen = _Underside(heights, np.ones(len(heights)), 0.0, 1.0, bottoms, columns, 0.01, np.array([8.0, 5.0]))
    assert abs(_support_level(seen)) < 0.004
    few = replace(seen, bottoms=np.concatenate([bottoms[:20], bottoms[60:]]))
    assert abs(_support_level(few) - 0.08) < 0.004, "too few to hold their own"


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_the_support_is_the_densest_level_of_columns(size: float) -> None:
    """The bottoms of half of the columns become denser towards the floor; the others are far above it. In any unit, the
    plane is at the 15 % quantile of the bottoms that are within 1.5 % of the height from the densest level.
    """
    bottoms = np.concatenate([0.04 * np.linspace(-1.0, 1.0, 401) ** 3, np.linspace(0.05, 0.14, 401)])
    within = bottoms[np.abs(bottoms) <= 0.015]
    columns = np.stack([np.arange(802), np.zeros(802)], axis=1).astype(int)
    heights = size * np.array([0.0, 1.0])
    found = _support_level(
        _Underside(heights, np.ones(2), 0.0, size, size * bottoms, columns, 0.02 * size, np.array([200.0, 0.0]))
    )
    assert found == pytest.approx(size * np.quantile(within, 0.15), abs=2e-4 * size)


def test_the_reason_for_up_gives_the_scores() -> None:
    """The reason states the scores of the best and the second-best axis, and whether they differ clearly: a pawn has
    one base, a cube has six."""
    cube = np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3))
    cube[np.arange(4000), np.arange(4000) % 3] = np.sign(cube[np.arange(4000), np.arange(4000) % 3]) * 0.5
    block = GaussianCloud.from_numpy(
        cube, np.tile([1.0, 0, 0, 0], (4000, 1)), np.full((4000, 3), -5.0), np.full(4000, 4.0), np.zeros((4000, 1, 3))
    )
    for cloud, sure in ((pawn(gaussian_count=3000).cloud, "clearly"), (block, "narrowly")):
        near, _ = centred(cloud)
        totals = []
        for axis, habit in enumerate((0.0, 0.10, 0.05)):
            for sign in (1.0, -1.0):
                shape = _support_shape(near, sign * np.eye(3)[axis])
                totals.append(
                    (shape.polygon + shape.level + shape.depth + habit, f"{'+' if sign > 0 else '-'}{'xyz'[axis]}")
                )
        (best, name), (second, other) = sorted(totals, key=lambda total: -total[0])[:2]
        up, reason = guess_up(cloud)
        assert up["xyz".index(name[1])] == (1.0 if name[0] == "+" else -1.0)
        assert reason.endswith(f"{sure} ahead of {other}: {best:.2f} against {second:.2f} points")


def test_a_sheet_has_no_support_along_its_normal() -> None:
    sheet = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 3)) * [1.0, 1.0, 0.0]
    cloud = GaussianCloud.from_numpy(
        sheet, np.tile([1.0, 0, 0, 0], (400, 1)), np.full((400, 3), -5.0), np.full(400, 4.0), np.zeros((400, 1, 3))
    )
    shape = _support_shape(cloud, np.array([0.0, 0.0, 1.0]))
    assert (shape.polygon, shape.level, shape.depth) == (0.0, 0.0, 0.0)


def opaque(means: np.ndarray, opacities: np.ndarray | float = 0.98) -> GaussianCloud:
    """Return small isotropic Gaussians at ``means`` (n, 3)."""
    logits = np.broadcast_to(np.log(opacities / (1.0 - np.asarray(opacities))), len(means))
    return GaussianCloud.from_numpy(
        means, np.tile([1.0, 0, 0, 0], (len(means), 1)), np.full((len(means), 3), -5.0), logits,
        np.zeros((len(means), 1, 3)),
    )  # fmt: skip


def test_the_columns_cover_the_footprint() -> None:
    """A block of 2 x 1 is covered by 64 x 32 columns, whose bottoms are its base; its centre is in their middle."""
    x, y, z = np.meshgrid(np.linspace(0.0, 2.0, 160), np.linspace(0.0, 1.0, 80), [0.0, 0.5], indexing="ij")
    block = opaque(np.column_stack([x.ravel(), y.ravel(), z.ravel()]) + [3.0, -2.0, 1.0])
    seen = _underside(block, np.array([0.0, 0.0, 1.0]))
    columns = {(int(a), int(b)) for a, b in seen.columns}
    if np.ptp(seen.columns[:, 0]) < np.ptp(seen.columns[:, 1]):
        columns = {(b, a) for a, b in columns}
    assert columns >= {(a, b) for a in range(64) for b in range(31)}
    np.testing.assert_allclose(seen.bottoms, 1.0, atol=1e-6)
    np.testing.assert_allclose(np.sort(seen.centre), [15.5, 31.5], atol=0.5)


def test_distant_strays_do_not_widen_the_support() -> None:
    """A mushroom whose foot has a ninth of the area of its cap is supported by this fraction, with and without distant
    strays at the level of its base."""
    random = np.random.default_rng(0)

    def disc(radius: float, height: float, count: int) -> np.ndarray:
        angle, share = random.uniform(0.0, 2.0 * np.pi, count), random.uniform(0.0, 1.0, count)
        flat = radius * np.sqrt(share)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return np.column_stack([flat, np.full(count, height)])

    mushroom = np.concatenate([disc(0.2, 0.0, 4000), disc(0.6, 1.0, 40000)])
    strays = np.array([[9.0, 0.0, 0.0], [-9.0, 1.0, 0.0], [0.0, 9.0, 0.0], [0.0, -9.0, 0.0]])
    up = np.array([0.0, 0.0, 1.0])
    for means in (mushroom, np.concatenate([mushroom, strays])):
        shape = _support_shape(opaque(means), up)
        assert shape.polygon == pytest.approx(1.0 / 9.0, abs=0.02)


def test_haze_is_no_support() -> None:
    """An opaque block over haze of equal mass has no support, because none of the low Gaussians is visible."""
    random = np.random.default_rng(0)
    haze, block = random.uniform(0.0, 1.0, (2, 8000, 3))
    block[:, 2] = 0.8 + 0.2 * block[:, 2]
    opacities = np.repeat([0.1, 0.9], 8000)
    shape = _support_shape(opaque(np.concatenate([haze, block]), opacities), np.array([0.0, 0.0, 1.0]))
    assert (shape.polygon, shape.level, shape.depth) == (0.0, 0.0, 0.0)


def test_up_of_a_huge_capture_is_estimated_from_a_subset(monkeypatch: pytest.MonkeyPatch) -> None:
    """The estimate from an even subset of a table equals the estimate from all Gaussians, in any order of the file."""
    random = np.random.default_rng(0)
    top = random.uniform([-1.0, -1.0, 1.0], [1.0, 1.0, 1.05], (6000, 3))
    leg = random.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 1.0], (3000, 3))
    foot = random.uniform([-0.6, -0.6, 0.0], [0.6, 0.6, 0.02], (3000, 3))
    table = opaque(np.concatenate([top, leg, foot])[:, [2, 0, 1]])
    whole = guess_up(table)[0]
    monkeypatch.setattr("egs_warp.segmentation.base_plane._MAX_GAUSSIANS", 4000)
    up, reason = guess_up(table)
    np.testing.assert_array_equal(up, whole)
    assert reason == guess_up(table.subset(random.permutation(table.count)))[1]
