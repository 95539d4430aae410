"""Plane under the object and further planes: level patches, each drawn in its own colour."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from egs_warp.assets import scene
from egs_warp.commands.scene_input import SceneInput, read_scene
from egs_warp.commands.scene_planes import planes_of_scene
from egs_warp.geometry.gaussians import GaussianCloud, concatenate
from egs_warp.pipelines.pictures import picture_cameras, plane_picture
from egs_warp.segmentation.object_spec import ObjectSpec
from tests.support.ply_variants import columns_of, ply_of
from tests.support.scenes import FLOOR, ball_on_floor


def test_further_planes_are_level_patches_in_their_own_colours() -> None:
    """Apart from the floor, only the board and the cushion of the stool are level planes of the bedroom; horizontal
    slices of walls and legs are not reported."""
    made = scene("stool")
    cloud = concatenate(made.background, made.object)
    given = SceneInput(cloud, [], ObjectSpec(point=np.array([0.0, 0.0, 0.68])), None, made.plane, ())
    found = planes_of_scene(given, plane_mask=None, view=None, count=5)
    assert [-one.offset for one in found.planes] == pytest.approx([0.0, 0.52, 0.68], abs=0.01)
    assert all(one.normal[2] > np.cos(np.radians(1.0)) for one in found.planes)
    assert found.notes[-1] == "found 3 of 5 planes"
    cameras = picture_cameras(made.plane, found.centre, found.size)[1:2]
    picture = plane_picture(cloud, found.planes[:2], cameras, centre=found.centre, size=found.size).astype(float)
    red, green, _ = np.moveaxis(picture, -1, 0)
    assert (red - green > 90).mean() > 0.01
    assert (green - red > 60).mean() > 0.002


@pytest.mark.parametrize(
    ("comments", "note"),
    [
        (["Exported from Brush", "Vertical axis: z"], "up is estimated as +z (the file names the axis z"),
        (["Vertical axis: z"], "plane "),
    ],
)
def test_up_of_the_file_is_used(comments: list[str], note: str, tmp_path: Path) -> None:
    cloud, _ = ball_on_floor()
    (tmp_path / "a.ply").write_bytes(ply_of(columns_of(cloud), comments=comments))
    flags = dict.fromkeys(("up", "plane", "cameras", "mask_model", "view"))
    flags |= {"device": "cpu", "capture": str(tmp_path / "a.ply"), "object": ["0,-0.5,0.5"]}
    found = planes_of_scene(read_scene(argparse.Namespace(**flags)), plane_mask=None, view=None, count=1)
    assert found.notes[0].startswith(note)
    assert found.planes[0].normal[2] > np.cos(np.radians(0.3))


def test_a_capture_with_nothing_flat_has_one_plane() -> None:
    """For isotropic Gaussians on a grid, no plane is found besides the given one."""
    x, y = (values.ravel() for values in np.meshgrid(np.linspace(-1.0, 1.0, 40), np.linspace(-1.0, 1.0, 40)))
    means = np.stack([x, y, np.zeros_like(x)], axis=1)
    box = (np.abs(x) < 0.2) & (np.abs(y) < 0.2)
    means = np.concatenate([means, *(means[box] + [0.0, 0.0, height] for height in np.linspace(0.03, 0.6, 12))])
    count = len(means)
    cloud = GaussianCloud.from_numpy(
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), -3.5),
        np.full(count, 4.0),
        np.zeros((count, 1, 3)),
    )
    given = SceneInput(cloud, [], ObjectSpec(point=np.array([0.0, 0.0, 0.3])), None, FLOOR, ())
    found = planes_of_scene(given, plane_mask=None, view=None, count=2)
    assert len(found.planes) == 1 and found.notes[-1] == "found 1 of 2 planes"
