"""Solids of the procedural rooms: ellipsoids and boxes whose surfaces are sampled, and the toys and furniture composed
of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from egs_warp.assets.surface import SurfaceSamples

Colour = tuple[float, float, float]

_AMBIENT, _SKY = 0.35, 0.2
"""Ambient irradiance from all directions, and additional irradiance from above."""
_RAYS = 16
"""Number of rays to the disc of a light."""
_OFFSET = 0.02
"""Distance of the origin of a shadow ray from its surface; Gaussians lie up to a quarter of their spacing below the
surface."""


@dataclass(frozen=True)
class Solid:
    """An ellipsoid or a box."""

    centre: np.ndarray
    """(3,) centre, scene units."""
    half: np.ndarray
    """(3,) half axes, or half sides of a box, scene units."""
    colour: Colour
    """Linear albedo of the surface."""
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3) axes of the solid as columns, in the axes of the room."""
    is_box: bool = False

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return (n,) bool, True for ``points`` (n, 3) inside."""
        local = (points - self.centre) @ self.turn / self.half
        return np.abs(local).max(axis=1) < 1.0 if self.is_box else (local**2).sum(axis=1) < 1.0

    def is_hit(self, origins: np.ndarray, ray: np.ndarray) -> np.ndarray:
        """Return (n,) bool, True where the half-line from ``origins`` (n, 3) along ``ray`` (3,) meets the solid."""
        start, along = (origins - self.centre) @ self.turn / self.half, ray @ self.turn / self.half
        if self.is_box:
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = np.sort(np.stack([(-1.0 - start) / along, (1.0 - start) / along]), axis=0)
            enter, leave = ends[0].max(axis=1), ends[1].min(axis=1)
            return (enter <= leave) & (leave > 0.0)
        a, b, c = along @ along, start @ along, (start * start).sum(axis=1) - 1.0
        root = b * b - a * c
        return (root > 0.0) & (-b + np.sqrt(np.maximum(root, 0.0)) > 0.0)

    def samples(self, spacing: float, random: np.random.Generator) -> SurfaceSamples:
        """Return points spread evenly over the surface, about ``spacing`` (scene units) apart."""
        if self.is_box:
            local, normals = self._on_faces(spacing, random)
        else:
            # Thomsen's formula for the area of an ellipsoid, which is accurate to 1.1 %.
            a, b, c = self.half
            power = 1.6075
            products = np.array([a * b, a * c, b * c]) ** power
            count = max(int(4.0 * np.pi * products.mean() ** (1.0 / power) / spacing**2), 12)
            directions = random.normal(size=(8 * count, 3))
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            # The area of the ellipsoid per solid angle of the unit sphere is proportional to this length.
            stretch = np.linalg.norm(directions / self.half, axis=1)
            accepted = np.flatnonzero(random.uniform(0.0, stretch.max(), len(stretch)) < stretch)[:count]
            local = directions[accepted] * self.half
            normals = directions[accepted] / self.half
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return SurfaceSamples(self.centre + local @ self.turn.T, normals @ self.turn.T, spacing)

    def _on_faces(self, spacing: float, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return points (n, 3) on the six faces and their normals (n, 3), in the axes of the box."""
        places, normals = [], []
        for axis in range(3):
            across = [other for other in range(3) if other != axis]
            for sign in (-1.0, 1.0):
                flat = jittered_grid(self.half[across], spacing, random)
                local = np.full((len(flat), 3), sign * self.half[axis])
                local[:, across] = flat
                places.append(local)
                normals.append(np.tile(sign * np.eye(3)[axis], (len(flat), 1)))
        return np.concatenate(places), np.concatenate(normals)

    def moved(self, shift: Sequence[float], degrees: float = 0.0, scale: float = 1.0) -> Solid:
        """Return the solid scaled and turned by ``degrees`` about the vertical axis, both about the origin, then moved
        by ``shift`` (3,)."""
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        return replace(self, centre=scale * turn @ self.centre + shift, half=scale * self.half, turn=turn @ self.turn)


@dataclass(frozen=True)
class SceneLight:
    """Ambient light and a distant light, in the room's axes."""

    direction: np.ndarray
    """(3,) unit vector to the light."""
    half_angle: float
    """Half angle of the light's disc, degrees."""
    key: float
    """Irradiance of a surface that faces the light."""

    def visible(self, points: np.ndarray, normals: np.ndarray, solids: Sequence[Solid]) -> np.ndarray:
        """Return the fraction (n,) of the light's disc that reaches ``points`` (n, 3) with ``normals`` (n, 3)."""
        first = np.cross(self.direction, [0.3, 0.5, 0.8])
        first /= np.linalg.norm(first)
        second = np.cross(self.direction, first)
        numbers = np.arange(_RAYS)
        radii = np.tan(np.radians(self.half_angle)) * np.sqrt((numbers + 0.5) / _RAYS)
        angles = 2.399963 * numbers
        origins, seen = points + _OFFSET * normals, np.zeros(len(points))
        for radius, angle in zip(radii, angles, strict=True):
            ray = self.direction + radius * (np.cos(angle) * first + np.sin(angle) * second)
            free = np.ones(len(points), bool)
            for one in solids:
                free &= ~one.is_hit(origins, ray)
            seen += free
        return seen / _RAYS

    def irradiance(self, points: np.ndarray, normals: np.ndarray, solids: Sequence[Solid]) -> np.ndarray:
        """Return the irradiance (n,) of surface points (n, 3) between ``solids``."""
        ambient = _AMBIENT + _SKY * np.clip(normals[:, 2], 0.0, None)
        cosine = np.clip(normals @ self.direction, 0.0, None)
        return ambient + self.key * cosine * self.visible(points, normals, solids)


