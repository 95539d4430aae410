"""The React example of the player, built with the npm package and run in a real Chromium."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from egs_warp.web.player import PLAYER
from tests.support.bundles import bundle_bytes
from tests.support.chromium import NEEDED, wait_until
from tests.support.static_site import served_folder

_PACKAGES = PLAYER.parents[1] / "node_modules"
_ROOT = Path(__file__).parents[2]
EXAMPLE = _ROOT / "examples" / "web_player" / "react.jsx"
pytestmark = [
    *NEEDED,
    pytest.mark.skipif(not PLAYER.is_file(), reason="the player is not built; make web builds it"),
    pytest.mark.skipif(not (_PACKAGES / "react").is_dir(), reason="React is not installed; make web installs it"),
]
_MAIN = """
import { createRoot } from "react-dom/client";
import { Creature } from "./react.jsx";
const root = createRoot(document.getElementById("root"));
window.show = (file) => root.render(file ? <Creature file={file} title={file} /> : null);
window.show("a.egs");
"""
_PAGE = """<!doctype html><link rel="icon" href="data:,"><style>egs-player { width: 240px }</style>
<div id="root"></div><script type="module" src="built.js"></script>"""


def _build(folder: Path) -> None:
    """Bundle the example as an application would that has installed the package."""
    (folder / "main.jsx").write_text(_MAIN, encoding="utf-8")
    (folder / "react.jsx").write_text(EXAMPLE.read_text(encoding="utf-8"), encoding="utf-8")
    packages = folder / "node_modules"
    packages.mkdir()
    for name in ("react", "react-dom", "scheduler"):
        (packages / name).symlink_to((_PACKAGES / name).resolve())
    (packages / "egs-player").symlink_to(PLAYER.parents[1])
    flags = ["--bundle", "--format=esm", "--jsx=automatic", '--define:process.env.NODE_ENV="production"']
    command = [str(_PACKAGES / ".bin" / "esbuild"), "main.jsx", *flags, "--outfile=built.js", "--log-level=warning"]
    subprocess.run(command, cwd=folder, check=True)


def test_the_example_plays_follows_its_file_and_is_removed(chromium: Any, tmp_path: Path) -> None:
    for name in ("a.egs", "b.egs"):
        (tmp_path / name).write_bytes(bundle_bytes())
    (tmp_path / "index.html").write_text(_PAGE, encoding="utf-8")
    _build(tmp_path)
    with served_folder(tmp_path) as site:
        page = chromium.new_page(viewport={"width": 400, "height": 400})
        complaints: list[str] = []
        page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(f"{site}/index.html")
        wait_until(page, "document.querySelector('egs-player')?.readyState === 4")
        page.evaluate("window.player = document.querySelector('egs-player')")
        assert page.evaluate("[player.hasAttribute('loop'), player.hasAttribute('controls')]") == [True, True]
        page.evaluate("player.currentTime = 0.5")
        wait_until(page, "document.querySelector('figcaption').textContent.includes('a.egs, 0.50 s')")
        page.click("text=From the start")
        assert not page.evaluate("player.paused")
        wait_until(page, "player.currentTime > 0 && player.currentTime < 0.4")
        page.evaluate("show('b.egs')")
        wait_until(page, "document.querySelector('figcaption').textContent.startsWith('b.egs')")
        wait_until(page, "player.readyState === 4 && player.isConnected")
        page.evaluate("show()")
        wait_until(page, "document.querySelector('egs-player') === null && player.readyState === 0")
        assert complaints == []
        page.close()
