"""Differences between a capture and its copy in another format, measured for each Gaussian."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.capture import Capture

_ARRAYS = ("means", "rotations", "log_scales", "opacity_logits", "sh")
_FINE = 1000.0
"""Weight of positions, in sizes of the capture, when Gaussians are matched."""


def conversion_loss(before: Capture, after: Capture) -> list[str]:
    """Describe, line by line for the user, how ``after``, written from ``before``, differs. Each Gaussian is matched
    with the most similar one, as some formats change the order."""
    old, new = before.cloud, after.cloud
    lines = []
    if new.count != old.count:
        lines.append(f"{old.count - new.count} of {old.count} Gaussians are gone")
    if new.sh_degree < old.sh_degree:
        rest = "; colours no longer change with the view" if new.sh_degree == 0 else ""
        lines.append(f"colours of degree {old.sh_degree} are now of degree {new.sh_degree}{rest}")
    if before.antialiased and not after.antialiased:
        lines.append("the mark of training with antialiasing is lost")
    if before.up is not None and after.up is None:
        lines.append("the up direction is lost")
    if after.up is not None and (before.up is None or not np.allclose(before.up, after.up)):
        lines.append("the axes are unchanged, but this format's viewers take +y as up")
    differences = _differences(old, new)
    if not lines and not differences:
        return ["nothing is lost: every bit is the same"]
    return lines + differences


def _differences(old: GaussianCloud, new: GaussianCloud) -> list[str]:
    coefficients = min(old.sh.shape[1], new.sh.shape[1])
    same = old.count == new.count and all(
        np.array_equal(_array(old, name, coefficients), _array(new, name, coefficients)) for name in _ARRAYS
    )
    if same:
        return []
    extent = float(np.ptp(old.means.numpy(), axis=0).max()) or 1.0
    order = np.asarray(KDTree(_features(old, extent)).query(_features(new, extent))[1], np.int64)
    means = np.linalg.norm(new.means.numpy() - old.means.numpy()[order], axis=1)
    scales = np.exp(np.abs(new.log_scales.numpy() - old.log_scales.numpy()[order])).max(axis=1)
    cosines = np.abs(np.einsum("ni,ni->n", new.rotations.numpy(), old.rotations.numpy()[order]))
    angles = 2.0 * np.degrees(np.arccos(np.minimum(cosines, 1.0)))
    opacities = np.abs(new.opacities() - old.opacities()[order])
    colours = SH_BAND_0 * np.abs(new.sh.numpy()[:, 0] - old.sh.numpy()[order, 0]).max(axis=1)

    def both(values: np.ndarray, scale: float = 1.0) -> str:
        return f"{scale * float(np.median(values)):.2g} (at most {scale * float(values.max()):.2g})"

    parts = [
        f"positions {both(means)} units, of a size of {extent:.3g}",
        f"standard deviations by {both(scales - 1.0, 100.0)} %",
        f"rotations {both(angles)} degrees",
        f"opacities {both(opacities, 255.0)} of 255",
        f"colours {both(colours, 255.0)} of 255",
    ]
    if coefficients > 1:
        rest = np.abs(new.sh.numpy()[:, 1:coefficients] - old.sh.numpy()[order, 1:coefficients]).max(axis=(1, 2))
        parts.append(f"coefficients of higher bands {both(rest)}")
    return [f"changed, in the median: {', '.join(parts)}"]


def _array(cloud: GaussianCloud, name: str, coefficients: int) -> np.ndarray:
    values = getattr(cloud, name).numpy()
    return values[:, :coefficients] if name == "sh" else values


def _features(cloud: GaussianCloud, extent: float) -> np.ndarray:
    places = cloud.means.numpy().astype(np.float64) * (_FINE / extent)
    return np.concatenate(
        [places, cloud.log_scales.numpy(), cloud.sh.numpy()[:, 0], cloud.opacities()[:, None]], axis=1
    )
