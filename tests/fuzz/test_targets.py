"""The fuzz targets in small numbers, a million in ``tests/searches/fuzz.py``; and the faults that they must find."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import pytest

from emb_runtime.can.codec import Message
from emb_runtime.can.e2e import CounterCheck, LeakyCount
from emb_runtime.can.receiver import Reception
from tests.fuzz import runs
from tests.fuzz.stream import Played, ViolationError
from tests.fuzz.targets import TARGETS

PLAYED: dict[str, tuple[Callable[[Random], Played], int]] = {
    **{name: (target, 12) for name, target in TARGETS.items()},
    "loop": (runs.run, 8),
}
Patch = pytest.MonkeyPatch


@pytest.mark.parametrize("name", PLAYED)
def test_nothing_is_found_in_a_few_random_sequences(name: str) -> None:
    target, count = PLAYED[name]
    played = [target(Random(f"{name}:test:{number}")) for number in range(count)]
    assert all(p.items > 0 for p in played)
    assert any(p.commands > 0 for p in played) == (name in ("guard", "loop"))


# --- a fuzzer that finds nothing may be blind: each target must find what is planted -------------------------------


def a_rejected_counter_is_stored(patch: Patch) -> None:
    reject = CounterCheck.reject

    def careless(self: CounterCheck) -> None:
        reject(self)
        self.last = None if self.last is None else (self.last + 1) % 15

    patch.setattr(CounterCheck, "reject", careless)


def permission_never_ends(patch: Patch) -> None:
    patch.setattr(Reception, "inhibit_reason", lambda *_: "")


def a_frame_may_come_again(patch: Patch) -> None:
    def careless(self: CounterCheck, counter: int) -> int:
        self.last = counter
        return 1

    patch.setattr(CounterCheck, "advance", careless)


def a_bad_frame_costs_one_good_one(patch: Patch) -> None:
    patch.setattr("emb_runtime.can.e2e.WEIGHT", 1)


def nothing_is_forgiven(patch: Patch) -> None:
    patch.setattr(LeakyCount, "forgive", lambda _: None)


def the_slew_is_not_limited(patch: Patch) -> None:
    patch.setattr("emb_runtime.safety.guard.slew_reference", lambda *_: 0.0)


def an_old_sample_is_good_enough(patch: Patch) -> None:
    patch.setattr("emb_runtime.safety.guard.OLDEST_SAMPLE_PERIODS", 3)


def the_guard_takes_a_29_bit_identifier_for_its_own(patch: Patch) -> None:
    decode = Message.decode
    patch.setattr(Message, "decode", lambda self, frame: decode(self, frame._replace(extended=False)))


def a_stop_frame_carries_a_current(patch: Patch) -> None:
    patch.setattr("emb_runtime.control.loop.STOP_FRAMES", 0)


def the_loop_fails_at_what_it_does_not_know(patch: Patch) -> None:
    patch.setattr(Reception, "inhibit_reason", lambda *_: 1 / 0)


@pytest.mark.parametrize(
    ("name", "plant"),
    [
        ("reception", a_rejected_counter_is_stored),
        ("reception", permission_never_ends),
        ("reception", a_frame_may_come_again),
        ("reception", a_bad_frame_costs_one_good_one),
        ("reception", nothing_is_forgiven),
        ("guard", the_slew_is_not_limited),
        ("guard", an_old_sample_is_good_enough),
        ("guard", the_guard_takes_a_29_bit_identifier_for_its_own),
        ("loop", permission_never_ends),
        ("loop", a_stop_frame_carries_a_current),
        ("loop", the_loop_fails_at_what_it_does_not_know),
    ],
)
def test_a_planted_fault_is_found(name: str, plant: Callable[[Patch], None], monkeypatch: Patch) -> None:
    plant(monkeypatch)
    target, _ = PLAYED[name]
    found = []
    for number in range(60):
        try:
            target(Random(f"{name}:planted:{number}"))
        except ViolationError:
            found.append(number)
            break
    assert found
