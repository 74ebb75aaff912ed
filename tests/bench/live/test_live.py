from __future__ import annotations

import http.client
import json
import os
import pty
import random
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap import records as mcap
from mcap.reader import make_reader
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from emb_bench.live.follow import NewLogs, chunks, follow
from emb_bench.live.page import SUBPROTOCOL
from emb_bench.live.serve import (
    BACKLOG,
    LARGEST_REQUEST,
    MESSAGE,
    MOST_TEXTS,
    MOST_VIEWERS,
    MOST_WAITING,
    Server,
    Viewer,
)
from emb_bench.logs.log import read_log
from emb_bench.logs.mcap_file import HEADER, Chunk
from emb_runtime.cli import main as emb_run
from emb_runtime.errors import EXIT_DONE, EXIT_SAFETY_STOP, EXIT_USAGE, LogError, UsageError
from emb_runtime.estimator.estimate import LOST, UNITS
from emb_runtime.numbers import around, in_percent
from tests.corrupt import rewritten, without

SECONDS = 20.0


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of the shipped actor on the simulated brake."""
    path = tmp_path_factory.mktemp("live") / "run.mcap"
    assert emb_run.main(["--iface", "sim", "--log", str(path), "--no-rt", "--json"]) == EXIT_DONE
    return path


def messages_of(path: Path) -> Counter[tuple[str, int, bytes]]:
    """Topic, publish time and payload of every message, by the plain reader."""
    with path.open("rb") as file:
        return Counter((c.topic, m.publish_time, m.data) for _, c, m in make_reader(file).iter_messages())


def topics_of(path: Path) -> set[str]:
    """Every topic that the log describes, whether it has messages or none."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {channel.topic for channel in summary.channels.values()}


