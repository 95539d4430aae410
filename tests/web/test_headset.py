"""Pages in an emulated headset: real size, feet on the floor, pointing, and the return to the page."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from egs_warp.pipelines.bundle import export_bundle
from egs_warp.web.page import export_page
from egs_warp.web.player import PLAYER, player_script
from egs_warp.web.recording import Recording
from egs_warp.web.session import Session
from tests.support.chromium import NEEDED, opened, wait_until
from tests.support.headsets import HEAD, emulation, needs_headset
from tests.support.live_pages import KEEP_SENT, watched
from tests.support.static_site import served_folder

pytestmark = [*NEEDED, needs_headset]
_READ = """() => {
    const { cameras } = stage.renderer.xr.getCamera();
    return [cameras.map(({ matrixWorld }) => matrixWorld.elements), [...stage.bodies.positions]];
}"""
_POINT = """([hand, x, y, z]) => {
    const controller = device.controllers[hand], from = { x: 0.2, y: 1.2, z: -0.4 };
    // The ray of a controller leaves it along its -z axis.
    const [dx, dy, dz] = [x - from.x, y - from.y, z - from.z], length = Math.hypot(dx, dy, dz);
    const cross = [dy, -dx, 0].map((value) => value / length), w = 1 - dz / length;
    const size = Math.hypot(...cross, w);
    controller.position.set(from.x, from.y, from.z);
    controller.quaternion.set(cross[0] / size, cross[1] / size, cross[2] / size, w / size);
}"""
"""JavaScript that points a controller at a position in the room."""
_PRESS = "([hand, button, value]) => { device.controllers[hand].updateButtonValue(button, value); }"


@pytest.fixture(scope="module")
def site(recording: Recording, run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("headset")
    export_page(folder / "view.html", [recording])
    export_bundle(recording, folder / "a.egs")
    (folder / "player.js").write_text(player_script(), encoding="utf-8")
    (folder / "player.html").write_text(
        '<!doctype html><html><head><link rel="icon" href="data:,"></head><body>'
        '<script type="module" src="player.js"></script>'
        '<egs-player id="one" style="width:300px" src="a.egs" controls></egs-player></body></html>',
        encoding="utf-8",
    )
    with served_folder(folder) as address:
        yield address


@contextmanager
def _view(chromium: Any, site: str, **settings: Any) -> Iterator[Any]:
    """Open the page of a run with an emulated headset; it must not report errors."""
    page, complaints = opened(chromium, f"{site}/view.html", scripts=emulation(settings.pop("hit", None)), **settings)
    page.evaluate("window.stage = egs.viewers[0]")
    yield page
    assert complaints == []
    page.close()


def _enter(page: Any, kind: str) -> None:
    page.locator(f"button[title^='Enter {kind}']").click()
    _images(page)


def _images(page: Any, count: int = 4) -> None:
    """Wait until the session has drawn some images."""
    page.evaluate(
        """(count) => new Promise((resolve) => {
            const draw = stage.draw.bind(stage);
            stage.draw = () => {
                const done = draw();
                if (--count <= 0) { stage.draw = draw; resolve(); }
                return done;
            };
        })""",
        count,
    )


def _in_room(page: Any, points: Any = None) -> np.ndarray:
    """Return points (N, 3), m, of the scene in the space of the emulated headset, which has y up and its floor at y =
    0.

    By default, the points are the nodes of the body.
    """
    cameras, positions = page.evaluate(_READ)
    poses = np.reshape(cameras, (2, 4, 4)).transpose(0, 2, 1)
    # The head is not rotated; its position is the mean of the eyes.
    rotation, eye = poses[0, :3, :3], poses[:, :3, 3].mean(axis=0)
    return np.array(HEAD) + (np.reshape(positions if points is None else points, (-1, 3)) - eye) @ rotation


def _middle(page: Any) -> np.ndarray:
    nodes = _in_room(page)
    return 0.5 * (nodes.min(axis=0) + nodes.max(axis=0))


def _canvas(page: Any) -> np.ndarray:
    """Return the next image (H, W, 4) of the session, 0 to 1, with the views of both eyes side by side."""
    text = page.evaluate(
        """() => new Promise((resolve) => {
            const draw = stage.draw.bind(stage);
            stage.draw = () => {
                const done = draw();
                stage.draw = draw;
                resolve(stage.canvas.toDataURL("image/png").split(",")[1]);
                return done;
            };
        })"""
    )
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("RGBA"), np.float64) / 255.0


def _point(page: Any, hand: str, place: np.ndarray) -> None:
    page.evaluate(_POINT, [hand, *place.tolist()])
    _images(page, 2)


def _press(page: Any, hand: str, button: str, *, on: bool) -> None:
    page.evaluate(_PRESS, [hand, button, float(on)])
    _images(page, 2)


def test_a_run_stands_on_the_floor_of_a_headset_at_its_real_size(chromium: Any, site: str, recording: Recording):
    with _view(chromium, site) as page:
        before = page.evaluate("[stage.camera.position.toArray(), stage.canvas.width]")
        _enter(page, "VR")
        nodes = _in_room(page)
        assert abs(nodes[:, 1].min()) < 0.01
        assert np.ptp(nodes[:, 1]) == pytest.approx(np.ptp(recording.trajectory.positions[0][:, 2]), rel=1e-4)
        # The body is in front of the head, which looks along -z.
        distance = max(1.2, 1.5 * recording.trajectory.height)
        np.testing.assert_allclose(_middle(page)[[0, 2]], [HEAD[0], HEAD[2] - distance], atol=0.1 * distance)
        page.locator("button[title='Leave VR']").dispatch_event("click")
        wait_until(page, "!stage.headset.isPresenting && !stage.renderer.xr.isPresenting")
        _images(page, 2)
        after = page.evaluate("[stage.camera.position.toArray(), stage.canvas.width]")
        np.testing.assert_allclose(after[0], before[0], atol=1e-6)
        assert after[1] == before[1] and page.evaluate("stage.controls.enabled && stage.ground.mesh.visible")
        assert page.locator("button[title^='Enter VR']").is_visible()


@pytest.mark.parametrize("hit", [None, (0.35, -0.12, -1.5)], ids=["local-floor", "hit-test"])
def test_a_run_stands_on_the_real_floor_with_its_shadow(
    chromium: Any, site: str, hit: tuple[float, float, float] | None
):
    with _view(chromium, site, hit=hit) as page:
        _enter(page, "AR")
        floor = 0.0 if hit is None else hit[1]
        assert abs(_in_room(page)[:, 1].min() - floor) < 0.01
        if hit is not None:
            np.testing.assert_allclose(_middle(page)[[0, 2]], np.array(hit)[[0, 2]], atol=0.1)
        page.evaluate("device.quaternion.set(Math.sin(-0.25), 0, 0, Math.cos(-0.25))")
        _images(page, 30)
        picture = _canvas(page)
        half = picture[:, : picture.shape[1] // 2]
        alpha, colour = half[..., 3], half[..., :3].max(axis=-1)
        # Most of the image shows the room; the body is opaque, and its shadow is black and translucent.
        assert (alpha == 0.0).mean() > 0.5 and (alpha > 0.98).mean() > 0.005
        shadow = (alpha > 0.05) & (alpha < 0.6) & (colour < 0.01)
        assert shadow.mean() > 0.002
        assert not page.evaluate("stage.ground.mesh.visible")


def test_selecting_a_place_moves_the_user_or_the_creature(chromium: Any, site: str):
    with _view(chromium, site) as page:
        for kind, hand in (("VR", "right"), ("AR", "left")):
            _enter(page, kind)
            before = _middle(page)
            place = before + [0.7, -before[1], -0.3]
            place[1] = 0.0
            _point(page, hand, place)
            _press(page, hand, "trigger", on=True)
            _press(page, hand, "trigger", on=False)
            moved = _middle(page) - before
            # In VR the user moves to the selected position; in AR the creature does.
            expected = np.array(HEAD) - place if kind == "VR" else place - before
            np.testing.assert_allclose(moved[[0, 2]], expected[[0, 2]], atol=0.05)
            assert abs(_in_room(page)[:, 1].min()) < 0.01
            page.evaluate("stage.headset.leave()")
            wait_until(page, "!stage.headset.isPresenting")


def test_a_squeeze_drags_the_creature_over_the_floor(chromium: Any, site: str):
    with _view(chromium, site) as page:
        _enter(page, "VR")
        before = _middle(page)
        start = np.array([0.4, 0.0, -1.0])
        _point(page, "right", start)
        _press(page, "right", "squeeze", on=True)
        _point(page, "right", start + [-0.5, 0.0, -0.6])
        _images(page, 3)
        _press(page, "right", "squeeze", on=False)
        _point(page, "right", start)
        np.testing.assert_allclose(_middle(page) - before, [-0.5, 0.0, -0.6], atol=0.02)


def test_selecting_the_floor_sends_a_live_creature_there(chromium: Any, session: Session):
    with watched(chromium, session, scripts=emulation()) as page:
        page.evaluate("window.stage = egs.viewers[0]")
        wait_until(page, "egs.live.state?.resting")
        page.evaluate(KEEP_SENT)
        _enter(page, "VR")
        assert abs(_in_room(page)[:, 1].min()) < 0.01
        before = _middle(page)
        place = np.array([before[0] + 0.5, 0.0, before[2]])
        _point(page, "right", place)
        _press(page, "right", "trigger", on=True)
        _press(page, "right", "trigger", on=False)
        wait_until(page, "egs.live.state?.goal !== null")
        (sent,) = page.evaluate("sent.filter(({ type }) => type === 'go')")
        np.testing.assert_allclose(_in_room(page, [sent["x"], sent["y"], 0.0]), [place], atol=1e-3)
        wait_until(page, "egs.live.state?.doing !== 'stand' || egs.live.state?.motions > 0")


@pytest.mark.skipif(not PLAYER.is_file(), reason="the player is not built; make web builds it")
def test_the_player_enters_and_leaves_both(chromium: Any, site: str):
    page = chromium.new_page()
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    for script in emulation():
        page.add_init_script(script)
    page.goto(f"{site}/player.html")
    wait_until(page, "document.querySelector('egs-player').readyState === 4")
    page.evaluate("window.stage = one.view")
    for kind in ("VR", "AR"):
        _enter(page, kind)
        assert abs(_in_room(page)[:, 1].min()) < 0.01
        assert page.evaluate("stage.ground.mesh.visible") == (kind == "VR")
        page.evaluate("stage.headset.leave()")
        wait_until(page, "!stage.headset.isPresenting")
    _images(page, 2)
    assert page.evaluate("stage.canvas.width") == 300 and complaints == []
    page.close()


def test_without_a_headset_there_is_no_button(chromium: Any, site: str):
    page, complaints = opened(chromium, f"{site}/view.html")
    assert page.locator("button[title^='Enter']:visible").count() == 0
    assert complaints == []
    page.close()
