"""Mappings drawn at random, and a decoder of DBC signals that shares no code with the product."""

from __future__ import annotations

import math
import random
import struct
from pathlib import Path

from emb_runtime.config.bench import shipped_bench_text

EXAMPLES = Path(__file__).parents[1] / "examples" / "drives"
SHIPPED = ("odrive", "vesc", "mit")
LIMIT = 6.0  # Largest current of the mappings drawn [A]

_SENSORS = """\
BO_ 800 Sensors: 8 Drive
 SG_ Angle : 0|32@1- (1,0) [0|0] "rad" Host
 SG_ Velocity : 32|32@1- (1,0) [0|0] "rad/s" Host

"""
_SENSOR_TYPES = "SIG_VALTYPE_ 800 Angle : 1;\nSIG_VALTYPE_ 800 Velocity : 1;\n"
_ALWAYS = ["no_answers", "no_echo", "no_device_time", "no_identity", "hold_on_loss", "no_counter", "no_crc"]


def late_bench(polled: bool = False) -> str:
    """The shipped bench file with the age of frames that a mapped drive has."""
    age = "[1, 1]" if polled else "[0, 1]"
    text = shipped_bench_text().replace("frame_age     = [0, 0]", f"frame_age     = {age}")
    return text + "\n[plants.late-command]\ncommand_delay = 1\n"


