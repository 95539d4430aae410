"""Speed and memory of ``<egs-player>`` in headless Chromium, for bundles of several sizes.

A cage that was simulated for a jump deforms different numbers of Gaussians of the same pawn. The page plays the film in
a square of 480 pixels. For each new picture, all Gaussians are deformed. They are sorted while pictures are drawn;
``sorts`` in the JSON is the number of sorts per second. On a machine without a GPU, Chromium draws on the CPU
(SwiftShader), which ``renderer`` in the JSON records; ``headless_browser`` lists the flags for a GPU.

Aims: ``first_picture`` (2 s for 20,000 Gaussians), ``film`` (25 pictures per second for 20,000 Gaussians),
``page_gpu_60`` (on a GPU, 60 pictures per second for every bundle).
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egs_warp.assets.pawn import pawn
from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.io.bundle import read_bundle, write_bundle
from egs_warp.launching import use_device
from egs_warp.pipelines.bundle import bundle_of_motion
from egs_warp.pipelines.creature import CreatureOptions, make_creature
from egs_warp.pipelines.simulated_run import SimulatedRun, simulate
from egs_warp.web.player import player_script
from harness import Row, Table, flags, report
from headless_browser import REFRESH, browser_flags, check_browser, is_gpu, launched, renderer_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GAUSSIANS = (20_000, 200_000, 1_000_000)
NODES = {250: 170, 500: 420}
"""Values to request from the mesher, by the approximate number of nodes that result."""
SIDE = 480
"""Width and height of the element, pixels."""
_BODY_GAUSSIANS = 20_000
"""Number of Gaussians of the capture from which the cage is built."""

LOAD = """async (side) => {
    window.started = performance.now();
    const player = document.createElement("egs-player");
    player.setAttribute("loop", "");
    player.style.width = `${side}px`;
    const ready = new Promise((resolve, reject) => {
        player.addEventListener("canplay", () => resolve(performance.now() - window.started));
        player.addEventListener("error", (event) => reject(new Error(event.message)));
    });
    player.setAttribute("src", "film.egs");
    document.body.append(player);
    window.player = player;
    return await ready;
}"""
"""Script that opens the bundle and returns the time to its first picture, ms."""

PLAY = """async (seconds) => {
    const { view } = player;
    const { spark } = view.splatRenderer;
    let drawn = 0, sorts = 0, lastSort = spark.lastSortTime;
    const draw = view.draw;
    // The element draws only what has changed; the call returns true for a new picture.
    view.draw = () => {
        const isNew = draw.call(view);
        drawn += isNew;
        if (spark.lastSortTime !== lastSort) { sorts++; lastSort = spark.lastSortTime; }
        return isNew;
    };
    const gl = view.canvas.getContext("webgl2");
    player.play();
    const began = performance.now();
    await new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
    player.pause();
    // The pictures that were requested are complete.
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    const took = (performance.now() - began) / 1000;
    delete view.draw;
    return { fps: drawn / took, sorts: sorts / took };
}"""
"""Script that plays the bundle and returns the numbers of new pictures and of sorts per second."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="only 20,000 Gaussians, 5 s each", device="cpu")
    browser_flags(parser)
    parser.add_argument(
        "--bundles", type=Path, help="folder that keeps the bundles; those that it contains are measured as they are"
    )
    parser.add_argument("--nodes", type=int, nargs="+", choices=list(NODES), default=list(NODES))
    options = parser.parse_args(arguments)
    check_browser(parser, options)
    use_device(options.device)
    seconds = 5.0 if options.quick else 10.0
    table = Table(
        gaussians="8d",
        nodes="5d",
        bundle_MB=".2f",
        first_picture_s=".2f",
        pictures_a_second=".2f",
        sorts_a_second=".2f",
        MB=".0f",
    )
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        folder = options.bundles or Path(name)
        for nodes in options.nodes:
            for path in _bundles(folder, nodes, GAUSSIANS[:1] if options.quick else GAUSSIANS):
                row = _facts(path) | measured(path, options, seconds)
                rows.append(row)
                columns = ("gaussians", "nodes", "bundle_MB", "first_picture_s", "fps", "sorts", "memory_MB")
                table.row(*(row[key] for key in columns))
    small = min(rows, key=lambda row: (row["gaussians"], row["nodes"]))
    on_gpu = is_gpu(small["renderer"])

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for nodes in sorted({row["nodes"] for row in rows}):
            chosen = [row for row in rows if row["nodes"] == nodes]
            counts = [row["gaussians"] for row in chosen]
            axes.loglog(counts, [row["fps"] for row in chosen], "o-", label=f"{nodes} nodes")
        axes.set(xlabel="Gaussians", ylabel="pictures per second")
        axes.legend()

    report(
        options,
        rows,
        aims={
            "first_picture": small["first_picture_s"] <= 2.0,
            "film": small["fps"] >= 25.0,
            "page_gpu_60": all(row["fps"] >= REFRESH for row in rows) if on_gpu else None,
        },
        why_null={} if on_gpu else {"page_gpu_60": "Chromium renders on the CPU"},
        conditions={
            "renderer": small["renderer"],
            "browser_flags": options.browser_flags,
            "load_average": os.getloadavg(),
            "cores": os.cpu_count(),
        },
        packages=("playwright",),
        draw=draw,
    )