def ellipsoid(centre: Sequence[float], half: Sequence[float], colour: Colour, *, tilt: float = 0.0) -> Solid:
    """Create an ellipsoid tilted by ``tilt`` degrees about the axis x."""
    turn = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    return Solid(np.array(centre, float), np.array(half, float), colour, turn)


def box(low: Sequence[float], high: Sequence[float], colour: Colour) -> Solid:
    """Create an axis-aligned box from two opposite corners."""
    first, second = np.array(low, float), np.array(high, float)
    return Solid(0.5 * (first + second), 0.5 * (second - first), colour, is_box=True)


def jittered_grid(half: np.ndarray, spacing: float, random: np.random.Generator) -> np.ndarray:
    """Return (n, 2) points of a jittered grid in the rectangle with half sides ``half`` (2,), about ``spacing``
    apart."""
    counts = np.maximum(np.rint(2.0 * half / spacing).astype(int), 1)
    cells = np.indices(tuple(counts)).reshape(2, -1).T + random.uniform(0.15, 0.85, (int(counts.prod()), 2))
    return half * (2.0 * cells / counts - 1.0)


def on_both_sides(make: Callable[[float], Solid]) -> list[Solid]:
    """Return the limbs on the two sides, ``make(-1)`` and ``make(1)``."""
    return [make(-1.0), make(1.0)]


def _bear() -> list[Solid]:
    fur, pale = (0.38, 0.20, 0.09), (0.62, 0.45, 0.28)
    return [
        ellipsoid((0, 0, 0.33), (0.25, 0.22, 0.33), fur),
        ellipsoid((0, -0.02, 0.75), (0.22, 0.20, 0.20), fur),
        ellipsoid((0, -0.19, 0.70), (0.09, 0.08, 0.07), pale),
        *on_both_sides(lambda s: ellipsoid((0.17 * s, 0, 0.93), (0.08, 0.05, 0.08), pale)),
        *on_both_sides(lambda s: ellipsoid((0.27 * s, -0.08, 0.42), (0.08, 0.09, 0.20), fur, tilt=-30.0)),
        *on_both_sides(lambda s: ellipsoid((0.17 * s, -0.28, 0.09), (0.10, 0.22, 0.10), fur)),
    ]


def _rabbit() -> list[Solid]:
    fur, pink = (0.66, 0.62, 0.58), (0.75, 0.42, 0.42)
    return [
        ellipsoid((0, 0.1, 0.24), (0.22, 0.36, 0.24), fur),
        ellipsoid((0, -0.3, 0.42), (0.17, 0.18, 0.17), fur),
        *on_both_sides(lambda s: ellipsoid((0.09 * s, -0.22, 0.76), (0.05, 0.04, 0.24), pink, tilt=-10.0)),
        *on_both_sides(lambda s: ellipsoid((0.13 * s, -0.36, 0.07), (0.06, 0.16, 0.07), fur)),
        ellipsoid((0, 0.46, 0.2), (0.09, 0.09, 0.09), (0.85, 0.83, 0.80)),
    ]


def _dog() -> list[Solid]:
    coat, dark = (0.50, 0.36, 0.18), (0.14, 0.09, 0.06)
    legs = [ellipsoid((x, y, 0.17), (0.075, 0.075, 0.20), coat) for x in (-0.13, 0.13) for y in (-0.28, 0.26)]
    return [
        ellipsoid((0, 0, 0.42), (0.19, 0.42, 0.18), coat),
        ellipsoid((0, -0.45, 0.66), (0.17, 0.18, 0.16), coat),
        ellipsoid((0, -0.62, 0.61), (0.08, 0.11, 0.07), dark),
        *on_both_sides(lambda s: ellipsoid((0.16 * s, -0.42, 0.66), (0.04, 0.08, 0.14), dark)),
        ellipsoid((0, 0.46, 0.56), (0.04, 0.05, 0.18), coat, tilt=-25.0),
        *legs,
    ]


def _duck() -> list[Solid]:
    yellow, beak = (0.80, 0.58, 0.08), (0.75, 0.25, 0.05)
    return [
        ellipsoid((0, 0.05, 0.27), (0.28, 0.38, 0.27), yellow),
        ellipsoid((0, -0.2, 0.64), (0.19, 0.19, 0.19), yellow),
        ellipsoid((0, -0.4, 0.61), (0.10, 0.12, 0.04), beak),
        *on_both_sides(lambda s: ellipsoid((0.26 * s, 0.08, 0.32), (0.05, 0.22, 0.14), yellow)),
    ]


