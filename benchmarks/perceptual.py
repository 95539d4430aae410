"""Perceptual difference of two images: FLIP, and LPIPS (Zhang et al. 2018, AlexNet).

LPIPS needs the ``lpips`` package and the network's weights on this machine; nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

PIXELS_PER_DEGREE = 67.0206
"""Pixels per degree of the visual field for a viewer 0.7 m in front of a screen 0.7 m wide with 3840 columns, the
default of FLIP."""
_XYZ_FROM_RGB = (
    (10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794),
    (2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897),
    (1425376 / 73733382, 8788810 / 73733382, 70074185 / 73733382),
)
_SENSITIVITIES = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
"""Contrast sensitivity of the achromatic, red-green and blue-yellow channels: weights and widths of Gaussians in the
frequency domain."""
_FEATURE_DEGREES = 0.082
"""Width of the edges and points to which the feature detector responds, degrees."""
_COLOUR_POWER, _FEATURE_POWER = 0.7, 0.5
_KNEE, _KNEE_VALUE = 0.4, 0.95
"""Breakpoint of FLIP's mapping of errors: colour differences up to the first number, as a fraction of the largest one,
are mapped linearly to the range from 0 to the second number."""


def flip_error(picture: torch.Tensor, target: torch.Tensor) -> float:
    """Mean FLIP (Andersson et al. 2020, low dynamic range) of two images (H, W, 3), sRGB from 0 to 1.

    The value is 0 for equal images and 1 for the largest difference. FLIP predicts the difference that a viewer
    perceives when alternating between the two images.
    """
    pair = [one.permute(2, 0, 1)[None].double() for one in (target, picture)]
    opponents = [_opponent(_linear(one.clamp(0.0, 1.0))) for one in pair]
    colour = _colour_difference(*(_filtered_lab(one) for one in opponents))
    feature = _feature_difference(*(one[:, :1] for one in opponents))
    return float((colour ** (1.0 - feature)).mean())


def _linear(srgb: torch.Tensor) -> torch.Tensor:
    return torch.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)


def _mixed(matrix: torch.Tensor, planes: torch.Tensor) -> torch.Tensor:
    return torch.einsum("ij,bjhw->bihw", matrix, planes)


def _xyz(planes: torch.Tensor) -> torch.Tensor:
    """Return the XYZ values (1, 3, H, W) of linear RGB ``planes``, relative to the white point."""
    matrix = torch.tensor(_XYZ_FROM_RGB, dtype=planes.dtype, device=planes.device)
    return _mixed(matrix / matrix.sum(dim=1, keepdim=True), planes)


def _opponent(linear: torch.Tensor) -> torch.Tensor:
    """Return the channels Y, Cx, Cz (1, 3, H, W): lightness, red-green and blue-yellow."""
    x, y, z = _xyz(linear).unbind(dim=1)
    return torch.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], dim=1)


def _filtered_lab(opponent: torch.Tensor) -> torch.Tensor:
    """Return the channels L*, a*, b* (1, 3, H, W) after the contrast sensitivity filter; chroma is scaled by lightness
    (Hunt effect)."""
    widest = max(width for terms in _SENSITIVITIES for _, width in terms)
    radius = int(np.ceil(3.0 * np.sqrt(widest / (2.0 * np.pi**2)) * PIXELS_PER_DEGREE))
    degrees = torch.arange(-radius, radius + 1, dtype=opponent.dtype, device=opponent.device) / PIXELS_PER_DEGREE
    planes = []
    for plane, terms in zip(opponent.split(1, dim=1), _SENSITIVITIES, strict=True):
        lines = [torch.exp(-(np.pi**2) * degrees**2 / width) for _, width in terms]
        weights = [
            weight * np.sqrt(np.pi / width) * float(line.sum()) ** 2
            for (weight, width), line in zip(terms, lines, strict=True)
        ]
        blurred = [
            _convolved(plane, line / line.sum(), line / line.sum()) * (weight / sum(weights))
            for line, weight in zip(lines, weights, strict=True)
        ]
        planes.append(torch.stack(blurred).sum(dim=0))
    y = (planes[0] + 16.0) / 116.0
    xyz = torch.cat([y + planes[1] / 500.0, y, y - planes[2] / 200.0], dim=1)
    matrix = torch.tensor(_XYZ_FROM_RGB, dtype=xyz.dtype, device=xyz.device)
    back = torch.linalg.inv(matrix / matrix.sum(dim=1, keepdim=True))
    return _hunted_lab(_mixed(back, xyz).clamp(0.0, 1.0))


def _hunted_lab(linear: torch.Tensor) -> torch.Tensor:
    xyz = _xyz(linear)
    edge = 6.0 / 29.0
    x, y, z = torch.where(xyz > edge**3, xyz.clamp(min=1e-12) ** (1 / 3), xyz / (3 * edge**2) + 4 / 29).unbind(dim=1)
    lightness = 116.0 * y - 16.0
    return torch.stack([lightness, 5.0 * lightness * (x - y), 2.0 * lightness * (y - z)], dim=1)


def _colour_difference(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Return the HyAB distance (1, 1, H, W), with large values compressed, on a scale from 0 to 1."""

    def distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        off = a - b
        return (off[:, :1].abs() + torch.linalg.vector_norm(off[:, 1:], dim=1, keepdim=True)) ** _COLOUR_POWER

    green, blue = (
        _hunted_lab(torch.tensor(rgb, dtype=one.dtype, device=one.device)[None, :, None, None])
        for rgb in ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    )
    largest = float(distance(green, blue))
    knee = _KNEE * largest
    off = distance(one, other)
    compressed = _KNEE_VALUE + (off - knee) / (largest - knee) * (1.0 - _KNEE_VALUE)
    return torch.where(off < knee, off * (_KNEE_VALUE / knee), compressed)


