"""Tetrahedra inside a level set: isosurface stuffing with a body-centred cubic lattice that is cut off at a plane.

F. Labelle and J. R. Shewchuk, "Isosurface stuffing: fast tetrahedral meshes with good dihedral angles", SIGGRAPH 2007.
Lattice points close to the surface are moved onto it; tetrahedra that the surface still crosses are cut. At the plane,
the lowest tetrahedra are halves of lattice tetrahedra, with an additional point in the middle of each square. The
bottom is therefore exactly flat, and its outline is as fine as any other part of the surface.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from egs_warp.geometry.unique_rows import distinct_rows

Field = Callable[[np.ndarray], np.ndarray]
"""Function that returns the signed distance (m,) at points (m, 3), negative inside."""

_SNAP_LONG, _SNAP_SHORT = 0.25, 0.41
"""Maximum distance from a lattice point to the surface at which the point is moved onto it, as a fraction of a long
edge (side of a cube) and of a short edge (half body diagonal). Away from the floor, dihedral angles are then at least
9.26 degrees (tests/meshing/test_stuffing.py)."""


def isosurface_stuffing(field: Field, low: np.ndarray, high: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Fill ``field`` < 0 above z = 0 with tetrahedra.

    Parts thinner than about a cell may be missed, because they may contain no lattice point.

    Args:
        field: signed distance, negative inside.
        low: (3,) lower corner of a box that contains the solid.
        high: (3,) upper corner of this box.
        cell: side of the lattice's cubes, in the units of the points.

    Returns:
        Nodes (N, 3) and tetrahedra (T, 4) of either orientation; T is 0 if no lattice point is inside.
    """
    points, tets, long_edges, is_floor = _lattice(low, high, cell)
    value = field(points)
    tets, long_edges = _crossed_or_inside(value, tets, long_edges)
    edges, edge_of = _unique_edges(tets)
    edge_is_long = np.zeros(len(edges), bool)
    edge_is_long[edge_of[np.arange(len(tets))[:, None], long_edges]] = True
    points, value = _snap(field, points, value, edges, edge_is_long, is_floor)
    sign = np.where(value < 0.0, 1, np.where(value > 0.0, -1, 0))
    cut = sign[edges[:, 0]] * sign[edges[:, 1]] < 0
    cut_points = _roots(field, points[edges[cut, 0]], points[edges[cut, 1]], sign[edges[cut, 0]])
    node_of_edge = np.full(len(edges), -1)
    node_of_edge[cut] = len(points) + np.arange(np.count_nonzero(cut))
    nodes = np.concatenate([points, cut_points])
    filled = _fill_tets(nodes, tets, sign, edges, edge_is_long, node_of_edge)
    used, compact = np.unique(filled, return_inverse=True)
    return nodes[used], compact.reshape(-1, 4)


_CORNER_PAIRS = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])