def in_last_chunk(path: Path) -> int:
    """Offset of a byte in the middle of the last chunk."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = max(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
    return chunk.chunk_start_offset + chunk.chunk_length // 2


def never() -> bool:
    return False


class Growth:
    """A copy of a log that grows by the next piece whenever its reader waits."""

    def __init__(self, log: Path, copy: Path, sizes: Iterator[int]) -> None:
        self._rest, self.path, self._sizes = log.read_bytes(), copy, sizes
        copy.write_bytes(b"")

    def __call__(self) -> bool:
        size = next(self._sizes)
        with self.path.open("ab") as file:
            file.write(self._rest[:size])
        self._rest = self._rest[size:]
        return bool(self._rest)


@given(seed=st.integers(0, 2**32))
@settings(max_examples=5, deadline=None)
def test_a_growing_log_gives_every_message_once_wherever_it_pauses(
    shipped: Path, tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    dice = random.Random(seed)
    sizes = iter(lambda: dice.choice([1, 9, 1000, 30_000]), None)
    growth = Growth(shipped, tmp_path_factory.mktemp("growing") / "run.mcap", sizes)
    channels: dict[int, str] = {}
    found: Counter[tuple[str, int, bytes]] = Counter()
    for chunk in chunks(growth.path, growth):
        channels |= {record.id: record.topic for record in chunk.described if hasattr(record, "topic")}
        found.update((channels[m.channel_id], m.publish_time, m.data) for m in chunk.messages())
    assert found == messages_of(shipped)


def test_what_is_no_log_is_refused(shipped: Path, tmp_path: Path) -> None:
    pipe, text, damaged, huge = (tmp_path / f"{name}.mcap" for name in ("pipe", "text", "damaged", "huge"))
    os.mkfifo(pipe)
    text.write_text("angle, velocity\n" * 10)
    whole = bytearray(shipped.read_bytes())
    whole[in_last_chunk(shipped)] ^= 0xFF
    damaged.write_bytes(whole)
    huge.write_bytes(shipped.read_bytes()[:8] + struct.pack("<BQ", 6, 1 << 60))
    for path, said in ((pipe, "a pipe"), (text, "not an MCAP"), (damaged, "damaged"), (huge, "none of ours")):
        with pytest.raises(LogError, match=said):
            list(chunks(path, never))


def test_the_new_logs_of_a_folder_come_in_their_order(tmp_path: Path) -> None:
    (tmp_path / "before.mcap").touch()
    logs = NewLogs(tmp_path)
    assert not logs.waiting
    for order, name in enumerate(("b", "a")):
        (tmp_path / f"{name}.mcap").touch()
        os.utime(tmp_path / f"{name}.mcap", ns=(order * 10**9, order * 10**9))
    assert [logs.next(), logs.next(), logs.next()] == [tmp_path / "b.mcap", tmp_path / "a.mcap", None]
    assert NewLogs(tmp_path, "before.mcap", old=True).next() == tmp_path / "before.mcap"


def test_a_log_that_is_damaged_or_ends_early_does_not_keep_the_next_one_back(shipped: Path, tmp_path: Path) -> None:
    logs = NewLogs(tmp_path)
    contents = (b"no log at all", shipped.read_bytes()[: in_last_chunk(shipped)], shipped.read_bytes())
    for order, content in enumerate(contents):
        path = tmp_path / f"{order}.mcap"
        path.write_bytes(content)
        os.utime(path, ns=(order, order))
    told, wrong = Told(), list[LogError]()
    follow(logs, cast("Server", told), never, wrong.append)
    assert [len(log) > 0 for log in told.logs] == [False, True, True]
    assert sum(len(chunk.at) for chunk in told.logs[2]) == messages_of(shipped).total()
    assert told.reasons[0] == str(wrong[0])
    assert told.reasons[1].startswith("unknown")
    assert told.reasons[2:] == ["DONE"]


def test_a_log_whose_messages_lack_a_field_is_named(shipped: Path, tmp_path: Path, server: Server) -> None:
    shutil.copy(shipped, tmp_path / "other.mcap")
    rewritten(tmp_path / "other.mcap", without("/cycle", "reasons"))
    wrong: list[LogError] = []
    follow(NewLogs(tmp_path, old=True), server, never, wrong.append)
    (said,) = map(str, wrong)
    assert "other.mcap: its messages are not readable: " in said


class Told:
    """A viewer that keeps what it was given."""

    def __init__(self) -> None:
        self.logs: list[list[Chunk]] = []
        self.reasons: list[str] = []

    def begin(self, name: str, logs: list[str]) -> None:
        self.logs.append([])

    def know(self, bench: bytes) -> None:
        assert b"[limits]" in bench

    def add(self, chunk: Chunk) -> None:
        self.logs[-1].append(chunk)

    def end(self, reason: str) -> None:
        self.reasons.append(reason)


def subscribe_to_everything(viewer: ClientConnection, topics: set[str]) -> dict[int, str]:
    """Topics by the number of the subscription, once all are advertised."""
    found: dict[int, str] = {}
    while not topics <= set(found.values()):
        said = viewer.recv(SECONDS)
        document = json.loads(said) if isinstance(said, str) else {}
        if document.get("op") == "advertise":
            new = {channel["id"]: channel["topic"] for channel in document["channels"]}
            assert {(c["encoding"], c["schemaEncoding"]) for c in document["channels"]} == {("protobuf", "protobuf")}
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": i, "channelId": i} for i in new]}))
            found |= new
    return found


def subscribed(viewer: ClientConnection) -> None:
    """Wait until what a viewer asked for is taken: it is told, in its turn, that a channel does not exist."""
    viewer.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 9999, "channelId": 9999}]}))
    while json.loads(viewer.recv(SECONDS)).get("message") != "no channel is numbered 9999":
        pass


def test_a_viewer_gets_every_message_over_the_foxglove_protocol(shipped: Path) -> None:
    server = Server(port=0)
    try:
        with connect(server.address, subprotocols=["foxglove.sdk.v1"], max_size=None) as viewer:  # type: ignore[list-item]
            wanted = messages_of(shipped)
            first, *rest = chunks(shipped, never)
            server.begin()
            server.add(first)  # the topics; who subscribes gets what follows
            for chunk in rest:
                server.add(chunk)
            topics = subscribe_to_everything(viewer, topics_of(shipped))
            subscribed(viewer)
            server.begin()
            for chunk in chunks(shipped, never):  # the same topics once more: they keep their channels
                server.add(chunk)
            found: Counter[tuple[str, int, bytes]] = Counter()
            while found.total() < wanted.total():
                said = viewer.recv(SECONDS)
                assert isinstance(said, bytes), said
                opcode, number, time_ns = struct.unpack_from("<BIQ", said)
                assert opcode == 1
                found[topics[number], time_ns, said[13:]] += 1
            assert found == wanted
    finally:
        server.close()


@pytest.fixture
def server() -> Iterator[Server]:
    served = Server(port=0, empty="no log yet")
    yield served
    served.close()


class Browser:
    """A page in Chromium, asked over its DevTools protocol."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket

    def value(self, expression: str) -> Any:
        """Value of an expression of JavaScript in the page."""
        parameters = {"expression": expression, "returnByValue": True}
        self._socket.send(json.dumps({"id": 1, "method": "Runtime.evaluate", "params": parameters}))
        return json.loads(self._socket.recv(SECONDS))["result"]["result"].get("value")

    def wait(self, expression: str) -> None:
        """Wait until an expression is true."""
        deadline = time.monotonic() + SECONDS
        while not self.value(expression):
            assert time.monotonic() < deadline, expression
            time.sleep(0.02)


