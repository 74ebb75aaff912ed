"""The watchdog process against loops that are stopped, killed, hung and robbed of Python's lock.

The bus is a Unix socket here: a transport that a package of the test's own registers, as any package may.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from emb_runtime.can.transport import Transport
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError
from emb_runtime.safety.watchdog import WatchdogHandle

from tests.bench.processes import wait_until_gone  # isort: skip
from tests.independent import DATABASE  # isort: skip

BUS = """
import socket
from emb_runtime.system.clock import MonotonicClock

class DatagramBus:
    truth = None

    def __init__(self, path):
        self.name = f"datagram:{path}"
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def send(self, frame):
        self._socket.sendto(frame.identifier.to_bytes(4, "little") + frame.data, self._path)

    def close(self):
        self._socket.close()

def open_bus(path, bench):
    return DatagramBus(path), MonotonicClock()
"""

LOOP = """
import ctypes, os, sys, threading, time
from datagram_bus import DatagramBus
from emb_runtime.config.bench import load_bench
from emb_runtime.safety.watchdog import WatchdogHandle

def hog():
    sys.setswitchinterval(1e6)
    while True:
        pass

path, how = sys.argv[1:]
watchdog = WatchdogHandle.start(DatagramBus(path), load_bench(), 0.5, real_time=False)
pulse = watchdog.pulse
if how == "forked" and os.fork() == 0:
    time.sleep(60)  # a sibling that holds every inherited pipe open
pulse.publish(13, 6)
pulse.arm(time.monotonic_ns())
print(watchdog.pid, flush=True)
for k in range(10**9):
    pulse.beat(time.monotonic_ns())
    time.sleep(0.001)
    if k == 100 and how == "hung":
        ctypes.CDLL(None).sleep(1000)
    if k == 100 and how == "hung with the lock":
        ctypes.PyDLL(None).sleep(1000)
    if k == 100 and how == "robbed of the lock":
        threading.Thread(target=hog, daemon=True).start()
    if pulse.tripped:
        break
print("tripped", watchdog.finish(), flush=True)
"""


class Bus:
    """The other end of the bus."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / "bus"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))

    def frames(self, count: int) -> list[dict[str, Any]]:
        """The next frames, decoded by cantools; each is waited for."""
        self._socket.settimeout(60)
        return [self._decoded(self._socket.recv(100)) for _ in range(count)]

    def rest(self) -> list[dict[str, Any]]:
        """What has come and was not asked for yet."""
        self._socket.setblocking(False)
        found = []
        while True:
            try:
                found.append(self._decoded(self._socket.recv(100)))
            except BlockingIOError:
                return found

    def close(self) -> None:
        self._socket.close()

    def _decoded(self, data: bytes) -> dict[str, Any]:
        values = DATABASE.decode_message(int.from_bytes(data[:4], "little"), data[4:], decode_choices=False)
        return {name: values[name] for name in ("Counter", "Answers", "Current", "Enable")}


def stop_frames(*counters: int, answers: int) -> list[dict[str, Any]]:
    return [{"Counter": counter, "Answers": answers, "Current": 0.0, "Enable": 0} for counter in counters]


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bus]:
    with tempfile.TemporaryDirectory(prefix="bus") as name:  # not tmp_path, too long for the path of a Unix socket
        directory = Path(name)
        (directory / "datagram_bus.py").write_text(BUS)
        information = directory / "datagram_bus-1.dist-info"
        information.mkdir()
        (information / "METADATA").write_text("Metadata-Version: 2.1\nName: datagram-bus\nVersion: 1\n")
        (information / "entry_points.txt").write_text("[emb_runtime.transports]\ndatagram = datagram_bus:open_bus\n")
        monkeypatch.setenv("PYTHONPATH", name)
        made = Bus(directory)
        yield made
        made.close()


def transport(bus: Bus | None = None, name: str = "", truth: object = None) -> Transport:
    return cast(Transport, SimpleNamespace(name=name or f"datagram:{bus.path if bus else ''}", truth=truth))


def watchdog_of(bus: Bus, bench: Bench, heartbeat: float) -> WatchdogHandle:
    return WatchdogHandle.start(transport(bus), bench, heartbeat, real_time=False)


class LoopProcess:
    """A loop that beats until something happens to it."""

    def __init__(self, bus: Bus, how: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", LOOP, str(bus.path), how], stdout=subprocess.PIPE, start_new_session=True, text=True
        )
        assert self._process.stdout is not None
        self.output = self._process.stdout
        self.watchdog_pid = int(self.output.readline())

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def end(self) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self.output.close()


@pytest.mark.parametrize("how", ["hung", "hung with the lock", "robbed of the lock"])
def test_a_loop_that_does_not_come_back_is_stopped_for(bus: Bus, how: str) -> None:
    loop = LoopProcess(bus, how)
    assert bus.frames(3) == stop_frames(14, 0, 1, answers=6)
    loop.end()
    wait_until_gone(loop.watchdog_pid)
    assert bus.rest() == []


