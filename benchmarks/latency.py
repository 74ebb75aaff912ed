"""Latency from a sensor frame to the answer on a real bus: emb-run beside python-can and a minimal C program.

    python benchmarks/latency.py [--seconds 6] [--actor tests/hil/network.onnx]

On ``vcan0``, through emb-hil if this kernel has none. Three programs answer the same emb-node, one after the other, for
``--seconds`` at 1 kHz each: ``emb-run`` with policy, guard, shield and logging on; the same program through
python-can's Bus API (its socketcan backend); and a minimal C program that does recvmsg, recvmsg, send. A socket that
takes no part keeps all frames with the kernel's time stamps; measured is from a velocity frame to the command that
answers it, as both were on the bus. On a busy computer, ``chrt -f 10`` in front keeps others out of it.

Exit code 0 if emb-run takes at most twice the C program's time at the median, and less than python-can.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.bus.long_run import write_both
from emb_runtime.can.e2e import COUNTER_MODULUS
from emb_runtime.can.messages import load_layout
from emb_runtime.can.python_can import PythonCan
from emb_runtime.can.transport import Transport
from emb_runtime.cli import main as run
from emb_runtime.cli import repeat
from emb_runtime.config.bench import Bench
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE
from emb_runtime.records import CurrentCommand, Frame
from emb_runtime.system import realtime
from emb_runtime.system.clock import Clock, MonotonicClock

BUS = "vcan0"
HIGHEST_RATIO = 2.0  # Limit of emb-run's median over the C program's
CONTESTANTS = {
    "echo": "C: recvmsg, recvmsg, send",
    "emb-run": "emb-run",
    "python-can": "emb-run through python-can",
}
ATTEMPTS = 3  # Repetitions of each, where a busy computer made it stop
LEAST = 0.1  # Share of the samples that must be answered; with fewer, the result is not valid
_FRAME = struct.Struct("=IB3x8s")
_SO_RCVBUFFORCE, _SO_TIMESTAMPNS = 33, 35
_KEPT = 128 << 20  # bytes of frames that nobody has read yet: some 170,000
ECHO = Path(__file__).parent / "bus" / "echo.c"


def main() -> int:
    """Measure and print; gives the exit code."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--seconds", type=float, default=6.0, metavar="S", help="length of each run (default: %(default)g)")
    p.add_argument("--actor", type=Path, metavar="FILE", help="of emb-export (default: the shipped one)")
    p.add_argument("--keep", type=Path, metavar="DIR", help="leave the logs and the frames in this new folder")
    p.add_argument("--inside", type=Path, metavar="DIR", help=argparse.SUPPRESS)
    p.add_argument("--python-can", nargs=argparse.REMAINDER, metavar="ARGUMENT", help=argparse.SUPPRESS)
    args = p.parse_args()
    if args.python_can is not None:
        return _run_through_python_can(args.python_can)
    if args.inside is not None:
        _measure(args.inside, args.seconds)
        return EXIT_DONE
    with tempfile.TemporaryDirectory(prefix="emb-latency-") as temporary:
        folder = Path(temporary)
        if args.keep is not None:
            folder = args.keep.resolve()
            folder.mkdir()
        return _outside(folder, args.seconds, args.actor)


def _outside(folder: Path, seconds: float, actor: Path | None) -> int:
    write_both(folder, round(1000 * seconds), actor)
    (folder / "commands").write_bytes(_commands())
    subprocess.run(["cc", "-O2", "-o", str(folder / "echo"), str(ECHO)], check=True)
    inside = [sys.executable, __file__, "--seconds", str(seconds), "--inside", str(folder)]
    hil = [sys.executable, "-m", "emb_bench.hil.cli", "--timeout", "600", "--"]
    subprocess.run([*hil, *inside], check=True, stdin=subprocess.DEVNULL)
    delays = {name: _delays(folder / f"{name}.json") for name in CONTESTANTS}
    medians = {name: float(np.median(values)) if len(values) else math.nan for name, values in delays.items()}
    print(f"{'velocity frame to command, as on the bus':42}{'median':>10}{'p99':>10}{'answered':>10}{'to C':>8}")
    for name, said in CONTESTANTS.items():
        high = float(np.percentile(delays[name], 99)) if len(delays[name]) else math.nan
        ratio = medians[name] / medians["echo"]
        print(f"{said:42}{1e6 * medians[name]:7.0f} us{1e6 * high:7.0f} us{len(delays[name]):10}{ratio:8.2f}")
    to_c, to_python_can = medians["emb-run"] / medians["echo"], medians["emb-run"] / medians["python-can"]
    met = to_c <= HIGHEST_RATIO and to_python_can < 1.0
    print(
        f"emb-run takes {to_c:.2f} times as long as C (limit {HIGHEST_RATIO:g}) and {to_python_can:.2f} times as long "
        f"as python-can (limit 1): {'met' if met else 'NOT MET'}"
    )
    return EXIT_DONE if met else EXIT_CHECK_FAILED


