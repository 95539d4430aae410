"""Time from opening a page to its first image with splats, for the page of ``view`` and for ``<egs-player>``.

Each page is opened several times, in a window of 640 x 480 pixels and in a new context of Chromium with an empty cache.
The time is measured from the navigation until the splats are sorted and drawn. The files are served by this machine.
Chromium renders in software, unless ``--browser-flags`` contains flags for a GPU (see ``headless_browser``).

Aim: ``two_seconds`` (the median of each page is at most 2 s).
"""

from __future__ import annotations

import base64
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egs_warp.launching import use_device
from egs_warp.pipelines.bundle import export_bundle
from egs_warp.web.page import export_page
from egs_warp.web.player import PLAYER
from egs_warp.web.recording import Recording
from harness import Row, Table, flags, report
from headless_browser import browser_flags, check_browser, launched, renderer_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WINDOW = {"width": 640, "height": 480}
_PLAYER_PAGE = """<!doctype html><html><body><script type="module">{script}</script>
<egs-player style="width:480px" src="data:application/octet-stream;base64,{bundle}"></egs-player></body></html>"""
_WATCH = """(() => {
    const look = () => {
        const stage = window.egs?.viewers[0] ?? document.querySelector("egs-player")?.view;
        // Spark draws the splats that have an order.
        if (stage?.splatRenderer.spark.activeSplats > 0 && !stage.dirty) window.firstPicture = performance.now();
        else requestAnimationFrame(look);
    };
    look();
})()"""


def times_of(browser: Any, address: str, count: int) -> list[float]:
    """Return the times in seconds of ``count`` visits to a page."""
    times = []
    for _ in range(count):
        page = browser.new_page(viewport=WINDOW)
        page.add_init_script(_WATCH)
        page.goto(address)
        page.wait_for_function("window.firstPicture !== undefined", timeout=120_000)
        times.append(page.evaluate("window.firstPicture") / 1e3)
        page.close()
    return times


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the pages of a run and print the table."""
    parser = flags(__doc__, quick="3 visits instead of 9", device="cpu")
    parser.add_argument("run", type=Path, nargs="?", default=Path("out/jump"), help="run folder (out/jump)")
    browser_flags(parser)
    options = parser.parse_args(arguments)
    check_browser(parser, options)
    from playwright.sync_api import sync_playwright

    use_device(options.device)
    recording = Recording.read(options.run)
    table = Table(page="<8", gaussians="7d", MB=".1f", median_s=".2f", worst_s=".2f")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder_name, sync_playwright() as started:
        folder = Path(folder_name)
        export_page(folder / "view.html", [recording])
        export_bundle(recording, folder / "run.egs")
        _write_player_page(folder)
        browser = launched(started, options)
        for page in ("view", "player"):
            path = folder / f"{page}.html"
            times = times_of(browser, path.as_uri(), 3 if options.quick else 9)
            row: Row = {
                "page": page,
                "gaussians": recording.creature.splats.count,
                "megabytes": path.stat().st_size / 1e6,
                "times_s": times,
            }
            rows.append(row)
            table.row(page, row["gaussians"], row["megabytes"], statistics.median(times), max(times))
        renderer = renderer_of(browser.new_page())
        browser.close()

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.boxplot([row["times_s"] for row in rows])
        axes.set_xticks([1, 2], [row["page"] for row in rows])
        axes.set(ylabel="time to the first image, s", ylim=(0.0, None))

    aims = {"two_seconds": all(statistics.median(row["times_s"]) <= 2.0 for row in rows)}
    conditions = {"renderer": renderer, "browser_flags": options.browser_flags}
    report(options, rows, aims=aims, conditions=conditions, packages=("playwright",), draw=draw)


def _write_player_page(folder: Path) -> None:
    """Write a page that contains the element and the bundle run.egs in one file and needs no server."""
    script = PLAYER.read_text(encoding="utf-8").replace("</script", "<\\/script")
    bundle = base64.b64encode((folder / "run.egs").read_bytes()).decode()
    (folder / "player.html").write_text(_PLAYER_PAGE.format(script=script, bundle=bundle), encoding="utf-8")


if __name__ == "__main__":
    main()
