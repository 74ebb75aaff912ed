"""A mapped drive on a simulated bus in lock-step, as a test breaks it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from emb_runtime.config.bench import Bench, parse_bench, shipped_bench_text
from emb_runtime.drives.bench_fit import require_fit
from emb_runtime.drives.mapping_file import parse_mapping
from emb_runtime.drives.transport import InProcessDrive
from emb_runtime.records import Frame
from emb_runtime.system.clock import SteppedClock
from simulated_drives import SimDriveTransport, SimulatedDrive, open_sim_drive
from tests.actors import constant_actor
from tests.drives import EXAMPLES
from tests.runtime.operating import EmbRun

Change = Callable[[Frame], Frame | None]


def late_bench(polled: bool = False) -> str:
    """The shipped bench file with the age of frames that a mapped drive has."""
    age = "[1, 1]" if polled else "[0, 1]"
    text = shipped_bench_text().replace("frame_age     = [0, 0]", f"frame_age     = {age}")
    return text + "\n[plants.late-command]\ncommand_delay = 1\n"


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
    (
        'default = "none"',
        'Axis0_Get_Iq = {kind = "sum", checksum = "Sum", counter = "Count", modulus = 15, start = 3}',
    ),
)


def protected(count: int, time_ns: int, current: float = 0.5, off: int = 0) -> Frame:
    """The current of that drive."""
    rest = struct.pack("<Bf", count, current)
    return Frame(0x014, bytes(((sum(rest) + 3 + off) & 0xFF,)) + rest, time_ns)


class MappedBus:
    """The bus that ``emb-run`` opens, with the drive on it.

    ``change`` makes of each frame of the drive what is received, or None; ``edit`` changes the mapping's texts.
    """

    def __init__(self, name: str, bench_text: str) -> None:
        self.name = name
        self.bench = parse_bench(bench_text, "bench.toml")
        self.change: Change = lambda frame: frame
        self.at: tuple[int, Callable[[SimulatedDrive], object]] | None = None
        self.edits: list[tuple[str, str]] = []
        self.sent: list[Frame] = []
        self.shift = 0
        """Periods that have passed when the bus is opened."""
        self.before_send: Callable[[Frame], object] = lambda _frame: None

    def open(self, _iface: str, bench: Bench, _identifiers: object = None) -> tuple[InProcessDrive, SteppedClock]:
        texts = [(EXAMPLES / f"{self.name}.{kind}").read_text() for kind in ("toml", "dbc")]
        for old, new in self.edits:
            assert any(old in text for text in texts)
            texts = [text.replace(old, new) for text in texts]
        mapping = parse_mapping(texts[0], texts[1], f"{self.name}.toml")
        require_fit(mapping, bench)
        bus, clock = open_sim_drive(self.name, bench)
        self.bus, self.drive = bus, bus.drive
        self.drive.periods = self.shift
        self._wrap(bus)
        self.transport = InProcessDrive(mapping, bench, bus, clock, f"map:{self.name}.toml@sim-drive")
        return self.transport, clock

    def _wrap(self, bus: SimDriveTransport) -> None:
        receive, send = bus.receive, bus.send

        def received(deadline_ns: int) -> Frame | None:
            if self.at is not None and self.transport.node.counts.obeyed >= self.at[0]:
                action, self.at = self.at[1], None
                action(self.drive)
            frame = receive(deadline_ns)
            return frame if frame is None or frame.own else self.change(frame)

        def sent(frame: Frame) -> None:
            self.before_send(frame)
            self.sent.append(frame)
            send(frame)

        bus.receive, bus.send = received, sent  # type: ignore[method-assign]


def runner(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, current: float = 6.0
) -> tuple[MappedBus, EmbRun]:
    """``emb-run`` with a mapped drive and an actor of constant current; recorder and trial of the actor run here."""
    for module in ("log.recorder", "log.ring_buffer", "policy.trial"):
        monkeypatch.setattr(f"emb_runtime.{module}.HAS_CHILD_PROCESSES", False)
    text = late_bench(polled=name == "mit")
    bus = MappedBus(name, text)
    for module in ("repeat", "main"):
        monkeypatch.setattr(f"emb_runtime.cli.{module}.open_transport", bus.open)
    actor, bench = tmp_path / "actor.onnx", tmp_path / "late.toml"
    actor.write_bytes(constant_actor(bus.bench, current))
    bench.write_text(text)
    arguments = ("--iface", f"map:{name}.toml@sim-drive", "--policy", str(actor), "--bench", str(bench))
    return bus, EmbRun(arguments, capsys, tmp_path / "run.mcap")