@contextmanager
def browser_at(server: Server, profile: Path) -> Iterator[Browser]:
    """The page of a server in Chromium."""
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0", f"--user-data-dir={profile}"]
    command = ["chromium", *flags, server.address.replace("ws:", "http:")]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            at = next(line.split()[-1] for line in process.stderr if "DevTools listening" in line)
            with urllib.request.urlopen(f"http://{at.split('/')[2]}/json/list", timeout=SECONDS) as answered:
                (page,) = [page for page in json.load(answered) if page["type"] == "page"]
            with connect(page["webSocketDebuggerUrl"], max_size=None) as socket:
                yield Browser(socket)
        finally:
            process.terminate()
            process.communicate(timeout=SECONDS)


@pytest.mark.browser
def test_the_page_in_a_browser_shows_every_sample_and_estimate(shipped: Path, tmp_path: Path, server: Server) -> None:
    log = read_log(shipped)
    cycles, last, wrong = log.cycles["step"] >= 0, log.tables["/estimate"], list[LogError]()
    whole = f"cycles.length === {cycles.sum()} && document.title.startsWith('DONE')"
    with browser_at(server, tmp_path / "early") as page:
        page.wait("document.getElementById('state').textContent === 'no log yet'")
        for _ in range(2):  # the second log takes the place of the first
            page.value("document.title = ''")
            follow(NewLogs(shipped.parent, shipped.name, old=True), server, never, wrong.append)
            page.wait(whole)
        assert page.value("cycles.map(c => c.angle)") == log.cycles["angle"][cycles].tolist()
        assert page.value("estimates.length") == log.counts["/estimate"]
        page.wait("document.querySelectorAll('canvas').length === 4 && !waiting")  # the last estimate is drawn
        assert page.value("document.body.innerText").startswith(f"{shipped.name} DONE")
        assert page.value("limits") == [[-10, 100], [-500, 500], [-6, 6]]
        assert "0.000 s  ACTIVE after BEGIN" in page.value(
            "[...document.querySelectorAll('li')].map(e => e.textContent)"
        )
        rows = page.value("[...document.querySelectorAll('#estimate tr')].map(r => r.innerText.split('\\t'))")
        assert [row[0] for row in rows] == [*UNITS]
        for name, unit, (_, value, half) in zip(UNITS, UNITS.values(), rows, strict=True):
            assert value == f"{around(last[name][-1], 1.96 * last[f'{name}_deviation'][-1])} {unit}"
            share = 1.96 * last[f"{name}_deviation"][-1] / last[name][-1]
            assert half == f"repeatability ± {in_percent(share)}"
        assert page.value("document.getElementById('total').textContent") == "total about 2 %, as J is known to 1 %"
        page.value(f"take({{cycles: [], estimates: [], table: [], events: [[0, '{LOST} not finite']]}})")
        assert page.value("estimates.length + document.getElementById('estimate').childElementCount") == 0
    with browser_at(server, tmp_path / "late") as page:
        page.wait(whole)


