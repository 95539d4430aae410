"""Quality and time from clicks or masks to an object, and from photos to a film, in real scenes.

Five scenes have objects and ground annotated by hand in eight views each (``annotated_scenes.py``). For ``masks``, the
outlines of every other view are given. For ``clicks``, the first click is on the innermost point of the object in the
first view. Two more clicks correct the render of the object alone in the third and in the fifth view, each at the
innermost point of the largest missing or superfluous region; regions thinner than 2 % of the image are ignored. Both
are evaluated in the other views by the overlap (IoU) of the outlines with the pixels in which the object alone, cut at
its plane, has an opacity above 0.5; pixels where the whole capture has a lower opacity are holes and are ignored.
The capture of the bonsai is trained first, unless it is read from ``--trained`` or from the films.

With ``--films FOLDER``, films of bonsai, mouse and plush dog from photos, and of koala, fox, narcissus and playbot from
a capture (``room_films.py``), are made first, ``--processes`` of them at a time; each stage is timed. For the ground,
the planes of three built-in scenes are compared with the truth. The planes of the real scenes are compared with two
markings, one in the even and one in the odd views, by the angle between normals and the distance at the object's foot
(``room_ground.py``).

Aims: ``iou_masks`` (mean of each scene 0.95, of the bonsai 0.90), ``iou_click`` (0.88 with three clicks and no model;
one click with a mask model is not measured, because no model that takes clicks is available without external data),
``ground`` (built-in scenes: 1 degree and 0.5 % of the object's height; real ones: twice the difference between the
markings), ``films`` (each requested film exists and its motion is complete), ``psnr_vs_gsplat`` (held-out PSNR at least
gsplat's on bonsai, mouse and plush dog, with the same colour fit for both; needs a GPU with gsplat, and ``--peers``).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from annotated_scenes import NAMES, DrawnScene, read_drawn
from clicking import CLICKED, JUDGED, clicked, found_by, overlap, picture
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.inpainting.holes import hole_under
from egs_warp.inpainting.inpaint import InpaintOptions, inpaint
from egs_warp.io import read_cameras, read_capture
from egs_warp.pipelines.train_capture import train
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.votes import MaskedView
from harness import Row, Table, data_folder, flags, report, timed
from room_films import CLICKS, FILMS, film, is_here
from room_ground import judged_ground, known_ground, real_ground
from train_peers import has_gsplat

IOU_MASKS, IOU_FOLIAGE, IOU_CLICKS = 0.95, 0.90, 0.88
TRAINING_CASES = ("bonsai", "mouse", "plush_dog")


def film_rows(options: argparse.Namespace) -> list[Row]:
    """Return one row per film, each made by its own process; the row of a failed film has ``messages`` in place of
    results."""
    threads = str(max(1, (os.cpu_count() or 1) // options.processes))
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), threads)

    def one(name: str) -> Row:
        out = options.films / name
        command = [sys.executable, __file__, "--one", name, "--films", str(options.films), "--device", options.device]
        command += ["--nodes", str(options.nodes), *(["--trained", str(options.trained)] if options.trained else [])]
        options.films.mkdir(parents=True, exist_ok=True)
        with (options.films / f"{name}.log").open("w") as log:
            status = subprocess.run(command, stdout=log, stderr=log, env={**os.environ, **limits}).returncode
        if status or not (out / "row.json").exists():
            messages = (options.films / f"{name}.log").read_text().strip().splitlines()
            return {"scene": name, "how": "film", "ended": "failed", "messages": messages[-1:]}
        return json.loads((out / "row.json").read_text())

    # Films that begin with training take the longest, so they start first.
    names = [name for name in FILMS if is_here(name) and (not options.only or name in options.only)]
    with ThreadPoolExecutor(options.processes) as pool:
        rows = list(pool.map(one, names))
    for row in rows:
        stages = " ".join(f"{stage} {value:.1f}" for stage, value in row.get("seconds", {}).items())
        print(f"{row['scene']}: {stages or row['messages']} ({row['ended']})", flush=True)
    if options.json:
        # These rows are stored now, in case the run is stopped before the rest is done.
        options.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    return rows


def cloud_of(annotated: DrawnScene, options: argparse.Namespace, seconds: dict[str, float]) -> GaussianCloud:
    """Read the capture, or train one from the photos."""
    if annotated.capture is not None:
        return read_capture(annotated.capture, device=options.device).cloud
    assert annotated.photos is not None
    candidates = [options.trained / f"{annotated.name}.ply"] if options.trained else []
    candidates += [options.films / annotated.name / "capture.ply"] if options.films else []
    for place in candidates:
        if place.exists():
            return read_capture(place, device=options.device).cloud
    small = options.device == "cpu"
    result, seconds["train"] = timed(
        train,
        annotated.photos,
        iterations=2500 if small else 7000,
        max_gaussians=40_000 if small else 200_000,
        max_side=360 if small else 1600,
        seed=options.seed,
        device=options.device,
    )
    return result.cloud


def rows_of(annotated: DrawnScene, options: argparse.Namespace, table: Table) -> tuple[list[Row], list[np.ndarray]]:
    """Return the rows for masks, one click, three clicks and the ground, and images of one of the evaluated views."""
    trained: dict[str, float] = {}
    cloud = cloud_of(annotated, options, trained)
    cameras = [one.camera for one in read_cameras(annotated.photos)] if annotated.photos else []
    masked_views = tuple(
        MaskedView(view.camera, view.mask, f"view {2 * k}") for k, view in enumerate(annotated.views[CLICKED])
    )
    rows: list[Row] = []
    pictures = []
    for how in ("masks", "1 click", f"{CLICKS} clicks"):
        row: Row = {"scene": annotated.name, "how": how, "gaussians": cloud.count}
        seconds = {name: 1e-3 * value for name, value in trained.items()} if how == "masks" else {}
        stages: dict[str, float] = {}
        try:
            spec, written = (
                (ObjectSpec(masks=masked_views), [])
                if how == "masks"
                else clicked(annotated, cloud, cameras, 1 if how == "1 click" else CLICKS)
            )
            located, object_cloud, bare = found_by(cloud, spec, cameras, stages)
        except UserError as error:
            rows.append({**row, "iou": 0.0, "ious": [], "messages": str(error)})
            table.row(annotated.name, how, 0.0, 0.0, None, None)
            continue
        if how == "masks" and not options.quick:
            hole = hole_under(cloud, located.plane, located.segmentation)
            if hole is not None:
                _, stages["inpaint"] = timed(inpaint, bare, hole, options=InpaintOptions(steps=0))
        seconds |= {name: 1e-3 * value for name, value in stages.items()}
        judged = [overlap(cloud, object_cloud, view) for view in annotated.views[JUDGED]]
        ious = [one[0] for one in judged]
        rows.append({**row, "iou": float(np.mean(ious)), "ious": ious, "clicks": written, "seconds": seconds})
        if how == "masks":
            rows.append(real_ground(annotated, cloud, located))
        pictures.append(picture(object_cloud, annotated.views[JUDGED][0], *judged[0][1:]))
        total = sum(stages.values())
        table.row(annotated.name, how, float(np.mean(ious)), min(ious), 1e-3 * total, None)
    return rows, pictures


def psnr_rows(options: argparse.Namespace) -> list[Row]:
    """Return held-out scores of our training and of gsplat's, measured as in ``train.py``."""
    from train import run_case

    chosen = argparse.Namespace(**vars(options), iterations=7000, gaussians=200_000, max_side=1600)
    table = Table(case="<10", method="<12", gaussians="d", seconds="6.1f", **{f"figure_{k}": ".3f" for k in range(6)})
    rows: list[Row] = []
    for case in TRAINING_CASES:
        if (data_folder() / "posed" / case).exists():
            rows += run_case(case, chosen, table)[0]
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(
        __doc__,
        quick="only scenes with a capture, without inpainting; the bonsai only with --trained",
        device="cpu",
        plot="image of the object alone in a judged view, from masks, one click and three; red: missing, blue: excess",
    )
    parser.add_argument("--trained", type=Path, help="folder of captures that were trained before: bonsai.ply")
    parser.add_argument("--films", type=Path, help="folder for the films, one folder a scene")
    parser.add_argument("--processes", type=int, default=1, help="films at a time")
    parser.add_argument("--nodes", type=int, default=500, help="approximate number of nodes of the films' cages")
    parser.add_argument("--only", nargs="*", metavar="SCENE", help="only these scenes")
    parser.add_argument("--peers", action="store_true", help="also train with gsplat, for psnr_vs_gsplat")
    parser.add_argument("--one", choices=FILMS, help="only make the film of this scene")
    options = parser.parse_args(arguments)
    if options.one:
        path = options.trained / f"{options.one}.ply" if options.trained else None
        known = path if path and path.exists() else None
        film(options.one, options.films / options.one, device=options.device, nodes=options.nodes, trained=known)
        return
    rows: list[Row] = film_rows(options) if options.films else []
    figure: list[np.ndarray] = []
    table = Table(scene="<10", how="<9", IoU=".3f", worst=".3f", seconds="6.1f", ground="s")
    for name in ("pawn", "stool", "figurine"):
        rows.append(known_ground(name, options.device))
        table.row(name, "ground", None, None, None, "{degrees:.2f} deg, {offset:.2%}".format(**rows[-1]))
    for name in NAMES:
        annotated = read_drawn(name)
        if options.only and name not in options.only:
            continue
        has_cloud = annotated.capture is not None or options.trained or options.films or not options.quick
        if not annotated.is_here or not has_cloud:
            print(f"{name}: skipped, because its data are not on this machine; set EGS_WARP_DATA, or give --trained")
            continue
        more, pictures = rows_of(annotated, options, table)
        rows += more
        ground = next((row for row in more if row["how"] == "ground"), None)
        if ground is not None:
            text = "{degrees:.2f} deg, {offset:.2%} (marked {markings_degrees:.2f}, {markings_offset:.2%})"
            table.row(name, "ground", None, None, None, text.format(**ground))
        blank = np.full((320, 320, 3), 255, np.uint8)
        figure.append(np.concatenate([*pictures, *[blank] * (3 - len(pictures))], axis=1))
    why_null: dict[str, str] = {}
    against: bool | None = None
    if options.device.startswith("cuda") and has_gsplat() and options.peers:
        peers = psnr_rows(options)
        rows += peers
        ours, theirs = (
            {row["case"]: row["held_out_psnr"] for row in peers if row["method"].startswith(who)}
            for who in ("egs_warp", "gsplat")
        )
        against = all(ours[case] >= theirs[case] for case in theirs)
    else:
        why_null["psnr_vs_gsplat"] = "needs a GPU with gsplat, and --peers"
    films = [row["ended"] == "done" for row in rows if row.get("how") == "film"]
    if not films:
        why_null["films"] = "measured with --films only"
    report(
        options,
        rows,
        aims={**judged_masks(rows), "ground": judged_ground(rows), "films": all(films) if films else None}
        | {"psnr_vs_gsplat": against},
        why_null=why_null,
        packages=["torch"],
        picture=np.concatenate(figure) if figure else None,
    )


def judged_masks(rows: Sequence[Row]) -> dict[str, bool]:
    """Return the aims ``iou_masks`` and ``iou_click``."""
    masks, three = ([row for row in rows if row.get("how") == how] for how in ("masks", f"{CLICKS} clicks"))
    return {
        "iou_masks": all(row["iou"] >= (IOU_FOLIAGE if row["scene"] == "bonsai" else IOU_MASKS) for row in masks),
        "iou_click": all(row["iou"] >= IOU_CLICKS for row in three),
    }


if __name__ == "__main__":
    main()
