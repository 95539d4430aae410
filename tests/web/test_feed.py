"""A session at the other end of a socket: of a test, and of the page in a real Chromium."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from egs_warp.cli import main
from egs_warp.io import write_ply
from egs_warp.locomotion.audit import audit
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.motions.stance import sole_shares
from egs_warp.web.feed import LiveFeed, live_camera
from egs_warp.web.page import PAGE
from egs_warp.web.server import LARGEST_MESSAGE, PageServer
from egs_warp.web.session import Session
from tests.support.chromium import NEEDED, opened, wait_until
from tests.support.lives import coarse_pawn, session_of
from tests.support.pages import served

needs_page = pytest.mark.skipif(not PAGE.is_file(), reason="the page is not built; make web builds it")


def in_browser(test: Any) -> Any:
    """The marks of a test in Chromium."""
    for mark in NEEDED:
        test = mark(test)
    return test


_FAR = "Math.hypot(...egs.stages[0].middle.toArray().map((x, k) => x - {}[k])) > 0.01"
"""The centre of mass is no longer there."""
_SENT = """() => {
    const { source } = egs.stages[0], send = source.send.bind(source);
    window.sent = [];
    source.send = (message) => { window.sent.push(message); send(message); };
}"""
"""Keeps what the page asks for from then on."""
_AWAY = """() => {
    const { camera } = egs.stages[0], way = camera.getWorldDirection(camera.position.clone());
    return [way.x, way.y].map((part) => part / Math.hypot(way.x, way.y));
}"""
"""Where the eye looks along the ground."""


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    made = session_of(coarse_pawn(), tmp_path)
    made.start()
    yield made
    made.stop()


@contextmanager
def _live(session: Session, **place: Any) -> Iterator[PageServer]:
    with served(feed=LiveFeed(session), **place) as server:
        yield server


@contextmanager
def _watched(chromium: Any, session: Session, *size: int) -> Iterator[Any]:
    """The page of a live session, which must not complain."""
    with _live(session) as server:
        page, complaints = opened(chromium, server.address, *size)
        yield page
        assert complaints == []
        page.close()


def _socket(server: PageServer, token: str | None = None) -> ClientConnection:
    own = f"http://127.0.0.1:{server.port}"
    address = f"ws://127.0.0.1:{server.port}/{token or server.token}/live"
    return connect(address, origin=own, max_size=None, compression=None)  # pyright: ignore[reportArgumentType]


def _news(socket: ClientConnection, **wanted: Any) -> dict[str, Any]:
    """The first news that hold what is ``wanted``."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        message = socket.recv(timeout=30)
        if isinstance(message, str):
            news = json.loads(message)
            if all(name in news and news[name] == value for name, value in wanted.items()):
                return news
    raise AssertionError(wanted)


def _error(socket: ClientConnection) -> str:
    """The first complaint."""
    while True:
        news = _news(socket)
        if "error" in news:
            return news["error"]


