"""The loop killed at random moments of a run on a real vcan0: who stops the brake, how soon, and what the log lacks.

    python -m tests.searches.kills [--kills 200] [--seed 1]

Each run is killed after a random number of enabled commands and a random part of a period, so in any phase of a cycle.
The plays and their judgement are those of ``make hil``. Needs what that needs.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from pathlib import Path

from tests.hil.judge import WATCHDOG_MS, judge, seen
from tests.hil.plays import perform
from tests.scenarios.table import IN_HAND, Scenario

PERIOD, LAST = 1e-3, 480
"""Of the shipped bench [s]; the last command that is waited for, of 500."""


def killed(number: int, draw: random.Random) -> Scenario:
    """A run that is killed once."""
    after, pause = draw.randint(1, LAST), draw.uniform(0.0, PERIOD)
    kill = {"do": "signal", "to": "run", "signal": "SIGKILL", "after": after, "pause": pause, "stops": 0}
    return Scenario(f"kill_{number:03d}", f"kill -9 after command {after}", (), None, (kill,), may_lose=IN_HAND)


def main() -> int:
    """Print the table; 1 if a kill leaves anything that must not be."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--kills", type=int, default=200)
    p.add_argument("--seed", type=int, default=1)
    arguments = p.parse_args()
    draw = random.Random(arguments.seed)
    plays = [killed(number, draw) for number in range(arguments.kills)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "kills"
        perform(plays, folder)
        verdicts = [judge(seen(play, folder)) for play in plays]
    wrong = 0
    for play, verdict in zip(plays, verdicts, strict=True):
        faults = [*verdict.wrong]
        if verdict.frames_lost is None or verdict.frames_lost > IN_HAND:
            faults.append(f"{verdict.frames_lost} frames are not in the log")
        wrong += bool(faults)
        for fault in faults:
            print(f"{play.name}, {play.what}: {fault}")
    stops = [v.stop_ms for v in verdicts if v.stop_ms is not None]
    lost = [v.frames_lost for v in verdicts if v.frames_lost is not None]
    what = f"loop killed at {len(plays)} moments, seed {arguments.seed}"
    print(f"| {what}: with anything wrong | 0 | {wrong} |")
    print(f"| {what}: longest to the node's stop [ms] | {WATCHDOG_MS + 2:g} | {max(stops, default=float('nan')):.1f} |")
    print(f"| {what}: most frames that a log lacks | {IN_HAND} | {max(lost, default=-1)} |")
    return 1 if wrong or len(stops) < len(plays) else 0


if __name__ == "__main__":
    sys.exit(main())
