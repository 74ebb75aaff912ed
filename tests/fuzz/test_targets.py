"""The fuzz targets in small numbers, a million in ``tests/searches/fuzz.py``; and the faults that they must find."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_runtime.can.codec import Message
from emb_runtime.can.e2e import CounterCheck
from emb_runtime.can.receiver import Reception
from emb_runtime.records import Frame, RunState
from emb_runtime.safety import state_machine
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.state_machine import Event, Fault
from tests.fuzz import runs
from tests.fuzz.targets import TARGETS, Played, ViolationError

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


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=20)
@given(draw=st.randoms(use_true_random=False))
def test_nothing_is_found_whatever_hypothesis_chooses(name: str, draw: Random) -> None:
    assert 0 < TARGETS[name](draw).items <= 110


# --- a fuzzer that finds nothing may be blind: each target must find what is planted -------------------------------


def reserved_bits_are_ignored(patch: Patch) -> None:
    decode = Message.decode

    def careless(self: Message, frame: Frame) -> dict[str, Any]:
        object.__setattr__(self, "reserved", 0)
        return decode(self, frame)

    originals = {id(m): m.reserved for m in runs.LAYOUT.messages.values()}
    patch.setattr(Message, "decode", careless)
    for message in runs.LAYOUT.messages.values():  # so that undoing puts them back
        patch.setitem(message.__dict__, "reserved", originals[id(message)])


def a_rejected_counter_is_stored(patch: Patch) -> None:
    reject = CounterCheck.reject

    def careless(self: CounterCheck) -> None:
        reject(self)
        self.last = None if self.last is None else (self.last + 1) % 15

    patch.setattr(CounterCheck, "reject", careless)


def permission_never_ends(patch: Patch) -> None:
    patch.setattr(Reception, "inhibit_reason", lambda *_: "")


def a_run_that_stops_can_be_begun_again(patch: Patch) -> None:
    patch.setitem(state_machine._NEXT, (RunState.STOPPING, Event.BEGIN), RunState.ACTIVE)


def the_first_fault_is_forgotten(patch: Patch) -> None:
    faulted = state_machine._faulted

    def careless(run: state_machine.Run, fault: Fault, now_ns: int) -> state_machine.Run:
        return faulted(run._replace(fault=None), fault, now_ns)

    patch.setattr(state_machine, "_faulted", careless)


def the_slew_is_not_limited(patch: Patch) -> None:
    patch.setattr("emb_runtime.safety.guard.slew_reference", lambda *_: 0.0)


def an_old_sample_is_good_enough(patch: Patch) -> None:
    patch.setattr("emb_runtime.safety.guard.OLDEST_SAMPLE_PERIODS", 3)


def the_guard_mends_what_it_should_reject(patch: Patch) -> None:
    send = Guard.send

    def careless(self: Guard, frame: Frame, *rest: Any) -> None:
        send(self, frame._replace(extended=False), *rest)

    patch.setattr(Guard, "send", careless)


def a_stop_frame_carries_a_current(patch: Patch) -> None:
    patch.setattr("emb_runtime.control.loop.STOP_FRAMES", 0)


def the_loop_fails_at_what_it_does_not_know(patch: Patch) -> None:
    patch.setattr(Reception, "inhibit_reason", lambda *_: 1 / 0)


@pytest.mark.parametrize(
    ("name", "plant"),
    [
        ("decoder", reserved_bits_are_ignored),
        ("reception", a_rejected_counter_is_stored),
        ("reception", permission_never_ends),
        ("machine", a_run_that_stops_can_be_begun_again),
        ("machine", the_first_fault_is_forgotten),
        ("guard", the_slew_is_not_limited),
        ("guard", an_old_sample_is_good_enough),
        ("guard", the_guard_mends_what_it_should_reject),
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
