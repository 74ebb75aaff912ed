"""The mapping file: a drive's own DBC, and what its signals are to a brake, read, checked, and made a :class:`Mapping`.

What a drive cannot give is derived here from what the file names, and must be accepted by name in the file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping as Dictionary
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emb_runtime.can.codec import parse
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import LONGEST_NODE_WATCHDOG
from emb_runtime.config.toml_text import MAX_TOML_BYTES, parse_toml
from emb_runtime.config.validation import Rules, Table, shown
from emb_runtime.drives.mapping import (
    PROPERTIES,
    Commanded,
    ConstantFrame,
    Mapping,
    MappingError,
    Measured,
    MessageInfo,
    State,
    Step,
)
from emb_runtime.drives.protection import DATA_IDS, KINDS, MODULI, Protection
from emb_runtime.drives.signals import Field, make_field
from emb_runtime.errors import FrameError
from emb_runtime.system.input_file import read_text

if TYPE_CHECKING:
    from cantools.database.can import Database
    from cantools.database.can import Message as DbcMessage

SCHEMA = 1
MAX_DBC_BYTES = 4 << 20
MOST_STEPS = 16  # Steps of a sequence, and frames of a step
LONGEST_WAIT = 5.0  # Longest wait for a state [s]

ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi}
VELOCITY_UNITS = {
    "rad/s": 1.0,
    "deg/s": math.pi / 180.0,
    "rev/s": 2.0 * math.pi,
    "rpm": 2.0 * math.pi / 60.0,
}
CURRENT_UNITS = {"A": 1.0, "mA": 1e-3}
TORQUE_UNITS = ("Nm", "per_mille")  # Units of a command or report that is no current: ``per_ampere`` of them make one


def load_mapping(path: str | Path) -> Mapping:
    """Read a mapping file and its DBC, which lies beside it.

    Raises:
        MappingError: a file cannot be read, or is refused; the message has the file, the key and the reason.
    """
    text = _read(path, MAX_TOML_BYTES)
    dbc = Table(str(path), "", _parsed(text, str(path)), _RULES).table("can").text("dbc")
    return parse_mapping(text, _read(Path(path).parent / dbc, MAX_DBC_BYTES), str(path))


def parse_mapping(text: str, dbc_text: str, source: str) -> Mapping:
    """Turn the texts of a mapping file and its DBC into checked records.

    Raises:
        MappingError: see :func:`load_mapping`.
    """
    top = Table(source, "", _parsed(text, source), _RULES)
    top.schema(SCHEMA)
    name = top.text("name")
    can = top.table("can")
    can.text("dbc")
    try:
        database = parse(dbc_text)
    except FrameError as err:
        raise MappingError(f"{source}: can.dbc: {_one_line(err)}") from err
    reader = _Reader(source, database, can.table("protection") if "protection" in can.names() else None)
    signals = can.table("signals")
    command = reader.command(signals)
    angle = reader.measured(signals, "angle", ANGLE_UNITS)
    if "velocity" not in signals.names():
        raise signals.fail(
            "velocity",
            "missing: the shield stops the brake by it, and none is made from the angle; use a gateway that does",
        )
    velocity = reader.measured(signals, "velocity", VELOCITY_UNITS)
    current = reader.measured(signals, "current", CURRENT_UNITS) if "current" in signals.names() else None
    state = reader.state(signals) if "state" in signals.names() else None
    signals.nothing_else(("current", "state"))
    arm, disarm = (reader.sequence(can, key, command, state) for key in ("arm", "disarm"))
    polled = can.text("exchange", ("broadcast", "poll")) == "poll"
    pair_within = can.number("pair_within", lambda v: 0 < v <= 0.1, "a time in (0, 0.1] s")
    can.nothing_else(("protection", "arm", "disarm"))
    reader.no_other_protection()
    node = top.table("node")
    watchdog = _watchdog(node)
    end_stop_speed = node.number(
        "end_stop_speed", _positive, "the speed into an end stop that the brake bears, in rad/s"
    )
    relative = command.field.name if _is_torque(signals.table("command")) else ""
    lost = _lost(reader, angle, velocity, current, command, state, relative)
    _accepted(node, lost)
    node.nothing_else()
    top.nothing_else()
    return Mapping(
        name=name,
        polled=polled,
        pair_within=pair_within,
        messages=reader.used,
        angle=angle,
        velocity=velocity,
        current=current,
        command=command,
        state=state,
        arm=arm,
        disarm=disarm,
        watchdog=watchdog,
        end_stop_speed=end_stop_speed,
        lost=lost,
        text=text,
        dbc_text=dbc_text,
        database=database,
    )


_RULES = Rules(MappingError, 200)


class _Reader:
    """Reads what refers to the DBC, and keeps the messages that are used."""

    def __init__(self, source: str, database: Database, protection: Table | None) -> None:
        self._source = source
        self._database = database
        self._protection = protection
        self._default = "none"
        if protection is not None and "default" in protection.names():
            self._default = protection.text("default", ("none",))
        self.used: dict[str, MessageInfo] = {}

    def measured(self, signals: Table, key: str, units: Dictionary[str, float]) -> Measured:
        table = signals.table(key)
        message, field = self._signal(table)
        factor, offset = self._scale(table, units, torque=key == "current"), _optional(table, "offset", 0.0)
        low, high = self._range(table)
        wrap = _optional(table, "wrap", 0.0, _positive, "a positive number")
        if wrap and key != "angle":
            raise table.fail("wrap", "only an angle begins anew")
        table.nothing_else()
        return Measured(message.name, field, factor, offset, low, high, wrap)

    def command(self, signals: Table) -> Commanded:
        table = signals.table("command")
        message, field = self._signal(table)
        factor = 1.0 / self._scale(table, CURRENT_UNITS, torque=True)
        low, high = self._range(table)
        if not low <= 0.0 <= high:
            raise table.fail("range", f"0 must lie inside, got {low:g} to {high:g}")
        others: dict[str, float] = {}
        if "others" in table.names():
            given = table.table("others")
            others = {name: given.number(name) for name in given.names()}
        table.nothing_else(("others",))
        info = self.used[message.name]
        protected = {f.name for f in (info.protection.checksum, info.protection.counter) if f is not None}
        needed = set(info.fields) - {field.name} - protected
        if set(others) != needed:
            raise table.fail("others", f"expected a value for {_names(needed)}, got {_names(others)}")
        return Commanded(message.name, field, factor, low, high, others)

    def state(self, signals: Table) -> State:
        table = signals.table("state")
        message, field = self._signal(table)
        if field.is_float:
            raise table.fail("signal", "expected a signal of whole numbers")
        idle, active = (_integers(table, key) for key in ("idle", "active"))
        if set(idle) & set(active):
            raise table.fail("active", "a value cannot be both idle and active")
        timeout = table.number("timeout", lambda v: 0 < v <= LONGEST_WAIT, f"a time in (0, {LONGEST_WAIT:g}] s")
        error = None
        if "error" in table.names():
            error = self.used[message.name].fields.get(table.text("error"))
            if error is None:
                raise table.fail("error", f"no such signal in {message.name}")
        table.nothing_else(("error",))
        return State(message.name, field, idle, active, timeout, error)

    def sequence(self, can: Table, key: str, command: Commanded, state: State | None) -> tuple[Step, ...]:
        if key not in can.names():
            return ()
        return tuple(self._step(table, command, state) for table in can.tables(key, 1, MOST_STEPS))

    def _step(self, table: Table, command: Commanded, state: State | None) -> Step:
        send = table.table("send")
        if len(send.names()) > MOST_STEPS:
            raise table.fail("send", f"expected at most {MOST_STEPS} frames")
        frames = tuple(self._constant(send, name, command) for name in send.names())
        waits, timeout = "", 0.0
        if "wait" in table.names():
            wait = table.table("wait")
            if "state" in wait.names():
                waits = wait.text("state", ("idle", "active"))
                if state is None:
                    raise wait.fail("state", "this file names no state to wait for")
            timeout = wait.number("timeout", lambda v: 0 < v <= LONGEST_WAIT, f"a time in (0, {LONGEST_WAIT:g}] s")
            wait.nothing_else(("state",))
        table.nothing_else(("wait",))
        return Step(frames, waits, timeout)

    def _constant(self, send: Table, name: str, command: Commanded) -> ConstantFrame:
        message = self._message(send, name, name)
        if isinstance(send.get(name), str):
            try:
                data = bytes.fromhex(send.text(name))
            except ValueError:
                raise send.fail(name, "expected signals, or bytes in hexadecimal") from None
            if len(data) != message.length:
                raise send.fail(name, f"expected {message.length} bytes, got {len(data)}")
            return ConstantFrame(name, data, None)
        table = send.table(name)
        values = {key: table.number(key) for key in table.names()}
        if self.used[name].protection.kind != "none":
            raise send.fail(name, "a protected message cannot be part of a sequence")
        if name == command.message and values.get(command.field.name) != 0.0:
            raise send.fail(name, "a sequence commands no current: give 0, or the bytes that the drive's maker gives")
        try:
            data = message.encode(values, padding=False, strict=True)
        except Exception as err:  # what cantools raises for values that do not fit is of several kinds
            raise send.fail(name, f"does not fit the DBC: {_one_line(err)}") from err
        return ConstantFrame(name, bytes(data), values)

    def no_other_protection(self) -> None:
        if self._protection is not None:
            self._protection.nothing_else(("default",))

    def _message(self, table: Table, key: str, name: str) -> DbcMessage:
        try:
            message = self._database.get_message_by_name(name)
        except KeyError:
            raise table.fail(key, f"the DBC has no message {shown(name)}") from None
        if name in self.used:
            return message
        if message.is_fd or message.length > 8 or message.is_multiplexed():
            raise table.fail(key, f"{name}: expected a classical frame without multiplexed signals; use a gateway")
        ours = {m.identifier for m in load_layout().messages.values()}
        if not message.is_extended_frame and message.frame_id in ours:
            raise table.fail(
                key, f"{name} has the identifier {message.frame_id:#05x} of a message of ours: give the drive another"
            )
        fields = {s.name: make_field(s) for s in message.signals}
        for field in fields.values():
            if field.is_float and field.length not in (16, 32, 64):
                raise table.fail(key, f"{name}.{field.name}: expected a float of 16, 32 or 64 bits")
            if not math.isfinite(field.scale) or field.scale == 0.0 or not math.isfinite(field.offset):
                raise table.fail(key, f"{name}.{field.name}: expected a scale that is finite and not 0")
        self.used[name] = MessageInfo(
            name=name,
            identifier=message.frame_id,
            extended=message.is_extended_frame,
            length=message.length,
            fields=fields,
            protection=self._protection_of(name, fields),
        )
        return message

    def _signal(self, table: Table) -> tuple[DbcMessage, Field]:
        text = table.text("signal")
        message_name, dot, name = text.partition(".")
        if not dot:
            raise table.fail("signal", f"expected MESSAGE.SIGNAL, got {shown(text)}")
        message = self._message(table, "signal", message_name)
        field = self.used[message_name].fields.get(name)
        if field is None:
            known = _names(self.used[message_name].fields)
            raise table.fail("signal", f"{message_name} has no signal {shown(name)}; it has {known}")
        return message, field

    def _scale(self, table: Table, units: Dictionary[str, float], torque: bool) -> float:
        """SI units per DBC unit."""
        unit = table.text("unit", (*units, *TORQUE_UNITS) if torque else tuple(units))
        sign = table.get("sign", "1 or -1")
        if isinstance(sign, bool) or sign not in (1, -1):
            raise table.fail("sign", f"expected 1 or -1, got {shown(sign)}")
        scale = _optional(table, "scale", 1.0, _positive, "a positive number")
        if unit in TORQUE_UNITS:
            return float(sign) * scale / table.number("per_ampere", _positive, f"a positive number of {unit}")
        return float(sign) * scale * units[unit]

    def _range(self, table: Table) -> tuple[float, float]:
        low, high = table.number_pair("range")
        if low == high:
            raise table.fail("range", "expected two different values")
        return low, high

    def _protection_of(self, name: str, fields: Dictionary[str, Field]) -> Protection:
        if self._protection is None or name not in self._protection.names():
            return Protection(self._default)
        table = self._protection.table(name)
        kind = table.text("kind", KINDS)
        checksum, counter = (_field_of(table, key, fields) for key in ("checksum", "counter"))
        modulus = MODULI.get(kind, 0)
        if counter is not None and not modulus:
            most = 1 << min(counter.length, 16)
            modulus = table.integer("modulus", 2, most) if "modulus" in table.names() else most
        data_ids: tuple[int, ...] = ()
        if kind in DATA_IDS:
            count = DATA_IDS[kind]
            highest = 0xFF if kind == "profile2" else 0xFFFF
            data_ids = tuple(int(v) for v in table.numbers("data_ids", count, count))
            if any(not 0 <= v <= highest for v in data_ids):
                raise table.fail("data_ids", f"expected whole numbers from 0 to {highest}")
        start = table.integer("start", 0, 255) if "start" in table.names() else 0
        table.nothing_else(("checksum", "counter", "modulus", "data_ids", "start"))
        _check_protection(table, kind, checksum, counter, modulus)
        return Protection(kind, checksum, counter, modulus if counter is not None else 0, data_ids, start)


def _check_protection(table: Table, kind: str, checksum: Field | None, counter: Field | None, modulus: int) -> None:
    if kind != "none":
        bits = 16 if kind == "profile5" else 8
        if checksum is None:
            raise table.fail("checksum", "missing: expected the name of a signal; add it")
        whole = sorted(checksum.positions) == list(range(min(checksum.positions), min(checksum.positions) + bits))
        if checksum.length != bits or not whole or min(checksum.positions) % 8 or checksum.signed or checksum.is_float:
            raise table.fail("checksum", f"expected an unsigned signal of {bits} bits that begins with a byte")
    if kind in MODULI and counter is None:
        raise table.fail("counter", "missing: expected the name of a signal; add it")
    if counter is not None and (counter.is_float or counter.signed or modulus > 1 << counter.length):
        raise table.fail("counter", f"expected an unsigned signal that counts to {modulus}")


def _field_of(table: Table, key: str, fields: Dictionary[str, Field]) -> Field | None:
    if key not in table.names():
        return None
    name = table.text(key)
    if name not in fields:
        raise table.fail(key, f"no such signal; the message has {_names(fields)}")
    return fields[name]


def _watchdog(node: Table) -> float:
    """The drive's own time-out [s]: a drive without one is refused, whatever is accepted."""
    node.text("on_loss", ("hold",))
    node.text("stop", ("freewheel",))
    if "watchdog" not in node.names():
        raise node.fail(
            "watchdog", "missing: a drive that never lets go by itself is not commanded, and no key accepts it"
        )
    most = LONGEST_NODE_WATCHDOG
    return node.number("watchdog", lambda v: 0 < v <= most, f"the drive's own time-out, in (0, {most:g}] s")


