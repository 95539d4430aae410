"""Estimate of the plane on which an object stands, and of the up direction, if neither is given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import upright_frame
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.geometry.unique_rows import distinct_rows
from egs_warp.meshing.body_gaussians import canonical_order, centred, representatives
from egs_warp.segmentation.resting_directions import resting_directions

_COLUMNS = 64
"""Number of columns across the longer side of the footprint."""
_SEARCHED_SHARE = 0.15
"""Fraction of the object's height, from the bottom, in which the support is searched for."""
_BANDWIDTH = 0.01
"""Bandwidth of the density estimate of the heights of column bottoms, as a fraction of the object's height. Bottoms
within 1.5 bandwidths of the peak belong to the support."""
_VISIBLE = 0.3
"""Minimum opacity of the Gaussians that form the underside."""
_MAX_GAUSSIANS = 300_000
"""Maximum number of Gaussians, sampled evenly, from which the up direction is estimated."""
_MAX_MASS_BELOW = 0.015
"""Maximum share of the opacity mass below the plane: half of the share that may be excluded from contact."""


_AXIS_NAMES = "xyz"
_AXIS_BONUS = {1: 0.10, 2: 0.05, 0: 0.0}
"""Bonus of each axis in the score of an up direction: trainers and generators usually use y (COLMAP: -y, glTF: +y),
less often z, and hardly ever x."""
_CLEAR_MARGIN = 0.3
_POOR_SCORE = 1.75
"""Score below which no axis is a good up direction. For a tilted object, each axis scores less than this."""
_SURE_LEVEL = 0.5
"""Minimum level fraction of a reliable support. A tilted direction replaces an axis only if its own level fraction
reaches this value, that of the axis does not, and its score is clearly higher."""
_FEW_GAUSSIANS, _MAX_DIRECTIONS = 20_000, 24
"""Number of Gaussians that are used in the search for tilted directions, and maximum number of these directions."""


@dataclass(frozen=True)
class _Underside:
    """The object seen from below."""

    heights: np.ndarray
    """(n,) heights of all means along the up direction, scene units."""
    opacities: np.ndarray
    """(n,) opacities of the Gaussians, 0 to 1."""
    low: float
    high: float
    """Robust maximum of the heights, scene units; ``low`` is the robust minimum."""
    bottoms: np.ndarray
    """(c,) lowest visible height of each column."""
    columns: np.ndarray
    """(c, 2) integer position of each column."""
    column_width: float
    """Width of a column, scene units."""
    centre: np.ndarray
    """(2,) centre of opacity, in units of the column width."""

    @property
    def size(self) -> float:
        """Robust height of the object, scene units."""
        return self.high - self.low


def find_base_plane(cloud: GaussianCloud, up: np.ndarray) -> Plane:
    """Return the plane orthogonal to ``up`` (3,) on which the object stands.

    The object is cut into columns; their lowest visible Gaussians are its underside. The support is the densest level
    of the underside in the lowest 15 % of the height (strays are too few to form a level), and the plane is the lower
    edge of that level. The plane is lowered, if necessary, until at most 1.5 % of the opacity mass lies below it.

    Raises ``UserError`` if the object has no height.
    """
    normal = np.asarray(up, dtype=np.float64)
    normal = normal / np.linalg.norm(normal)
    near, anchor = _ordered(representatives(cloud))
    underside = _underside(near, normal)
    level = min(_support_level(underside), _mass_quantile(underside.heights, underside.opacities, _MAX_MASS_BELOW))
    return Plane(normal, -level).moved(anchor)


def _ordered(cloud: GaussianCloud) -> tuple[GaussianCloud, np.ndarray]:
    """Return the Gaussians, moved to the origin and in an order that does not depend on the file, and the displacement
    (3,)."""
    near, anchor = centred(cloud)
    return near.subset(canonical_order(near)), anchor


