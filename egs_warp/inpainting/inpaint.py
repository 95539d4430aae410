"""Create new floor where the object stood: flat Gaussians on the plane, coloured by a 2D inpainter in a face-on view.

Paper section 3.7: the depth of the hole comes from the plane, Eq. (18); a dense cloud of flat Gaussians is placed there
and trained for about 100 steps against the inpainted picture. The kernels are in ``egs_warp/kernels/inpainting``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import warp as wp
from scipy import ndimage

from egs_warp.checked_calls import Count, Range, Seed, checked_constructor
from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.bitmaps import connected_parts, depth_inside, distance_to
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud, concatenate
from egs_warp.inpainting.holes import Hole
from egs_warp.inpainting.inpainters import Inpainter, OpenCvInpainter
from egs_warp.inpainting.new_floor import flat_gaussians, rim_heights, with_gloss
from egs_warp.inpainting.patch_synthesis import PatchSynthesis, painting_time
from egs_warp.inpainting.rectified import PlaneWindow, RectifiedImage, diffuse_only, rectify
from egs_warp.inpainting.stains import shaded, stain_around
from egs_warp.installation import install_command
from egs_warp.segmentation.plane_search import near_plane

_MARGIN = 0.01
"""Fraction of the hole's side by which the hole is enlarged, because the object and its shadow stain the floor at the
hole's edge. Gaps in the floor that touch the hole are always added. With a fraction of 0.03 or more, a sheet under a
plush toy loses part of its edge."""
_THICKNESS = 0.15
"""Distance from the plane within which Gaussians are floor, as a fraction of the hole's side."""
_HAZE = 0.25
"""Height below which Gaussians over the hole are floor, or haze at the object's foot, as a fraction of the hole's
side."""
_KNOWN = 0.6
"""Minimum opacity of the floor at which its colour is known."""
_SOLID = 0.3
"""Minimum opacity at which a Gaussian near the plane counts as floor."""
_TEXELS_ACROSS = 120.0
"""Number of texels along the side of a hole of any size, so that the computing time does not depend on the size."""
_WINDOW = 3.0
"""Side of the window as a multiple of the hole's side. The window contains the hole and the floor to copy from."""
_SHARPNESS = 0.5
"""Spacing of the new Gaussians as a fraction of the width of the floor's fine Gaussians."""
_MAX_SPACING = 3
"""Largest spacing of new Gaussians, texels."""
_RIM = 12
"""Width of the rim around the hole that takes part in the training, texels."""
_GAP_REACH = 0.25
"""Maximum distance of gaps from the hole, as a fraction of the hole's side. Gaps farther away remain open."""
_GAP_EDGE = 6.0
"""Width, in texels, of the unreliable floor around a gap; it is filled with the gap."""
_CHANNEL = 9.0
"""Half width, in texels. A channel narrower than this does not connect a gap to the empty space beyond the floor."""
_EDGE_BAND = 0.1
"""Distance from the edge of the floor within which Gaussians below it are the side of a table or a pedestal, as a
fraction of the hole's side."""
_MIN_RIM_FRACTION = 0.4
"""Minimum fraction of the hole's edge that must be floor."""
_MAX_ISLAND_AREA = 0.15
"""Area below which an island of floor inside the hole is discarded, as a fraction of the hole's area."""
_COLOUR_WEIGHT = 4.0
"""Weight of the squared distance between a Gaussian's colour and the painted colour."""
_RECTIFY_COST = 0.9
"""Processor time of rendering the face-on picture, s; measured on a CPU: 0.8 to 1.2 s for koala, fox, narcissus and
pawn."""
_STEP_COST, _STEP_COST_PER_GAUSSIAN = 0.022, 1e-6
"""Processor time of a training step, s: constant part, and part per new Gaussian. Measured in total: 0.03 to 0.04 s."""
_GROWTH = 1.4
"""Ratio of the filled area, which includes gaps and stains, to the area of the hole; measured: 1.5 for the koala, 1.4
for the fox."""
_HOLE_AREA, _HOLE_DEPTH = 0.6, 0.35
"""Assumed area and half width of a hole that is not known yet, relative to area and side of its bounding square."""


