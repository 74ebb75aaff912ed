"""A codec generated from any message of plain signals agrees with cantools."""

from __future__ import annotations

import math
import subprocess
import sys
from collections import namedtuple
from collections.abc import Mapping
from dataclasses import dataclass
from random import Random

import cantools.database
import pytest
from cantools.database.can import Database

from emb_runtime.can import codec as codec_module
from emb_runtime.can.codec import Fault, FrameRejectedError, Message, describe, parse, worst_bits
from emb_runtime.can.generated import Codec, Field, generate_codec
from emb_runtime.can.messages import load_layout
from emb_runtime.errors import FrameError
from emb_runtime.records import Frame
from tests.independent import DATABASE, with_crc


@dataclass(frozen=True)
class Drawn:
    """A signal of a random message."""

    name: str
    start: int
    length: int
    signed: bool
    factor: str
    minimum: str
    maximum: str

    def __str__(self) -> str:
        place = f"{self.start}|{self.length}@1{'-' if self.signed else '+'}"
        return f' SG_ {self.name} : {place} ({self.factor},0) [{self.minimum}|{self.maximum}] "u" N'


def exact(value: float) -> str:
    return f"{value:.9g}"


def drawn_signals(rng: Random, bits: int) -> list[Drawn]:
    """Signals over bits 12 and up, with gaps, whose ranges lie on their steps and inside their bits."""
    signals: list[Drawn] = []
    at = 12
    while at < bits:
        start = at + rng.choice([0, 0, 1, 3])
        length = min(rng.randint(1, 20), bits - start)
        if length < 1:
            break
        signed = length > 1 and rng.random() < 0.5
        low, high = (-(1 << length - 1), (1 << length - 1) - 1) if signed else (0, (1 << length) - 1)
        if rng.random() < 0.5 and length > 3:
            low, high = low + rng.randint(0, 3), high - rng.randint(0, 3)
        factor = rng.choice([1.0, 1.0, 0.5, 0.25, 0.125])
        ends = (exact(low * factor), exact(high * factor))
        signals.append(Drawn(f"S{len(signals)}", start, length, signed, exact(factor), *ends))
        at = start + length
    return signals


def text_of(signals: list[Drawn], length: int, data_id: int = 7) -> str:
    head = [Drawn("CRC", 0, 8, False, "1", "0", "255"), Drawn("Counter", 8, 4, False, "1", "0", "14")]
    return "\n".join(
        [
            'VERSION "1"',
            "BU_: N",
            f"BO_ 291 M: {length} N",
            *map(str, head + signals),
            "",
            'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 100000;',
            'BA_DEF_ BO_ "DataId" INT 0 100000;',
            'BA_DEF_DEF_ "GenMsgCycleTime" 0;',
            'BA_DEF_DEF_ "DataId" 0;',
            'BA_ "GenMsgCycleTime" BO_ 291 20;',
            f'BA_ "DataId" BO_ 291 {data_id};',
            "",
        ]
    )


def codec(text: str) -> Message:
    return describe(parse(text).get_message_by_name("M"))


def encode(message: Message, values: Mapping[str, float]) -> Frame:
    return coded(message).encode(*(values[signal.name] for signal in message.signals[1:]))


def decode(message: Message, frame: Frame) -> dict[str, float]:
    """By the generated function, and by the table: they agree."""
    values = coded(message).decode(frame)._asdict()
    by_table = message.decode(frame)
    assert by_table == {"CRC": frame.data[0], **values}
    return by_table


def coded(message: Message) -> Codec:
    names = [signal.name for signal in message.signals[1:]]
    return generate_codec(message, namedtuple("M", names), tuple(map(Field, names)))


@pytest.mark.parametrize("seed", range(12))
def test_a_message_of_any_plain_signals_is_coded_as_by_cantools(seed: int) -> None:
    rng = Random(seed)
    length = rng.randint(3, 8)
    signals, data_id = drawn_signals(rng, 8 * length), rng.randint(1, 0xFFFF)
    text = text_of(signals, length, data_id)
    ours = codec(text)
    theirs = cantools.database.load_string(text, "dbc")
    assert isinstance(theirs, Database)
    assert (ours.name, ours.identifier, ours.length, ours.data_id) == ("M", 291, length, data_id)
    assert ours.cycle_time == pytest.approx(0.020)
    for _ in range(20):
        values: dict[str, float] = {"Counter": rng.randint(0, 14)}
        for s in signals:
            step, least, most = float(s.factor), float(s.minimum), float(s.maximum)
            on_step = rng.choice([least, most, least + step * rng.randint(0, round((most - least) / step))])
            between = 0.25 * step if step < 1.0 and on_step < most else 0.0
            values[s.name] = on_step + rng.choice([0.0, between, -between if on_step > least else 0.0])
        expected = with_crc(data_id, theirs.encode_message("M", values | {"CRC": 0}, strict=True)[1:])
        frame = encode(ours, values)
        assert frame.data == expected
        assert decode(ours, frame) == theirs.decode_message("M", expected, decode_choices=False)


