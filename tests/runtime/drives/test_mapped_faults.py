"""Every fault of a mapped drive, on each simulated drive: how the run ends, and how far the true brake went.

Simulated drives in lock-step. A fault that comes later comes 60 samples into a run of 6 A, at some 480 rad/s.
"""

from __future__ import annotations

import itertools
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from emb_runtime.drives.node import INTRUDED
from emb_runtime.errors import BusError
from emb_runtime.records import Frame
from emb_runtime.safety.end_stop import released_speed
from simulated_drives import SimulatedDrive
from tests.drives import SHIPPED
from tests.runtime.drives.mapped import PROTECTED, Change, MappedBus, protected, rests_below, runner, within_limits

pytestmark = pytest.mark.usefixtures("handlers", "one_process")
Break = Callable[[MappedBus], object]


def edited(*edits: tuple[str, str]) -> Break:
    def edit(bus: MappedBus) -> None:
        for old, new in edits:
            bus.edit(old, new)

    return edit


def later(change: Change) -> Break:
    return lambda bus: setattr(bus, "at", (60, lambda _drive: setattr(bus, "change", change)))


def disarmed(drive: SimulatedDrive) -> None:
    """Its own doing: it lets go, and obeys nobody until it is armed anew."""
    drive.timed_out()
    drive.take = lambda _frame: None  # type: ignore[assignment, method-assign]


def lost_arming(bus: MappedBus) -> None:
    bus.at = 60, SimulatedDrive.timed_out if bus.name != "vesc" else disarmed


def frozen(bus: MappedBus) -> None:
    kept: dict[int, bytes] = {}
    later(lambda frame: frame._replace(data=kept.setdefault(frame.identifier, frame.data)))(bus)


def interface_down(bus: MappedBus) -> None:
    def down(_frame: Frame) -> Frame | None:
        raise BusError("vcan0: the interface is down")

    def go_down(_drive: SimulatedDrive) -> None:
        bus.change = bus.before_send = down

    bus.at = 60, go_down


def inject(bus: MappedBus, frame: Frame) -> None:
    """Put a frame of a stranger on the drive's bus."""
    bus.drive.receive(frame)
    bus.injected.append(frame)


def repeated(bus: MappedBus) -> None:
    """A stranger sends our latest command once more: 6 A."""
    bus.at = 60, lambda _drive: inject(bus, bus.sent[-1])


def fought_over(bus: MappedBus) -> None:
    """A stranger sends that command after each of ours, for half a second."""

    def fight(_drive: SimulatedDrive) -> None:
        kept, send, left = bus.sent[-1], bus.bus.send, itertools.count()

        def sent(frame: Frame) -> None:
            send(frame)
            if next(left) < 500:
                inject(bus, kept)

        bus.bus.send = sent  # type: ignore[method-assign]
        inject(bus, kept)

    bus.at = 60, fight


def replaced(identifier: int, of: Callable[[bytes], bytes]) -> Break:
    return later(lambda frame: frame._replace(data=of(frame.data)) if frame.identifier == identifier else frame)


# --- lines of the shipped mapping files ------------------------------------------------------------------------------

