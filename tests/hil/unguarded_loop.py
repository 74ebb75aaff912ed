"""A loop that asks no guard: it stands still under a watchdog, and then sends an enabled command all the same.

Prints what became of it as JSON. One sniffer and this process are alone on the bus.
"""

from __future__ import annotations

import json
import time

from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import BusError
from emb_runtime.safety.watchdog import WatchdogHandle
from tests.hil.sniffer import open_socket, read, wait_until

HEARTBEAT = 0.05


def main() -> None:
    bench, layout = load_bench(), load_layout()
    sniffer, other = open_socket([]), open_socket([])
    transport, clock = open_transport("vcan0", bench)
    watchdog = WatchdogHandle.start(transport, bench, HEARTBEAT)
    pulse = watchdog.pulse

    def send(counter: int) -> str:
        try:
            transport.send(layout.encode_command(counter, 0, 1.0, True))
        except BusError as err:
            return str(err)
        return ""

    pulse.arm(clock.now_ns())
    pulse.publish(0, 0)
    refused_before = send(0)
    wait_until(lambda: pulse.tripped, 30)
    time.sleep(0.2)
    refused_after = send(1)
    time.sleep(0.01)  # a frame's stamp and the clock that dates the loss differ by some microseconds
    other.send(b"\x23\x01\x00\x00\x00" + bytes(11))
    heard = []
    while (frame := transport.receive(clock.now_ns() + 1_000_000_000)) is not None:
        heard.append(frame.identifier)
    result = watchdog.finish()
    frames = [(identifier, data) for _, identifier, data in read(sniffer)[0]]
    said = {"before": refused_before, "after": refused_after, "frames": frames, "heard": heard}
    print(json.dumps(said | {"result": vars(result)}))  # noqa: T201


if __name__ == "__main__":
    main()
