"""The watchdog process: sends the stop frame when the loop stalls or has ended, and can send no other frame.

``python -m emb_runtime.safety.watchdog_process HEARTBEAT_FD [LOOP_SOCKET_FD] DOCUMENT_FD``, started only by
:class:`emb_runtime.safety.watchdog.WatchdogHandle`. It has another socket of the bus, a priority above the loop's, and
225 prepared frames: disabled, 0 A, one for each pair of counters. The shared memory only selects one of them.

Why no enabled command acts after the trip:

* ``tripped`` is set before the first stop frame is sent, and the guard reads it before each command.
* One command may have passed this check, if the loop was stopped between check and sending. It answers a sample from
  before the silence, and the node obeys only an answer to its newest sample. The node's stop, which the first stop
  frame began, is latched, too. If the node also stood still, the stop frames of the next two periods follow that
  command.
* Frames in the queue of the interface are sent before the stop frames, which wait behind them.
* If the loop continues much later, its counters may match by chance. So on SocketCAN the watchdog, after its first stop
  frame, binds the loop's socket to no interface. The kernel then rejects every frame that the loop sends; the socket
  still receives, from all CAN interfaces.
"""

from __future__ import annotations

import os
import select
import socket
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Any

from emb_runtime.can.e2e import COUNTER_MODULUS, next_counter
from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import Layout, load_layout
from emb_runtime.config.bench import parse_bench
from emb_runtime.errors import EmbError
from emb_runtime.records import Frame
from emb_runtime.safety.heartbeat import STOP_FRAMES, Heartbeat
from emb_runtime.system import child_process, realtime
from emb_runtime.system.clock import Clock

PRIORITY = realtime.PRIORITY + 10  # Above the loop's, which may occupy the only processor
LOOKS = 5  # Looks at the heartbeat within its time
LONGEST_SILENCE = 2  # Longest silence, in heartbeats, even if this process was delayed
STOP_TRIES = 50  # Most periods in which stop frames are tried: the transmit queue may be full
REST_NS = 100_000_000  # Time between two looks after the stop frames, until the loop's process ends [ns]

StopFrames = tuple[tuple[Frame, ...], ...]
"""Stop frames by alive counter, and by the counter of the sample that they answer."""


class LoopStatus(StrEnum):
    """Status of the loop at a look at its heartbeat."""

    ALIVE = ""
    STALLED = "stalled"  # The loop is silent for too long: send the stop frames
    GONE = "gone"  # The loop's process has ended while it was to be watched: send the stop frames
    OVER = "over"  # The loop's process has ended, or has released the watchdog, after its run


class SilenceMonitor:
    """Monitor of the loop's silence. Pure: monotonic times are handed in [ns].

    A silence as long as the heartbeat trips. If this process itself was delayed by more than two polls, the excess is
    not counted as loop silence, up to two heartbeats in all: that is the longest silence, plus the time of one poll.
    """

    def __init__(self, heartbeat_ns: int, now_ns: int) -> None:
        self._heartbeat_ns = heartbeat_ns
        self.interval_ns = heartbeat_ns // LOOKS  # Time between two looks [ns]
        self._look_ns = now_ns
        self._idle_ns = now_ns
        self._since_ns = now_ns
        self._stolen_ns = 0

    def look(self, now_ns: int, beat_ns: int, armed: bool, gone: bool) -> LoopStatus:
        """Evaluate the heartbeat at a monotonic time, which is read after the loop's last beat, ``beat_ns`` [ns].

        A beat in the future means that the memory is damaged, and counts as a stall. ``armed``: the loop is to be
        watched; ``gone``: it has ended.
        """
        gap_ns, self._look_ns = now_ns - self._look_ns, now_ns
        if gone:
            return LoopStatus.GONE if armed else LoopStatus.OVER
        if not armed:
            self._idle_ns = now_ns
            return LoopStatus.ALIVE
        if beat_ns > now_ns:
            return LoopStatus.STALLED
        since_ns = max(beat_ns, self._idle_ns)
        if since_ns != self._since_ns:
            self._since_ns, self._stolen_ns = since_ns, 0
        silence_ns = now_ns - since_ns
        if gap_ns > 2 * self.interval_ns:
            self._stolen_ns += min(gap_ns - self.interval_ns, silence_ns)
        excused = silence_ns - self._stolen_ns < self._heartbeat_ns
        return LoopStatus.ALIVE if excused and silence_ns < LONGEST_SILENCE * self._heartbeat_ns else LoopStatus.STALLED


def stop_frames(layout: Layout) -> StopFrames:
    """Stop frames: all that the watchdog can send."""
    counters = range(COUNTER_MODULUS)
    return tuple(
        tuple(layout.encode_command(counter, answers, 0.0, False) for answers in counters) for counter in counters
    )


