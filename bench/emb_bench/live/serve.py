"""A page for a browser, and the chunks of logs for it as server-sent events (WHATWG HTML, section 9.2).

A page of any website may ask this computer. A browser gives it no answer of another origin; a name that is not this
computer's, which another's name server may have given our address (DNS rebinding), is refused.
"""

from __future__ import annotations

import ipaddress
import queue
import re
import socketserver
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any, Final

from emb_bench.live.page import Page, html
from emb_bench.logs.mcap_file import Chunk
from emb_runtime.errors import UsageError

HOST = "127.0.0.1"
PORT = 8765
STALLED = 2.0  # Time after which a browser that takes nothing is left [s]; it connects again by itself

PAGE_HEADERS: Final = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
EVENT_HEADERS: Final = {"Content-Type": "text/event-stream", "Cache-Control": "no-store"}

Waiting = queue.SimpleQueue[str | None]
"""Messages that wait for one browser; None ends its connection."""


class _TcpServer(socketserver.ThreadingTCPServer):
    """A thread a connection; closing waits for them. The server of ``http.server`` looks up its own name first."""

    allow_reuse_address = True


class Server:
    """A server of one log after the other.

    Port 0 is any free one.

    Raises:
        UsageError: the port cannot be had.
    """

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        self._page = Page()
        self._lock = threading.Lock()
        self._browsers: list[Waiting] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            timeout = STALLED

            def do_GET(self) -> None:
                server.answer(self, host)

            def log_message(self, *_: Any) -> None:
                pass

        try:
            self._server = _TcpServer((host, port), Handler)
        except (OSError, OverflowError) as err:
            raise UsageError(f"the server cannot listen at {host}:{port}: {err}") from err
        self.address = f"http://{host}:{self._server.server_address[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def begin(self) -> None:
        """Begin another log."""
        with self._lock:
            self._send(self._page.begin())

    def add(self, chunk: Chunk) -> None:
        """Send the messages of a chunk."""
        with self._lock:  # a browser that comes meanwhile gets them once
            self._send(self._page.add(chunk))

    def end(self, reason: str) -> None:
        """The log is whole: send the run's exit reason."""
        with self._lock:
            self._send(self._page.end(reason))

    def close(self) -> None:
        """End the server, once the browsers have the last messages, or take none."""
        with self._lock:
            self._send(None)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _send(self, text: str | None) -> None:
        for waiting in self._browsers:
            waiting.put(text)

    def answer(self, request: BaseHTTPRequestHandler, host: str) -> None:
        """Answer a browser: the page, its events, or a refusal."""
        named = request.headers.get_all("Host", [])
        if len(named) != 1 or not _is_ours(named[0], host):
            request.send_error(HTTPStatus.FORBIDDEN, "connect to this computer by its address or as localhost")
        elif request.path == "/":
            _begin(request, PAGE_HEADERS)
            request.wfile.write(html().encode())
        elif request.path == "/events":
            self._send_events(request)
        else:
            request.send_error(HTTPStatus.NOT_FOUND, "the page is at /")

    def _send_events(self, request: BaseHTTPRequestHandler) -> None:
        waiting: Waiting = queue.SimpleQueue()
        with self._lock:
            for before in self._page.so_far:
                waiting.put(before)
            self._browsers.append(waiting)
        try:
            _begin(request, EVENT_HEADERS)
            while (text := waiting.get()) is not None:
                request.wfile.write(f"data: {text}\n\n".encode())
        except OSError:
            pass  # the browser has gone, or takes nothing
        finally:
            with self._lock:
                self._browsers.remove(waiting)


def _begin(request: BaseHTTPRequestHandler, headers: dict[str, str]) -> None:
    request.send_response(HTTPStatus.OK)
    for name, value in headers.items():
        request.send_header(name, value)
    request.end_headers()


def _is_ours(named: str, host: str) -> bool:
    """Returns True if a ``Host`` header has an address, or the name of this computer or of the address listened at."""
    name = re.sub(r":\d{1,5}$", "", named).lower()
    try:
        ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return name in ("localhost", host.lower())
    return True