@checked_constructor
@dataclass(frozen=True, kw_only=True)
class InpaintOptions:
    """Options of ``inpaint``."""

    steps: Count = 100
    """Training steps against the inpainted picture. With 0 there is no training, and PyTorch is not needed."""
    margin: Annotated[float, Range(0.0, 1.0, "a fraction of the side of the hole")] = _MARGIN
    """Fraction of the hole's side by which the hole is enlarged."""
    seed: Seed = 0


@dataclass(frozen=True)
class InpaintResult:
    """A background with new floor."""

    cloud: GaussianCloud
    """Background with the new floor, scene units; first the retained Gaussians, then the new ones."""
    is_new: np.ndarray
    """(n,) bool, True for new Gaussians."""
    is_retained: np.ndarray
    """(m,) bool, True for the Gaussians of the background that were retained; the others lay in the hole."""
    window: PlaneWindow
    """Window of the face-on view."""
    hole: np.ndarray
    """(rows, columns) bool, the hole, filled with new floor, on the window."""
    before: RectifiedImage
    """Face-on picture of the floor before the hole is filled."""
    painted: np.ndarray
    """(rows, columns, 3) float32, the inpainter's result."""
    seconds: dict[str, float]
    """Duration of each stage, s."""
    notes: tuple[str, ...]
    """Messages for the user."""

    @property
    def removed(self) -> int:
        """Number of Gaussians removed from the background because they lay in the hole."""
        return int((~self.is_retained).sum())


