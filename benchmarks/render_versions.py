"""Time of the renderer on a CPU and that of an older checkout, in two processes that alternate."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import GaussianCloud
from egs_warp.render import render_gaussians
from egs_warp.render.backward import backward
from egs_warp.render.compositing import Background, composite
from egs_warp.render.projection import project, view_from_camera
from egs_warp.render.tiles import build_tile_lists

# The names are not imported, because the older version does not define such a list.
_ATTRIBUTES = ("means", "rotations", "log_scales", "opacity_logits", "sh")
_WORKER = "from render_versions import serve; serve()"


def compare_versions(cloud: GaussianCloud, camera: Camera, *, old: Path, repeats: int) -> dict[str, dict[str, float]]:
    """Return, by task, the median milliseconds of wall and processor time of both versions, and the ratios old / new of
    both times.

    Args:
        cloud, camera: scene and camera of the rendered image.
        old: checkout of the older version, whose ``egs_warp.render`` must have the same interface.
        repeats: number of measurements of each version.
    """
    with tempfile.TemporaryDirectory() as place:
        scene = Path(place) / "scene.pickle"
        arrays = {name: getattr(cloud, name).numpy() for name in _ATTRIBUTES}
        scene.write_bytes(pickle.dumps({"arrays": arrays, "camera": vars(camera)}))
        here = Path(__file__).resolve().parent
        workers = {"old": _start(old, scene), "new": _start(here.parent, scene)}
        try:
            for worker in workers.values():
                _send_request(worker, "warm")
            records = {name: [] for name in workers}
            for _ in range(repeats):
                for name, worker in workers.items():
                    records[name].append(json.loads(_send_request(worker, "time")))
        finally:
            for worker in workers.values():
                worker.kill()
                worker.communicate()
    rows: dict[str, dict[str, float]] = {}
    for task in records["new"][0]:
        wall, processor = (
            {name: float(np.median([record[task][k] for record in records[name]])) for name in workers} for k in (0, 1)
        )
        rows[task] = {
            **{f"{name}_ms": ms for name, ms in wall.items()},
            **{f"{name}_processor_ms": ms for name, ms in processor.items()},
            "speedup": wall["old"] / wall["new"],
            "processor_speedup": processor["old"] / processor["new"],
        }
    return rows


def _start(checkout: Path, scene: Path) -> subprocess.Popen[str]:
    benchmarks = Path(__file__).resolve().parent
    path = os.pathsep.join([str(checkout), str(benchmarks), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", _WORKER, str(scene)],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": path},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _send_request(worker: subprocess.Popen[str], request: str) -> str:
    assert worker.stdin is not None and worker.stdout is not None
    worker.stdin.write(request + "\n")
    worker.stdin.flush()
    # Lines that Warp prints to the same stream are skipped.
    for line in worker.stdout:
        if line.startswith("{"):
            return line
    raise RuntimeError(f"the process of {worker.args} has ended with status {worker.wait()}")


def serve() -> None:
    """Render the scene that the argument of the process names once for every line of input, and print the times."""
    wp.init()
    scene = pickle.loads(Path(sys.argv[1]).read_bytes())
    cloud, camera = GaussianCloud.from_numpy(**scene["arrays"], device="cpu"), Camera(**scene["camera"])
    tasks = _tasks(cloud, camera)
    for _ in sys.stdin:
        times = {}
        for name, task in tasks.items():
            wall, processor = time.perf_counter(), time.process_time()
            task()
            times[name] = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - processor)
        print(json.dumps(times), flush=True)


def _tasks(cloud: GaussianCloud, camera: Camera) -> dict[str, Callable[[], object]]:
    view, background, shape = view_from_camera(camera), Background(wp.vec3()), (camera.height, camera.width)
    by_colour = wp.ones(shape, dtype=wp.vec3, device="cpu")
    by_alpha, by_depth = (wp.ones(shape, dtype=wp.float32, device="cpu") for _ in range(2))

    def with_gradients(threads: int) -> None:
        projected = project(cloud, view, antialiased=False, threads=threads)
        lists = build_tile_lists(projected, view, threads=threads)
        image = composite(projected, lists, view, background=background, threads=threads)
        backward(
            *(cloud, view, projected, lists, image),
            colour_gradient=by_colour,
            alpha_gradient=by_alpha,
            depth_gradient=by_depth,
            antialiased=False,
            want_pose=False,
            threads=threads,
        )

    tasks: dict[str, Callable[[], object]] = {}
    for threads in (1, 2):
        tasks[f"forward {threads}"] = lambda threads=threads: render_gaussians(
            cloud, camera, background=(0, 0, 0), threads=threads
        )
        tasks[f"forward_backward {threads}"] = lambda threads=threads: with_gradients(threads)
    return tasks