@needs_page
def test_a_socket_gets_header_frames_and_news_and_its_commands_are_done(session: Session):
    with _live(session) as server, _socket(server) as socket:
        head = socket.recv(timeout=20)
        assert isinstance(head, bytes) and head[:8] == b"EGSPAGE1"
        facts = json.loads(head[12 : 12 + int(np.frombuffer(head, "<u4", 1, 8)[0])])
        assert facts["title"] == "pawn" and len(facts["curves"]) == 4 and facts["limits"]["sag"] == [0.01, 0.1]
        first = socket.recv(timeout=20)
        assert isinstance(first, bytes)
        counts = np.frombuffer(first, "<u4", 4, 8).tolist()
        assert counts[0] == len(session.creature.body.node_mass) and counts[3] == 4
        assert len(first) == 32 + 12 * counts[0] + -(-counts[1] // 4) * 4 + 36 * counts[2] + 16
        socket.send(json.dumps({"type": "motion", "text": "jump 0 0.1"}))
        assert _news(socket, type="state", doing="jump")["motions"] == 1
        socket.send(json.dumps({"type": "motion", "text": "fly"}))
        assert "unknown motion 'fly'" in _error(socket)
        _news(socket, type="state", doing="stand")


@needs_page
def test_a_socket_that_is_lost_is_taken_up_where_it_was(session: Session):
    with _live(session) as server:
        with _socket(server) as socket:
            head = socket.recv(timeout=20)
            socket.send(json.dumps({"type": "motion", "text": "jump 0 0.1"}))
            _news(socket, type="state", doing="jump")
        time.sleep(0.5)
        held = session.state.time
        with _socket(server) as socket:
            assert socket.recv(timeout=20) == head
            frame = socket.recv(timeout=20)
            assert isinstance(frame, bytes)
            assert np.frombuffer(frame, "<f4", 1, 4)[0] == pytest.approx(held)
            assert _news(socket, type="state")["doing"] == "jump"


@needs_page
def test_strangers_and_giants_do_not_disturb_it(session: Session, capfd: pytest.CaptureFixture[str]):
    with _live(session) as server:
        with pytest.raises(InvalidStatus), _socket(server, "wrong-token"):
            pass
        with _socket(server) as socket:
            socket.recv(timeout=20)
            with _socket(server) as second, pytest.raises(ConnectionClosed, match="another page watches"):
                second.recv(timeout=20)
            with pytest.raises(ConnectionClosed):
                socket.send(b"x" * 100_000_000)
                while True:
                    socket.recv(timeout=20)
        assert LARGEST_MESSAGE < 100_000_000
        for _ in range(50):
            with _socket(server) as again:
                try:
                    again.recv(timeout=20)
                except ConnectionClosed:
                    time.sleep(0.1)
                    continue
                again.send("[" * 30000)
                assert _error(again).startswith("this message makes no sense")
                again.send(json.dumps({"type": "motion", "text": "jump 0 0.1"}))
                assert _news(again, type="state", doing="jump")
                break
        else:
            raise AssertionError("not taken up again")
    assert "Traceback" not in capfd.readouterr().err


def test_the_camera_sees_the_creature_with_room_around_it():
    creature = coarse_pawn()
    camera = live_camera(creature)
    seen = creature.start.positions @ camera.rotation.T + camera.translation
    place = seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    assert place.min() > 0.2 * camera.width and place.max() < 0.8 * camera.width
    assert np.ptp(place[:, 1]) > 0.2 * camera.height


@needs_page
@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--port", "70000"], "--port 70000: cannot be used"),
        (["--friction", "-1"], "--friction -1.0: give a Coulomb coefficient"),
        (["--nodes", "3"], "--nodes 3: give a number from 50 to 20000"),
        (["--muscles", "missing.json"], "missing.json: no such file"),
        (["--front", "0,0,1"], "--front 0,0,1: points up or down"),
        (["--up", "w"], "--up w: give one of"),
        (["--background", "missing.ply"], "missing.ply"),
    ],
)
def test_bad_flags_are_told_in_one_line(
    flags: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "pawn.ply", coarse_pawn().cloud)
    up = [] if "--up" in flags else ["--up", "z"]
    assert main(["live", "pawn.ply", "--nodes", "50", *up, "--no-browser", *flags]) == 2
    (line,) = [one for one in capsys.readouterr().err.splitlines() if one.startswith("egs-warp: ")]
    assert said in line


@needs_page
def test_a_port_in_use_is_told_before_any_work(session: Session, capsys: pytest.CaptureFixture[str]):
    with _live(session) as server:
        assert main(["live", "no-such.ply", "--port", str(server.port)]) == 2
        assert capsys.readouterr().err.startswith(f"egs-warp: --port {server.port}: cannot be used")


