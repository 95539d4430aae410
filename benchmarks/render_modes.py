"""Further modes of the renderer, each compared with gsplat's result for the same Gaussians."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
import warp as wp

import render_peers as peers
from egs_warp.render import render_gaussians, render_views
from harness import Row, median_ms

_WIDTH, _HEIGHT = 648, 420
_OPACITY_FACTOR = 0.35
"""Factor on the opacities that keeps all alphas below 0.99, where the renderers' limits differ."""
_BACKGROUNDS = ((0.9, 0.2, 0.1), (0.1, 0.8, 0.3), (0.2, 0.3, 1.0))
_MIN_ALPHA = 0.01
"""Minimum alpha of the pixels whose mean depths are compared."""


def difference(ours: torch.Tensor, other: torch.Tensor) -> dict[str, float]:
    """Return the mean and largest absolute difference, and the fraction of values above 1e-3 (splats at their alpha
    cut)."""
    off = (ours - other).abs()
    return {"mean": float(off.mean()), "largest": float(off.max()), "above_1e-3": float((off > 1e-3).float().mean())}


def mode_row(points: dict[str, np.ndarray], *, seed: int, repeats: int) -> Row:
    """Compare antialiased images, mean depth, masked tiles and three cameras with backgrounds; time the three
    cameras."""
    from gsplat import rasterize_to_pixels  # type: ignore[import-not-found]
    from gsplat.rendering import rasterization  # type: ignore[import-not-found]

    plain = peers.garden_scene(points, grid=1, seed=seed, device="cuda")
    scene = replace(plain, opacities=plain.opacities.detach() * _OPACITY_FACTOR)
    cloud = peers.cloud_of(peers.ours_scene(scene))
    cameras = [peers.garden_camera(points, width=_WIDTH, height=_HEIGHT, number=number) for number in range(3)]
    matrices = [peers.gsplat_matrices(camera) for camera in cameras]
    poses, intrinsics = (torch.cat(parts) for parts in zip(*matrices, strict=True))
    colours = torch.tensor(_BACKGROUNDS, device="cuda")
    values = (scene.means, scene.rotations, scene.scales, scene.opacities, scene.colours)

    def theirs(which: slice, **options: Any) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.no_grad():
            picture, alpha, _ = rasterization(*values, poses[which], intrinsics[which], _WIDTH, _HEIGHT, **options)
        return picture, alpha

    def their_masked(mask: np.ndarray) -> torch.Tensor:
        """Render with masked tiles, which gsplat supports only in its low-level functions."""
        with torch.no_grad():
            projection = rasterization(*values, poses[:1], intrinsics[:1], _WIDTH, _HEIGHT, packed=False)[2]
            picture, _ = rasterize_to_pixels(
                *(
                    projection["means2d"],
                    projection["conics"],
                    scene.colours[None].contiguous(),
                    projection["opacities"],
                ),
                *(_WIDTH, _HEIGHT, projection["tile_size"], projection["isect_offsets"], projection["flatten_ids"]),
                backgrounds=colours[:1],
                masks=torch.as_tensor(mask, device="cuda")[None],
            )
        return picture[0]

    one, every = slice(0, 1), slice(0, 3)
    sharp = wp.to_torch(render_gaussians(cloud, cameras[0], background=(0, 0, 0), antialiased=True).colour)
    depth = wp.to_torch(render_gaussians(cloud, cameras[0]).depth)
    their_depth, alpha = theirs(one, render_mode="ED")
    mask = np.random.default_rng(seed).random((-(-_HEIGHT // 16), -(-_WIDTH // 16))) < 0.5
    masked = wp.to_torch(render_gaussians(cloud, cameras[0], background=_BACKGROUNDS[0], mask=mask).colour)
    covered = alpha[0, :, :, 0] > _MIN_ALPHA
    unit = float(depth[covered].mean())
    # With packed=True, gsplat takes at most one background.
    their_three = theirs(every, backgrounds=colours, packed=False)[0]

    def ours_of_three() -> list[torch.Tensor]:
        return [wp.to_torch(image.colour) for image in render_views(cloud, cameras, backgrounds=_BACKGROUNDS)]

    return {
        "kind": "modes",
        "gaussians": cloud.count,
        "width": _WIDTH,
        "height": _HEIGHT,
        "difference": {
            "antialiased": difference(sharp, theirs(one, rasterize_mode="antialiased")[0][0]),
            "depth": difference(depth[covered] / unit, their_depth[0, :, :, 0][covered] / unit),
            "mask": difference(masked, their_masked(mask)),
            "three cameras": difference(torch.stack(ours_of_three()), their_three),
        },
        "three_cameras": median_ms(
            {
                "ours": ours_of_three,
                "gsplat_unpacked": lambda: theirs(every, backgrounds=colours, packed=False),
            },
            repeats=repeats,
            synchronise=torch.cuda.synchronize,
        ),
    }