@dataclass
class Watchdog:
    """Watchdog of one loop, from the first look to the end of its process."""

    heartbeat: Heartbeat
    frames: StopFrames
    period_ns: int  # Between two stop frames [ns]
    clock: Clock
    send: Callable[[Frame], None]  # Puts a frame on the bus; raises BusError, or any error of a vendor's driver
    silence_loop: Callable[[], None]  # Takes the bus away from the loop's socket; raises OSError
    wait: Callable[[int], bool]  # Waits until a time or until the loop's process ends; True if it has ended
    tripped: str = ""
    time_ns: int = 0  # Time of the last look [ns]
    beat_ns: int = 0  # The loop's last beat at that look [ns]
    sent: int = 0
    lateness_ns: int = 0  # Largest lateness of a look [ns]
    error: str = ""

    def run(self) -> dict[str, Any]:
        """Watch until the loop's process has ended; returns the fields of ``WatchdogResult``."""
        status = self._watch()
        if status is not LoopStatus.OVER:
            self._stop(status)
            while not self.wait(self.clock.now_ns() + REST_NS):
                pass
        return {
            "tripped": self.tripped,
            "time_ns": self.time_ns if self.tripped else 0,
            "silence_ns": self.time_ns - self.beat_ns if self.tripped else 0,
            "frames": self.sent,
            "lateness_ns": self.lateness_ns,
            "error": self.error,
        }

    def _watch(self) -> LoopStatus:
        """Look on an absolute grid until the status is another than ALIVE."""
        heartbeat = self.heartbeat
        due_ns = self.time_ns = self.clock.now_ns()
        watch = SilenceMonitor(heartbeat.heartbeat_ns, self.time_ns)
        status = LoopStatus.ALIVE
        while status is LoopStatus.ALIVE:
            due_ns += ((self.time_ns - due_ns) // watch.interval_ns + 1) * watch.interval_ns
            gone = self.wait(due_ns)
            armed, self.beat_ns = heartbeat.armed, heartbeat.beat_ns
            self.time_ns = self.clock.now_ns()
            heartbeat.mark_alive(self.time_ns)
            self.lateness_ns = max(self.lateness_ns, self.time_ns - due_ns)
            status = watch.look(self.time_ns, self.beat_ns, armed, gone)
        return status

    def _stop(self, status: LoopStatus) -> None:
        self.heartbeat.trip()
        self.tripped = str(status)
        counter, answers = self.heartbeat.last
        due_ns = self.time_ns
        for attempt in range(STOP_TRIES):
            counter = next_counter(counter)
            try:
                self.send(self.frames[counter][answers])
                self.sent += 1
            except Exception as err:  # of any kind: the next frame is still tried
                self.error = str(err) or type(err).__name__
            if attempt == 0:  # after the stop frame, as it may block in the kernel
                try:
                    self.silence_loop()
                except OSError as err:
                    self.error = f"the loop's socket keeps its bus: {err.strerror}"
            if self.sent == STOP_FRAMES:
                break
            due_ns += self.period_ns
            self.clock.sleep_until(due_ns)


def _loop_is_gone(parent: int, clock: Clock) -> Callable[[int], bool]:
    """A wait that returns at once when the parent closes our standard input or ends."""
    watched = [0, os.pidfd_open(parent)]  # a process that the runtime forked may hold the other end of the pipe open
    if os.getppid() != parent:
        raise ProcessLookupError("the runtime has ended")

    def wait(until_ns: int) -> bool:
        # Nothing is written into the pipe: readable means end of file.
        return bool(select.select(watched, [], [], max(0.0, (until_ns - clock.now_ns()) * 1e-9))[0])

    return wait


def _unbind(descriptors: Sequence[int]) -> None:
    """Bind CAN sockets of another process to no interface: what it sends from now on fails with ENXIO."""
    for descriptor in descriptors:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW, fileno=os.dup(descriptor)) as loop_socket:
            loop_socket.bind(("",))


def main(arguments: list[str]) -> int:
    """Watch over one run. Returns the exit status."""
    child_process.leave_ending_to_parent()
    heartbeat_fd, *loop_sockets, document_fd = map(int, arguments)
    document = child_process.read_document(document_fd)
    bench = parse_bench(document["bench"], "bench")
    try:
        transport, clock = open_transport(document["iface"], bench, identifiers=())
        wait = _loop_is_gone(int(document["parent"]), clock)
    except (EmbError, OSError) as err:
        child_process.write_answer({"error": str(err)})
        return 1
    watchdog = Watchdog(
        heartbeat=Heartbeat(heartbeat_fd),
        frames=stop_frames(load_layout()),
        period_ns=bench.timing.sample_time_ns,
        clock=clock,
        send=transport.send,
        silence_loop=partial(_unbind, loop_sockets),
        wait=wait,
    )
    obtained = realtime.obtain(priority=PRIORITY) if document["real_time"] else {}
    child_process.write_answer({"ready": obtained})
    child_process.write_answer(watchdog.run())
    transport.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