ANGLE = {
    "odrive": 'unit = "rev", sign = 1, range = [-2, 17]',
    "vesc": 'unit = "deg", sign = 1, range = [0, 360], wrap = 360',
    "mit": 'unit = "rad", sign = 1, scale = 9, range = [-1.2, 11.3]',
}
VELOCITY = {
    "odrive": 'unit = "rev/s", sign = 1, range = [-90, 90]',
    "vesc": 'unit = "rpm", sign = 1, scale = 0.14285714285714285, range = [-40000, 40000]',
    "mit": 'unit = "rad/s", sign = 1, scale = 9, range = [-60, 60]',
}
COMMAND = {
    "odrive": 'unit = "Nm", sign = 1, per_ampere = 0.0217, range = [-0.1303, 0.1303]',
    "vesc": 'unit = "A", sign = 1, range = [-6.001, 6.001]',
    "mit": 'unit = "Nm", sign = 1, per_ampere = 0.1953, range = [-1.18, 1.18]',
}
DOUBLED = {
    "odrive": 'unit = "Nm", sign = 1, per_ampere = 0.0434, range = [-0.2606, 0.2606]',
    "vesc": 'unit = "mA", sign = 1, scale = 500, range = [-12.002, 12.002]',
    "mit": 'unit = "Nm", sign = 1, per_ampere = 0.3906, range = [-2.36, 2.36]',
}
OTHER_ANGLE = {
    "odrive": 'unit = "rad", sign = 1, range = [-12, 110]',
    "vesc": 'unit = "rad", sign = 1, range = [0, 360], wrap = 360',
    "mit": 'unit = "rev", sign = 1, scale = 9, range = [-1.2, 11.3]',
}
OTHER_VELOCITY = {
    "odrive": 'unit = "rad/s", sign = 1, range = [-510, 510]',
    "vesc": 'unit = "rpm", sign = 1, scale = 1, range = [-40000, 40000]',
    "mit": 'unit = "rev/s", sign = 1, scale = 9, range = [-60, 60]',
}
OTHER_SENSORS = {
    "odrive": (("BO_ 9 ", "BO_ 41 "), ("_ 9 Pos", "_ 41 Pos"), ("_ 9 Vel", "_ 41 Vel")),
    "vesc": (("BO_ 2147485957 ", "BO_ 2147485958 "),),
    "mit": (("BO_ 2 ", "BO_ 3 "),),
}
OUT_OF_RANGE = {
    "odrive": replaced(0x009, lambda data: struct.pack("<f", 17.5) + data[4:]),
    "vesc": replaced(16 << 8 | 5, lambda data: data[:6] + struct.pack(">h", 400 * 50)),
    "mit": replaced(2, lambda data: data[:1] + b"\xff\xff" + data[3:]),
}

OTHER_COMMAND = {
    "odrive": (("BO_ 14 ", "BO_ 13 "), ("_ 14 Input_Torque", "_ 13 Input_Torque")),
    "vesc": (("BO_ 2147483909 ", "BO_ 2147483908 "),),
}


def backward(line: str) -> str:
    """The line with the other sign; a range follows, where it is not that of one turn."""
    line = line.replace("sign = 1", "sign = -1")
    return line.replace("[-2, 17]", "[-17, 2]").replace("[-1.2, 11.3]", "[-11.3, 1.2]")


CONTRADICT = "angle and velocity contradict each other"


class Fault(NamedTuple):
    """A fault, and the end that a run comes to with each drive."""

    breaks: Callable[[str], Break]  # By the drive's name
    results: tuple[str, str, str]  # With ODrive, VESC, MIT
    says: tuple[str, str, str] = ("", "", "")
    """Part of the node's reason for giving the drive up; empty where it did not."""
    code: int = 3
    lets_go: bool = False
    """Nobody can brake any more: below the bound that the pre-flight states, not within the limits."""


