"""Automatic fibres along the branches of a body's curve skeleton."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from egs_warp.attachments import mean_edge_length
from egs_warp.fibres import Fibre, FibreKind
from egs_warp.skeleton import Branch, Skeleton
from egs_warp.tetmesh import TetMesh

_RADIUS_FRACTION = 0.7
"""Fibres run at this part of the way from the branch's axis to the surface: near enough to bend, inside enough to hold."""
_MAX_FLARE = 1.6
"""No fibre is further from the axis than this many section radii, lest those of a leg spread over the seat it carries."""


@dataclass(frozen=True)
class _Detail:
    """How many fibres a branch gets."""

    azimuths: int
    """Longitudinal fibres, evenly around the axis: a multiple of 4, so that they mirror in both horizontal axes."""
    intervals: int
    """Segments of each longitudinal or oblique fibre."""
    radial_levels: int
    diameters: int
    """Radial fibres on each level."""
    hoops: int
    helices: int
    """Oblique fibres of each hand."""

    def segment_count(self) -> int:
        along = (self.azimuths + 2 * self.helices) * self.intervals
        return along + self.radial_levels * self.diameters + self.hoops * self.azimuths


_DETAILS = (
    _Detail(8, 5, 4, 4, 2, 2),
    _Detail(8, 4, 3, 2, 1, 2),
    _Detail(4, 3, 2, 2, 1, 2),
    _Detail(4, 2, 1, 2, 1, 2),
    _Detail(4, 2, 1, 2, 1, 1),
    _Detail(4, 1, 1, 2, 1, 1),
)
"""From the richest to the poorest."""
_LEG_DETAILS = (_Detail(4, 4, 1, 2, 1, 1), _Detail(4, 3, 1, 1, 1, 1), *_DETAILS[-2:])
"""The same of each leg of a body on ``_LEGS`` or more. A foot is carried ahead and set down flat by a leg that bends one way
above and the other way below, which takes three segments on each side of it."""
_LEGS = 3
_SEGMENTS, _LEGGED_SEGMENTS = 112, 120


def is_legged(skeleton: Skeleton) -> bool:
    """Whether the body stands on three legs or more."""
    return sum(branch.starts_on_ground for branch in skeleton.branches) >= _LEGS


def lay_fibres(
    mesh: TetMesh, skeleton: Skeleton, *, max_force: float, max_stress: float, max_segments: int | None = None
) -> list[Fibre]:
    """Longitudinal, radial, circular and oblique fibres on every branch, at most ``max_segments`` segments in all (112; for a
    body on three legs or more 120).

    ``max_force`` in newtons bounds each segment; ``max_stress`` in pascals bounds all longitudinal fibres of one section
    together. Branches too many for the budget go without, the least voluminous first.
    """
    edge = mean_edge_length(mesh)
    surface = _Surface(mesh)
    forward = _principal_horizontal(mesh, skeleton.up)
    fibres: list[Fibre] = []
    for group, (branch, detail) in enumerate(_share_segments(skeleton, edge, max_segments)):
        tube = _Tube(branch, skeleton.up, forward, surface, edge, detail)
        name = "trunk" if group == 0 else f"limb {group}"
        fibres += [
            replace(fibre, group=group, max_force=np.minimum(max_force, max_stress * fibre.max_force))
            for fibre in tube.fibres(name)
        ]
    return _with_partners(fibres, _centre(mesh), skeleton.up, forward, tolerance=0.75 * edge)