def _underside(cloud: GaussianCloud, normal: np.ndarray) -> _Underside:
    """Compute the underside of a cloud in canonical order."""
    means, opacities = cloud.means.numpy().astype(np.float64), cloud.opacities()
    heights = means @ normal
    low, high = (_mass_quantile(heights, opacities, share) for share in (0.002, 0.998))
    if not high > low:
        raise UserError(
            f"object: its {cloud.count} Gaussians have no height along the up direction, so no plane can be found",
            check=("up",),
        )
    first, second, _ = upright_frame(means, opacities, Plane(normal, 0.0)).axes
    across = np.stack([means @ first, means @ second], axis=1)
    box = np.array([[_mass_quantile(across[:, k], opacities, share) for share in (0.002, 0.998)] for k in range(2)])
    width = max(float(np.ptp(box, axis=1).max()) / _COLUMNS, 1e-12 * (high - low))
    visible = cloud.visible(_VISIBLE)
    column = np.floor((across[visible] - box[:, 0]) / width).astype(np.int64)
    near = np.all((column >= -2) & (column <= _COLUMNS + 2), axis=1)
    columns, of = distinct_rows(column[near])
    bottoms = np.full(len(columns), np.inf)
    np.minimum.at(bottoms, of, heights[visible][near])
    within_box = np.all((across >= box[:, 0]) & (across <= box[:, 1]), axis=1)
    weights = np.where(within_box, opacities, 0.0)
    centre = (weights @ across / max(float(weights.sum()), 1e-30) - box[:, 0]) / width - 0.5
    return _Underside(heights, opacities, low, high, bottoms, columns, width, centre)


def _support_level(underside: _Underside) -> float:
    """Return the height of the ground: the lower edge of the lowest level at which many columns have their bottom."""
    size = underside.size
    bottom = underside.low - 0.1 * size
    # Strays may have lowered the robust minimum of the heights, so search at least up to the height below which 3 % of
    # the mass lies.
    top = max(
        underside.low + _SEARCHED_SHARE * size,
        _mass_quantile(underside.heights, underside.opacities, 0.03) + 2.0 * _BANDWIDTH * size,
    )
    bottoms = underside.bottoms[(underside.bottoms > bottom) & (underside.bottoms < top)]
    if len(bottoms) == 0:
        return underside.low
    levels = np.linspace(bottom, top, 501)
    density = np.exp(-0.5 * ((levels[:, None] - bottoms[None, :]) / (_BANDWIDTH * size)) ** 2).sum(axis=1)
    # Choose the lowest peak that is above half of the highest one: a bevel above the sole may have a higher peak than
    # the sole.
    inner = density[1:-1]
    peaks = 1 + np.flatnonzero((inner >= density[:-2]) & (inner > density[2:]) & (inner > 0.5 * density.max()))
    mode = levels[peaks[0]] if len(peaks) else levels[int(np.argmax(density))]
    members = bottoms[np.abs(bottoms - mode) <= 1.5 * _BANDWIDTH * size]
    return float(np.quantile(members, 0.15)) if len(members) else float(mode)


def _mass_quantile(values: np.ndarray, masses: np.ndarray, share: float) -> float:
    """Return the element of ``values`` (n,) at which the cumulative sum of ``masses`` (n,) reaches the fraction
    ``share`` of the total."""
    order = np.argsort(values, kind="stable")
    mass = np.cumsum(masses[order])
    return float(values[order][min(int(np.searchsorted(mass, share * mass[-1])), len(values) - 1)])


