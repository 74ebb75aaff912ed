"""The runtime's side of the watchdog: starts the process that watches over the loop, and ends it.

The process (:mod:`emb_runtime.safety.watchdog_process`) stands beside the loop, not in it: it sends the stop frames
when the loop is stopped, killed, hung in a call or blocked on the GIL, and cannot send any more itself.
Behind it stands the node's watchdog, which needs nobody on this computer.
"""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field

from emb_runtime.can.transport import SocketCan, Transport
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError
from emb_runtime.safety.heartbeat import Heartbeat
from emb_runtime.system.child_process import Child

START_TIMEOUT = 30.0  # Longest wait for the process to be on the bus [s]
FINISH_TIMEOUT = 5.0  # Longest wait for its report [s]


@dataclass(frozen=True)
class WatchdogResult:
    """Report of a watchdog."""

    tripped: str = ""
    """``stalled``: the loop stood still; ``gone``: it ended while it was watched; empty: it did not trip."""
    time_ns: int = 0  # Time at which it tripped, monotonic; 0 if it did not [ns]
    silence_ns: int = 0  # Age of the loop's last sign of life then; 0 if it did not trip [ns]
    frames: int = 0  # Stop frames that were sent
    lateness_ns: int = 0  # Largest lateness of a look at the heartbeat [ns]
    error: str = ""  # Error that kept it from its report or its stop frames; empty if there was none
    realtime: dict[str, str] = field(default_factory=dict)
    """Real-time settings that it obtained, see :func:`emb_runtime.system.realtime.obtain`."""

    def trailer(self) -> dict[str, str]:
        """Report for the log's trailer."""
        values = asdict(self)
        settings = values.pop("realtime")
        entries = {f"watchdog_{name}": str(value) for name, value in values.items()}
        return entries | {f"watchdog_rt_{name}": value for name, value in settings.items()}


class WatchdogHandle:
    """A running watchdog process. Made by :meth:`start`, ended by :meth:`finish`."""

    def __init__(self, pulse: Heartbeat, child: Child, settings: dict[str, str]) -> None:
        self.pulse = pulse  # The loop's side: what it and the guard must be given
        self.realtime = settings  # Real-time settings that the process obtained
        self._child = child

    @classmethod
    def start(
        cls,
        transport: Transport,
        bench: Bench,
        heartbeat: float,
        *,
        real_time: bool = True,
        timeout: float = START_TIMEOUT,
    ) -> WatchdogHandle:
        """Start the process and wait until it is on the bus and watches.

        Args:
            transport: the loop's, open. The process opens the same bus once more, for itself.
            bench: the bench.
            heartbeat: silence of the loop that trips it [s].
            real_time: the process asks for real-time behaviour, above the loop's.
            timeout: longest wait [s].

        Raises:
            BusError: this bus cannot be watched or not opened twice, or the process did not start in time.
        """
        name = transport.name
        if transport.truth is not None:
            raise BusError(f"{name}: only this process can open this bus, so no watchdog can; run without one")
        # The loop's socket goes along, so that the bus can be taken away from it.
        sockets = [transport.descriptor] if isinstance(transport, SocketCan) else []
        document = {"iface": name, "bench": bench.text, "parent": os.getpid(), "real_time": real_time}
        try:
            with ExitStack() as opened:
                pulse = Heartbeat.create(heartbeat, time.monotonic_ns())
                opened.callback(pulse.close)
                program = "emb_runtime.safety.watchdog_process"
                child = Child("watchdog", program, document, timeout, [pulse.fd, *sockets])
                opened.pop_all()
        except OSError as err:
            raise BusError(f"{name}: cannot watch over the loop: {err}") from err
        return cls(pulse, child, child.ready)

    @property
    def pid(self) -> int:
        """Process id of the watchdog."""
        return self._child.pid

    def finish(self, timeout: float = FINISH_TIMEOUT) -> WatchdogResult:
        """End the process; if the loop has not disarmed, it sends the stop frames first.

        A failure is in its report, which is waited for at most ``timeout`` seconds, and never raised.
        """
        self._child.release()
        answer = self._child.read_answer(timeout)
        self._child.join()
        self.pulse.close()
        return WatchdogResult(**answer, realtime=self.realtime)
