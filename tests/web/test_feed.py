"""A live session behind a socket, and the command that serves it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from egs_warp.assets.pawn import pawn
from egs_warp.cli import main
from egs_warp.io import write_ply
from egs_warp.launching import THREADS, available_threads
from egs_warp.web.feed import live_camera
from egs_warp.web.server import MAX_MESSAGE_BYTES, PageServer
from egs_warp.web.session import Session
from tests.support.live_pages import living, needs_page
from tests.support.live_sessions import coarse_pawn, session_of


def _socket(server: PageServer, token: str | None = None) -> ClientConnection:
    own = f"http://127.0.0.1:{server.port}"
    address = f"ws://127.0.0.1:{server.port}/{token or server.token}/live"
    return connect(address, origin=own, max_size=None, compression=None)  # pyright: ignore[reportArgumentType]


def _news(socket: ClientConnection, **wanted: Any) -> dict[str, Any]:
    """Return the first message that contains ``wanted``."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        message = socket.recv(timeout=30)
        if isinstance(message, str):
            news = json.loads(message)
            if all(name in news and news[name] == value for name, value in wanted.items()):
                return news
    raise AssertionError(wanted)


def _error(socket: ClientConnection) -> str:
    """Return the first error message."""
    while True:
        news = _news(socket)
        if "error" in news:
            return news["error"]


@needs_page
def test_a_socket_gets_header_frames_and_news_and_its_commands_are_done(session: Session):
    with living(session) as server, _socket(server) as socket:
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
def test_a_lost_socket_continues_where_it_was(session: Session):
    with living(session) as server:
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
    with living(session) as server:
        with pytest.raises(InvalidStatus), _socket(server, "wrong-token"):
            pass
        with _socket(server) as socket:
            socket.recv(timeout=20)
            with _socket(server) as second, pytest.raises(ConnectionClosed, match="another page shows"):
                second.recv(timeout=20)
            with pytest.raises(ConnectionClosed):
                socket.send(b"x" * 100_000_000)
                while True:
                    socket.recv(timeout=20)
        assert MAX_MESSAGE_BYTES < 100_000_000
        for _ in range(50):
            with _socket(server) as again:
                try:
                    again.recv(timeout=20)
                except ConnectionClosed:
                    time.sleep(0.1)
                    continue
                again.send("[" * 30000)
                assert _error(again).startswith("invalid message: ")
                again.send(json.dumps({"type": "motion", "text": "jump 0 0.1"}))
                assert _news(again, type="state", doing="jump")
                break
        else:
            raise AssertionError("not taken up again")
    assert "Traceback" not in capfd.readouterr().err


def test_the_camera_shows_the_creature_with_a_margin():
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
        (["--friction", "-1"], "--friction -1: give a Coulomb coefficient"),
        (["--nodes", "3"], "--nodes 3: give a whole number from 50 to 20000"),
        (["--muscles", "missing.json"], "missing.json: no such file"),
        (["--front", "0,0,1"], "--front 0,0,1: points up or down"),
        (["--up", "w"], "--up w: give one of"),
        (["--background", "missing.ply"], "missing.ply"),
    ],
)
def test_bad_flags_are_one_line_errors(
    flags: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "pawn.ply", coarse_pawn().cloud)
    up = [] if "--up" in flags else ["--up", "z"]
    assert main(["live", "pawn.ply", "--nodes", "50", *up, "--no-browser", *flags]) == 2
    (line,) = [one for one in capsys.readouterr().err.splitlines() if one.startswith("egs-warp: ")]
    assert said in line


@needs_page
def test_a_port_in_use_is_reported_before_any_work(
    session: Session, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "empty.ply").touch()
    with living(session) as server:
        assert main(["live", str(tmp_path / "empty.ply"), "--port", str(server.port)]) == 2
        assert capsys.readouterr().err.startswith(f"egs-warp: --port {server.port}: cannot be used")


@needs_page
def test_the_command_leaves_a_core_to_the_page_while_it_serves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    used = []
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(3)), raising=False)
    monkeypatch.delenv(THREADS, raising=False)
    monkeypatch.setattr("egs_warp.commands.live._session", lambda *_, **__: session_of(coarse_pawn(), tmp_path))
    monkeypatch.setattr(
        "egs_warp.commands.live.wait_for_end", lambda thread: used.append((thread.is_alive(), available_threads()))
    )
    write_ply(tmp_path / "pawn.ply", pawn(gaussian_count=2000).cloud)
    assert main(["live", str(tmp_path / "pawn.ply"), "--up", "z", "--no-browser"]) == 0
    assert used == [(True, 2)] and available_threads() == 3
    assert "open http://127.0.0.1:" in capsys.readouterr().out