def guess_up(
    cloud: GaussianCloud,
    capture_format_up: np.ndarray | None = None,
    *,
    tilted: bool = True,
    vertical_axis: int | None = None,
) -> tuple[np.ndarray, str]:
    """Return the up direction (3,), a unit vector, and the reason for this choice, as text for the user.

    The direction is ``capture_format_up`` if the file defines it. Otherwise it is the best of the six axes or, with
    ``tilted``, another direction in which the object clearly rests better. If the ``vertical_axis`` (0 to 2) is known,
    it is the positive direction of that axis, unless the negative one is clearly better.

    An object rests on the side where its support is wide, level, and well below its weight. The score of a direction is
    the sum of three numbers: the area of the support polygon as a fraction of the silhouette seen along it, the
    fraction of low columns that end at one level, and the depth of the centre of opacity inside the polygon.
    """
    if capture_format_up is not None:
        return np.asarray(capture_format_up, dtype=np.float64), "the file defines it"
    scores = []
    near, _ = _ordered(representatives(cloud))
    near = near.subset(np.arange(0, near.count, -(-near.count // _MAX_GAUSSIANS)))
    for axis in range(3) if vertical_axis is None else (vertical_axis,):
        for sign in (1.0, -1.0):
            up = np.zeros(3)
            up[axis] = sign
            shape = _support_shape(near, up)
            scores.append((shape.score + _AXIS_BONUS[axis], shape, up))
    if vertical_axis is not None:
        clearly_down = scores[1][0] - scores[0][0] > _CLEAR_MARGIN
        reason = f"the file names the axis {_AXIS_NAMES[vertical_axis]}, and its direction is guessed"
        return scores[1 if clearly_down else 0][2], reason
    # Python's sort is stable, so the earlier axis wins a tie.
    scores.sort(key=lambda entry: -entry[0])
    (best, shape, up), (second, _, other) = scores[0], scores[1]
    resting = _resting_up(near) if tilted and shape.level < _SURE_LEVEL else None
    advantage = resting[1].score - best if resting is not None else 0.0
    if resting is not None and resting[1].level >= _SURE_LEVEL and advantage > _CLEAR_MARGIN:
        direction, support = resting
        angle = np.degrees(np.arccos(np.abs(direction).max()))
        return direction, (
            f"guessed: {support}; the capture is tilted by {angle:.0f} degrees from {_name(direction)}, clearly ahead"
            f" of the best axis {_name(up)}: {support.score:.2f} against {best:.2f} points"
        )
    if best < _POOR_SCORE or advantage > _CLEAR_MARGIN:
        order = "no axis fits well, as if the capture were tilted; next is"
    else:
        order = f"{'clearly' if best - second > _CLEAR_MARGIN else 'narrowly'} ahead of"
    return up, f"guessed: {shape}; {order} {_name(other)}: {best:.2f} against {second:.2f} points"


def _resting_up(cloud: GaussianCloud) -> tuple[np.ndarray, _Support] | None:
    """Return the direction (3,) in which the object rests best, tilted or not; None if the object has no volume."""
    few = cloud.subset(np.arange(0, cloud.count, -(-cloud.count // _FEW_GAUSSIANS)))
    ups = resting_directions(few.means.numpy()[few.visible(_VISIBLE)].astype(np.float64), at_most=_MAX_DIRECTIONS)
    if len(ups) == 0:
        return None
    up = max(ups, key=lambda direction: _support_shape(few, direction).score)
    return up, _support_shape(cloud, up)


def _name(up: np.ndarray) -> str:
    axis = int(np.argmax(np.abs(up)))
    return f"{'-' if up[axis] < 0 else '+'}{_AXIS_NAMES[axis]}"


@dataclass(frozen=True)
class _Support:
    """Quality of the support on one side of the object; each value is from 0 to 1."""

    polygon: float
    """Area of the support polygon divided by the area of the silhouette."""
    level: float
    """Fraction of the low columns that end at the level of the support."""
    depth: float
    """Distance of the centre of opacity from the edge of the polygon, divided by the radius of a disc of the same area;
    0 if the centre is outside."""

    @property
    def score(self) -> float:
        """Sum of the three qualities, 0 to 3."""
        return self.polygon + self.level + self.depth

    def __str__(self) -> str:
        return (
            f"the support polygon there is {100 * self.polygon:.0f} % of the silhouette and "
            f"{100 * self.level:.0f} % of the low parts end at one level"
        )


def _support_shape(cloud: GaussianCloud, up: np.ndarray) -> _Support:
    try:
        underside = _underside(cloud, up)
    except UserError:  # The object is flat along this axis.
        return _Support(0.0, 0.0, 0.0)
    extent = max(underside.size, _COLUMNS * underside.column_width)
    above = underside.bottoms - _support_level(underside)
    support, low = np.abs(above) < 0.02 * extent, above < 0.12 * extent
    if not low.any():
        return _Support(0.0, 0.0, 0.0)
    level = float(np.sum(support) / np.sum(low))
    try:
        hull = ConvexHull(underside.columns[support])
    except (QhullError, ValueError):  # There are fewer than three columns, or all are in one line.
        return _Support(0.0, level, 0.0)
    inside = -(hull.equations[:, :2] @ underside.centre + hull.equations[:, 2]).max()
    depth = float(np.clip(inside / np.sqrt(hull.volume / np.pi), 0.0, 1.0))
    return _Support(min(float(hull.volume) / len(above), 1.0), level, depth)
