"""Page of a world in Chromium, which shows all bodies and selects the one that is clicked."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from egs_warp import cli
from egs_warp.errors import UserError
from egs_warp.locomotion.audit import Audit
from egs_warp.locomotion.world_audit import PairAudit, WorldAudit
from egs_warp.pipelines.bundle import export_bundle
from egs_warp.pipelines.end_state import State
from egs_warp.pipelines.world_report import Penetration, WorldReport
from egs_warp.render.rasteriser import render_gaussians
from egs_warp.web.page import export_page
from egs_warp.web.player import PLAYER, player_script
from egs_warp.web.world_recording import WorldRecording, read_recording
from tests.support.chromium import opened, wait_until
from tests.support.finished_worlds import NAMES, write_world_run
from tests.support.live_pages import in_browser
from tests.support.page_camera import page_camera
from tests.support.page_pictures import BACKGROUND, STAGE, picture_of, psnr_on_body
from tests.support.static_site import served_folder

_CLICK_ON = """(index) => {
    const viewer = egs.viewers[0], [first, count] = viewer.parts[index].nodes;
    const box = viewer.canvas.getBoundingClientRect();
    viewer.camera.updateMatrixWorld();
    for (let node = first; node < first + count; node++) {
        const point = viewer.nodePosition(node).project(viewer.camera);
        const at = [box.left + (0.5 + 0.5 * point.x) * box.width, box.top + (0.5 - 0.5 * point.y) * box.height];
        // The positions of clicks are whole pixels.
        at.forEach((value, k) => { at[k] = Math.round(value); });
        const hit = viewer.pick(...at);
        if (hit !== undefined && viewer.bodyOf(hit.node) === index) return at;
    }
}"""
"""JavaScript that returns a window position at which a body is visible."""


@pytest.mark.parametrize("scheme", ["dark", "light"])
@in_browser
def test_a_click_selects_a_body(chromium: Any, tmp_path: Path, scheme: str) -> None:
    folder, file = write_world_run(tmp_path / "run"), tmp_path / "world.html"
    assert cli.main(["view", str(folder), "--export", str(file)]) == 0
    page, complaints = opened(chromium, file.as_uri(), 700, 460, color_scheme=scheme)
    rows = page.locator(".bodies .body")
    assert rows.count() == 2 and page.evaluate("egs.selected") is None
    page.mouse.click(*page.evaluate(_CLICK_ON, 1))
    assert page.evaluate("egs.selected") == 1
    assert rows.nth(1).get_attribute("aria-pressed") == "true" and rows.nth(0).get_attribute("aria-pressed") == "false"
    assert rows.nth(1).locator(".detail").inner_text() == "box-1 fell"
    page.keyboard.press("c")
    assert page.locator(".curves .row:visible").count() == 5
    page.keyboard.press("c")
    centre = page.evaluate("egs.viewers[0].centreOfMass.toArray()")
    rows.nth(0).click()
    assert page.evaluate("egs.selected") == 0
    assert page.evaluate("egs.viewers[0].centreOfMass.toArray()")[2] < centre[2] - 0.2
    page.mouse.click(*page.evaluate(_CLICK_ON, 0))
    assert page.evaluate("egs.selected") is None
    assert complaints == []
    page.close()


def _with_deep_bodies(recording: WorldRecording) -> WorldRecording:
    """Return the recording with the report of a world in which the first body is inside the second one, which is deeper
    than 1 % of its height in the ground."""
    numbers: dict[str, Any] = {each.name: 0 for each in fields(Audit)}
    rows: Any = {
        name: SimpleNamespace(audit=replace(Audit(**numbers), penetration=depth), state=State.DONE)
        for name, depth in zip(NAMES, (0.019, 0.017), strict=True)
    }
    values: dict[str, Any] = {each.name: 0.0 for each in fields(PairAudit)} | {"bodies": (0, 1)}
    found = {
        NAMES[0]: Penetration(NAMES, 0.1, 0.019),
        NAMES[1]: Penetration(NAMES[1:], 0.1, 0.017),
    }
    audit = WorldAudit(0.0, 0.0, (PairAudit(**values),))
    results = {name: f"{name} fell" for name in NAMES}
    report = WorldReport(rows, results, audit, stopped=False, penetrations=found).to_json()
    return replace(recording, report={**recording.report, **report})


def test_only_failures_of_pairs_are_listed_beside_those_of_bodies(tmp_path: Path) -> None:
    header = _with_deep_bodies(WorldRecording.read(write_world_run(tmp_path / "run"))).header()
    facts = json.JSONDecoder().raw_decode(header[header.index(b'{"') :].decode("utf-8", "replace"))[0]
    assert [line.partition(":")[0] for line in facts["failures"]] == [" and ".join(NAMES)]


@in_browser
def test_only_failed_audits_are_red_and_a_phone_shows_names_first(chromium: Any, tmp_path: Path) -> None:
    folder, file = write_world_run(tmp_path / "run"), tmp_path / "world.html"
    recording = WorldRecording.read(folder)
    recording = _with_deep_bodies(recording)
    export_page(file, [recording])
    page, complaints = opened(chromium, file.as_uri(), 390, 844)
    red = page.evaluate(
        """() => [...document.querySelectorAll(".bodies :is(b, small, .detail, p)")]
            .filter((one) => getComputedStyle(one).color === getComputedStyle(document.querySelector(".failure")).color)
            .map(({ textContent }) => textContent)"""
    )
    assert "audit failed" in red and "box-1 fell" not in red
    pair = "penetration 1.9 times its limit, 1.9 cm deep at 0.10 s; look at the film there, and if it shows, change the"
    assert [text for text in red if pair in text] == [
        f"{' and '.join(NAMES)}: {pair} motion or the distance of the bodies"
    ]
    details = page.locator(".bodies .detail")
    assert not any(one.is_visible() for one in details.all())
    page.locator(".bodies .body", has_text="box-1").click()
    visible = [one.inner_text() for one in details.all() if one.is_visible()]
    assert visible[0] == "box-1 fell" and visible[1].startswith("penetration 1.7 times its limit, 1.7 cm deep at ")
    assert complaints == []
    page.close()


def _stacked(recording: WorldRecording, upper: str) -> WorldRecording:
    """Return the recording with the body ``upper`` close above the other one. The soft block is bent. The upper body is
    transparent, so that its whole shadow is visible."""
    bodies = {}
    for name, run in recording.bodies.items():
        t = run.trajectory
        positions = t.positions.copy()
        positions[..., 2] += {"block": 0.31, "box-1": -0.42}[name] if upper == "block" else 0.0
        if name == "block":
            positions[..., 2] += 0.4 * positions[..., 0] ** 2
        splats = run.creature.splats
        if name == upper:
            splats = replace(splats, opacity_logits=wp.full_like(splats.opacity_logits, -20.0))
        creature = replace(run.creature, splats=splats)
        bodies[name] = replace(run, trajectory=replace(t, positions=positions), creature=creature)
    return replace(recording, bodies=bodies)


def _film_pictures(recording: WorldRecording, page: Any, stage: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the first frame without and with the contact shadows of films, for the camera of the page."""
    filmed, camera = recording.filmed, page_camera(page, stage)
    poses = filmed.poses(0)
    cloud = filmed.joint_deformer().deform(poses).cloud
    plain = np.clip(render_gaussians(cloud, camera, background=BACKGROUND).colour.numpy(), 0.0, 1.0)
    filmed.shadows(cloud.device).draw(cloud, poses)
    return plain, np.clip(render_gaussians(cloud, camera, background=BACKGROUND).colour.numpy(), 0.0, 1.0)