def _share_segments(skeleton: Skeleton, edge: float, budget: int | None) -> list[tuple[Branch, _Detail]]:
    """The detail of each branch; like branches (the four legs of a stool) get the same."""
    legged = is_legged(skeleton)
    budget = budget or (_LEGGED_SEGMENTS if legged else _SEGMENTS)
    families: list[list[Branch]] = []
    for branch in skeleton.branches:
        like = families[-1][0] if families else None
        if legged and like and like.starts_on_ground != branch.starts_on_ground:
            like = None
        if like and branch.volume > 0.7 * like.volume and 0.75 < branch.length / like.length < 1.33:
            families[-1].append(branch)
        else:
            families.append([branch])
    levels = [0] * len(families)
    ladders = [_LEG_DETAILS if legged and family[0].starts_on_ground else _DETAILS for family in families]

    def detail(family: int) -> _Detail:
        chosen = ladders[family][levels[family]]
        shortest = min(branch.length for branch in families[family])
        return replace(chosen, intervals=int(np.clip(round(shortest / (1.2 * edge)), 1, chosen.intervals)))

    def count(family: int) -> int:
        return len(families[family]) * detail(family).segment_count()

    def greed(family: int) -> tuple[bool, float]:
        """Segments against the volume they move; legs count double, since they alone push the ground, and those of a body on
        many legs come last."""
        volume = sum(branch.volume * (2.0 if branch.starts_on_ground else 1.0) for branch in families[family])
        return ladders[family] is _DETAILS, count(family) / volume**0.5

    while sum(count(family) for family in range(len(families))) > budget:
        reducible = [family for family in range(len(families)) if levels[family] < len(ladders[family]) - 1]
        if reducible:
            levels[max(reducible, key=greed)] += 1
        elif len(families) > 1:
            families.pop()
            levels.pop()
        else:
            break
    return [(branch, detail(index)) for index, family in enumerate(families) for branch in family]


class _Surface:
    """Rays from inside the body to its surface."""

    def __init__(self, mesh: TetMesh) -> None:
        corners = mesh.nodes[mesh.boundary_faces()]
        self.origin = corners[:, 0]
        self.sides = corners[:, 1] - self.origin, corners[:, 2] - self.origin
        self.normal = np.cross(*self.sides)

    def exit_distance(self, start: np.ndarray, direction: np.ndarray, *, limit: float) -> float:
        """Metres from ``start`` along unit ``direction`` to where the ray first leaves the body; at most ``limit``."""
        facing = self.normal @ direction
        leaving = facing > 1e-12 * np.linalg.norm(self.normal, axis=1)
        to_start = start - self.origin
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -np.einsum("fi,fi->f", self.normal, to_start) / facing
            across = np.cross(to_start, direction)
            first = -np.einsum("fi,fi->f", across, self.sides[1]) / facing
            second = np.einsum("fi,fi->f", across, self.sides[0]) / facing
        slack = 1e-9
        hit = leaving & (distance > 0) & (first >= -slack) & (second >= -slack) & (first + second <= 1 + slack)
        return min(limit, float(distance[hit].min())) if hit.any() else limit


