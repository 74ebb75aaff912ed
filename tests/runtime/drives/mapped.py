"""A mapped drive on a simulated bus in lock-step, as a test breaks it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from emb_bench.config.bench import Bench, parse_bench
from emb_bench.sim.transport import SteppedClock
from emb_runtime.can.transport import Transport
from emb_runtime.drives.lock_step import LockStepDrive
from emb_runtime.drives.mapping import Mapping
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.records import Frame
from simulated_drives import WATCHDOG, SimDriveTransport, SimulatedDrive, open_sim_drive
from tests.actors import constant_actor
from tests.drives import EXAMPLES, late_bench
from tests.runtime.operating import EmbRun

Change = Callable[[Frame], Frame | None]


def protected_odrive() -> tuple[str, str]:
    """Mapping file and DBC of an ODrive whose current has a checksum and a counter of 15 values."""
    toml, dbc = ((EXAMPLES / f"odrive.{kind}").read_text() for kind in ("toml", "dbc"))
    for old, new in PROTECTED:
        assert old in toml + dbc
        toml, dbc = toml.replace(old, new), dbc.replace(old, new)
    return toml, dbc


PROTECTED = (
    ("BO_ 20 Axis0_Get_Iq: 8", "BO_ 20 Axis0_Get_Iq: 6"),
    (
        ' SG_ Iq_Setpoint : 0|32@1- (1,0) [0|0] "A" Host\n SG_ Iq_Measured : 32|32@1- (1,0) [0|0] "A" Host',
        ' SG_ Sum : 0|8@1+ (1,0) [0|0] "" Host\n SG_ Count : 8|4@1+ (1,0) [0|0] "" Host\n'
        ' SG_ Iq_Measured : 16|32@1- (1,0) [0|0] "A" Host',
    ),
    ("SIG_VALTYPE_ 20 Iq_Setpoint : 1;\n", ""),
    ('default = "none"', 'Axis0_Get_Iq = {kind = "sum", checksum = "Sum", counter = "Count", modulus = 15, start = 3}'),
)


def protected(count: int, time_ns: int, current: float = 0.5, off: int = 0) -> Frame:
    """The current of that drive."""
    rest = struct.pack("<Bf", count, current)
    return Frame(0x014, bytes(((sum(rest) + 3 + off) & 0xFF,)) + rest, time_ns)


class MappedBus:
    """The bus that ``emb-run`` opens, with the drive on it.

    ``change`` makes of each frame of the drive what is received, or None; the mapping's files are in a folder.
    """

    def __init__(self, name: str, bench_text: str, folder: Path) -> None:
        self.name, self.file = name, folder / f"{name}.toml"
        for kind in ("toml", "dbc"):
            (folder / f"{name}.{kind}").write_text((EXAMPLES / f"{name}.{kind}").read_text())
        self.bench = parse_bench(bench_text, "bench.toml")
        self.change: Change = lambda frame: frame
        self.at: tuple[int, Callable[[SimulatedDrive], object]] | None = None
        self.sent: list[Frame] = []
        self.injected: list[Frame] = []
        """Frames of somebody else, to be received before any other."""
        self.shift = 0
        """Periods that have passed when the bus is opened."""
        self.watchdog: float | None = WATCHDOG
        self.before_send: Callable[[Frame], object] = lambda _frame: None

    def edit(self, old: str, new: str) -> None:
        """Change the mapping file or its DBC."""
        files = [path for path in (self.file, self.file.with_suffix(".dbc")) if old in path.read_text()]
        assert files
        for path in files:
            path.write_text(path.read_text().replace(old, new))

    @property
    def mapping(self) -> Mapping:
        return load_mapping(self.file)

    def open(self, _iface: str, bench: Bench, _identifiers: object = None) -> tuple[Transport, SteppedClock]:
        bus, clock = open_sim_drive(self.name, bench)
        self.bus, self.drive, self.clock = bus, bus.drive, clock
        self.drive.periods, self.drive.watchdog = self.shift, self.watchdog
        self._wrap(bus)
        self.transport = LockStepDrive(self.mapping, bench, bus, clock, f"map:{self.file}@sim-drive")
        return self.transport, clock

    def _wrap(self, bus: SimDriveTransport) -> None:
        receive, send = bus.receive, bus.send

        def received(deadline_ns: int) -> Frame | None:
            if self.at is not None and hasattr(self, "transport") and self.transport.node.answers.obeyed >= self.at[0]:
                action, self.at = self.at[1], None
                action(self.drive)
            if self.injected:
                return self.injected.pop(0)._replace(time_ns=self.clock.now_ns(), own=False)
            frame = receive(deadline_ns)
            return frame if frame is None or frame.own else self.change(frame)

        def sent(frame: Frame) -> None:
            self.before_send(frame)
            self.sent.append(frame)
            send(frame)

        bus.receive, bus.send = received, sent  # type: ignore[method-assign]


def rests_below(bus: MappedBus, speed: float) -> None:
    """The true brake, which goes on without a commander, is let go, inside its travel and never faster than that."""
    for _ in range(600):
        bus.drive.tick()
    low, high = bus.bench.limits.angle
    assert low <= bus.drive.angle_range[0]
    assert bus.drive.angle_range[1] <= high
    assert bus.drive.top_speed <= speed
    assert not bus.drive.armed


def within_limits(bus: MappedBus) -> None:
    """That, at the bench's limits."""
    rests_below(bus, bus.bench.limits.velocity)


def runner(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, current: float = 6.0
) -> tuple[MappedBus, EmbRun]:
    """``emb-run`` with a mapped drive and an actor of constant current."""
    text = late_bench(polled=name == "mit")
    bus = MappedBus(name, text, tmp_path)
    for module in ("experiment", "main"):
        monkeypatch.setattr(f"emb_runtime.cli.{module}.open_transport", bus.open)
    actor, bench = tmp_path / "actor.onnx", tmp_path / "late.toml"
    actor.write_bytes(constant_actor(bus.bench, current))
    bench.write_text(text)
    arguments = ("--iface", f"map:{bus.file}@sim-drive", "--policy", str(actor), "--bench", str(bench))
    return bus, EmbRun(arguments, capsys, tmp_path / "run.mcap")
