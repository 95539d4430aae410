"""One branch of a skeleton as a bent cylinder, and the fibres in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.muscles.fibres import Fibre, FibreKind
from egs_warp.muscles.skeleton import Branch

_RADIUS_FRACTION = 0.7
"""Fibres run at this part of the way from the branch's axis to the surface:
near enough to bend, inside enough to hold.
"""
_MAX_FLARE = 1.6
"""No fibre is further from the axis than this many section radii,
lest those of a leg spread over the seat it carries.
"""


@dataclass(frozen=True)
class FibreDensity:
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
        """Of the whole branch."""
        along = (self.azimuths + 2 * self.helices) * self.intervals
        return along + self.radial_levels * self.diameters + self.hoops * self.azimuths


class Surface:
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


class BranchCylinder:
    """A branch seen as a bent cylinder: stations along its axis, and around each the distance to the surface."""

    def __init__(
        self, branch: Branch, up: np.ndarray, forward: np.ndarray, surface: Surface, edge: float, detail: FibreDensity
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
        """(3,) of the axis at this arc length, metres."""
        return np.array([np.interp(arc, self.arc, self.branch.points[:, axis]) for axis in range(3)])

    def radius(self, arc: float) -> float:
        """Of the section at this arc length, metres."""
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
