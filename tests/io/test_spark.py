"""Reading of our files by Spark: counts, positions, sizes, rotations, opacities and colours are those that egs_warp
reads."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egs_warp.geometry.gaussians import SH_BAND_0
from egs_warp.io import read_capture
from egs_warp.io.writing import WRITERS
from egs_warp.web.page import PAGE
from tests.support.captures import make_cloud
from tests.support.chromium import NEEDED

PACKAGES = PAGE.parent / "client" / "node_modules"
pytestmark = [
    *NEEDED,
    pytest.mark.slow,
    pytest.mark.skipif(not PACKAGES.is_dir(), reason="Spark is not installed; make web installs it"),
]
ADDRESS = "http://spark.test"
MODULES = """<script type="importmap">{"imports": {
    "three": "/three/build/three.module.js",
    "three/addons/": "/three/examples/jsm/",
    "@sparkjsdev/spark": "/@sparkjsdev/spark/dist/spark.module.js"
}}</script>"""
READ = """async ([text, fileName]) => {
    const { ExtSplats } = await import("@sparkjsdev/spark");
    const fileBytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
    const splats = new ExtSplats({ fileBytes, fileName });
    await splats.initialized;
    const rows = [];
    splats.forEachSplat((_, centre, scales, turn, opacity, colour) =>
        rows.push([...centre.toArray(), ...scales.toArray(), ...turn.toArray(), opacity, ...colour.toArray()]));
    return rows;
}"""


@pytest.fixture(scope="module")
def page(chromium: Any) -> Iterator[Any]:
    def answer(route: Any) -> None:
        name = route.request.url.removeprefix(ADDRESS).lstrip("/")
        if name:
            route.fulfill(path=PACKAGES / name)
        else:
            route.fulfill(body=MODULES, content_type="text/html")

    page = chromium.new_page()
    page.route(f"{ADDRESS}/**", answer)
    page.goto(ADDRESS)
    yield page
    page.close()


# Spark reads neither version 4 of .spz nor glTF.
@pytest.mark.parametrize("kind", ["ply", "compressed-ply", "spz", "sog", "splat"])
def test_spark_reads_our_files(kind: str, page: Any, tmp_path: Path) -> None:
    path = tmp_path / f"a{WRITERS[kind].ending}"
    WRITERS[kind](path, make_cloud(300, 3))
    rows = np.array(page.evaluate(READ, [base64.b64encode(path.read_bytes()).decode(), path.name]))
    ours = read_capture(path, device="cpu")
    assert rows.shape == (ours.count, 14)
    centres, sizes, turns, opacities, colours = np.split(rows, [3, 6, 10, 11], axis=1)
    np.testing.assert_allclose(centres, ours.means.numpy(), rtol=0, atol=1e-5)
    # Spark keeps sizes, rotations, opacities and colours with fewer bits.
    np.testing.assert_allclose(np.log(sizes), ours.log_scales.numpy(), rtol=0, atol=0.003)
    cosines = np.abs((turns[:, [3, 0, 1, 2]] * ours.rotations.numpy()).sum(axis=1))
    # Spark decodes the bytes of a quaternion in .splat differently.
    assert cosines.min() > (1.0 - 2e-4 if kind == "splat" else 1.0 - 2e-5)
    np.testing.assert_allclose(opacities[:, 0], ours.opacities(), rtol=0, atol=5e-4)
    np.testing.assert_allclose(colours, 0.5 + SH_BAND_0 * ours.sh.numpy()[:, 0], rtol=0, atol=5e-4)