def inpaint(
    background: GaussianCloud,
    hole: Hole,
    *,
    inpainter: Inpainter | None = None,
    options: InpaintOptions | None = None,
    progress: Callable[[float], None] = lambda done: None,
) -> InpaintResult:
    """Fill ``hole`` in the floor of ``background`` (scene units) with new Gaussians; those in the hole and near it are
    removed.

    Args:
        background: the capture without the object.
        hole: region of the floor to fill.
        inpainter: fills the face-on picture; by default ``PatchSynthesis``, or ``OpenCvInpainter`` if too little floor
            is left to copy from.
        options: see ``InpaintOptions``.
        progress: called with the approximate share of the time that has passed, 0 to 1.

    Raises:
        UserError: the hole is off the floor, too narrow, or leaves no floor to copy from.
    """
    options = options or InpaintOptions()
    synthesis = PatchSynthesis(seed=options.seed, device=str(background.device))
    clock = _Clock()
    window, grown, spacing = _window_around(background, hole, options.margin)
    side = hole.bounds()[1]
    thickness = _THICKNESS * side
    junk = _in_hole(background, window, grown, side)
    if junk.all():
        raise UserError("inpaint: the hole covers the whole capture; make it smaller")
    retained = background.subset(~junk)
    before = rectify(retained, window, thickness=thickness)
    grown, known, void = _closed(grown, before.alpha)
    _check(grown, known)
    # The added gaps contain haze, too. Gaussians below the edge of the floor are the side of a table or a pedestal.
    inner = grown & (distance_to(void) > _EDGE_BAND * _TEXELS_ACROSS) if void.any() else grown
    junk = _in_hole(background, window, inner, side)
    grown, known, stained = _without_stain(grown, known, before)
    junk |= _in_hole(background, window, grown, side, depth=_THICKNESS)
    if junk.all():
        raise UserError("inpaint: the hole covers the whole capture; make it smaller")
    retained = background.subset(~junk)
    clock.lap("rectify")
    paint_cost = painting_time(
        float(grown.sum()), float(depth_inside(grown).max()), float(depth_inside(known & ~grown).max())
    )
    train_cost = _training_time(float(grown.sum()) / spacing**2, options.steps)
    train_start = _RECTIFY_COST + paint_cost
    total_cost = train_start + train_cost
    show_painting = lambda done: progress((_RECTIFY_COST + paint_cost * done) / total_cost)  # noqa: E731
    show_painting(0.0)
    # Without a stain around the hole there is no shadow, and dark floor may be copied into the hole.
    shade = shaded(grown, known, before.colour) if stained else None
    image = np.where(known[..., None], before.colour, 0.0)
    notes: tuple[str, ...] = ()
    try:
        painted = (inpainter or synthesis).fill(image, grown, known, shade, progress=show_painting)
    except UserError as error:
        if inpainter is not None:
            raise
        # The remaining floor is narrower than a patch everywhere.
        painted = OpenCvInpainter().fill(image, grown, known)
        notes = (f"the colours around the hole were continued smoothly ({error})",)
    clock.lap("inpaint")
    new = flat_gaussians(
        window,
        grown,
        known,
        painted,
        rim_heights(before, grown, known),
        spacing=spacing,
        device=str(background.device),
    )
    if new is None:
        raise UserError(
            f"inpaint: the hole is too narrow: its {int(grown.sum())} texels fill no more than half of any block of"
            f" {spacing} x {spacing} texels, and each new Gaussian needs more; make it wider"
        )
    new = replace(new, antialiased=background.antialiased)
    if options.steps > 0:
        progress(train_start / total_cost)
        show_training = lambda step, _: progress(  # noqa: E731
            (train_start + train_cost * (step + 1) / options.steps) / total_cost
        )
        new = _trained(retained, new, window, grown, painted, thickness, options, show_training)
    clock.lap("train")
    floor = near_plane(retained, window.plane, thickness) & retained.visible(_SOLID)
    if not floor.any():
        raise UserError(
            f"inpaint: no floor is left around the hole: {retained.count} Gaussians remain, but no visible"
            f" one is within {thickness:.3g} scene units of the plane; make the hole smaller or check plane and hole"
        )
    new = with_gloss(new, retained.subset(floor), window)
    cloud = concatenate(retained, new)
    clock.lap("join")
    notes += (
        f"{int(junk.sum())} Gaussians in the hole were replaced by {new.count} on the plane",
        f"the hole is {grown.sum() * window.texel**2:.3g} square scene units; a texel is {window.texel:.3g} wide",
        *((f"{100 * stained:.0f} % of the hole was floor stained by the object's shadow or foot",) if stained else ()),
    )
    is_new = np.arange(cloud.count) >= retained.count
    return InpaintResult(cloud, is_new, ~junk, window, grown, before, painted, clock.seconds, notes)


def inpaint_cost(hole: Hole | None, *, steps: int) -> float:
    """Return the expected processor time of ``inpaint`` with ``PatchSynthesis`` on a CPU, s.

    Args:
        hole: the hole; None if it is not known yet.
        steps: number of training steps.
    """
    area, depth = _HOLE_AREA, _HOLE_DEPTH
    if hole is not None:
        side = hole.bounds()[1]
        area, depth = hole.area / side**2, float(depth_inside(hole.mask).max()) * hole.window.texel / side
    texels = min(_GROWTH * area, 1.0) * _TEXELS_ACROSS**2
    return _RECTIFY_COST + painting_time(texels, depth * _TEXELS_ACROSS) + _training_time(texels, steps)


def _training_time(new_count: float, steps: int) -> float:
    """Return the expected processor time of ``steps`` training steps of ``new_count`` new Gaussians, s."""
    return steps * (_STEP_COST + _STEP_COST_PER_GAUSSIAN * new_count)


def _window_around(background: GaussianCloud, hole: Hole, margin: float) -> tuple[PlaneWindow, np.ndarray, int]:
    """Return a window around the hole, the enlarged hole on this window, and the spacing of new Gaussians in texels.

    The spacing is chosen so that the new floor is as sharp as the old one.
    """
    plane = hole.plane
    centre, side = hole.bounds()
    full = side * (1.0 + 2.0 * margin)
    across = round(_WINDOW * _TEXELS_ACROSS)
    window = PlaneWindow(plane, centre, full / _TEXELS_ACROSS, across, across)
    mask = distance_to(hole.drawn_on(window)) <= margin * side / window.texel
    means = background.means.numpy()
    floor = near_plane(background, plane, _THICKNESS * side) & background.visible(_SOLID)
    floor &= window.sample(np.ones(mask.shape, bool), means)
    if not floor.any():
        raise UserError("inpaint: the hole is off the floor: nothing lies on the plane around it; check plane and hole")
    # The smallest axis of a floor's Gaussian is vertical; the middle one limits the detail it can show.
    width = float(np.quantile(background.breadths(floor), 0.25))
    return window, mask, int(np.clip(round(_SHARPNESS * width / window.texel), 1, _MAX_SPACING))


