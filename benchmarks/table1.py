"""Table 1: methods of deforming Gaussians with a cage, compared with the true deformed mesh.

Glossy objects with true meshes are photographed at rest by a ray caster and trained to Gaussians of SH degree 3 by the
project's own trainer. Then they are bent, twisted and dropped on the floor: one displacement of the cage nodes, known
or simulated, deforms both the mesh's vertices and the Gaussians. The gloss rotates with the surface, as in a capture,
so the scores depend on how a method rotates the colours. Held-out cameras compare the two. The table contains three
objects; two more are held out. The settings of splitting were chosen on three others (``--choose``), which appear in no
table.

Rows: SuGaR (bound to a surface of the capture, and once to the cage's faces), PhysGaussian, VR-GS; our method unsplit,
with the paper's split (Eq. 17 as corrected), and with our split. Further rows compare equal numbers of Gaussians: the
other methods deform the Gaussians that result from our split, and all methods, ours without splits, deform a capture
trained with the same number of Gaussians.

Aims, from means over objects: ``best_psnr_every_deformation`` and ``best_ssim_every_deformation`` (our method ahead of
all rows that start from the same capture), ``margin_over_vrgs`` (by at least the paper's margins), ``split_helps`` (our
method ahead of itself without splits in PSNR and SSIM for every deformation), ``equal_count_best`` (in PSNR and SSIM
for every deformation, our method ahead of the others on its split, and our unsplit method ahead of them on the capture
trained with the same number), ``paper_margins_held_out`` (the paper's margins over VR-GS on the two held-out objects).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

import painted_meshes
from harness import Row, Table, flags, report
from lego_proxy import lego
from perceptual import lpips_distance
from table1_rows import MAIN, MOTIONS, ROWS, SAME_SPLIT, SAME_TRAINING, Splitting, object_rows, settings_rows

OBJECTS = ("chair", "plant", "microphone")
HELD_OUT = ("spot", "stool")
FROM_PHOTOS = "lego"
"""Proxy of the NeRF-synthetic model, built from its photos (``lego_proxy.py``). It is evaluated only on request and
affects no aim."""
CHOOSING = ("cat", "vase", "table")
"""Objects on which the settings below were chosen."""
DEGREES, MIN_ERROR, DEPTH, GROWTH = 4.0, 7e-4, 4, 20.0
"""Result of ``--choose`` with images of 256 x 256 and 3000 training steps; the first two values are the library's
defaults."""
SETTINGS = {
    f"{degrees:g} degrees, {error:g}": (degrees, error)
    for error, degrees in product((7e-4, 4e-4, 2e-4, 1e-4), (9.0, 4.0))
}
"""Settings that ``--choose`` compares, the coarsest first."""
PSNR_TOLERANCE = 0.02
"""Tolerance of ``--choose``, dB: it selects the coarsest setting whose mean PSNR over objects and motions differs from
the best by at most this value."""
PAPER_MARGINS = {"bend": (0.16, 0.006), "twist": (0.36, 0.017), "fall": (0.36, 0.013)}
"""Margins in PSNR (dB) and SSIM of the paper's full method over VR-GS in the paper's Table 1."""
SCORES = ("psnr", "ssim", "flip")


def means(rows: list[Row], objects: Sequence[str]) -> dict[tuple[str, str], tuple[float, ...]]:
    """Return the means of PSNR, SSIM, FLIP and number of Gaussians over ``objects``, for each motion and row."""
    table = {}
    for motion, name in product(MOTIONS, ROWS):
        chosen = [r for r in rows if (r["motion"], r["row"]) == (motion, name) and r["object"] in objects]
        table[motion, name] = tuple(float(np.mean([row[key] for row in chosen])) for key in (*SCORES, "gaussians"))
    return table


def judge(rows: list[Row], *, quick: bool) -> tuple[dict[str, bool | None], dict[str, str]]:
    """Return the aims from the rows."""
    present = {row["object"] for row in rows}
    small = "--quick judges only the ordering; see the full run"

    def missing(objects: Sequence[str]) -> str | None:
        absent = [name for name in objects if name not in present]
        return f"without {', '.join(absent)}; give the JSON of all runs to --rows" if absent else None

    def before(table: dict[tuple[str, str], tuple[float, ...]], ours: str, others: Sequence[str], score: int) -> bool:
        return all(table[m, ours][score] >= max(table[m, o][score] for o in others) for m in MOTIONS)

    def margins(table: dict[tuple[str, str], tuple[float, ...]]) -> bool:
        return all(
            table[m, "ours"][score] - table[m, "VR-GS"][score] >= PAPER_MARGINS[m][score]
            for m, score in product(MOTIONS, (0, 1))
        )

    aims: dict[str, bool | None]
    reason = missing(OBJECTS)
    names = ("best_psnr_every_deformation", "best_ssim_every_deformation", "margin_over_vrgs", "split_helps")
    if reason:
        aims = dict.fromkeys((*names, "equal_count_best"))
        why = dict.fromkeys(aims, reason)
    else:
        why = {names[2]: small} if quick else {}
        table = means(rows, OBJECTS)
        others = [name for name in MAIN if name != "ours"]
        trained = [name for name in SAME_TRAINING if not name.startswith("ours")]
        aims = {
            names[0]: before(table, "ours", others, 0),
            names[1]: before(table, "ours", others, 1),
            names[2]: None if quick else margins(table),
            names[3]: all(before(table, "ours", ["ours, no split"], score) for score in (0, 1)),
            "equal_count_best": all(
                before(table, "ours", list(SAME_SPLIT), score)
                and before(table, "ours, no split, as many", trained, score)
                for score in (0, 1)
            ),
        }
    reason = small if quick else missing(HELD_OUT)
    aims["paper_margins_held_out"] = None if reason else margins(means(rows, HELD_OUT))
    if reason:
        why["paper_margins_held_out"] = reason
    return aims, why


def show(rows: list[Row]) -> None:
    """Print means over the objects of the table, and over the held-out ones."""
    for title, objects in (
        ("the table's objects", OBJECTS),
        ("the held-out objects", HELD_OUT),
        ("from photos", (FROM_PHOTOS,)),
    ):
        chosen = [name for name in objects if any(row["object"] == name for row in rows)]
        if not chosen:
            continue
        print(f"\n{title}: mean over {', '.join(chosen)}")
        columns = {f"{m}_{what}": f for m in MOTIONS for what, f in (("dB", ".2f"), ("SSIM", ".4f"), ("FLIP", ".4f"))}
        table = Table(row="<26", **columns)
        averages = means(rows, chosen)
        for name in ROWS:
            table.row(name, *(value for motion in MOTIONS for value in averages[motion, name][:3]))


def choose(options: argparse.Namespace) -> list[Row]:
    """Return the rows of every setting on the objects of ``CHOOSING``."""
    settings = {
        name: Splitting(degrees, error, options.depth, options.growth) for name, (degrees, error) in SETTINGS.items()
    }
    rows: list[Row] = []
    for name in options.objects:
        rows += settings_rows(getattr(painted_meshes, name)(), options, settings)
    print("\nmean over objects and motions")
    table = Table(setting="<24", dB=".3f", SSIM=".4f", FLIP=".4f", Gaussians="7.0f")
    for name in settings:
        chosen = [row for row in rows if row["setting"] == name]
        table.row(name, *(float(np.mean([row[key] for row in chosen])) for key in (*SCORES, "gaussians")))
    print(f"selected: {selected_setting(rows)}")
    return rows


def selected_setting(rows: list[Row]) -> str:
    """Return the setting that ``--choose`` selects from its rows."""
    averages = {
        name: np.mean([row["psnr"] for row in rows if row["setting"] == name])
        for name in SETTINGS
        if any(row["setting"] == name for row in rows)
    }
    return next(name for name, value in averages.items() if value >= max(averages.values()) - PSNR_TOLERANCE)


def rows_in(paths: Sequence[Path]) -> list[Row]:
    """Return the rows of several JSON files."""
    return [row for path in paths for row in json.loads(path.read_text())["rows"]]


def mesh_of(name: str, options: argparse.Namespace) -> painted_meshes.PaintedMesh:
    """Return the object of this name."""
    if name != FROM_PHOTOS:
        return getattr(painted_meshes, name)()
    return lego(
        gaussians=3000 if options.quick else 30_000,
        iterations=options.iterations,
        seed=options.seed,
        device=options.device,
        cache=options.clouds / "lego_proxy.npz" if options.clouds else None,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="128 x 128, few training steps")
    parser.add_argument(
        "--objects",
        nargs="+",
        choices=[*OBJECTS, *HELD_OUT, FROM_PHOTOS, *CHOOSING],
        help="objects (default all of the table and the held-out ones)",
    )
    parser.add_argument("--held-out", dest="objects", action="store_const", const=HELD_OUT, help=f"{HELD_OUT} instead")
    parser.add_argument("--choose", action="store_true", help=f"compare settings of splitting on {CHOOSING}")
    parser.add_argument("--chosen", nargs="+", type=Path, help="JSON of --choose, whose selected setting is used")
    parser.add_argument("--matt", action="store_true", help="no lamps, no gloss, SH of degree 0")
    parser.add_argument("--size", type=int, help="width and height of the images, pixels (default 800)")
    parser.add_argument("--gaussians", type=int, help="number of Gaussians of a capture (default 4000)")
    parser.add_argument("--iterations", type=int, help="training steps (default 7000)")
    parser.add_argument("--nodes", type=int, help="approximate number of nodes of the cage")
    parser.add_argument("--clouds", type=Path, help="cache folder for clouds and falls")
    parser.add_argument("--rows", nargs="+", type=Path, help="judge the rows in these JSON files together")
    parser.add_argument(
        "--degrees", type=float, default=DEGREES, help="minimum rotation between the ends of a Gaussian that is split"
    )
    parser.add_argument(
        "--misfit",
        type=float,
        default=MIN_ERROR,
        help="minimum fit error of a Gaussian that is split, as a fraction of the cage's diagonal",
    )
    parser.add_argument("--depth", type=int, default=DEPTH)
    parser.add_argument("--growth", type=float, help=f"maximum growth of the number of Gaussians (default {GROWTH:g})")
    options = parser.parse_args(arguments)
    quick = options.quick
    shown = OBJECTS if quick else (*OBJECTS, *HELD_OUT)
    options.objects = options.objects or (CHOOSING if options.choose else shown)
    if options.choose != (options.objects[0] in CHOOSING):
        parser.error(f"--choose is for {', '.join(CHOOSING)}; they are not shown in the table")
    options.size = options.size or (128 if quick else 800)
    options.views, options.judges = (24, 6) if quick else (60, 12)
    options.gaussians = options.gaussians or (1500 if quick else 4000)
    options.iterations = options.iterations or (1000 if quick else 7000)
    if options.chosen:
        options.degrees, options.misfit = SETTINGS[selected_setting(rows_in(options.chosen))]
    options.growth = options.growth or (5.0 if quick else GROWTH)
    if options.clouds:
        options.clouds.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    strips: list[np.ndarray] = []
    if options.choose:
        rows = choose(options)
        aims = dict.fromkeys(judge([], quick=True)[0])
        why_null = dict.fromkeys(aims, "--choose compares settings on objects that no table shows")
    else:
        rows += rows_in(options.rows or [])
        splitting = Splitting(options.degrees, options.misfit, options.depth, options.growth)
        for name in [] if options.rows else options.objects:
            more, pictures = object_rows(mesh_of(name, options), options, splitting)
            rows += more
            strips += pictures
        aims, why_null = judge(rows, quick=quick)
        show(rows)
    _, no_lpips = lpips_distance()
    report(
        options,
        rows,
        aims=aims,
        why_null={**why_null, **({"lpips": no_lpips} if no_lpips else {})},
        packages=["torch"],
        conditions={
            key: getattr(options, key) for key in ("size", "gaussians", "iterations", "matt", "degrees", "misfit")
        },
        picture=np.concatenate(strips, axis=0) if strips else None,
    )


if __name__ == "__main__":
    main()
