"""Differences between a capture and its copy in another format, measured Gaussian by Gaussian."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.capture import Capture

_BLOCK_ROWS = 1 << 17
"""Number of Gaussians that are compared at a time, which limits the memory."""


def conversion_loss(
    before: Capture, after: Capture, order: np.ndarray | None = None, *, origin: np.ndarray | None = None
) -> list[str]:
    """Return lines for the user that describe how ``after`` differs from ``before``.

    Args:
        before: The capture that was written.
        after: The written file, read back.
        order: (n,) index in ``before`` of each Gaussian of the file, as returned by its writer; None if the order is
            the same.
        origin: (3,) offset of ``before`` that the file includes (``stored_origin``); None if it includes none.
    """
    old, new = before.cloud, after.cloud
    order = np.arange(old.count) if order is None else order
    if after.rows is not None:
        order = order[after.rows]
    lines = []
    if new.count < old.count:
        lines.append(f"{old.count - new.count} of {old.count} Gaussians are gone")
    if new.sh_degree < old.sh_degree:
        rest = "; colours no longer change with the view" if new.sh_degree == 0 else ""
        lines.append(f"the SH degree falls from {old.sh_degree} to {new.sh_degree}{rest}")
    if before.antialiased and not after.antialiased:
        lines.append("the tag of training with antialiasing is lost")
    if before.up is not None and after.up is None:
        lines.append("the up direction is lost")
    if before.vertical_axis is not None and after.up is None and after.vertical_axis is None:
        lines.append("the name of the vertical axis is lost")
    if after.up is not None and (before.up is None or not np.allclose(before.up, after.up)):
        lines.append("the axes are unchanged, but this format's viewers take +y as up")
    if before.origin is not None and origin is None:
        offset = ",".join(f"{x:.12g}" for x in before.origin)
        lines.append(f"the offset {offset} cannot be stored in this format; the file is relative to it")
    shift = np.zeros(3) if origin is None else (0.0 if after.origin is None else after.origin) - origin
    differences = _differences(old, new, order, shift)
    if lines or differences:
        return lines + differences
    if before.notes:
        return ["every bit that was read is the same; the notes state what was left out or rounded"]
    return ["nothing is lost: every bit is the same"]


class _Loss:
    """Root mean square and maximum of the differences of one quantity."""

    def __init__(self) -> None:
        self._squares, self._count, self._worst = 0.0, 0, 0.0

    def add(self, values: np.ndarray) -> None:
        """Add non-negative differences of any shape."""
        self._squares += float(np.sum(values * values, dtype=np.float64))
        self._count += values.size
        self._worst = max(self._worst, float(values.max()))

    def __str__(self) -> str:
        return f"{(self._squares / self._count) ** 0.5:.2g} (at most {self._worst:.2g})"


def _differences(old: GaussianCloud, new: GaussianCloud, order: np.ndarray, shift: np.ndarray) -> list[str]:
    coefficients = min(old.sh.shape[1], new.sh.shape[1])
    if all(_is_same(*pair) for pair in _blocks(old, new, order, coefficients, shift)):
        return []
    measures = {
        "positions {} units": _position_errors,
        "standard deviations {} %": _size_errors,
        "rotations {} degrees": _rotation_errors,
        "opacities {} of 255": _opacity_errors,
        "colours {} of 255": lambda a, b: 255.0 * SH_BAND_0 * np.abs(a.sh[:, 0] - b.sh[:, 0]).max(axis=1),
        "coefficients of higher bands {}": lambda a, b: np.abs(a.sh[:, 1:] - b.sh[:, 1:]).max(axis=(1, 2)),
    }
    if coefficients == 1:
        measures.popitem()
    losses = {text: _Loss() for text in measures}
    for pair in _blocks(old, new, order, coefficients, shift):
        for text, measure in measures.items():
            losses[text].add(measure(*pair))
    extent = float(np.ptp(old.means.numpy(), axis=0).max())
    parts = [text.format(loss) for text, loss in losses.items()]
    parts[0] += f", of a size of {extent:.3g}"
    return [f"changed, root mean square: {', '.join(parts)}"]


class _Block(NamedTuple):
    """Arrays of some Gaussians of a ``GaussianCloud``."""

    means: np.ndarray
    rotations: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray


def _blocks(
    old: GaussianCloud, new: GaussianCloud, order: np.ndarray, coefficients: int, shift: np.ndarray
) -> Iterator[tuple[_Block, _Block]]:
    """Yield blocks of corresponding Gaussians of both clouds, with the SH bands that both have. The Gaussians of
    ``new`` are moved by ``shift`` (3,)."""
    names = _Block._fields
    before, after = ([getattr(cloud, name).numpy() for name in names] for cloud in (old, new))
    before[-1], after[-1] = before[-1][:, :coefficients], after[-1][:, :coefficients]
    for start in range(0, len(order), _BLOCK_ROWS):
        rows = order[start : start + _BLOCK_ROWS]
        same = _Block(*(b[start : start + len(rows)] for b in after))
        if shift.any():
            same = same._replace(means=same.means + shift)
        yield _Block(*(a[rows] for a in before)), same


def _is_same(old: _Block, new: _Block) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(old, new, strict=True))


def _position_errors(old: _Block, new: _Block) -> np.ndarray:
    return np.linalg.norm(new.means.astype(np.float64) - old.means, axis=1)


def _size_errors(old: _Block, new: _Block) -> np.ndarray:
    """Return the maximum change (n,) of a standard deviation of each Gaussian, in percent of its largest standard
    deviation, because a small change of the thickness of a flat Gaussian is not visible."""
    before, after = (np.exp(block.log_scales.astype(np.float64)) for block in (old, new))
    return 100.0 * np.abs(after - before).max(axis=1) / before.max(axis=1)


def _rotation_errors(old: _Block, new: _Block) -> np.ndarray:
    """Return the angles (n,) between the rotations, degrees. A quaternion and its negative are the same rotation."""
    a, b = old.rotations.astype(np.float64), new.rotations.astype(np.float64)
    chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4.0 * np.degrees(np.arcsin(np.minimum(0.5 * chord, 1.0)))


def _opacity_errors(old: _Block, new: _Block) -> np.ndarray:
    before, after = (expit(block.opacity_logits.astype(np.float64)) for block in (old, new))
    return 255.0 * np.abs(after - before)