def _lost(
    reader: _Reader,
    angle: Measured,
    velocity: Measured,
    current: Measured | None,
    command: Commanded,
    state: State | None,
    relative: str,
) -> tuple[str, ...]:
    """Names of the properties that the drive lacks, in the order of :data:`PROPERTIES`."""
    sensors = [reader.used[measured.message].protection for measured in (angle, velocity)]
    absent = {"no_answers", "no_echo", "no_device_time", "no_identity", "hold_on_loss"}
    absent |= {"no_counter"} if any(p.counter is None for p in sensors) else set()
    absent |= {"no_crc"} if any(p.checksum is None for p in sensors) else set()
    absent |= {"no_command_crc"} if reader.used[command.message].protection.checksum is None else set()
    absent |= {"no_current"} if current is None else set()
    absent |= {"no_state"} if state is None else set()
    absent |= {"relative_k_m"} if relative else set()
    return tuple(name for name in PROPERTIES if name in absent)


def _accepted(node: Table, lost: tuple[str, ...]) -> None:
    """Refuse a file that does not accept exactly what the drive lacks."""
    given = node.get("accept", "a list of names")
    if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
        raise node.fail("accept", f"expected a list of names, got {shown(given)}")
    if missing := [name for name in lost if name not in given]:
        more = f"; nor are {', '.join(missing[1:])}" if missing[1:] else ""
        raise node.fail("accept", f"'{missing[0]}' is not accepted: {PROPERTIES[missing[0]]}{more}")
    if surplus := [name for name in given if name not in lost]:
        raise node.fail("accept", f"{shown(surplus[0])} is nothing that this drive lacks")