def _bundles(folder: Path, nodes: int, counts: Sequence[int]) -> Iterator[Path]:
    """Yield the bundles with about ``nodes`` nodes and about ``counts`` Gaussians; write those that are missing in
    ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    performance = None
    for count in counts:
        path = folder / f"{nodes}_{count}.egs"
        if not path.is_file():
            performance = performance or _jump(NODES[nodes])
            _write(performance, count, path)
        yield path


def _jump(nodes: int) -> SimulatedRun:
    built = pawn(gaussian_count=_BODY_GAUSSIANS)
    creature = make_creature(built.cloud, plane=built.plane, options=CreatureOptions(nodes=nodes))
    return simulate(creature, "jump 0.5", frames=60)


def _write(performance: SimulatedRun, count: int, path: Path) -> None:
    """Write a bundle with about ``count`` Gaussians."""
    creature, trajectory = performance.creature, performance.trajectory
    cloud = creature.placed(pawn(gaussian_count=count).cloud)
    deformer = Deformer(cloud, embed_gaussians(cloud, creature.cage.mesh))
    frames = performance.simulation.frames
    write_bundle(path, bundle_of_motion(deformer, trajectory, frames, performance.camera(SIDE), title="jump"))


def _facts(path: Path) -> Row:
    """Return the sizes of a bundle."""
    body = read_bundle(path).bodies[0]
    assert body.cage is not None
    counts = {"gaussians": body.splats.count, "nodes": len(body.cage.rest_nodes)}
    return counts | {"bundle_MB": path.stat().st_size / 1e6}


def measured(bundle: Path, options: argparse.Namespace, seconds: float) -> Row:
    """Return the time to the first picture, the pictures and sorts per second, and the memory of a page that shows
    ``bundle``."""
    from playwright.sync_api import sync_playwright

    with _served(bundle) as address, sync_playwright() as started:
        chromium = launched(started, options)
        page = chromium.new_page(viewport={"width": 640, "height": 640})
        page.set_default_timeout(600_000)
        page.goto(address)
        page.evaluate("customElements.whenDefined('egs-player')")
        before = _memory(chromium)
        first = page.evaluate(LOAD, SIDE)
        played = page.evaluate(PLAY, seconds)
        renderer = renderer_of(page)
        memory = _memory(chromium) - before
        chromium.close()
    return {"first_picture_s": first / 1e3, **played, "memory_MB": memory, "renderer": renderer}


def _memory(chromium: Any) -> float:
    """Return the proportional set size of all processes of the browser, MB; it counts shared pages once."""
    session = chromium.new_browser_cdp_session()
    processes = session.send("SystemInfo.getProcessInfo")["processInfo"]
    session.detach()
    total = 0
    for process in processes:
        text = Path(f"/proc/{process['id']}/smaps_rollup").read_text()
        total += next(int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:"))
    return total * 1024 / 1e6


@contextmanager
def _served(bundle: Path) -> Iterator[str]:
    """Serve a page with the element, and ``bundle`` as film.egs; yield its address."""
    page = '<!doctype html><link rel="icon" href="data:,"><script type="module" src="player.js"></script><body>'
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(bundle, Path(folder) / "film.egs")
        (Path(folder) / "player.js").write_text(player_script(), encoding="utf-8")
        (Path(folder) / "index.html").write_text(page, encoding="utf-8")
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_QuietHandler, directory=folder))
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/index.html"
        finally:
            server.shutdown()
            thread.join()
            server.server_close()


class _QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Suppress the log of requests."""


if __name__ == "__main__":
    main()