@in_browser
def test_a_key_makes_it_jump_and_the_take_says_so(chromium: Any, session: Session, tmp_path: Path):
    with _watched(chromium, session) as page:
        page.keyboard.press("r")
        wait_until(page, "egs.live.state?.recording")
        page.keyboard.press("j")
        wait_until(page, "egs.live.state?.doing === 'jump'")
        wait_until(page, "egs.live.state?.doing === 'stand'")
        heights = page.evaluate("egs.stages[0].source.frames.map((frame) => frame.curves[0])")
        assert max(heights) - heights[0] > 0.2
        page.keyboard.press("r")
        wait_until(page, "egs.live.told.some((line) => line.startsWith('wrote '))")
        report = json.loads((tmp_path / "take-1" / "report.json").read_text())
        assert [motion["name"] for motion in report["motion"]] == ["jump"]
        assert report["motion"][0]["reached"]["distance"] > 0.4


@in_browser
@pytest.mark.parametrize(
    ("pressed", "axes", "doing"), [([0], [0, 0], "jump"), ([], [-1, 0.2], "drive")], ids=["button", "stick"]
)
def test_a_gamepad_steers_it(chromium: Any, session: Session, pressed: list[int], axes: list[float], doing: str):
    with _watched(chromium, session) as page:
        page.evaluate(
            """([pressed, axes]) => {
                const buttons = Array.from({ length: 17 }, (_, k) => ({ pressed: pressed.includes(k) }));
                const held = { mapping: "standard", buttons, axes };
                Object.defineProperty(navigator, "getGamepads", { value: () => [null, held] });
            }""",
            [pressed, axes],
        )
        wait_until(page, f"egs.live.state?.doing === '{doing}'")


@in_browser
def test_a_gamepad_pushes_it_once_for_each_press(chromium: Any, session: Session):
    with _watched(chromium, session) as page:
        page.evaluate(_SENT)
        page.evaluate(
            """() => {
                const buttons = Array.from({ length: 17 }, (_, k) => ({ pressed: k === 3 }));
                const held = { mapping: "standard", buttons, axes: [0, 0] };
                const look = () => { window.looks += 1; return [held]; };
                window.press = (on) => { buttons[3].pressed = on; window.looks = 0; };
                window.looks = 0;
                Object.defineProperty(navigator, "getGamepads", { value: look });
            }"""
        )
        for on in (False, True):
            wait_until(page, "window.looks > 3")
            page.evaluate("(on) => window.press(on)", on)
        wait_until(page, "window.looks > 3")
        assert [message["type"] for message in page.evaluate("window.sent")] == ["push", "push"]


@in_browser
def test_what_is_shown_goes_evenly_and_never_back(chromium: Any, session: Session):
    with _watched(chromium, session) as page:
        page.keyboard.press(" ")
        wait_until(page, "egs.live.state?.doing === 'jump'")
        shown = page.evaluate(
            """() => new Promise((resolve) => {
                const shown = [], began = performance.now();
                const look = () => {
                    shown.push(egs.live.clock.time);
                    if (performance.now() - began < 3000) requestAnimationFrame(look); else resolve(shown);
                };
                look();
            })"""
        )
        assert len(shown) > 20 and np.diff(shown).min() >= 0.0 and shown[-1] > shown[0]
        # A frame of the solver is shown in more than one picture where the solver is slower than the screen.
        assert np.diff(shown).max() < 0.1
        assert "stand" in page.text_content(".pace") or "jump" in page.text_content(".pace")


@pytest.mark.slow
@in_browser
def test_a_click_on_the_ground_sends_it_there(chromium: Any, session: Session):
    with _watched(chromium, session, 640, 480) as page:
        box = page.locator("canvas.view").bounding_box()
        page.mouse.click(box["x"] + 400, box["y"] + 300)
        wait_until(page, "egs.live.state?.goal")
        goal = np.array(page.evaluate("egs.live.state?.goal"))
        start = np.array(page.evaluate("egs.stages[0].middle.toArray()"))[:2]
        assert np.linalg.norm(goal - start) > 0.25
        # Some hundred steps of a walk, beside a page that is drawn on the same cores.
        wait_until(page, "egs.live.state?.goal === null", seconds=600.0)
        assert not [line for line in page.evaluate("egs.live.told") if line.startswith("go")]
        place = session.steering.place
        feet = sole_shares(place.body, place.ground, place.standing) @ session.state.positions
        assert np.linalg.norm(feet[:2] - goal) < 0.15


