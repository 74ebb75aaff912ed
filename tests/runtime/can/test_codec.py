"""Codecs of the layout's messages and of any with plain signals agree with cantools and an independent CRC."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from random import Random
from typing import Any

import cantools.database
import e2e.p01
import pytest

from emb_runtime.can import codec as codec_module
from emb_runtime.can.codec import Fault, FrameRejectedError, Message, describe, parse, worst_bits
from emb_runtime.can.messages import load_layout
from emb_runtime.errors import FrameError
from emb_runtime.records import Frame
from tests.independent import DATABASE, with_crc
from tests.runtime.can.test_messages import fault_of, generic

HEAD = (' SG_ CRC : 0|8@1+ (1,0) [0|255] "" N', ' SG_ Counter : 8|4@1+ (1,0) [0|14] "" N')


def text_of(signals: list[str], length: int, data_id: int = 7) -> str:
    """A DBC with one message."""
    return "\n".join(
        [
            'VERSION "1"',
            "BU_: N",
            f"BO_ 291 M: {length} N",
            *HEAD,
            *signals,
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


def drawn(seed: int) -> str:
    """Signals over bits 12 and up, with gaps, whose ranges lie on their steps and inside their bits."""
    rng = Random(seed)
    payload = rng.randint(3, 8)
    signals: list[str] = []
    at = 12
    while at < 8 * payload:
        start = at + rng.choice([0, 0, 1, 3])
        length = min(rng.randint(1, 20), 8 * payload - start)
        if length < 1:
            break
        signed = length > 1 and rng.random() < 0.5
        low, high = (-(1 << length - 1), (1 << length - 1) - 1) if signed else (0, (1 << length) - 1)
        if rng.random() < 0.5 and length > 3:
            low, high = low + rng.randint(0, 3), high - rng.randint(0, 3)
        factor = rng.choice([1.0, 1.0, 0.5, 0.25, 0.125, 2.0, 3.0])
        scaling = f"({factor:g},0) [{low * factor:.9g}|{high * factor:.9g}]"
        signals.append(f' SG_ S{len(signals)} : {start}|{length}@1{"-" if signed else "+"} {scaling} "u" N')
        at = start + length
    return text_of(signals, payload, rng.randint(1, 0xFFFF))


def both(text: str) -> tuple[Message, Any]:
    """The message of a DBC as ours and as cantools'."""
    theirs: Any = cantools.database.load_string(text, "dbc")
    return describe(parse(text).get_message_by_name("M")), theirs.get_message_by_name("M")


MESSAGES: dict[str, tuple[Message, Any]] = {
    **{message.name: (message, DATABASE.get_message_by_name(message.name)) for message in load_layout().all_messages},
    **{f"drawn with seed {seed}": both(drawn(seed)) for seed in range(16)},
}


class Coding:
    """One message in both codecs; frames are put together by where cantools finds the signals."""

    def __init__(self, name: str) -> None:
        self.ours, self.theirs = MESSAGES[name]
        self.codec = generic(self.ours)
        self.signals = sorted((s for s in self.theirs.signals if s.name != "CRC"), key=lambda signal: signal.start)
        self.data_id = int(self.theirs.dbc.attributes["DataId"].value)
        self.rng = Random(name)

    def encode(self, values: dict[str, float]) -> Frame:
        return self.codec.encode(*(values[signal.name] for signal in self.signals))

    def ends(self, signal: Any) -> tuple[int, int]:
        """Least and greatest raw value."""
        return round(signal.minimum / signal.scale), round(signal.maximum / signal.scale)

    def values(self) -> dict[str, float]:
        """A value of each signal, at an end, on a step or between two."""
        found: dict[str, float] = {}
        for signal in self.signals:
            low, high = self.ends(signal)
            off = 0.0 if signal.scale == 1 else self.rng.choice((0.0, 0.25, -0.25))
            value = signal.scale * (self.rng.choice((low, high, self.rng.randint(low, high))) + off)
            found[signal.name] = min(max(value, signal.minimum), signal.maximum)
        return found

    def protected(self, word: int) -> Frame:
        """The frame of a payload word, with a CRC that is right, whatever else is wrong."""
        body = word.to_bytes(self.theirs.length, "little")[1:]
        return Frame(self.theirs.frame_id, with_crc(self.data_id, body))

    def good(self) -> int:
        """The payload word of a valid frame."""
        data = self.theirs.encode({**self.values(), "CRC": 0}, strict=True)
        return int.from_bytes(data, "little")

    def with_raw(self, signal: Any, raw: int) -> Frame:
        """A valid frame but for the bits of one signal."""
        mask = (1 << signal.length) - 1
        return self.protected(self.good() & ~(mask << signal.start) | (raw & mask) << signal.start)


@pytest.fixture(params=MESSAGES)
def coding(request: pytest.FixtureRequest) -> Coding:
    return Coding(request.param)


