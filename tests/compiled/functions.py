"""Functions of the compiled core with inputs drawn for them: their answers, in whichever core a process runs.

Among the inputs are the edges (zeros of both signs, infinities, NaN, subnormals) and any pattern of 64 bits; what a
function raises is an answer as well.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable, Iterator
from functools import cache
from itertools import islice
from typing import Any

from emb_runtime.can import e2e, receiver
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.control import memory, start_conditions
from emb_runtime.estimator import kalman, speed_loop
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.records import CurrentCommand, Frame, NodeState, RunState, SensorSample
from emb_runtime.safety import (
    command_limits,
    drive_monitor,
    response,
    sensor_monitor,
    sensor_thresholds,
    shield,
    shield_design,
    state_machine,
)
from emb_runtime.safety.guard import Guard
from emb_runtime.system import compiled_core

BLOCK = 1000  # Answers that are drawn from one seed
EDGES = (0.0, -0.0, 1.0, -6.0, 6.0, 5e-324, -2.2e-308, 1e6, 1e308, math.inf, -math.inf, math.nan)


def is_compiled() -> bool:
    """Returns True if this process runs the compiled core."""
    return compiled_core.running().compiled


def answers(name: str, seed: int) -> list[str]:
    """Answers of a function to a block of inputs, in such a form that equal means bit for bit."""
    return [repr(bits(answer)) for answer in islice(FUNCTIONS[name](random.Random(seed)), BLOCK)]


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


@cache
def _laws() -> list[Any]:
    law = shield_design.make_law(_bench())
    return [
        law,
        law._replace(age_high=2),
        law._replace(age_low=1, age_high=1, delay=law.delay._replace(lag=2e-4, kept=math.exp(-5.0))),
        law._replace(coasting=True, damping_velocity=math.inf),
    ]


def _drawn_past(dice: random.Random) -> tuple[float, ...]:
    return tuple(_number(dice, 6.0) for _ in range(5))


def _shield(dice: random.Random) -> Iterator[Any]:
    laws = _laws()
    yield laws
    while True:
        law, past = dice.choice(laws), _drawn_past(dice)
        angle, velocity, wanted = _number(dice, 110.0), _number(dice, 510.0), _number(dice, 7.0)
        step = dice.randrange(-1, law.steps + 2)
        yield (
            _tried(shield.shield, law, angle, velocity, wanted, past, step),
            _tried(shield.window, law, angle, velocity, past),
            _tried(shield.damped_current, velocity, law.current, law.damping_velocity),
        )


def _successor(dice: random.Random) -> Iterator[Any]:
    laws = _laws()
    while True:
        box = (_number(dice, 110.0), _number(dice, 110.0), _number(dice, 510.0), _number(dice, 510.0))
        yield _tried(shield.successor, dice.choice(laws), *box, _number(dice, 6.0))


def _decide(dice: random.Random) -> Iterator[Any]:
    laws, limits = _laws(), command_limits
    while True:
        reach = limits.CommandLimits(abs(_number(dice, 6.0)), abs(_number(dice, 12.0)))
        asked = _tried(limits.checked, _number(dice, 7.0), 6.0)
        wanted = asked if isinstance(asked, float) else 0.0
        state, past = (_number(dice, 110.0), _number(dice, 510.0)), _drawn_past(dice)
        last, step = _number(dice, 6.0), dice.randrange(0, 501)
        yield asked, _tried(limits.decide, dice.choice(laws), reach, *state, wanted, past, last, step)


def _e2e(dice: random.Random) -> Iterator[Any]:
    check = e2e.CounterCheck(5)
    while True:
        data, start, counter = dice.randbytes(dice.randrange(1, 9)), dice.randrange(256), dice.randrange(-1, 16)
        payload = bytes((e2e.crc(start, data[1:]),)) + data[1:] if dice.random() < 0.5 else data
        yield (
            *(e2e.profile1_start(dice.randrange(65536)), payload, e2e.has_valid_crc(start, payload)),
            *(e2e.next_counter(counter), _tried(check.advance, counter), check.last, check.errors),
        )


def _codec(dice: random.Random) -> Iterator[Any]:
    layout = load_layout()
    while True:
        for message in layout.messages.values():
            frame = _drawn_frame(dice, message)
            yield _tried(message.decode, frame)


def _drawn_frame(dice: random.Random, message: Any) -> Frame:
    body = dice.randbytes(message.length - 1 if dice.random() < 0.9 else dice.randrange(1, 8))
    data = bytes((e2e.crc(message.crc_start, body) if dice.random() < 0.8 else 0,)) + body
    return Frame(message.identifier, data, error=dice.random() < 0.05, extended=dice.random() < 0.05)


def _reception(dice: random.Random) -> Iterator[Any]:
    """A stream of pairs, with gaps, jumps, repeats, and frames that are none."""
    bench, layout = _bench(), load_layout()
    told: list[str] = []
    take = receiver.Reception(layout, bench, lambda _frame, why: told.append(why))
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
            _drawn_frame(dice, dice.choice(messages)),
        )
        for frame in frames[: 2 + (dice.random() < 0.1)]:
            sample = take.add_frame(frame._replace(time_ns=time_ns, own=dice.random() < 0.01, dropped=counter // 14))
            yield (
                *(sample, take.inhibit_reason(time_ns + dice.randrange(-(10**7), 10**8)), take.rejected, take.dropped),
                *(take.too_many_rejected, take.foreign_command, list(told), take.status, str(take.rejections())),
            )
            told.clear()
        if take.foreign_command or take.too_many_rejected:
            take = receiver.Reception(layout, bench, lambda _frame, why: told.append(why))


def _drive(dice: random.Random) -> Iterator[Any]:
    while True:
        check = drive_monitor.DriveCheck(0.5, 6.0)
        for _ in range(50):
            counter, current = dice.randrange(15), _number(dice, 6.0)
            check.sent(counter, current)
            obeyed = counter if dice.random() < 0.8 else dice.randrange(16)
            applied = current + dice.uniform(-0.6, 0.6) if dice.random() < 0.8 else _number(dice, 6.0)
            yield _tried(check.current_problem, obeyed, applied), check.errors


def _sensors(dice: random.Random) -> Iterator[Any]:
    monitor, laws = sensor_monitor, _laws()[:2]
    limits = sensor_thresholds.sensor_thresholds(_bench(), laws[0])
    while True:
        law = dice.choice(laws)
        angle, velocity = dice.uniform(-5.0, 80.0), dice.uniform(-300.0, 300.0)
        state = monitor.begin_monitor(angle, velocity)
        for _ in range(40):
            elapsed, current = dice.choice((1e-3, 1e-3, 1e-3, 2e-3)), _number(dice, 6.0)
            velocity += dice.uniform(-6.0, 6.0)
            angle += elapsed * velocity
            measured = (_number(dice, 100.0), velocity) if dice.random() < 0.02 else (angle, velocity)
            obeyed, reported = dice.random() < 0.9, current + dice.uniform(-0.5, 0.5)
            state, verdict = monitor.judge(law, limits, state, elapsed, *measured, obeyed, current, reported)
            yield verdict, state, monitor.largest_current(law, limits, state, 6.0)


def _response(dice: random.Random) -> Iterator[Any]:
    """Proofs of brakes about the set's, whose commands act as declared, later, or not at all."""
    proof, laws = response, _laws()
    models = [proof.response_model(_bench(), law) for law in laws]
    yield models, [proof.unproven_law(_bench(), law) for law in laws]
    while True:
        model = dice.choice(models)
        angle, velocity, command = dice.uniform(-5.0, 20.0), dice.uniform(-9.0, 9.0), 0.0
        motor, past = dice.uniform(0.8 * model.box.motor_low, 1.2 * model.box.motor_high), [0.0] * dice.randrange(1, 5)
        state = proof.begin_response(model, angle, velocity)
        for _ in range(40):
            if dice.random() < 0.3:
                command = dice.choice((0.0, model.holds, model.moves, _number(dice, 6.0), 6.0, -6.0))
            past = [command, *past[:-1]]
            velocity += model.sample_time * motor * past[-1] + dice.gauss(0.0, 1.0)
            angle += model.sample_time * velocity
            measured = (_number(dice, 100.0), _number(dice, 500.0)) if dice.random() < 0.02 else (angle, velocity)
            state, verdict = proof.take(model, state, dice.random() < 0.95, *measured, command)
            yield verdict, state, proof.overshoot(model, state, model.extra), proof.explains(model, state)


