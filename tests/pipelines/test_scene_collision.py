"""Collision meshes in the frame of the capture: convex parts are read as they were written, other parts become
boxes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egs_warp.contact.terrain import Solid
from egs_warp.errors import UserError
from egs_warp.geometry.body_frame import BodyFrame
from egs_warp.io.triangle_glb import TriangleMesh, read_triangle_glb, write_triangle_glb
from egs_warp.pipelines.scene_collision import read_collision_mesh, solid_mesh, write_collision_mesh
from egs_warp.pipelines.scene_obstacles import SceneObstacles, box_between
from egs_warp.pipelines.world_file import ramp

FRAME = BodyFrame(Rotation.from_euler("xyz", [0.3, -0.5, 1.0]).as_matrix(), np.array([4.0, -2.0, 1.0]), 0.25)
LOW, HIGH = np.array([-2.0, -2.0, -0.1]), np.full(3, 2.0)


def depth(solids: tuple[Solid, ...], points: np.ndarray) -> np.ndarray:
    """Return the signed distance (n,) of the ``points`` from the nearest solid, as contact detection computes it."""
    return np.min([np.max([face.heights(points) for face in solid.faces], axis=0) for solid in solids], axis=0)


def test_written_obstacles_are_read_back(tmp_path: Path) -> None:
    solids = (
        box_between(np.array([0.5, -0.2, 0.0]), np.array([1.0, 0.4, 0.7])),
        ramp((-1.0, 0.0), 0.8, 0.5, 0.4, 30.0),
    )
    write_collision_mesh(tmp_path / "mesh.glb", SceneObstacles(None, solids, LOW, HIGH), FRAME)
    meshes = read_triangle_glb(tmp_path / "mesh.glb")
    assert [mesh.name for mesh in meshes] == ["ground", "solid-1", "solid-2"]
    np.testing.assert_allclose(FRAME.points(meshes[0].vertices)[:, 2], 0.0, atol=1e-6)
    again = read_collision_mesh(tmp_path / "mesh.glb")
    assert [len(solid.faces) for solid in again] == [6, 5]
    points = np.random.default_rng(0).uniform([-1.5, -1.5, 0.0], 1.5, (500, 3))
    found = FRAME.scale * depth(again, FRAME.capture_points(points))
    np.testing.assert_allclose(found, depth(solids, points), atol=2e-6)


def test_solids_outside_the_measured_box_are_not_written(tmp_path: Path) -> None:
    """A solid in a mesh of the user may be far from the objects, or share only a face with the measured box."""
    far, beside = box_between(np.full(3, 5.0), np.full(3, 6.0)), box_between(np.array([2.0, 0.0, 0.0]), np.full(3, 3.0))
    near = box_between(np.zeros(3), np.ones(3))
    write_collision_mesh(tmp_path / "mesh.glb", SceneObstacles(None, (far, beside, near), LOW, HIGH), FRAME)
    assert [mesh.name for mesh in read_triangle_glb(tmp_path / "mesh.glb")] == ["ground", "solid-3"]


@pytest.mark.parametrize("extension", ["KHR_mesh_quantization", "EXT_meshopt_compression"])
def test_packed_positions_are_refused(extension: str, tmp_path: Path) -> None:
    box = solid_mesh(box_between(np.zeros(3), np.ones(3)))
    write_triangle_glb(tmp_path / "a.glb", [TriangleMesh("box", *box)])
    name = f'"extensionsRequired":["{extension}"],"scene"'.encode()
    data = (tmp_path / "a.glb").read_bytes().replace(b'"scene"', name, 1)
    length = int.from_bytes(data[12:16], "little") + len(name) - len(b'"scene"')
    (tmp_path / "a.glb").write_bytes(data[:12] + length.to_bytes(4, "little") + data[16:])
    with pytest.raises(UserError, match=f"a.glb: it requires {extension}, which is not supported; export it without"):
        read_triangle_glb(tmp_path / "a.glb")


def test_a_part_that_is_not_convex_becomes_boxes(tmp_path: Path) -> None:
    """A table of a plate and a leg is one surface; the space beside the leg stays free."""
    parts = [solid_mesh(box_between(np.array(low), np.array(high))) for low, high in BARS]
    vertices = np.concatenate([part[0] for part in parts])
    faces = np.concatenate([parts[0][1], parts[1][1] + len(parts[0][0])])
    # One triangle connects the two surfaces.
    faces = np.concatenate([faces, [[0, 1, len(parts[0][0])]]])
    write_triangle_glb(tmp_path / "table.glb", [TriangleMesh("table", vertices, faces)])
    solids = read_collision_mesh(tmp_path / "table.glb")
    assert len(solids) >= 2
    inside = np.array([[0.0, 0.0, 1.05], [0.8, 0.8, 1.05], [0.0, 0.0, 0.4]])
    beside = np.array([[0.6, 0.0, 0.5], [0.0, -0.6, 0.5], [0.0, 0.0, 1.3]])
    assert (depth(solids, inside) < 0.0).all() and (depth(solids, beside) > 0.1).all()


BARS = (((-1.0, -1.0, 1.0), (1.0, 1.0, 1.1)), ((-0.1, -0.1, 0.0), (0.1, 0.1, 1.0)))
"""Corners of the plate and of the leg of a table."""


def test_invalid_files_are_refused(tmp_path: Path) -> None:
    flat = TriangleMesh("sheet", np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([[0, 1, 2]]))
    write_triangle_glb(tmp_path / "flat.glb", [flat])
    (tmp_path / "text.glb").write_text("solid")
    (tmp_path / "cut.glb").write_bytes((tmp_path / "flat.glb").read_bytes()[:-20])
    for name, message in (
        ("flat.glb", r"flat.glb: part 1 \(sheet\) is flat"),
        ("text.glb", "not a .glb file"),
        ("cut.glb", "extends beyond the file"),
        ("missing.glb", "missing.glb"),
    ):
        with pytest.raises(UserError, match=message):
            read_collision_mesh(tmp_path / name)
