"""Simulated drives, written from their makers' public documents: ODrive CANSimple, VESC, MIT (Mini-Cheetah, AK).

    PYTHONPATH=examples/drives emb-run --iface map:examples/drives/odrive.toml@sim-drive:odrive    # in lock-step
    PYTHONPATH=examples/drives python -m simulated_drives --iface vcan0 --drive odrive             # on a bus

Not part of the installed packages: the folder beside this file registers the transport ``sim-drive``.
Each is a brake with a drive's own protocol, which knows nothing of ours: bytes are packed by hand. A drive holds its
last command until its own time-out, and then lets go; its watchdog is as the firmware has it when new.
Sources: ODrive ``can_simple.cpp``; ``vedderb/bldc`` ``comm_can.md``; ``bgkatz/motorcontrol`` ``CAN_com.cpp``.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import struct
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from emb_bench.cli.node import PRIORITY, run_node
from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import Plant
from emb_bench.sim.simulated_brake import Noise, SimulatedBrake, read_brake
from emb_bench.sim.transport import LockstepBus, SteppedClock
from emb_runtime.can.interfaces import open_transport
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError
from emb_runtime.records import Frame
from emb_runtime.system import realtime

TORQUE_CONSTANT = 0.0217  # Set up in the drives that command torques [N·m/A]
WATCHDOG = 0.010  # Time-out that a user has set up [s]


class SimulatedDrive(SimulatedBrake):
    """A brake behind a drive that holds a command until its time-out. The protocol is a subclass's.

    Args:
        bench: sample time, and what the brake is.
        theta: the brake's true parameters.
        noise: draws the sensors' errors.
        plant: how the brake moves and what lies between it and the bus.
    """

    def __init__(self, bench: Bench, theta: BrakeParameters, noise: Noise, plant: Plant) -> None:
        super().__init__(theta, noise, plant, bench.timing.sample_time)
        self.watchdog: float | None = WATCHDOG
        """Time-out; None where it is off [s]."""
        self.armed = False
        self.asked = 0.0
        """Current that is held [A]."""
        self.applied = 0.0
        """Current in the last period [A]."""
        self.measured = (0.0, 0.0)
        """Angle [rad] and velocity [rad/s]."""
        self._fed = 0
        self.replies: list[Frame] = []
        """Frames that answer what was received."""

    def receive(self, frame: Frame) -> None:
        """Take one frame from the bus."""
        if not (frame.own or frame.error or frame.remote):
            self.take(frame)

    def take(self, frame: Frame) -> None:
        """Take one frame of a commander."""
        raise NotImplementedError

    def broadcast(self) -> list[Frame]:
        """Frames that it sends at the end of a period."""
        raise NotImplementedError

    def timed_out(self) -> None:
        """Its time-out ran out: it lets go."""
        self.armed = False

    def feed(self) -> None:
        """Begin the time-out anew."""
        self._fed = self.periods

    def tick(self, skipped: int = 0) -> list[Frame]:
        """Let one period pass, and more if the drive was late; gives what it sends at the end of the last one."""
        for _ in range(skipped + 1):
            late = self.watchdog is not None and (self.periods - self._fed) * self._t_s >= self.watchdog
            if self.armed and late:
                self.timed_out()
            asked = self._delayed(self.asked if self.armed else 0.0)
            self.applied = asked if math.isfinite(asked) else 0.0
            self.measured = self._advance(self.applied)
        return self.broadcast()


class ODrive(SimulatedDrive):
    """ODrive, node id 0: encoder and Iq each period, heartbeat each 100 ms; armed by its axis state."""

    IDLE, CLOSED_LOOP = 1, 8
    WATCHDOG_EXPIRED = 0x800
    HEARTBEAT_PERIODS = 100

    def __init__(self, bench: Bench, theta: BrakeParameters, noise: Noise, plant: Plant) -> None:
        super().__init__(bench, theta, noise, plant)
        self.state = self.IDLE
        self.error = 0
        self._modes = (3, 1)  # position control, as when new

    def take(self, frame: Frame) -> None:
        """Any frame to the node feeds its watchdog."""
        if frame.extended or frame.identifier >> 5 != 0:
            return
        number, data = frame.identifier & 0x1F, frame.data
        self.feed()
        if number == 0x07:
            (asked,) = struct.unpack("<I", data[:4])
            if asked == self.CLOSED_LOOP and not self.error:
                self.state, self.asked, self.armed = self.CLOSED_LOOP, 0.0, True
            elif asked == self.IDLE:
                self.state, self.armed = self.IDLE, False
        elif number == 0x0B:
            self._modes = struct.unpack("<II", data)
        elif number == 0x0E and self._modes == (1, 1):
            (torque,) = struct.unpack("<f", data[:4])
            self.asked = torque / TORQUE_CONSTANT
        elif number == 0x18:
            self.error = 0

    def timed_out(self) -> None:
        """The axis is idle, with an error."""
        super().timed_out()
        self.state, self.error = self.IDLE, self.WATCHDOG_EXPIRED

    def broadcast(self) -> list[Frame]:
        """Encoder estimates and currents; now and then the heartbeat."""
        angle, velocity = self.measured
        turns = struct.pack("<ff", angle / (2.0 * math.pi), velocity / (2.0 * math.pi))
        asked = self.asked if self.armed else 0.0
        frames = [Frame(0x009, turns), Frame(0x014, struct.pack("<ff", asked, self.applied))]
        if self.periods % self.HEARTBEAT_PERIODS == 1 % self.HEARTBEAT_PERIODS:
            frames.insert(0, Frame(0x001, struct.pack("<IBBBB", self.error, self.state, 0, 0, 0)))
        return frames


class Vesc(SimulatedDrive):
    """VESC, controller id 5, 7 pole pairs: status 1 and 4 each period, 5 now and then; a current needs no arming."""

    IDENTIFIER, POLE_PAIRS = 5, 7

    def take(self, frame: Frame) -> None:
        """Obey CAN_PACKET_SET_CURRENT."""
        if not frame.extended or frame.identifier != 1 << 8 | self.IDENTIFIER or len(frame.data) != 4:
            return
        self.feed()
        self.asked, self.armed = struct.unpack(">i", frame.data)[0] / 1000.0, True

    def broadcast(self) -> list[Frame]:
        """CAN_PACKET_STATUS and CAN_PACKET_STATUS_4, now and then CAN_PACKET_STATUS_5."""
        angle, velocity = self.measured
        erpm = round(velocity * 60.0 / (2.0 * math.pi) * self.POLE_PAIRS)
        first = struct.pack(">ihh", erpm, max(min(round(self.applied * 10.0), 32767), -32768), 0)
        fourth = struct.pack(">hhhh", 250, 250, 0, round(math.degrees(angle) % 360.0 * 50.0))
        packets = {9: first, 16: fourth} | ({} if self.periods % 50 else {27: struct.pack(">ihh", 0, 240, 0)})
        return [Frame(number << 8 | self.IDENTIFIER, data, extended=True) for number, data in packets.items()]


class Mit(SimulatedDrive):
    """MIT protocol, drive 1 behind a gear of 9: each frame is answered, packed before it is unpacked."""

    GEAR = 9.0
    SPANS = ((-12.5, 12.5, 16), (-65.0, 65.0, 12), (-18.0, 18.0, 12))

    def take(self, frame: Frame) -> None:
        """Answer, then obey: enter or leave motor mode, or a torque."""
        if frame.extended or frame.identifier != 1 or len(frame.data) != 8:
            return
        self.feed()
        self.replies.append(Frame(2, self._reply()))
        if frame.data == b"\xff" * 7 + b"\xfc":
            self.armed, self.asked = True, 0.0
        elif frame.data == b"\xff" * 7 + b"\xfd":
            self.armed = False
        else:
            raw = int.from_bytes(frame.data, "big") & 0xFFF
            low, high, bits = self.SPANS[2]
            self.asked = (low + raw * (high - low) / ((1 << bits) - 1)) / (TORQUE_CONSTANT * self.GEAR)

    def broadcast(self) -> list[Frame]:
        """Nothing: it speaks when it is spoken to."""
        return []

    def _reply(self) -> bytes:
        angle, velocity = self.measured
        word = 1
        values = angle / self.GEAR, velocity / self.GEAR, self.applied * TORQUE_CONSTANT * self.GEAR
        for value, (low, high, bits) in zip(values, self.SPANS, strict=True):
            top = (1 << bits) - 1
            word = word << bits | min(max(int((value - low) * top / (high - low)), 0), top)
        return word.to_bytes(6, "big")


DRIVES: Mapping[str, type[SimulatedDrive]] = {"odrive": ODrive, "vesc": Vesc, "mit": Mit}


class SimDriveTransport(LockstepBus):
    """A bus with a simulated drive on it and nothing else, in lock-step."""

    name = "sim-drive"

    def __init__(
        self, drive: SimulatedDrive, clock: SteppedClock, period_ns: int, truth: Mapping[str, float | str]
    ) -> None:
        super().__init__(drive, clock, period_ns, truth)
        self.drive = drive

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus; a drive that answers does so at once."""
        super().send(frame)
        now_ns = self._clock.now_ns()
        self._queue.extend(reply._replace(time_ns=now_ns) for reply in self.drive.replies)
        self.drive.replies.clear()


