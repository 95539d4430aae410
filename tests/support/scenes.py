"""Scene of a ball on a floor, and parts of such scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp
from PIL import Image

from egs_warp.assets import pawn
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud, concatenate, with_degree
from egs_warp.geometry.plane import Plane
from egs_warp.io import write_ply
from egs_warp.io.cameras import write_cameras
from egs_warp.segmentation.selection_masks import masks_from_selection
from tests.support.grounds import sheet

FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


def ball_on_floor(lift: float = 0.0) -> tuple[GaussianCloud, np.ndarray]:
    """Return a ball on a floor, and (n,) bool, True for the Gaussians of the ball.

    The ball is hollow with loose Gaussians inside, the floor is square, and there is a floater above.
    """
    random = np.random.default_rng(1)
    shell = random.normal(size=(1500, 3))
    shell = 0.5 * shell / np.linalg.norm(shell, axis=1, keepdims=True) + [0.0, 0.0, 0.5 + lift]
    inner = random.normal(scale=0.05, size=(20, 3)) + [0.0, 0.0, 0.5 + lift]
    grid = np.stack(np.meshgrid(*[np.linspace(-1.5, 1.5, 60)] * 2), axis=-1).reshape(-1, 2)
    floor = np.column_stack([grid, random.normal(0.0, 0.002, len(grid))])
    floater = np.array([[0.55, 0.0, 1.0]])
    means = np.concatenate([shell, inner, floater, floor])
    scales = np.full((len(means), 3), np.log(0.025))
    scales[len(shell) + len(inner) + 1 :, 2] = np.log(0.004)
    cloud = GaussianCloud.from_numpy(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1)),
        scales,
        np.full(len(means), 3.0),
        random.uniform(-1.0, 1.0, (len(means), 1, 3)),
    )
    return cloud, np.arange(len(means)) < len(shell) + len(inner)


def write_scene(folder: Path, *, views: int, size: int) -> np.ndarray:
    """Write a scene with cameras and a mask; return the mask (size, size).

    The files are ``ball_on_floor`` as scene.ply, ``views`` cameras of ``size`` pixels around it as cameras.json, and
    the mask of the second camera as photo1.png.
    """
    cloud, truth = ball_on_floor()
    write_ply(folder / "scene.ply", cloud)
    cameras = ring_cameras(FLOOR, np.array([0.0, 0.0, 0.5]), 0.9, count=views, size=size)
    write_cameras(folder / "cameras.json", cameras, [f"photo{k}.png" for k in range(views)])
    mask = masks_from_selection(cloud, truth, cameras[1:2])[0].mask
    Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "photo1.png")
    return mask


def round_ones(means: np.ndarray, radius: float, bands: int = 1) -> GaussianCloud:
    """Return isotropic opaque Gaussians at ``means`` (n, 3)."""
    return GaussianCloud.from_numpy(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1)),
        np.full((len(means), 3), np.log(radius)),
        np.full(len(means), 3.0),
        np.zeros((len(means), bands, 3)),
    )


def lying(means: np.ndarray) -> GaussianCloud:
    """Return flat, horizontal, opaque Gaussians at ``means`` (n, 3), as on a floor."""
    return sheet(means, np.tile(FLOOR.normal, (len(means), 1)), 0.03, (0.5, 0.5, 0.5))


def shell(count: int = 1500) -> np.ndarray:
    """Return points (n, 3) of a Fibonacci lattice on a sphere of diameter 1 that touches the floor at the origin."""
    z = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    around = np.sqrt(1.0 - z**2)
    return 0.5 * np.column_stack([around * np.cos(angle), around * np.sin(angle), z]) + [0.0, 0.0, 0.5]


def blocks(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> GaussianCloud:
    """Return opaque round Gaussians 0.04 apart on the faces of boxes, given by their corners."""
    points = []
    for low, high in boxes:
        axes = [np.arange(a, b + 0.02, 0.04) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        ends = np.array([[axis[0] for axis in axes], [axis[-1] for axis in axes]])
        points.append(grid[(grid == ends[0]).any(axis=1) | (grid == ends[1]).any(axis=1)])
    means = np.concatenate(points)
    count = len(means)
    quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    scales = np.full((count, 3), np.log(0.02))
    return GaussianCloud.from_numpy(
        means, quaternions, scales, np.full(count, 4.0), np.zeros((count, 1, 3)), device="cpu"
    )


def two_pawns_on_a_board() -> GaussianCloud:
    """Return two pawns 1.5 apart along x on a board of 4.5 x 3, with a block beside them."""
    thing = pawn(gaussian_count=3000, device="cpu").cloud
    shifted = replace(thing, means=wp.array(thing.means.numpy() + np.array([1.5, 0.0, 0.0], np.float32), dtype=wp.vec3))
    board = blocks(((-1.5, -1.5, -0.04), (3.0, 1.5, 0.0)), ((0.6, 0.9, 0.0), (1.0, 1.3, 0.5)))
    return concatenate(*(with_degree(each, 0) for each in (thing, shifted, board)))
