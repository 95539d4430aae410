"""Positions of georeferenced captures: a capture far from the coordinate origin is stored relative to a point in its
middle.

In single precision, map coordinates such as 5403000 m north have a resolution of half a metre.
"""

from __future__ import annotations

import numpy as np

MAX_ROUNDING = 2.0**-16
"""Maximum rounding error of positions in single precision, relative to the size of the capture; if it would be larger,
an origin is subtracted."""
_SAMPLES = 200_000
"""Number of evenly chosen Gaussians from which the size of a capture is measured."""
COARSE_STEP = 2.0**-10
"""Resolution of single precision, relative to the size of the capture, above which a note is written."""


def relative_positions(means: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """Return positions in single precision, relative to an origin if necessary.

    Args:
        means: (n, 3) float32 or float64, finite positions, n > 0.

    Returns:
        Positions (n, 3) float32; the origin (3,) float64 that was subtracted, or None; and notes for the user.
    """
    some = means[:: -(-len(means) // _SAMPLES)].astype(np.float64)
    middle = np.median(some, axis=0)
    offsets = some - middle
    size = float(np.sqrt(np.median(np.einsum("ni,ni->n", offsets, offsets)))) or float(np.abs(offsets).max())
    step = float(np.spacing(np.float32(np.abs(middle).max())))
    rounded, error = _rounded(means)
    if size > 0.0 and error > MAX_ROUNDING * size:
        # A multiple of a power of two has few digits, and subtracting it causes no rounding.
        unit = 2.0 ** np.floor(np.log2(size))
        origin = unit * np.rint(middle / unit)
        rounded, error = _rounded(means - origin)
        text = ",".join(f"{x:.15g}" for x in origin)
        note = f"positions are relative to {text}, as single precision has steps of {step:.2g} units there"
        return rounded, origin, (f"{note}; the remainder was rounded by at most {error:.2g} units" if error else note,)
    if error > 0.0:
        return rounded, None, (f"positions were rounded to single precision, by at most {error:.2g} units",)
    if step > COARSE_STEP * size > 0.0:
        note = f"positions lie in steps of {step:.2g} units, {100.0 * step / size:.2g} % of the capture's size"
        return rounded, None, (f"{note}: it is far from its origin; export it with an offset, or in double precision",)
    return rounded, None, ()


def _rounded(means: np.ndarray) -> tuple[np.ndarray, float]:
    """Return ``means`` in single precision, and the maximum rounding error."""
    rounded = means.astype(np.float32, copy=False)
    if means.dtype == np.float32:
        return rounded, 0.0
    return rounded, float(np.abs(rounded - means).max())
