"""The shield's laws and decisions of shipped numbers to the last bit: a change of the code must not change them.

That the numbers are right is shown by ``test_shield_design_reference.py`` and ``test_shield_reference.py``.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable
from random import Random
from typing import Any

import pytest

from emb_runtime.safety.command_limits import CommandLimits, decide
from emb_runtime.safety.shield_design import ShieldLaw, make_law
from tests.laws import numbers
from tests.properties.shield_search import bench_with

COASTING = {"envelope": "coasting", "angle_margin": 1.1}
PINNED: dict[str, tuple[dict[str, Any], str, str]] = {
    "shipped": ({}, "bcc80fbf85c5546a", "8be85b96d02b3130"),
    "lagging": ({"current_lag": 0.002}, "2b6f7edada5bbdb7", "c17f5a1f891682a0"),
    "late": ({"frame_age": (0, 3)}, "86bb046f111720ad", "00b847c61a6e6b19"),
    "of one age": ({"frame_age": (1, 1)}, "185d1f3062e36c5a", "0c731be54ff2e987"),
    "observed": ({"observer": 1520.0}, "49c4fcd093ae98c0", "77b72fca9686517e"),
    "observed, late": ({"observer": 1520.0, "frame_age": (0, 1)}, "b1723592029e77f7", "8e5c56837e0fac11"),
    "coasting": (COASTING, "f454d49bd7d2eb2b", "d99565461ca7e2db"),
}
"""Settings of the shield; digests of its law, and of its decisions."""


def digest(numbers: Iterable[float]) -> str:
    """SHA-256 of doubles, shortened."""
    return hashlib.sha256(b"".join(struct.pack("<d", number) for number in numbers)).hexdigest()[:16]


def law_of(settings: dict[str, Any]) -> ShieldLaw:
    """Law of the shipped bench with a sensor of the velocity, or an observer, and other settings of the shield."""
    return make_law(bench_with(**settings))


@pytest.mark.parametrize("name", PINNED)
def test_a_law_is_the_same_to_the_last_bit(name: str) -> None:
    settings, expected, _ = PINNED[name]
    assert digest(numbers(law_of(settings)).values()) == expected


@pytest.mark.parametrize("name", PINNED)
def test_decisions_are_the_same_to_the_last_bit(name: str) -> None:
    settings, _, expected = PINNED[name]
    law, dice = law_of(settings), Random(4)
    found: list[float] = []
    for _ in range(20_000):
        limits = CommandLimits(dice.choice((6.0, 2.0)), dice.choice((12.0, 1.5)))
        state = dice.uniform(-12.0, 105.0), dice.uniform(-520.0, 520.0)
        if dice.random() < 0.3:  # near home, where the way home ends
            state = dice.uniform(-0.6, 0.6), dice.uniform(-30.0, 30.0)
        a, b, c, d, e = (dice.uniform(-6.0, 6.0) for _ in range(5))
        requested = dice.uniform(-7.0, 7.0)
        decision = decide(law, limits, *state, requested, (a, b, c, d, e), a, dice.randrange(law.steps))
        assert decision.requested == requested
        found += decision[1:]
    assert digest(found) == expected
