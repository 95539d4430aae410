"""Export of a finished run to a bundle: rest splats, cage and node positions (docs/concepts/bundle.md).

``examples/read_bundle.py`` reads bundles.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from egs_warp.deformation.deformer import Deformer
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import with_degree
from egs_warp.geometry.main_light import normalised
from egs_warp.geometry.tetmesh import TetMesh
from egs_warp.io.bundle import Bundle, BundleBody, BundleCage, BundleLevelSet, write_bundle
from egs_warp.io.bundle_file import ENDING
from egs_warp.io.planes import light_to_json
from egs_warp.io.run_folder import check_no_file_of_a_run
from egs_warp.lighting.surface_normals import surface_normals
from egs_warp.locomotion.rollout import FRAME_RATE
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.locomotion.world_audit import ContactShape
from egs_warp.pipelines.drawn_cage import DrawnCage, drawn_level_set
from egs_warp.pipelines.export import chosen_frames
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.pipelines.finished_world import FinishedWorld


def export_bundle(
    run: FinishedRun | FinishedWorld, path: Path, *, every: int = 1, degree: int | None = None, licence: str = ""
) -> None:
    """Write ``run`` to a bundle (docs/guide/export.md).

    Args:
        run: The run to export, of a single capture or of a world.
        path: Name that ends in .egs.
        every: Interval of the exported frames, in frames at 60 Hz.
        degree: SH degree of the colours; None keeps the degree of the capture.
        licence: Licence of the content, as the file will state it.

    Raises:
        UserError: ``path`` has another ending, or is a file of a run.
    """
    check_no_file_of_a_run(path)
    if path.suffix.lower() != ENDING:
        raise UserError(f"{path}: give a name that ends in {ENDING}")
    if isinstance(run, FinishedWorld):
        bundle = bundle_of_world(run, every=every, degree=degree, licence=licence)
    else:
        bundle = bundle_of(run, every=every, degree=degree, licence=licence)
    write_bundle(path, bundle)


def bundle_of(run: FinishedRun, *, every: int = 1, degree: int | None = None, licence: str = "") -> Bundle:
    """Return the bundle of ``run``: its creature, and its scene as a static body. The arguments are those of
    ``export_bundle``."""
    steps = run.steps[chosen_frames(run, frame=None, every=every)]
    light = run.creature.light
    bodies = [_moving_body(run.deformer(), run.trajectory, steps, degree, has_normals=light is not None)]
    # Use the scene without the shadow of the object, because the player draws shadows itself.
    scene = run.scene_without_shadow()
    if scene is not None:
        bodies.append(BundleBody("scene", with_degree(scene, degree)))
    facts = _facts(run.trajectory, run.creature.camera, run.title) | {"licence": licence}
    if light is not None:
        facts["light"] = light_to_json(normalised(light))
    return Bundle(tuple(bodies), FRAME_RATE / every, len(steps), facts)


def bundle_of_world(world: FinishedWorld, *, every: int = 1, degree: int | None = None, licence: str = "") -> Bundle:
    """Return the bundle of a world, in which each body has its own cage. The arguments are those of
    ``export_bundle``."""
    frames = chosen_frames(world, frame=None, every=every)
    bodies = tuple(
        _moving_body(
            run.deformer(),
            run.trajectory,
            run.steps[frames],
            degree,
            name=name,
            shape=world.shapes[name],
        )
        for name, run in world.bodies.items()
    )
    facts = _facts(world.first.trajectory, world.camera, world.title)
    frame = world.capture_frame
    facts |= {
        "licence": licence,
        "height": max(t.height for t in world.trajectories),
        "flat_ground": not world.solids,
        "capture": {"axes": frame.axes.tolist(), "origin": frame.origin.tolist(), "metres_per_unit": frame.scale},
    }
    return Bundle(bodies, FRAME_RATE / every, len(frames), facts)


def bundle_of_motion(
    deformer: Deformer, trajectory: Trajectory, steps: np.ndarray, camera: Camera, *, title: str
) -> Bundle:
    """Return the bundle of a motion that is not stored in files.

    Args:
        deformer: Deformer of the Gaussians.
        trajectory: The motion.
        steps: (F,) indices of the states that are the frames at 60 Hz.
        camera: Initial camera of the player.
        title: Name of the bundle.
    """
    body = _moving_body(deformer, trajectory, steps, None)
    return Bundle((body,), FRAME_RATE, len(steps), _facts(trajectory, camera, title))


def _facts(t: Trajectory, camera: Camera, title: str) -> dict[str, Any]:
    return {
        "title": title,
        "licence": "",
        "up": [0.0, 0.0, 1.0],
        "metres_per_unit": 1.0,
        "height": t.height,
        "front": t.front.tolist(),
        "flat_ground": len(t.planes) == 1 and t.ground_coefficients.size == 0,
        "camera": {
            "position": camera.centre.tolist(),
            "forward": camera.rotation[2].tolist(),
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.height / camera.fy))),
        },
        "capture": {
            "axes": t.body_axes.tolist(),
            "origin": t.body_origin.tolist(),
            "metres_per_unit": t.metres_per_unit,
        },
    }


def _moving_body(
    deformer: Deformer,
    t: Trajectory,
    steps: np.ndarray,
    degree: int | None,
    *,
    has_normals: bool = False,
    name: str = "creature",
    shape: ContactShape | None = None,
) -> BundleBody:
    drawn = DrawnCage.of(TetMesh(t.rest_positions, t.tets), shape)
    level_set = None
    if shape is not None:
        own = drawn_level_set(shape)
        level_set = BundleLevelSet(own.origin, own.spacing, own.coefficients, t.height)
    bundled = BundleCage(
        rest_nodes=drawn.nodes.astype(np.float32),
        cage_tets=drawn.tets,
        surface=drawn.surface,
        max_stretch=deformer.max_stretch,
        nodes=drawn.positions(t.positions[steps]),
        level_set=level_set,
        **deformer.plan_arrays(),
    )
    normals = surface_normals(deformer.rest) if has_normals else None
    return BundleBody(name, with_degree(deformer.rest, degree), bundled, normals)