def test_a_message_is_coded_as_by_cantools_and_what_cannot_be_encoded_is_rejected(coding: Coding) -> None:
    ours, theirs = coding.ours, coding.theirs
    assert (ours.name, ours.identifier, ours.length) == (theirs.name, theirs.frame_id, theirs.length)
    assert ours.data_id == coding.data_id
    assert ours.cycle_time == pytest.approx((theirs.cycle_time or 0) * 1e-3)
    for _ in range(30):
        values = coding.values()
        expected = coding.protected(int.from_bytes(theirs.encode({**values, "CRC": 0}, strict=True), "little"))
        assert coding.encode(values) == expected
        assert fault_of(ours, expected) is None
        assert ours.decode(expected) == theirs.decode(expected.data, decode_choices=False)
        any_bits = coding.protected(coding.rng.getrandbits(8 * ours.length))
        said = theirs.decode(any_bits.data, decode_choices=False)
        try:
            again = theirs.encode(said, strict=True)  # refuses values out of range; reserved bits come out as zero
        except cantools.database.EncodeError:
            again = b""
        faults = (None,) if again == any_bits.data else (Fault.COUNTER, Fault.RESERVED, Fault.RANGE)
        assert fault_of(ours, any_bits) in faults
        payload = coding.rng.randbytes(ours.length)
        whole = fault_of(ours, Frame(ours.identifier, payload)) not in (Fault.CRC, Fault.COUNTER)
        assert whole == e2e.p01.e2e_p01_check(bytearray(payload), coding.data_id)


def test_the_ends_of_each_range_can_be_sent_and_believed_and_nothing_beyond_them(coding: Coding) -> None:
    for signal in coding.signals:
        values, (low, high) = coding.values(), coding.ends(signal)
        ours = coding.ours.signal(signal.name)
        assert (ours.unit, ours.minimum, ours.maximum) == (signal.unit or "", signal.minimum, signal.maximum)
        assert (ours.raw_minimum, ours.raw_maximum) == (low, high)
        assert isinstance(ours.factor, int) == float(signal.scale).is_integer()  # the values of a whole step are whole
        for end in (signal.minimum, signal.maximum):
            frame = coding.encode(values | {signal.name: end})
            assert coding.ours.decode(frame)[signal.name] == pytest.approx(end)
        beyond = [math.nan, math.inf, -math.inf, 1e9, -1e9, 1e300]
        beyond += [math.nextafter(signal.minimum, -math.inf), math.nextafter(signal.maximum, math.inf)]
        beyond += [low + 0.1, high - 0.5] if signal.scale == 1 else []
        for value in beyond:
            with pytest.raises(FrameError, match=rf"{coding.ours.name}\.{signal.name}: expected a"):
                coding.encode(values | {signal.name: value})
        least = -(1 << signal.length - 1) if signal.is_signed else 0
        for raw in (low, high, low - 1, high + 1):
            if not least <= raw < least + (1 << signal.length):
                continue  # its bits cannot say that
            frame = coding.with_raw(signal, raw)
            if low <= raw <= high:
                assert coding.ours.decode(frame)[signal.name] == raw * ours.factor
                continue
            assert fault_of(coding.ours, frame) is (Fault.COUNTER if signal.name == "Counter" else Fault.RANGE)
            said = f"{signal.name}: expected a value from {signal.minimum:g} to {signal.maximum:g} {signal.unit or ''}"
            told = f"{coding.ours.name}: frame rejected, value out of range: {said.rstrip()}, got {raw * ours.factor:g}"
            with pytest.raises(FrameRejectedError, match=re.escape(told) if signal.name != "Counter" else "counter"):
                coding.codec.decode(frame)


def test_a_frame_is_rejected_for_its_kind_its_length_and_each_bit_that_no_signal_covers(coding: Coding) -> None:
    word = coding.good()
    frame = coding.protected(word)
    other = frame._replace(identifier=frame.identifier + 16)
    kinds = [frame._replace(extended=True), frame._replace(remote=True), frame._replace(error=True)]
    assert {fault_of(coding.ours, wrong) for wrong in (other, *kinds)} == {Fault.KIND}
    for length in set(range(9)) - {coding.ours.length}:
        wrong = frame._replace(data=frame.data[:length].ljust(length, b"\0"))
        assert fault_of(coding.ours, wrong) is Fault.LENGTH
    covered = {bit for s in coding.theirs.signals for bit in range(s.start, s.start + s.length)}
    reserved = set(range(8 * coding.ours.length)) - covered
    assert coding.ours.reserved == sum(1 << bit for bit in reserved)
    for bit in reserved:
        assert fault_of(coding.ours, coding.protected(word | 1 << bit)) is Fault.RESERVED


PLAIN = ' SG_ S : 16|8@1- (1,0) [-128|127] "u" N'


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
    assert not {"cantools", "cantools.tester"} & sys.modules.keys()  # the package imports its tester


@pytest.mark.parametrize("length", range(2, 9))
def test_the_longest_frame_has_a_stuffed_bit_after_the_first_five_bits_and_after_every_four_more(length: int) -> None:
    ours, _ = both(text_of([], length))
    stuffable = 34 + 8 * length
    assert ours.worst_bits == stuffable + 13 + len(range(5, stuffable + 1, 4))
    longer = stuffable + 20  # 18 bits of the identifier, SRR and one reserved bit
    assert worst_bits(length, extended=True) == longer + 13 + len(range(5, longer + 1, 4))
