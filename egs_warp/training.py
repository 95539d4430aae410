"""A capture from posed photos: read them, begin with a rough cloud, train. What ``egs-warp train`` calls.

Imports torch, so import it only where something is trained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from egs_warp.camera import Camera
from egs_warp.errors import UserError
from egs_warp.finetune import Densification, FinetuneOptions, Rates, TrainingView, finetune, psnr, ssim
from egs_warp.gaussians import GaussianCloud
from egs_warp.io.cameras import read_cameras
from egs_warp.render import render

SH_BAND_0 = 0.28209479177387814
_HOLD_OUT_EVERY = 8
"""As published methods do: every eighth photo is judged on and not trained on."""


@dataclass(frozen=True)
class PhotoScore:
    """How well the capture shows one photo."""

    name: str
    held_out: bool
    psnr: float
    """dB."""
    ssim: float
    """Mean structural similarity, 11 x 11 Gaussian window."""


@dataclass(frozen=True)
class TrainResult:
    """What training from photos gave."""

    cloud: GaussianCloud
    losses: np.ndarray
    """(iterations,) float64."""
    views: tuple[TrainingView, ...]
    """Every photo as it was trained or judged on: reduced and laid over the background."""
    scores: tuple[PhotoScore, ...]
    """One for each of ``views``."""
    background: tuple[float, float, float]
    """The colour behind the capture."""

    def mean_score(self, *, held_out: bool) -> tuple[float, float] | None:
        """Mean PSNR and SSIM of the photos held out, or of those trained on; None where there are none."""
        chosen = [(score.psnr, score.ssim) for score in self.scores if score.held_out is held_out]
        if not chosen:
            return None
        psnr_mean, ssim_mean = np.mean(chosen, axis=0)
        return float(psnr_mean), float(ssim_mean)


def train(
    posed: Path | str,
    *,
    iterations: int = 3000,
    max_gaussians: int = 50_000,
    sh_degree: int = 2,
    background: tuple[float, float, float] | None = None,
    max_side: int | None = None,
    seed: int = 0,
    device: str | None = None,
    threads: int | None = None,
    progress: Callable[[int, float], None] | None = None,
    stage: Callable[[str], None] | None = None,
) -> TrainResult:
    """Make a capture from the photos that ``posed`` (COLMAP, ``transforms.json`` or ``cameras.json``) points to.

    Photos larger than ``max_side`` pixels are reduced. Every eighth photo is held out and judged on. Photos with alpha
    or masks (``read_views``) are trained before a random colour each step, so that nothing can pass for the backdrop.
    They are judged before ``background``; without one, it is white for those and the mean colour along the photos'
    borders for others, so that no Gaussians are spent on a plain backdrop. ``progress`` is called with each step's
    number and loss, ``stage`` with what begins. Raises ``UserError`` for missing photos and impossible options.
    """
    if iterations < 1 or max_gaussians < 100 or not 0 <= sh_degree <= 3:
        raise UserError(
            f"train: {iterations} iterations, {max_gaussians} Gaussians and SH degree {sh_degree};"
            " give at least 1, at least 100, and 0 to 3"
        )
    say = stage or (lambda _text: None)
    say(f"reading {posed}")
    photos = read_views(posed, max_side=max_side)
    background = background or backdrop_colour(photos)
    views = tuple(laid_over(view, background) for view in photos)
    held_out = [len(views) >= _HOLD_OUT_EVERY and number % _HOLD_OUT_EVERY == 0 for number in range(len(views))]
    cut_out = all(view.alpha is not None for view in photos)
    chosen = [view for view, out in zip(photos if cut_out else views, held_out, strict=True) if not out]
    start = rough_cloud(chosen, count=max(100, max_gaussians // 3), sh_degree=sh_degree, seed=seed, device=device)
    options = FinetuneOptions(
        iterations=iterations,
        # Short runs cannot wait for the rates of 30,000 steps.
        rates=Rates(means=1.6e-4 * min(4.0, max(1.0, 30_000 / iterations) ** 0.5)),
        background=None if cut_out else background,
        densification=Densification.RELOCATION,
        max_gaussians=max_gaussians,
        seed=seed,
        threads=threads,
    )
    say(f"training on {len(chosen)} photos (the first run compiles kernels: up to a minute)")
    result = finetune(start, chosen, options=options, progress=progress)
    say("judging every photo")
    scores = tuple(
        _score(result.cloud, view, background, held_out=out, threads=threads)
        for view, out in zip(views, held_out, strict=True)
    )
    return TrainResult(result.cloud, result.losses, views, scores, background)


def _score(
    cloud: GaussianCloud,
    view: TrainingView,
    background: tuple[float, float, float],
    *,
    held_out: bool,
    threads: int | None,
) -> PhotoScore:
    picture = np.clip(render(cloud, view.camera, background=background, threads=threads).colour.numpy(), 0, 1)
    likeness = float(ssim(torch.as_tensor(picture), torch.as_tensor(view.image)))
    return PhotoScore(view.name, held_out, psnr(picture, view.image), likeness)


def read_views(posed: Path | str, *, max_side: int | None = None) -> list[TrainingView]:
    """Photos and cameras; photos larger than ``max_side`` pixels are reduced.

    Alpha is the photo's own or, as COLMAP has it, that of ``masks/PHOTO.png`` (or ``masks/`` with the photo's own name)
    beside the photos' folder: white is kept. Raises ``UserError`` for a photo or mask that is unreadable or of another
    shape than its camera, and for a missing photo.
    """
    views = []
    for entry in read_cameras(posed):
        if entry.image is None:
            raise UserError(f"{posed}: the photo {entry.name} is not beside the poses; put the images there")
        pixels = cv2.imread(str(entry.image), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise UserError(f"{entry.image}: not a readable picture; export it again as PNG or JPEG")
        full = {"uint8": 255.0, "uint16": 65535.0}.get(pixels.dtype.name, 1.0)
        values = np.atleast_3d(np.asarray(pixels, dtype=np.float32)) / full
        colour = values[:, :, :3][:, :, ::-1] if values.shape[2] >= 3 else np.repeat(values[:, :, :1], 3, axis=2)
        alpha = values[:, :, 3] if values.shape[2] == 4 else _mask_of(entry.image, entry.name, colour.shape[:2])
        camera = _scaled(entry.camera, colour.shape[1], colour.shape[0], entry.image)
        side = max(camera.width, camera.height)
        if max_side is not None and side > max_side:
            width, height = (max(1, round(s * max_side / side)) for s in (camera.width, camera.height))
            if alpha is not None:
                # Transparent pixels hold any colour: it must not bleed into their neighbours.
                colour = cv2.resize(colour * alpha[:, :, None], (width, height), interpolation=cv2.INTER_AREA)
                alpha = cv2.resize(alpha, (width, height), interpolation=cv2.INTER_AREA)
                colour = colour / np.maximum(alpha, 1e-6)[:, :, None]
            else:
                colour = cv2.resize(colour, (width, height), interpolation=cv2.INTER_AREA)
            camera = _scaled(camera, width, height, entry.image, exact=False)
        image = np.ascontiguousarray(colour, dtype=np.float32)
        views.append(TrainingView(camera, image, alpha, name=entry.name))
    return views


def _mask_of(image: Path, name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """(H, W) float32 from the photo's mask file, if there is one."""
    # COLMAP's names may hold folders, which the masks repeat.
    depth = min(len(Path(name).parts), len(image.parents) - 1)
    relative = image.relative_to(image.parents[depth - 1])
    places = (
        place
        for folder, file in ((image.parents[depth] / "masks", relative), (image.parent.parent / "masks", image.name))
        for place in (folder / f"{file}.png", (folder / file).with_suffix(".png"), folder / file)
    )
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        return None
    pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise UserError(f"{path}: not a readable picture; export the mask again")
    if pixels.shape != shape:
        raise UserError(
            f"{path}: {pixels.shape[1]} x {pixels.shape[0]} pixels, but its photo has {shape[1]} x {shape[0]};"
            " make the mask from the same photo"
        )
    return pixels.astype(np.float32) / 255.0