PORT = "{port}"
PROTOCOL: list[Any] = ["foxglove.sdk.v1"]
PAGE: list[Any] = [SUBPROTOCOL]
FOREIGN = {
    "a page from elsewhere": {"origin": "https://evil.example"},
    "a page whose address begins like ours": {"origin": "http://localhost.evil.example"},
    "a page behind our address as its user": {"origin": "http://localhost:80@evil.example"},
    "a page that hides where it is from": {"origin": "null"},
    "another name with our address": {"Host": "evil.example:{port}"},
    "another name that ends like ours": {"Host": "evil.localhost:{port}"},
    "another name, with the page of a viewer": {"Host": "evil.example", "origin": "https://app.foxglove.dev"},
    "no name": {"Host": ""},
}
OURS = {
    "no page": {},
    "a page of this computer": {"origin": "http://localhost:8080"},
    "a page of this computer by its address": {"origin": "http://127.0.0.1"},
    "the viewer's page": {"origin": "https://app.foxglove.dev"},
    "the viewer's program": {"origin": "file://"},
    "this computer's name": {"Host": "localhost:{port}"},
    "this computer's other address": {"Host": "[::1]:{port}"},
}


def answer(server: Server, *headers: str) -> str:
    """First line of the answer to a handshake with these headers."""
    host, port = server.address.removeprefix("ws://").split(":")
    with socket.create_connection((host, int(port)), timeout=SECONDS) as raw:
        upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        upgrade += f"Sec-WebSocket-Protocol: {PROTOCOL[0]}\r\n"
        key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        lines = "".join(f"{header.replace(PORT, port)}\r\n" for header in headers)
        raw.sendall(f"GET / HTTP/1.1\r\n{upgrade}{key}{lines}\r\n".encode())
        return raw.makefile(encoding="latin-1").readline().strip()


def test_a_page_from_elsewhere_and_a_name_that_is_not_ours_are_refused(server: Server) -> None:
    for refused, rows in ((True, FOREIGN), (False, OURS)):
        for row, headers in rows.items():
            sent = {"Host": "127.0.0.1:{port}", **headers}
            status = answer(server, *(f"{name.title()}: {value}" for name, value in sent.items()))
            assert ("403" in status) == refused, f"{row}: {status}"
            assert ("101" in status) != refused, f"{row}: {status}"


def test_the_page_is_served_by_our_name_only_and_loads_nothing_from_elsewhere(server: Server) -> None:
    for host, path, status in (("localhost", "/", 200), ("evil.example", "/", 403), ("127.0.0.1", "/favicon.ico", 404)):
        asked = http.client.HTTPConnection(server.address.removeprefix("ws://"), timeout=SECONDS)
        asked.request("GET", path, headers={"Host": host})
        answered = asked.getresponse()
        assert answered.status == status
        assert (b"<html" in answered.read()) == (status == 200)
        if status == 200:
            assert answered.headers["Content-Type"] == "text/html; charset=utf-8"
            assert answered.headers["Content-Security-Policy"].startswith("default-src 'none'")
        asked.close()


def test_a_handshake_with_two_names_or_two_origins_is_refused(server: Server) -> None:
    twice = (["Host: localhost", "Host: evil.example"], ["Host: localhost", "Origin: file://", "Origin: http://evil"])
    for headers in twice:
        assert "403" in answer(server, *headers) or "400" in answer(server, *headers)


def test_a_client_that_does_not_speak_the_protocol_is_left_and_the_others_stay(server: Server, shipped: Path) -> None:
    with connect(server.address, subprotocols=PROTOCOL) as viewer:
        for nonsense in ("nonsense", "[]", '{"op": "subscribe"}', '{"op": "subscribe", "subscriptions": [3]}'):
            with connect(server.address, subprotocols=PROTOCOL) as wrong:
                wrong.send(nonsense)
                assert all(isinstance(said, str) for said in wrong)  # until it is closed
        viewer.send(b"what is binary is passed over")
        topics = subscribe_to_everything_once_served(server, viewer, shipped)
        viewer.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [*topics]}))
        subscribed(viewer)
        server.add(next(iter(chunks(shipped, never))))
        with pytest.raises(TimeoutError):
            viewer.recv(0.1)


