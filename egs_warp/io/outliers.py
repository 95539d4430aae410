"""Gaussians that no capture means to have: far out, larger than everything, brighter than any light.

One of them is enough to stall a simulation or to overflow single precision. They are found by bounds that such
Gaussians do not move themselves (medians), left out, and told.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.limits import FURTHEST
from egs_warp.io.raw import RawCapture

FURTHEST_SIZES = 1e4
"""Sizes of the capture from its middle: skies are some hundred sizes out."""
LARGEST_SIZES = 1e2
"""Sizes of the capture: standard deviation of its largest Gaussian."""
LARGEST_SH = 1e3
"""A coefficient of a colour; a white surface has 1.8."""
LEAST_LOG_SCALE = -100.0
"""Below, exp gives 0 in single precision."""
LARGEST_LOGIT = 500.0
"""An opacity beyond is 0 or 1, as an infinite one."""
_MOST_LEFT_OUT = 0.5
_SHOWN = 3


def without_outliers(raw: RawCapture, source: Path) -> RawCapture:
    """``raw`` (finite) without what lies further than ``FURTHEST_SIZES`` out, is larger than ``LARGEST_SIZES`` or has a
    colour beyond ``LARGEST_SH``, with a note that tells how many.

    The size of the capture is the median distance of its Gaussians from their median, or their median standard
    deviation if that is more. Raises ``UserError`` for a capture that is too large, or mostly of such Gaussians.
    """
    means = raw.means.astype(np.float64)
    # A log scale that exp cannot hold in double precision is out in any capture.
    scales = np.exp(np.minimum(raw.log_scales.max(axis=1).astype(np.float64), 700.0))
    middle = np.median(means, axis=0)
    distance = np.sqrt(np.einsum("ni,ni->n", means - middle, means - middle))
    size = max(float(np.median(distance)), float(np.median(scales)))
    reach = max(size, float(np.abs(middle).max()))
    if reach > FURTHEST:
        raise UserError(f"{source}: it reaches {reach:.3g} units out, at most {FURTHEST:g} are read; export it again")
    far, large = distance > FURTHEST_SIZES * size, scales > LARGEST_SIZES * size
    bright = np.asarray((np.abs(raw.sh) > LARGEST_SH).any(axis=(1, 2)))
    out = far | large | bright
    count = int(out.sum())
    if count > _MOST_LEFT_OUT * len(out):
        raise UserError(f"{source}: {count} of {len(out)} Gaussians {_why(far, large, bright)}; export it again")
    notes = raw.notes
    if count:
        numbers = ", ".join(str(number) for number in np.flatnonzero(out)[:_SHOWN])
        numbers += ", ..." if count > _SHOWN else ""
        why = f"{_why(far, large, bright)} (number {numbers}; the capture's size is {size:.3g})"
        notes = (*notes, f"{count} Gaussians left out that {why}")
    flat = int(np.count_nonzero((raw.log_scales < LEAST_LOG_SCALE).any(axis=1) & ~out))
    if flat:
        notes = (*notes, f"{flat} Gaussians with a log scale below {LEAST_LOG_SCALE:g} read as that")
    turnless = int(np.count_nonzero((raw.rotations == 0.0).all(axis=1) & ~out))
    if turnless:
        notes = (*notes, f"{turnless} Gaussians with a rotation of length 0 read as not turned")
    kept = slice(None) if not count else ~out
    logits = raw.opacity_logits[kept]
    return replace(
        raw,
        means=raw.means[kept],
        rotations=raw.rotations[kept],
        log_scales=np.maximum(raw.log_scales[kept], np.float32(LEAST_LOG_SCALE)),
        opacity_logits=np.where(np.abs(logits) > LARGEST_LOGIT, np.copysign(np.float32(np.inf), logits), logits),
        sh=raw.sh[kept],
        notes=notes,
    )


def _why(far: np.ndarray, large: np.ndarray, bright: np.ndarray) -> str:
    reasons = (
        (far, f"lie further than {FURTHEST_SIZES:g} sizes of the capture out"),
        (large, f"are larger than {LARGEST_SIZES:g} sizes of the capture"),
        (bright, f"have a colour beyond {LARGEST_SH:g}"),
    )
    return " or ".join(said for which, said in reasons if which.any())
