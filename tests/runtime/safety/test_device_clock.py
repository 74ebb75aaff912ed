"""The node's clock is held against the computer's to the nanosecond, in both directions, and adds up.

Any sequence of pairs is judged against an account that keeps every offset; what the rule is for is played with clocks
of a constant rate.
"""

from __future__ import annotations

from random import Random

import pytest

from emb_runtime.safety.device_clock import DeviceClock

MS = 1_000_000
BASE = 7_000 * MS  # Arrival less device time, of a frame without latency


class Account:
    """The rule told anew."""

    def __init__(self, period_ns: int) -> None:
        self.period_ns = period_ns
        self.allowance_ns = max(2 * period_ns, 2 * MS)
        self.follows_ns = 20 * period_ns // 2000  # 500 ppm of a window
        self.learned: list[int] = []  # Offsets of the pairs before arming, since the reference began
        self.moved_ns = 0
        self.offsets: list[int] = []
        self.errors = self.last_ns = 0
        self.problem = ""

    @property
    def reference_ns(self) -> int:
        return min(self.learned) + self.moved_ns

    def learn(self, device_ns: int, arrival_ns: int) -> bool:
        offset_ns, self.last_ns = arrival_ns - device_ns, device_ns
        steady = not self.learned or offset_ns >= self.learned[0] - self.allowance_ns
        self.learned = [*(self.learned if steady else []), offset_ns]
        return steady

    def judge(self, device_ns: int, arrival_ns: int, seen_ns: int) -> str:
        if self.problem:
            return self.problem
        elapsed_ns, self.last_ns = device_ns - self.last_ns, device_ns
        whole = max(round(elapsed_ns / self.period_ns), 1)
        on_grid = abs(elapsed_ns - whole * self.period_ns) <= self.period_ns // 4
        if elapsed_ns <= 0:
            self.problem = f"it went from one sample to the next by {elapsed_ns / 1e6:.3f} ms"
        else:
            self.errors = max(self.errors - 1, 0) if on_grid else min(self.errors + 4, 20)
        if self.errors == 20:
            apart = f"its samples are {elapsed_ns / 1e6:.3f} ms apart"
            self.problem = f"{apart}, the bench's period is {self.period_ns / 1e6:g} ms"
        self.offsets.append(arrival_ns - device_ns)
        if len(self.offsets) % 20 == 0:
            behind_ns = min(self.offsets[-20:]) - self.reference_ns
            if behind_ns > self.allowance_ns:
                self.problem = f"it has lost {behind_ns / 1e6:.3f} ms on this computer's"
            self.moved_ns += max(-self.follows_ns, min(behind_ns, self.follows_ns))
        ahead_ns = self.reference_ns - (seen_ns - device_ns)
        if ahead_ns > self.allowance_ns:
            self.problem = f"it has gained {ahead_ns / 1e6:.3f} ms on this computer's"
        return self.problem


@pytest.mark.parametrize("period_ns", [MS // 10, MS, 3 * MS, 4 * MS, 100 * MS])
def test_any_sequence_of_pairs_is_judged_as_by_the_account(period_ns: int) -> None:
    for seed in range(80):
        draw, clock, account = Random(seed), DeviceClock(period_ns), Account(period_ns)
        assert clock.allowance_ns == account.allowance_ns
        allowed_ns, device_ns, quarter_ns = account.allowance_ns, 100 * MS, period_ns // 4
        for _ in range(draw.choice((1, 2, 5))):
            if draw.random() < 0.2:
                clock.restart()
                account.learned = []
            device_ns += period_ns
            early_ns = draw.choice((0, 0, -300_000, 500_000, -allowed_ns, -allowed_ns - 1, 4 * allowed_ns))
            arrival_ns = BASE + device_ns + early_ns
            assert clock.learn(device_ns, arrival_ns) == account.learn(device_ns, arrival_ns)
        late_ns, off_ns, every = 0, 0, draw.choice((7, 20))
        strays = seed % 4 == 0  # else the problem would nearly always be there within the first window
        for number in range(90):
            if number % every == 0:
                late_ns = draw.choice((0, 0, 100, account.follows_ns - 1, account.follows_ns + 1, -account.follows_ns))
                late_ns = draw.choice((late_ns, late_ns, allowed_ns, allowed_ns + 1, -allowed_ns))
                if strays:
                    off_ns = draw.choice(
                        (*[0] * 3, quarter_ns, -quarter_ns, quarter_ns + 1, -quarter_ns - 1, period_ns // 2)
                    )
            stray = draw.random()
            elapsed_ns = draw.choice((1, 1, 1, 2, 7)) * period_ns + off_ns
            if stray < 0.01:
                elapsed_ns = draw.choice((0, -1, 1, quarter_ns, quarter_ns + 1, 3 * quarter_ns))
            device_ns += elapsed_ns
            arrival_ns = account.reference_ns + device_ns + late_ns
            if 0.01 < stray < 0.02:
                arrival_ns = account.reference_ns + device_ns - draw.choice((allowed_ns, allowed_ns + 1))
            seen_ns = arrival_ns + draw.choice((0, 0, 8 * period_ns))
            expected = account.judge(device_ns, arrival_ns, seen_ns)
            assert clock.time_problem(device_ns, arrival_ns, seen_ns) == expected, (seed, number)
            assert clock.problem == expected


def learned() -> tuple[DeviceClock, int]:
    """A clock that has learned from pairs without latency, and the device time of the last."""
    clock, device_ns = DeviceClock(MS), 100 * MS
    for _ in range(10):
        device_ns += MS
        assert clock.learn(device_ns, BASE + device_ns)
    return clock, device_ns


@pytest.mark.parametrize(("ppm", "earliest", "latest"), [(10_000, 205, 212), (-10_000, 205, 252), (1_000, 3900, 4100)])
def test_what_is_beyond_two_quartzes_adds_up(ppm: int, earliest: int, latest: int) -> None:
    """A clock of a constant rate; the arrivals are the computer's own milliseconds."""
    clock, device_ns = learned()
    for n in range(1, latest + 1):
        arrival_ns = BASE + device_ns + n * MS
        if clock.time_problem(device_ns + n * (MS + ppm), arrival_ns, arrival_ns):
            break
    assert clock.problem
    assert n >= earliest


@pytest.mark.parametrize("ppm", [-400, 0, 400])
def test_latencies_below_the_allowance_never_blame_a_quartz(ppm: int) -> None:
    for seed in range(30):
        draw, (clock, device_ns) = Random(seed), learned()
        for n in range(1, 191):
            arrival_ns = BASE + device_ns + n * MS + draw.choice((0, 1_900_000, draw.randrange(1_900_000)))
            assert clock.time_problem(device_ns + n * (MS + ppm), arrival_ns, arrival_ns) == "", (seed, n)


def test_samples_a_quarter_of_a_period_apart_are_off_the_grid() -> None:
    clock, device_ns = learned()
    for n in range(1, 20):
        at_ns = device_ns + n * (MS // 4)
        clock.time_problem(at_ns, BASE + at_ns, BASE + at_ns)
    assert clock.problem == "its samples are 0.250 ms apart, the bench's period is 1 ms"
