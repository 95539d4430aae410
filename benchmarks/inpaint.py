"""Inpainting of the floor under an object, compared with the known floor.

Cases: the three built-in scenes (the floor under the object is removed and replaced by dark haze, as in a capture), and
holes cut into visible floor of real captures. In held-out views, the hole's pixels are compared with the original
floor.

Rows: this package; the same with patch synthesis replaced by ``cv2.inpaint`` on the face-on view of the plane (same
flat Gaussians, same training); ``cv2.inpaint`` in every image (the better of its two methods, but the time of both);
and training without the plane, in which the same number of Gaussians, scattered where the object stood, is trained
against the same single inpainted image.

In addition to PSNR and SSIM, the rows have PSNR after a blur (``coarse_psnr``) and the gradient energy relative to the
true floor's (``detail``; 1 is ideal), because PSNR favours a blurred result where the true pixels cannot be known.
``face_on`` quantifies this preference: it contains both PSNRs, on the plane, for our inpainting, for one uniform
colour, and for the true floor itself, shifted into the hole.

Aims: ``beats_cv2_by_3db``, ``beats_no_prior_by_3db``, ``inpaint_beats_rectified_cv2`` (mean PSNR over the cases),
``seconds_on_gpu`` (every case at most 20 s), ``hole_size_independent`` (the times for two holes, one with four times
the area of the other, differ by at most a factor of 1.5).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

from egs_warp.assets import scene
from egs_warp.geometry.camera import Camera, camera_rays
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.inpainting.holes import Hole, disc, footprint
from egs_warp.inpainting.inpaint import InpaintOptions, InpaintResult, inpaint
from egs_warp.inpainting.inpainters import OpenCvInpainter, OpenCvMethod
from egs_warp.inpainting.picture import depth_colours
from egs_warp.inpainting.rectified import rectify
from egs_warp.io import read_capture
from egs_warp.io.video import contact_sheet
from egs_warp.render import render_gaussians
from egs_warp.segmentation.plane_fit import plane_depth
from egs_warp.training.finetune import FinetuneOptions, finetune
from egs_warp.training.metrics import psnr
from egs_warp.training.training_view import TrainingView
from floor_measures import coarse_psnr, gradient_energy, moved_floor_scores, similarity
from harness import Row, Table, data_folder, flags, report, timed

OURS, FACE_ON_CV2, CV2, NO_PRIOR = "ours", "cv2 face-on", "cv2 in the picture", "no plane prior"
METHODS = (OURS, FACE_ON_CV2, CV2, NO_PRIOR)
REAL = {
    # File, plane, and centre and radius of the hole in scene units, by the name of the case.
    "koala planks": ("koala.ply", (0.003, -1.0, -0.018, -0.023), (0.35, 0.0, -1.15), 0.2),
    "playbot moss": ("playbot", (0.0, -1.0, 0.0, -0.019), (0.6, 0.0, 0.6), 0.14),
}


@dataclass(frozen=True)
class Case:
    """A floor with a hole, and the original floor."""

    name: str
    truth: GaussianCloud
    damaged: GaussianCloud
    """Background as after segmentation: haze instead of the floor in the hole."""
    hole: Hole
    is_real: bool


def built_in(name: str, device: str) -> Case:
    """Build the case of a built-in scene: the floor under its object."""
    built = scene(name, device=device)
    hole = footprint(built.object, built.plane)
    return Case(name, built.background, damaged(built.background, hole), hole, False)


def real(name: str, device: str) -> Case | None:
    """Build the case of a hole in visible floor; None if the capture is not on this machine."""
    file, coefficients, centre, radius = REAL[name]
    path = data_folder() / "scenes" / file
    if not path.exists():
        return None
    hole = disc(Plane.from_coefficients(*coefficients), np.array(centre), radius)
    truth = read_capture(path, device=device).cloud
    return Case(name, truth, damaged(truth, hole), hole, True)


def damaged(truth: GaussianCloud, hole: Hole) -> GaussianCloud:
    """Remove the Gaussians in the hole and add a little dark haze around the plane there.

    Captures contain such haze, because no camera sees the floor under the object.
    """
    _, side = hole.bounds()
    means = truth.means.numpy()
    away = np.abs(hole.plane.heights(means))
    remaining = truth.subset(~(hole.window.sample(hole.mask, means) & (away < 0.5 * side)))
    random = np.random.default_rng(0)
    at = np.argwhere(hole.mask)
    count = 40
    pixels = at[random.integers(len(at), size=count)][:, ::-1] + 0.5
    haze = GaussianCloud.from_numpy(
        hole.window.points(pixels) + random.normal(0.0, 0.06 * side, (count, 1)) * hole.plane.normal,
        random.normal(size=(count, 4)),
        np.log(0.06 * side) + random.normal(0.0, 0.3, (count, 3)),
        random.normal(0.0, 1.0, count),
        np.concatenate([np.full((count, 1, 3), -1.2), np.zeros((count, truth.sh.shape[1] - 1, 3))], axis=1),
        device=str(truth.device),
    )
    return concatenate(remaining, haze)


def cameras_around(hole: Hole, size: int) -> list[Camera]:
    """Return eight cameras on two rings; the first one renders the single image on which the baseline trains."""
    middle, side = hole.bounds()
    first, second = hole.plane.tangents()
    cameras = []
    for number in range(8):
        azimuth, elevation = 2.0 * np.pi * (number + 0.3) / 8, np.radians((28.0, 50.0)[number % 2])
        level = np.cos(azimuth) * first + np.sin(azimuth) * second
        eye = middle + 4.5 * side * (np.cos(elevation) * level + np.sin(elevation) * hole.plane.normal)
        cameras.append(
            Camera.look_at(
                eye, middle, hole.plane.normal, width=size, height=size, vertical_fov_degrees=24.0, near=0.05 * side
            )
        )
    return cameras


def hole_pixels(result: InpaintResult, camera: Camera) -> np.ndarray:
    """Return (H, W) bool, True where the pixel's ray meets the plane inside the hole."""
    depth = plane_depth(result.window.plane, camera)
    points = camera.centre + depth[..., None] * camera_rays(camera)
    return (result.window.sample(result.hole, points.reshape(-1, 3)).reshape(depth.shape)) & (depth > 0.0)


