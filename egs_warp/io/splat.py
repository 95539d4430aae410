""".splat: 32 bytes per Gaussian and no header.

Public description: https://github.com/antimatter15/splat. Position and scale are three float32 each, colour and opacity
together four uint8, and the rotation four uint8 b for w x y z, each (b - 128) / 128. There is no magic number and no SH
band above 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import SH_BAND_0, GaussianCloud
from egs_warp.io.atomic import atomic_write
from egs_warp.io.raw import RawCapture, byte, bytes_from_logits, logits_from_bytes

_ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])
SPLAT_ROW = _ROW.itemsize
"""Number of bytes of one Gaussian."""
_MAX_NEGATIVE = 0.5
"""Maximum fraction of Gaussians with a negative scale in a file that is accepted as a .splat."""
_MIN_SCALE = float(np.finfo(np.float32).tiny)


def decode_splat(data: bytes, source: Path) -> RawCapture:
    """Decode a .splat.

    A few negative scales become NaN. Raises ``UserError`` for a file that ends inside a Gaussian, or in which more than
    half of the scales are negative.
    """
    if len(data) % _ROW.itemsize:
        whole = len(data) // _ROW.itemsize
        raise UserError(
            f"{source}: truncated or not a .splat: {whole + 1} Gaussians need {(whole + 1) * _ROW.itemsize} bytes, "
            f"found {len(data)}; copy or export it again"
        )
    rows = np.frombuffer(data, _ROW)
    scales = rows["scale"]
    negative = np.flatnonzero((scales < 0).any(axis=1))
    if len(negative) > _MAX_NEGATIVE * len(rows):
        raise UserError(
            f"{source}: scale of {len(negative)} Gaussians is negative (first: number {negative[0]}); "
            "if the file is a .splat, export it again"
        )
    # In float32, exp is 0 below about -104, so Gaussians with smaller log scales are stored with scale 0.
    zero = int(np.count_nonzero((scales == 0).any(axis=1)))
    colour = rows["colour"]
    with np.errstate(invalid="ignore"):
        log_scales = np.log(np.where(scales == 0, np.float32(_MIN_SCALE), scales))
    return RawCapture(
        format=".splat",
        means=np.ascontiguousarray(rows["position"]),
        rotations=(rows["rotation"].astype(np.float32) - np.float32(128.0)) / np.float32(128.0),
        log_scales=log_scales,
        opacity_logits=logits_from_bytes(colour[:, 3]),
        sh=((colour[:, None, :3] / 255.0 - 0.5) / SH_BAND_0).astype(np.float32),
        notes=(f"{zero} Gaussians with a scale of 0 read as {_MIN_SCALE:.0e}",) if zero else (),
    )


def write_splat(path: Path | str, cloud: GaussianCloud) -> None:
    """Write ``cloud`` as a .splat: only SH band 0, with colour, opacity and rotation in 8 bits each.

    Raises ``UserError`` if the file cannot be written.
    """
    rows = np.empty(cloud.count, _ROW)
    rows["position"] = cloud.means.numpy()
    with np.errstate(over="ignore"):
        rows["scale"] = np.minimum(np.exp(cloud.log_scales.numpy()), np.finfo(np.float32).max)
    rows["colour"][:, :3] = byte((cloud.sh.numpy()[:, 0].astype(np.float64) * SH_BAND_0 + 0.5) * 255.0)
    rows["colour"][:, 3] = bytes_from_logits(cloud.opacity_logits.numpy())
    rows["rotation"] = byte(cloud.rotations.numpy() * 128.0 + 128.0)
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(rows.tobytes())