class RandomMapping:
    """The texts of a mapping with a command of random place, size, order, scale, unit, sign and protection."""

    def __init__(self, seed: int) -> None:
        draw = random.Random(seed)
        self.big_endian = draw.random() < 0.5
        self.kind = draw.choice(("none", "none", "profile1", "profile2", "profile5", "xor", "sum"))
        self.identifier, self.extended = draw.choice(
            ((draw.randrange(300, 700), False), (draw.randrange(1 << 29), True))
        )
        self.signals: list[tuple[str, int, int]] = []
        bit = self._header()
        self.is_float = draw.random() < 0.3 and bit <= 32
        self.length = self._length(draw, 64 - bit)
        start = bit + draw.randint(0, 64 - bit - self.length)
        if draw.random() < 0.5 and start - bit >= 4:
            self.signals.append(("Other", bit, 4))
        self.signals.append(("Current", start, self.length))
        self.signed = self.is_float or draw.random() < 0.5
        self.unit, self.per_ampere = draw.choice((("A", 1.0), ("mA", 1000.0), ("Nm", draw.uniform(0.01, 2.0))))
        self.sign, self.scale = draw.choice((1, -1)), draw.uniform(0.5, 4.0)
        span = LIMIT * self.per_ampere / self.scale * 1.01
        self.span = span
        self.step = 1.0 if self.is_float else 2.0 * span / ((1 << self.length) - 2)
        self.offset, self.range = 0.0 if self.signed else -span, "[0|0]"
        self._distort(draw)
        self.dbc = self._dbc()
        self.toml = self._toml()

    def _length(self, draw: random.Random, free: int) -> int:
        return 32 if self.is_float else draw.randint(11, min(32, free - 8))

    def _distort(self, draw: random.Random) -> None:
        """Change what the signal carries."""

    def _header(self) -> int:
        """Place checksum and counter; the first bit that is free, counted along the bus."""
        if self.kind == "none":
            return 0
        self.big_endian = self.big_endian and self.kind in ("xor", "sum")
        wide = self.kind == "profile5"
        self.signals.append(("Checksum", 0, 16 if wide else 8))
        if wide:
            self.signals.append(("Counter", 16, 8))
        elif self.kind != "sum":
            self.signals.append(("Counter", 8, 4))
        return 24 if wide else 16

    def _dbc(self) -> str:
        identifier = self.identifier | (1 << 31 if self.extended else 0)
        lines = [f"BO_ {identifier} Command: 8 Host"]
        for name, bit, length in self.signals:
            start, order = (8 * (bit // 8) + 7 - bit % 8, 0) if self.big_endian else (bit, 1)
            mine = name == "Current"
            sign = "-" if mine and self.signed else "+"
            scale = f"({self.step!r},{self.offset!r})" if mine else "(1,0)"
            lines.append(f' SG_ {name} : {start}|{length}@{order}{sign} {scale} {self.range} "" Drive')
        types = _SENSOR_TYPES + (f"SIG_VALTYPE_ {identifier} Current : 1;\n" if self.is_float else "")
        return 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: Host Drive\n\n' + "\n".join(lines) + "\n\n" + _SENSORS + types

    def _toml(self) -> str:
        names = [name for name, _, _ in self.signals]
        accept = [*_ALWAYS, "no_current", "no_state"]
        accept += ["no_command_crc"] if self.kind == "none" else []
        accept += ["relative_k_m"] if self.unit == "Nm" else []
        extra = f", per_ampere = {self.per_ampere!r}" if self.unit == "Nm" else ""
        others = ", others = {Other = 5}" if "Other" in names else ""
        protection = ""
        if self.kind != "none":
            ids = {"profile1": [4660], "profile2": list(range(16)), "profile5": [513]}.get(self.kind)
            protection = f'[can.protection.Command]\nkind = "{self.kind}"\nchecksum = "Checksum"\n'
            protection += 'counter = "Counter"\n' if "Counter" in names else ""
            protection += f"data_ids = {ids}\n" if ids else ""
        return f"""\
schema = 1
name = "random"
[can]
dbc = "random.dbc"
exchange = "broadcast"
pair_within = 0.001
[can.signals]
angle = {{signal = "Sensors.Angle", unit = "rad", sign = 1, range = [-100, 200]}}
velocity = {{signal = "Sensors.Velocity", unit = "rad/s", sign = 1, range = [-900, 900]}}
command = {{signal = "Command.Current", unit = "{self.unit}", sign = {self.sign}, scale = {self.scale!r}{extra}, \
range = [{-self.span!r}, {self.span!r}]{others}}}
{protection}[node]
on_loss = "hold"
watchdog = 0.01
stop = "freewheel"
end_stop_speed = 1800
accept = {accept}
"""

    def amperes(self, data: bytes) -> float:
        """The current that a payload says, read from its bits as text [A]."""
        (bit, length) = next((bit, length) for name, bit, length in self.signals if name == "Current")
        if self.big_endian:
            text = "".join(f"{byte:08b}" for byte in data)[bit : bit + length]
        else:
            text = "".join(f"{byte:08b}" for byte in reversed(data))[64 - bit - length : 64 - bit]
        if self.is_float:
            code = {16: "<e", 32: "<f"}[length]
            raw = struct.unpack(code, int(text, 2).to_bytes(length // 8, "little"))[0]
        else:
            raw = int(text, 2)
            raw -= (1 << length) if self.signed and text[0] == "1" else 0
        return float((raw * self.step + self.offset) * self.scale * self.sign / self.per_ampere)

    @property
    def ampere_step(self) -> float:
        """Distance of neighbouring currents, at most [A]."""
        step = self.span * 2.0**-23 if self.is_float else self.step
        return step * self.scale / self.per_ampere


class AnyCommand(RandomMapping):
    """One whose command has 8 to 16 bits or is a float, with any step, sign, offset and range in the DBC."""

    def _length(self, draw: random.Random, free: int) -> int:
        return draw.choice((16, 32)) if self.is_float else draw.randint(8, min(16, free))

    def _distort(self, draw: random.Random) -> None:
        if self.is_float:
            self.step, around = 10.0 ** draw.uniform(-6.0, 3.0), self.span * draw.choice((0.0, 1.0, 100.0))
        else:
            self.step *= draw.choice((0.5, 0.999, 1.0, 1.01, 1.5, 4.0)) * draw.choice((1, 1, -1))
            around = self.span * draw.choice((0.0, 0.0, 1.0, 2.0))
        self.offset = draw.choice((self.offset, draw.uniform(-around, around), around, -around))
        self.range = draw.choice(("[0|0]", "[0|65535]", "[-3|3]", "[7|1]", "[-1E9|1E9]"))

    def error_carried(self, value: float) -> float:
        """Least difference of what the signal can say from a value, in its steps [DBC units]."""
        wanted = (value - self.offset) / self.step
        if self.is_float:
            return 0.0 if abs(wanted) <= {16: 65504.0, 32: 3.4028e38}[self.length] else math.inf
        least = -(1 << self.length - 1) if self.signed else 0
        return abs(min(max(round(wanted), least), least + (1 << self.length) - 1) - wanted)

    @property
    def ampere_step(self) -> float:
        """Distance of neighbouring currents, at most [A]."""
        step = abs(self.step)
        if self.is_float:
            largest = (self.span + abs(self.offset)) / step
            step *= largest * 2.0 ** {16: -10, 32: -23}[self.length] + {16: 2.0**-24, 32: 2.0**-149}[self.length]
        return step * self.scale / self.per_ampere
