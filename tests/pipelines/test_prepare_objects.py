"""Several objects of one scene: each is cut out of the scene that remains after the previous ones, and shared Gaussians
are refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.inpaint import InpaintResult
from egs_warp.notes import Detail, Problem
from egs_warp.pipelines.locate_plane import LocatedPlane
from egs_warp.pipelines.prepare_objects import PreparedObjects, prepare_objects
from egs_warp.pipelines.prepare_scene import PreparedScene
from egs_warp.segmentation.clicks import Click
from egs_warp.segmentation.object_spec import ObjectSpec, Segmentation

COUNT = 40
FIRST, SECOND = np.arange(0, 10), np.arange(10, 20)
"""Gaussians of two objects, of which the first one stands on the second one."""


def row(count: int, z: float) -> GaussianCloud:
    """Return Gaussians along the x axis."""
    points = np.column_stack([np.arange(count, dtype=float), np.zeros(count), np.full(count, z)])
    quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return GaussianCloud.from_numpy(
        points, quaternions, np.full((count, 3), -2.0), np.full(count, 2.0), np.zeros((count, 1, 3)), device="cpu"
    )


def mask_of(indices: np.ndarray, count: int = COUNT) -> np.ndarray:
    mask = np.zeros(count, bool)
    mask[indices] = True
    return mask


class FakePreparer:
    """Preparer that cuts out the picked Gaussians, removes one more, and adds three Gaussians of inpainted floor."""

    def __init__(self, tilt: float = 0.0) -> None:
        self.specs: list[ObjectSpec] = []
        self.clouds: list[GaussianCloud] = []
        self.tilt = tilt

    def __call__(self, cloud: GaussianCloud, spec: ObjectSpec, *, up: object, plane: Plane | None) -> PreparedScene:
        assert spec.picked is not None
        angle = np.radians(self.tilt * len(self.specs))
        plane = plane or Plane(np.array([np.sin(angle), 0.0, np.cos(angle)]), -0.01 * len(self.specs))
        self.specs.append(spec)
        self.clouds.append(cloud)
        none = np.zeros(cloud.count, bool)
        segmentation = Segmentation(spec.picked, none, none, 1.0)
        with_hole = cloud.subset(~spec.picked)
        retained = np.arange(with_hole.count) != with_hole.count - 1
        new = row(3, 0.5)
        filled_cloud = concatenate(with_hole.subset(retained), new)
        is_new, absent = np.arange(filled_cloud.count) >= filled_cloud.count - 3, cast(Any, None)
        filled = InpaintResult(filled_cloud, is_new, retained, absent, absent, absent, absent, {}, ())
        located = LocatedPlane(plane, None, np.zeros(3), 1.0, segmentation, ())
        parts = cloud.subset(spec.picked), filled_cloud, with_hole
        return PreparedScene(*parts, plane, None, located, (Problem("done"), Detail("1 mm")), filled=filled)


def prepared(first: ObjectSpec, second: ObjectSpec, fake: FakePreparer | None = None) -> PreparedObjects:
    return prepare_objects(row(COUNT, 0.0), {"first": first, "second": second}, prepare=fake or FakePreparer())


def test_the_second_object_is_found_in_what_the_first_one_leaves() -> None:
    """The picked Gaussians and the clicks refer to the remaining scene, in which Gaussians 10 to 19 are the first ten
    and the inpainted ones are at x = 0, 1 and 2. Inpainted floor next to the second object belongs to it."""
    fake = FakePreparer()
    click = Click(np.zeros(3), np.array([5, 12, 19]), inside=False)
    second = ObjectSpec(picked=mask_of(np.arange(10, 22)), clicks=(click,))
    result = prepared(ObjectSpec(picked=mask_of(FIRST)), second, fake)
    assert [cloud.count for cloud in fake.clouds] == [COUNT, COUNT - 10 - 1 + 3]
    spec = fake.specs[1]
    assert spec.picked is not None
    assert np.flatnonzero(spec.picked).tolist() == [*range(12), 29, 30, 31]
    assert spec.clicks[0].hits.tolist() == [2, 9]
    assert result.background is result.scenes["second"].background
    assert result.notes == ("first: done", "first: 1 mm", "second: done", "second: 1 mm")
    assert [type(note) for note in result.notes] == 2 * [Problem, Detail]


def test_an_object_that_belongs_to_an_earlier_one_is_refused() -> None:
    with pytest.raises(
        UserError, match=r"^second: 80 % of its selected Gaussians belong to first, which is cut out before it;"
    ):
        prepared(ObjectSpec(picked=mask_of(FIRST)), ObjectSpec(picked=mask_of(np.arange(2, 12))))
    result = prepared(ObjectSpec(picked=mask_of(FIRST)), ObjectSpec(picked=mask_of(np.arange(8, 18))))
    assert result.notes[2] == "second: 20 % of its selected Gaussians belong to first, which keeps them"


def test_objects_on_the_same_ground_have_one_plane_and_others_parallel_ones() -> None:
    specs = ObjectSpec(picked=mask_of(FIRST)), ObjectSpec(picked=mask_of(SECOND))
    same = prepared(*specs, FakePreparer(tilt=1.0))
    assert same.planes["first"] is same.planes["second"]
    tilted = prepared(*specs, FakePreparer(tilt=10.0)).planes
    assert tilted["first"] is not tilted["second"]
    np.testing.assert_array_equal(tilted["first"].normal, tilted["second"].normal)


def test_an_error_begins_with_the_name_of_the_object() -> None:
    class Failing(FakePreparer):
        def __call__(self, cloud: GaussianCloud, spec: ObjectSpec, *, up: object, plane: Plane | None) -> PreparedScene:
            if self.specs:
                raise UserError("object: nothing is there; click on it")
            return super().__call__(cloud, spec, up=up, plane=plane)

    second = replace(ObjectSpec(picked=mask_of(SECOND)))
    planes = {"second": Plane(np.array([0.0, 0.0, 1.0]), 0.0)}
    with pytest.raises(UserError, match=r"^second: object: nothing is there"):
        prepare_objects(
            row(COUNT, 0.0),
            {"first": ObjectSpec(picked=mask_of(FIRST)), "second": second},
            planes=planes,
            prepare=Failing(),
        )