def subscribe_to_everything_once_served(server: Server, viewer: ClientConnection, log: Path) -> dict[int, str]:
    server.begin()
    server.add(next(iter(chunks(log, never))))
    return subscribe_to_everything(viewer, topics_of(log))


def test_a_topic_with_another_schema_gets_another_channel(server: Server) -> None:
    with connect(server.address, subprotocols=PROTOCOL) as viewer:
        assert json.loads(viewer.recv(SECONDS))["op"] == "serverInfo"
        for schema in (b"one", b"two", b"two"):
            server.begin()
            described = (
                mcap.Schema(id=3, data=schema, encoding="protobuf", name="emb.Angle"),
                mcap.Channel(id=5, topic="/angle", message_encoding="protobuf", metadata={}, schema_id=3),
            )
            server.add(Chunk(b"", np.empty(0, np.int64), np.empty(0, HEADER), described))
        said = [json.loads(viewer.recv(SECONDS)) for _ in range(3)]
        assert [each["op"] for each in said] == ["advertise", "unadvertise", "advertise"]
        assert said[1]["channelIds"] == [said[0]["channels"][0]["id"]]
        assert said[2]["channels"][0]["schema"] == "dHdv"
        with pytest.raises(TimeoutError):
            viewer.recv(0.05)


def test_the_newest_log_of_a_folder_is_shown_first_and_the_page_may_ask_for_another(
    shipped: Path, tmp_path: Path, server: Server
) -> None:
    for order, name in enumerate(("old", "new")):
        shutil.copy(shipped, tmp_path / f"{name}.mcap")
        os.utime(tmp_path / f"{name}.mcap", ns=(order, order))
    logs = NewLogs(tmp_path)
    with connect(server.address, subprotocols=PAGE, max_size=None) as page:
        assert json.loads(page.recv(SECONDS)) == {"empty": "no log yet"}
        logs.choose(logs.names[0])
        for name in ("new", "old"):
            follow(logs, server, never, lambda err: pytest.fail(str(err)))
            said = [json.loads(page.recv(SECONDS))]
            while "result" not in said[-1]:
                said.append(json.loads(page.recv(SECONDS)))
            assert said[0] == {"begin": f"{name}.mcap", "logs": ["new.mcap", "old.mcap"]}
            assert [each["limits"] for each in said if "limits" in each] == [[[-10, 100], [-500, 500], [-6, 6]]]
            events = [event for each in said for event in each.get("events", ())]
            (start,) = (each["start"] for each in said if "start" in each)
            assert [text for time, text in events if abs(time - start) < 1e-6] == ["ACTIVE after BEGIN"]
            for asked in ("../run.mcap", str(shipped), "", "old.mcap"):
                page.send(json.dumps({"op": "show", "log": asked}))
            deadline = time.monotonic() + SECONDS
            while not logs.waiting and time.monotonic() < deadline:
                time.sleep(0.01)


