"""Clearing of the plane: the object's Gaussians that straddle the plane are fine-tuned with L_seg, split or removed.

The kernels are in ``egs_warp/kernels/segmentation/clearance.py``.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from egs_warp.checked_calls import NonNegative, PositiveCount, Range, Seed, checked_constructor
from egs_warp.deformation.splitting import SplitRule, child_layout, child_opacities
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.camera_ring import ring_cameras
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud, concatenate
from egs_warp.geometry.plane import Plane
from egs_warp.kernels.deformation.splitting import split_kernel
from egs_warp.kernels.segmentation.clearance import extent_kernel, half_space_kernel
from egs_warp.launching import available_threads, empty, launch_rows
from egs_warp.render.projection import project, view_from_camera
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.segmentation.plane_fit import plane_depth

if TYPE_CHECKING:
    from egs_warp.training.gaussian_tensors import GaussianTensors
    from egs_warp.training.training_view import TrainingView

GAMMA = 3.0
"""Extent of a Gaussian, in standard deviations, as in Eq. (3)."""
_MIN_CROP = 16
"""Minimum side of a cropped view, pixels."""


class ExtentMeasure(enum.Enum):
    """Measure of a Gaussian's extent towards the plane."""

    AXIS_TIPS = "axis-tips"
    """Distance to the farthest of the six axis tips of the ellipsoid, Eq. (20)."""
    ELLIPSOID = "ellipsoid"
    """The extent of the ellipsoid along the normal, gamma sqrt(N^T Sigma N), which is up to sqrt 3 times the extent of
    the tips."""


class StraddlingPolicy(enum.Enum):
    """Handling of the object's Gaussians that straddle its plane."""

    NONE = "none"
    """Leave them unchanged."""
    REMOVE = "remove"
    """Remove them."""
    FINETUNE = "finetune"
    """Train them to shrink and move until they are clear of the plane, while renders of the object stay the same (Eq.
    21)."""
    SPLIT = "split"
    """Replace each by its part above the plane."""


@checked_constructor
@dataclass(frozen=True, kw_only=True)
class StraddlingOptions:
    """Options of ``StraddlingPolicy.FINETUNE``."""

    iterations: PositiveCount = 100
    reach: ExtentMeasure = ExtentMeasure.ELLIPSOID
    weight: NonNegative = 0.3
    """Weight of L_seg relative to the photometric loss; the results for 0.3 and 3 differ by at most 0.4 dB."""
    subdivisions: Annotated[int, Range(0, 20)] = 5
    """Maximum number of rounds, before training, in which each straddling Gaussian is split in three across the plane.
    Smaller Gaussians can lie closer to the plane without crossing it. The paper uses no such rounds (0)."""
    fine_reach: NonNegative = 0.006
    """Extent across the plane, as a fraction of the object's height, up to which Gaussians are not split further."""
    max_growth: NonNegative = 0.25
    """Maximum number of Gaussians that these splits add, as a fraction of the number in the object. The Gaussians that
    extend farthest across the plane are split first. Without this limit, each round doubles the number of straddling
    Gaussians."""
    cut_rest: bool = True
    """True to cut Gaussians that still straddle the plane after training, as ``SPLIT`` does; the paper does not cut
    them."""
    seed: Seed = 0