FAULTS = {
    "silent": Fault(
        lambda _: later(lambda _frame: None), ("SENSOR_LOST",) * 3, ("silent for 3 periods",) * 3, lets_go=True
    ),
    "out of range": Fault(OUT_OF_RANGE.__getitem__, ("SENSOR_LOST",) * 3, ("silent for 3 periods",) * 3, lets_go=True),
    "interface down": Fault(lambda _: interface_down, ("BUS_LOST",) * 3, code=4, lets_go=True),
    "frozen": Fault(
        # A polled drive that is given up is not asked any more.
        lambda _: frozen,
        ("FRAMES_REJECTED", "FRAMES_REJECTED", "SENSOR_LOST"),
        (CONTRADICT,) * 3,
    ),
    "arming lost": Fault(lambda _: lost_arming, ("CURRENT_MISMATCH",) * 3),
    "motor of the wrong sign": Fault(
        lambda drive: edited((COMMAND[drive], backward(COMMAND[drive]))), ("WRONG_POLARITY",) * 3
    ),
    "sensors of the wrong sign": Fault(
        lambda drive: edited(*((lines[drive], backward(lines[drive])) for lines in (ANGLE, VELOCITY))),
        ("WRONG_POLARITY",) * 3,
    ),
    "velocity of the wrong sign": Fault(
        lambda drive: edited((VELOCITY[drive], backward(VELOCITY[drive]))), ("WRONG_POLARITY",) * 3
    ),
    "angle in another unit": Fault(
        lambda drive: edited((ANGLE[drive], OTHER_ANGLE[drive])),
        ("SENSORS_CONTRADICT", "NODE_NOT_READY", "SENSOR_LOST"),
        ("", CONTRADICT, CONTRADICT),
    ),
    "velocity in another unit": Fault(
        lambda drive: edited((VELOCITY[drive], OTHER_VELOCITY[drive])),
        ("SENSORS_CONTRADICT", "MOTION_OUTSIDE_SET", "MOTION_OUTSIDE_SET"),
        ("", CONTRADICT, ""),
    ),
    "both in another unit": Fault(
        lambda drive: edited((ANGLE[drive], OTHER_ANGLE[drive]), (VELOCITY[drive], OTHER_VELOCITY[drive])),
        ("MOTION_OUTSIDE_SET", "NODE_NOT_READY", "MOTION_OUTSIDE_SET"),
        ("", CONTRADICT, ""),
    ),
    "a command of another node": Fault(lambda _: repeated, ("FOREIGN_COMMAND",) * 3, (INTRUDED,) * 3),
    "commands of another node": Fault(lambda _: fought_over, ("FOREIGN_COMMAND",) * 3, (INTRUDED,) * 3),
    "current doubled": Fault(lambda drive: edited((COMMAND[drive], DOUBLED[drive])), ("MOTION_OUTSIDE_SET",) * 3),
}


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_ends_the_run_with_its_name_and_the_brake_where_it_may_be(
    fault: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, emb_run = runner(name, tmp_path, capsys, monkeypatch)
    expected, drive = FAULTS[fault], SHIPPED.index(name)
    expected.breaks(name)(bus)
    document: dict[str, Any] = emb_run.document(code=expected.code)
    assert document["result"] == expected.results[drive]
    assert expected.says[drive] in bus.transport.node.failure
    if expected.says[drive]:
        assert not bus.drive.armed
    if expected.lets_go:
        rests_below(bus, released_speed(bus.bench, bus.mapping.longest_hold(bus.bench.timing.sample_time)))
    else:
        within_limits(bus)


@pytest.mark.parametrize(("factor", "current"), [(-4.0, 6.0), (1.3, -6.0), (1.6, -6.0), (6.283, 6.0)])
@pytest.mark.parametrize("name", SHIPPED)
def test_a_velocity_with_a_wrong_factor_ends_the_run_with_the_brake_within_its_limits(
    name: str,
    factor: float,
    current: float,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus, emb_run = runner(name, tmp_path, capsys, monkeypatch, current)
    line = VELOCITY[name]
    unit, said = line.split(", ")[0], line[line.index("range") :]
    given = re.search(r"scale = (\S+),", line)
    scale = factor * (float(given[1]) if given else 1.0)
    bus.edit(line, f"{unit}, sign = {math.copysign(1.0, scale):g}, scale = {abs(scale)}, {said}")
    emb_run.document(code=3)
    within_limits(bus)


@pytest.mark.parametrize("name", OTHER_COMMAND)
def test_a_command_that_the_drive_does_not_hear_ends_the_run_at_rest(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, emb_run = runner(name, tmp_path, capsys, monkeypatch)
    for edit in OTHER_COMMAND[name]:
        bus.edit(*edit)
    assert emb_run.document(code=3)["result"] == "CURRENT_MISMATCH"
    rests_below(bus, 0.0)


@pytest.mark.parametrize(("step", "code"), [(1, 0), (2, 4)])
def test_a_drive_whose_counter_skips_every_other_frame_is_not_armed(
    step: int, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, emb_run = runner("odrive", tmp_path, capsys, monkeypatch, current=2.0)
    for edit in PROTECTED:
        bus.edit(*edit)
    count = itertools.count(0, step)

    def protect(frame: Frame) -> Frame:
        if frame.identifier != 0x014:
            return frame
        return protected(next(count) % 15, frame.time_ns, struct.unpack("<f", frame.data[4:])[0])

    bus.change = protect
    printed, told = emb_run.streams(code=code)
    assert ("frames of Axis0_Get_Iq are missing" in told) == bool(code)
    assert printed.startswith("done") == (not code)


def test_a_drive_that_is_not_heard_or_never_says_its_state_is_not_armed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("odrive", "vesc", "mit", "silent"):
        folder = tmp_path / name
        folder.mkdir()
        bus, emb_run = runner(name if name != "silent" else "odrive", folder, capsys, monkeypatch)
        if name == "silent":
            bus.change = lambda frame: None if frame.identifier == 0x001 else frame
        for edit in OTHER_SENSORS.get(name, ()):
            bus.edit(*edit)
        _, told = emb_run.streams(code=4)
        reason = "cannot arm the drive" if name == "silent" else "no samples of the drive"
        assert reason in told or name == "mit"  # which is armed before it is heard, and given up
        rests_below(bus, 0.0)
