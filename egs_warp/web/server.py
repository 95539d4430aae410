"""Local server of the page and its runs, with a socket that sends the frames of a live session.

Only programs on this machine can connect, and only pages from this server may use the socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import secrets
import socket
import threading
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator, Sequence
from typing import Any, Protocol, runtime_checkable
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from egs_warp.errors import ArgumentError
from egs_warp.io.text import load_json
from egs_warp.web.page import page_text

HOST = "127.0.0.1"
"""Address that the server binds."""
IN_USE = "another page shows this session"
"""Reason with which the socket of a page is closed while another page has the only feed."""
_TRY_AGAIN_LATER = 1013
"""Code with which such a socket is closed (RFC 6455)."""
_ENDED = 1012
"""Code with which the sockets are closed when the server ends (RFC 6455)."""
_CLOSING_TIME = 2.0
"""Time within which pages must answer that their sockets are closed, s; the server then ends without their answers."""
_ALIVE_INTERVAL = 2.0
"""Time between two messages from which a page knows that the server is there, s."""
MAX_MESSAGE_BYTES = 65_536
"""Maximum size of a message, bytes; a larger one closes the socket."""
_HOST_NAMES = frozenset({"127.0.0.1", "localhost"})
"""Host names that the server accepts in requests."""
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    # Spark is a WebAssembly module that runs in a worker; both are embedded in the page.
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob: data:;"
    " worker-src blob: data:; style-src 'unsafe-inline'; img-src data: blob:; media-src blob:; connect-src 'self' data:"
    " blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
}


class FrameFeed(Protocol):
    """Source of the frames of a socket: a recording or a running solver."""

    def header(self) -> bytes:
        """Return the header (``packets.header``)."""
        ...

    def packets(self) -> AsyncGenerator[bytes | str]:
        """Yield frames (``Frame.packet``) and events (JSON texts) as they become available."""
        ...

    def receive(self, message: dict[str, object]) -> None:
        """Handle a message from the page. Raises ``ValueError`` for an invalid message."""
        ...


class PageFeed(FrameFeed, Protocol):
    """Feed of one of several pages of a session."""

    def close(self) -> None:
        """Remove the page from the session."""
        ...


@runtime_checkable
class PreparedFeed(FrameFeed, Protocol):
    """Feed whose header is not available at once."""

    def events_before_header(self) -> AsyncGenerator[str]:
        """Yield events (JSON texts) until the header is available."""
        ...


@runtime_checkable
class SharedFeed(Protocol):
    """Feed source of a live session that several pages show at once."""

    def connect(self) -> PageFeed:
        """Return the feed for a page that connects."""
        ...


class PageServer:
    """Server that provides the page at a secret local address."""

    def __init__(
        self,
        runs: Sequence[Callable[[], bytes]],
        *,
        port: int = 0,
        feed: FrameFeed | SharedFeed | None = None,
        token: str | None = None,
    ) -> None:
        """Bind the port.

        Args:
            runs: one function for each run, which returns the bytes of the run and is called once.
            port: port to bind; 0 selects a free one.
            feed: source of a live session: a ``FrameFeed``, which is sent to one client at a time, until another one
                takes it over, or a ``SharedFeed``; None for no live session.
            token: secret part of the address; None for a random one.

        Raises:
            UserError: the port cannot be used.
        """
        self.token = token or secrets.token_urlsafe(24)
        self._page = page_text()
        self._runs = list(runs)
        self._run_bytes: dict[int, bytes] = {}
        self._feed = feed
        self._client: asyncio.Task[None] | None = None
        self._socket = _bind(port)
        self.port: int = self._socket.getsockname()[1]
        secret = f"/{self.token}"
        routes: list[BaseRoute] = [
            Route(f"{secret}/", self._send_page),
            Route(f"{secret}/run/{{number:int}}", self._send_run),
        ]
        if feed is not None:
            routes.append(WebSocketRoute(f"{secret}/live", self._send_frames))
        app = _SameOriginOnly(Starlette(routes=routes), self.port)
        settings = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            ws_max_size=MAX_MESSAGE_BYTES,
            server_header=False,
            lifespan="off",
        )
        self._stopping = asyncio.Event()
        self._sockets: set[asyncio.Task[Any]] = set()
        self._server = _ClosingServer(settings, self._close_sockets)

    @property
    def address(self) -> str:
        """Address of the page. It contains a secret, so only users who know the address can open the page."""
        query = "?live" if self._feed is not None else f"?runs={len(self._runs)}" if len(self._runs) > 1 else ""
        return f"http://{HOST}:{self.port}/{self.token}/{query}"

    def serve(self) -> None:
        """Serve until ``stop`` or Ctrl-C."""
        with contextlib.suppress(KeyboardInterrupt):
            self._server.run(sockets=[self._socket])

    @contextlib.contextmanager
    def serve_in_background(self) -> Iterator[threading.Thread]:
        """Serve in a thread within the context."""
        thread = threading.Thread(target=self.serve, name="page server", daemon=True)
        thread.start()
        try:
            yield thread
        finally:
            self.stop()
            thread.join()

    def stop(self) -> None:
        """End ``serve``; can be called from any thread."""
        self._server.should_exit = True

    async def _close_sockets(self) -> None:
        """Close the sockets of all pages, and wait for the answers of the pages."""
        self._stopping.set()
        if not self._sockets:
            return
        connections = self._server.server_state.connections
        others = len(connections) - len(self._sockets)
        await asyncio.wait(self._sockets, timeout=_CLOSING_TIME)
        with contextlib.suppress(asyncio.TimeoutError):
            async with asyncio.timeout(_CLOSING_TIME):
                # A connection ends when its page has answered.
                while len(connections) > others:
                    await asyncio.sleep(0.02)

    async def _send_page(self, request: Request) -> Response:
        return HTMLResponse(self._page, headers=_HEADERS)

    async def _send_run(self, request: Request) -> Response:
        number = int(request.path_params["number"])
        if number >= len(self._runs):
            return PlainTextResponse("there is no such run", 404, headers=_HEADERS)
        if number not in self._run_bytes:
            self._run_bytes[number] = await asyncio.to_thread(self._runs[number])
        return Response(self._run_bytes[number], media_type="application/octet-stream", headers=_HEADERS)

    async def _send_frames(self, page: WebSocket) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._sockets.add(task)
        try:
            await self._serve_page(page)
        finally:
            self._sockets.discard(task)

    async def _serve_page(self, page: WebSocket) -> None:
        feed = self._feed
        assert feed is not None
        await page.accept()
        if isinstance(feed, SharedFeed):
            own = feed.connect()
            try:
                await _exchange(page, own, self._stopping)
            finally:
                own.close()
            return
        while self._client is not None:
            # A page that takes over waits until the other one is unsubscribed.
            if "take" not in page.query_params:
                await page.close(_TRY_AGAIN_LATER, IN_USE)
                return
            self._client.cancel()
            await asyncio.wait({self._client})
            await asyncio.sleep(0)
        client = self._client = asyncio.create_task(_exchange(page, feed, self._stopping))
        try:
            await asyncio.wait({client})
        finally:
            client.cancel()
            self._client = None
        if client.cancelled():
            with contextlib.suppress(WebSocketDisconnect):
                await page.close(_TRY_AGAIN_LATER, IN_USE)
        else:
            client.result()


async def _exchange(page: WebSocket, feed: FrameFeed, stopping: asyncio.Event) -> None:
    """Send the header and the packets of ``feed``, and receive messages, until the page or the feed ends, or until
    ``stopping`` is set."""
    with contextlib.suppress(WebSocketDisconnect):
        await _first_to_end(_receive_messages(page, feed), _send_packets(page, feed), _wait_for(stopping))
        if stopping.is_set() and page.application_state is WebSocketState.CONNECTED:
            await page.close(_ENDED, "the program has ended")


async def _wait_for(event: asyncio.Event) -> None:
    await event.wait()


async def _send_alive(page: WebSocket) -> None:
    """Send an event at regular intervals, because no frames are sent while a body is at rest."""
    while True:
        await asyncio.sleep(_ALIVE_INTERVAL)
        await page.send_text('{"type": "alive"}')


async def _first_to_end(*coroutines: Coroutine[None, None, None]) -> None:
    """Run the coroutines until one of them ends, then cancel the others. If the one that ended has raised an error, the
    error is raised again."""
    tasks = [asyncio.create_task(coroutine) for coroutine in coroutines]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _send_packets(page: WebSocket, feed: FrameFeed) -> None:
    """Send the header and the packets of ``feed``, then close the socket."""
    if isinstance(feed, PreparedFeed):
        async with contextlib.aclosing(feed.events_before_header()) as events:
            async for event in events:
                await page.send_text(event)
    await page.send_bytes(await asyncio.to_thread(feed.header))
    await _first_to_end(_send_frames(page, feed), _send_alive(page))
    await page.close(1000, "the session has ended")


async def _send_frames(page: WebSocket, feed: FrameFeed) -> None:
    async with contextlib.aclosing(feed.packets()) as packets:
        async for packet in packets:
            await (page.send_text(packet) if isinstance(packet, str) else page.send_bytes(packet))


async def _receive_messages(page: WebSocket, feed: FrameFeed) -> None:
    """Pass messages from the page to ``feed``; the answer to an invalid message is an error."""
    while True:
        try:
            message = load_json(await page.receive_text())
            if not isinstance(message, dict):
                raise ValueError("not an object")
            feed.receive(message)
        except (ValueError, KeyError, TypeError) as error:
            # Report the error in one line, and continue.
            await page.send_text(json.dumps({"error": f"invalid message: {str(error)[:200]}"}))


class _ClosingServer(uvicorn.Server):
    """Server that closes its sockets before it drops its connections.

    On its own, uvicorn closes a connection without waiting for the answer. If a message of the page arrives at that
    time, the page loses the code with which its socket was closed.
    """

    def __init__(self, settings: uvicorn.Config, close_sockets: Callable[[], Coroutine[None, None, None]]) -> None:
        super().__init__(settings)
        self._close_sockets = close_sockets

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close all sockets, then end."""
        await self._close_sockets()
        await super().shutdown(sockets)


class _SameOriginOnly:
    """Middleware that rejects requests that other websites send through the user's browser.

    It compares the host and the origin of each request with the address of this server.
    """

    def __init__(self, app: ASGIApp, port: int) -> None:
        self._app = app
        self._hosts = {f"{name}:{port}" for name in _HOST_NAMES}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        origin = connection.headers.get("origin")
        # Browsers always send an origin when they open a socket.
        is_foreign = urlsplit(origin).netloc not in self._hosts if origin is not None else scope["type"] == "websocket"
        if connection.headers.get("host") not in self._hosts or is_foreign:
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008})
            else:
                await PlainTextResponse("request from another site", 403, headers=_HEADERS)(scope, receive, send)
            return
        await self._app(scope, receive, send)


def check_port(port: int) -> None:
    """Raise ``UserError`` if the port cannot be used; call this before any long computation."""
    _bind(port).close()


def _bind(port: int) -> socket.socket:
    """Return a listening socket at ``port``."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if os.name == "posix":
            # On Windows, this option would share the port with another process.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port))
        listener.listen(16)
    except (OSError, OverflowError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise ArgumentError(
            "port", f"cannot be used ({reason}); give another port, or 0 for any free one", value=port
        ) from error
    return listener