def test_a_loop_that_was_stopped_finds_the_watchdog_tripped_when_it_goes_on(bus: Bus) -> None:
    loop = LoopProcess(bus, "stopped")
    loop.signal(signal.SIGSTOP)
    assert bus.frames(3) == stop_frames(14, 0, 1, answers=6)
    loop.signal(signal.SIGCONT)
    said = loop.output.readline()
    assert said.startswith("tripped WatchdogResult(tripped='stalled'")
    assert "frames=3" in said
    assert "error=''" in said
    loop.end()
    wait_until_gone(loop.watchdog_pid)
    assert bus.rest() == []


@pytest.mark.parametrize("how", ["killed", "forked"])
def test_a_loop_that_is_killed_is_stopped_for_and_the_watchdog_ends(bus: Bus, how: str) -> None:
    loop = LoopProcess(bus, how)
    loop.signal(signal.SIGKILL)
    assert bus.frames(3) == stop_frames(14, 0, 1, answers=6)
    wait_until_gone(loop.watchdog_pid)
    loop.end()
    assert bus.rest() == []


def test_letting_go_of_the_watchdog_sends_the_stop_frames_while_armed_and_nothing_after_disarming(
    bus: Bus, bench: Bench
) -> None:
    for disarmed, tripped, frames in ((True, "", []), (False, "gone", stop_frames(0, 1, 2, answers=0))):
        watchdog = watchdog_of(bus, bench, heartbeat=60.0)
        watchdog.pulse.arm(time.monotonic_ns())
        if disarmed:
            watchdog.pulse.disarm()
        result = watchdog.finish()
        assert (result.tripped, result.frames, result.error) == (tripped, len(frames), "")
        assert bus.rest() == frames


def test_the_report_says_when_it_tripped_and_after_which_silence(bus: Bus, bench: Bench) -> None:
    watchdog = watchdog_of(bus, bench, heartbeat=0.05)
    before = time.monotonic_ns()
    watchdog.pulse.arm(before)
    bus.frames(3)
    assert watchdog.pulse.tripped
    result = watchdog.finish()
    assert result.tripped == "stalled"
    assert result.silence_ns >= 50_000_000
    assert result.time_ns == before + result.silence_ns
    assert result.trailer() == {
        "watchdog_tripped": "stalled",
        "watchdog_time_ns": str(result.time_ns),
        "watchdog_silence_ns": str(result.silence_ns),
        "watchdog_frames": "3",
        "watchdog_lateness_ns": str(result.lateness_ns),
        "watchdog_error": "",
    }


def test_a_watchdog_that_is_killed_is_missed_and_told(bus: Bus, bench: Bench) -> None:
    watchdog = watchdog_of(bus, bench, heartbeat=0.02)
    os.kill(watchdog.pid, signal.SIGKILL)
    deadline = time.monotonic() + 30
    while watchdog.pulse.watched(time.monotonic_ns()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    result = watchdog.finish()
    assert (result.tripped, result.error) == ("", "the watchdog process died (signal 9)")


def test_a_watchdog_that_does_not_answer_is_ended(bus: Bus, bench: Bench) -> None:
    watchdog = watchdog_of(bus, bench, heartbeat=60.0)
    os.kill(watchdog.pid, signal.SIGSTOP)
    result = watchdog.finish(timeout=0.1)
    assert result.error == "the watchdog process did not answer within 0.1 s"
    wait_until_gone(watchdog.pid)


def test_the_watchdog_leaves_signals_to_the_runtime_and_what_it_obtained_of_real_time_is_told(
    bus: Bus, bench: Bench
) -> None:
    watchdog = WatchdogHandle.start(transport(bus), bench, 60.0)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(watchdog.pid, number)
    result = watchdog.finish()
    assert result.error == ""
    settings = result.realtime
    assert settings["garbage_collector"] == "frozen, off"
    assert result.trailer()["watchdog_rt_garbage_collector"] == "frozen, off"
    assert settings["scheduler"] == "FIFO 90" or settings["scheduler"].startswith("not obtained: ")


def test_a_bus_that_nobody_else_can_open_is_refused(bench: Bench) -> None:
    with pytest.raises(BusError, match="only this process can open this bus"):
        WatchdogHandle.start(transport(name="sim", truth={"f_v": 2e-5}), bench, 0.005)


def test_a_bus_that_cannot_be_opened_a_second_time_is_told_in_one_line(bench: Bench) -> None:
    with pytest.raises(BusError, match="nocan7: cannot watch over the loop: ") as caught:
        WatchdogHandle.start(transport(name="nocan7"), bench, 0.005)
    assert "\n" not in str(caught.value)


def test_a_watchdog_that_does_not_start_does_not_hang_the_runtime(
    tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    sleeper = tmp_path / "python"
    sleeper.write_text("#!/bin/sh\nexec sleep 60\n")
    sleeper.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(sleeper))
    with pytest.raises(BusError, match=r"did not answer within 0\.2 s"):
        WatchdogHandle.start(transport(name="vcan0"), bench, 0.005, timeout=0.2)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "absent"))
    with pytest.raises(BusError, match="No such file"):
        WatchdogHandle.start(transport(name="vcan0"), bench, 0.005)
