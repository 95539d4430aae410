"""Figure 7: an object segmented from a real scene, by four methods side by side.

``hard assignment`` is the method of Gaussian Grouping: each Gaussian belongs to the group that most of its pixels show.
It belongs to the object if more than half of its blending weight lies in the object's masks of 18 views; the plane is
not used. The other methods are those of Table 3: Gaussians that straddle the plane are removed (``remove``), cut at the
plane (``static split``), or trained until they are clear of it (``L_seg``).

The measure is the same as in Table 3, with cameras in the plane: the residual is the sum of the pixels below the plane
divided by the sum above it; PSNR and SSIM compare the upper half with the hard assignment, which contains everything
that the masks show. Aim: ``figure7_best``: in every scene L_seg has a residual of at most 0.002, as in the paper, and
no other method with a residual of at most 0.002 has a higher PSNR of the upper half. ``whole dB``, which has no aim,
combines both: it is the PSNR of the whole image, whose target is the hard assignment's upper half above an empty lower
half.

The image (``--plot``) has one row for each scene, seen from just above the plane at the object's foot: the whole
scene, then the four methods.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

import table3
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.video import contact_sheet
from egs_warp.render import render_gaussians
from egs_warp.segmentation.clearance import StraddlingOptions, StraddlingPolicy, clear_plane
from harness import Row, Table, data_folder, flags, report, timed

SCENES = ("koala.ply", "narcissus.sog", "fox.ply")
HARD, OURS = "hard assignment", "L_seg"
CLEARINGS = {"remove": StraddlingPolicy.REMOVE, "static split": StraddlingPolicy.SPLIT, OURS: StraddlingPolicy.FINETUNE}
MAX_RESIDUAL = 0.002
VIEW_ELEVATION = 8.0
"""Elevation of the camera above the plane, degrees."""


def rows_of(name: str, device: str, side: int, seed: int, table: Table) -> tuple[list[Row], np.ndarray]:
    """Return one row for each method, and one image that shows all methods."""
    parts = table3.segment_parts(name, device)
    cameras = table3.cameras_in(parts.located.plane, parts.located, side)
    clouds = {HARD: (parts.hard, 0.0)}
    for method, clearing in CLEARINGS.items():
        cloud, milliseconds = timed(
            clear_plane, parts.above, parts.located.plane, clearing, options=StraddlingOptions(seed=seed)
        )
        clouds[method] = (cloud, 1e-3 * milliseconds)
    targets = [table3.picture(parts.hard, camera)[: side // 2] for camera in cameras]
    rows = []
    for method, (cloud, seconds) in clouds.items():
        scores = table3.scores(
            [table3.picture(cloud, camera) for camera in cameras], None if method == HARD else targets
        )
        rows.append({"scene": name, "method": method, "gaussians": cloud.count, "seconds": seconds, **scores})
        figures = (scores[key] for key in ("psnr", "ssim", "flip", "residual", "whole_psnr"))
        table.row(name, method, *figures, cloud.count, seconds)
    return rows, close_by(parts, {method: cloud for method, (cloud, _) in clouds.items()})


def close_by(parts: table3.Parts, clouds: Mapping[str, GaussianCloud], size: int = 400) -> np.ndarray:
    """Render the object's foot from slightly above the plane: in its scene, and segmented by each method, on white."""
    plane, located = parts.located.plane, parts.located
    first, second = plane.tangents()
    foot = located.centre - plane.heights(located.centre) * plane.normal
    down = np.radians(VIEW_ELEVATION)
    level = np.cos(0.4) * first + np.sin(0.4) * second
    away = np.cos(down) * level + np.sin(down) * plane.normal
    target = foot + 0.12 * located.size * plane.normal
    camera = Camera.look_at(
        target + 2.0 * located.size * away, target, plane.normal, width=size, height=size, vertical_fov_degrees=26.0
    )
    shown = {"the scene": parts.whole, **clouds}
    tiles = [render_gaussians(cloud, camera, background=(1.0, 1.0, 1.0)).colour_srgb8() for cloud in shown.values()]
    return contact_sheet(tiles, len(tiles), list(shown))


def judge(rows: Sequence[Row], missing: Sequence[str]) -> tuple[dict[str, bool | None], dict[str, str]]:
    """Return the aim, computed from the rows, and the reason if it is None."""
    if missing:
        return {"figure7_best": None}, {"figure7_best": f"without {', '.join(missing)}; set EGS_WARP_DATA"}
    passed = []
    for name in {row["scene"] for row in rows}:
        clean = {r["method"]: r for r in rows if r["scene"] == name and r["residual"] <= MAX_RESIDUAL}
        # The hard assignment is the target of the PSNR, so its own PSNR is infinite. It must therefore be excluded by
        # its residual.
        passed.append(
            OURS in clean and HARD not in clean and all(clean[OURS]["psnr"] >= row["psnr"] for row in clean.values())
        )
    return {"figure7_best": all(passed)}, {}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    options = flags(__doc__, quick="pictures half as large", device="cpu").parse_args(arguments)
    side = 400 if options.quick else 800
    rows: list[Row] = []
    pictures = []
    missing = [name for name in SCENES if not (data_folder() / "scenes" / name).exists()]
    table = Table(
        scene="<14",
        method="<16",
        PSNR=".2f",
        SSIM=".4f",
        FLIP=".4f",
        residual=".5f",
        whole_dB=".2f",
        Gaussians="8d",
        seconds="6.1f",
    )
    for name in SCENES:
        if name in missing:
            print(f"{name}: its capture is not on this machine; set EGS_WARP_DATA to the folder of captures")
            continue
        more, picture = rows_of(name, options.device, side, options.seed, table)
        rows += more
        pictures.append(picture)
    aims, why_null = judge(rows, missing)
    report(
        options,
        rows,
        aims=aims,
        why_null=why_null,
        packages=["torch"],
        conditions={"side": side},
        picture=np.concatenate(pictures) if pictures else None,
    )


if __name__ == "__main__":
    main()
