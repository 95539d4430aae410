"""Frame rate and latency of ``egs-warp live``, with a page in Chromium on the same machine.

A built-in pawn of 20,000 Gaussians, with cages of about 250 and 541 nodes, jumps and turns on key presses, in a page of
640 x 360 pixels. During the motion, the benchmark measures solver steps and images per second, bytes per frame, the
speed of the page's clock relative to real time, and stalls, which are the fraction of images that show no new frame.
For a body at rest, it measures the latency from a key press to the first pixel that differs by more than 4 of 255, for
several jumps and turns.

Without a GPU, Chromium renders in software, on the same cores as the solver. ``headless_browser`` lists the flags for
a GPU, and those without which Chromium draws at most 60 images per second.

Aims, for about 250 nodes: ``solver_fps`` (at least 10 steps per second; 60 on a GPU), ``page_fps`` (at least 25 images
per second; 60 if Chromium has a GPU), ``latency`` (median at most 150 ms; 60 ms on a GPU).
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egs_warp.assets.pawn import pawn
from egs_warp.io import write_ply
from harness import Row, Table, flags, report
from headless_browser import REFRESH, browser_flags, check_browser, is_gpu, launched, renderer_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GAUSSIANS = 20_000
WINDOW = {"width": 640, "height": 360}
REQUESTED_NODES = {250: 175, 541: 400}
"""Value of ``--nodes`` by the approximate number of nodes that the pawn's cage then has."""