@in_browser
def test_a_drag_pulls_at_it(chromium: Any, session: Session):
    with _watched(chromium, session) as page:
        before = page.evaluate("egs.stages[0].middle.toArray()")
        camera = page.evaluate("egs.stages[0].camera.position.toArray()")
        seen = page.evaluate(
            """() => {
                const stage = egs.stages[0], box = stage.canvas.getBoundingClientRect();
                const p = stage.middle.project(stage.camera);
                return [box.left + (p.x + 1) / 2 * box.width, box.top + (1 - p.y) / 2 * box.height];
            }"""
        )
        page.mouse.move(*seen)
        page.mouse.down()
        page.mouse.move(seen[0] + 40, seen[1], steps=4)
        wait_until(page, "egs.live.state?.pulled")
        wait_until(page, _FAR.format(before))
        page.mouse.up()
        wait_until(page, "!egs.live.state?.pulled")
        # The camera has gone along with it, and was not turned.
        moved = np.subtract(page.evaluate("egs.stages[0].camera.position.toArray()"), camera)
        assert np.linalg.norm(moved) < 0.5


@in_browser
def test_a_key_a_button_and_a_click_push_it_away_from_the_eye(chromium: Any, session: Session, tmp_path: Path):
    with _watched(chromium, session) as page:
        page.evaluate(_SENT)
        page.keyboard.press("r")
        wait_until(page, "egs.live.state?.recording")
        away, before = np.array(page.evaluate(_AWAY)), np.array(page.evaluate("egs.stages[0].middle.toArray()"))
        page.keyboard.down("b")
        page.keyboard.down("b")  # as a key that is held repeats itself
        page.keyboard.up("b")
        page.click("[title='Push it away from you (b)']")
        wait_until(page, _FAR.format(before.tolist()))
        moved = np.array(page.evaluate("egs.stages[0].middle.toArray()")) - before
        assert moved[:2] @ away > 0.9 * np.linalg.norm(moved[:2])
        head = page.evaluate(
            """() => {
                const stage = egs.stages[0], box = stage.canvas.getBoundingClientRect();
                const place = stage.middle.add({ x: 0, y: 0, z: 0.45 * stage.source.header.facts.height });
                const p = place.project(stage.camera);
                return [box.left + (p.x + 1) / 2 * box.width, box.top + (1 - p.y) / 2 * box.height];
            }"""
        )
        page.click("[title='Friction, stiffness, pushes']")
        page.locator("[aria-label=Push]").focus()
        page.keyboard.press("ArrowLeft")
        page.mouse.click(*head)
        pushes = [message for message in page.evaluate("window.sent") if message["type"] == "push"]
        assert not [message for message in page.evaluate("window.sent") if message["type"] in ("pull", "release", "go")]
        assert ["height" in push for push in pushes] == [False, False, True] and 0.6 < pushes[2]["height"] <= 1.0
        for push, size in zip(pushes, (0.15, 0.15, 0.1), strict=True):
            assert push["z"] == 0.0 and [push["x"], push["y"]] == pytest.approx((size * away).tolist(), abs=0.02 * size)
        taken = session.state.time
        wait_until(page, f"egs.stages[0].source.frames.at(-1).time > {taken + 0.1}")
        page.keyboard.press("r")
        wait_until(page, "egs.live.told.some((line) => line.startsWith('wrote '))")
    trajectory = Trajectory.load(tmp_path / "take-1" / "trajectory.npz")
    given = np.einsum("n,kni->i", trajectory.node_mass, trajectory.kick_velocity)
    body = session.creature.body
    assert np.linalg.norm(given) / (body.mass * body.speed_unit) == pytest.approx(0.4, rel=0.02)
    held = audit(trajectory)
    assert max(held.momentum_residual, held.angular_momentum_residual, held.energy_residual) < 1e-6