def _guard(dice: random.Random) -> Iterator[Any]:
    bench, layout = _bench(), load_layout()
    while True:
        sent: list[Frame] = []
        guard = Guard(layout, bench, sent.append, None, dice.choice((1.0, 6.0)))
        now_ns, current = 10**9, 0.0
        for _ in range(100):
            now_ns += dice.randrange(0, 2_000_000)
            current = max(min(current + dice.uniform(-4.0, 4.0), 6.0), -6.0) if dice.random() < 0.98 else 0.0
            enable, answers = dice.random() < 0.97, dice.randrange(15)
            counter = guard.next_counter if dice.random() < 0.95 else dice.randrange(15)
            command = CurrentCommand(counter, answers, current if enable or dice.random() < 0.1 else 0.0, enable)
            state = RunState.ACTIVE if dice.random() < 0.95 else dice.choice(tuple(RunState))
            frame, sampled_ns = layout.encode_command(*command), now_ns - dice.randrange(0, 2_100_000)
            checked = _tried(guard.check, frame, state, sampled_ns, now_ns)
            yield checked, _tried(guard.send, frame), list(sent), guard.passed, guard.rejected
            sent.clear()


def _states(dice: random.Random) -> Iterator[Any]:
    machine = state_machine
    events = (*machine.Event, *machine.Fault)
    while True:
        run, now_ns = machine.Run(), 10**9
        for _ in range(12):
            now_ns += dice.randrange(0, 5_000_000)
            event = dice.choice(events if dice.random() < 0.1 else tuple(machine.Event))
            after = _tried(machine.next_run, run, event, now_ns)
            run = after if isinstance(after, machine.Run) else run
            yield tuple(map(str, after)), machine.may_enable(run.state), machine.may_send(run.state)


