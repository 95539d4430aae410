"""Figure 7: an object taken out of a real scene, in four ways side by side.

``hard assignment`` is what Gaussian Grouping does: each Gaussian belongs to the group that most of its pixels show, to
the object if more than half of its blending weight lies in the object's masks of 18 views; the plane has no say. The
others are Table 3's: what straddles the plane is left out (``remove``), cut at the plane (``static split``), or trained
until it is clear of it (``L_seg``).

The measure is Table 3's: cameras in the plane; the residual is the sum of the pixels below the plane over that above
it, PSNR and SSIM of the upper half are those against the hard assignment, which has all that the masks show. Aim:
``figure7_best``: in every scene L_seg leaves at most 0.002 below the plane, the paper's figure, and of all ways that
leave so little none keeps more of the upper half (PSNR). ``whole dB``, which no aim judges, has both in one: PSNR
of the whole picture against that upper half over nothing.

The picture (``--plot``): a row a scene, from just above the plane, the foot of the object close by; the whole scene,
then the four ways.
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
MOST_RESIDUAL = 0.002
LOOK_DOWN = 8.0
"""Degrees."""


def rows_of(name: str, device: str, side: int, seed: int, table: Table) -> tuple[list[Row], np.ndarray]:
    """One row a way, and their pictures."""
    parts = table3.taken_apart(name, device)
    cameras = table3.cameras_in(parts.located.plane, parts.located, side)
    clouds = {HARD: (parts.hard, 0.0)}
    for way, clearing in CLEARINGS.items():
        cloud, milliseconds = timed(
            clear_plane, parts.above, parts.located.plane, clearing, options=StraddlingOptions(seed=seed)
        )
        clouds[way] = (cloud, 1e-3 * milliseconds)
    wanted = [table3.picture(parts.hard, camera)[: side // 2] for camera in cameras]
    rows = []
    for way, (cloud, seconds) in clouds.items():
        scores = table3.scores([table3.picture(cloud, camera) for camera in cameras], None if way == HARD else wanted)
        rows.append({"scene": name, "method": way, "gaussians": cloud.count, "seconds": seconds, **scores})
        figures = (scores[key] for key in ("psnr", "ssim", "flip", "residual", "whole_psnr"))
        table.row(name, way, *figures, cloud.count, seconds)
    return rows, close_by(parts, {way: cloud for way, (cloud, _) in clouds.items()})


def close_by(parts: table3.Parts, clouds: Mapping[str, GaussianCloud], size: int = 400) -> np.ndarray:
    """The foot of the object from a little above the plane: in its scene, and taken out in each way, on white."""
    plane, located = parts.located.plane, parts.located
    first, second = plane.tangents()
    foot = located.centre - plane.heights(located.centre) * plane.normal
    down = np.radians(LOOK_DOWN)
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
    """The aim, from the rows."""
    if missing:
        return {"figure7_best": None}, {"figure7_best": f"without {', '.join(missing)}; set EGS_WARP_DATA"}
    verdicts = []
    for name in {row["scene"] for row in rows}:
        clean = {r["method"]: r for r in rows if r["scene"] == name and r["residual"] <= MOST_RESIDUAL}
        # Nothing is taken for the upper half but the hard assignment, whose own PSNR is without bound.
        verdicts.append(
            OURS in clean and HARD not in clean and all(clean[OURS]["psnr"] >= row["psnr"] for row in clean.values())
        )
    return {"figure7_best": all(verdicts)}, {}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print, write."""
    options = flags(__doc__, quick="pictures half as large", device="cpu").parse_args(arguments)
    side = 400 if options.quick else 800
    rows: list[Row] = []
    pictures = []
    missing = [name for name in SCENES if not (data_folder() / "scenes" / name).exists()]
    table = Table(
        scene="<14",
        way="<16",
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
            print(f"{name}: not here; set EGS_WARP_DATA")
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