def test_an_empty_folder_says_what_to_type(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "emb_bench.cli.replay", "live", "--port", "0", "my runs"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        assert process.stderr is not None
        address = process.stderr.readline().split("http://")[1].split()[0]
        with connect(f"ws://{address}", subprotocols=PAGE) as page:
            said = json.loads(page.recv(SECONDS))["empty"]
        process.send_signal(signal.SIGINT)
        assert process.wait(SECONDS) == EXIT_DONE
        assert process.stderr.read() == "", "Ctrl-C is how watching a folder ends"
    assert said == "no log in my runs yet: in another terminal, emb-run --iface sim --log 'my runs/'"


@pytest.mark.parametrize(
    ("named", "listening", "other"),
    [([], "127.0.0.1", "127.0.0.2"), (["--host", "127.0.0.2"], "127.0.0.2", "127.0.0.1")],
)
def test_the_address_that_is_named_is_listened_at_and_no_other(
    tmp_path: Path, named: list[str], listening: str, other: str
) -> None:
    command = [sys.executable, "-m", "emb_bench.cli.replay", "live", "--port", "0", *named, str(tmp_path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            address = process.stderr.readline().split("http://")[1].split()[0]
            port = int(address.strip("/").split(":")[1])
            with connect(f"ws://{address}", subprotocols=PAGE) as page:
                assert "empty" in json.loads(page.recv(SECONDS))
            socket.create_connection((listening, port), timeout=SECONDS).close()
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((other, port), timeout=SECONDS)
        finally:
            process.kill()


def test_a_viewer_may_subscribe_to_what_is_advertised_and_nothing_else(server: Server, shipped: Path) -> None:
    with connect(server.address, subprotocols=PROTOCOL) as viewer:
        subscribe_to_everything_once_served(server, viewer, shipped)
        many = [{"id": number, "channelId": number} for number in range(1000, 2000)]
        for _ in range(50):
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": many}))
            said = json.loads(viewer.recv(SECONDS))
            assert said == {"op": "status", "level": 2, "message": "no channel is numbered 1000"}
        viewer.send("x" * (LARGEST_REQUEST + 1))
        with pytest.raises(ConnectionClosed, match="1009"):
            viewer.recv(SECONDS)


def test_one_viewer_too_many_is_told_so_and_the_others_stay(server: Server) -> None:
    assert (MOST_VIEWERS, LARGEST_REQUEST, MOST_WAITING, MOST_TEXTS) == (16, 64 << 10, 32 << 20, 1000)  # SECURITY.md
    with ExitStack() as held:
        viewers = [held.enter_context(connect(server.address, subprotocols=PROTOCOL)) for _ in range(MOST_VIEWERS)]
        assert all(json.loads(viewer.recv(SECONDS))["op"] == "serverInfo" for viewer in viewers)
        for kind in (PROTOCOL, PAGE):
            with connect(server.address, subprotocols=kind) as refused, pytest.raises(ConnectionClosed, match="1013"):
                refused.recv(SECONDS)
        viewers[0].ping().wait(SECONDS)


class Slow:
    """A connection that asks for channels 1 and 2, and reads when it is let."""

    def __init__(self) -> None:
        self.sending, self.reads, self.left = (threading.Event() for _ in range(3))
        self.received: list[str | bytes] = []
        self.reason = ""

    def __iter__(self) -> Iterator[str]:
        yield json.dumps({"op": "subscribe", "subscriptions": [{"id": n + 6, "channelId": n} for n in (1, 2)]})
        self.left.wait(SECONDS)

    def send(self, what: str | bytes) -> None:
        self.sending.set()
        assert self.reads.wait(SECONDS)
        self.received.append(what)

    def close(self, _: int = 0, reason: str = "") -> None:
        self.reason = self.reason or reason
        self.left.set()


@pytest.mark.parametrize(
    ("messages", "size", "waiting"), [(BACKLOG + 10, 10, BACKLOG), (20, MOST_WAITING // 4, 4)], ids=["many", "large"]
)
def test_what_waits_for_a_slow_viewer_is_bounded(messages: int, size: int, waiting: int) -> None:
    slow, served = Slow(), SimpleNamespace(advertised={1})
    viewer = Viewer(cast("Any", slow), cast("Any", served))
    listening = threading.Thread(target=viewer.listen)
    listening.start()
    assert slow.sending.wait(SECONDS)  # channel 2 does not exist: it is told so, and does not read
    served.advertised.add(2)
    for _ in range(messages):
        viewer.log(1, 0, bytes(size))
        viewer.log(2, 0, bytes(size))  # what did not exist is not subscribed to when it does
    slow.reads.set()
    while len(slow.received) < 1 + waiting and listening.is_alive():
        time.sleep(0.001)
    slow.left.set()
    listening.join(SECONDS)
    assert Counter(len(received) for received in slow.received[1:]) == {MESSAGE.size + size: waiting}


def test_a_viewer_that_reads_no_text_is_left() -> None:
    slow = Slow()
    viewer = Viewer(cast("Any", slow), cast("Any", SimpleNamespace(advertised=set())))
    listening = threading.Thread(target=viewer.listen)
    listening.start()
    assert slow.sending.wait(SECONDS)
    for _ in range(2 * MOST_TEXTS):
        viewer.say(op="status")
    slow.reads.set()
    listening.join(SECONDS)
    assert (len(slow.received), slow.reason) == (1, "too slow: load the page again")


def test_without_the_library_the_server_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "websockets.sync.server", None)
    with pytest.raises(UsageError, match=r"needs websockets: .*'\.\[live\]'"):
        Server(port=0)


@pytest.fixture
def taken_port() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@pytest.mark.parametrize("command", [["emb_bench.cli.replay", "live"], ["emb_runtime.cli.main", "--live"]])
def test_a_port_that_is_taken_is_refused_in_one_line_before_anything_runs(
    command: list[str], taken_port: int, tmp_path: Path
) -> None:
    port = ["--port", str(taken_port)] if command[1] == "live" else [str(taken_port)]
    done = subprocess.run(
        [sys.executable, "-m", *command, *port], capture_output=True, text=True, cwd=tmp_path, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (EXIT_USAGE, "", 1)
    assert f"127.0.0.1:{taken_port}" in done.stderr
    assert not list(tmp_path.rglob("*.mcap"))


def test_a_run_that_is_shown_is_the_same_run(shipped: Path, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    arguments = ["-m", "emb_runtime.cli.main", "--iface", "sim", "--no-rt", "--log", str(log), "--live", "0"]
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=120, check=True)
    assert "live at http://127.0.0.1:" in done.stderr
    assert done.stdout.startswith("done: 500 of 500")
    ours, theirs = (read_log(path).cycles for path in (log, shipped))
    for column in ("step", "angle", "velocity", "policy_current", "sent_current", "state", "reasons"):
        assert list(map(repr, ours[column].tolist())) == list(map(repr, theirs[column].tolist())), column


def on_a_terminal(arguments: list[str], cwd: Path, until: bytes, **environment: str) -> tuple[int, str]:
    """Play emb-run on a terminal, and press Ctrl-C there once it has said something: exit code, and what it said."""
    ours, its = pty.openpty()
    command = [sys.executable, "-m", "emb_runtime.cli.main", "--no-rt", *arguments]
    with subprocess.Popen(
        command, stdin=its, stdout=its, stderr=its, cwd=cwd, start_new_session=True, env=os.environ | environment
    ) as process:
        os.close(its)
        try:
            said = b""
            while until not in said:
                said += os.read(ours, 4096)
            page = said.decode().split("live at ")[1].split()[0]
            socket_at = page.replace("http", "ws")
            with connect(socket_at, subprotocols=PAGE) as first, connect(socket_at, subprotocols=PROTOCOL) as second:
                assert "begin" in json.loads(first.recv(SECONDS))  # who comes after the run still sees it
                assert json.loads(second.recv(SECONDS))["op"] == "serverInfo"
                process.send_signal(signal.SIGINT)
                return process.wait(SECONDS), said.decode()
        finally:
            process.kill()
            os.close(ours)


def test_on_a_terminal_the_page_stays_until_ctrl_c_which_gives_the_exit_code_of_the_run(tmp_path: Path) -> None:
    started = tmp_path / "browser"
    started.write_text(f"#!/bin/sh\necho $1 > {tmp_path}/opened\n")
    started.chmod(0o755)
    for sim, code, environment in (
        ("sim", EXIT_DONE, {"BROWSER": str(started)}),
        ("sim:k_m=0.05", EXIT_SAFETY_STOP, {"BROWSER": "/nonexistent", "PATH": "/nonexistent", "DISPLAY": ""}),
    ):
        found, said = on_a_terminal(
            ["--iface", sim, "--live", "0", "--open", "--log", "runs/"], tmp_path, b"until Ctrl-C", **environment
        )
        assert (found, "Traceback" in said) == (code, False), said
        page = said.split("page stays at ")[1].split()[0]
        assert f"live at {page} in a browser" in said
        assert f"open {page} in one" in said or (tmp_path / "opened").read_text().strip() == page
    assert "no browser is found here" in said
