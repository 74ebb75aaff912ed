"""Every fault that can be played against emb-run and emb-node, on a real bus, with the time-outs as shipped.

    python -m tests.searches.faults [NAME ...] [--keep DIR]

In User-Mode Linux, 1000 times slower than this computer, so that a busy machine changes nothing. Prints for each:
emb-run's report, device time from the last obeyed command to the node's safe stop (limit: the node's watchdog and two
periods), bus time from the fault to the stop (of a lying node, in its periods from the first lie), largest true
excursion, frames missing in the log. Ends with 1 if anything is as it must not be.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "drives"))

from tests.hil.judge import WATCHDOG_MS, Verdict, judge, seen
from tests.hil.plays import PLAYS, perform


def main() -> int:
    """Play, judge, print; gives the exit code."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("names", nargs="*", metavar="NAME", help="only these (default: all)")
    p.add_argument("--keep", type=Path, metavar="DIR", help="where logs and frames are kept (default: nowhere)")
    args = p.parse_args()
    if unknown := sorted(set(args.names) - {play.name for play in PLAYS}):
        p.error(f"no such fault: {', '.join(unknown)}; there are: {', '.join(play.name for play in PLAYS)}")
    plays = [play for play in PLAYS if not args.names or play.name in args.names]
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        where = (args.keep or Path(folder)).resolve()
        perform(plays, where)
        verdicts = [judge(seen(play, where)) for play in plays]
    limit = WATCHDOG_MS + 2.0
    print(f"{len(plays)} faults in {time.monotonic() - began:.0f} s of real time; limit {limit:g} ms\n")
    print(
        f"{'fault':55} {'emb-run said':18} {'stop':>8} {'reaction':>9} {'angle [rad]':>16} {'[rad/s]':>8} {'lost':>5}"
    )
    for play, verdict in zip(plays, verdicts, strict=True):
        print(row(play.what, verdict))
        for reason in verdict.wrong:
            print(f"    WRONG: {reason}")
    stops = [v.stop_ms for p, v in zip(plays, verdicts, strict=True) if p.stops and not p.node_lost and v.stop_ms]
    latest = max(stops, default=math.nan)
    print(f"\nlatest safe stop {latest:.1f} ms after the last obeyed command, ratio to the limit {latest / limit:.2f}")
    wrong = sum(bool(v.wrong) for v in verdicts)
    print(f"{wrong} of {len(plays)} faults with something wrong")
    return 1 if wrong else 0


def row(what: str, v: Verdict) -> str:
    """A line of the table."""
    angle = "unknown" if math.isnan(v.angle[0]) else f"{v.angle[0]:.2f}..{v.angle[1]:.2f}"
    speed = "unknown" if math.isnan(v.top_speed) else f"{v.top_speed:.1f}"
    return (
        f"{what:55} {v.result:18} {_ms(v.stop_ms):>8} {_ms(v.reaction_ms):>9} {angle:>16} {speed:>8} "
        f"{'-' if v.frames_lost is None else v.frames_lost:>5}"
    )


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} ms"


if __name__ == "__main__":
    sys.exit(main())