def laid_over(view: TrainingView, background: tuple[float, float, float]) -> TrainingView:
    """``view`` without alpha, its picture over one colour."""
    if view.alpha is None:
        return view
    alpha = view.alpha[:, :, None]
    behind = np.asarray(background, dtype=np.float32)
    return replace(view, image=view.image * alpha + (1 - alpha) * behind, alpha=None)


def backdrop_colour(views: Sequence[TrainingView]) -> tuple[float, float, float]:
    """White for photos with alpha; else the mean colour along the borders of all photos."""
    if any(view.alpha is not None for view in views):
        return (1.0, 1.0, 1.0)
    rims = []
    for view in views:
        image = view.image
        rims.append(np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]).mean(axis=0))
    red, green, blue = np.mean(rims, axis=0).tolist()
    return (red, green, blue)


def _scaled(camera: Camera, width: int, height: int, image: Path, *, exact: bool = True) -> Camera:
    """The camera for its photo at another size; poses are often of the full photo and images reduced."""
    x, y = width / camera.width, height / camera.height
    if exact and abs(x / y - 1) > 0.01:
        raise UserError(
            f"{image}: {width} x {height} pixels, but its camera has {camera.width} x {camera.height};"
            " use the photos that the poses were made from"
        )
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=camera.cx * x,
        cy=camera.cy * y,
    )


