"""Soft body in a USD stage, with mesh, mass, material and ground for other physics simulators."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.usd import export_usd

Usd, UsdGeom, UsdPhysics, UsdShade = map(
    pytest.importorskip, ("pxr.Usd", "pxr.UsdGeom", "pxr.UsdPhysics", "pxr.UsdShade")
)


def test_a_simulator_finds_the_body_its_material_and_the_ground(run_folder: Path, tmp_path: Path) -> None:
    run = FinishedRun.read(run_folder)
    t = run.trajectory
    export_usd(run, tmp_path / "run.usdc", every=6, degree=0, quiet=True)
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    prim = stage.GetPrimAtPath("/creature/soft_body")
    mesh = UsdGeom.TetMesh(prim)
    np.testing.assert_array_equal(np.array(mesh.GetTetVertexIndicesAttr().Get()), t.tets)
    for code, frame in ((Usd.TimeCode.Default(), 0), (12.0, 12)):
        np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get(code)), t.positions[run.steps[frame]], atol=1e-6)
    assert len(UsdGeom.TetMesh.FindInvertedElements(mesh)) == 0
    faces = UsdGeom.TetMesh.ComputeSurfaceFaces(mesh)
    given = np.array(mesh.GetSurfaceFaceVertexIndicesAttr().Get())
    assert {frozenset(face) for face in np.array(faces).tolist()} == {frozenset(face) for face in given.tolist()}
    np.testing.assert_allclose(np.array(prim.GetAttribute("physics:restShapePoints").Get()), t.unloaded_positions)
    assert prim.GetAttribute("physics:mass").Get() == pytest.approx(t.node_mass.sum())
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
    values = [material.GetPrim().GetAttribute(f"physics:{name}").Get() for name in ("youngsModulus", "poissonsRatio")]
    assert values == pytest.approx([t.young_modulus, t.poisson_ratio])
    assert UsdPhysics.MaterialAPI(material).GetDynamicFrictionAttr().Get() == pytest.approx(t.friction)
    scene = UsdPhysics.Scene.Get(stage, "/creature/physics")
    pull = scene.GetGravityMagnitudeAttr().Get() * np.array(scene.GetGravityDirectionAttr().Get())
    np.testing.assert_allclose(pull, t.gravity, atol=1e-5)
    ground = stage.GetPrimAtPath("/creature/ground")
    assert ground.HasAPI(UsdPhysics.CollisionAPI)
    to_world = np.array(UsdGeom.Xformable(ground).ComputeLocalToWorldTransform(0.0))
    # USD transforms row vectors, so the third row is the image of the z axis.
    np.testing.assert_allclose(to_world[2, :3], t.planes[0, :3], atol=1e-6)
    assert to_world[3, :3] @ t.planes[0, :3] + t.planes[0, 3] == pytest.approx(0.0, abs=1e-6)
