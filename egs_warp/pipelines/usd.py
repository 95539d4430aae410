"""Export of a finished run to a USD stage: splats, cage, soft body, muscles and forces, with time samples at 60 Hz."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import GaussianCloud, with_degree
from egs_warp.installation import install_command
from egs_warp.io.atomic import atomic_write, system_error
from egs_warp.io.run_folder import check_no_file_of_a_run
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.world_audit import ContactShape
from egs_warp.pipelines.drawn_cage import DrawnCage
from egs_warp.pipelines.export import chosen_frames
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.finished_world import FinishedWorld
from egs_warp.pipelines.usd_body import define_body, define_material, define_surroundings

CREATURE, WORLD = "/creature", "/world"
_SURROUNDINGS = ("physics", "ground", "scene")
"""Names of the prims of a world that are not bodies."""
SPLATS, CAGE, MUSCLES, FORCES, SCENE = "splats", "cage", "muscles", "forces", "scene"
_WIDTH = 0.004
"""Width of the curves, m."""
_WEIGHT_LENGTH = 0.5
"""Length of the line for a force of one body weight, body heights."""


def export_usd(
    run: FinishedRun | FinishedWorld,
    path: Path,
    *,
    every: int = 1,
    degree: int | None = None,
    quiet: bool = False,
    announce: Callable[[int], object] = lambda size: None,
) -> None:
    """Write ``run`` to a USD file in metres, with z up and 60 time codes per second.

    The splats are a ParticleField3DGaussianSplat (OpenUSD 26.03 and later), the cage is a mesh, muscles and forces are
    curves, and the body is a tetrahedral mesh with its material (``usd_body``). Each body of a world has a prim of its
    own below ``/world``.

    Args:
        run: The run to export, of a single capture or of a world.
        path: Name that ends in .usdc or .usda.
        every: Interval of the exported frames, in frames at 60 Hz.
        degree: SH degree of the colours, which take most of the file; None keeps the degree of the capture.
        quiet: True to show no progress bar.
        announce: Called with the size of the splats in all frames, bytes, which is nearly the size of the file.

    Raises:
        UserError: usd-core is not installed or too old, or ``path`` has another ending.
    """
    _, Usd, UsdGeom, UsdVol, Vt = _modules()
    if path.suffix not in (".usdc", ".usda"):
        raise UserError(f"{path}: give a name that ends in .usdc or .usda")
    check_no_file_of_a_run(path)
    frames = chosen_frames(run, frame=None, every=every)
    with atomic_write(path) as temporary, _system_errors():
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(FRAME_RATE)
        stage.SetFramesPerSecond(FRAME_RATE)
        stage.SetStartTimeCode(float(frames[0]))
        stage.SetEndTimeCode(float(frames[-1]))
        if isinstance(run, FinishedWorld):
            root = WORLD
            names = _identifiers(list(run.bodies))
            bodies = [
                _BodyPrims(stage, f"{WORLD}/{name}", each, shape, degree=degree)
                for name, each, shape in zip(names, run.bodies.values(), run.shapes.values(), strict=True)
            ]
            define_surroundings(stage, WORLD, run.first.trajectory, bodies[0].material)
        else:
            root = CREATURE
            bodies = [_BodyPrims(stage, CREATURE, run, None, degree=degree)]
            define_surroundings(stage, CREATURE, run.trajectory, bodies[0].material)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, root).GetPrim())
        announce(len(frames) * sum(body.splat_bytes for body in bodies))
        for index in tqdm(frames, desc="export", unit="frame", disable=quiet):
            for body in bodies:
                body.write_frame(int(index), is_first=index == 0)
        if run.scene is not None:
            scene = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"{root}/{SCENE}")
            still = with_degree(run.scene, degree)
            _write_constant(scene, still, Vt)
            _write_sample(scene, still, Usd.TimeCode.Default(), Vt)
        stage.GetRootLayer().Save()
        del stage


class _BodyPrims:
    """The prims of one body below its path: splats, cage, muscles, forces and, for a soft body, its tetrahedra."""

    def __init__(
        self, stage: Any, path: str, run: FinishedRun, shape: ContactShape | None, *, degree: int | None
    ) -> None:
        """Define the prims. ``shape`` is the shape of a body of a world, from which the surface of a prop is drawn."""
        Sdf, _, UsdGeom, UsdVol, Vt = _modules()
        self._run, self._degree, self._deformer = run, degree, run.deformer()
        t = run.trajectory
        self._outer_cage = DrawnCage.of(run.mesh, shape)
        UsdGeom.Xform.Define(stage, path)
        self._splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"{path}/{SPLATS}")
        splats = with_degree(run.creature.splats, degree)
        _write_constant(self._splats, splats, Vt)
        colours = 3 * splats.sh.shape[1] if splats.sh_degree else 0
        self.splat_bytes = splats.count * (3 + 4 + 3 + colours) * np.dtype(np.float32).itemsize
        """Size of the splats in a frame, bytes: positions, quaternions, scales and, above degree 0, colours."""
        self._cage = UsdGeom.Mesh.Define(stage, f"{path}/{CAGE}")
        faces = self._outer_cage.surface
        self._cage.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        self._cage.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
        self._cage.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        self._cage.SetNormalsInterpolation(UsdGeom.Tokens.uniform)
        self._cage.CreatePurposeAttr(UsdGeom.Tokens.guide)
        self._muscles = _curves(UsdGeom.BasisCurves.Define(stage, f"{path}/{MUSCLES}"), UsdGeom)
        segments = run.creature.muscle_segments
        self._muscles.CreateCurveVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(segments), 2, np.int32)))
        self._activation = UsdGeom.PrimvarsAPI(self._muscles).CreatePrimvar(
            "activation", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.uniform
        )
        self._forces = _curves(UsdGeom.BasisCurves.Define(stage, f"{path}/{FORCES}"), UsdGeom)
        self._weight = float(t.node_mass.sum() * np.linalg.norm(t.gravity))
        self.material = define_material(stage, path, t)
        """Material of the body."""
        # This excludes props: a prop is stiff, and its single tetrahedron does not have its shape.
        self._soft_body = define_body(stage, path, t, self.material) if len(t.tets) > 1 else None

    def write_frame(self, index: int, *, is_first: bool) -> None:
        """Write the samples of the frame ``index`` at 60 Hz."""
        _, Usd, _, _, Vt = _modules()
        run, t = self._run, self._run.trajectory
        step, code = int(run.steps[index]), float(index)
        nodes = t.positions[step]
        positions = self._outer_cage.positions(nodes)
        cloud = with_degree(self._deformer.deform(nodes).cloud, self._degree)
        # The first frame is also the default value, for programs and validators that specify no time.
        for at in (Usd.TimeCode.Default(), code) if is_first else (code,):
            _write_sample(self._splats, cloud, at, Vt)
            _set_points(self._cage, positions, at, Vt)
            if self._soft_body is not None:
                _set_points(self._soft_body, nodes, at, Vt)
            self._cage.GetNormalsAttr().Set(Vt.Vec3fArray.FromNumpy(_normals(positions[self._outer_cage.surface])), at)
        ends = run.creature.muscle_ends @ nodes
        segments = run.creature.muscle_segments
        _set_points(self._muscles, ends[segments].reshape(-1, 3), code, Vt, width=_WIDTH)
        self._activation.Set(Vt.FloatArray.FromNumpy(run.activations(step).astype(np.float32)), code)
        points, _, force = run.contacts(step)
        tips = points + _WEIGHT_LENGTH * t.height / self._weight * force
        self._forces.GetCurveVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.full(len(points), 2, np.int32)), code)
        _set_points(self._forces, np.stack([points, tips], axis=1).reshape(-1, 3), code, Vt, width=_WIDTH)


def _identifiers(names: list[str]) -> list[str]:
    """Return a unique USD identifier for each of the ``names``."""
    found: list[str] = []
    for name in names:
        base = import_module("pxr.Tf").MakeValidIdentifier(name)
        number = 1
        while (candidate := base if number == 1 else f"{base}_{number}") in (*found, *_SURROUNDINGS):
            number += 1
        found.append(candidate)
    return found


@contextmanager
def _system_errors() -> Iterator[None]:
    """Raise ``OSError`` for a USD error that was caused by the operating system, such as a full disk."""
    try:
        yield
    except RuntimeError as error:
        cause = system_error(str(error))
        if cause is None:
            raise
        raise cause from error


def _modules() -> tuple[Any, ...]:
    try:
        modules = tuple(import_module(f"pxr.{name}") for name in ("Sdf", "Usd", "UsdGeom", "UsdVol", "Vt"))
    except ImportError as error:
        raise UserError(f"usd: usd-core is not installed; {install_command('usd')}") from error
    _, Usd, _, UsdVol, _ = modules
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        version = ".".join(map(str, Usd.GetVersion()))
        raise UserError(f"usd: usd-core {version} does not support Gaussian splats; install 26.3 or newer")
    return modules


def _curves(curves: Any, UsdGeom: Any) -> Any:
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateWidthsAttr([_WIDTH])
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    curves.CreateCurveVertexCountsAttr()
    curves.CreatePurposeAttr(UsdGeom.Tokens.guide)
    return curves


def _normals(triangles: np.ndarray) -> np.ndarray:
    edges = triangles[:, 1:] - triangles[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)


def _set_points(shape: Any, points: np.ndarray, code: Any, Vt: Any, *, width: float = 0.0) -> None:
    values = np.ascontiguousarray(points, np.float32)
    shape.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(values), code)
    shape.GetExtentAttr().Set(Vt.Vec3fArray.FromNumpy(_extent(values, 0.5 * width)), code)


def _extent(points: np.ndarray, margin: float) -> np.ndarray:
    if len(points) == 0:
        # USD's representation of an empty extent.
        return np.finfo(np.float32).max * np.array([[1.0] * 3, [-1.0] * 3], np.float32)
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin]).astype(np.float32)


def _write_constant(splats: Any, cloud: GaussianCloud, Vt: Any) -> None:
    splats.GetOpacitiesAttr().Set(Vt.FloatArray.FromNumpy(cloud.opacities().astype(np.float32)))
    splats.GetRadianceSphericalHarmonicsDegreeAttr().Set(cloud.sh_degree)
    colours = splats.GetRadianceSphericalHarmonicsCoefficientsAttr()
    colours.SetMetadata("interpolation", "vertex")
    colours.SetMetadata("elementSize", cloud.sh.shape[1])
    if cloud.sh_degree == 0:
        # Band 0 is invariant under rotations, so it needs no time samples.
        _write_colours(splats, cloud, None, Vt)


def _write_colours(splats: Any, cloud: GaussianCloud, code: Any, Vt: Any) -> None:
    """Write the SH coefficients, band 0 first, Gaussian by Gaussian."""
    values = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(cloud.sh.numpy().reshape(-1, 3)))
    attribute = splats.GetRadianceSphericalHarmonicsCoefficientsAttr()
    attribute.Set(values) if code is None else attribute.Set(values, code)


def _write_sample(splats: Any, cloud: GaussianCloud, code: Any, Vt: Any) -> None:
    means, scales = cloud.means.numpy(), np.exp(cloud.log_scales.numpy())
    splats.GetPositionsAttr().Set(Vt.Vec3fArray.FromNumpy(np.array(means)), code)
    # USD stores quaternions as x, y, z, w.
    rotations = np.ascontiguousarray(cloud.rotations.numpy()[:, [1, 2, 3, 0]])
    splats.GetOrientationsAttr().Set(Vt.QuatfArray.FromNumpy(rotations), code)
    splats.GetScalesAttr().Set(Vt.Vec3fArray.FromNumpy(scales), code)
    splats.GetExtentAttr().Set(Vt.Vec3fArray.FromNumpy(_extent(means, 3.0 * float(scales.max()))), code)
    if cloud.sh_degree:
        _write_colours(splats, cloud, code, Vt)