def picture(cloud: GaussianCloud, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Render colour (H, W, 3) and depth (H, W)."""
    image = render_gaussians(cloud, camera)
    return np.clip(image.colour.numpy(), 0.0, 1.0), image.depth.numpy()


def best_by_opencv(image: np.ndarray, mask: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Inpaint ``mask`` (H, W) in ``image`` (H, W, 3) with the OpenCV method whose result is closer to ``truth``."""
    wide = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    coded = np.rint(255 * image).astype(np.uint8)
    filled = (cv2.inpaint(coded, wide, 5, flag) / np.float32(255.0) for flag in (cv2.INPAINT_TELEA, cv2.INPAINT_NS))
    return max(filled, key=lambda one: psnr(one[mask], truth[mask]))


def without_plane(
    case: Case, result: InpaintResult, camera: Camera, target: np.ndarray, steps: int, seed: int
) -> GaussianCloud:
    """Train the number of Gaussians that our inpainting adds, scattered over the volume of the object, against one
    image."""
    _, side = case.hole.bounds()
    remaining = result.cloud.subset(~result.is_new)
    count = int(result.is_new.sum())
    random = np.random.default_rng(seed)
    at = np.argwhere(result.hole)
    pixels = at[random.integers(len(at), size=count)][:, ::-1] + random.uniform(0, 1, (count, 2))
    rise = random.uniform(-0.25, 0.5, (count, 1)) * side
    sh = np.zeros((count, remaining.sh.shape[1], 3))
    sh[:, 0] = (np.median(result.painted[result.hole], axis=0) - 0.5) / SH_BAND_0
    scattered = GaussianCloud.from_numpy(
        result.window.points(pixels) + rise * case.hole.plane.normal,
        random.normal(size=(count, 4)),
        np.full((count, 3), np.log(1.5 * side / count ** (1 / 2))),
        np.full(count, np.log(0.1 / 0.9)),
        sh,
        device=str(remaining.device),
    )
    whole = concatenate(remaining, scattered)
    trainable = np.arange(whole.count) >= remaining.count
    mask = cv2.dilate(hole_pixels(result, camera).astype(np.float32), np.ones((9, 9), np.uint8))
    return finetune(
        whole,
        [TrainingView(camera, target, weight=mask)],
        options=FinetuneOptions(iterations=steps, seed=seed),
        trainable=trainable,
    ).cloud


def judge_case(case: Case, options: argparse.Namespace, table: Table) -> tuple[list[Row], np.ndarray]:
    """Return one row for each method, and a strip of images with colour above depth."""
    runs = [inpaint(case.damaged, case.hole, options=InpaintOptions(seed=options.seed)) for _ in range(options.repeat)]
    # The first run also compiles kernels.
    seconds = [sum(run.seconds.values()) for run in (runs[1:] or runs)]
    result = runs[-1]
    smooth = {
        method: inpaint(
            case.damaged, case.hole, inpainter=OpenCvInpainter(method), options=InpaintOptions(seed=options.seed)
        )
        for method in OpenCvMethod
    }
    cameras = cameras_around(case.hole, options.size)
    empty = result.cloud.subset(~result.is_new)
    target, _ = picture(result.cloud, cameras[0])
    unguided, unguided_ms = timed(without_plane, case, result, cameras[0], target, options.baseline_steps, options.seed)
    clouds = {OURS: result.cloud, **{one: run.cloud for one, run in smooth.items()}, NO_PRIOR: unguided}
    scores: dict[str | OpenCvMethod, list[tuple[float, ...]]] = {method: [] for method in (*clouds, CV2)}
    cv2_seconds = []
    views: list[tuple[np.ndarray, ...]] = []
    for camera in cameras[1:]:
        truth, true_depth = picture(case.truth, camera)
        # Exclude objects in front of the floor, which are the same in every image.
        ahead = true_depth - plane_depth(case.hole.plane, camera)
        mask = hole_pixels(result, camera) & (np.abs(ahead) < 0.25 * case.hole.bounds()[1])
        if mask.sum() < 100:
            continue
        hollow, hollow_depth = picture(empty, camera)
        flat, cv2_ms = timed(best_by_opencv, hollow, mask, truth)
        cv2_seconds.append(1e-3 * cv2_ms)
        images = {method: picture(cloud, camera) for method, cloud in clouds.items()}
        if not views:
            views = [(hollow, hollow_depth), (flat, np.zeros_like(hollow_depth)), *images.values(), (truth, true_depth)]
        for method, (image, depth) in {**images, CV2: (flat, None)}.items():
            off = np.nan if depth is None else np.abs(depth[mask] - true_depth[mask]).mean() / case.hole.bounds()[1]
            scores[method].append(
                (
                    psnr(image[mask], truth[mask]),
                    float(similarity(truth, image)[mask].mean()),
                    coarse_psnr(image, truth, mask),
                    gradient_energy(image, truth, mask),
                    float(off),
                )
            )
    means = {method: np.mean(values, axis=0) for method, values in scores.items()}
    better = max(smooth, key=lambda one: means[one][0])
    chosen = {OURS: OURS, FACE_ON_CV2: better, CV2: CV2, NO_PRIOR: NO_PRIOR}
    spent = {
        OURS: float(np.median(seconds)),
        FACE_ON_CV2: sum(smooth[better].seconds.values()),
        CV2: float(np.median(cv2_seconds)),
        NO_PRIOR: 1e-3 * unguided_ms,
    }
    rows = []
    for method in METHODS:
        mean = means[chosen[method]]
        rows.append(
            {
                "case": case.name,
                "real": case.is_real,
                "method": method,
                "psnr": float(mean[0]),
                "ssim": float(mean[1]),
                "coarse_psnr": float(mean[2]),
                "detail": float(mean[3]),
                "depth_error_of_hole_side": None if np.isnan(mean[4]) else float(mean[4]),
                "seconds": spent[method],
                "stages": result.seconds if method == OURS else None,
                "face_on": face_on(case, result) if method == OURS else None,
                "gaussians": int(result.is_new.sum()) if method != CV2 else 0,
                "hole_texels": int(result.hole.sum()),
            }
        )
        depth = rows[-1]["depth_error_of_hole_side"]
        table.row(case.name, method, *mean[:4], spent[method], depth)
    face_on_scores = rows[0]["face_on"]
    print(
        "  face-on, dB: "
        + ", ".join(f"{name} {one:.2f} ({two:.2f} coarse)" for name, (one, two) in face_on_scores.items()),
        flush=True,
    )
    hollow, flat, ours, telea, navier, unprior, truth = views
    shown = [hollow, flat, unprior, telea if better is OpenCvMethod.TELEA else navier, ours, truth]
    return rows, sheet([one for one, _ in shown], [depth for _, depth in shown], case.name)


def face_on(case: Case, result: InpaintResult) -> dict[str, tuple[float, float]]:
    """Return the PSNR and the PSNR after a blur (dB) of pictures of the hole, seen face-on, by name.

    The pictures are our inpainting, the mean colour of the rim, and shifted copies of the true floor, of which the mean
    and the best scores are returned.
    """
    floor = rectify(case.truth, result.window, thickness=0.15 * case.hole.bounds()[1])
    truth, known = floor.colour, floor.alpha > 0.6
    inside = result.hole & known
    rim = ndimage.binary_dilation(result.hole, iterations=12) & ~result.hole & known
    pictures = {"ours": result.painted, "one colour": np.broadcast_to(truth[rim].mean(axis=0), truth.shape)}
    scores = {
        name: (psnr(one[inside], truth[inside]), coarse_psnr(one, truth, inside)) for name, one in pictures.items()
    }
    shifted_scores = np.array(moved_floor_scores(truth, known, inside))
    if len(shifted_scores):
        for name, (fine, coarse) in {
            "moved": shifted_scores.mean(axis=0),
            "moved, best": shifted_scores.max(axis=0),
        }.items():
            scores[f"true floor {name}"] = (float(fine), float(coarse))
    return scores


def sheet(colours: list[np.ndarray], depths: list[np.ndarray], name: str) -> np.ndarray:
    """Arrange colour images above depth images, with labels."""
    near, far = np.quantile(depths[-1][depths[-1] > 0], [0.02, 0.98])
    labels = [f"{name}: hole", CV2, NO_PRIOR, FACE_ON_CV2, OURS, "truth"]
    tiles = [np.rint(255 * colour).astype(np.uint8) for colour in colours] + [
        depth_colours(depth, float(near), float(far)) for depth in depths
    ]
    return contact_sheet(tiles, 6, labels + ["depth", "no depth", *4 * ["depth"]])


def size_rows(options: argparse.Namespace) -> list[Row]:
    """Time, alternately, the inpainting of a round hole in the table cloth and of a hole with four times its area."""
    built = scene("figurine", device=options.device)
    holes = {radius: disc(built.plane, np.array([0.1, 0.2, 0.0]), radius) for radius in (0.16, 0.32)}
    clouds = {radius: damaged(built.background, hole) for radius, hole in holes.items()}
    seconds: dict[float, list[float]] = {radius: [] for radius in holes}
    for _ in range(max(3, options.repeat)):
        for radius, hole in holes.items():
            run = inpaint(clouds[radius], hole, options=InpaintOptions(seed=options.seed))
            seconds[radius].append(sum(run.seconds.values()))
    rows = [
        {"case": "size", "method": OURS, "area": holes[radius].area, "seconds": float(np.median(spent))}
        for radius, spent in seconds.items()
    ]
    for row in rows:
        print(f"hole of {row['area']:.3f} square units: {row['seconds']:.2f} s", flush=True)
    return rows


def judge(rows: list[Row], *, on_gpu: bool) -> tuple[dict[str, bool | None], dict[str, str]]:
    """Return the aims from the rows."""

    def mean(method: str) -> float:
        return float(np.mean([row["psnr"] for row in rows if row["case"] != "size" and row["method"] == method]))

    sizes = [row["seconds"] for row in rows if row["case"] == "size"]
    ours = [row["seconds"] for row in rows if row["case"] != "size" and row["method"] == OURS]
    aims: dict[str, bool | None] = {
        "beats_cv2_by_3db": mean(OURS) >= mean(CV2) + 3.0,
        "beats_no_prior_by_3db": mean(OURS) >= mean(NO_PRIOR) + 3.0,
        "inpaint_beats_rectified_cv2": mean(OURS) > mean(FACE_ON_CV2),
        "seconds_on_gpu": max(ours) <= 20.0 if on_gpu else None,
        "hole_size_independent": max(sizes) <= 1.5 * min(sizes),
    }
    why = {} if on_gpu else {"seconds_on_gpu": "only measured on a GPU"}
    return aims, why


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="256 x 256, 150 steps without the plane, one run each")
    parser.add_argument("--cases", nargs="+", default=["pawn", "stool", "figurine", *REAL])
    parser.add_argument("--size", type=int, help="width and height of the images, pixels (default 400)")
    parser.add_argument("--baseline-steps", type=int, help="training steps without the plane (default 5000)")
    parser.add_argument("--join", type=Path, help="JSON of an earlier run with other cases, judged with this run")
    parser.add_argument("--repeat", type=int, help="timed runs (default 4, the first is not counted)")
    options = parser.parse_args(arguments)
    options.size = options.size or (256 if options.quick else 400)
    options.baseline_steps = options.baseline_steps or (150 if options.quick else 5000)
    options.repeat = options.repeat or (1 if options.quick else 4)
    rows: list[Row] = []
    strips: list[np.ndarray] = []
    missing = []
    table = Table(
        case="<13", method="<18", dB=".2f", SSIM=".3f", coarse_dB=".2f", detail=".2f", seconds=".2f", depth_off=".2%"
    )
    for name in options.cases:
        make: Callable[[str, str], Case | None] = real if name in REAL else built_in
        case = make(name, options.device)
        if case is None:
            missing.append(name)
            continue
        part, strip = judge_case(case, options, table)
        rows += part
        strips.append(strip)
    if options.join:
        rows += [row for row in json.loads(options.join.read_text())["rows"] if row["case"] != "size"]
    rows += size_rows(options)
    aims, why_null = judge(rows, on_gpu=options.device.startswith("cuda"))
    if missing:
        print(f"cases without their capture on this machine: {', '.join(missing)}")
    table = Table(mean_of_all="<18", dB=".2f", SSIM=".3f", coarse_dB=".2f", detail=".2f")
    for method in METHODS:
        chosen = [row for row in rows if row["method"] == method and row["case"] != "size"]
        means = (np.mean([row[key] for row in chosen]) for key in ("psnr", "ssim", "coarse_psnr", "detail"))
        table.row(method, *means)
    report(
        options,
        rows,
        aims=aims,
        why_null=why_null,
        packages=["opencv-python-headless", "torch"],
        conditions={"size": options.size, "baseline_steps": options.baseline_steps, "missing": missing},
        picture=np.concatenate(strips, axis=0) if strips else None,
    )


if __name__ == "__main__":
    main()
