"""The chunks of logs for a page in a browser, and for Foxglove and Lichtblick over the Foxglove WebSocket protocol.

Source: https://github.com/foxglove/ws-protocol, ``docs/spec.md``; only what a server needs that sends and obeys nobody.

A page of any website may open a connection to this computer. Its browser says where the page is from (``Origin``) and
which name it looked up (``Host``): a page from elsewhere is refused, and a name that is not this computer's, which
another's name server may have given our address (DNS rebinding).
"""

from __future__ import annotations

import base64
import ipaddress
import json
import logging
import re
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final

from mcap import records as mcap

from emb_bench.live.page import SUBPROTOCOL, Page, html
from emb_bench.logs.mcap_file import Chunk
from emb_runtime.errors import UsageError, needs

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.sync.server import ServerConnection

HOST = "127.0.0.1"
PORT = 8765  # Port that viewers propose
SUBSCRIBING = 0.1  # Time for viewers to subscribe to new topics before their first message [s]
LINGER = 0.2  # Time for viewers to get the last messages [s]
BACKLOG = 1 << 14  # Messages that wait for a slow viewer; a chunk has about a thousand. Then the oldest are dropped.
MOST_WAITING = 32 << 20  # Size of them [bytes]
MOST_TEXTS = 1000  # Texts that wait for a slow viewer, a late page's ``KEPT`` among them; with more it is closed
MOST_VIEWERS = 16
LARGEST_REQUEST = 64 << 10  # [bytes]
OPENING, CLOSING = 2.0, 0.5  # Longest handshakes [s]

ORIGINS: Final = (
    None,  # No page of a browser: the viewer as a program
    "file://",  # The viewer as a program that is made as a page
    "https://app.foxglove.dev",
    re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d{1,5})?"),
)
"""Origins of the pages that may connect."""
PAGE_HEADERS: Final = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self' ws:; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
MESSAGE: Final = struct.Struct("<BIQ")  # Opcode 1, number of the subscription, time [ns]; the payload follows


class Viewer:
    """One connection: its subscriptions, and a thread that sends what waits."""

    def __init__(self, connection: ServerConnection, server: Server) -> None:
        self._connection = connection
        self._server = server
        self._subscriptions: dict[int, int] = {}
        self._texts: deque[str] = deque()
        self._messages: deque[bytes] = deque()
        self._waiting = 0  # Size of the messages [bytes]
        self._news = threading.Condition()
        self._open = True

    def say(self, **document: Any) -> None:
        """Send a document, before the messages that wait."""
        self.send(json.dumps(document))

    def send(self, *texts: str) -> None:
        """Send texts, before the messages that wait."""
        with self._news:
            if self._open:
                self._texts.extend(texts)
                self._open = len(self._texts) <= MOST_TEXTS
            self._news.notify()

    def log(self, channel: int, time_ns: int, data: bytes) -> None:
        """Send a message of a channel, if the viewer has subscribed to it."""
        if (subscription := self._subscriptions.get(channel)) is not None:
            with self._news:
                self._messages.append(MESSAGE.pack(1, subscription, time_ns) + data)
                self._waiting += len(data)
                while len(self._messages) > BACKLOG or self._waiting > MOST_WAITING:
                    self._waiting -= len(self._messages.popleft()) - MESSAGE.size
                self._news.notify()

    def listen(self) -> None:
        """Process the requests of the viewer, until it leaves."""
        sender = threading.Thread(target=self._send)
        sender.start()
        try:
            for text in self._connection:
                self._take(text)
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError):
            pass  # it does not speak the protocol
        finally:
            with self._news:
                self._open = False
                self._news.notify()
            self._connection.close()
            sender.join()

    def _take(self, text: str | bytes) -> None:
        document = json.loads(text) if isinstance(text, str) else {}
        if document.get("op") == "subscribe":
            new = {int(each["channelId"]): int(each["id"]) & 0xFFFFFFFF for each in document["subscriptions"]}
            advertised = self._server.advertised
            self._subscriptions = {
                key: value for key, value in (self._subscriptions | new).items() if key in advertised
            }
            if unknown := new.keys() - advertised:
                self.say(op="status", level=2, message=f"no channel is numbered {min(unknown)}")
        elif document.get("op") == "unsubscribe":
            ended = document["subscriptionIds"]
            self._subscriptions = {key: value for key, value in self._subscriptions.items() if value not in ended}
        elif document.get("op") == "show":
            self._server.choose(str(document["log"]))

    def _send(self) -> None:
        from websockets.exceptions import ConnectionClosed
        from websockets.frames import CloseCode

        try:
            while True:
                with self._news:
                    self._news.wait_for(lambda: self._texts or self._messages or not self._open)
                    if not self._open:
                        break
                    waiting: list[str | bytes] = [*self._texts, *self._messages]
                    self._texts.clear()
                    self._messages.clear()
                    self._waiting = 0
                for each in waiting:
                    self._connection.send(each)
            if len(self._texts) > MOST_TEXTS:
                self._connection.close(CloseCode.TRY_AGAIN_LATER, "too slow: load the page again")
        except ConnectionClosed:
            pass  # listen() ends as well