class _Tube:
    """A branch seen as a bent cylinder: stations along its axis, and around each the distance to the surface."""

    def __init__(
        self, branch: Branch, up: np.ndarray, forward: np.ndarray, surface: _Surface, edge: float, detail: _Detail
    ) -> None:
        self.branch, self.detail, self.surface = branch, detail, surface
        steps = np.linalg.norm(np.diff(branch.points, axis=0), axis=1)
        self.arc = np.concatenate([[0.0], np.cumsum(steps)])
        self.window = max(edge, float(np.median(branch.radii)))
        # A junction's section is as wide as the whole body there; the limb that ends in it is not.
        self.radii = np.minimum(branch.radii, 1.5 * np.median(branch.radii))
        self.stations = self._place_stations(edge)
        self.up = up
        tangents = np.array([self.tangent(station) for station in self.stations])
        helpers = np.stack([forward, np.cross(up, forward), up])
        # The helper least along the branch gives the most stable frame; the margin keeps upright branches on `forward`.
        worst = np.abs(tangents @ helpers.T).max(axis=0) + np.array([0.0, 0.1, 0.1])
        self.helper = helpers[int(np.argmin(worst))]

    def _place_stations(self, edge: float) -> np.ndarray:
        """Arc lengths of the fibres' vertices: inside a free or ground end, and a little way into a junction.

        A limb's fibres hold on to the body that carries it but do not cross it, and have a vertex where they enter it,
        lest they leave the body on the inside of the bend.
        """
        slim = np.flatnonzero(self.branch.own & (self.branch.radii <= 1.25 * np.median(self.branch.radii)))
        enters = float(self.arc[slim[0]]) if len(slim) else 0.0
        leaves = float(self.arc[slim[-1]]) if len(slim) else float(self.arc[-1])
        into_junction = 0.5 * (edge + self.window)
        ends = [
            0.45 * edge,
            max(float(self.arc[-1]) - max(0.45 * edge, 0.4 * float(self.radii[-1])), 0.6 * self.arc[-1]),
        ]
        if not self.branch.starts_on_ground:
            ends[0] = max(0.0, enters - into_junction)
        if not self.branch.ends_freely:
            ends[1] = min(float(self.arc[-1]), leaves + into_junction)
        stations = np.linspace(ends[0], ends[1], self.detail.intervals + 1)
        if self.detail.intervals > 1:
            if not self.branch.ends_freely and ends[0] + edge < leaves < ends[1] - 0.5 * edge:
                stations[:-1] = np.linspace(ends[0], leaves, self.detail.intervals)
            elif not self.branch.starts_on_ground and ends[0] + 0.5 * edge < enters < ends[1] - edge:
                stations[1:] = np.linspace(enters, ends[1], self.detail.intervals)
        return stations

    def centre(self, arc: float) -> np.ndarray:
        return np.array([np.interp(arc, self.arc, self.branch.points[:, axis]) for axis in range(3)])

    def radius(self, arc: float) -> float:
        return float(np.interp(arc, self.arc, self.radii))

    def tangent(self, arc: float) -> np.ndarray:
        """Unit direction of the axis; on the ground it is the ground's normal, so that the first section lies flat."""
        ahead, behind = min(arc + self.window, self.arc[-1]), max(arc - self.window, 0.0)
        direction = self.centre(ahead) - self.centre(behind)
        direction = direction / np.linalg.norm(direction)
        if self.branch.starts_on_ground:
            flat = max(0.0, 1.0 - arc / self.window)
            direction = (1.0 - flat) * direction + flat * self.up
        return direction / np.linalg.norm(direction)

    def point(self, arc: float, azimuth: float) -> np.ndarray:
        """The fibres' place at this arc length and azimuth index (turning right-handed about the axis)."""
        tangent = self.tangent(arc)
        side = self.helper - (self.helper @ tangent) * tangent
        side /= np.linalg.norm(side)
        angle = 2.0 * np.pi * (azimuth + 0.5) / self.detail.azimuths
        outwards = np.cos(angle) * side + np.sin(angle) * np.cross(tangent, side)
        centre = self.centre(arc)
        reach = self.surface.exit_distance(centre, outwards, limit=_MAX_FLARE * self.radius(arc))
        return centre + _RADIUS_FRACTION * reach * outwards

    def fibres(self, name: str) -> list[Fibre]:
        """All fibres of the branch; ``max_force`` here is each one's share of the section's area, square metres."""
        count = self.detail.azimuths
        middles = 0.5 * (self.stations[1:] + self.stations[:-1])
        shares = np.array([np.pi * self.radius(middle) ** 2 for middle in middles]) / count
        grid = [[self.point(station, azimuth) for azimuth in range(count)] for station in self.stations]
        fibres = [
            Fibre(
                f"{name} longitudinal {azimuth}",
                FibreKind.LONGITUDINAL,
                np.array([row[azimuth] for row in grid]),
                shares,
            )
            for azimuth in range(count)
        ]
        for level, arc in enumerate(self._spread(self.detail.radial_levels)):
            share = np.pi * self.radius(arc) ** 2 / count
            for diameter in range(self.detail.diameters):
                azimuth = diameter * count // (2 * self.detail.diameters)
                ends = np.array([self.point(arc, azimuth), self.point(arc, azimuth + count // 2)])
                fibres.append(Fibre(f"{name} radial {level}.{diameter}", FibreKind.RADIAL, ends, share))
        for hoop, arc in enumerate(self._spread(self.detail.hoops)):
            ring = np.array([self.point(arc, azimuth) for azimuth in range(count)])
            ring = np.concatenate([ring, ring[:1]])
            share = np.pi * self.radius(arc) ** 2 / count
            fibres.append(Fibre(f"{name} circular {hoop}", FibreKind.CIRCULAR, ring, share))
        for kind, hand in ((FibreKind.OBLIQUE_RIGHT, 1), (FibreKind.OBLIQUE_LEFT, -1)):
            for helix in range(self.detail.helices):
                azimuth = helix * count // self.detail.helices
                azimuth = azimuth if hand > 0 else count - 1 - azimuth
                points = [grid[0][azimuth]]
                for row, before, after in zip(grid[1:], self.stations[:-1], self.stations[1:], strict=True):
                    azimuth = (azimuth + hand * self._turn(before, after)) % count
                    points.append(row[azimuth])
                fibres.append(Fibre(f"{name} {kind.value} {helix}", kind, np.array(points), shares))
        return fibres

    def _spread(self, count: int) -> np.ndarray:
        """Arc lengths of ``count`` levels evenly inside the stations."""
        first, last = self.stations[0], self.stations[-1]
        return first + (last - first) * (np.arange(count) + 0.5) / max(count, 1)

    def _turn(self, before: float, after: float) -> int:
        """Azimuth steps between two stations that bring a helix nearest to 45 degrees; at most a quarter turn."""
        radius = _RADIUS_FRACTION * self.radius(0.5 * (before + after))
        steps = round((after - before) / radius * self.detail.azimuths / (2.0 * np.pi))
        return int(np.clip(steps, 1, self.detail.azimuths // 4))


def _centre(mesh: TetMesh) -> np.ndarray:
    return np.average(mesh.nodes, axis=0, weights=mesh.lumped_masses(1.0))


def _principal_horizontal(mesh: TetMesh, up: np.ndarray) -> np.ndarray:
    """Unit horizontal vector (3,) along which the body is widest; a round body gets a fixed one.

    Its sign is fixed too: rounding must not choose between a direction and its opposite.
    """
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = np.cross(helper, up)
    first /= np.linalg.norm(first)
    plane = np.stack([first, np.cross(up, first)])
    flat = (mesh.nodes - _centre(mesh)) @ plane.T
    second_moments = (flat * mesh.lumped_masses(1.0)[:, None]).T @ flat
    values, vectors = np.linalg.eigh(second_moments)
    if values[1] < 1.1 * values[0]:
        return first
    widest = vectors[:, 1] @ plane
    return widest * (1.0 if widest[int(np.argmax(np.abs(widest)))] > 0 else -1.0)


_MIRRORED = {FibreKind.OBLIQUE_LEFT: FibreKind.OBLIQUE_RIGHT, FibreKind.OBLIQUE_RIGHT: FibreKind.OBLIQUE_LEFT}


def _with_partners(
    fibres: list[Fibre], centre: np.ndarray, up: np.ndarray, forward: np.ndarray, *, tolerance: float
) -> list[Fibre]:
    """Fibres with their mirror images named, in whichever of the two upright principal planes mirrors more of them."""
    best: dict[str, str] = {}
    for normal in (forward, np.cross(up, forward)):
        found: dict[str, str] = {}
        for fibre in fibres:
            image = fibre.points - 2.0 * ((fibre.points - centre) @ normal)[:, None] * normal
            candidates = [
                (distance, other.name)
                for other in fibres
                if other.kind is _MIRRORED.get(fibre.kind, fibre.kind)
                and (distance := _polyline_distance(image, other.points)) < tolerance
            ]
            if candidates:
                found[fibre.name] = min(candidates)[1]
        mutual = {name: other for name, other in found.items() if found.get(other) == name}
        if len(mutual) > len(best):
            best = mutual
    return [replace(fibre, partner=best.get(fibre.name)) for fibre in fibres]


def _polyline_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Largest distance from a vertex of one polyline to the nearest of the other, both ways."""
    if len(first) != len(second):
        return float("inf")
    apart = np.linalg.norm(first[:, None] - second[None], axis=2)
    return float(max(apart.min(axis=0).max(), apart.min(axis=1).max()))
