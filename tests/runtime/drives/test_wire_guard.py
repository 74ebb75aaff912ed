"""What leaves to a mapped drive says what was meant, or nothing leaves."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from emb_runtime.drives.mapping import Mapping, load_mapping, parse_mapping
from emb_runtime.drives.wire import Encoder
from emb_runtime.drives.wire_guard import WireGuard, WireGuardError
from emb_runtime.errors import FrameError
from emb_runtime.records import Frame
from tests.drives import EXAMPLES, LIMIT, SHIPPED, RandomMapping


class Way:
    """Encoder, second guard and bus of a mapping."""

    def __init__(self, mapping: Mapping, limit: float = LIMIT) -> None:
        self.bus: list[Frame] = []
        self.encoder = Encoder(mapping)
        self.guard = WireGuard(mapping, limit, self.bus.append)

    def command(self, current: float) -> float:
        return self.guard.command(self.encoder.command(current), current)


@pytest.mark.parametrize("seed", range(150))
def test_bytes_on_the_bus_decode_to_what_was_meant_or_nothing_leaves(seed: int) -> None:
    drawn, draw = RandomMapping(seed), random.Random(-seed)
    mapping = parse_mapping(drawn.toml, drawn.dbc, "random.toml")
    message = mapping.database.get_message_by_name("Command")
    way = Way(mapping)
    for current in (0.0, LIMIT, -LIMIT, *(draw.uniform(-LIMIT, LIMIT) for _ in range(7))):
        said = way.command(current)
        data = way.bus[-1].data
        assert drawn.amperes(data) == pytest.approx(current, abs=0.51 * drawn.ampere_step)
        assert said == pytest.approx(drawn.amperes(data), abs=1e-9)
        by_cantools = message.decode_simple(data)["Current"]
        assert isinstance(by_cantools, float | int)
        assert by_cantools * drawn.scale * drawn.sign / drawn.per_ampere == pytest.approx(said, abs=1e-9)
    left = len(way.bus)
    for current in (math.nan, math.inf, -math.inf, 1.5 * LIMIT, -1e300):
        with pytest.raises((FrameError, WireGuardError)):
            way.command(current)
    assert len(way.bus) == left


@pytest.mark.parametrize("seed", range(60))
def test_a_flipped_bit_is_refused_or_changes_nothing_of_the_current(seed: int) -> None:
    drawn, draw = RandomMapping(seed), random.Random(seed)
    mapping = parse_mapping(drawn.toml, drawn.dbc, "random.toml")
    for bit in range(64):
        way, current = Way(mapping), draw.uniform(-LIMIT, LIMIT)
        frame = way.encoder.command(current)
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        try:
            way.guard.command(frame._replace(data=bytes(data)), current)
        except WireGuardError:
            assert not way.bus
            continue
        assert drawn.kind == "none"
        assert drawn.amperes(way.bus[0].data) == pytest.approx(current, abs=0.51 * drawn.ampere_step)


@pytest.fixture(params=SHIPPED)
def mapping(request: pytest.FixtureRequest) -> Mapping:
    return load_mapping(EXAMPLES / f"{request.param}.toml")


def test_the_frame_of_another_current_is_refused(mapping: Mapping) -> None:
    way = Way(mapping)
    with pytest.raises(WireGuardError, match="meant were -2 A"):
        way.guard.command(way.encoder.command(2.0), -2.0)
    with pytest.raises(WireGuardError, match="nan A is beyond"):
        way.guard.command(way.encoder.command(2.0), math.nan)
    assert (way.bus, way.guard.passed, way.guard.rejected) == ([], 0, 2)


def test_a_current_beyond_the_limit_is_refused(mapping: Mapping) -> None:
    way = Way(mapping, limit=1.0)
    with pytest.raises(WireGuardError, match="beyond 1 A"):
        way.command(1.5)
    with pytest.raises(WireGuardError, match="its bytes say"):
        way.guard.command(way.encoder.command(1.5), 1.0)
    assert not way.bus


@pytest.mark.parametrize("change", ["identifier", "extended", "remote", "error", "short", "long"])
def test_another_kind_of_frame_is_refused(mapping: Mapping, change: str) -> None:
    way = Way(mapping)
    frame = way.encoder.command(1.0)
    changed = {
        "identifier": frame._replace(identifier=frame.identifier + 1),
        "extended": frame._replace(extended=not frame.extended),
        "remote": frame._replace(remote=True),
        "error": frame._replace(error=True),
        "short": frame._replace(data=frame.data[:-1]),
        "long": frame._replace(data=frame.data + b"\0"),
    }[change]
    with pytest.raises(WireGuardError):
        way.guard.command(changed, 1.0)
    assert not way.bus


def test_the_frames_of_the_sequences_pass_as_they_are_and_in_no_other_way(mapping: Mapping) -> None:
    for step in (*mapping.arm, *mapping.disarm):
        for constant in step.frames:
            way = Way(mapping)
            frame = way.encoder.constant(constant)
            way.guard.constant(frame, constant)
            assert way.bus == [frame]
            for bit in range(8 * len(frame.data)):
                data = bytearray(frame.data)
                data[bit // 8] ^= 1 << bit % 8
                changed = frame._replace(data=bytes(data))
                if constant.values and _same(mapping, constant.message, constant.data, bytes(data)):
                    continue
                with pytest.raises(WireGuardError):
                    Way(mapping).guard.constant(changed, constant)


def _same(mapping: Mapping, name: str, first: bytes, second: bytes) -> bool:
    """The two say the same within 1e-40, as floats next to zero do."""
    message = mapping.database.get_message_by_name(name)
    pairs = zip(message.decode_simple(first).values(), message.decode_simple(second).values(), strict=True)
    return all(isinstance(a, float | int) and isinstance(b, float | int) and abs(a - b) < 1e-30 for a, b in pairs)


def test_a_limit_that_is_no_current_is_refused(mapping: Mapping) -> None:
    for limit in (math.nan, math.inf, -1.0):
        with pytest.raises(ValueError, match="limit"):
            WireGuard(mapping, limit, lambda _frame: None)


def test_a_mapping_with_the_wrong_scale_between_encoder_and_guard_lets_nothing_out(mapping: Mapping) -> None:
    wrong = replace(mapping, command=replace(mapping.command, factor=-mapping.command.factor))
    way = Way(mapping)
    with pytest.raises(WireGuardError):
        way.guard.command(Encoder(wrong).command(3.0), 3.0)
    assert not way.bus
