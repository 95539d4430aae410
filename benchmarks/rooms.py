"""Overlap, time and plane clearing of objects in procedural rooms with ground truth. The objects are proposed by
``egs-warp pick``, selected by clicks, or given by masks.

The twenty rooms of ``room_scenes.py`` are captures with labelled Gaussians, and photos of them: toys on duvets, floors,
grass and furniture, against walls, beside furniture, between other toys, half under a table. Eight photos are annotated
with the truth. As in ``scene_quality.py``, every other annotated photo may be clicked or gives a mask. In the remaining
ones, the overlap (IoU) of the object alone, cut at its ground, is evaluated; pixels in which something in front hides
the object are ignored. ``before`` and ``after`` are the numbers of Gaussians of the object before and after the default
clearing of the ground (fine-tuning). A row is a success if the IoU is at least 0.9, so that the object is complete and
nothing else is included, and if the clearing ends with a finite object within the bound. Stains on the floor of a film
are not evaluated. ``warnings`` in the JSON are the warnings that ``egs-warp segment`` prints.

With ``--train``, each capture is trained from the photos first, as a user would; for all rooms this needs a GPU.

Aims: ``one_click`` (success in at least nine tenths of the rooms), ``three_clicks`` (success in all rooms),
``clearing`` (never more than 1.5 times as many Gaussians, always finite and not empty), ``reported`` (an object
with an IoU below 0.5 always comes with a warning or an error).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from clicking import CLICKED, JUDGED, clicked, found_by, overlap, picture
from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.io.cameras import write_cameras
from egs_warp.io.video import write_png
from egs_warp.pipelines.locate_plane import LocatedPlane, up_of_cameras
from egs_warp.pipelines.pick import Pick, photo_warnings, pick_warnings, proposed
from egs_warp.pipelines.pictures import picture_cameras
from egs_warp.pipelines.prepare_scene import SceneOptions, segment_scene
from egs_warp.pipelines.segmentation_warnings import segmentation_warnings
from egs_warp.segmentation.interactive import ClickGraph
from egs_warp.segmentation.object_spec import ObjectSpec
from egs_warp.segmentation.votes import MaskedView
from harness import Row, Table, flags, report, timed
from room_scenes import SCENES, SyntheticScene, build_scene

MIN_IOU, UNUSABLE_IOU, MAX_RATIO = 0.9, 0.5, 1.5
CLICKS = {"proposal": 0, "1 click": 1, "3 clicks": 3, "masks": 0}
"""Number of clicks of each description of the object."""
QUICK = ("bear_duvet_wall_wardrobe", "dog_grass_toys", "bear_floor_table", "robot_chair")


def trained(scene: SyntheticScene, options: argparse.Namespace) -> GaussianCloud:
    """Train a capture from the photos of ``scene``, as ``egs-warp train`` does."""
    from egs_warp.pipelines.train_capture import train

    with tempfile.TemporaryDirectory() as folder:
        names = [f"photo{number}.png" for number in range(len(scene.cameras))]
        for name, photo in zip(names, scene.photos(), strict=True):
            write_png(Path(folder, name), np.rint(255.0 * photo).astype(np.uint8))
        write_cameras(Path(folder, "cameras.json"), scene.cameras, names)
        return train(
            folder,
            iterations=options.train,
            max_gaussians=scene.cloud.count,
            seed=options.seed,
            device=options.device,
        ).cloud


def rows_of(scene: SyntheticScene, cloud: GaussianCloud, options: argparse.Namespace) -> tuple[list[Row], np.ndarray]:
    """Return the row of each description of the object, and the pictures of the object in the first judged view."""
    views = scene.drawn.views
    rows: list[Row] = []
    pictures = []
    for how in options.how:
        count = CLICKS[how]
        row: Row = {"scene": scene.name, "how": how, "gaussians": cloud.count, "iou": 0.0, "success": False}
        seconds: dict[str, float] = {}
        try:
            plane, written = None, []
            if how == "proposal":
                pick, seconds["propose"] = timed(_proposal, scene, cloud)
                spec, plane = ObjectSpec(picked=pick.mask), pick.plane
            elif count:
                spec, written = clicked(scene.drawn, cloud, scene.cameras, count)
            else:
                spec = ObjectSpec(masks=tuple(MaskedView(v.camera, v.mask, "mask") for v in views[CLICKED]))
            located, object_cloud, _ = found_by(cloud, spec, scene.cameras, seconds, plane)
            cleared = cleared_row(cloud, located)
        except UserError as error:
            rows.append({**row, "message": str(error)})
            pictures.append(np.full((320, 320, 3), 255, np.uint8))
            continue
        eyes = picture_cameras(located.plane, located.centre, located.size, scene.cameras)
        judged = [overlap(cloud, object_cloud, view) for view in views[JUDGED]]
        ious = [one[0] for one in judged]
        row |= {"iou": float(np.mean(ious)), "ious": ious, "clicks": written, **cleared}
        row["warnings"] = segmentation_warnings(cloud, located, object_cloud, eyes)
        row["seconds"] = {name: 1e-3 * value for name, value in seconds.items()}
        row["success"] = bool(row["iou"] >= MIN_IOU and is_clear(row))
        rows.append(row)
        pictures.append(picture(object_cloud, views[JUDGED][0], *judged[0][1:]))
    return rows, np.concatenate(pictures, axis=1)


def _proposal(scene: SyntheticScene, cloud: GaussianCloud) -> Pick:
    """Return the proposal for ``cloud``. Raises ``UserError`` if there is none, or if ``from-photos --yes`` would
    refuse it."""
    up = up_of_cameras(scene.cameras)
    assert up is not None
    graph = ClickGraph.of(cloud)
    pick = proposed(graph, up, cameras=scene.cameras)
    doubts = (*pick_warnings(graph, pick), *photo_warnings(cloud, pick.mask, scene.cameras))
    if doubts or not pick.mask.any():
        raise UserError(doubts[0] if doubts else "no object was found")
    return pick


def cleared_row(cloud: GaussianCloud, located: LocatedPlane) -> Row:
    """Return the entries of a row about the default clearing of the ground."""
    before = int(located.segmentation.object_mask.sum())
    try:
        (object_cloud, *_), milliseconds = timed(segment_scene, cloud, located, SceneOptions())
    except UserError as error:
        return {"before": before, "after": 0, "finite": False, "clearing_message": str(error)}
    finite = all(np.isfinite(getattr(object_cloud, name).numpy()).all() for name in ARRAYS)
    return {"before": before, "after": object_cloud.count, "finite": finite, "clearing_seconds": 1e-3 * milliseconds}


def is_clear(row: Row) -> bool:
    """Return True if the clearing of a row ended with a finite object that is not empty, within the bound."""
    return row["finite"] and 0 < row["after"] <= MAX_RATIO * row["before"]


def aims_of(rows: Sequence[Row], names: Sequence[str]) -> dict[str, bool]:
    """Return the aims, computed from the rows of the rooms ``names``."""
    successes = {how: [row["success"] for row in rows if row["how"] == how] for how in CLICKS}
    aims = {
        "one_click": sum(successes["1 click"]) >= 0.9 * len(names),
        "three_clicks": sum(successes["3 clicks"]) == len(names),
    }
    measured = {"one_click": bool(successes["1 click"]), "three_clicks": bool(successes["3 clicks"])}
    return {name: value for name, value in aims.items() if measured[name]} | {
        "clearing": all(is_clear(row) for row in rows if "before" in row),
        "reported": all("message" in row or row["warnings"] for row in rows if row["iou"] < UNUSABLE_IOU),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(
        __doc__,
        quick="four rooms",
        device="cpu",
        seed="seed of the rooms",
        plot="image of the object alone in a judged view, for each description; red: missing, blue: excess",
    )
    parser.add_argument("--only", nargs="*", metavar="ROOM", choices=SCENES, help="only these rooms")
    parser.add_argument("--how", nargs="*", choices=CLICKS, default=list(CLICKS), help="only these descriptions")
    parser.add_argument("--density", type=float, default=1.0, help="factor of the number of Gaussians")
    parser.add_argument("--train", type=int, metavar="STEPS", help="train the captures from photos, in so many steps")
    options = parser.parse_args(arguments)
    names = options.only or (QUICK if options.quick else tuple(SCENES))
    rows: list[Row] = []
    figure: list[np.ndarray] = []
    table = Table(
        scene="<26",
        how="<8",
        IoU=".3f",
        before="d",
        after="d",
        find_s="6.1f",
        clear_s="6.1f",
        success="<7",
        message="<",
    )
    for name in names:
        scene = build_scene(name, seed=options.seed, density=options.density, device=options.device)
        cloud = trained(scene, options) if options.train else scene.cloud
        more, shown = rows_of(scene, cloud, options)
        rows += more
        figure.append(shown)
        for row in more:
            table.row(
                *(name, row["how"], row["iou"], row.get("before"), row.get("after")),
                sum(row["seconds"].values()) if "seconds" in row else None,
                row.get("clearing_seconds"),
                "yes" if row["success"] else "no",
                row.get("message", row.get("clearing_message", " ".join(row.get("clicks", ())))),
            )
    report(options, rows, aims=aims_of(rows, names), packages=["torch"], picture=np.concatenate(figure))


if __name__ == "__main__":
    main()
