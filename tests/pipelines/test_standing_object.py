"""Object and support of a point: pedestals, small bases, flat objects, and points on the ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.io.capture import read_capture
from egs_warp.pipelines.locate_plane import locate_plane
from egs_warp.pipelines.standing_object import find_standing_object
from egs_warp.segmentation.object_spec import Box, ObjectSpec
from tests.support.grounds import ball, level
from tests.support.scenes import FLOOR, blocks, lying

UP = FLOOR.normal
GROUND = -1.2
"""Height of the ground below a pedestal whose top is at z = 0."""


def joined(*parts: GaussianCloud) -> GaussianCloud:
    whole = parts[0]
    for part in parts[1:]:
        whole = concatenate(whole, part)
    return whole


def slab(half: float, low: float, high: float) -> GaussianCloud:
    """Return an upright block of rough stone: few of the Gaussians on its top, which is at ``high``, lie flat."""
    flat = lying(level((-half, -half), (half, half), high, 0.1))
    return joined(blocks(((-half, -half, low), (half, half, high))), flat)


def floor(height: float = 0.0) -> GaussianCloud:
    """Return a floor that scatters, as trained ones do."""
    points = level((-2.0, -2.0), (2.0, 2.0), height, 0.05)
    points[:, 2] += np.random.default_rng(5).normal(0.0, 0.006, len(points))
    return lying(points)


def on_pedestal(half: float = 0.43) -> GaussianCloud:
    """Return a ball of diameter 1 on a pedestal, of which only a narrow ledge is visible."""
    return joined(ball(), slab(half, GROUND, 0.0), floor(GROUND))


def point(*coordinates: float) -> ObjectSpec:
    return ObjectSpec(point=np.array(coordinates))


def test_an_object_ends_at_the_top_of_its_pedestal() -> None:
    """The object is the ball alone, and a note gives the plane with which the pedestal is included."""
    cloud = on_pedestal()
    found = find_standing_object(cloud, point(0.0, -0.5, 0.5), UP, 25.0)
    own = found.segmentation.object_mask
    assert own[:5000].mean() > 0.9 and own[5000:].sum() < 50
    assert abs(float(found.plane.heights(np.zeros(3)))) < 0.02
    (note,) = found.notes
    assert note.startswith("the object ends at the base on which it stands; to include it, give the plane ")
    ground = Plane.from_coefficients(*map(float, note.split()[-1].split(",")))
    whole = locate_plane(cloud, point(0.0, -0.5, 0.5), plane=ground).segmentation.object_mask
    assert whole[:5000].mean() > 0.9 and whole[5000 : cloud.count - 6400].mean() > 0.8


def test_a_base_that_is_smaller_than_the_object_belongs_to_it() -> None:
    cloud = joined(ball(), slab(0.43, -0.25, 0.0), floor(-0.25))
    found = find_standing_object(cloud, point(0.0, -0.5, 0.5), UP, 25.0)
    own = found.segmentation.object_mask
    assert own[:5000].mean() > 0.9 and own[5000 : cloud.count - 6400].mean() > 0.6
    (note,) = found.notes
    assert note.startswith("the object includes the base on which it stands; to leave it out, give the plane ")
    top = Plane.from_coefficients(*map(float, note.split()[-1].split(",")))
    assert abs(float(top.heights(np.zeros(3)))) < 0.02


def test_a_slab_in_the_box_belongs_to_the_object() -> None:
    """A statue on a slab that is hardly wider than it, on a pedestal that surrounds both. The statue, slab included,
    ends at the pedestal, and a note gives the plane on the slab."""
    statue = joined(slab(0.41, 0.0, 1.0), slab(0.44, -0.1, 0.0))
    cloud = joined(statue, slab(0.6, GROUND, -0.1), floor(GROUND))
    box = ObjectSpec(box=Box(np.array([-0.5, -0.5, -0.13]), np.array([0.5, 0.5, 1.02])))
    found = find_standing_object(cloud, box, UP, 25.0)
    own = found.segmentation.object_mask
    assert abs(float(found.plane.heights(np.array([0.0, 0.0, -0.1])))) < 0.02
    # The underside of the slab is in the plane of the pedestal.
    is_higher = cloud.means.numpy()[: statue.count, 2] > -0.09
    assert own[: statue.count][is_higher].mean() > 0.99 and own[statue.count :].mean() < 0.01
    (note,) = found.notes
    assert note.startswith("the object includes the base on which it stands; to leave it out, give the plane ")
    top = Plane.from_coefficients(*map(float, note.split()[-1].split(",")))
    assert abs(float(top.heights(np.zeros(3)))) < 0.03


@pytest.mark.data
@pytest.mark.parametrize(
    ("low", "high"),
    [((-0.45, -0.4, 1.56), (0.5, 0.4, 2.6)), ((-0.6, -0.5, 1.5), (0.6, 0.5, 2.6))],
    ids=["tight", "wider than the pedestal"],
)
def test_a_box_around_the_fox_includes_its_slab(data_dir: Path, low: tuple, high: tuple) -> None:
    """The top of the pedestal is at z = 1.60, and that of the slab at z = 1.69."""
    cloud = read_capture(data_dir / "scenes" / "fox.ply").cloud
    found = find_standing_object(cloud, ObjectSpec(box=Box(np.array(low), np.array(high))), UP, 25.0)
    assert 1.58 < -found.plane.offset < 1.62
    assert 0.27 < found.segmentation.object_mask.mean() < 0.35


def test_a_point_on_a_pedestal_names_the_object_that_stands_on_it() -> None:
    with pytest.raises(
        UserError, match=r"^object: the point 0\.41,0\.41,0 lies on a level surface 1\.2 above the"
    ) as error:
        find_standing_object(on_pedestal(), point(0.41, 0.41, 0.0), UP, 25.0)
    assert "to select this surface as well, give also the plane of the ground" in str(error.value)


@pytest.mark.parametrize("height", [-0.015, 0.0, 0.015])
def test_a_point_on_the_floor_names_the_object_beside_it(height: float) -> None:
    cloud = joined(ball(), floor())
    message = r"^object: the point 0\.7,0\.3,.* lies on the ground, beside an object of \d+ Gaussians and size 1\.7"
    with pytest.raises(UserError, match=message) as error:
        find_standing_object(cloud, point(0.7, 0.3, height), UP, 25.0)
    suggested = str(error.value).split("such as ")[1]
    found = find_standing_object(cloud, point(*map(float, suggested.split(","))), UP, 25.0)
    assert found.segmentation.object_mask[:5000].mean() > 0.97


def test_a_point_below_the_floor_is_told_from_a_missing_floor() -> None:
    message = r"^object: the point 0,-0\.5,-0\.7 is 0\.70\d* below the widest level surface, .* give a"
    with pytest.raises(UserError, match=message):
        find_standing_object(joined(ball(), floor()), point(0.0, -0.5, -0.7), UP, 25.0)


def test_a_box_inside_an_object_is_refused_with_what_to_give() -> None:
    inside = ObjectSpec(box=Box(np.array([-0.2, -0.2, 0.7]), np.array([0.2, 0.2, 1.1])))
    with pytest.raises(UserError, match=r"^object: .*give a box around the whole object"):
        find_standing_object(joined(ball(), floor()), inside, UP, 25.0)


def test_a_point_or_a_box_that_contains_only_floor_is_refused() -> None:
    with pytest.raises(UserError, match=r"^object: the point 0\.7,0\.3,0 lies on the ground, and nothing rises above"):
        find_standing_object(floor(), point(0.7, 0.3, 0.0), UP, 25.0)
    piece = ObjectSpec(box=Box(np.array([0.3, -0.2, -0.1]), np.array([1.1, 0.8, 0.1])))
    with pytest.raises(UserError, match="object: "):
        find_standing_object(floor(), piece, UP, 25.0)


def test_a_failure_above_the_scatter_of_the_ground_keeps_its_cause() -> None:
    """The floor scatters by 0.006, and nothing stands on it."""
    with pytest.raises(
        UserError, match=r"^object: no part of it lies above the plane; mark it with other masks, a box"
    ):
        find_standing_object(floor(), point(0.7, 0.3, 0.05), UP, 25.0)


def test_a_mound_without_a_step_is_refused_unless_the_plane_is_given() -> None:
    """A legitimate flat object on grass looks like a mound; the messages say that masks select it."""

    def mound(height: float) -> GaussianCloud:
        cloud = floor()
        means = cloud.means.numpy()
        means[:, 2] += height * np.exp(-np.square(means[:, :2]).sum(axis=1) / 0.5**2)
        return lying(means)

    advice = (
        "lies on the ground, and nothing rises above it there; give a point on the object, above the ground, or mark"
    )
    with pytest.raises(UserError, match=f"^object: the point 0,0,0.14 {advice} it with masks$"):
        find_standing_object(mound(0.14), point(0.0, 0.0, 0.14), UP, 25.0)
    found = locate_plane(mound(0.14), point(0.0, 0.0, 0.14), plane=FLOOR)
    assert found.notes == (f"the object may be wrong: the point 0,0,0.14 {advice} it with masks",)
    box = ObjectSpec(box=Box(np.array([-0.7, -0.7, -0.1]), np.array([0.7, 0.7, 0.3])))
    (note,) = locate_plane(mound(0.1), box, plane=FLOOR).notes
    assert note.endswith(
        "wrong: the box contains only ground; give a box around the whole object, or mark it with masks"
    )


@pytest.mark.parametrize("thickness", [0.05, 0.12])
def test_a_flat_object_on_the_floor_is_found(thickness: float) -> None:
    """The point is on the top of a book of 0.8 x 0.6 on a floor."""
    top = lying(level((-0.4, -0.3), (0.4, 0.3), thickness, 0.03))
    book = joined(blocks(((-0.4, -0.3, 0.0), (0.4, 0.3, thickness - 0.01))), top)
    cloud = joined(book, floor())
    found = find_standing_object(cloud, point(0.1, 0.05, thickness), UP, 25.0)
    own = found.segmentation.object_mask
    assert own[book.count - top.count : book.count].mean() > 0.9 and own[book.count :].mean() < 0.01
