"""Fuzz: random, mutated and forged frames and sequences of events, judged by accounts that share no code with ours.

    python -m tests.searches.fuzz [--seed 0] [--scale 1.0] [--target guard [--sequence 17]]

Each sequence is drawn by a generator seeded with its target, the seed and its number, so that any of them can be played
again alone: ``--target NAME --sequence NUMBER`` shows its traceback. "hangs" are sequences that took more than a
minute, or a run that would not end; "wrong" are verdicts that differ from the independent account's, and each illegal
one of the commands that reached the bus. Ends with 1 if anything was found.
"""

from __future__ import annotations

import argparse
import itertools
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from random import Random

from emb_runtime.can.codec import FrameRejectedError
from emb_runtime.can.messages import load_layout
from emb_runtime.records import Frame
from tests.fuzz import runs
from tests.fuzz.runs import HangError
from tests.fuzz.stream import Played, ViolationError
from tests.fuzz.targets import TARGETS
from tests.independent import protected

LAYOUT = load_layout()
LONGEST = 60.0  # Time for one sequence [s]; the slowest takes a tenth of a second
FINDINGS = ("exceptions", "hangs", "wrong")


def valid_frame(draw: Random) -> Frame:
    """A frame of ours that says anything that it may."""
    message = draw.choice(list(LAYOUT.messages.values()))
    raws = [draw.randint(s.raw_minimum, s.raw_maximum) for s in message.signals[1:]]
    word = sum((raw & s.mask) << s.shift for raw, s in zip(raws, message.signals[1:], strict=True))
    return Frame(message.identifier, protected(message.identifier, word.to_bytes(message.length, "little")[1:]))


def bit_errors(draw: Random) -> Played:
    """Every frame with one or two wrong bits that can be made of a valid one is rejected."""
    frame = valid_frame(draw)
    message = next(m for m in LAYOUT.messages.values() if m.identifier == frame.identifier)
    word, count = int.from_bytes(frame.data, "little"), 0
    for first, second in itertools.combinations_with_replacement(range(8 * message.length), 2):
        data = (word ^ (1 << first | 1 << second)).to_bytes(message.length, "little")
        count += 1
        try:
            message.decode(Frame(frame.identifier, data))
        except FrameRejectedError:
            continue
        raise ViolationError(frame, "with bits", first, second, "wrong was accepted")
    return Played(count)


@dataclass(frozen=True)
class Entry:
    """Target of the fuzzing, and its default number of inputs."""

    target: Callable[[Random], Played]
    sequences: int
    judge: str


ENTRIES = {
    "bit-errors": Entry(bit_errors, 500, "every 1- and 2-bit error of valid frames is rejected"),
    "reception": Entry(TARGETS["reception"], 3_000, "model with its own codec: samples, counters, permission"),
    "guard": Entry(TARGETS["guard"], 3_000, "model in whole steps: sent if and only if legal"),
    "loop": Entry(runs.run, 1_500, "each command on the bus by cantools, E2E library, model of the reception"),
}


@contextmanager
def bounded() -> Iterator[None]:
    """End what takes longer than a sequence may."""

    def expired(_number: int, _frame: object) -> None:
        raise HangError(f"more than {LONGEST:g} s")

    signal.signal(signal.SIGALRM, expired)
    signal.setitimer(signal.ITIMER_REAL, LONGEST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def fuzz(name: str, entry: Entry, seed: int, count: int) -> Counter[str]:
    """Play the first sequences of a target: frames or events, commands on the bus, and findings by their kind."""
    found = Counter[str]()
    for number in range(count):
        try:
            with bounded():
                items, commands = entry.target(Random(f"{name}:{seed}:{number}"))
            found.update(items=items, commands=commands)
        except (Exception, HangError) as error:
            kind = {HangError: "hangs", ViolationError: "wrong"}.get(type(error), "exceptions")
            if not any(found[each] for each in FINDINGS):
                print(
                    f"  first: --target {name} --sequence {number}: {type(error).__name__}: {error}"[:400], flush=True
                )
            found[kind] += 1
    return found


def main() -> int:
    """Fuzz all targets, or the requested ones, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scale", type=float, default=1.0, help="so many times as many sequences")
    parser.add_argument("--target", choices=ENTRIES, help="this one alone")
    parser.add_argument("--sequence", type=int, help="of the target, this sequence alone, with its traceback")
    args = parser.parse_args()
    if args.sequence is not None:
        if args.target is None:
            parser.error("--sequence needs --target")
        print(ENTRIES[args.target].target(Random(f"{args.target}:{args.seed}:{args.sequence}")))
        return 0
    findings = 0
    print("| target | sequences | frames, events | commands on the bus | exceptions | hangs | wrong | s | judged by |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in [args.target] if args.target else ENTRIES:
        entry, begin = ENTRIES[name], time.monotonic()
        count = max(1, round(entry.sequences * args.scale))
        found = fuzz(name, entry, args.seed, count)
        counts = [f"{n:,}" for n in (count, *(found[each] for each in ("items", "commands", *FINDINGS)))]
        print(f"| {name} | {' | '.join(counts)} | {time.monotonic() - begin:.0f} | {entry.judge} |", flush=True)
        findings += sum(found[each] for each in FINDINGS)
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
