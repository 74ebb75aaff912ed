"""Comparison of the compiled core with its sources, bit for bit, on drawn inputs.

:func:`difference` is what ``emb-run`` asks at its start, with few inputs; ``benchmarks/compiled_core.py`` asks the same
with a million for each of :data:`COMPARISONS`. Among the numbers drawn are the edges (0, infinities, NaN, subnormals)
and any pattern of 64 bits. An exception is an answer like any other: its kind and its words must be the same.

Nothing is imported of the core by name: it is loaded twice, compiled and from its sources.
"""

from __future__ import annotations

import importlib
import math
import random
import struct
from collections.abc import Callable, Iterator
from functools import cache
from itertools import islice, zip_longest
from textwrap import shorten
from typing import Any, NamedTuple

from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.config.shield_config import shield_config
from emb_runtime.records import CurrentCommand, Frame, NodeState, RunState, SensorSample
from emb_runtime.system import compiled_core

INPUTS = 100  # Inputs of each comparison at the start of ``emb-run``
EDGES = (0.0, -0.0, 1.0, -6.0, 6.0, 5e-324, -2.2e-308, 1e6, 1e308, math.inf, -math.inf, math.nan)


class Modules(NamedTuple):
    """The modules that are compared; what they are is known at run time only."""

    e2e: Any
    codec: Any
    messages: Any
    receiver: Any
    shield: Any
    shield_design: Any
    command_limits: Any
    drive_monitor: Any
    guard: Any
    sensor_thresholds: Any
    sensor_monitor: Any
    state_machine: Any
    assumptions: Any
    known: Any
    law: Any
    bounded: Any
    start_conditions: Any
    result: Any
    scalar_operations: Any


_ROOMS = (*("can",) * 4, *("safety",) * 8, *("learning",) * 4, *("control",) * 2, "policy")
_NAMES = tuple(f"emb_runtime.{room}.{name}" for room, name in zip(_ROOMS, Modules._fields, strict=True))


def difference(count: int = INPUTS, seed: int = 0) -> str:
    """Compare the compiled core, which this process runs, with its sources.

    Args:
        count: inputs of each comparison.
        seed: of the drawing.

    Returns:
        The first difference, in words; empty if there is none.
    """
    compiled, plain = cores()
    for name, compare in COMPARISONS.items():
        if found := compared(compare, compiled, plain, count, seed):
            return f"{name}: {found}"
    return ""


def cores() -> tuple[Modules, Modules]:
    """The compiled core, which this process runs, and its sources."""
    return Modules(*map(importlib.import_module, _NAMES)), Modules(*compiled_core.sources(*_NAMES))


Comparison = Callable[[Modules, random.Random], Iterator[Any]]
"""Answers of a core, without end, to inputs drawn from the dice."""


def compared(compare: Comparison, compiled: Modules, plain: Modules, count: int, seed: int) -> str:
    """First difference of two cores in one comparison; empty if there is none."""
    runs = (islice(compare(core, random.Random(seed)), count) for core in (compiled, plain))
    for number, (one, other) in enumerate(zip_longest(*runs)):
        if bits(one) != bits(other):
            said = (shorten(repr(answer), 80, placeholder=" …") for answer in (one, other))
            return f"input {number}: compiled {next(said)}, Python {next(said)}"
    return ""


def bits(answer: Any) -> Any:
    """An answer in such a form that equal means bit for bit; an enumeration's member is its number.

    One NaN is as good as another: IEEE 754 leaves its sign and payload open, and on aarch64 a compiled product of a
    negated number has another sign than Python's.
    """
    if isinstance(answer, float):
        return "NaN" if math.isnan(answer) else struct.pack("<d", answer)
    if isinstance(answer, int) and not isinstance(answer, bool):
        return int(answer)
    if isinstance(answer, (tuple, list)):
        return tuple(map(bits, answer))
    return type(answer).__name__, answer


