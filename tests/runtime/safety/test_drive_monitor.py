"""What the drive reports must lie among the last commands that it says it obeyed: the rule against an account of it."""

from __future__ import annotations

import math
from random import Random

from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.safety.drive_monitor import DriveCheck

TOLERANCE, LIMIT = 0.5, 6.0
JUST = 1e-9  # Beyond a border [A]


class Account:
    """The rule told anew, with all that was obeyed."""

    def __init__(self) -> None:
        self.sent: dict[int, float] = {}
        self.obeyed = [0.0]  # before the first command nothing flowed
        self.errors = 0

    def ends(self) -> tuple[float, float]:
        """Least and greatest current of the last six commands, what flowed before the first one among them."""
        last = ([self.obeyed[0]] * 6 + self.obeyed[1:])[-6:]
        return min(last), max(last)

    def judge(self, counter: int, applied: float) -> str:
        if counter == NO_COUNTER:
            possible = abs(applied) <= LIMIT + TOLERANCE
            self.obeyed = [applied if possible else 0.0]  # where the next command's current begins
            told = f"it reports {applied:.2f} A of its braking, at most 6 A"
            return "" if possible else self.bad(told)
        if counter in self.sent:
            self.obeyed.append(self.sent[counter])
            low, high = self.ends()
            if low - TOLERANCE <= applied <= high + TOLERANCE:
                self.errors = max(self.errors - 1, 0)
                return ""
            return self.bad(f"it reports {applied:.2f} A, commanded were {low:.2f} to {high:.2f} A")
        return self.bad(f"it reports that it obeyed command {counter}, which was never sent")

    def bad(self, told: str) -> str:
        """Five in a row are too many, and four good ones forgive a bad one."""
        self.errors = min(self.errors + 4, 20)
        return told if self.errors == 20 else ""


def test_any_sequence_of_reports_is_judged_as_by_the_account() -> None:
    for seed in range(150):
        draw, check, account = Random(seed), DriveCheck(TOLERANCE, LIMIT), Account()
        honest = draw.choice((0.2, 0.7, 0.95))
        for number in range(60):
            counter = number % 15
            if draw.random() < 0.9:
                current = draw.choice((-6.0, -3.0, 0.0, 1.0, 3.0, 6.0))
                check.sent(counter, current)
                account.sent[counter] = current
            if draw.random() < 0.15:
                counter = NO_COUNTER
                wrong = [
                    math.nan,
                    math.inf,
                    -math.inf,
                    20.0,
                    -20.0,
                    LIMIT + TOLERANCE + JUST,
                    -LIMIT - TOLERANCE - JUST,
                ]
                right = [LIMIT + TOLERANCE, -LIMIT - TOLERANCE, 0.0, 5.0]
            else:
                counter = draw.randrange(15) if draw.random() < 0.05 else counter
                last = Account()
                last.obeyed = [*account.obeyed, account.sent.get(counter, 0.0)]
                low, high = last.ends()
                wrong = [math.nan, math.inf, low - TOLERANCE - JUST, high + TOLERANCE + JUST]
                right = [low - TOLERANCE, high + TOLERANCE, low, high]
            applied = draw.choice(right if draw.random() < honest else wrong)
            assert check.current_problem(counter, applied) == account.judge(counter, applied), seed
            assert check.errors == account.errors, seed


@given(st.lists(st.sampled_from([-6.0, 0.0, 6.0]), min_size=1, max_size=60), st.floats(0.1, 2.0))
def test_a_current_loop_of_two_periods_is_not_blamed(commands: list[float], lag: float) -> None:
    check, applied = DriveCheck(TOLERANCE, LIMIT), 0.0
    for n, u in enumerate(commands):
        applied = u + (applied - u) * math.exp(-1.0 / lag)
        check.sent(n % 15, u)
        assert check.current_problem(n % 15, applied) == ""
