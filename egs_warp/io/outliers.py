"""Removal of erroneous Gaussians: those that are not finite, far away, much larger than the capture, or brighter than
any light.

A single outlier can stall a simulation or overflow single precision. Outliers are detected by bounds that are based on
medians, which outliers do not affect; they are left out and reported.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.limits import MAX_COORDINATE, MIN_LOG_SCALE
from egs_warp.io.raw import RawCapture, property_names

MAX_DISTANCE_RATIO = 1e4
"""Maximum distance from the middle of the capture, in sizes of the capture; a sky can be hundreds of sizes away."""
MAX_SCALE_RATIO = 1e2
"""Maximum standard deviation of a Gaussian, in sizes of the capture."""
MAX_SH = 1e3
"""Maximum SH coefficient; the coefficient of a white surface is 1.8."""
MAX_LOGIT = 500.0
"""Magnitude of an opacity logit above which it is treated as infinite."""
_MAX_OUTLIER_FRACTION = 0.5
_SHOWN = 3


def without_not_finite(raw: RawCapture, source: Path) -> RawCapture:
    """Return ``raw`` without the Gaussians that have values that are not finite; a note states their number.

    An opacity logit may be infinite, and a log scale may be minus infinity for a flat Gaussian. Raises ``UserError``
    for a capture without Gaussians, or if most of them are not finite.
    """
    count = len(raw.means)
    if count == 0:
        raise UserError(f"{source}: it has no Gaussians; export it again from the tool that made it")
    good = np.ones(count, bool)
    examples = []
    for array, names in property_names(raw.sh.shape[1]).items():
        values = getattr(raw, array).reshape(count, len(names))
        if array == "opacity_logits":
            finite = ~np.isnan(values)
        else:
            finite = values < np.inf if array == "log_scales" else np.isfinite(values)
        if finite.all():
            continue
        good &= finite.all(axis=1)
        column = int(np.flatnonzero(~finite.all(axis=0))[0])
        examples.append((int(np.flatnonzero(~finite[:, column])[0]), names[column]))
    if not examples:
        return raw
    number, name = min(examples)
    bad = count - int(np.count_nonzero(good))
    if bad > _MAX_OUTLIER_FRACTION * count:
        raise UserError(
            f"{source}: {bad} of {count} Gaussians have a value that is not finite ({name} of number {number});"
            " export it again"
        )
    note = f"left out {bad} Gaussians that have a value that is not finite ({name} of number {number})"
    return _subset(raw, good, (*raw.notes, note))


def _subset(raw: RawCapture, chosen: np.ndarray, notes: tuple[str, ...]) -> RawCapture:
    return replace(
        raw,
        means=raw.means[chosen],
        rotations=raw.rotations[chosen],
        log_scales=raw.log_scales[chosen],
        opacity_logits=raw.opacity_logits[chosen],
        sh=raw.sh[chosen],
        rows=np.arange(len(raw.means))[chosen] if raw.rows is None else raw.rows[chosen],
        notes=notes,
    )


def without_outliers(raw: RawCapture, source: Path) -> RawCapture:
    """Return ``raw``, whose values must be finite, without outliers; a note states their number.

    Outliers are farther out than ``MAX_DISTANCE_RATIO``, larger than ``MAX_SCALE_RATIO``, or have a colour beyond
    ``MAX_SH``. The size of the capture is the median distance of its Gaussians from their median, or their median
    standard deviation if that is larger. Raises ``UserError`` for a capture that is too large, or consists mostly of
    outliers.
    """
    means = raw.means.astype(np.float64)
    # A log scale whose exponential overflows in double precision is an outlier in any capture.
    scales = np.exp(np.minimum(raw.log_scales.max(axis=1).astype(np.float64), 700.0))
    middle = np.median(means, axis=0)
    distance = np.sqrt(np.einsum("ni,ni->n", means - middle, means - middle))
    size = max(float(np.median(distance)), float(np.median(scales)))
    reach = max(size, float(np.abs(middle).max()))
    if reach > MAX_COORDINATE:
        raise UserError(
            f"{source}: it extends {reach:.3g} units from the origin, the limit is {MAX_COORDINATE:g}; export it again"
        )
    far, large = distance > MAX_DISTANCE_RATIO * size, scales > MAX_SCALE_RATIO * size
    bright = np.zeros(len(means), bool)
    if max(float(raw.sh.max()), -float(raw.sh.min())) > MAX_SH:
        bright = np.asarray((np.abs(raw.sh) > MAX_SH).any(axis=(1, 2)))
    out = far | large | bright
    count = int(out.sum())
    if count > _MAX_OUTLIER_FRACTION * len(out):
        raise UserError(f"{source}: {count} of {len(out)} Gaussians {_why(far, large, bright)}; export it again")
    notes = raw.notes
    if count:
        numbers = ", ".join(str(number) for number in np.flatnonzero(out)[:_SHOWN])
        numbers += ", ..." if count > _SHOWN else ""
        why = f"{_why(far, large, bright)} (number {numbers}; the capture's size is {size:.3g})"
        notes = (*notes, f"left out {count} Gaussians that {why}")
    flat = int(np.count_nonzero((raw.log_scales < MIN_LOG_SCALE).any(axis=1) & ~out))
    if flat:
        notes = (*notes, f"{flat} Gaussians with a log scale below {MIN_LOG_SCALE:g} read with that value")
    without_rotation = int(np.count_nonzero((raw.rotations == 0.0).all(axis=1) & ~out))
    if without_rotation:
        notes = (*notes, f"{without_rotation} Gaussians with a rotation of length 0 read as unrotated")
    kept = _subset(raw, ~out, notes) if count else replace(raw, notes=notes)
    logits = kept.opacity_logits
    return replace(
        kept,
        log_scales=np.maximum(kept.log_scales, np.float32(MIN_LOG_SCALE)),
        opacity_logits=np.where(np.abs(logits) > MAX_LOGIT, np.copysign(np.float32(np.inf), logits), logits),
    )


def _why(far: np.ndarray, large: np.ndarray, bright: np.ndarray) -> str:
    reasons = (
        (far, f"lie more than {MAX_DISTANCE_RATIO:g} sizes of the capture away"),
        (large, f"are larger than {MAX_SCALE_RATIO:g} sizes of the capture"),
        (bright, f"have a colour beyond {MAX_SH:g}"),
    )
    return " or ".join(reason for which, reason in reasons if which.any())
