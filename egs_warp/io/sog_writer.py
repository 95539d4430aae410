"""Writing of SOG version 2 (``sog`` reads it). Code books of 256 values, and a palette of sets of SH coefficients, are
computed from the capture."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np

from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.io.atomic import atomic_write
from egs_warp.io.morton import morton_order
from egs_warp.io.raw import byte, bytes_from_logits, largest_dropped
from egs_warp.io.sog import FIRST_TAG, LABELS_PER_ROW

_BOOK_SIZE = 256
_BOOK_SAMPLES = 1_000_000
_LLOYD_ROUNDS = 12
_PALETTE_LEVELS = 16


def write_sog(path: Path | str, cloud: GaussianCloud, *, keep_order: bool = False) -> np.ndarray:
    """Write ``cloud`` as a .sog, which has a twentieth of the size of a .ply file.

    The format is lossy: positions are rounded to 1/65535 of the extent (finer near the origin), rotations and opacity
    to 1/255, and scales, colours and SH coefficients to 256 values each, which are chosen for the capture. For more
    than 65,536 Gaussians, similar sets of SH coefficients are merged. Gaussians are sorted in space unless
    ``keep_order`` is set. Returns the index (n,) in ``cloud`` of each Gaussian of the file. Raises ``UserError`` if the
    file cannot be written.
    """
    means = cloud.means.numpy().astype(np.float64)
    order = np.arange(cloud.count) if keep_order else morton_order(means)
    logs = (np.sign(means) * np.log1p(np.abs(means)))[order]
    mins, maxs = logs.min(axis=0), logs.max(axis=0)
    fixed = np.rint((logs - mins) / np.maximum(maxs - mins, 1e-300) * 65535.0).astype(np.uint16)
    three, largest = largest_dropped(cloud.rotations.numpy()[order])
    quats = np.concatenate([byte((three * np.sqrt(2.0) + 1.0) * 127.5), (largest[:, None] + FIRST_TAG)], axis=1)
    sh = cloud.sh.numpy()[order]
    scale_book, scales = _code_book(cloud.log_scales.numpy()[order])
    colour_book, colours = _code_book(sh[:, 0])
    alphas = bytes_from_logits(cloud.opacity_logits.numpy()[order])
    images = {
        "means_l.webp": _square(fixed & 255),
        "means_u.webp": _square(fixed >> 8),
        "quats.webp": _square(quats),
        "scales.webp": _square(scales),
        "sh0.webp": _square(np.concatenate([colours, alphas[:, None]], axis=1)),
    }
    meta: dict[str, object] = {
        "version": 2,
        "asset": {"generator": "egs_warp"},
        "count": cloud.count,
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colour_book.tolist(), "files": ["sh0.webp"]},
    }
    if cloud.antialiased:
        # ``antialias`` is the entry of the format's description, ``model`` is the one that splat-transform uses.
        meta |= {"antialias": True, "model": "antialiased"}
    if cloud.sh_degree > 0:
        palette, labels = _palette(sh[:, 1:].reshape(len(sh), -1))
        sh_book, centroids = _code_book(palette)
        meta["shN"] = {
            "count": len(palette),
            "bands": cloud.sh_degree,
            "codebook": sh_book.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
        images["shN_centroids.webp"] = _palette_rows(centroids.reshape(len(palette), -1, 3))
        images["shN_labels.webp"] = _square(np.stack([labels & 255, labels >> 8], axis=1))
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, pixels in images.items():
            archive.writestr(name, _webp(pixels))
        archive.writestr("meta.json", json.dumps(meta))
    return order


def _code_book(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a code book (256,) of increasing values that represent ``values`` with small squared error, and the index
    of each value in it as uint8.

    It is computed by Lloyd's algorithm in one dimension, starting from quantiles and equally many evenly spaced values.
    The latter preserve outliers, such as a few very large Gaussians. Up to 256 different values are represented
    exactly.
    """
    samples = np.sort(values.ravel()[:: -(-values.size // _BOOK_SAMPLES)].astype(np.float64))
    different = np.unique(values)
    if len(different) <= _BOOK_SIZE:
        book = np.pad(different.astype(np.float64), (0, _BOOK_SIZE - len(different)), mode="edge")
        return book, np.searchsorted(different, values).astype(np.uint8)
    sums = np.concatenate([[0.0], np.cumsum(samples)])
    half = (np.arange(_BOOK_SIZE // 2) + 0.5) / (_BOOK_SIZE // 2)
    spaced = different[0] + half * (float(different[-1]) - different[0])
    book = np.sort(np.concatenate([np.quantile(samples, half), spaced]))
    for _ in range(_LLOYD_ROUNDS):
        cuts = np.searchsorted(samples, 0.5 * (book[1:] + book[:-1]))
        starts, ends = np.concatenate([[0], cuts]), np.concatenate([cuts, [len(samples)]])
        used = ends > starts
        book[used] = (sums[ends] - sums[starts])[used] / (ends - starts)[used]
        book.sort()
    book = book.astype(np.float32).astype(np.float64)
    return book, np.searchsorted(0.5 * (book[1:] + book[:-1]), values).astype(np.uint8)


def _palette(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a palette of at most 65,536 vectors (p, m) that represent ``vectors`` (n, m), and the index of each vector
    in it.

    Clusters are split at their mean, perpendicular to the direction of maximum variance, until there are enough.
    """
    count, width = vectors.shape
    if count <= 1 << _PALETTE_LEVELS:
        return vectors, np.arange(count)
    labels = np.zeros(count, np.int64)
    rows = np.arange(count)
    for level in range(_PALETTE_LEVELS):
        cells = 1 << level
        means, spreads = np.empty((cells, width)), np.empty((cells, width))
        sizes = np.maximum(np.bincount(labels, minlength=cells), 1)
        for column in range(width):
            values = vectors[:, column].astype(np.float64)
            means[:, column] = np.bincount(labels, values, cells) / sizes
            spreads[:, column] = np.bincount(labels, (values - means[labels, column]) ** 2, cells)
        across = np.argmax(spreads, axis=1)[labels]
        labels = 2 * labels + (vectors[rows, across] > means[labels, across])
    _, labels = np.unique(labels, return_inverse=True)
    sizes = np.bincount(labels)
    centres = np.stack([np.bincount(labels, vectors[:, column]) / sizes for column in range(width)], axis=1)
    return centres, labels


def _square(values: np.ndarray) -> np.ndarray:
    """Return an image (side, side, 4) uint8 that contains ``values`` (n, 1 to 4) row by row; it is opaque if the values
    have no fourth column."""
    side = int(np.ceil(np.sqrt(len(values))))
    pixels = np.zeros((side * side, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(side, side, 4)


def _palette_rows(centroids: np.ndarray) -> np.ndarray:
    """Return the image (rows, 64 (K-1), 4) uint8 of the palette ``centroids`` (p, K-1, 3)."""
    count, coefficients, _ = centroids.shape
    rows = -(-count // LABELS_PER_ROW)
    pixels = np.full((rows * LABELS_PER_ROW, coefficients, 4), 255, np.uint8)
    pixels[:count, :, :3] = centroids
    return pixels.reshape(rows, LABELS_PER_ROW * coefficients, 4)


def _webp(pixels: np.ndarray) -> bytes:
    from PIL import Image

    data = io.BytesIO()
    # Without ``exact``, the encoder would drop the colours of pixels whose fourth channel is 0.
    Image.fromarray(pixels).save(data, "WEBP", lossless=True, exact=True, quality=80, method=2)
    return data.getvalue()