def _lattice(low: np.ndarray, high: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the points (P, 3) and tetrahedra (T, 4) of the lattice, the two long edges (T, 2) of each tetrahedron as
    indices into ``_CORNER_PAIRS``, and the mask (P,) bool of points on the floor."""
    centre = 0.5 * (low + high)[:2]
    half = np.ceil(0.5 * (high - low)[:2] / cell).astype(int) + 1
    nx, ny = 2 * half
    nz = int(np.ceil(high[2] / cell)) + 1
    start = np.append(centre - half * cell, 0.0)
    corner = np.arange((nx + 1) * (ny + 1) * (nz + 1)).reshape(nx + 1, ny + 1, nz + 1)
    middle = corner.size + np.arange(nx * ny * nz).reshape(nx, ny, nz)
    floor = corner.size + middle.size + np.arange(nx * ny).reshape(nx, ny)

    def positions(shape: tuple[int, ...], shift: tuple[float, float, float]) -> np.ndarray:
        return start + cell * (np.indices(shape).reshape(3, -1).T + np.array(shift))

    points = np.concatenate(
        [
            positions(corner.shape, (0.0, 0.0, 0.0)),
            positions(middle.shape, (0.5, 0.5, 0.5)),
            positions((nx, ny, 1), (0.5, 0.5, 0.0)),
        ]
    )
    pieces = []
    for axis in range(3):
        # The square between two neighbouring cells, with its corners in order. The point below a square on the floor is
        # a floor point.
        other = [k for k in range(3) if k != axis]
        count = [nx, ny, nz]
        inner = [slice(None)] * 3
        first, second = list(inner), list(inner)
        first[axis], second[axis] = slice(0, -1), slice(1, None)
        below, above = middle[tuple(first)], middle[tuple(second)]
        if axis == 2:
            below = np.concatenate([floor[:, :, None], below], axis=2)
            above = middle
        squares = []
        for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
            pick = list(inner)
            pick[axis] = slice(0, count[axis]) if axis == 2 else slice(1, count[axis])
            pick[other[0]] = slice(a, count[other[0]] + a)
            pick[other[1]] = slice(b, count[other[1]] + b)
            squares.append(corner[tuple(pick)].ravel())
        for side in range(4):
            pieces.append(np.stack([squares[side], squares[(side + 1) % 4], below.ravel(), above.ravel()], axis=1))
    tets = np.concatenate(pieces)
    long_edges = np.broadcast_to([0, 5], (len(tets), 2))
    return points, tets, long_edges, points[:, 2] == 0.0


def _crossed_or_inside(value: np.ndarray, tets: np.ndarray, long_edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the tetrahedra with at least one corner inside the surface, and their long edges."""
    keep = np.any(value[tets] < 0.0, axis=1)
    return tets[keep], long_edges[keep]


def _unique_edges(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges (E, 2), lower point first, and the edge indices (T, 6) of each tetrahedron."""
    ends = np.sort(tets[:, _CORNER_PAIRS].reshape(-1, 2), axis=1)
    edges, edge_of = distinct_rows(ends)
    return edges, edge_of.reshape(-1, 6)


def _snap(
    field: Field,
    points: np.ndarray,
    value: np.ndarray,
    edges: np.ndarray,
    edge_is_long: np.ndarray,
    is_floor: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (P, 3) and values (P,) after points near the surface have been moved to the nearest
    intersection of one of their edges with the surface. Floor points move only along the floor."""
    cut = np.flatnonzero(value[edges[:, 0]] * value[edges[:, 1]] < 0.0)
    ends = edges[cut]
    at = _roots(field, points[ends[:, 0]], points[ends[:, 1]], np.where(value[ends[:, 0]] < 0.0, 1, -1))
    length = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)
    # The vertical edge of a floor point is half as long as the other long edges.
    limit = np.where(edge_is_long[cut], _SNAP_LONG * length.max(initial=0.0), _SNAP_SHORT * length)
    snapped, on_surface = points.copy(), value.copy()
    end = ends.T.ravel()
    target = np.concatenate([at, at])
    travel = np.linalg.norm(target - points[end], axis=1)
    close = travel < np.concatenate([limit, limit])
    end, target, travel = end[close], target[close], travel[close]
    # Later writes overwrite earlier ones: the nearest intersection is written last. For floor points, intersections
    # along the floor are written after all others.
    in_floor = is_floor[end] & (target[:, 2] == 0.0)
    order = np.lexsort((-travel, in_floor))
    for k in order:
        on_surface[end[k]] = 0.0
        snapped[end[k]] = points[end[k]] if is_floor[end[k]] and not in_floor[k] else target[k]
    return snapped, on_surface


def _roots(field: Field, a: np.ndarray, b: np.ndarray, sign_a: np.ndarray) -> np.ndarray:
    """Return the points (m, 3) where ``field`` vanishes between ``a`` and ``b``; ``sign_a`` is 1 where a is inside."""
    low, high = np.zeros(len(a)), np.ones(len(a))
    for _ in range(12):
        t = 0.5 * (low + high)
        same = (field(a + t[:, None] * (b - a)) < 0.0) == (sign_a > 0)
        low, high = np.where(same, t, low), np.where(same, high, t)
    return a + (0.5 * (low + high))[:, None] * (b - a)


def _fill_tets(
    nodes: np.ndarray,
    tets: np.ndarray,
    sign: np.ndarray,
    edges: np.ndarray,
    edge_is_long: np.ndarray,
    node_of_edge: np.ndarray,
) -> np.ndarray:
    """Return tetrahedra (T', 4) that fill the part of each tetrahedron inside the surface, by the signs at its
    corners."""
    order = np.argsort(-sign[tets], axis=1, kind="stable")
    tets = np.take_along_axis(tets, order, axis=1)
    signs = sign[tets]
    inside, outside = np.sum(signs > 0, axis=1), np.sum(signs < 0, axis=1)
    key = edges[:, 0].astype(np.int64) * len(nodes) + edges[:, 1]

    def edge(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.searchsorted(key, np.minimum(a, b).astype(np.int64) * len(nodes) + np.maximum(a, b))

    def cut(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return node_of_edge[edge(a, b)]

    def first_owns(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Return a mask that is True where the diagonal of the quad a, b, cut(b, c), cut(a, c) starts at a. The two
        tetrahedra that share the quad apply the same rule."""
        a_long, b_long = edge_is_long[edge(a, c)], edge_is_long[edge(b, c)]
        return np.where(a_long != b_long, b_long, a < b)

    def pick(n_inside: int, n_outside: int) -> tuple[np.ndarray, ...]:
        return tuple(tets[(inside == n_inside) & (outside == n_outside)].T)

    out = [tets[(outside == 0) & (inside > 0)]]
    a, b, c, d = pick(1, 3)
    out.append(np.stack([a, cut(a, b), cut(a, c), cut(a, d)], 1))
    a, b, c, d = pick(1, 2)
    out.append(np.stack([a, b, cut(a, c), cut(a, d)], 1))
    a, b, c, d = pick(1, 1)
    out.append(np.stack([a, b, c, cut(a, d)], 1))
    a, b, c, d = pick(2, 1)
    swap = ~first_owns(a, b, d)
    a, b = np.where(swap, b, a), np.where(swap, a, b)
    out += [np.stack([a, b, cut(b, d), c], 1), np.stack([a, cut(b, d), cut(a, d), c], 1)]
    a, b, c, d = pick(2, 2)
    top, bottom = np.stack([a, cut(a, c), cut(a, d)], 1), np.stack([b, cut(b, c), cut(b, d)], 1)
    own01, own02 = first_owns(a, b, c), first_owns(a, b, d)
    shorter = np.linalg.norm(nodes[top[:, 1]] - nodes[bottom[:, 2]], axis=1) <= np.linalg.norm(
        nodes[top[:, 2]] - nodes[bottom[:, 1]], axis=1
    )
    # The third quad lies on the surface, so any diagonal is allowed that does not complete a cycle.
    own12 = np.where(own01 == own02, shorter, ~own01)
    out += _prisms(top, bottom, own01, own02, own12)
    a, b, c, d = pick(3, 1)
    top, bottom = np.stack([a, b, c], 1), np.stack([cut(a, d), cut(b, d), cut(c, d)], 1)
    out += _prisms(top, bottom, first_owns(a, b, d), first_owns(a, c, d), first_owns(b, c, d))
    return np.concatenate(out)


def _prisms(
    top: np.ndarray, bottom: np.ndarray, own01: np.ndarray, own02: np.ndarray, own12: np.ndarray
) -> list[np.ndarray]:
    """Return three tetrahedra for each prism. The diagonal of quad ij runs from top i to bottom j where ``own_ij`` is
    True, otherwise from top j to bottom i. The three diagonals must not form a cycle."""
    wins = np.stack([own01.astype(int) + own02, ~own01 + own12.astype(int), (~own02).astype(int) + ~own12], axis=1)
    rank = np.argsort(-wins, axis=1, kind="stable")
    p, q = np.take_along_axis(top, rank, axis=1).T, np.take_along_axis(bottom, rank, axis=1).T
    return [
        np.stack([p[0], p[1], p[2], q[2]], 1),
        np.stack([p[0], p[1], q[1], q[2]], 1),
        np.stack([p[0], q[0], q[1], q[2]], 1),
    ]
