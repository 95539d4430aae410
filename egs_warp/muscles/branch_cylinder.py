"""Model of a branch of the skeleton as a bent cylinder, and the layout of the fibres in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.muscles.fibres import Fibre, FibreKind
from egs_warp.muscles.skeleton import Branch

_RADIUS_FRACTION = 0.7
"""Distance of fibres from the axis of the branch, as a fraction of the distance to the surface.

Fibres near the surface have longer lever arms for bending; fibres farther inside are attached to more nodes.
"""
_MAX_FLARE = 1.6
"""Maximum distance from the axis to the assumed surface, in section radii.

This limit prevents the fibres of a chair's leg from spreading into the seat above it.
"""


@dataclass(frozen=True)
class FibreDensity:
    """Numbers of fibres of each kind in a branch, and of their segments."""

    azimuths: int
    """Number of longitudinal fibres, evenly spaced around the axis; a multiple of 4 for mirror symmetry in both
    horizontal axes."""
    intervals: int
    """Number of segments of each longitudinal or oblique fibre."""
    radial_levels: int
    """Number of levels of radial fibres along the branch."""
    diameters: int
    """Number of radial fibres on each level."""
    hoops: int
    """Number of circular fibres."""
    helices: int
    """Number of oblique fibres of each handedness."""

    def segment_count(self) -> int:
        """Return the total number of segments in a branch."""
        along = (self.azimuths + 2 * self.helices) * self.intervals
        return along + self.radial_levels * self.diameters + self.hoops * self.azimuths


class Surface:
    """Boundary of the body, for rays that start inside the body."""

    def __init__(self, mesh: TetMesh) -> None:
        corners = mesh.nodes[mesh.boundary_faces()]
        self.origin = corners[:, 0]
        self.sides = corners[:, 1] - self.origin, corners[:, 2] - self.origin
        self.normal = np.cross(*self.sides)

    def exit_distance(self, start: np.ndarray, direction: np.ndarray, *, limit: float) -> float:
        """Return the distance from ``start`` along the unit vector ``direction`` to the first exit from the body, at
        most ``limit``, m."""
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
    """Bent cylinder of a branch: stations along its axis, and the distances from each station to the surface."""

    def __init__(
        self, branch: Branch, up: np.ndarray, forward: np.ndarray, surface: Surface, edge: float, detail: FibreDensity
    ) -> None:
        self.branch, self.detail, self.surface = branch, detail, surface
        steps = np.linalg.norm(np.diff(branch.points, axis=0), axis=1)
        self.arc = np.concatenate([[0.0], np.cumsum(steps)])
        self.window = max(edge, float(np.median(branch.radii)))
        # The section at a junction is as wide as the body, and so wider than the limb that ends in it.
        self.radii = np.minimum(branch.radii, 1.5 * np.median(branch.radii))
        self.stations = self._place_stations(edge)
        self.up = up
        tangents = np.array([self.tangent(station) for station in self.stations])
        helpers = np.stack([forward, np.cross(up, forward), up])
        # The helper vector most orthogonal to the branch gives the most stable frame; the added 0.1 favours `forward`.
        worst = np.abs(tangents @ helpers.T).max(axis=0) + np.array([0.0, 0.1, 0.1])
        self.helper = helpers[int(np.argmin(worst))]

    def _place_stations(self, edge: float) -> np.ndarray:
        """Return the arc lengths of the fibres' vertices, m.

        At a free end or at the ground, the outermost vertex is inside the branch. At a junction, it is slightly inside
        the adjoining body: the fibres of a limb are anchored in the adjoining body but do not cross it. A vertex at the
        transition to the adjoining body keeps the fibres inside the body at a bend.
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
        """Return the point (3,) of the axis at arc length ``arc``, m."""
        return np.array([np.interp(arc, self.arc, self.branch.points[:, axis]) for axis in range(3)])

    def radius(self, arc: float) -> float:
        """Return the radius of the section at arc length ``arc``, m."""
        return float(np.interp(arc, self.arc, self.radii))

    def tangent(self, arc: float) -> np.ndarray:
        """Return the unit direction of the axis; at the ground, this is the normal of the ground, so that the first
        section lies flat on it."""
        ahead, behind = min(arc + self.window, self.arc[-1]), max(arc - self.window, 0.0)
        direction = self.centre(ahead) - self.centre(behind)
        direction = direction / np.linalg.norm(direction)
        if self.branch.starts_on_ground:
            flat = max(0.0, 1.0 - arc / self.window)
            direction = (1.0 - flat) * direction + flat * self.up
        return direction / np.linalg.norm(direction)

    def point(self, arc: float, azimuth: float) -> np.ndarray:
        """Return the point (3,) m of a fibre at arc length ``arc`` (m) and azimuth index ``azimuth``, counted
        right-handed about the axis."""
        tangent = self.tangent(arc)
        side = self.helper - (self.helper @ tangent) * tangent
        side /= np.linalg.norm(side)
        angle = 2.0 * np.pi * (azimuth + 0.5) / self.detail.azimuths
        outwards = np.cos(angle) * side + np.sin(angle) * np.cross(tangent, side)
        centre = self.centre(arc)
        reach = self.surface.exit_distance(centre, outwards, limit=_MAX_FLARE * self.radius(arc))
        return centre + _RADIUS_FRACTION * reach * outwards

    def fibres(self, name: str, group: int, *, max_force: float, max_stress: float) -> list[Fibre]:
        """Return all fibres of the branch.

        Args:
            name: name of the branch, with which the names of its fibres begin.
            group: group of the fibres.
            max_force: maximum force of a segment, N.
            max_stress: maximum force of a segment per share of the section's area, Pa. The longitudinal fibres of a
                section share its area equally.
        """
        count = self.detail.azimuths

        def strength(arc: float) -> float:
            return min(max_force, max_stress * (np.pi * self.radius(arc) ** 2 / count))

        middles = 0.5 * (self.stations[1:] + self.stations[:-1])
        strengths = np.array([strength(middle) for middle in middles])
        grid = [[self.point(station, azimuth) for azimuth in range(count)] for station in self.stations]
        fibres = [
            Fibre(
                f"{name} longitudinal {azimuth}",
                FibreKind.LONGITUDINAL,
                np.array([row[azimuth] for row in grid]),
                strengths,
                group,
            )
            for azimuth in range(count)
        ]
        for level, arc in enumerate(self._spread(self.detail.radial_levels)):
            for diameter in range(self.detail.diameters):
                azimuth = diameter * count // (2 * self.detail.diameters)
                ends = np.array([self.point(arc, azimuth), self.point(arc, azimuth + count // 2)])
                fibres.append(Fibre(f"{name} radial {level}.{diameter}", FibreKind.RADIAL, ends, strength(arc), group))
        for hoop, arc in enumerate(self._spread(self.detail.hoops)):
            ring = np.array([self.point(arc, azimuth) for azimuth in range(count)])
            ring = np.concatenate([ring, ring[:1]])
            fibres.append(Fibre(f"{name} circular {hoop}", FibreKind.CIRCULAR, ring, strength(arc), group))
        for kind, hand in ((FibreKind.OBLIQUE_RIGHT, 1), (FibreKind.OBLIQUE_LEFT, -1)):
            for helix in range(self.detail.helices):
                azimuth = helix * count // self.detail.helices
                azimuth = azimuth if hand > 0 else count - 1 - azimuth
                points = [grid[0][azimuth]]
                for row, before, after in zip(grid[1:], self.stations[:-1], self.stations[1:], strict=True):
                    azimuth = (azimuth + hand * self._azimuth_steps(before, after)) % count
                    points.append(row[azimuth])
                fibres.append(Fibre(f"{name} {kind.value} {helix}", kind, np.array(points), strengths, group))
        return fibres

    def _spread(self, count: int) -> np.ndarray:
        """Return the arc lengths of ``count`` evenly spaced levels within the stations."""
        first, last = self.stations[0], self.stations[-1]
        return first + (last - first) * (np.arange(count) + 0.5) / max(count, 1)

    def _azimuth_steps(self, before: float, after: float) -> int:
        """Return the azimuth steps between two stations for a helix of about 45 degrees; at most a quarter turn."""
        radius = _RADIUS_FRACTION * self.radius(0.5 * (before + after))
        steps = round((after - before) / radius * self.detail.azimuths / (2.0 * np.pi))
        return int(np.clip(steps, 1, self.detail.azimuths // 4))
