"""Documents read into records: each refusal is one line with document, key, what was expected and what came."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
import pytest
from msgspec import Meta

from emb_runtime.config.typed import FieldError, read
from emb_runtime.errors import PolicyRefusedError, UsageError

Positive = Annotated[float, Meta(gt=0)]


class Gear(msgspec.Struct, frozen=True):
    """A record within a record."""

    ratio: Annotated[float, Meta(gt=0, le=6)]
    teeth: Annotated[int, Meta(ge=1)] = 1
    pair: tuple[float, float] = (0.0, 1.0)
    kind: Literal["spur", "worm"] = "spur"

    def __post_init__(self) -> None:
        """Refuse a pair in the wrong order."""
        if self.pair[0] > self.pair[1]:
            raise FieldError("pair", f"the lower value {self.pair[0]:g} is above the upper {self.pair[1]:g}")


@dataclass(frozen=True)
class Machine:
    """A dataclass is read as a struct is."""

    gear: Gear
    spares: dict[str, Gear] = field(default_factory=dict)
    quantiles: dict[Literal["p50", "p99.9"], Positive] = field(default_factory=dict)
    stages: Annotated[tuple[Gear, ...], Meta(max_length=2)] = ()
    name: str | dict[str, float] = "machine"
    flag: bool = False
    load: float | None = None


SPUR: dict[str, Any] = {"ratio": 2}


def refusal(document: object, **options: Any) -> str:
    with pytest.raises(UsageError) as refused:
        read(Machine, document, "my.toml", UsageError, **options)
    message = str(refused.value)
    assert message.isprintable()
    return message.removeprefix("my.toml: ")


def test_a_document_becomes_a_record() -> None:
    document = {"gear": {"ratio": 2, "pair": [1, 2], "kind": "worm"}, "spares": {"b": SPUR}, "name": {"x": 1}}
    machine = read(Machine, document, "my.toml", UsageError)
    assert machine == Machine(Gear(2.0, 1, (1.0, 2.0), "worm"), {"b": Gear(2.0)}, name={"x": 1.0})
    assert isinstance(machine.gear.ratio, float)


def test_what_does_not_fit_is_refused_with_its_place_what_was_expected_and_what_came() -> None:
    for document, message in [
        (3, "expected a table, got a number, 3"),
        ({}, "gear: missing: expected a table; add it"),
        ({"gear": {}}, "gear.ratio: missing: expected a number above 0, at most 6; add it"),
        ({"gear": {"ratio": 7}}, "gear.ratio: expected a number above 0, at most 6, got 7"),
        ({"gear": {"ratio": 0.0}}, "gear.ratio: expected a number above 0, at most 6, got 0.0"),
        ({"gear": {"ratio": True}}, "gear.ratio: expected a number above 0, at most 6, got true"),
        ({"gear": {"ratio": "2"}}, "gear.ratio: expected a number above 0, at most 6, got a text in quotes, '2'"),
        ({"gear": {"ratio": math.nan}}, "gear.ratio: expected a finite number"),
        ({"gear": SPUR, "load": math.inf}, "load: expected a finite number"),
        ({"gear": SPUR, "load": 10**400}, "load: expected a finite number"),
        ({"gear": SPUR, "name": {"x": -math.inf}}, "name.x: expected a finite number"),
        ({"gear": {"ratio": 2, "teeth": 2.0}}, "gear.teeth: expected a whole number from 1, got 2.0"),
        ({"gear": {"ratio": 2, "teeth": 0}}, "gear.teeth: expected a whole number from 1, got 0"),
        ({"gear": {"ratio": 2, "kind": "bevel"}}, "gear.kind: expected one of spur, worm, got 'bevel'"),
        ({"gear": {"ratio": 2, "pair": [2, 1]}}, "gear.pair: the lower value 2 is above the upper 1"),
        ({"gear": {"ratio": 2, "pair": [2]}}, "gear.pair: expected [a number, a number], got [2]"),
        ({"gear": {"ratio": 2, "speed": 1}}, "gear.speed: unknown key; expected some of kind, pair, ratio, teeth"),
        ({"gear": SPUR, "a\nb": 1}, r"'a\nb': unknown key"),
        (
            {"gear": SPUR, "spares": {"a": SPUR, "b": {"ratio": 9}}},
            "spares.b.ratio: expected a number above 0, at most 6",
        ),
        ({"gear": SPUR, "spares": {"a": SPUR, "b": {"pair": [2, 1], **SPUR}}}, "spares.b.pair: the lower value 2"),
        ({"gear": SPUR, "spares": {"a": SPUR, "b": {}}}, "spares.b.ratio: missing: expected"),
        ({"gear": SPUR, "spares": 3}, "spares: expected a table, got a number, 3"),
        ({"gear": SPUR, "quantiles": {"p50": 1, "p42": 1}}, "quantiles.p42: unknown key; expected one of p50, p99.9"),
        ({"gear": SPUR, "quantiles": {"p50": 1, "p99.9": 0}}, "quantiles.p99.9: expected a number above 0, got 0"),
        (
            {"gear": SPUR, "stages": [SPUR, {"ratio": 8}]},
            "stages[1].ratio: expected a number above 0, at most 6, got 8",
        ),
        ({"gear": SPUR, "stages": [SPUR] * 3}, "stages: expected a list of 0 to 2 entries, got"),
        ({"gear": SPUR, "name": ""}, "name: expected a printable text of 1 to 200 characters, got ''"),
        ({"gear": SPUR, "name": "a\x1b[31m"}, "name: expected a printable text"),
        ({"gear": SPUR, "name": "a" * 201}, "name: expected a printable text"),
        ({"gear": SPUR, "name": {"x": "big"}}, "name.x: expected a number, got a text in quotes, 'big'"),
        ({"gear": SPUR, "flag": 1}, "flag: expected true or false, got a number, 1"),
        ({"gear": SPUR, "flag": "true"}, "flag: expected true or false, got a text in quotes, 'true'"),
        ({"gear": {"ratio": [2]}}, "gear.ratio: expected a number above 0, at most 6, got a list, [2]"),
        ({"gear": {"ratio": 2, "kind": 3}}, "gear.kind: expected one of spur, worm, got a number, 3"),
        ({"gear": SPUR, "name": 3}, "name: expected a text or a table, got a number, 3"),
    ]:
        assert refusal(document).startswith(message), document


def test_a_number_other_than_0_has_a_size_with_which_arithmetic_does_not_overflow() -> None:
    assert refusal({"gear": {"ratio": 1e-31}}).startswith("gear.ratio: expected 0 or a size from 1e-30")
    assert refusal({"gear": SPUR, "load": -1e31}).startswith("load: expected 0 or a size")
    assert read(Machine, {"gear": SPUR, "load": 0}, "f", UsageError).load == 0.0


def test_a_text_has_200_characters_at_most_and_the_remedy_is_given_by_the_caller() -> None:
    assert read(Machine, {"gear": SPUR, "name": "a" * 200}, "f", UsageError).name == "a" * 200
    assert refusal({"gear": SPUR, "name": "a" * 201}).startswith("name: expected a printable text of 1 to 200 ")
    assert refusal({"gear": {}}, remedy="export it anew").endswith("; export it anew")
    with pytest.raises(PolicyRefusedError, match=r"^contract: gear: missing"):
        read(Machine, {}, "contract", PolicyRefusedError)


def test_a_value_as_long_as_a_file_is_shortened() -> None:
    assert len(refusal({"gear": {"ratio": 2, "kind": "x" * 200}})) < 200
    assert len(refusal({"gear": {"ratio": 2, "y" * 5000: 1}})) < 400
    assert "too many digits" in refusal({"gear": SPUR, "flag": 10**5000})
