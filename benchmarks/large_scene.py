"""Memory and time of each stage from capture to film, for a scene of millions of Gaussians.

A real capture (``--scene``) is repeated side by side along its plane until there are ``--gaussians`` Gaussians, with
SH of degree 3, the highest degree of a capture. The object belongs to the original copy and is clicked as in
``scene_quality.py``. Stages: ``load`` reads the scene from a file, ``plane`` finds the support plane, ``ground``
measures the ground, ``object`` segments the object, ``hole`` inpaints the floor, ``body`` builds the creature,
``animate`` simulates ``--frames`` frames of a jump, ``film`` renders them in the scene. ``peak`` is the peak resident
memory of the whole process during the stage. It is read from the counter VmHWM of Linux, which is reset before each
stage; on other systems it is not measured.

Aims: ``memory`` (every stage within 16 GiB), ``three_minutes`` (all stages except ``animate`` together; only on a GPU).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np

from annotated_scenes import NAMES, DrawnScene, read_drawn
from clicking import clicked
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.inpainting.holes import hole_under
from egs_warp.inpainting.inpaint import inpaint
from egs_warp.io import read_capture
from egs_warp.io.ply import write_ply
from egs_warp.io.run_folder import run_folder
from egs_warp.motions.script import motion
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.film import draw_film, film_setup
from egs_warp.pipelines.locate_plane import locate_plane, with_measured_ground
from egs_warp.pipelines.prepare_scene import SceneOptions, segment_scene, snap_to_plane
from egs_warp.pipelines.simulated_run import simulate
from egs_warp.segmentation.object_spec import ObjectSpec
from harness import Row, Table, flags, report, timed

P = ParamSpec("P")
T = TypeVar("T")
MEMORY_GIB = 16.0
SECONDS = 180.0
COEFFICIENTS = 16
"""Number of SH coefficients of degree 3."""


def repeated(cloud: GaussianCloud, normal: np.ndarray, count: int) -> GaussianCloud:
    """Repeat ``cloud`` on a grid orthogonal to ``normal`` (3,), from its own position outwards.

    Returns:
        the first ``count`` Gaussians of the copies, with SH of degree 3.
    """
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    tangents = np.stack([first, np.cross(normal, first)])
    means = cloud.means.numpy().astype(np.float64)
    low, high = np.quantile(means @ tangents.T, [0.01, 0.99], axis=0)
    copies = -(-count // cloud.count)
    side = int(np.ceil(np.sqrt(copies)))
    steps = np.stack(np.meshgrid(*2 * [np.arange(side) - side // 2]), axis=-1).reshape(-1, 2)
    steps = steps[np.argsort(np.abs(steps).max(axis=1), kind="stable")][:copies]
    shifts = (steps * (high - low)) @ tangents
    sh = np.zeros((cloud.count, COEFFICIENTS, 3), np.float32)
    sh[:, : cloud.sh.shape[1]] = cloud.sh.numpy()
    many = lambda values: np.concatenate([values] * copies)[:count]  # noqa: E731
    return GaussianCloud.from_numpy(
        (means[None] + shifts[:, None]).reshape(-1, 3)[:count].astype(np.float32),
        many(cloud.rotations.numpy()),
        many(cloud.log_scales.numpy()),
        many(cloud.opacity_logits.numpy()),
        many(sh),
        device=str(cloud.device),
    )


class Stages:
    """Record of the seconds and the peak memory of each stage."""

    def __init__(self, table: Table) -> None:
        self.rows: list[Row] = []
        self._table = table

    def run(self, stage: str, action: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T:
        """Run ``action``, record and print its row, and return its result."""
        Path("/proc/self/clear_refs").write_text("5")
        result, milliseconds = timed(action, *arguments, **options)
        status = Path("/proc/self/status").read_text()
        peak, now = (int(status.split(name)[1].split()[0]) / 2**20 for name in ("VmHWM:", "VmRSS:"))
        self.rows.append({"stage": stage, "seconds": 1e-3 * milliseconds, "peak_gib": peak, "after_gib": now})
        self._table.row(*self.rows[-1].values())
        return result


def measure(options: argparse.Namespace, stages: Stages) -> None:
    """Run all stages one after another."""
    annotated = read_drawn(options.scene)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "scene.ply"
        spec = _write_scene(annotated, place, options)
        cloud = stages.run("load", read_capture, place, device=options.device).cloud
        located = stages.run("plane", locate_plane, cloud, spec)
        located = stages.run("ground", with_measured_ground, cloud, located, spec)
        object_cloud, bare, _ = stages.run("object", segment_scene, cloud, located, SceneOptions())
        object_cloud, _ = snap_to_plane(object_cloud, located)
        hole = hole_under(cloud, located.plane, located.segmentation)
        del cloud
        background = bare if hole is None else stages.run("hole", inpaint, bare, hole).cloud
        del bare
        creature = stages.run(
            "body",
            make_creature,
            object_cloud,
            plane=located.plane,
            options=CreatureOptions(ground=located.ground, nodes=options.nodes),
        )
        performance = stages.run("animate", simulate, creature, motion("jump"), frames=options.frames)
        with run_folder(Path(folder) / "film", overwrite=True) as run:
            setup = stages.run("prepare film", film_setup, performance, size=512, background=background)
            stages.run("film", draw_film, setup, run, name="film", quiet=True)
            if options.plot:
                options.plot.write_bytes((Path(folder) / "film" / "sheet.png").read_bytes())
            run.finish()


def _write_scene(annotated: DrawnScene, place: Path, options: argparse.Namespace) -> ObjectSpec:
    """Write the repeated scene to a file; return a click on its object."""
    assert annotated.capture is not None
    once = read_capture(annotated.capture, device=options.device).cloud
    spec, _ = clicked(annotated, once, [], 1)
    located = locate_plane(once, spec)
    write_ply(place, repeated(once, located.plane.normal, options.gaussians))
    return spec


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="200,000 Gaussians", device="cpu", plot="image file for the film's frames")
    parser.add_argument("--scene", choices=NAMES[:-1], default="koala", help="scene whose capture is repeated")
    parser.add_argument("--gaussians", type=int, default=3_000_000)
    parser.add_argument("--nodes", type=int, default=250, help="approximate number of nodes of the cage")
    parser.add_argument("--frames", type=int, default=2, help="frames of the film")
    options = parser.parse_args(arguments)
    if options.quick:
        options.gaussians = 200_000
    stages = Stages(Table(stage="<8", seconds="7.1f", peak_GiB="5.2f", after_GiB="5.2f"))
    measure(options, stages)
    seconds = sum(row["seconds"] for row in stages.rows if row["stage"] != "animate")
    on_gpu = options.device.startswith("cuda")
    report(
        options,
        stages.rows,
        aims={
            "memory": max(row["peak_gib"] for row in stages.rows) <= MEMORY_GIB,
            "three_minutes": seconds <= SECONDS if on_gpu else None,
        },
        why_null={} if on_gpu else {"three_minutes": "only measured on a GPU"},
        packages=["torch"],
    )


if __name__ == "__main__":
    main()