MOVE = """(seconds) => new Promise((resolve) => {
    const viewer = egs.viewers[0], { source } = viewer, { clock } = egs.live;
    const seen = { drawn: 0, arrived: [], bytes: 0, shown: [] }, began = performance.now();
    const now = () => (performance.now() - began) / 1000;
    const draw = viewer.draw.bind(viewer), receive = source.receive.bind(source);
    viewer.draw = () => { const done = draw(); seen.drawn += done ? 1 : 0; return done; };
    source.receive = (data) => {
        if (typeof data !== "string") { seen.arrived.push(now()); seen.bytes += data.byteLength; }
        receive(data);
    };
    const look = () => {
        seen.shown.push([now(), clock.time]);
        if (now() < seconds) requestAnimationFrame(look);
        else { delete viewer.draw; delete source.receive; resolve(seen); }
    };
    look();
})"""
"""Script that counts the frames that arrive and the images that are drawn within ``seconds`` s."""
WAIT_FOR_PIXEL = """() => {
    const viewer = egs.viewers[0], { canvas } = viewer, copy = document.createElement("canvas");
    copy.width = canvas.width; copy.height = canvas.height;
    const context = copy.getContext("2d", { willReadFrequently: true });
    const pixels = () => {
        context.drawImage(canvas, 0, 0);
        return context.getImageData(0, 0, copy.width, copy.height).data;
    };
    window.latency = undefined;
    window.watching = false;
    let before, pressed;
    document.addEventListener("keydown", (event) => { pressed = event.timeStamp; }, { once: true, capture: true });
    const draw = viewer.draw.bind(viewer);
    // The resolution must be the same before and after the key press.
    viewer.setResolution = () => {};
    viewer.draw = () => {
        if (!draw()) return false;
        const now = pixels();
        window.watching = true;
        if (pressed === undefined) before = now;
        else if (now.some((value, k) => Math.abs(value - before[k]) > 4)) {
            window.latency = performance.now() - pressed;
            delete viewer.draw;
            delete viewer.setResolution;
        }
        return true;
    };
    viewer.invalidate();
}"""
"""Script that compares every image after a key press with the last image before it."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="10 s of motion and 3 latencies", seed="not used: nothing here is random")
    browser_flags(parser)
    parser.add_argument("--nodes", type=int, nargs="+", choices=list(REQUESTED_NODES), default=list(REQUESTED_NODES))
    options = parser.parse_args(arguments)
    seconds, presses = (10.0, 3) if options.quick else (30.0, 9)
    check_browser(parser, options)
    rows: list[Row] = []
    table = Table(
        nodes="5d",
        steps_a_second=".1f",
        ms_a_step=".0f",
        pictures_a_second=".1f",
        speed=".2f",
        stalls=".0%",
        bytes_a_frame="7.0f",
        latency_ms=".0f",
        worst_ms=".0f",
    )
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "pawn.ply"
        write_ply(capture, pawn(gaussian_count=GAUSSIANS).cloud)
        for nodes in options.nodes:
            with _address(capture, REQUESTED_NODES[nodes], options.device, Path(folder)) as address:
                row = measured(address, options, seconds, presses)
            rows.append(row)
            names = ("nodes", "solver_fps", "step_ms", "page_fps", "speed", "stalls", "frame_bytes")
            latencies = row["latency_ms"]
            table.row(*(row[name] for name in names), statistics.median(latencies), max(latencies))
    small = min(rows, key=lambda row: row["nodes"])
    on_gpu = options.device.startswith("cuda")
    page_gpu = is_gpu(small["renderer"])

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for row in rows:
            wall, shown = zip(*row["shown"], strict=True)
            axes.plot(wall, [moment - shown[0] for moment in shown], label=f"{row['nodes']} nodes")
        axes.set(xlabel="real time, s", ylabel="time shown, s")
        axes.legend()

    report(
        options,
        rows,
        aims={
            "solver_fps": small["solver_fps"] >= (REFRESH if on_gpu else 10.0),
            "page_fps": small["page_fps"] >= (REFRESH if page_gpu else 25.0),
            "latency": statistics.median(small["latency_ms"]) <= (60.0 if on_gpu else 150.0),
        },
        conditions={
            "renderer": small["renderer"],
            "browser_flags": options.browser_flags,
            "load_average": os.getloadavg(),
            "cores": os.cpu_count(),
        },
        packages=("playwright",),
        draw=draw,
    )


def measured(address: str, options: argparse.Namespace, seconds: float, presses: int) -> Row:
    """Open the page at ``address``, and measure ``seconds`` s of motion and the latencies of ``presses`` key
    presses."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        chromium = launched(started, options)
        page = chromium.new_page(viewport=WINDOW)  # pyright: ignore[reportArgumentType]
        page.goto(address)
        _wait(page, "window.egs?.live?.state?.resting")
        facts = page.evaluate(
            """() => {
                const { arrays } = egs.viewers[0].source.header;
                return { nodes: arrays.get("rest").length / 3, splats: arrays.get("splats_means").length / 3 };
            }"""
        )
        renderer = renderer_of(page)
        page.evaluate("egs.live.source.send({ type: 'motion', text: 'hop x20 0.4 0.2' })")
        _wait(page, "egs.live.state.doing === 'hop'")
        page.wait_for_timeout(2000)
        seen = page.evaluate(MOVE, seconds)
        page.keyboard.press("Escape")
        latencies = []
        for press in range(presses):
            _wait(page, "egs.live.state.resting && egs.live.clock.time >= egs.viewers[0].source.frames.at(-1).time")
            page.wait_for_timeout(1500)
            page.evaluate(WAIT_FOR_PIXEL)
            _wait(page, "window.watching")
            page.keyboard.press("ArrowLeft" if press % 2 else "Space")
            _wait(page, "window.latency !== undefined")
            latencies.append(page.evaluate("window.latency"))
        chromium.close()
    arrived, shown = seen["arrived"], seen["shown"]
    between = [after - before for before, after in zip(arrived, arrived[1:], strict=False)]
    moments = [moment for _, moment in shown]
    still = sum(before == after for before, after in zip(moments, moments[1:], strict=False))
    return {
        **facts,
        "renderer": renderer,
        "solver_fps": len(arrived) / seconds,
        "step_ms": 1e3 * statistics.median(between),
        "page_fps": seen["drawn"] / seconds,
        "speed": (moments[-1] - moments[0]) / seconds,
        "stalls": still / (len(moments) - 1),
        "frame_bytes": seen["bytes"] / len(arrived),
        "latency_ms": latencies,
        "shown": shown,
    }


@contextmanager
def _address(capture: Path, nodes: int, device: str, folder: Path) -> Iterator[str]:
    """Start ``egs-warp live`` in its own process and yield the address of its page."""
    command = [sys.executable, "-m", "egs_warp.cli", "live", str(capture), "--up", "z", "--no-browser"]
    more = ["--nodes", str(nodes), "--device", device, "--out", str(folder / "takes")]
    process = subprocess.Popen([*command, *more], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stderr is not None
        for line in process.stdout:
            if line.startswith("open "):
                yield line.split()[1]
                break
        else:
            raise RuntimeError(process.stderr.read())
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=60)


def _wait(page: Any, condition: str) -> None:
    """Wait until ``condition`` holds on the page, which reloads itself when the body is prepared."""
    from playwright.sync_api import Error

    end = time.monotonic() + 150.0
    while time.monotonic() < end:
        try:
            if page.evaluate(condition):
                return
        except Error as problem:
            if "navigation" not in problem.message:
                raise
        page.wait_for_timeout(50)
    raise TimeoutError(f"{condition}: {page.evaluate('JSON.stringify([egs.live?.state, egs.live?.messages])')}")


if __name__ == "__main__":
    main()
