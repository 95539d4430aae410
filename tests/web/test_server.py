"""Server of the page, which only programs on this machine and its own page can access."""

from __future__ import annotations

import http.client
import json
import shutil
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from egs_warp.errors import UserError
from egs_warp.web.page import PAGE
from egs_warp.web.recording import Recording
from egs_warp.web.server import IN_USE, MAX_MESSAGE_BYTES, PageServer
from tests.support.pages import RecordedFeed, served

pytestmark = pytest.mark.skipif(not PAGE.is_file(), reason="the page is not built; make web builds it")


@pytest.fixture(scope="module")
def server(recording: Recording) -> Iterator[PageServer]:
    with served(recording, feed=RecordedFeed(recording)) as running:
        yield running


def _get(server: PageServer, path: str, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    connection.request("GET", path, headers={name.title(): value for name, value in headers.items()})
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_page_and_run_are_served_under_the_token(server: PageServer, recording: Recording):
    assert _get(server, f"/{server.token}/") == (200, PAGE.read_bytes())
    assert _get(server, f"/{server.token}/run/0") == (200, recording.bytes())


@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/wrong-token/",
        "/{token}/run/1",
        "/{token}/run/-1",
        "/{token}/report.json",
        "/{token}/run/0/../../../../etc/passwd",
        "/{token}/..%2f..%2f..%2fetc%2fpasswd",
        "/{token}/run/%2e%2e/%2e%2e/trajectory.npz",
        "/{token}//etc/passwd",
        "/{token}/run/0/%2e%2e/%2e%2e/report.json",
        "/{token}/%2fetc%2fpasswd",
        "/{token}/run/%2fetc%2fpasswd",
        "//etc/passwd",
        "/{token}x/run/0",
        "/run/0",
    ],
)
def test_nothing_else_is_served(server: PageServer, path: str):
    status, body = _get(server, path.format(token=server.token))
    assert status == 404 and len(body) < 200


def test_files_of_the_run_folder_are_not_served(run_folder: Path, tmp_path: Path):
    """Neither files in the folder nor targets of links in it are served: the page receives data computed from the run,
    and no path of the server names a file."""
    folder, secret = tmp_path / "run", tmp_path / "secret.txt"
    shutil.copytree(run_folder, folder)
    secret.write_text("nobody's business")
    (folder / "link.txt").symlink_to(secret)
    (folder / "0").symlink_to(tmp_path)
    with served(Recording.read(folder)) as server:
        assert _get(server, f"/{server.token}/run/0")[0] == 200
        for name in ("link.txt", "0/secret.txt", "report.json", "run/link.txt", "run/0/secret.txt", "run/0/link.txt"):
            status, body = _get(server, f"/{server.token}/{name}")
            assert status == 404 and b"business" not in body, name


def test_other_hosts_and_origins_are_refused(server: PageServer):
    path = f"/{server.token}/run/0"
    assert _get(server, path, host="evil.example")[0] == 403
    assert _get(server, path, host=f"evil.example:{server.port}")[0] == 403
    assert _get(server, path, origin="http://evil.example")[0] == 403
    assert _get(server, path, origin="null")[0] == 403
    assert _get(server, path, origin=f"http://127.0.0.1:{server.port}")[0] == 200
    assert _get(server, path, host=f"localhost:{server.port}")[0] == 200


def _socket(server: PageServer, origin: str | None = "own", *, query: str = ""):
    own = f"http://127.0.0.1:{server.port}"
    address = f"ws://127.0.0.1:{server.port}/{server.token}/live{query}"
    sender: Any = own if origin == "own" else origin
    return connect(address, origin=sender, max_size=None, compression=None)


def _taken_up_again(server: PageServer) -> bool:
    """Return True if a page that reconnects receives the header again."""
    for _ in range(50):
        with _socket(server) as page:
            try:
                return bool(page.recv(timeout=20))
            except ConnectionClosed:
                time.sleep(0.1)
    return False


