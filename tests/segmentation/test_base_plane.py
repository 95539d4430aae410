"""The base plane and the guess of up."""

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
    find_base_plane,
    guess_up,
)

_OBJECTS = [("monkey.ply", (0, 1, 0)), ("plush_dog.ply", (0, -1, 0)), ("robot.spz", (0, 1, 0))]


def _with_strays(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Opaque strays up to half a height below the object."""
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
    """The plane of the scaled object is the scaled plane."""
    thing = pawn(gaussian_count=6000)
    plane = find_base_plane(thing.cloud, thing.up)
    scaled = find_base_plane(thing.cloud.scaled(scale), thing.up)
    assert scaled.offset == pytest.approx(scale * plane.offset, abs=1e-3 * scale)


@pytest.mark.data
@pytest.mark.parametrize(("name", "up"), _OBJECTS)
def test_planes_of_real_captures(data_dir: Path, name: str, up: tuple[int, int, int]) -> None:
    """Little mass below, yet visible support within 1.5 % of the height."""
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
    """The guess is right for every real object and says why."""
    guessed, reason = guess_up(read_capture(data_dir / "objects" / name).cloud, None)
    assert np.array_equal(guessed, up)
    assert "support polygon" in reason and "score" in reason


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_up_of_a_turned_pawn(axis: int, sign: float) -> None:
    """A pawn laid along any axis is recognised by its base."""
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
    """A format that defines up is believed."""
    up, reason = guess_up(pawn(gaussian_count=500).cloud, np.array([0.0, -1.0, 0.0]))
    assert np.array_equal(up, [0.0, -1.0, 0.0])
    assert reason == "the file format defines it"


def test_no_height() -> None:
    """A sheet square to up has no base plane."""
    cloud = pawn(gaussian_count=500).cloud
    flat = GaussianCloud.from_numpy(
        cloud.means.numpy() * [1, 1, 0],
        cloud.rotations.numpy(),
        cloud.log_scales.numpy(),
        cloud.opacity_logits.numpy(),
        cloud.sh.numpy(),
    )
    with pytest.raises(UserError, match="have no height along up, so no plane can be found; check up"):
        find_base_plane(flat, np.array([0.0, 0.0, 1.0]))


def test_a_bevel_above_the_sole_is_not_the_support() -> None:
    """Of two levels of the underside the lower one is, though more columns end at the other."""
    random = np.random.default_rng(0)
    bottoms = np.concatenate([random.normal(0.0, 0.001, 60), random.normal(0.08, 0.001, 100)])
    heights = np.concatenate([bottoms, random.uniform(0.1, 1.0, 2000)])
    columns = np.stack(np.divmod(np.arange(160), 16), axis=1)
    seen = _Underside(heights, np.ones(len(heights)), 0.0, 1.0, bottoms, columns, 0.01, np.array([8.0, 5.0]))
    assert abs(_support_level(seen)) < 0.004
    few = replace(seen, bottoms=np.concatenate([bottoms[:20], bottoms[60:]]))
    assert abs(_support_level(few) - 0.08) < 0.004, "too few to hold their own"


def test_the_reason_for_up_is_what_was_weighed() -> None:
    """Scores of the best axis and of the next, and whether they are far apart: a pawn has one base, a cube six."""
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
        assert reason.endswith(f"{sure} ahead of {other}, score {best:.2f} to {second:.2f}")


def test_what_is_flat_along_an_axis_is_not_supported_there() -> None:
    sheet = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 3)) * [1.0, 1.0, 0.0]
    cloud = GaussianCloud.from_numpy(
        sheet, np.tile([1.0, 0, 0, 0], (400, 1)), np.full((400, 3), -5.0), np.full(400, 4.0), np.zeros((400, 1, 3))
    )
    shape = _support_shape(cloud, np.array([0.0, 0.0, 1.0]))
    assert (shape.polygon, shape.level, shape.depth) == (0.0, 0.0, 0.0)
