"""A creature in a three.js scene, in a real Chromium."""

from __future__ import annotations

import base64
import io
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from egs_warp.pipelines.bundle import export_bundle
from egs_warp.pipelines.finished_run import FinishedRun
from egs_warp.web.player import PLAYER
from tests.support.chromium import NEEDED, wait_until
from tests.support.static_site import served_folder

_PACKAGES = PLAYER.parents[1] / "node_modules"
pytestmark = [
    *NEEDED,
    pytest.mark.skipif(not PLAYER.is_file(), reason="the player is not built; make web builds it"),
    pytest.mark.skipif(
        not _PACKAGES.is_dir(), reason="three.js is not installed beside the player; make web installs it"
    ),
]
_SCENE = """
<script type="importmap">{ "imports": {
  "three": "./node_modules/three/build/three.module.js", "three/addons/": "./node_modules/three/examples/jsm/",
  "@sparkjsdev/spark": "./node_modules/@sparkjsdev/spark/dist/spark.module.js"
} }</script>
<script type="module">
import * as THREE from "three";
import { SparkRenderer } from "@sparkjsdev/spark";
import { addCreature } from "./creature.js";
const renderer = new THREE.WebGLRenderer();
renderer.setSize(240, 240);
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(40, 1, 0.05, 100);
camera.position.set(2, 0.5, 3);
camera.lookAt(2, 0.5, 0);
const creature = await addCreature(scene, renderer, "a.egs");
creature.object.position.set(2, 0, 0);
creature.seek(0.1);
const other = new THREE.Scene();
other.add(new SparkRenderer({ renderer }));
const refused = await addCreature(other, renderer, "a.egs").catch((error) => error.message);
window.scene = { renderer, scene, camera, creature, refused };
</script>"""


def test_a_creature_stands_in_any_scene_of_three(chromium: Any, run_folder: Path, tmp_path: Path) -> None:
    export_bundle(FinishedRun.read(run_folder), tmp_path / "a.egs")
    shutil.copy(PLAYER.with_name("three.js"), tmp_path / "creature.js")
    (tmp_path / "node_modules").symlink_to(_PACKAGES)
    head = '<!doctype html><html><head><link rel="icon" href="data:,"></head><body>'
    (tmp_path / "scene.html").write_text(f"{head}{_SCENE}</body></html>", encoding="utf-8")
    with served_folder(tmp_path) as site:
        page = chromium.new_page(viewport={"width": 320, "height": 320})
        complaints: list[str] = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(f"{site}/scene.html")
        wait_until(page, "window.scene !== undefined || false")
        text = page.evaluate(
            """async () => {
                const { renderer, scene, camera } = window.scene;
                const spark = scene.children.find((one) => "activeSplats" in one);
                do {
                    renderer.render(scene, camera);
                    await new Promise((resolve) => setTimeout(resolve, 50));
                } while (spark.sorting || spark.activeSplats === 0);
                renderer.render(scene, camera);
                return renderer.domElement.toDataURL("image/png").split(",")[1];
            }"""
        )
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("L"), float)
        rows, columns = np.nonzero(picture > 20)
        # The body is 1 m tall, upright along y and in the middle of the picture, of which 240 pixels show 2.18 m.
        assert 90 < np.ptp(rows) < 130 and abs(columns.mean() - 120) < 12 and 40 < np.ptp(columns) < 90
        assert page.evaluate("window.scene.refused").endswith("has to be created with covSplats: true")
        assert complaints == []
        page.close()
