"""Table 3 and Figure 9 of the paper: an object cut at its plane, viewed from within the plane.

Scenes are segmented as by ``egs-warp segment``, from masks in 18 views: masks of the true object in the built-in
scenes, and of the object that a click selects in real captures. ``mask only`` contains everything that the masks claim,
without regard to the plane. Four cameras of 800 x 800 pixels lie in the plane, so that its horizon is the middle row.
PSNR and SSIM compare the upper halves with the upper halves of ``mask only``, on black. The residual is the sum of the
pixels in the lower half divided by their sum in the upper half.

Aims: ``residual`` (L_seg: at most 0.002 in every scene), ``psnr`` (L_seg: at least 35.3 dB in every scene). ``L_seg, no
subdivision`` is the paper's own method; our method splits large straddling Gaussians before training, and cuts the
remaining straddling ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from egs_warp.assets import scene
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.io import read_capture
from egs_warp.pipelines.locate_plane import LocatedPlane, locate_plane
from egs_warp.render import render_gaussians
from egs_warp.segmentation.clearance import StraddlingOptions, StraddlingPolicy, clear_plane
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.selection_masks import masks_from_selection
from egs_warp.segmentation.votes import blending_votes
from egs_warp.training.metrics import psnr, ssim
from harness import Row, Table, data_folder, flags, report, timed
from perceptual import flip_error, lpips_distance

BUILT_IN = ("pawn", "stool", "figurine")
CAPTURES = ("koala.ply", "narcissus.sog")
CLICKS = {"koala.ply": (0.1, -0.7, 0.15), "narcissus.sog": (0.0, -0.8, 0.0), "fox.ply": (0.0, 0.0, 0.7)}
"""A click on the object of each capture."""
METHODS: dict[str, tuple[StraddlingPolicy, StraddlingOptions | None]] = {
    "mask only": (StraddlingPolicy.NONE, None),
    "remove": (StraddlingPolicy.REMOVE, None),
    "L_seg": (StraddlingPolicy.FINETUNE, None),
    "L_seg, no subdivision": (StraddlingPolicy.FINETUNE, StraddlingOptions(subdivisions=0, cut_rest=False)),
    "static split": (StraddlingPolicy.SPLIT, None),
}
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Parts:
    """Parts of a segmented scene."""

    whole: GaussianCloud
    hard: GaussianCloud
    """Gaussians with more than half of their blending weight in the masks, without regard to the plane."""
    claimed: GaussianCloud
    """``hard`` without detached parts: the object, including what lies below the plane."""
    above: GaussianCloud
    """The object above the plane."""
    located: LocatedPlane


def segment_parts(name: str, device: str) -> Parts:
    """Segment the scene from masks in 18 views: masks of the true object in built-in scenes, of a click's object in
    captures."""
    if name in BUILT_IN:
        built = scene(name, device=device)
        cloud, chosen = built.whole()
        plane, size = built.plane, 1.5
        centre = np.array([0.0, 0.0, 0.5])
    else:
        cloud = read_capture(data_folder() / "scenes" / name, device=device).cloud
        clicked = locate_plane(cloud, ObjectSpec(point=np.array(CLICKS[name])))
        chosen, plane, centre, size = clicked.segmentation.object_mask, clicked.plane, clicked.centre, clicked.size
    masks = masks_from_selection(cloud, chosen, ring_cameras(plane, centre, 0.6 * size, size=256))
    located = locate_plane(cloud, ObjectSpec(masks=tuple(masks)), up=plane.normal)
    segmentation = located.segmentation
    hard = blending_votes(cloud, [view for view in masks if view.mask.any()]).share_inside() > 0.5
    claimed = (segmentation.object_mask | segmentation.buried_mask) & hard
    return Parts(cloud, cloud.subset(hard), cloud.subset(claimed), cloud.subset(segmentation.object_mask), located)


def cameras_in(plane: Plane, located: LocatedPlane, side: int) -> list[Camera]:
    """Return four cameras that look along the plane, with their centres in it."""
    tall = 2.0 * float(plane.heights(located.centre))
    middle = located.centre - plane.heights(located.centre) * plane.normal
    return ring_cameras(plane, middle, tall, count=4, elevations=(0.0,), size=side, margin=1.15)


def picture(cloud: GaussianCloud, camera: Camera) -> np.ndarray:
    """Return the render (H, W, 3) float32 of ``cloud`` on black, with values from 0 to 1."""
    return np.clip(render_gaussians(cloud, camera, background=BLACK).colour.numpy(), 0.0, 1.0)


def scores(pictures: Sequence[np.ndarray], targets: Sequence[np.ndarray] | None) -> dict[str, float | None]:
    """Return the scores of images against the upper halves ``targets``.

    ``targets`` is None for the images that define the targets. ``whole_psnr`` compares the whole image with the upper
    half of the target above an empty lower half, so it combines residual and similarity.
    """
    half = len(pictures[0]) // 2
    residual = float(np.mean([one[half:].sum() / one[:half].sum() for one in pictures]))
    if targets is None:
        below = float(np.mean([-10.0 * np.log10(max((one[half:] ** 2).sum() / one.size, 1e-10)) for one in pictures]))
        return {"psnr": None, "ssim": None, "flip": None, "lpips": None, "residual": residual, "whole_psnr": below}
    pairs = [(one[:half], other) for one, other in zip(pictures, targets, strict=True)]
    distance, _ = lpips_distance()
    tensors = [tuple(torch.tensor(one) for one in pair) for pair in pairs]
    return {
        "psnr": float(np.mean([psnr(*pair) for pair in pairs])),
        "ssim": float(np.mean([float(ssim(*pair)) for pair in tensors])),
        "flip": float(np.mean([flip_error(*pair) for pair in tensors])),
        "lpips": float(np.mean([distance(*pair) for pair in pairs])) if distance else None,
        "residual": residual,
        "whole_psnr": float(
            np.mean([psnr(a, np.concatenate([b, np.zeros_like(b)])) for a, b in zip(pictures, targets, strict=True)])
        ),
    }


def rows_of(name: str, device: str, side: int, seed: int, table: Table) -> tuple[list[Row], np.ndarray]:
    """Return one row for each method, and their images from one camera side by side."""
    parts = segment_parts(name, device)
    plane = parts.located.plane
    cameras = cameras_in(plane, parts.located, side)
    half = side // 2
    targets = [picture(parts.claimed, camera)[:half] for camera in cameras]
    rows, shown = [], []
    for method, (clearing, chosen) in METHODS.items():
        options = StraddlingOptions(seed=seed) if chosen is None else chosen
        cloud, milliseconds = parts.claimed, 0.0
        if clearing is not StraddlingPolicy.NONE:
            cloud, milliseconds = timed(clear_plane, parts.above, plane, clearing, options=options)
        pictures = [picture(cloud, camera) for camera in cameras]
        row = {
            "scene": name,
            "method": method,
            "gaussians": cloud.count,
            "seconds": 1e-3 * milliseconds,
            **scores(pictures, None if clearing is StraddlingPolicy.NONE else targets),
        }
        rows.append(row)
        table.row(name, method, row["psnr"], row["ssim"], row["flip"], row["residual"], row["seconds"])
        shown.append(pictures[1][int(0.55 * half) : int(1.3 * half), side // 5 : side - side // 5])
    return rows, np.concatenate(shown, axis=1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    options = flags(
        __doc__,
        quick="the pawn, the stool and the koala only",
        device="cpu",
        plot="file for figure 9: one row for each scene, columns in the table's order",
    ).parse_args(arguments)
    names = ["pawn", "stool", "koala.ply"] if options.quick else [*BUILT_IN, *CAPTURES]
    _, no_lpips = lpips_distance()
    why_null = {"lpips": no_lpips} if no_lpips else {}
    rows: list[Row] = []
    figure: list[np.ndarray] = []
    table = Table(scene="<14", method="<22", PSNR=".3f", SSIM=".4f", FLIP=".4f", residual=".5f", seconds="6.1f")
    for name in names:
        if name in CAPTURES and not (data_folder() / "scenes" / name).exists():
            print(f"{name}: its capture is not on this machine; set EGS_WARP_DATA to the folder of captures")
            continue
        more, shown = rows_of(name, options.device, 800, options.seed, table)
        rows += more
        figure.append(shown)
    ours = [row for row in rows if row["method"] == "L_seg"]
    report(
        options,
        rows,
        aims={
            "residual": all(row["residual"] <= 0.002 for row in ours),
            "psnr": all(row["psnr"] >= 35.3 for row in ours),
        },
        why_null=why_null,
        packages=["torch"],
        picture=np.concatenate(figure),
    )


if __name__ == "__main__":
    main()