class Server:
    """A server of one log after the other; a topic keeps its channel where its schema stays the same.

    Port 0 is any free one.

    Raises:
        UsageError: websockets is not installed, or the port cannot be had.
    """

    def __init__(self, host: str = HOST, port: int = PORT, empty: str = "") -> None:
        with needs("a viewer's server", "live"):
            from websockets.sync.server import serve
        self._host = host
        self._lock = threading.Lock()
        self._viewers: set[Viewer] = set()
        self._pages: set[Viewer] = set()
        self._page = Page(empty)
        self.choose: Callable[[str], object] = str
        """Called with the name of the log that a page asks for."""
        self._channels: dict[tuple[str, bytes], dict[str, Any]] = {}
        self._made = 0
        self._schemas: dict[int, mcap.Schema] = {}
        self._of_log: dict[int, int] = {}
        silent = logging.Logger("emb-live", logging.CRITICAL + 1)
        try:
            self._server = serve(
                self._view,
                host,
                port,
                origins=ORIGINS,  # type: ignore[arg-type]
                process_request=self._page_or_refusal,
                subprotocols=(*SUBPROTOCOLS, SUBPROTOCOL),  # type: ignore[arg-type]
                compression=None,
                open_timeout=OPENING,
                close_timeout=CLOSING,
                max_size=LARGEST_REQUEST,
                logger=silent,
            )
        except (OSError, OverflowError) as err:
            raise UsageError(
                f"the server cannot listen at {host}:{port}: {err}; choose another port, or 0 for a free one"
            ) from err
        place = f"{host}:{self._server.socket.getsockname()[1]}"
        self.address = f"ws://{place}"  # For a viewer
        self.page = f"http://{place}"  # For a browser
        self.addresses = f"{self.page} in a browser, {self.address} in Foxglove"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def begin(self, name: str = "", logs: Sequence[str] = ()) -> None:
        """Another log begins, one of those that a page may choose. It numbers channels and schemas anew."""
        self._schemas.clear()
        self._of_log.clear()
        self._to_pages(lambda: self._page.begin(name, logs))

    def know(self, bench: bytes) -> None:
        """Show the limits by the log's bench file, and totals with its systematic errors."""
        self._to_pages(lambda: self._page.know(bench))

    @property
    def advertised(self) -> set[int]:
        """Numbers of the channels that a viewer may subscribe to."""
        with self._lock:
            return {channel["id"] for channel in self._channels.values()}

    def end(self, reason: str) -> None:
        """The log has ended: the run's exit reason."""
        self._to_pages(lambda: self._page.end(reason))

    def _to_pages(self, made: Callable[[], str]) -> None:
        with self._lock:  # a page that comes meanwhile gets it once
            text = made()
            for page in self._pages:
                page.send(text)

    def add(self, chunk: Chunk) -> None:
        """Serve the messages of a chunk. Their time is the one at which they happened, not that of their writing."""
        made = self._made
        for record in chunk.described:
            if isinstance(record, mcap.Schema):
                self._schemas[record.id] = record
            elif record.id not in self._of_log and record.schema_id in self._schemas:
                self._of_log[record.id] = self._channel(record, self._schemas[record.schema_id])
        if self._made != made:
            time.sleep(SUBSCRIBING)
        with self._lock:
            viewers = tuple(self._viewers)
        self._to_pages(lambda: self._page.add(chunk))
        for message in chunk.messages() if viewers else ():
            if (channel := self._of_log.get(message.channel_id)) is not None:
                for viewer in viewers:
                    viewer.log(channel, message.publish_time, message.data)

    def close(self) -> None:
        """End the server, once viewers had time for the last messages."""
        time.sleep(LINGER)
        self._server.shutdown()
        self._thread.join()

    def _channel(self, channel: mcap.Channel, schema: mcap.Schema) -> int:
        """Number of the channel of a topic; one of another schema ends."""
        key = (channel.topic, schema.data)
        with self._lock:
            if key not in self._channels:
                ended = [self._channels.pop(old)["id"] for old in [*self._channels] if old[0] == channel.topic]
                self._made += 1
                self._channels[key] = {
                    "id": self._made,
                    "topic": channel.topic,
                    "encoding": channel.message_encoding,
                    "schemaName": schema.name,
                    "schemaEncoding": schema.encoding,
                    "schema": base64.b64encode(schema.data).decode(),
                }
                for viewer in self._viewers:
                    if ended:
                        viewer.say(op="unadvertise", channelIds=ended)
                    viewer.say(op="advertise", channels=[self._channels[key]])
            return int(self._channels[key]["id"])

    def _view(self, connection: ServerConnection) -> None:
        from websockets.frames import CloseCode

        viewer = Viewer(connection, self)
        of_its_kind = self._pages if connection.subprotocol == SUBPROTOCOL else self._viewers
        with self._lock:
            if len(self._viewers) + len(self._pages) >= MOST_VIEWERS:
                return connection.close(CloseCode.TRY_AGAIN_LATER, f"there are {MOST_VIEWERS} viewers: close one")
            if of_its_kind is self._pages:
                viewer.send(*self._page.so_far)
            else:
                viewer.say(op="serverInfo", name="emb-excite", capabilities=[], supportedEncodings=[], metadata={})
                if self._channels:
                    viewer.say(op="advertise", channels=[*self._channels.values()])
            of_its_kind.add(viewer)
        try:
            viewer.listen()
        finally:
            with self._lock:
                of_its_kind.discard(viewer)

    def _page_or_refusal(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page for a browser; a refusal of a name that is not this computer's. An address is nobody else's name."""
        named = request.headers.get_all("Host")
        if len(named) != 1 or not _is_ours(named[0], self._host):
            return connection.respond(HTTPStatus.FORBIDDEN, "connect to this computer by its address or as localhost\n")
        if "Upgrade" in request.headers:
            return None
        if request.path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "the page is at /\n")
        response = connection.respond(HTTPStatus.OK, html())
        response.headers.pop("Content-Type")  # a second value would be added to it
        response.headers.update(PAGE_HEADERS)
        return response


def _is_ours(named: str, host: str) -> bool:
    """Returns True if a ``Host`` header has an address, or the name of this computer or of the address listened at."""
    name = re.sub(r":\d{1,5}$", "", named).lower()
    try:
        ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return name in ("localhost", host.lower())
    return True