def open_sim_drive(options: str, bench: Bench) -> tuple[SimDriveTransport, SteppedClock]:
    """Open a bus with a simulated drive.

    Args:
        options: ``odrive,plant=exact,seed=3,f_v=3e-5``: which drive, and the rest as for the simulated brake.
        bench: knows the plants.

    Raises:
        UsageError: an option is unknown or has no sensible value.
        BenchFileError: the bench has no such plant.
    """
    name, _, rest_of = options.partition(",")
    if name not in DRIVES:
        raise UsageError(f"sim-drive: expected one of {', '.join(DRIVES)}, got '{name}'")
    brake = read_brake(rest_of, bench, "sim-drive: ")
    now_ns = time.monotonic_ns()
    clock = SteppedClock(now_ns, time.time_ns() - now_ns)
    drive = DRIVES[name](bench, brake.theta, brake.noise, brake.plant)
    return SimDriveTransport(drive, clock, bench.timing.sample_time_ns, brake.truth), clock


class OnBus:
    """A drive for :func:`emb_bench.cli.node.run_node`: what answers a frame is sent in the next period."""

    def __init__(self, drive: SimulatedDrive) -> None:
        self._drive = drive
        self.receive = drive.receive

    def tick(self, skipped: int = 0) -> list[Frame]:
        """Let a period pass; gives what is sent at its end."""
        frames = [*self._drive.tick(skipped), *self._drive.replies]
        self._drive.replies.clear()
        return frames


