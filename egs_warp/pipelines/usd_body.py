"""The soft body of a run in USD, for physics simulators: a tetrahedral mesh with its material, and the ground.

The names of the deformable schemas follow the AOUSD proposal, which OpenUSD does not contain yet.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.locomotion.trajectory import Trajectory

_GROUND_SIDE = 20.0
"""Side of the drawn part of the ground, body heights; its collider is infinite."""


def define_body(stage: Any, path: str, run: Trajectory, material: Any) -> Any:
    """Define the soft body below ``path`` with its ``material``; return the tetrahedral mesh.

    The default points are the nodes in the first frame, at rest on the ground, from which a simulator starts. The rest
    shape is the unloaded one, which is free of stress.
    """
    Sdf, UsdGeom, UsdPhysics, UsdShade, Vt = (
        import_module(f"pxr.{name}") for name in ("Sdf", "UsdGeom", "UsdPhysics", "UsdShade", "Vt")
    )
    types = Sdf.ValueTypeNames
    mesh = UsdGeom.TetMesh.Define(stage, f"{path}/soft_body")
    prim = mesh.GetPrim()
    mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)
    mesh.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(run.tets, np.int32)))
    faces = TetMesh(run.rest_positions, run.tets).boundary_faces()
    mesh.CreateSurfaceFaceVertexIndicesAttr(Vt.Vec3iArray.FromNumpy(np.ascontiguousarray(faces, np.int32)))
    UsdPhysics.CollisionAPI.Apply(prim)
    for schema in ("PhysicsDeformableBodyAPI", "PhysicsVolumeDeformableSimAPI"):
        prim.AddAppliedSchema(schema)
    unloaded = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(run.unloaded_positions, np.float32))
    prim.CreateAttribute("physics:mass", types.Float).Set(float(run.node_mass.sum()))
    prim.CreateAttribute("physics:restShapePoints", types.Point3fArray).Set(unloaded)
    _bind(UsdShade, prim, material)
    return mesh


def define_material(stage: Any, path: str, run: Trajectory) -> Any:
    """Define the material of a body below ``path`` and return it."""
    Sdf, UsdPhysics, UsdShade = (import_module(f"pxr.{name}") for name in ("Sdf", "UsdPhysics", "UsdShade"))
    types, mass = Sdf.ValueTypeNames, float(run.node_mass.sum())
    material = UsdShade.Material.Define(stage, f"{path}/material")
    surface = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    surface.CreateDensityAttr(mass / float(TetMesh(run.unloaded_positions, run.tets).volumes().sum()))
    surface.CreateStaticFrictionAttr(run.friction)
    surface.CreateDynamicFrictionAttr(run.friction)
    material.GetPrim().AddAppliedSchema("PhysicsVolumeDeformableMaterialAPI")
    elastic = {"youngsModulus": run.young_modulus, "poissonsRatio": run.poisson_ratio}
    for name, value in elastic.items():
        material.GetPrim().CreateAttribute(f"physics:{name}", types.Float).Set(float(value))
    # No schema has an attribute for stiffness-proportional damping.
    material.GetPrim().CreateAttribute("egs:dampingTime", types.Float, custom=True).Set(float(run.damping_time))
    return material


def define_surroundings(stage: Any, path: str, run: Trajectory, material: Any) -> None:
    """Define gravity below ``path`` and, if the ground is flat, the ground with the friction of ``material``."""
    Gf, UsdPhysics = (import_module(f"pxr.{name}") for name in ("Gf", "UsdPhysics"))
    scene = UsdPhysics.Scene.Define(stage, f"{path}/physics")
    size = float(np.linalg.norm(run.gravity))
    scene.CreateGravityDirectionAttr(Gf.Vec3f(*(run.gravity / size).tolist()))
    scene.CreateGravityMagnitudeAttr(size)
    if run.ground_coefficients.size == 0:
        _define_ground(stage, f"{path}/ground", run, material)


def _define_ground(stage: Any, path: str, run: Trajectory, material: Any) -> None:
    Gf, UsdGeom, UsdPhysics, UsdShade = (
        import_module(f"pxr.{name}") for name in ("Gf", "UsdGeom", "UsdPhysics", "UsdShade")
    )
    normal, offset = run.planes[0, :3], float(run.planes[0, 3])
    ground = UsdGeom.Plane.Define(stage, path)
    side = _GROUND_SIDE * run.height
    ground.CreateAxisAttr(UsdGeom.Tokens.z)
    ground.CreateWidthAttr(side)
    ground.CreateLengthAttr(side)
    ground.CreateExtentAttr([Gf.Vec3f(-0.5 * side, -0.5 * side, 0.0), Gf.Vec3f(0.5 * side, 0.5 * side, 0.0)])
    ground.CreatePurposeAttr(UsdGeom.Tokens.guide)
    place = UsdGeom.Xformable(ground)
    place.AddTranslateOp().Set(Gf.Vec3d(*(-offset * normal).tolist()))
    turn = Gf.Rotation(Gf.Vec3d(0.0, 0.0, 1.0), Gf.Vec3d(*normal.tolist())).GetQuat()
    place.AddOrientOp().Set(Gf.Quatf(turn))
    UsdPhysics.CollisionAPI.Apply(ground.GetPrim())
    _bind(UsdShade, ground.GetPrim(), material)


def _bind(UsdShade: Any, prim: Any, material: Any) -> None:
    binding = UsdShade.MaterialBindingAPI.Apply(prim)
    binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")
