"""Common record of all capture formats: the result of decoding, and the input of the checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.geometry.gaussians import unit_quaternions

EXTREME_LOGIT = 16.0
"""Opacity logit that replaces an infinite one: 1 - opacity is then 1e-7, about one step of float32 at 1."""
SH_COUNTS = (0, 3, 8, 15)
"""Numbers of SH coefficients above band 0 for degrees 0 to 3."""
BAND_4 = 24
"""Number of SH coefficients above band 0 for degree 4, which is not rendered."""


@dataclass(frozen=True)
class RawCapture:
    """Host arrays as decoded from the file, not yet checked, in the axes of the file."""

    format: str
    """Name of the format, as shown to the user."""
    means: np.ndarray
    """(n, 3) means in file units, float32; float64 if the file stores more than single precision."""
    rotations: np.ndarray
    """(n, 4) float32, quaternions w x y z of any length."""
    log_scales: np.ndarray
    """(n, 3) float32, logarithms of the standard deviations."""
    opacity_logits: np.ndarray
    """(n,) float32, logits of the opacities, which may be infinite."""
    sh: np.ndarray
    """(n, (degree+1)^2, 3) float32, SH coefficients, band 0 first."""
    up: np.ndarray | None = None
    """(3,) float64, unit up direction; None if neither the format nor the file defines it."""
    vertical_axis: int | None = None
    """Index of the vertical axis, if the file specifies one without a reliable sign."""
    antialiased: bool = False
    """True if the file states that it was trained with antialiasing."""
    origin: np.ndarray | None = None
    """(3,) float64, file units: offset of the capture, which ``means`` do not include."""
    rows: np.ndarray | None = None
    """(n,) indices of the Gaussians in the file; None if all Gaussians of the file were read in order."""
    notes: tuple[str, ...] = ()
    """Messages for the user about Gaussians that were left out and values that were repaired."""


def property_names(coefficient_count: int) -> dict[str, list[str]]:
    """Return the names of the columns in an INRIA .ply for each array of ``RawCapture``, flattened to (n, columns)."""
    rest = coefficient_count - 1
    return {
        "means": ["x", "y", "z"],
        "rotations": [f"rot_{i}" for i in range(4)],
        "log_scales": [f"scale_{i}" for i in range(3)],
        "opacity_logits": ["opacity"],
        "sh": [f"f_dc_{c}" for c in range(3)] + [f"f_rest_{c * rest + k}" for k in range(rest) for c in range(3)],
    }


def full_bands(rest: int) -> int:
    """Return the number of SH coefficients in the complete bands that are rendered, 0, 3, 8 or 15, given ``rest``
    coefficients above band 0."""
    return max(count for count in SH_COUNTS if count <= rest)


def bands_note(rest: int) -> tuple[str, ...]:
    """Return a note for the user if only ``full_bands`` of ``rest`` SH coefficients are read; None if all are read."""
    extra = rest - full_bands(rest)
    if not extra:
        return ()
    if rest == BAND_4:
        return ("SH band 4 left out (degrees 0 to 3 are rendered)",)
    return (f"{extra} of {rest} SH coefficients above band 0 left out: they do not complete a band of degree 1 to 3",)


def logits_from_bytes(alphas: np.ndarray) -> np.ndarray:
    """Return the float32 logits of opacities stored as uint8 / 255; the logits of 0 and 255 are -``EXTREME_LOGIT`` and
    +``EXTREME_LOGIT``."""
    opacity = np.arange(1, 255) / 255.0
    table = np.concatenate([[-EXTREME_LOGIT], np.log(opacity / (1.0 - opacity)), [EXTREME_LOGIT]])
    return table.astype(np.float32)[alphas]


def logits_from_opacities(opacities: np.ndarray) -> np.ndarray:
    """Return the float32 logits of opacities from 0 to 1; the logits of 0 and 1 are -``EXTREME_LOGIT`` and
    +``EXTREME_LOGIT``."""
    values = opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        logits = np.log(values) - np.log1p(-values)
    return np.clip(logits, -EXTREME_LOGIT, EXTREME_LOGIT).astype(np.float32)


def bytes_from_logits(logits: np.ndarray) -> np.ndarray:
    """Return the opacities of ``logits`` as uint8, where 255 represents 1."""
    return byte(255.0 / (1.0 + np.exp(-np.clip(logits.astype(np.float64), -100.0, 100.0))))


def byte(values: np.ndarray) -> np.ndarray:
    """Return ``values`` rounded and clamped to the range 0 to 255, as uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def largest_dropped(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the three components (n, 3) other than the largest one, with signs such that the largest is positive; and
    the index (n,) uint32 of the largest component."""
    unit = unit_quaternions(quaternions).astype(np.float64)
    largest = np.argmax(np.abs(unit), axis=1)
    rows = np.arange(len(unit))
    unit *= np.where(unit[rows, largest] < 0, -1.0, 1.0)[:, None]
    is_smaller = np.ones(unit.shape, bool)
    is_smaller[rows, largest] = False
    return unit[is_smaller].reshape(-1, 3), largest.astype(np.uint32)


def largest_restored(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Return unit quaternions (n, 4) float32 from components and index: the inverse of ``largest_dropped``."""
    quaternions = np.empty((len(three), 4))
    is_smaller = np.ones(quaternions.shape, bool)
    rows = np.arange(len(three))
    is_smaller[rows, largest] = False
    quaternions[is_smaller] = three.ravel()
    quaternions[rows, largest] = np.sqrt(np.maximum(0.0, 1.0 - np.einsum("ni,ni->n", three, three)))
    return unit_quaternions(quaternions)


def bit_field(words: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """Extract ``bits`` bits of uint32 ``words``, from bit ``shift`` upwards, and scale them to the range 0 to 1 in
    float64."""
    mask = (1 << bits) - 1
    return ((words >> np.uint32(shift)) & np.uint32(mask)) / mask