def _robot() -> list[Solid]:
    grey, red = (0.36, 0.40, 0.45), (0.55, 0.10, 0.08)
    return [
        box((-0.24, -0.16, 0.30), (0.24, 0.16, 0.68), red),
        box((-0.17, -0.15, 0.70), (0.17, 0.15, 0.97), grey),
        box((-0.06, -0.06, 0.64), (0.06, 0.06, 0.72), grey),
        *on_both_sides(lambda s: box((0.14 * s - 0.07, -0.12, 0.0), (0.14 * s + 0.07, 0.12, 0.32), grey)),
        *on_both_sides(lambda s: box((0.30 * s - 0.06, -0.08, 0.28), (0.30 * s + 0.06, 0.08, 0.66), grey)),
    ]


def _blocks() -> list[Solid]:
    return [
        box((-0.35, -0.2, 0.0), (0.35, 0.2, 0.3), (0.60, 0.12, 0.10)),
        box((-0.25, -0.18, 0.3), (0.18, 0.18, 0.6), (0.10, 0.25, 0.55)),
        box((-0.13, -0.13, 0.6), (0.13, 0.13, 0.86), (0.72, 0.55, 0.10)),
    ]


TOYS: Mapping[str, Callable[[], list[Solid]]] = {
    "bear": _bear,
    "rabbit": _rabbit,
    "dog": _dog,
    "duck": _duck,
    "robot": _robot,
    "blocks": _blocks,
}
"""Toys of about one unit in height that stand on z = 0 at the origin and face -y."""

_WOOD, _WHITE, _CLOTH = (0.33, 0.19, 0.09), (0.62, 0.61, 0.58), (0.20, 0.28, 0.24)


def table(height: float) -> list[Solid]:
    """Create a table without a floor, whose top is at z = ``height`` and whose legs are two units long."""
    legs = [
        box((x - 0.08, y - 0.08, height - 2.0), (x + 0.08, y + 0.08, height - 0.1), _WOOD)
        for x in (-1.6, 1.6)
        for y in (-1.1, 1.1)
    ]
    return [box((-1.8, -1.3, height - 0.12), (1.8, 1.3, height), _WOOD), *legs]


def chair() -> list[Solid]:
    """Create a chair with its seat at z = 0 and its back at y = 0.5."""
    legs = [
        box((x - 0.06, y - 0.06, -1.6), (x + 0.06, y + 0.06, -0.05), _WOOD) for x in (-0.7, 0.7) for y in (-0.75, 0.5)
    ]
    slats = [box((-0.75, 0.5, low), (0.75, 0.58, low + 0.28), _WOOD) for low in (0.25, 0.7, 1.15)]
    posts = on_both_sides(lambda s: box((0.7 * s - 0.06, 0.47, 0.0), (0.7 * s + 0.06, 0.61, 1.45), _WOOD))
    return [box((-0.8, -0.85, -0.1), (0.8, 0.6, 0.0), _WOOD), *legs, *slats, *posts]


def sofa() -> list[Solid]:
    """Create a sofa with its seat at z = 0 and its back at y = 0.45."""
    arms = on_both_sides(lambda s: box((1.7 * s - 0.25, -1.3, -1.0), (1.7 * s + 0.25, 0.9, 0.5), _CLOTH))
    return [box((-1.5, -1.25, -1.0), (1.5, 0.5, 0.0), _CLOTH), box((-1.5, 0.45, -1.0), (1.5, 0.95, 1.1), _CLOTH), *arms]


def shelf() -> list[Solid]:
    """Create a bookcase with one of its boards at z = 0."""
    boards = [box((-1.3, -0.6, low - 0.08), (1.3, 0.7, low), _WHITE) for low in (-1.5, 0.0, 1.5)]
    sides = on_both_sides(lambda s: box((1.3 * s - 0.05, -0.6, -1.6), (1.3 * s + 0.05, 0.7, 1.55), _WHITE))
    books = [
        box((x, -0.3, 0.0), (x + 0.16, 0.6, height), colour)
        for x, height, colour in (
            (0.6, 0.9, (0.12, 0.20, 0.42)),
            (0.77, 1.1, (0.45, 0.09, 0.09)),
            (0.94, 0.8, (0.15, 0.35, 0.18)),
        )
    ]
    return [*boards, *sides, box((-1.3, 0.68, -1.6), (1.3, 0.75, 1.55), _WHITE), *books]


def wardrobe(side: float, floor: float) -> list[Solid]:
    """Create a wardrobe at x = ``side``, from z = ``floor``."""
    middle = side + 1.0 * np.sign(side)
    return [box((middle - 1.0, -0.9, floor), (middle + 1.0, 1.1, floor + 5.5), _WHITE)]


def pillow(shift: Sequence[float]) -> list[Solid]:
    """Create a pillow."""
    return [ellipsoid((0, 0, 0.1), (0.75, 0.45, 0.2), (0.70, 0.68, 0.64)).moved(shift, 20.0)]
