"""Activation of scales and opacities: detection of files that contain activated values where their format requires
logarithms and logits, and the 3D filter of Mip-Splatting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egs_warp.io.limits import MIN_LOG_SCALE
from egs_warp.io.raw import RawCapture, logits_from_opacities

_MIN_COUNT = 20
"""Minimum number of Gaussians for a decision, because a few values may look activated by chance."""
_SAMPLE = 1000
"""Number of Gaussians that are tested first, which is enough to exclude activated values in most files."""


def with_logarithms(raw: RawCapture) -> RawCapture:
    """Return ``raw`` with logarithms and logits if it evidently contains activated values; a note for the user reports
    this.

    Values are considered activated if all scales are positive and all opacities are within 0 to 1: as logarithms and
    logits, they would make each Gaussian wider than one unit and half transparent. If the opacities are not within 0 to
    1 or are all equal, positive scales are considered activated if most Gaussians would otherwise be wider than the
    capture. Opacities alone are not sufficient evidence: they are not changed, but a note reports them.
    """
    few = slice(0, _SAMPLE)
    if len(raw.means) < _MIN_COUNT or (
        bool(np.any(raw.log_scales[few, :2] < 0.0)) and not _within(raw.opacity_logits[few])
    ):
        return raw
    # The third scale of a flat Gaussian is absent: minus infinity, or 0 if the scales are activated.
    scales, opacities = raw.log_scales, raw.opacity_logits
    absent = ~(scales > MIN_LOG_SCALE)
    positive = bool((absent | (scales >= 0.0)).all() and (scales > 0.0).any())
    within = _within(opacities)
    varies = within and float(np.nanmin(opacities)) < float(np.nanmax(opacities))
    if positive and (varies or _wider_than_capture(raw)):
        with np.errstate(divide="ignore", invalid="ignore"):
            log_scales = np.where(absent, scales, np.log(np.maximum(scales, 0.0)))
        raw = replace(raw, log_scales=log_scales)
        if not within:
            note = "all scales are positive, and too large to be logarithms: read as standard deviations"
            return replace(raw, notes=(*raw.notes, note))
        note = "all scales are positive and all opacities within 0 to 1: read as standard deviations and opacities"
        note += ", not as their logarithms and logits"
        return replace(raw, opacity_logits=logits_from_opacities(opacities), notes=(*raw.notes, note))
    if varies:
        note = "all opacities lie within 0 to 1, as activated ones do; they were read as logits"
        return replace(raw, notes=(*raw.notes, note))
    return raw


def with_filter(raw: RawCapture, sizes: np.ndarray) -> RawCapture:
    """Return ``raw`` with the 3D smoothing filter of Mip-Splatting (Yu et al. 2024, Eq. 7), which its files store apart
    from scales and opacities: the covariance S becomes S + ``sizes``^2 I, and the opacity is multiplied by
    sqrt(|S| / |S + ``sizes``^2 I|). ``sizes`` (n,) are in file units."""
    variances = np.exp(2.0 * raw.log_scales.astype(np.float64))
    wider = variances + np.square(sizes.astype(np.float64))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.sqrt(np.where(wider > 0.0, variances / wider, 1.0).prod(axis=1))
        log_scales = 0.5 * np.log(wider)
    opacities = factor / (1.0 + np.exp(-raw.opacity_logits.astype(np.float64)))
    return replace(
        raw,
        log_scales=log_scales.astype(np.float32),
        opacity_logits=logits_from_opacities(opacities),
        notes=(*raw.notes, "the 3D filter of Mip-Splatting was applied to scales and opacities"),
    )


def _within(opacities: np.ndarray) -> bool:
    return not ((opacities < 0.0) | (opacities > 1.0)).any()


def _wider_than_capture(raw: RawCapture) -> bool:
    """Return True if the median Gaussian would be wider than the capture with scales read as logarithms, but not with
    scales read as standard deviations."""
    means = raw.means[np.isfinite(raw.means).all(axis=1)].astype(np.float64)
    if not len(means):
        return False
    distance = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    widest = np.nanmedian(raw.log_scales.max(axis=1).astype(np.float64))
    return float(np.exp(min(widest, 700.0))) > 2.0 * float(np.median(distance)) > widest