@in_browser
def test_pause_step_sliders_and_script(chromium: Any, session: Session):
    with _watched(chromium, session) as page:
        page.keyboard.press("p")
        wait_until(page, "egs.live.state?.paused && document.querySelector('.pace').textContent === 'paused'")
        time.sleep(0.2)
        held = session.state.time
        for _ in range(2):
            page.keyboard.press(".")
        wait_until(page, f"egs.stages[0].source.frames.at(-1).time > {held + 1.5 / 60.0}")
        assert session.state.time == pytest.approx(held + 2.0 / 60.0)
        page.click("[title='Friction, stiffness, pushes']")
        slider = page.locator("[aria-label=Friction]")
        slider.focus()
        page.keyboard.press("Home")
        wait_until(page, "egs.live.state?.friction === 0")
        page.keyboard.press("p")
        page.keyboard.press(" ")
        wait_until(page, "egs.live.state?.motions === 1")
        with page.expect_download() as script:
            page.click("[title^='Save what it did']")
        assert script.value.suggested_filename == "script.json"
        assert json.loads(Path(script.value.path()).read_text())[0]["motion"] == "jump"


@in_browser
def test_a_lost_connection_is_taken_up_and_the_session_goes_on(chromium: Any, session: Session):
    feed = LiveFeed(session)
    with served(feed=feed) as server:
        page, complaints = opened(chromium, server.address)
        page.keyboard.press(" ")
        wait_until(page, "egs.live.state?.doing === 'jump'")
        assert complaints == []
        port, token = server.port, server.token
    wait_until(page, "document.body.classList.contains('lost')")
    assert page.evaluate("document.body.dataset.lost") == "connection lost, trying again"
    assert page.locator("canvas.view").is_visible()
    page.evaluate("window.stayed = true")
    held = session.state.time
    with served(feed=feed, port=port, token=token):
        wait_until(page, f"egs.stages[0].source.frames.at(-1).time > {held + 0.1}")
        assert not page.evaluate("document.body.classList.contains('lost')")
        assert page.evaluate("window.stayed") and page.evaluate("egs.live.state?.doing") in ("jump", "stand")
        page.close()


@in_browser
def test_a_second_page_is_told_in_one_line(chromium: Any, session: Session):
    with _live(session) as server:
        first, complaints = opened(chromium, server.address)
        second = chromium.new_page()
        second.goto(server.address)
        second.wait_for_selector("[role=alert]:has-text('another page watches this run already; close it first')")
        second.close()
        first.keyboard.press(" ")
        wait_until(first, "egs.live.state?.doing === 'jump'")
        assert complaints == []
        first.close()


@in_browser
def test_a_phone_has_all_controls_within_reach(chromium: Any, session: Session):
    with _watched(chromium, session, 360, 740) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        page.click("[title^=Keys]")
        for part in (
            ".dock",
            "#left",
            "[title^='Push it']",
            "#forward",
            "#jump",
            "[title^='Record a take']",
            "[title^=Keys]",
            ".keys",
        ):
            box = page.locator(part).bounding_box()
            assert box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["y"] + box["height"] <= 740, part
        sheet = page.locator("[aria-label=Keys].sheet").bounding_box()
        assert sheet["y"] >= 0 and sheet["y"] + sheet["height"] <= page.locator(".dock").bounding_box()["y"]
        page.locator("#jump").tap() if page.evaluate("navigator.maxTouchPoints") else page.click("#jump")
        wait_until(page, "egs.live.state?.doing === 'jump'")
