"""Common record into which all capture formats are decoded before they become a ``GaussianCloud``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.geometry.gaussians import unit_quaternions

EXTREME_LOGIT = 16.0
"""Value for an infinite opacity logit: 1 - opacity is then 1e-7, below half a step of float32 at 1."""
SH_COUNTS = (0, 3, 8, 15)
"""Number of SH coefficients above band 0 of degree 0 to 3."""
BAND_4 = 24
"""Number of SH coefficients above band 0 of degree 4, which is not rendered."""


@dataclass(frozen=True)
class RawCapture:
    """Host arrays as the file contains them, not yet checked. Axes are the file's own."""

    format: str
    """Name of the format, as shown to the user."""
    means: np.ndarray
    """(n, 3) file units, float32; float64 if the file stores more than single precision."""
    rotations: np.ndarray
    """(n, 4) float32, w x y z, any length."""
    log_scales: np.ndarray
    """(n, 3) float32."""
    opacity_logits: np.ndarray
    """(n,) float32, may be infinite."""
    sh: np.ndarray
    """(n, (degree+1)^2, 3) float32, coefficient-major."""
    up: np.ndarray | None = None
    """(3,) float64 unit vector, if the format or the file defines the up direction."""
    vertical_axis: int | None = None
    """Index of the vertical axis, if the file names one without a reliable sign."""
    antialiased: bool = False
    """True if the file states that it was trained with antialiasing."""
    origin: np.ndarray | None = None
    """(3,) float64, file units: offset of the capture, which ``means`` do not include."""
    rows: np.ndarray | None = None
    """(n,) indices of these Gaussians in the file; None if they are all Gaussians of the file."""
    notes: tuple[str, ...] = ()
    """Messages for the user about Gaussians that were left out and values that were repaired."""


def property_names(coefficient_count: int) -> dict[str, list[str]]:
    """Return the names, as in the INRIA .ply, of the columns of each array of ``RawCapture``, flattened to (n,
    columns)."""
    rest = coefficient_count - 1
    return {
        "means": ["x", "y", "z"],
        "rotations": [f"rot_{i}" for i in range(4)],
        "log_scales": [f"scale_{i}" for i in range(3)],
        "opacity_logits": ["opacity"],
        "sh": [f"f_dc_{c}" for c in range(3)] + [f"f_rest_{c * rest + k}" for k in range(rest) for c in range(3)],
    }


def full_bands(rest: int) -> int:
    """Return how many of ``rest`` SH coefficients above band 0 make up complete bands that are rendered: 0, 3, 8 or
    15."""
    return max(count for count in SH_COUNTS if count <= rest)


def bands_note(rest: int) -> tuple[str, ...]:
    """Return the note for the user if only ``full_bands`` of ``rest`` SH coefficients are read; none if all are."""
    extra = rest - full_bands(rest)
    if not extra:
        return ()
    if rest == BAND_4:
        return ("SH band 4 left out (degrees 0 to 3 are rendered)",)
    return (f"{extra} of {rest} SH coefficients above band 0 left out: they do not complete a band of degree 1 to 3",)


def logits_from_bytes(alphas: np.ndarray) -> np.ndarray:
    """Float32 opacity logits of opacities stored as uint8 / 255; 0 and 255 give -+``EXTREME_LOGIT``."""
    opacity = np.arange(1, 255) / 255.0
    table = np.concatenate([[-EXTREME_LOGIT], np.log(opacity / (1.0 - opacity)), [EXTREME_LOGIT]])
    return table.astype(np.float32)[alphas]


def logits_from_opacities(opacities: np.ndarray) -> np.ndarray:
    """Float32 opacity logits of opacities of 0 to 1; both ends give -+``EXTREME_LOGIT``."""
    values = opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        logits = np.log(values) - np.log1p(-values)
    return np.clip(logits, -EXTREME_LOGIT, EXTREME_LOGIT).astype(np.float32)


def bytes_from_logits(logits: np.ndarray) -> np.ndarray:
    """Opacities as uint8, 255 for 1."""
    return byte(255.0 / (1.0 + np.exp(-np.clip(logits.astype(np.float64), -100.0, 100.0))))


def byte(values: np.ndarray) -> np.ndarray:
    """Values rounded and clamped to 0 ... 255, uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def largest_dropped(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, 3) the three smaller components in order, with signs such that the largest is positive, and (n,)
    uint32 the index of the largest."""
    unit = unit_quaternions(quaternions).astype(np.float64)
    largest = np.argmax(np.abs(unit), axis=1)
    rows = np.arange(len(unit))
    unit *= np.where(unit[rows, largest] < 0, -1.0, 1.0)[:, None]
    is_smaller = np.ones(unit.shape, bool)
    is_smaller[rows, largest] = False
    return unit[is_smaller].reshape(-1, 3), largest.astype(np.uint32)


def largest_restored(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Inverse of ``largest_dropped``: (n, 4) float32 unit quaternions."""
    quaternions = np.empty((len(three), 4))
    is_smaller = np.ones(quaternions.shape, bool)
    rows = np.arange(len(three))
    is_smaller[rows, largest] = False
    quaternions[is_smaller] = three.ravel()
    quaternions[rows, largest] = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("ni,ni->n", three, three)))
    return unit_quaternions(quaternions)


def bit_field(words: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """Extract ``bits`` bits of uint32 ``words`` from ``shift`` up, as 0 ... 1 in float64."""
    mask = (1 << bits) - 1
    return ((words >> np.uint32(shift)) & np.uint32(mask)) / mask
