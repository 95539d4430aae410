"""Cage files of the user: formats that are read, meshes that are refused, and bodies that are built from them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import meshio
import numpy as np
import pytest

from egs_warp.assets import pawn
from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.meshing.cage_file import read_cage_in, read_cage_mesh
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.placed_cage import place_cage
from tests.support.meshes import box_mesh

_UPRIGHT = BodyFrame(np.eye(3), np.zeros(3), 1.0)


@cache
def tower() -> TetMesh:
    """Return a block of 4 x 4 x 8 cells of size 1 on the ground."""
    return box_mesh((4, 4, 8), (4.0, 4.0, 8.0))


def written(path: Path, nodes: np.ndarray, tets: np.ndarray) -> Path:
    meshio.Mesh(nodes, [("tetra", tets)]).write(path)
    return path


@pytest.mark.parametrize("ending", [".mesh", ".msh", ".vtu"])
def test_tetrahedra_are_read_from_each_format(ending: str, tmp_path: Path) -> None:
    mesh = tower()
    read = read_cage_mesh(written(tmp_path / f"cage{ending}", mesh.nodes, mesh.tets))
    np.testing.assert_allclose(read.nodes, mesh.nodes, atol=1e-12)
    np.testing.assert_array_equal(read.tets, mesh.tets)


def test_left_handed_tetrahedra_are_turned_and_unused_nodes_left_out(tmp_path: Path) -> None:
    mesh = tower()
    nodes = np.concatenate([[[9.0, 9.0, 9.0]], mesh.nodes])
    read = read_cage_mesh(written(tmp_path / "cage.mesh", nodes, 1 + mesh.tets[:, [0, 1, 3, 2]]))
    np.testing.assert_allclose(read.nodes, mesh.nodes, atol=1e-12)
    assert (read.volumes() > 0.0).all()


def test_the_frame_is_applied_and_the_base_is_flat(tmp_path: Path) -> None:
    """Nodes are transformed to x' = s A (x - o), and those slightly below the ground are moved onto it."""
    mesh = tower()
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    frame = BodyFrame(axes, np.array([1.0, 2.0, 3.0]), 0.5)
    nodes = frame.capture_points(mesh.nodes - [0.0, 0.0, 0.01])
    read = read_cage_in(written(tmp_path / "cage.mesh", nodes, mesh.tets), frame)
    expected = mesh.nodes - [0.0, 0.0, 0.01]
    expected[:, 2] = np.maximum(expected[:, 2], 0.0)
    np.testing.assert_allclose(read.nodes, expected, atol=1e-12)


def refusal(path: Path) -> str:
    with pytest.raises(UserError) as error:
        read_cage_in(path, _UPRIGHT)
    assert "\n" not in str(error.value) and str(error.value).startswith(str(path))
    return str(error.value)


def test_problems_are_one_line(tmp_path: Path) -> None:
    mesh = tower()
    path = tmp_path / "cage.mesh"
    assert "no such file" in refusal(path)
    assert "give one of .mesh, .msh, .vtu" in refusal(tmp_path / "cage.obj")
    path.write_text("MeshVersionFormatted 2\nDimension 3\nVertices\n9\n0 0")
    assert "cannot be read as a mesh" in refusal(path)
    meshio.Mesh(mesh.nodes, [("triangle", mesh.boundary_faces())]).write(path)
    assert "its tetrahedra have 0 nodes; give a mesh with 50" in refusal(path)
    moved = mesh.nodes.copy()
    inner = int(np.argmin(np.linalg.norm(moved - moved.mean(axis=0), axis=1)))
    moved[inner] += [3.0, 0.0, 0.0]
    assert "are flat or turned inside out, the first at [" in refusal(written(path, moved, mesh.tets))
    both = np.concatenate([mesh.nodes, mesh.nodes + [50.0, 0.0, 0.0]])
    assert "has 2 parts" in refusal(written(path, both, np.concatenate([mesh.tets, mesh.tets + len(mesh.nodes)])))
    sunk = "is below the ground by 0.12 times the height of the mesh; move it up, and check that the mesh is in the"
    assert sunk in refusal(written(path, mesh.nodes - [0.0, 0.0, 1.0], mesh.tets))
    assert "a node does not have three finite coordinates" in refusal(written(path, mesh.nodes * 1e30, mesh.tets))


@pytest.mark.slow
def test_a_body_is_built_from_an_edited_cage(tmp_path: Path) -> None:
    """The nodes of the body are those of the file, up to a common scale that makes the body 1 m tall."""
    made = pawn(gaussian_count=2000)
    standing = place_cage(made.cloud, plane=made.plane, nodes=120)
    mesh = standing.cage.mesh
    nodes = mesh.nodes * [1.1, 1.0, 1.0]
    path = written(tmp_path / "cage.mesh", standing.frame.capture_points(nodes), mesh.tets)
    creature = make_creature(made.cloud, plane=made.plane, options=CreatureOptions(cage_file=path))
    np.testing.assert_allclose(creature.cage.mesh.nodes, nodes / nodes[:, 2].max(), atol=1e-6)
    assert creature.cage.method is None and creature.cage.enclosed_opacity_mass > 0.99
    far = written(path, standing.frame.capture_points(nodes + [5.0, 0.0, 0.0]), mesh.tets)
    with pytest.raises(UserError, match="encloses 0 % of the object; give a mesh that encloses it"):
        make_creature(made.cloud, plane=made.plane, options=replace(CreatureOptions(), cage_file=far))