def _commands() -> bytes:
    """Every command of 0 A that the C program may send, by own counter and by the counter answered."""
    layout, counters = load_layout(), range(COUNTER_MODULUS)
    frames = (
        layout.encode_command(CurrentCommand(own, answered, 0.0, enable=True))
        for own in counters
        for answered in counters
    )
    return b"".join(_FRAME.pack(frame.identifier, len(frame.data), frame.data) for frame in frames)


def _delays(file: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Delays from each velocity frame to the command that answers it, in time or not [s]."""
    layout = load_layout()
    found = []
    asked: dict[int, int] = {}
    for time_ns, identifier, data in json.loads(file.read_text()):
        frame = Frame(identifier, bytes.fromhex(data))
        if identifier == layout.velocity.identifier:
            asked[layout.decode_velocity(frame).counter] = time_ns
        elif identifier == layout.command.identifier:
            command = layout.decode_command(frame)
            if command.enable and command.answers in asked:
                found.append(1e-9 * (time_ns - asked.pop(command.answers)))
    return np.array(found)


def _measure(folder: Path, seconds: float) -> None:
    """Measures one program after the other, inside the kernel that has the bus."""
    layout = load_layout()
    bench = ["--bench", str(folder / "bench.toml")]
    node = [sys.executable, "-m", "emb_bench.cli.node", "--iface", BUS, *bench]
    asked = ["--iface", BUS, "--policy", str(folder / "actor.onnx"), *bench, "--yes", "--json"]
    asked += ["--long-timeouts", "--log"]
    identifiers = [str(layout.angle.identifier), str(layout.velocity.identifier)]
    commands = {
        "echo": [str(folder / "echo"), BUS, str(folder / "commands"), *identifiers, str(realtime.PRIORITY)],
        "emb-run": [sys.executable, "-m", "emb_runtime.cli.main", *asked],
        "python-can": [sys.executable, __file__, "--python-can", *asked],
    }
    for name, command in commands.items():
        for attempt in range(ATTEMPTS):
            # Written in memory: a write to the host's files holds up the whole User-Mode Linux kernel.
            log = Path("/dev/shm") / f"{name}-{attempt}.mcap"
            said = folder / f"{name}.out"
            if name == "echo":  # ends when the node is silent
                frames = _watched(command, node, said, seconds)
            else:
                frames = _watched([*command, str(log)], node, said, None)
            if log.exists():
                shutil.move(log, folder)
            if sum(identifier == layout.command.identifier for _, identifier, _ in frames) > LEAST * 1000 * seconds:
                break
        (folder / f"{name}.json").write_text(json.dumps(frames))


def _watched(
    command: Sequence[str], node: Sequence[str], said: Path, seconds: float | None
) -> list[tuple[int, int, str]]:
    """All frames on the bus while a program answers the node, for so many seconds or until it ends by itself."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as watcher:
        watcher.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _KEPT)
        watcher.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        watcher.bind((BUS,))
        watcher.setblocking(False)
        with (
            said.open("w") as out,
            subprocess.Popen(node, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as brake,
        ):
            assert brake.stderr is not None
            brake.stderr.readline()  # it reports that it is on the bus
            with subprocess.Popen(command, stdout=out) as program:
                if seconds is not None:
                    time.sleep(seconds)
                    brake.terminate()
                program.wait(timeout=120)
            brake.terminate()
        return list(_read(watcher))


def _read(watcher: socket.socket) -> Any:
    # Nothing reads while the bus is busy: on one processor a reader would slow down what it watches.
    while True:
        try:
            raw, ancillary, _, _ = watcher.recvmsg(_FRAME.size, socket.CMSG_SPACE(16))
        except BlockingIOError:
            return
        seconds, nanoseconds = struct.unpack("@ll", ancillary[0][2])
        identifier, length, data = _FRAME.unpack(raw)
        yield seconds * 1_000_000_000 + nanoseconds, identifier, data[:length].hex()


def _run_through_python_can(arguments: list[str]) -> int:
    """emb-run, with python-can's socketcan backend in place of its own socket."""

    def open_it(iface: str, bench: Bench, *_: Any) -> tuple[Transport, Clock]:
        clock = MonotonicClock()
        return PythonCan("socketcan", iface, bench.can.bitrate, clock), clock

    with mock.patch.object(repeat, "open_transport", open_it):
        return run.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