def plane_extents(
    cloud: GaussianCloud, plane: Plane, reach: ExtentMeasure = ExtentMeasure.ELLIPSOID
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the height d0 of each mean above the plane and the extent eta_seg along its normal, Eq. (20).

    A Gaussian straddles the plane if |d0| < eta_seg.

    Returns:
        d0 (n,) and eta_seg (n,), scene units.
    """
    count, device = cloud.count, cloud.device
    outputs = [empty(count, wp.float32, device) for _ in range(3)]
    launch_rows(
        extent_kernel,
        count,
        inputs=[wp.vec3(*plane.normal.tolist()), plane.offset, cloud.means, cloud.rotations, cloud.log_scales],
        outputs=outputs,
        device=device,
    )
    heights, tips, deviation = (output.numpy().astype(np.float64) for output in outputs)
    return heights, GAMMA * (tips if reach is ExtentMeasure.AXIS_TIPS else deviation)


def clear_plane(
    cloud: GaussianCloud,
    plane: Plane,
    method: StraddlingPolicy,
    *,
    cameras: Sequence[Camera] = (),
    views: Sequence[TrainingView] | None = None,
    surroundings: GaussianCloud | None = None,
    options: StraddlingOptions | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> GaussianCloud:
    """Treat the straddling Gaussians of ``cloud``, an object above ``plane``, with ``method``.

    ``FINETUNE`` compares the object with renders of its unchanged part above the plane, or with photographs of the
    whole scene. Gaussians whose means are below the plane after training are removed; if that applies to all Gaussians,
    the straddling ones are split instead. The result has at most ``1 + max_growth`` times as many Gaussians as
    ``cloud``.

    Args:
        cloud: Gaussians of the object, scene units.
        plane: the plane under the object.
        method: treatment of the straddling Gaussians.
        cameras: cameras of the renders; by default a ring around the object's foot.
        views: photographs, instead of renders.
        surroundings: the rest of the scene, which is rendered together with the object for the comparison with
            ``views`` but not trained.
        options: see ``StraddlingOptions``.
        progress: called with the index and loss of each training step.

    Raises:
        UserError: no Gaussian is left.
    """
    options = options or StraddlingOptions()
    heights, reach = plane_extents(cloud, plane, options.reach)
    straddling = np.abs(heights) < reach
    if method is StraddlingPolicy.NONE or not straddling.any():
        return cloud
    if method is StraddlingPolicy.REMOVE:
        return _nonempty_subset(cloud, ~straddling, "all of them straddle the plane and are removed")
    if method is StraddlingPolicy.SPLIT:
        return half_space(cloud, plane, straddling)
    if views is None:
        views = views_above(cloud, plane, cameras or foot_ring(cloud, plane))
    fine = cloud
    fine_reach = options.fine_reach * float(np.quantile(heights, 0.998))
    max_count = int((1.0 + options.max_growth) * cloud.count)
    for _ in range(options.subdivisions):
        fine = _subdivided(fine, plane, options.reach, fine_reach, max_count)
    tuned = _finetuned(fine, plane, views, surroundings, options, progress)
    above = plane.heights(tuned.means.numpy()) > 0.0
    if not above.any():
        return half_space(cloud, plane, straddling)
    tuned = tuned.subset(above)
    heights, reach = plane_extents(tuned, plane, options.reach)
    rest = np.abs(heights) < reach
    return half_space(tuned, plane, rest) if options.cut_rest and rest.any() else tuned


def half_space(cloud: GaussianCloud, plane: Plane, chosen: np.ndarray) -> GaussianCloud:
    """Return ``cloud`` with each of the ``chosen`` (n,) bool Gaussians replaced by its part above the plane.

    Mass, mean and covariance follow from truncating a normal distribution at the plane. With t = -d0 / sigma and l =
    pdf(t) / (1 - cdf(t)), the mean is m + l Sigma N / sigma, and the covariance is Sigma - l (l - t) Sigma N N^T Sigma
    / sigma^2.
    """
    source = np.flatnonzero(chosen).astype(np.int32)
    device = cloud.device
    shapes: list[tuple[str, Any]] = [
        ("means", wp.vec3),
        ("rotations", wp.vec4),
        ("log_scales", wp.vec3),
        ("opacity_logits", wp.float32),
    ]
    parts = [wp.empty(len(source), dtype=dtype, device=device) for _, dtype in shapes]
    launch_rows(
        half_space_kernel,
        len(source),
        inputs=[
            wp.vec3(*plane.normal.tolist()),
            plane.offset,
            wp.array(source, dtype=wp.int32, device=device),
            *(getattr(cloud, name) for name, _ in shapes),
        ],
        outputs=parts,
        device=device,
    )
    values = {name: getattr(cloud, name).numpy().copy() for name, _ in shapes}
    for (name, _), part in zip(shapes, parts, strict=True):
        values[name][source] = part.numpy()
    return GaussianCloud.from_numpy(**values, sh=cloud.sh.numpy(), antialiased=cloud.antialiased, device=str(device))


def views_above(cloud: GaussianCloud, plane: Plane, cameras: Sequence[Camera]) -> list[TrainingView]:
    """Render ``cloud`` alone. The valid pixels are those that show something above the plane, and those that show
    nothing at all."""
    from egs_warp.training.training_view import TrainingView

    views = []
    for camera in cameras:
        image = render_gaussians(cloud, camera, background=(0.0, 0.0, 0.0))
        alpha, depth = image.alpha.numpy(), image.depth.numpy()
        colour = np.clip(image.colour.numpy() / np.maximum(alpha, 1e-6)[..., None], 0.0, 1.0)
        behind = plane_depth(plane, camera)
        hidden = (behind > 0.0) & (depth > behind) & (alpha > 0.0)
        if plane.heights(camera.centre) <= 0.0:
            hidden |= (behind > 0.0) & (alpha > 0.0)
        views.append(TrainingView(camera, colour, alpha=alpha, weight=(~hidden).astype(np.float32)))
    return views


def foot_ring(cloud: GaussianCloud, plane: Plane, *, size: int = 256) -> list[Camera]:
    """Return low cameras around the part of ``cloud`` that is near the plane."""
    means = cloud.means.numpy().astype(np.float64)
    heights = plane.heights(means)
    low = means[heights < np.quantile(heights, 0.002) + 0.08 * np.ptp(np.quantile(heights, [0.002, 0.998]))]
    centre = np.median(low, axis=0)
    radius = float(np.quantile(np.linalg.norm(low - centre, axis=1), 0.98))
    return ring_cameras(plane, centre, 1.1 * radius, elevations=(1.0, 10.0, 25.0), size=size)


def _subdivided(
    cloud: GaussianCloud, plane: Plane, reach: ExtentMeasure, fine_reach: float, max_count: int
) -> GaussianCloud:
    """Split each straddling Gaussian that extends across the plane by more than ``fine_reach`` (scene units) into
    three, along the axis that extends farthest. The Gaussians that extend farthest are split first, until there are
    ``max_count`` Gaussians. Children with means below the plane are removed."""
    offsets, shrink = child_layout(SplitRule.MEASURED)
    heights, extent = plane_extents(cloud, plane, reach)
    parents = np.flatnonzero((np.abs(heights) < extent) & (extent > fine_reach))
    farthest = np.argsort(-extent[parents], kind="stable")
    parents = np.sort(parents[farthest[: max(max_count - cloud.count, 0) // (len(offsets) - 1)]])
    if len(parents) == 0:
        return cloud
    unchanged = np.setdiff1d(np.arange(cloud.count), parents)
    rotations_of_parents = Rotation.from_quat(cloud.rotations.numpy()[parents][:, [1, 2, 3, 0]]).as_matrix()
    along = np.abs(np.einsum("nij,i->nj", rotations_of_parents, plane.normal)) * np.exp(
        cloud.log_scales.numpy()[parents]
    )
    source = np.concatenate([unchanged, np.repeat(parents, len(offsets))]).astype(np.int32)
    axis, step = np.full(len(source), -1, np.int32), np.zeros(len(source), np.float32)
    axis[len(unchanged) :] = np.repeat(along.argmax(axis=1), len(offsets))
    step[len(unchanged) :] = np.tile(offsets, len(parents))
    peaks = np.clip(child_opacities(cloud.opacities()[parents], SplitRule.MEASURED), 1e-6, 1.0 - 1e-6).ravel()
    logits = cloud.opacity_logits.numpy()[source]
    logits[len(unchanged) :] = np.log(peaks / (1.0 - peaks))
    fields = [cloud.means, cloud.rotations, cloud.log_scales, cloud.sh]
    shapes = [len(source), len(source), len(source), (len(source), cloud.sh.shape[1])]
    with wp.ScopedDevice(cloud.device):
        plan = [wp.array(values) for values in (source, axis, step)]
        out = [wp.empty(shape, dtype=field.dtype) for shape, field in zip(shapes, fields, strict=True)]
        means, rotations, log_scales, sh = out
        split = GaussianCloud(means, rotations, log_scales, wp.array(logits), sh, cloud.antialiased)
    launch_rows(split_kernel, len(source), inputs=[*plan, shrink, *fields], outputs=out, device=cloud.device)
    return _nonempty_subset(
        split, plane.heights(split.means.numpy()) > 0.0, "after splitting all of their means lie below the plane"
    )


def _nonempty_subset(cloud: GaussianCloud, chosen: np.ndarray, reason: str) -> GaussianCloud:
    """Return the ``chosen`` (n,) bool Gaussians. Raises ``UserError`` with the ``reason`` if there are none."""
    if not chosen.any():
        raise UserError(
            f"clear: none of the object's {cloud.count} Gaussians is left: {reason}; clear with another method (split)",
            check=("plane",),
        )
    return cloud.subset(chosen)


def _finetuned(
    cloud: GaussianCloud,
    plane: Plane,
    views: Sequence[TrainingView],
    surroundings: GaussianCloud | None,
    options: StraddlingOptions,
    progress: Callable[[int, float], None] | None,
) -> GaussianCloud:
    # Import torch here, because it is slow to import and needed only here.
    import torch

    from egs_warp.training.finetune import FinetuneOptions, finetune

    heights, reach = plane_extents(cloud, plane, options.reach)
    straddling = np.abs(heights) < reach
    if not straddling.any():
        return cloud
    whole = cloud if surroundings is None else concatenate(cloud, surroundings)
    scale = float(np.median(reach[straddling]))
    # Gaussians just above the plane are trained, too, so that they can take over the appearance of the straddling ones.
    free = np.zeros(whole.count, bool)
    free[: cloud.count] = heights < 3.0 * scale
    views = _cropped(views, cloud.subset(free[: cloud.count]))
    # Most parts of a large object, and of its surroundings, are outside all views of its foot.
    shown = free | _in_pictures(whole, [view.camera for view in views])
    trained, free = whole.subset(shown), free[shown]
    near = torch.as_tensor(np.flatnonzero(free), device=wp.device_to_torch(cloud.device))
    normal = torch.tensor(plane.normal, dtype=torch.float32, device=near.device)

    def extra(tensors: GaussianTensors) -> torch.Tensor:
        loss = straddling_loss(tensors, near, normal, plane.offset, options.reach)
        return options.weight / (scale * int(straddling.sum())) * loss

    # Composite pictures with transparency over random colours, so that no Gaussian can hide in front of a background of
    # its own colour.
    cut_out = all(view.alpha is not None for view in views)
    result = finetune(
        trained,
        views,
        options=FinetuneOptions(
            iterations=options.iterations, background=None if cut_out else (0.0, 0.0, 0.0), seed=options.seed
        ),
        extra_loss=extra,
        trainable=free,
        progress=progress,
    )
    own = np.flatnonzero(shown[: cloud.count])
    values = {name: getattr(cloud, name).numpy().copy() for name in ARRAYS}
    for name, array in values.items():
        array[own] = getattr(result.cloud, name).numpy()[: len(own)]
    return GaussianCloud.from_numpy(**values, antialiased=cloud.antialiased, device=str(cloud.device))


def _cropped(views: Sequence[TrainingView], foot: GaussianCloud) -> list[TrainingView]:
    """Crop ``views`` to the Gaussians ``foot`` and omit views that do not show them. Return ``views`` unchanged if none
    shows them."""
    means, radii = foot.means.numpy().astype(np.float64), GAMMA * np.exp(foot.log_scales.numpy().max(axis=1))
    crops = []
    for view in views:
        camera = view.camera
        across, down, depth = camera.rotation @ means.T + camera.translation[:, None]
        ahead = depth > np.maximum(camera.near, radii)
        if not ahead.any():
            continue
        low, high = [], []
        for focal, middle, offset, side in (
            (camera.fx, camera.cx, across, camera.width),
            (camera.fy, camera.cy, down, camera.height),
        ):
            places, reach = middle + focal * offset[ahead] / depth[ahead], focal * radii[ahead] / depth[ahead]
            low.append(int(np.clip(np.floor((places - reach).min()), 0, side)))
            high.append(int(np.clip(np.ceil((places + reach).max()), 0, side)))
        (left, top), (right, bottom) = low, high
        if min(right - left, bottom - top) < _MIN_CROP:
            continue
        box = slice(top, bottom), slice(left, right)
        window = replace(camera, width=right - left, height=bottom - top, cx=camera.cx - left, cy=camera.cy - top)
        alpha, weight = (None if one is None else one[box] for one in (view.alpha, view.weight))
        crops.append(replace(view, camera=window, image=view.image[box], alpha=alpha, weight=weight))
    return crops or list(views)


def _in_pictures(cloud: GaussianCloud, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the mask (n,) bool of Gaussians that reach the picture of one of the ``cameras``, even if others hide
    them."""
    reached, threads = np.zeros(cloud.count, bool), available_threads()
    for camera in cameras:
        projected = project(cloud, view_from_camera(camera), antialiased=cloud.antialiased, threads=threads)
        reached |= np.diff(projected.slot_end.numpy(), prepend=0) > 0
    return reached


def straddling_loss(tensors: GaussianTensors, near: Any, normal: Any, offset: float, reach: ExtentMeasure) -> Any:
    """Return L_seg (Eq. 21), the sum of eta_seg - |d0| over the Gaussians with indices ``near`` (m,) that straddle the
    plane.

    The result is a scalar tensor, scene units; ``normal`` (3,) and ``offset`` are those of the plane.
    """
    import torch

    q = torch.nn.functional.normalize(tensors.rotations[near], dim=1)
    w, v = q[:, :1], q[:, 1:]
    # Express N in the axes of each Gaussian, by a rotation with the conjugate quaternion.
    n = normal.expand_as(v)
    local_normal = n + 2.0 * torch.cross(-v, torch.cross(-v, n, dim=1) + w * n, dim=1)
    along = local_normal * torch.exp(tensors.log_scales[near])
    eta = GAMMA * (
        along.abs().amax(dim=1) if reach is ExtentMeasure.AXIS_TIPS else (along.square().sum(dim=1) + 1e-20).sqrt()
    )
    height = tensors.means[near] @ normal + offset
    return torch.relu(eta - height.abs()).sum()