def middle_of(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) the point nearest to all optical axes, in the least-squares sense."""
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    return np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centres), rcond=None)[0]


def rough_cloud(
    views: Sequence[TrainingView], *, count: int, sh_degree: int, seed: int = 0, device: str | None = None
) -> GaussianCloud:
    """``count`` round Gaussians, spread evenly over the region that most cameras see, in the colours they see there.

    Of many random points those are kept on whose colour the views agree best, and where all views have alpha only those
    inside of all silhouettes: a rough visual and photometric hull.
    """
    centres = np.array([view.camera.centre for view in views])
    focus = middle_of([view.camera for view in views])
    distance = float(np.median(np.linalg.norm(centres - focus, axis=1)))
    reach = np.median([0.5 * max(v.camera.width / v.camera.fx, v.camera.height / v.camera.fy) for v in views])
    random = np.random.default_rng(seed)
    low, high = focus - distance * min(float(reach), 1.0), focus + distance * min(float(reach), 1.0)
    points = random.uniform(low, high, (8 * count, 3))
    sight = _Sight.of(points, views)
    if sight.solid.any():
        # The object may fill little of what the cameras see: look again, around it alone.
        margin = 0.05 * (high - low)
        low, high = points[sight.solid].min(axis=0) - margin, points[sight.solid].max(axis=0) + margin
        points = random.uniform(low, high, (8 * count, 3))
        sight = _Sight.of(points, views)
    kept = np.flatnonzero(sight.solid if sight.solid.any() else sight.often)
    if len(kept) == 0:
        raise UserError("train: the cameras do not look at a place in common; check the poses")
    # Empty space before a plain backdrop agrees as well as a surface does; half of the points are kept at random.
    best = kept[np.argsort(sight.spread[kept], kind="stable")][: count // 2]
    rest = random.permutation(np.setdiff1d(kept, best))[: count - len(best)]
    chosen = np.concatenate([best, rest])
    means = points[chosen]
    volume = float(np.prod(high - low)) * len(kept) / len(points)
    spacing = 0.5 * (volume / len(means)) ** (1 / 3)
    sh = np.zeros((len(means), (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (sight.colour[chosen] - 0.5) / SH_BAND_0
    return GaussianCloud.from_numpy(
        means,
        np.tile([1.0, 0, 0, 0], (len(means), 1)),
        np.full((len(means), 3), np.log(spacing)),
        np.full(len(means), np.log(0.1 / 0.9)),
        sh,
        device=device,
    )


@dataclass(frozen=True)
class _Sight:
    """How all views together see each of n points."""

    colour: np.ndarray
    """(n, 3) mean over the views that see it."""
    spread: np.ndarray
    """(n,) standard deviation of the colour."""
    often: np.ndarray
    """(n,) bool: seen by at least half as many views as any other point."""
    solid: np.ndarray
    """(n,) bool: seen often, and inside of the silhouettes; nowhere, unless all views have alpha."""

    @classmethod
    def of(cls, points: np.ndarray, views: Sequence[TrainingView]) -> _Sight:
        sums, squares = np.zeros((len(points), 3)), np.zeros((len(points), 3))
        seen, alpha = np.zeros(len(points)), np.zeros(len(points))
        for view in views:
            camera = view.camera
            p = points @ camera.rotation.T + camera.translation
            ahead = p[:, 2] > camera.near
            z = np.where(ahead, p[:, 2], 1.0)
            column = np.floor(camera.fx * p[:, 0] / z + camera.cx)
            row = np.floor(camera.fy * p[:, 1] / z + camera.cy)
            inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            pixel = row[inside].astype(int), column[inside].astype(int)
            sums[inside] += view.image[pixel]
            squares[inside] += view.image[pixel] ** 2
            seen[inside] += 1
            if view.alpha is not None:
                alpha[inside] += view.alpha[pixel]
        known = np.maximum(seen, 1)
        mean = sums / known[:, None]
        often = seen >= max(0.5 * seen.max(), 1)
        return cls(
            colour=mean,
            spread=np.sqrt(np.maximum(squares / known[:, None] - mean**2, 0).sum(axis=1)),
            often=often,
            # One mask in ten may cut a little off.
            solid=often & (alpha > 0.9 * known),
        )