def _check_shadows(plain: np.ndarray, shaded: np.ndarray, picture: np.ndarray) -> None:
    """Check that ``picture`` has the shadows of ``shaded``, and elsewhere the colours of ``plain``."""
    assert psnr_on_body(shaded, picture) >= 38.0 > 8.0 + psnr_on_body(plain, picture)
    depth = (plain - shaded).max(axis=-1)
    in_shadow = depth > 0.05
    assert in_shadow.sum() > 300
    # Differences of the renderers at edges do not depend on the shadow, so the median is compared.
    ratios = (plain - picture).max(axis=-1)[in_shadow] / depth[in_shadow]
    assert abs(np.median(ratios) - 1.0) < 0.05
    assert np.quantile(np.abs(picture - plain).max(axis=-1)[depth == 0.0], 0.99) < 0.02


@pytest.mark.parametrize("upper", NAMES)
@in_browser
def test_a_body_shades_the_body_below_it_as_in_a_film(chromium: Any, tmp_path: Path, upper: str) -> None:
    recording = _stacked(WorldRecording.read(write_world_run(tmp_path / "run")), upper)
    export_page(tmp_path / "world.html", [recording])
    page, complaints = opened(chromium, (tmp_path / "world.html").as_uri())
    page.evaluate("egs.setLayer('ground', false)")
    _check_shadows(*_film_pictures(recording, page, STAGE), picture_of(page))
    assert complaints == []
    page.close()


@pytest.mark.skipif(not PLAYER.is_file(), reason="the player is not built; make web builds it")
@in_browser
def test_the_player_draws_the_shadows_of_a_bundle(chromium: Any, tmp_path: Path) -> None:
    recording = _stacked(WorldRecording.read(write_world_run(tmp_path / "run")), "block")
    export_bundle(recording, tmp_path / "a.egs")
    (tmp_path / "player.js").write_text(player_script(), encoding="utf-8")
    colour = "#b9bec6"
    element = f'<egs-player src="a.egs" style="width:480px" background="{colour}"></egs-player>'
    (tmp_path / "index.html").write_text(
        f'<!doctype html><link rel="icon" href="data:,"><script type="module" src="player.js"></script>{element}',
        encoding="utf-8",
    )
    stage = "document.querySelector('egs-player').view"
    with served_folder(tmp_path) as address:
        page = chromium.new_page(viewport={"width": 640, "height": 640})
        page.goto(f"{address}/index.html")
        wait_until(page, "document.querySelector('egs-player').readyState === 4")
        _check_shadows(*_film_pictures(recording, page, stage), picture_of(page, stage))
        page.close()


def test_a_background_is_refused(tmp_path: Path) -> None:
    folder = write_world_run(tmp_path / "run")
    assert isinstance(read_recording(folder), WorldRecording)
    with pytest.raises(UserError, match="a scene behind the body is for the run of a single capture; leave it out"):
        read_recording(folder, background=tmp_path / "a.ply")
