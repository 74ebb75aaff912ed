"""The mapping file: a drive's DBC, and what its signals are to a brake, read, checked, and made a :class:`Mapping`.

What a drive cannot give is derived here from what the file names, and must be accepted by name in the file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping as Dictionary
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta, Struct

from emb_runtime.can.codec import parse
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import LONGEST_NODE_WATCHDOG, Bandwidth, Bitrate, Lag, Sensors
from emb_runtime.config.typed import MAX_TOML_BYTES, Positive, excerpt, parse_toml, read
from emb_runtime.drives.dbc import MAX_DBC_BYTES, MessageText, find_messages
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
from emb_runtime.drives.signals import DATA_IDS, MODULI, Field, Protection, make_field, raw_value
from emb_runtime.drives.wire import Encoder
from emb_runtime.drives.wire_guard import WireGuard, WireGuardError
from emb_runtime.errors import FrameError
from emb_runtime.system.input_file import decode, read_bytes

if TYPE_CHECKING:
    from cantools.database.can import Message as DbcMessage

MOST_STEPS = 16  # Steps of a sequence, and frames of a step

UNITS = {
    "rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi,
    "rad/s": 1.0, "deg/s": math.pi / 180.0, "rev/s": 2.0 * math.pi, "rpm": 2.0 * math.pi / 60.0,
    "A": 1.0, "mA": 1e-3, "degC": 1.0, "V": 1.0, "mV": 1e-3,
}  # fmt: skip
"""SI units per unit; of Nm and per_mille ``per_ampere`` make one ampere."""


# --- the file -------------------------------------------------------------------------------------------------------


def _described(description: str) -> Meta:
    return Meta(extra_json_schema={"description": description})


Wait = Annotated[float, Meta(gt=0, le=5)]  # [s]
Byte = Annotated[int, Meta(ge=0, le=255)]
States = Annotated[tuple[int, ...], Meta(min_length=1, max_length=16)]


class _Signal(Struct, kw_only=True):
    signal: str
    sign: Literal[1, -1]  # +1 if it grows as the brake tightens
    range: tuple[float, float]  # Values that are believed [DBC units]
    scale: Positive = 1.0


class _Angle(_Signal, kw_only=True):
    unit: Literal["rad", "deg", "rev"]
    offset: float = 0.0
    wrap: Positive | None = None  # Period after which it wraps around [DBC units]


class _Velocity(_Signal, kw_only=True):
    unit: Literal["rad/s", "deg/s", "rev/s", "rpm"]
    offset: float = 0.0
    observer_bandwidth: Bandwidth | None = None
    velocity_lag: Lag | None = None


class _Current(_Signal, kw_only=True):
    unit: Literal["A", "mA", "Nm", "per_mille"]
    offset: float = 0.0
    per_ampere: Positive | None = None


class _Temperature(_Signal, kw_only=True):
    unit: Literal["degC"]
    sign: Literal[1] = 1
    offset: float = 0.0


class _SupplyVoltage(_Signal, kw_only=True):
    unit: Literal["V", "mV"]
    sign: Literal[1] = 1
    offset: float = 0.0


class _Command(_Signal, kw_only=True):
    unit: Literal["A", "mA", "Nm", "per_mille"]
    per_ampere: Positive | None = None
    others: dict[str, float] = {}


class _State(Struct, kw_only=True):
    signal: str
    idle: States
    active: States
    timeout: Wait
    error: str | None = None


class _Signals(Struct, kw_only=True):
    command: _Command
    angle: _Angle
    velocity: Annotated[
        _Velocity,
        _described("the velocity, by which the shield stops the brake; none is made from the angle: use a gateway"),
    ]
    current: _Current | None = None
    state: _State | None = None
    temperature: _Temperature | None = None
    supply_voltage: _SupplyVoltage | None = None


class _Wait(Struct, kw_only=True):
    timeout: Wait
    state: Literal["idle", "active"] | None = None


class _Step(Struct, kw_only=True):
    send: Annotated[dict[str, str | dict[str, float]], Meta(max_length=MOST_STEPS)]
    wait: _Wait | None = None


class _Protection(Struct, kw_only=True):
    kind: Literal["none", "profile1", "profile2", "profile5", "xor", "sum"]
    checksum: str | None = None
    counter: str | None = None
    modulus: Annotated[int, Meta(ge=2, le=1 << 16)] | None = None
    data_ids: tuple[Annotated[int, Meta(ge=0, le=0xFFFF)], ...] = ()
    start: Byte = 0


Sequence = Annotated[tuple[_Step, ...], Meta(max_length=MOST_STEPS)]


class _Can(Struct, kw_only=True):
    dbc: str
    exchange: Literal["broadcast", "poll"]
    bitrate: Bitrate = 1_000_000  # [bit/s]
    pair_within: Annotated[float, Meta(gt=0, le=0.1)]  # Longest time between the messages of one sample [s]
    signals: _Signals
    arm: Sequence = ()
    disarm: Sequence = ()
    protection: dict[str, Literal["none"] | _Protection] = {}


class _Node(Struct, kw_only=True):
    on_loss: Literal["hold"]
    stop: Literal["freewheel"]
    watchdog: Annotated[
        float,
        Meta(gt=0, le=LONGEST_NODE_WATCHDOG),
        _described(
            f"the drive's time-out, above 0 to {LONGEST_NODE_WATCHDOG:g} s: a drive without one "
            "is not commanded, and no key accepts it"
        ),
    ]
    end_stop_speed: Annotated[Positive, _described("the speed into an end stop that the brake bears, in rad/s")]
    accept: tuple[str, ...]


class _File(Struct, kw_only=True):
    schema: Literal[1]
    name: str
    can: _Can
    node: _Node


def load_mapping(path: str | Path) -> Mapping:
    """Read a mapping file and its DBC, which lies beside it; MappingError has the file, the key and the reason."""
    text = _text(path, MAX_TOML_BYTES, "utf-8-sig")
    file = _file(text, str(path))
    return _made(file, text, _text(Path(path).parent / file.can.dbc, MAX_DBC_BYTES), str(path))


def parse_mapping(text: str, dbc_text: str, source: str) -> Mapping:
    """Turn the texts of a mapping file and its DBC into checked records; raises as :func:`load_mapping`."""
    return _made(_file(text, source), text, dbc_text, source)


def _file(text: str, source: str) -> _File:
    return read(_File, parse_toml(text, source, MappingError), source, MappingError)


def _text(path: str | Path, most: int, encoding: str = "") -> str:
    try:
        return decode(read_bytes(path, most), encoding)
    except (OSError, UnicodeDecodeError) as err:
        reason = err.strerror if isinstance(err, OSError) else f"not text in UTF-8{'' if encoding else ' or cp1252'}"
        raise MappingError(f"{path}: cannot read the file: {reason}") from err


# --- with its DBC ---------------------------------------------------------------------------------------------------


def _made(file: _File, text: str, dbc_text: str, source: str) -> Mapping:
    can, signals = file.can, file.can.signals
    try:
        messages = find_messages(dbc_text)
    except FrameError as err:
        raise MappingError(f"{source}: can.dbc: {err}") from err
    reader = _Reader(source, messages, can.protection)
    command = reader.command(signals.command)
    state = None if signals.state is None else reader.state(signals.state)
    declared = signals.velocity.observer_bandwidth, signals.velocity.velocity_lag
    if None not in declared:
        reason = "does not go with observer_bandwidth: expected one of the two"
        raise reader.error("can.signals.velocity.velocity_lag", reason)
    made = Mapping(
        name=file.name,
        polled=can.exchange == "poll",
        bitrate=can.bitrate,
        pair_within=can.pair_within,
        messages=reader.used,
        angle=reader.measured(signals.angle, "can.signals.angle"),
        velocity=reader.measured(signals.velocity, "can.signals.velocity"),
        sensors=Sensors("sensor" if declared == (None, None) else "observer", *declared),
        current=None if signals.current is None else reader.measured(signals.current, "can.signals.current"),
        conditions={
            name: reader.measured(of, f"can.signals.{name}")
            for name, of in (("temperature", signals.temperature), ("supply_voltage", signals.supply_voltage))
            if of is not None
        },
        command=command,
        state=state,
        arm=tuple(reader.sequence_step(step, f"can.arm[{n}]", command, state) for n, step in enumerate(can.arm)),
        disarm=tuple(
            reader.sequence_step(step, f"can.disarm[{n}]", command, state) for n, step in enumerate(can.disarm)
        ),
        watchdog=file.node.watchdog,
        end_stop_speed=file.node.end_stop_speed,
        text=text,
        dbc_text=dbc_text,
    )
    unused = set(can.protection) - {"default", *(info.dbc.name for info in reader.used.values())}
    if unused:
        raise reader.error(f"can.protection.{min(unused)}", "unknown key: no message of that name is used")
    if missing := [name for name in made.lost if name not in file.node.accept]:
        more = f"; nor are {', '.join(missing[1:])}" if missing[1:] else ""
        raise reader.error("node.accept", f"'{missing[0]}' is not accepted: {PROPERTIES[missing[0]]}{more}")
    if surplus := [name for name in file.node.accept if name not in made.lost]:
        raise reader.error("node.accept", f"{excerpt(surplus[0])} is nothing that this drive lacks")
    _require_carried(reader, made)
    return made


def _require_carried(reader: _Reader, made: Mapping) -> None:
    """Send every frame to nobody, the command with both ends of its range and zero: the DBC must carry them."""
    command = made.command
    ends = command.low / command.factor, command.high / command.factor
    encoder, guard = Encoder(made), WireGuard(made, max(map(abs, ends)), lambda _frame: None)
    for value in (command.low, 0.0, command.high):
        try:
            guard.command(encoder.value(value), value / command.factor)
        except (FrameError, WireGuardError) as err:
            amount = f"{value:g}, {value / command.factor:g} A"
            raise reader.error("can.signals.command", f"the DBC cannot carry {amount}: {err}") from err
    for name, steps in (("arm", made.arm), ("disarm", made.disarm)):
        for number, constant in ((n, frame) for n, step in enumerate(steps) for frame in step.frames):
            try:
                guard.constant(made.messages[constant.message].frame(constant.data), constant)
            except WireGuardError as err:
                message = made.messages[constant.message].dbc.name
                raise reader.error(f"can.{name}[{number}].send.{message}", f"the DBC cannot carry it: {err}") from err


class _Reader:
    """Finds what the file names in the DBC, and keeps the messages that are used."""

    def __init__(
        self, source: str, found: Dictionary[str, MessageText], protection: Dictionary[str, str | _Protection]
    ) -> None:
        self._source, self._found, self._protection = source, found, protection
        self.used: dict[str, MessageInfo] = {}

    def error(self, key: str, reason: str) -> MappingError:
        return MappingError(f"{self._source}: {key}: {reason}")

    def measured(self, of: _Angle | _Velocity | _Current | _Temperature | _SupplyVoltage, key: str) -> Measured:
        info, field = self._signal(of.signal, key)
        wrap = of.wrap or 0.0 if isinstance(of, _Angle) else 0.0
        low, high = self._range(of, key)
        if not (field.carries(low) and field.carries(high)):
            raise self.error(f"{key}.range", f"{of.signal} carries no value beyond {_ends(field)}: narrow the range")
        if high - low < wrap - field.step(high):
            raise self.error(f"{key}.range", f"expected all values of a period of {wrap:g}, got {low:g} to {high:g}")
        return Measured(info.name, field, self._scale(of, key), of.offset, low, high, wrap)

    def command(self, of: _Command) -> Commanded:
        key = "can.signals.command"
        info, field = self._signal(of.signal, key)
        if info.page is None and info.dbc.is_multiplexed():
            raise self.error(f"{key}.signal", f"{of.signal}: expected a signal of one value of the multiplexor")
        low, high = self._range(of, key)
        if not low <= 0.0 <= high:
            raise self.error(f"{key}.range", f"0 must lie inside, got {low:g} to {high:g}")
        protected = {f.name for f in (info.protection.checksum, info.protection.counter) if f is not None}
        needed = set(info.fields) - {field.name} - protected
        if set(of.others) != needed:
            raise self.error(f"{key}.others", f"expected a value for {_names(needed)}, got {_names(set(of.others))}")
        if info.page is not None and of.others[info.page.name] != info.page_value:
            raise self.error(f"{key}.others.{info.page.name}", f"expected {info.page_value}, of {of.signal}")
        is_current = not _is_torque(of.unit)
        return Commanded(info.name, field, 1.0 / self._scale(of, key), low, high, of.others, is_current)

    def state(self, of: _State) -> State:
        key = "can.signals.state"
        info, field = self._signal(of.signal, key)
        if field.is_float:
            raise self.error(f"{key}.signal", "expected a signal of whole numbers")
        if set(of.idle) & set(of.active):
            raise self.error(f"{key}.active", "a value cannot be both idle and active")
        for value in (*of.idle, *of.active):
            if not field.carries(value):
                raise self.error(f"{key}.signal", f"{of.signal} carries {_ends(field)}, and never {value}")
        if of.error is not None and of.error not in info.fields:
            raise self.error(f"{key}.error", f"no such signal in {info.dbc.name}; it has {_names(set(info.fields))}")
        error = None if of.error is None else info.fields[of.error]
        return State(info.name, field, of.idle, of.active, of.timeout, error)

    def sequence_step(self, of: _Step, key: str, command: Commanded, state: State | None) -> Step:
        if of.wait is not None and of.wait.state is not None and state is None:
            raise self.error(f"{key}.wait.state", "this file names no state to wait for")
        frames = tuple(self._constant(name, given, f"{key}.send.{name}", command) for name, given in of.send.items())
        return Step(frames, (of.wait and of.wait.state) or "", of.wait.timeout if of.wait else 0.0)

    def _constant(self, name: str, given: str | dict[str, float], key: str, command: Commanded) -> ConstantFrame:
        message = self._message(name, key)
        if isinstance(given, str):
            try:
                data = bytes.fromhex(given)
            except ValueError:
                raise self.error(key, "expected signals, or bytes in hexadecimal") from None
            if len(data) != message.length:
                raise self.error(key, f"expected {message.length} bytes, got {len(data)}")
            return ConstantFrame(self._info(message, _page_of(message, data), key).name, data, None)
        try:
            data = message.encode(given, padding=False, strict=True)
        except Exception as err:  # of several kinds, by what does not fit
            raise self.error(key, f"does not fit the DBC: {_one_line(err)}") from err
        info = self._info(message, _page_of(message, data), key)
        if info.protection.kind != "none":
            raise self.error(key, "a protected message cannot be part of a sequence")
        if info.name == command.message and given.get(command.field.name) != 0.0:
            raise self.error(key, "a sequence commands no current: give 0, or the bytes that the drive's maker gives")
        return ConstantFrame(info.name, bytes(data), given)

    def _message(self, name: str, key: str) -> DbcMessage:
        if (found := self._found.get(name)) is None:
            raise self.error(key, f"the DBC has no message {excerpt(name)}")
        if found.is_fd or found.length > 8:
            raise self.error(key, f"{name}: expected a classical frame; use a gateway")
        if found.multiplexors > 1 or found.multiplexed:
            raise self.error(key, f"{name}: expected one multiplexor at most; use a gateway")
        try:
            (message,) = parse(found.text).messages
        except (FrameError, ValueError) as err:
            raise self.error(key, f"{name}: {found.fault or _one_line(err)[:200]}") from err
        ours = {m.identifier for m in load_layout().messages.values()}
        if not message.is_extended_frame and message.frame_id in ours:
            raise self.error(
                key, f"{name} has the identifier {message.frame_id:#05x} of a message of ours: give the drive another"
            )
        return message

    def _signal(self, text: str, key: str) -> tuple[MessageInfo, Field]:
        key = f"{key}.signal"
        name, dot, signal = text.partition(".")
        if not dot:
            raise self.error(key, f"expected MESSAGE.SIGNAL, got {excerpt(text)}")
        message = self._message(name, key)
        found = next((one for one in message.signals if one.name == signal), None)
        if found is None:
            names = _names({one.name for one in message.signals})
            raise self.error(key, f"{name} has no signal {excerpt(signal)}; it has {names}")
        pages = found.multiplexer_ids or []
        if len(pages) > 1:
            raise self.error(key, f"{text}: expected a signal of one value of the multiplexor, it is of {len(pages)}")
        info = self._info(message, pages[0] if pages else None, key)
        return info, info.fields[signal]

    def _info(self, message: DbcMessage, page: int | None, key: str) -> MessageInfo:
        """The message, of a multiplexed one what has this value of its multiplexor."""
        name = message.name if page is None else f"{message.name}[{page}]"
        if name in self.used:
            return self.used[name]
        signals = [one for one in message.signals if one.multiplexer_ids is None or page in one.multiplexer_ids]
        fields = {one.name: make_field(one) for one in signals}
        for field in fields.values():
            if field.is_float and field.length not in (16, 32, 64):
                raise self.error(key, f"{message.name}.{field.name}: expected a float of 16, 32 or 64 bits")
            if not math.isfinite(field.scale) or field.scale == 0.0 or not math.isfinite(field.offset):
                raise self.error(key, f"{message.name}.{field.name}: expected a scale that is finite and not 0")
        if page is not None and (fields[_switch(message)].scale, fields[_switch(message)].offset) != (1.0, 0.0):
            raise self.error(key, f"{message.name}.{_switch(message)}: expected a multiplexor without scale and offset")
        protection = self._protection_of(message.name, fields)
        if page is not None and protection.counter is not None:
            raise self.error(f"can.protection.{message.name}", "a multiplexed message with a counter needs a gateway")
        self.used[name] = info = MessageInfo(
            name=name,
            dbc=message,
            identifier=message.frame_id,
            extended=message.is_extended_frame,
            length=message.length,
            fields=fields,
            protection=protection,
            page=None if page is None else fields[_switch(message)],
            page_value=page or 0,
        )
        return info

    def _scale(self, of: _Angle | _Velocity | _Current | _Temperature | _SupplyVoltage | _Command, key: str) -> float:
        """SI units per DBC unit."""
        if not _is_torque(of.unit):
            return of.sign * of.scale * UNITS[of.unit]
        assert isinstance(of, _Current | _Command)
        if of.per_ampere is None:
            raise self.error(f"{key}.per_ampere", f"missing: expected a positive number of {of.unit}; add it")
        return of.sign * of.scale / of.per_ampere

    def _range(self, of: _Signal, key: str) -> tuple[float, float]:
        low, high = of.range
        if not low < high:
            raise self.error(f"{key}.range", f"expected the lower value first, got {low:g} and {high:g}")
        return low, high

    def _protection_of(self, name: str, fields: Dictionary[str, Field]) -> Protection:
        of, key = self._protection.get(name), f"can.protection.{name}"
        if not isinstance(of, _Protection):
            return Protection("none")
        checksum = self._field(fields, of.checksum, f"{key}.checksum")
        counter = self._field(fields, of.counter, f"{key}.counter")
        modulus = MODULI.get(of.kind, 0)
        if counter is not None and not modulus:
            modulus = of.modulus or 1 << min(counter.length, 16)
        if of.kind != "none":
            self._check_checksum(checksum, 16 if of.kind == "profile5" else 8, f"{key}.checksum")
        if of.kind in MODULI and counter is None:
            raise self.error(f"{key}.counter", "missing: expected the name of a signal; add it")
        if counter is not None and (counter.is_float or counter.signed or modulus > 1 << counter.length):
            raise self.error(f"{key}.counter", f"expected an unsigned signal that counts to {modulus}")
        count, highest = DATA_IDS.get(of.kind, 0), 0xFF if of.kind == "profile2" else 0xFFFF
        if len(of.data_ids) != count or any(v > highest for v in of.data_ids):
            raise self.error(f"{key}.data_ids", f"expected {count} whole numbers from 0 to {highest}")
        return Protection(of.kind, checksum, counter, modulus if counter is not None else 0, of.data_ids, of.start)

    def _field(self, fields: Dictionary[str, Field], name: str | None, key: str) -> Field | None:
        if name is not None and name not in fields:
            raise self.error(key, f"no such signal; the message has {_names(set(fields))}")
        return None if name is None else fields[name]

    def _check_checksum(self, checksum: Field | None, bits: int, key: str) -> None:
        if checksum is None:
            raise self.error(key, "missing: expected the name of a signal; add it")
        first = min(checksum.positions)
        aligned = sorted(checksum.positions) == list(range(first, first + bits))
        if checksum.length != bits or not aligned or first % 8 or checksum.signed or checksum.is_float:
            raise self.error(key, f"expected an unsigned signal of {bits} bits that begins with a byte")


def _switch(message: DbcMessage) -> str:
    return next(signal.name for signal in message.signals if signal.is_multiplexer)


def _ends(field: Field) -> str:
    return " to ".join(f"{end:g}" for end in field.ends)


def _page_of(message: DbcMessage, data: bytes) -> int | None:
    """Value of a message's multiplexor in a payload; None of a message without one."""
    if not message.is_multiplexed():
        return None
    return raw_value(make_field(message.get_signal_by_name(_switch(message))), bytes(data))


def _is_torque(unit: str) -> bool:
    return unit not in UNITS


def _names(names: set[str]) -> str:
    return ", ".join(sorted(names)) or "none"


def _one_line(err: Exception) -> str:
    return " ".join(str(err).split())
