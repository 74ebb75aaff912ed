"""What is fuzzed, each against an account of it that is written anew: the reception here, the guard in its own tests.

A target plays one sequence of choices and says how much that was. It raises :class:`~tests.fuzz.stream.ViolationError`
for what must not be; every other exception that leaves it is a finding as well.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from emb_runtime.can.messages import load_layout
from emb_runtime.can.receiver import Reception
from emb_runtime.config.bench import load_bench
from tests.fuzz.model import ReceptionModel
from tests.fuzz.stream import MS, Played, Stream, demand
from tests.runtime.safety.test_guard import play

LENGTH = 100  # Frames in a sequence
BENCH, LAYOUT = load_bench(), load_layout()


def reception(draw: Random) -> Played:
    """Whatever is lost, damaged, repeated, swapped, forged or mistimed, no frame counts for more than it is."""
    stream, model = Stream(draw), ReceptionModel(BENCH)
    taken = Reception(LAYOUT, BENCH, lambda _frame, _why: None)
    count = 0
    while count < LENGTH:
        for frame in stream.period():
            count += 1
            ours, expected = taken.add_frame(frame), model.take(frame)
            demand(ours == expected, frame, "made", ours, "expected", expected)
            now_ns = frame.time_ns + draw.randint(-2 * MS, 3 * MS)
            demand((taken.inhibit_reason(now_ns) == "") == model.permitted(now_ns), "permission at", now_ns, taken)
            compare(taken, model)
    return Played(count)


def compare(taken: Reception, model: ReceptionModel) -> None:
    """The reception has counted what the model has."""
    seen = (taken.rejected, taken.too_many_rejected, taken.foreign_command)
    demand(seen == (model.rejected, model.too_many, model.foreign), "counted", seen, "expected", model)
    for state in taken.states:
        key = 0 if state.name == "pair" else state.identifier
        demand(state.errors.errors == model.errors[key], state.name, "leaky count", state.errors.errors)
        demand(state.errors.last == model.counters.get(key), state.name, "stored counter", state.errors.last)


TARGETS: dict[str, Callable[[Random], Played]] = {"reception": reception, "guard": play}