def _is_torque(command: Table) -> bool:
    return command.get("unit") in TORQUE_UNITS


def _optional(
    table: Table, key: str, absent: float, check: Any = lambda _value: True, wanted: str = "a number"
) -> float:
    return table.number(key, check, wanted) if key in table.names() else absent


def _positive(value: float) -> bool:
    return value > 0.0


def _integers(table: Table, key: str) -> tuple[int, ...]:
    values = table.numbers(key, 1, 16)
    if any(not value.is_integer() for value in map(float, values)):
        raise table.fail(key, "expected whole numbers")
    return tuple(int(value) for value in values)


def _names(names: object) -> str:
    assert isinstance(names, set | dict)
    return ", ".join(sorted(names)) or "none"


def _parsed(text: str, source: str) -> dict[str, Any]:
    try:
        return parse_toml(text)
    except ValueError as err:
        raise MappingError(f"{source}: {err}") from err


def _read(path: str | Path, most: int) -> str:
    try:
        return read_text(path, most)
    except (OSError, UnicodeDecodeError) as err:
        reason = err.strerror if isinstance(err, OSError) else "not UTF-8 text"
        raise MappingError(f"{path}: cannot read it: {reason}") from err


def _one_line(err: Exception) -> str:
    return " ".join(str(err).split())