def _in_hole(
    background: GaussianCloud, window: PlaneWindow, mask: np.ndarray, side: float, *, depth: float = 1.0
) -> np.ndarray:
    """Return the mask (n,) bool of the Gaussians in the hole ``mask``: floor, haze over it, and Gaussians under it.

    Gaussians that hang higher are not included. Gaussians below the plane are included down to ``depth`` times the
    ``side`` of the hole (scene units), because they are visible beyond the edge of a thin floor.
    """
    means = background.means.numpy()
    heights = window.plane.heights(means)
    return window.sample(mask, means) & (heights > -depth * side) & (heights < _HAZE * side)


def _closed(mask: np.ndarray, alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the hole enlarged by adjacent gaps and by islands of floor inside it, the known floor, and the empty space
    beyond the edge of the floor; all (rows, columns) bool."""
    # Pinholes between splats are not gaps.
    closed: Any = ndimage.binary_closing(np.pad(alpha > _KNOWN, 4, mode="edge"), iterations=2)
    solid = np.asarray(closed[4:-4, 4:-4])
    near = distance_to(mask) < _GAP_REACH * _TEXELS_ACROSS
    void = _void(~solid & ~mask)
    gaps, _ = connected_parts(mask | (~solid & near & ~void))
    touching = np.isin(gaps, np.unique(gaps[mask])) & ~mask
    hole = mask.copy()
    if touching.any():
        # Next to a gap, floor that becomes thin is stained. The outer half of a narrow rim remains.
        width = np.minimum(_GAP_EDGE, distance_to(void)) if void.any() else _GAP_EDGE
        hole = mask | (distance_to(touching) < width)
    parts, count = connected_parts(~hole)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    islands = (sizes < _MAX_ISLAND_AREA * hole.sum()) & (np.arange(count + 1) > 0)
    hole |= islands[parts]
    return hole, solid & ~hole, void


def _without_stain(hole: np.ndarray, known: np.ndarray, before: RectifiedImage) -> tuple[np.ndarray, np.ndarray, float]:
    """Add the stains around the hole if enough floor remains to copy from.

    Returns the hole and the known floor, both (rows, columns) bool, and the fraction of the enlarged hole that was
    stained.
    """
    stain = stain_around(hole, known, before.colour)
    if not stain.any():
        return hole, known, 0.0
    whole, left, _ = _closed(hole | stain, before.alpha)
    try:
        _check(whole, left)
    except UserError:
        # Copying from stained floor is better than having too little floor to copy from.
        return hole, known, 0.0
    return whole, left, float((whole & ~hole).sum() / whole.sum())


def _void(missing: np.ndarray) -> np.ndarray:
    """Return the mask (rows, columns) bool of the ``missing`` floor that lies beyond the floor's edge. Missing parts
    that are connected to it only by a narrow channel are gaps and are not included."""
    wide, _ = connected_parts(depth_inside(np.pad(missing, 1, mode="edge")) > _CHANNEL)
    edges = np.concatenate([wide[0], wide[-1], wide[:, 0], wide[:, -1]])
    outside = np.isin(wide, np.unique(edges[edges > 0]))[1:-1, 1:-1]
    return missing & (distance_to(outside) <= _CHANNEL + 1.0)


def _check(hole: np.ndarray, known: np.ndarray) -> None:
    if known.sum() < 0.1 * hole.sum():
        raise UserError("inpaint: the hole covers nearly all of the floor; make it smaller or show more of the floor")
    ring = ndimage.binary_dilation(hole, iterations=4) & ~hole
    share = float(known[ring].mean()) if ring.any() else 0.0
    if share < _MIN_RIM_FRACTION:
        raise UserError(
            f"inpaint: the hole is off the floor: only {100 * share:.0f} % of its edge touches visible floor;"
            " check plane and hole"
        )


def _trained(
    retained: GaussianCloud,
    new: GaussianCloud,
    window: PlaneWindow,
    hole: np.ndarray,
    painted: np.ndarray,
    thickness: float,
    options: InpaintOptions,
    progress: Callable[[int, float], None],
) -> GaussianCloud:
    """Train the Gaussians ``new``, together with the floor around the hole, against the inpainted picture. The result
    has SH degree 0."""
    try:
        from egs_warp.training.finetune import FinetuneOptions, LearningRates, finetune
        from egs_warp.training.gaussian_tensors import GaussianTensors
        from egs_warp.training.training_view import TrainingView
    except ImportError as error:
        advice = f"training needs PyTorch; give 0, or install it: {install_command('torch')}"
        raise ArgumentError("steps", advice, value=options.steps) from error

    crop, box = _crop(window, hole)
    nearby = near_plane(retained, window.plane, thickness) & (
        np.abs(crop.pixels(retained.means.numpy()) - 0.5 * np.array([crop.columns, crop.rows])).max(axis=1)
        < max(crop.rows, crop.columns)
    )
    around = diffuse_only(retained.subset(nearby), window.plane) if nearby.any() else None
    whole = concatenate(around, new) if around is not None else new
    trainable = np.arange(whole.count) >= whole.count - new.count
    target = wp.to_torch(new.sh)

    def colour_penalty(tensors: GaussianTensors) -> Any:
        return _COLOUR_WEIGHT * SH_BAND_0**2 * (tensors.sh_band_0[-new.count :] - target).square().mean()

    weight = ndimage.gaussian_filter(hole[box].astype(np.float32), 1.0)
    result = finetune(
        whole,
        [TrainingView(crop.camera(), painted[box], weight=(weight > 0.02) * (0.2 + 0.8 * weight))],
        options=FinetuneOptions(
            iterations=options.steps,
            # Positions and orientations are given by the plane; only the appearance is trained.
            rates=LearningRates(
                means=0.0, rotations=0.0, log_scales=5e-3, opacity_logits=2e-2, sh_band_0=2e-2, sh_rest=0.0
            ),
            background=(0.5, 0.5, 0.5),
            seed=options.seed,
        ),
        extra_loss=colour_penalty,
        trainable=trainable,
        progress=progress,
    )
    trained = result.cloud.subset(trainable)
    # Thickness is not visible face-on, so its training gradient is noise.
    log_scales = trained.log_scales.numpy()
    log_scales[:, 2] = new.log_scales.numpy()[:, 2]
    return GaussianCloud.from_numpy(
        trained.means.numpy(),
        trained.rotations.numpy(),
        log_scales,
        trained.opacity_logits.numpy(),
        trained.sh.numpy(),
        antialiased=trained.antialiased,
        device=str(retained.device),
    )


def _crop(window: PlaneWindow, hole: np.ndarray) -> tuple[PlaneWindow, tuple[slice, slice]]:
    """Return the part of the window that contains the hole and its rim, and its slices of rows and columns."""
    rows, columns = np.nonzero(hole)
    low = np.maximum([rows.min() - _RIM, columns.min() - _RIM], 0)
    high = np.minimum([rows.max() + 1 + _RIM, columns.max() + 1 + _RIM], hole.shape)
    middle = window.points(np.array([[low[1] + high[1], low[0] + high[0]]]) / 2.0)[0]
    size = high - low
    crop = replace(window, centre=middle, rows=int(size[0]), columns=int(size[1]))
    return crop, (slice(low[0], high[0]), slice(low[1], high[1]))


class _Clock:
    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = now - self._last
        self._last = now