def _bounds(dice: random.Random) -> Iterator[Any]:
    bounds, counters = start_conditions.Bounds(_bench()), memory.RunCounters()
    while True:
        angle, velocity, applied = _number(dice, 110.0), _number(dice, 510.0), _number(dice, 6.0)
        sample = SensorSample(dice.randrange(15), angle, velocity, 0, 0, applied, 15, NodeState.ACTIVE)
        counters.count_pair(sample, dice.randrange(3))
        counters.count_answer(dice.randrange(32), applied)
        yield (
            *(bounds.is_home(sample), bounds.outside(sample), counters.pairs, counters.missed, counters.left),
            *(counters.clipped, counters.limited, counters.angle_min, counters.angle_max, counters.top_speed),
        )


def _estimator(dice: random.Random) -> Iterator[Any]:
    """Estimates of a brake that moves about as it should, and the currents that follow a target speed."""
    while True:
        model = Estimator(_bench()).model._replace(derived=dice.random() < 0.3)
        state, gain = kalman.initial_state(model), dice.choice((1.0, 0.4))
        angle, velocity, current, step = dice.uniform(-1.0, 40.0), dice.uniform(-200.0, 200.0), 0.0, 0
        for _ in range(30):
            step += dice.choice((1, 1, 1, 1, 2, 4))
            seen = angle + dice.gauss(0.0, 1e-3), velocity + dice.gauss(0.0, 1.0)
            state = kalman.follow(model, state, *seen, float(step), current)
            believed = kalman.believed(model, state)
            wanted = speed_loop.current_for(model, state, believed, dice.uniform(-500.0, 500.0), gain)
            yield state, believed, kalman.deviations(model, state, believed), wanted
            current = dice.uniform(-6.0, 6.0)
            push = model.motor * current - model.spring * max(angle, 0.0) - model.viscous * velocity
            angle += 1e-3 * velocity
            velocity += 1e-3 * (push - math.copysign(model.coulomb, velocity))


FUNCTIONS: dict[str, Callable[[random.Random], Iterator[Any]]] = {
    "shield": _shield,
    "successor": _successor,
    "command limits": _decide,
    "end-to-end protection": _e2e,
    "codec": _codec,
    "reception": _reception,
    "drive monitor": _drive,
    "guard": _guard,
    "sensor monitor": _sensors,
    "response": _response,
    "state machine": _states,
    "bounds and counters": _bounds,
    "estimator": _estimator,
}
"""Answers without end to inputs drawn from the dice, by function."""