def _tried(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except Exception as err:
        return type(err).__name__, str(err), str(getattr(err, "detail", ""))


def _number(dice: random.Random, scale: float) -> float:
    kind = dice.random()
    if kind < 0.9:
        return dice.uniform(-scale, scale)
    if kind < 0.97:
        return dice.choice(EDGES)
    number: float = struct.unpack("<d", dice.randbytes(8))[0]
    return number


@cache
def _bench() -> Bench:
    return load_bench()


def _laws(core: Modules) -> list[Any]:
    law = core.shield_design.make_law(_bench())
    return [
        law,
        law._replace(age_high=2),
        law._replace(age_low=1, age_high=1, lag=2e-4, kept=math.exp(-5.0)),
        law._replace(coasting=True, damping_velocity=math.inf),
    ]


def _drawn_past(dice: random.Random) -> tuple[float, ...]:
    return tuple(_number(dice, 6.0) for _ in range(5))


def _shield(core: Modules, dice: random.Random) -> Iterator[Any]:
    laws = _laws(core)
    yield laws
    while True:
        law, past = dice.choice(laws), _drawn_past(dice)
        angle, velocity, wanted = _number(dice, 110.0), _number(dice, 510.0), _number(dice, 7.0)
        step = dice.randrange(-1, law.steps + 2)
        yield (
            _tried(core.shield.shield, law, angle, velocity, wanted, past, step),
            _tried(core.shield.window, law, angle, velocity, past),
            _tried(core.shield.damped_current, velocity, law.current, law.damping_velocity),
        )


def _successor(core: Modules, dice: random.Random) -> Iterator[Any]:
    laws = _laws(core)
    while True:
        box = (_number(dice, 110.0), _number(dice, 110.0), _number(dice, 510.0), _number(dice, 510.0))
        yield _tried(core.shield.successor, dice.choice(laws), *box, _number(dice, 6.0))


def _decide(core: Modules, dice: random.Random) -> Iterator[Any]:
    laws, limits = _laws(core), core.command_limits
    while True:
        reach = limits.Reach(abs(_number(dice, 6.0)), abs(_number(dice, 12.0)))
        asked = _tried(limits.checked, _number(dice, 7.0), 6.0)
        wanted = asked if isinstance(asked, float) else 0.0
        state, past = (_number(dice, 110.0), _number(dice, 510.0)), _drawn_past(dice)
        last, step = _number(dice, 6.0), dice.randrange(0, 501)
        yield asked, _tried(limits.decide, dice.choice(laws), reach, *state, wanted, past, last, step)


def _e2e(core: Modules, dice: random.Random) -> Iterator[Any]:
    e2e = core.e2e
    check = e2e.CounterCheck(5)
    while True:
        data, start, counter = dice.randbytes(dice.randrange(1, 9)), dice.randrange(256), dice.randrange(-1, 16)
        payload = e2e.protect(start, data[1:]) if dice.random() < 0.5 else data
        yield (
            *(e2e.crc8_j1850(data), e2e.profile1_start(dice.randrange(65536)), payload, e2e.check(start, payload)),
            *(e2e.next_counter(counter), _tried(check.step, counter), check.last, check.errors),
        )


def _codec(core: Modules, dice: random.Random) -> Iterator[Any]:
    layout = core.messages.load_layout()
    decoders = (layout.decode_command, layout.decode_angle, layout.decode_velocity, layout.decode_status)
    while True:
        for message, decode in zip(layout.messages.values(), decoders, strict=True):
            wanted = [_drawn_value(dice, signal) for signal in message.signals[1:]]
            packed = _tried(message.pack, *wanted)
            frame = packed if isinstance(packed, Frame) else _drawn_frame(core, dice, message)
            yield packed, _tried(decode, frame), _tried(message.decode, frame), message.unpack(frame.data.ljust(8))


def _drawn_value(dice: random.Random, signal: Any) -> Any:
    """A value in a signal's range, mostly: an int where it is whole."""
    if dice.random() < 0.03:
        return _number(dice, 2.0 * abs(signal.maximum) + 1.0)
    raw = dice.randint(signal.raw_minimum, signal.raw_maximum)
    return raw * signal.factor + signal.offset


def _drawn_frame(core: Modules, dice: random.Random, message: Any) -> Frame:
    body = dice.randbytes(message.length - 1 if dice.random() < 0.9 else dice.randrange(1, 8))
    data = core.e2e.protect(message.crc_start, body) if dice.random() < 0.8 else bytes(1) + body
    return Frame(message.identifier, data, error=dice.random() < 0.05, extended=dice.random() < 0.05)


def _reception(core: Modules, dice: random.Random) -> Iterator[Any]:
    """A stream of pairs, with gaps, jumps, repeats, and frames that are none."""
    bench, layout = _bench(), core.messages.load_layout()
    told: list[str] = []
    take = core.receiver.Reception(layout, bench, lambda _frame, why: told.append(why))
    counter, time_ns, angle, velocity = 0, 10**9, 0.0, 0.0
    messages = list(layout.messages.values())
    while True:
        counter, time_ns = (
            (counter + dice.choice((0, 1, 1, 1, 1, 1, 1, 2))) % 15,
            time_ns + dice.randrange(0, 3_000_000),
        )
        velocity = max(min(velocity + dice.uniform(-9.0, 9.0), 400.0), -400.0)
        angle = dice.uniform(0.0, 80.0) if dice.random() < 0.05 else max(min(angle + 1e-3 * velocity, 90.0), -9.0)
        frames = (
            layout.encode_angle(counter, angle, time_ns),
            layout.encode_velocity(counter, velocity, dice.uniform(-6.0, 6.0), dice.choice(tuple(NodeState)), counter),
            _drawn_frame(core, dice, dice.choice(messages)),
        )
        for frame in frames[: 2 + (dice.random() < 0.1)]:
            sample = take.take(frame._replace(time_ns=time_ns, own=dice.random() < 0.01, dropped=counter // 14))
            yield (
                *(sample, take.permitted(time_ns + dice.randrange(-(10**7), 10**8)), take.rejected, take.dropped),
                *(take.too_many_rejected, take.foreign_command, list(told), take.status, str(take.rejections())),
            )
            told.clear()
        if take.foreign_command or take.too_many_rejected:
            take = core.receiver.Reception(layout, bench, lambda _frame, why: told.append(why))


def _drive(core: Modules, dice: random.Random) -> Iterator[Any]:
    while True:
        check = core.drive_monitor.DriveCheck(0.5, 6.0)
        for _ in range(50):
            counter, current = dice.randrange(15), _number(dice, 6.0)
            check.sent(counter, current)
            obeyed = counter if dice.random() < 0.8 else dice.randrange(16)
            applied = current + dice.uniform(-0.6, 0.6) if dice.random() < 0.8 else _number(dice, 6.0)
            yield _tried(check.judge, obeyed, applied), check.errors


def _sensors(core: Modules, dice: random.Random) -> Iterator[Any]:
    monitor, laws = core.sensor_monitor, _laws(core)[:2]
    limits = core.sensor_thresholds.sensor_thresholds(_bench(), laws[0])
    while True:
        law, memory = dice.choice(laws), [0.0] * monitor.MEMORY
        angle, velocity = dice.uniform(-5.0, 80.0), dice.uniform(-300.0, 300.0)
        monitor.begin(memory, angle, velocity)
        for _ in range(40):
            elapsed, current = dice.choice((1e-3, 1e-3, 1e-3, 2e-3)), _number(dice, 6.0)
            velocity += dice.uniform(-6.0, 6.0)
            angle += elapsed * velocity
            measured = (_number(dice, 100.0), velocity) if dice.random() < 0.02 else (angle, velocity)
            obeyed, reported = dice.random() < 0.9, current + dice.uniform(-0.5, 0.5)
            verdict = _tried(monitor.judge, law, limits, memory, elapsed, *measured, obeyed, current, reported)
            yield verdict, list(memory), monitor.largest_current(law, limits, memory, 6.0)


def _learning(core: Modules, dice: random.Random) -> Iterator[Any]:
    """Answers to a brake that moves about as it should, with both models, and the law then."""
    bench, setting = _bench(), shield_config(_bench())
    plain = core.assumptions.make_assumptions(bench)
    while True:
        assumed = plain._replace(flow=dice.random() < 0.5, model_error=dice.choice((0.0, 50.0)))
        state = core.bounded.start(assumed)
        angle, velocity, current = dice.uniform(-1.0, 40.0), dice.uniform(-200.0, 200.0), 0.0
        for _ in range(30):
            measured = (angle + dice.gauss(0.0, 1e-3), velocity + dice.gauss(0.0, 1.0))
            if dice.random() < 0.05:
                answer = _tried(core.bounded.lose, assumed, state)
            else:
                heard = (_number(dice, 100.0), velocity) if dice.random() < 0.01 else measured
                answer = _tried(core.bounded.hear, assumed, state, *heard, current)
            known = core.known.known(state)
            yield answer, list(state), known, _tried(core.law.law_for, setting, bench.brake, known)
            current = dice.uniform(-6.0, 6.0)
            push = plain.motor * current - plain.spring * max(angle, 0.0) - plain.viscous * velocity
            angle += 1e-3 * velocity
            velocity += 1e-3 * (push - math.copysign(plain.coulomb, velocity))


def _guard(core: Modules, dice: random.Random) -> Iterator[Any]:
    bench, layout = _bench(), core.messages.load_layout()
    while True:
        sent: list[Frame] = []
        guard = core.guard.Guard(layout, bench, sent.append, None, dice.choice((1.0, 6.0)))
        now_ns, current = 10**9, 0.0
        for _ in range(100):
            now_ns += dice.randrange(0, 2_000_000)
            current = max(min(current + dice.uniform(-4.0, 4.0), 6.0), -6.0) if dice.random() < 0.98 else 0.0
            enable, answers = dice.random() < 0.97, dice.randrange(15)
            counter = guard.next_counter if dice.random() < 0.95 else dice.randrange(15)
            command = CurrentCommand(counter, answers, current if enable or dice.random() < 0.1 else 0.0, enable)
            state = RunState.ACTIVE if dice.random() < 0.95 else dice.choice(tuple(RunState))
            frame, sampled_ns = layout.encode_command(command), now_ns - dice.randrange(0, 2_100_000)
            yield _tried(guard.send, frame, state, sampled_ns, now_ns), list(sent), guard.passed, guard.rejected
            sent.clear()


def _states(core: Modules, dice: random.Random) -> Iterator[Any]:
    machine = core.state_machine
    times = machine.timeouts(_bench())
    events = (*machine.Event, *machine.Fault)
    while True:
        run, now_ns = machine.Run(), 10**9
        for _ in range(12):
            now_ns += dice.randrange(0, 5_000_000)
            event = dice.choice(events if dice.random() < 0.1 else tuple(machine.Event))
            after = _tried(machine.step, times, run, event, now_ns)
            run = after if isinstance(after, machine.Run) else run
            # Each core has enumerations of its own: their names are compared.
            yield tuple(map(str, after)), machine.missed(times, run, now_ns), machine.may_send(run.state)


def _bounds(core: Modules, dice: random.Random) -> Iterator[Any]:
    bounds, counters = core.start_conditions.Bounds(_bench()), core.result.RunCounters()
    while True:
        angle, velocity, applied = _number(dice, 110.0), _number(dice, 510.0), _number(dice, 6.0)
        sample = SensorSample(dice.randrange(15), angle, velocity, 0, 0, applied, 15, NodeState.ACTIVE)
        counters.count_pair(sample, dice.randrange(3))
        counters.count_answer(dice.randrange(32), applied)
        yield (
            *(bounds.is_home(sample), bounds.outside(sample), counters.pairs, counters.missed, counters.left),
            *(counters.clipped, counters.limited, counters.angle_min, counters.angle_max, counters.top_speed),
        )


def _scalars(core: Modules, dice: random.Random) -> Iterator[Any]:
    """Every operation, each of numbers and of results of others."""
    of = core.scalar_operations
    unary = of.Absolute, of.Sign, of.SquareRoot, of.Exponential, of.Logarithm, of.HyperbolicTangent
    comparing = of.Greater, of.GreaterOrEqual, of.Equal
    binary = of.Add, of.Subtract, of.Multiply, of.Divide, of.Maximum, of.Minimum, *comparing
    seen = [of.Number() for _ in range(4)]
    results = [kind(a) for kind in unary for a in seen[:2]]
    results += [kind(*pair) for kind in binary for pair in (seen[:2], seen[2:], results[:2])]
    results += [kind(seen[0], *results[:2]) for kind in (of.Where, of.AddProduct, of.SubtractProduct)]
    results += [of.AddProducts(*seen, *results[-3:])]
    while True:
        for number in seen:
            number.value = _number(dice, dice.choice((1.0, 30.0, 1e3)))
        for operation in results:
            operation.run()
        yield [operation.value for operation in results]


COMPARISONS: dict[str, Comparison] = {
    "shield": _shield,
    "successor": _successor,
    "command limits": _decide,
    "end-to-end protection": _e2e,
    "codec": _codec,
    "reception": _reception,
    "drive monitor": _drive,
    "guard": _guard,
    "sensor monitor": _sensors,
    "learning": _learning,
    "state machine": _states,
    "bounds and counters": _bounds,
    "scalar operations": _scalars,
}
"""By what they compare."""
