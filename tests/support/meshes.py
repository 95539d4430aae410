"""Small generated meshes for tests."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from egs_warp.geometry.tetmesh import TetMesh

UP = np.array([0.0, 0.0, 1.0])


def block_mesh(nx: int = 3, ny: int = 3, nz: int = 5, size: tuple[float, float, float] = (0.4, 0.4, 1.0)) -> TetMesh:
    """Return a box on z = 0 centred on the z axis, with nx x ny x nz nodes and six tetrahedra per cell; inner nodes are
    perturbed."""
    axes = [np.linspace(-size[0] / 2, size[0] / 2, nx), np.linspace(-size[1] / 2, size[1] / 2, ny)]
    axes.append(np.linspace(0, size[2], nz))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    index = np.arange(nx * ny * nz).reshape(nx, ny, nz)
    tets = []
    for order in itertools.permutations(range(3)):
        corner = np.zeros(3, int)
        path = [corner.copy()]
        for axis in order:
            corner[axis] += 1
            path.append(corner.copy())
        tets.append(
            np.stack([index[c[0] : nx - 1 + c[0], c[1] : ny - 1 + c[1], c[2] : nz - 1 + c[2]].ravel() for c in path], 1)
        )
    inside = (np.abs(points[:, :2]) < np.array(size[:2]) / 2 - 1e-9).all(1) & (points[:, 2] > 0)
    inside &= points[:, 2] < size[2] - 1e-9
    points[inside] += np.random.default_rng(0).uniform(-0.02, 0.02, (inside.sum(), 3))
    return TetMesh.oriented(points, np.concatenate(tets))


def box_mesh(counts: tuple[int, int, int], size: tuple[float, float, float]) -> TetMesh:
    """Return a box with its base centred at the origin and six tetrahedra per cell."""
    grid = np.stack(np.meshgrid(*[np.arange(n + 1) for n in counts], indexing="ij"), axis=-1)
    nodes = (grid / np.array(counts) * np.array(size) - [size[0] / 2, size[1] / 2, 0.0]).reshape(-1, 3)
    index = np.arange(len(nodes)).reshape(grid.shape[:3])
    cells = np.stack(
        [index[a : a + counts[0], b : b + counts[1], c : c + counts[2]].ravel() for a, b, c in np.ndindex(2, 2, 2)],
        axis=1,
    )
    # Adjacent cells are mirror images, so that the mesh prefers no diagonal and is symmetric about x = 0 and y = 0.
    odd = np.stack(np.meshgrid(*[np.arange(n) % 2 for n in counts], indexing="ij"), axis=-1).reshape(-1, 3) @ [4, 2, 1]
    cells = np.take_along_axis(cells, np.arange(8)[None] ^ odd[:, None], axis=1)
    paths = [(0, 1, 3, 7), (0, 1, 5, 7), (0, 2, 3, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 4, 6, 7)]
    return TetMesh.oriented(nodes, np.concatenate([cells[:, path] for path in paths]))


def carved(size: tuple[float, float, float], cell: float, keep: Callable[[np.ndarray], np.ndarray]) -> TetMesh:
    """Return the cells of a lattice over a box on z = 0 whose centres ``keep`` accepts, with six tetrahedra each."""
    counts = np.round(np.array(size) / cell).astype(int)
    grid = np.stack(np.meshgrid(*[np.arange(n + 1) for n in counts], indexing="ij"), axis=-1)
    nodes = (grid * cell - [size[0] / 2, size[1] / 2, 0.0]).reshape(-1, 3)
    index = np.arange(len(nodes)).reshape(grid.shape[:3])
    cells = np.stack(
        [index[a : a + counts[0], b : b + counts[1], c : c + counts[2]].ravel() for a, b, c in np.ndindex(2, 2, 2)],
        axis=1,
    )
    cells = cells[keep(nodes[cells].mean(axis=1))]
    paths = [(0, 1, 3, 7), (0, 1, 5, 7), (0, 2, 3, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 4, 6, 7)]
    used, tets = np.unique(np.concatenate([cells[:, path] for path in paths]), return_inverse=True)
    return TetMesh.oriented(nodes[used], tets.reshape(-1, 4))


def column() -> TetMesh:
    return carved((0.3, 0.3, 1.2), 0.1, lambda c: np.ones(len(c), dtype=bool))


def stool() -> TetMesh:
    """Return four legs under a seat."""
    return carved(
        (0.7, 0.7, 0.8), 0.1, lambda c: (c[:, 2] > 0.6) | ((np.abs(c[:, 0]) > 0.15) & (np.abs(c[:, 1]) > 0.15))
    )


def coarse_stool() -> TetMesh:
    """Return four legs, each one cell wide, under a seat; the mesh has 152 nodes."""
    return carved(
        (0.75, 0.75, 0.9), 0.15, lambda c: (c[:, 2] > 0.75) | ((np.abs(c[:, 0]) > 0.2) & (np.abs(c[:, 1]) > 0.2))
    )


def u_bar() -> TetMesh:
    """Return two prongs, each 0.2 m thick, on a base; the gap between them is 0.3 m wide and 0.6 m deep."""
    return carved((0.7, 0.2, 0.8), 0.1, lambda c: (c[:, 2] < 0.2) | (np.abs(c[:, 0]) > 0.15))


def figure() -> TetMesh:
    """Return a figure with two legs, a trunk that ends in a head, and two extended arms."""

    def keep(c: np.ndarray) -> np.ndarray:
        x, z = np.abs(c[:, 0]), c[:, 2]
        legs = (z < 0.5) & (x > 0.1) & (x < 0.3)
        trunk = (z > 0.5) & (x < 0.3)
        arms = (z > 0.8) & (z < 1.0)
        return legs | trunk | arms

    return carved((1.6, 0.2, 1.4), 0.1, keep)


def figure_with_tool() -> TetMesh:
    """Return ``figure`` with an upright tool at the end of its right arm and a tail that is higher than the arms."""
    size = (1.6, 0.8, 1.4)

    def keep(c: np.ndarray) -> np.ndarray:
        x, y, z = c.T
        middle = np.abs(y) < 0.1
        legs = (z < 0.5) & (np.abs(x) > 0.1) & (np.abs(x) < 0.3)
        trunk = (z > 0.5) & (np.abs(x) < 0.3)
        arms = (z > 0.8) & (z < 1.0)
        tool = (x > 0.7) & (z > 0.5) & (z < 1.3)
        tail = (np.abs(x) < 0.1) & (y < 0.0) & (z > 0.6) & (z < 0.8) | (np.abs(x) < 0.1) & (y < -0.2) & (z > 0.6)
        return (middle & (legs | trunk | arms | tool)) | (tail & (z < 1.3))

    return carved(size, 0.1, keep)


def rabbit() -> TetMesh:
    """Create a block with a narrow neck, a smaller head and two ears."""

    def keep(c: np.ndarray) -> np.ndarray:
        (x, y), z = np.abs(c[:, :2]).T, c[:, 2]
        across = np.maximum(x, y)
        ears = (z > 1.0) & (x > 0.1) & (y < 0.1)
        head = (z > 0.6) & (z < 1.0)
        return ((z < 0.5) & (across < 0.3)) | ((z < 0.6) & (across < 0.1)) | (head & (across < 0.3)) | ears

    return carved((0.6, 0.6, 1.4), 0.1, keep)


def ball_mesh(cells: int = 4) -> TetMesh:
    """Return a ball of diameter 1 on z = 0: a cube of ``cells`` cells along each side, mapped smoothly to a ball."""
    cube = box_mesh((cells, cells, cells), (2.0, 2.0, 2.0))
    x, y, z = (cube.nodes - [0.0, 0.0, 1.0]).T
    squares = x * x, y * y, z * z

    def mapped(along: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return along * np.sqrt(1.0 - 0.5 * a - 0.5 * b + a * b / 3.0)

    nodes = np.stack(
        [mapped(x, squares[1], squares[2]), mapped(y, squares[2], squares[0]), mapped(z, squares[0], squares[1])],
        axis=1,
    )
    nodes = 0.5 * nodes
    return TetMesh(nodes - [0.0, 0.0, nodes[:, 2].min()], cube.tets)


def worm_mesh(cells: int = 14) -> TetMesh:
    """Return a bar along x on z = 0, 1 m high and wide, and more than three times as long."""
    return box_mesh((cells, 2, 2), (0.5 * cells, 1.0, 1.0))