@pytest.mark.parametrize("seed", range(12))
def test_a_raw_value_just_beyond_a_range_is_rejected_and_one_at_its_end_is_not(seed: int) -> None:
    rng = Random(seed)
    signals = drawn_signals(rng, 64)
    ours = codec(text_of(signals, 8))
    good = encode(ours, {"Counter": 3} | {s.name: float(s.minimum) for s in signals})
    word = int.from_bytes(good.data, "little")
    for drawn in signals:
        signal = ours.signal(drawn.name)
        clear = word & ~(signal.mask << signal.shift)
        for raw, inside in (
            (signal.raw_minimum, True),
            (signal.raw_maximum, True),
            (signal.raw_minimum - 1, False),
            (signal.raw_maximum + 1, False),
        ):
            if (raw & signal.mask) != raw + (raw < 0) * (signal.mask + 1) or raw < -signal.sign:
                continue
            if raw > signal.mask - signal.sign:
                continue  # its bits cannot say that
            data = (clear | (raw & signal.mask) << signal.shift).to_bytes(8, "little")
            frame = good._replace(data=with_crc(7, data[1:]))
            if inside:
                assert decode(ours, frame)[drawn.name] == raw * float(drawn.factor)
            else:
                with pytest.raises(FrameRejectedError) as caught:
                    coded(ours).decode(frame)
                assert caught.value.fault is Fault.RANGE


@pytest.mark.parametrize("factor", ["2", "0.5", "3"])
def test_a_value_between_two_steps_becomes_the_nearer_one_unless_the_step_is_one(factor: str) -> None:
    step = float(factor)
    ours = codec(text_of([Drawn("S", 16, 8, False, factor, "0", exact(255 * step))], 3))
    for raw, off in ((0, 0.2), (7, -0.2), (200, 0.2), (255, 0.0)):
        frame = encode(ours, {"Counter": 1, "S": (raw + off) * step})
        assert decode(ours, frame)["S"] == raw * step


def test_a_value_beyond_its_range_is_told_as_it_is_on_the_bench() -> None:
    signal = Drawn("S", 16, 8, False, "0.25", "0", "50")
    ours = codec(text_of([signal], 3))
    frame = encode(ours, {"Counter": 1, "S": 50.0})
    beyond = frame._replace(data=with_crc(7, bytes((frame.data[1], 240))))
    with pytest.raises(FrameRejectedError, match=r"S: expected a value from 0 to 50 u, got 60"):
        coded(ours).decode(beyond)


PLAIN = Drawn("S", 16, 8, True, "1", "-128", "127")


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("BU_: N", "BU_ N"),
        ("BO_ 291 M", "BO_ 291.5 M"),
        ("S : 16|8", "S : 10|8"),  # over the counter
        ("BO_ 291 7;", 'BO_ 291 "seven";'),
        ('BA_ "DataId"', 'BA_ "Unknown"'),
    ],
)
def test_a_text_that_is_no_dbc_is_refused(right: str, wrong: str) -> None:
    text = text_of([PLAIN], 8)
    assert right in text
    with pytest.raises(FrameError, match="DBC: not readable"):
        parse(text.replace(right, wrong))


def test_reading_a_dbc_does_not_import_python_can_and_leaves_cantools_whole() -> None:
    code = (
        "import sys; from emb_runtime.can.messages import load_layout\n"
        "text = load_layout().text\n"
        "assert not {'can', 'asammdf', 'cantools'} & {*sys.modules}, sorted(sys.modules)\n"
        "import cantools\n"
        "assert 'can' in sys.modules\n"
        "print(len(cantools.database.load_string(text, 'dbc').messages))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) == len(DATABASE.messages)


def test_cantools_without_its_package_is_there_for_an_import_only(monkeypatch: pytest.MonkeyPatch) -> None:
    there, text = sys.modules["cantools"], load_layout().text
    assert len(codec_module.parse(text).messages) == len(DATABASE.messages)
    assert sys.modules["cantools"] is there
    for name in [name for name in sys.modules if name.partition(".")[0] == "cantools"]:
        monkeypatch.delitem(sys.modules, name)
    assert len(codec_module.parse(text).messages) == len(DATABASE.messages)
    assert "cantools.database.can" in sys.modules
    assert "cantools" not in sys.modules


@pytest.mark.parametrize("value", [math.nan, 0.1, 3.5, 14.5, 15])
def test_a_whole_signal_takes_whole_numbers_of_its_range_only(value: float) -> None:
    ours = codec(text_of([PLAIN], 8))
    with pytest.raises(FrameError, match=r"M\.Counter: expected a"):
        encode(ours, {"Counter": value, "S": 0})


@pytest.mark.parametrize("length", range(2, 9))
def test_the_longest_frame_has_a_stuffed_bit_after_the_first_five_bits_and_after_every_four_more(length: int) -> None:
    ours = codec(text_of([], length))
    stuffable = 34 + 8 * length
    assert ours.worst_bits == stuffable + 13 + len(range(5, stuffable + 1, 4))
    longer = stuffable + 20  # 18 bits of the identifier, SRR and one reserved bit
    assert worst_bits(length, extended=True) == longer + 13 + len(range(5, longer + 1, 4))


@pytest.mark.parametrize("name", ["EMB_Command", "EMB_Angle", "EMB_Velocity", "EMB_Status"])
def test_every_bit_that_no_signal_covers_is_reserved_and_no_other(name: str) -> None:
    source = DATABASE.get_message_by_name(name)
    covered = {bit for signal in source.signals for bit in range(signal.start, signal.start + signal.length)}
    message = load_layout().messages[name]
    assert message.reserved == sum(1 << bit for bit in range(8 * source.length) if bit not in covered)
