"""Small run of a world in the format of ``animate``: a box falls on a soft block beside a ramp."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from egs_warp.assets.surface import quaternions_from_normals
from egs_warp.contact.terrain import Solid
from egs_warp.fem.body import BodyState
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.geometry.plane import Plane
from egs_warp.locomotion.objectives import AnyObjective
from egs_warp.locomotion.rollout import BodyRun
from egs_warp.locomotion.stepper import StepReport
from egs_warp.locomotion.world_audit import ContactShape, audit_world
from egs_warp.locomotion.world_rollout import roll_out_world
from egs_warp.locomotion.world_stepper import WorldStepper
from egs_warp.pipelines.finished_world import SHAPE
from egs_warp.pipelines.render_data import FILE, RenderData
from tests.support.props import box_body, surface_grid

NAMES = ("block", "box-1")
SIZES = ((0.8, 0.6, 0.4), (0.3, 0.3, 0.3))
FRAMES = 8
_SHIFTS = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.42))
_RAMP = Solid((Plane(np.array([0.0, -0.6, 0.8]), 0.6), Plane(np.array([0.0, 1.0, 0.0]), -2.0)))


class _Passive:
    """Motion without objectives."""

    def objectives(self, state: BodyState, report: StepReport | None, dt: float) -> Sequence[AnyObjective]:
        return ()


def box_cloud(size: tuple[float, float, float], colour: float = 0.4) -> GaussianCloud:
    """Return opaque Gaussians on the surface of a box that stands on z = 0."""
    points = surface_grid(size, 7)
    count = len(points)
    return GaussianCloud.from_numpy(
        points,
        quaternions_from_normals(np.tile([0.0, 0.0, 1.0], (count, 1)), np.zeros(count)),
        np.full((count, 3), np.log(0.04)),
        np.full(count, 4.0),
        np.tile(np.array([colour, 0.1, -0.3]), (count, 1))[:, None],
        device="cpu",
    )


@cache
def _files() -> dict[str, bytes]:
    bodies = [box_body(size, soft=index == 0) for index, size in enumerate(SIZES)]
    runs, clouds = [], []
    for body, shift, size in zip(bodies, _SHIFTS, SIZES, strict=True):
        nodes = body.stepper.body.mesh.nodes
        start = BodyState(nodes + np.array(shift), np.zeros_like(nodes))
        runs.append(BodyRun(body.stepper, start, _Passive()))
        clouds.append(box_cloud(size))
    results = roll_out_world(WorldStepper(bodies), runs, frames=FRAMES)
    camera = Camera.look_at(
        np.array([2.0, -3.0, 1.5]), np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 1.0]), width=96, height=72
    )
    trajectories = []
    for result in results:
        t = result.trajectory
        planes = [[*face.normal, face.offset] for face in _RAMP.faces]
        trajectories.append(
            replace(t, planes=np.concatenate([t.planes, planes]), solid_from_plane=np.array([0, 1, 1], np.int32))
        )
    shapes = [ContactShape.of(each.stepper.geometry, each.level_set, each.rest_positions) for each in bodies]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        rows = {}
        for name, body, t, shape, cloud in zip(NAMES, bodies, trajectories, shapes, clouds, strict=True):
            own = folder / name
            own.mkdir()
            t.save(own / "trajectory.npz")
            shape.save(own / SHAPE)
            RenderData.of(cloud, camera, body.stepper.muscles).save(own / FILE)
            (own / "report.json").write_text(json.dumps({"source": name, "motion": [], "notes": []}))
            rows[name] = {"state": "done", "result": f"{name} fell", "audit": "audit: passed"}
        (folder / "report.json").write_text(json.dumps({"bodies": rows, "notes": []}))
        assert len(audit_world(trajectories, shapes).pairs) == 1
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write_world_run(folder: Path) -> Path:
    """Write the run of the world into ``folder``, and return the folder."""
    for name, data in _files().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return folder