def _next_text(page: ClientConnection) -> dict:
    while True:
        message = page.recv(timeout=20)
        if isinstance(message, str):
            return json.loads(message)


def test_a_socket_gets_the_header_and_then_frames(server: PageServer, recording: Recording):
    with _socket(server) as page:
        assert page.recv(timeout=20) == recording.header()
        first = next(iter(recording.frames()))
        assert page.recv(timeout=20) == first.packet()


@pytest.mark.parametrize("origin", [None, "http://evil.example", "null"])
def test_a_socket_of_another_site_is_refused(server: PageServer, origin: str | None):
    with pytest.raises(InvalidStatus), _socket(server, origin):
        pass


def test_a_socket_under_another_name_is_refused(server: PageServer):
    """A foreign host name is refused, because it may resolve to this machine."""
    own: Any = f"http://127.0.0.1:{server.port}"
    with socket.create_connection(("127.0.0.1", server.port)) as line, pytest.raises(InvalidStatus):
        connect(f"ws://evil.example:{server.port}/{server.token}/live", sock=line, origin=own)


def test_a_second_page_gets_a_message_and_the_first_continues(server: PageServer):
    with _socket(server) as first:
        first.recv(timeout=20)
        with _socket(server) as second, pytest.raises(ConnectionClosed) as closed:
            second.recv(timeout=20)
        assert closed.value.rcvd is not None
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1013, IN_USE)
        assert first.recv(timeout=20)


def test_pages_that_take_over_close_the_others(server: PageServer, recording: Recording):
    with _socket(server) as first:
        first.recv(timeout=20)
        with _socket(server, query="?take") as second, _socket(server, query="?take") as third:
            assert third.recv(timeout=20) == recording.header()
            for page in (first, second):
                with pytest.raises(ConnectionClosed) as closed:
                    while True:
                        page.recv(timeout=20)
                assert closed.value.rcvd is not None
                assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1013, IN_USE)
            assert isinstance(third.recv(timeout=20), bytes)
    assert _taken_up_again(server)


@pytest.mark.parametrize("message", ["{", "[1]", '"x"', '{"type": "fly"}', "[" * 30000, b"\xff\xfe\x00"])
def test_invalid_messages_get_one_line_and_the_run_continues(server: PageServer, message: str | bytes):
    with _socket(server) as page:
        page.recv(timeout=20)
        page.send(message)
        answer = _next_text(page)
        assert answer["error"].startswith("invalid message: ") and "\n" not in answer["error"]
        page.send('{"type": "pause"}')
        assert isinstance(page.recv(timeout=20), bytes)


@pytest.mark.parametrize("size", [MAX_MESSAGE_BYTES + 1, 100_000_000])
def test_a_message_that_is_too_large_closes_only_its_socket(
    server: PageServer, size: int, capfd: pytest.CaptureFixture[str]
):
    with _socket(server) as page:
        with pytest.raises(ConnectionClosed) as closed:
            page.send(b"x" * size)
            while True:
                page.recv(timeout=20)
        assert closed.value.rcvd is None or closed.value.rcvd.code == 1009
    assert _get(server, f"/{server.token}/")[0] == 200
    assert _taken_up_again(server)
    assert "Traceback" not in capfd.readouterr().err


def test_a_port_in_use_is_a_one_line_error(server: PageServer, recording: Recording):
    with pytest.raises(
        UserError, match=rf"^port {server.port}: cannot be used \(.*\); give another port, or 0 for any free one$"
    ):
        PageServer([recording.bytes], port=server.port)
    with pytest.raises(UserError, match=r"^port 70000: cannot be used"):
        PageServer([recording.bytes], port=70000)


def test_every_server_has_a_token_of_its_own(recording: Recording):
    with served(recording) as one, served(recording) as other:
        assert one.token != other.token and len(one.token) >= 32
        assert _get(one, f"/{one.token}/live")[0] == 404
