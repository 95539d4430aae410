"""Widget for notebooks: its data, and its image in a browser."""

from __future__ import annotations

import base64
import io
import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import egs_warp as egs
from egs_warp.installation import install_command
from egs_warp.io.bundle import read_bundle
from egs_warp.web import notebook
from egs_warp.web.player import PLAYER
from tests.support.chromium import NEEDED, wait_until
from tests.support.live_sessions import coarse_pawn
from tests.support.static_site import served_folder

_TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial.ipynb"
_BUILT = pytest.mark.skipif(not PLAYER.is_file(), reason="the player is not built; make web builds it")
_PAGE = """<!doctype html><html><head><link rel="icon" href="data:,"></head><body>
<div id="cell" style="width:480px"></div></body></html>"""
# As anywidget does, the script imports the text of the module and passes bytes as a DataView.
_RENDER = """async ([code, bundle, plays]) => {
    const module = await import(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
    const bytes = Uint8Array.from(atob(bundle), (character) => character.charCodeAt(0));
    const state = { bundle: new DataView(bytes.buffer), plays };
    window.remove = module.default.render({ model: { get: (name) => state[name] }, el: cell });
    window.player = document.querySelector("egs-player");
}"""


@pytest.fixture(scope="module")
def creature() -> egs.Creature:
    return coarse_pawn()


def _show(subject: Any) -> Any:
    pytest.importorskip("anywidget")
    return egs.show(subject)


def _picture_of(widget: Any) -> np.ndarray:
    (data, _) = widget._repr_mimebundle_()
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data["image/png"]))).convert("RGB"))


def test_without_anywidget_the_extra_is_named(creature: egs.Creature, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook._widget_class.cache_clear()
    monkeypatch.setitem(sys.modules, "anywidget", None)
    with pytest.raises(
        egs.UserError, match=rf"^show: anywidget is not installed; {re.escape(install_command('notebook'))}$"
    ):
        egs.show(creature)


@_BUILT
def test_a_widget_holds_the_bundle_of_the_motion_and_a_picture(creature: egs.Creature, tmp_path: Path) -> None:
    performance = egs.simulate(creature, "stand 0.1", frames=8)
    widget = _show(performance)
    (tmp_path / "a.egs").write_bytes(widget.bundle)
    bundle = read_bundle(tmp_path / "a.egs")
    cage = bundle.bodies[0].cage
    assert cage is not None and (bundle.frames, bundle.rate, bundle.facts["title"]) == (8, 60.0, "stand")
    np.testing.assert_allclose(cage.nodes, performance.frames, atol=2e-5)
    picture = _picture_of(widget)
    assert picture.shape == (480, 480, 3) and picture.std() > 10.0


@_BUILT
@NEEDED[0]
@NEEDED[2]
def test_the_module_draws_the_creature_in_a_cell(creature: egs.Creature, chromium: Any, tmp_path: Path) -> None:
    widget = _show(creature)
    (tmp_path / "index.html").write_text(_PAGE, encoding="utf-8")
    with served_folder(tmp_path) as site:
        page = chromium.new_page(viewport={"width": 640, "height": 640})
        complaints: list[str] = []
        page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(f"{site}/index.html")
        page.evaluate(_RENDER, [widget._esm, base64.b64encode(widget.bundle).decode(), widget.plays])
        wait_until(page, "player.readyState === 4")
        text = page.evaluate(
            """async () => {
                await player.view.drawSorted();
                return player.view.canvas.toDataURL("image/png").split(",")[1];
            }"""
        )
        drawn = np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB"), float)
        own = _picture_of(widget).astype(float)
        # The body is found by its colour, because the wood is reddish and the floor is grey.
        body = own[..., 0] - own[..., 2] > 30.0
        assert 0.03 < body.mean() < 0.3 and drawn.shape == own.shape
        assert np.abs(drawn - own)[body].mean() < 4.0 < np.abs(drawn[::-1] - own)[body].mean()
        page.evaluate("remove()")
        assert page.evaluate("cell.childElementCount") == 0
        assert complaints == []
        page.close()


@pytest.mark.slow
@_BUILT
def test_the_tutorial_runs_in_a_clean_kernel(tmp_path: Path) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("anywidget")
    notebook_file = nbformat.read(_TUTORIAL, as_version=4)
    assert all(not cell.get("outputs") for cell in notebook_file.cells), "clear the outputs before you commit"
    client = nbclient.NotebookClient(notebook_file, timeout=300, resources={"metadata": {"path": str(tmp_path)}})
    client.execute(env={**os.environ, "PYTHONPATH": str(_TUTORIAL.parents[1])})
    shown = [output.data for cell in notebook_file.cells for output in cell.get("outputs", ()) if "data" in output]
    widgets = [data for data in shown if "application/vnd.jupyter.widget-view+json" in data]
    assert len(widgets) == 4 and all("image/png" in data for data in widgets)
    assert (tmp_path / "jump" / "jump.mp4").stat().st_size > 1e4
    if (folder := os.environ.get("EGS_WARP_SHOTS")) is not None:
        nbformat.write(notebook_file, Path(folder) / "tutorial.ipynb")