def main(argv: list[str] | None = None) -> int:
    """Run a drive on a bus until SIGTERM or Ctrl-C; prints as JSON how the brake moved."""
    p = argparse.ArgumentParser(description="A brake behind a simulated drive, on a bus, with its own clock.")
    p.add_argument("--iface", required=True)
    p.add_argument("--drive", required=True, choices=sorted(DRIVES))
    p.add_argument("--bench", type=Path, metavar="FILE", help="bench file (default: the shipped drum brake)")
    p.add_argument("--brake", default="", metavar="plant=exact,f_v=3e-5,...", help="as for emb-node")
    args = p.parse_args(argv)
    bench = load_bench(args.bench)
    brake = read_brake(args.brake, bench, "--brake: ")
    drive = DRIVES[args.drive](bench, brake.theta, brake.noise, brake.plant)
    ended = False

    def end(_signal: int, _frame: object) -> None:
        nonlocal ended
        ended = True

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    transport, clock = open_transport(args.iface, bench)
    try:
        realtime.obtain(priority=PRIORITY)
        sys.stderr.write(f"{args.drive}: on {transport.name}\n")
        sys.stderr.flush()
        run_node(OnBus(drive), transport, clock, bench.timing.sample_time_ns, None, lambda: ended)
    finally:
        transport.close()
    low, high = drive.angle_range
    moved = {"angle_min": low, "angle_max": high, "top_speed": drive.top_speed, "armed": drive.armed}
    sys.stdout.write(json.dumps(moved) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