def _feature_difference(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Return the strength (1, 1, H, W), from 0 to 1, of edges or points that exist in only one of two lightness planes
    (1, 1, H, W)."""
    deviation = 0.5 * _FEATURE_DEGREES * PIXELS_PER_DEGREE
    radius = int(np.ceil(3.0 * deviation))
    x = torch.arange(-radius, radius + 1, dtype=one.dtype, device=one.device)
    bell = torch.exp(-(x**2) / (2.0 * deviation**2))
    edge, point = -x * bell, (x**2 / deviation**2 - 1.0) * bell

    def balanced(line: torch.Tensor) -> torch.Tensor:
        return torch.where(line > 0.0, line / line.clamp(min=0.0).sum(), line / -line.clamp(max=0.0).sum())

    def strength(plane: torch.Tensor, line: torch.Tensor) -> torch.Tensor:
        lightness, across = (plane + 16.0) / 116.0, bell / bell.sum()
        pair = [_convolved(lightness, line, across), _convolved(lightness, across, line)]
        return torch.linalg.vector_norm(torch.cat(pair, dim=1), dim=1, keepdim=True)

    offs = [(strength(one, line) - strength(other, line)).abs() for line in (balanced(edge), balanced(point))]
    return (torch.maximum(*offs) / np.sqrt(2.0)) ** _FEATURE_POWER


def _convolved(plane: torch.Tensor, along_x: torch.Tensor, along_y: torch.Tensor) -> torch.Tensor:
    """Return the plane (1, 1, H, W) correlated with two line kernels of equal length; border pixels are replicated."""
    radius = len(along_x) // 2
    padded = torch.nn.functional.pad(plane, [radius] * 4, mode="replicate")
    rows = torch.nn.functional.conv2d(padded, along_x[None, None, None])
    return torch.nn.functional.conv2d(rows, along_y[None, None, :, None])


def lpips_distance() -> tuple[Callable[[np.ndarray, np.ndarray], float] | None, str | None]:
    """Return a function that computes the LPIPS distance of two images (H, W, 3) with values from 0 to 1, and None;
    return None and the reason if LPIPS is unavailable."""
    try:
        import lpips  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None, "the package lpips is not installed"
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    if not list(folder.glob("alexnet-*.pth")):
        return None, f"the weights of AlexNet (alexnet-*.pth) are not in {folder.name} of torch's hub folder"
    network = lpips.LPIPS(net="alex", verbose=False)

    def distance(one: np.ndarray, other: np.ndarray) -> float:
        pair = [torch.as_tensor(2.0 * picture - 1.0).float().permute(2, 0, 1)[None] for picture in (one, other)]
        with torch.no_grad():
            return float(network(*pair))

    return distance, None
