"""Response of a run, proven at low speed: how late the velocity follows the commands.

The shield relies on what a bench file declares: frames of some age, a current that lags, an observer. Until a run has
shown that its velocity follows the commands no later than that, the shield works with :func:`unproven_law`, whose speed
stays so low that no brake of the set passes a limit under the longest response that is assumed.

A Kalman filter estimates the brake and the *overshoot*: what the velocity still gains, at most, by a full current that
it does not show yet [rad/s]. A velocity that follows the commands has none; late frames, a lag of the current and an
observer all have one. The filter's state is the velocity, the four uncertain parameters, and the overshoot; the
measurement is the velocity less the overshoot's share of the current. Where the direction of friction, or the current,
is not certain, the velocity's variance grows by what that may change (process noise).

Plain scalar functions on one row of memory, so that the runtime, a simulation and a compiled batch run the same code.
Formulas, figures and what it cannot see: ``docs/explanation/sensor-monitor.md``.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

from emb_runtime.can.e2e import next_counter
from emb_runtime.config.bench import OLDEST_FRAME, Bench
from emb_runtime.records import SensorSample
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.safety.state_machine import Fault, StopError

# Verdicts; plain integers, because a compiled function cannot see an enum.
OPEN: Final = 0
PROVEN: Final = 1
CONTRADICTED: Final = 2

LONGEST: Final = 6.0  # Longest response that is assumed before it is proven, of all causes [samples]
STROKE: Final = 0.5  # Share of the free stroke that is left until then
SLOWEST: Final = 0.25  # Least share of the homeward speed that is left until then
CONTRADICTS: Final = 4.5  # Errors of the estimate by which a contradicted response is beyond what is tolerated
PROVES: Final = 3.0  # Errors of the estimate by which a proven response is within what the shield covers
BEYOND: Final = 1.1  # Response that is no contradiction, in multiples of the declared one
EARLY: Final = 0.7  # Samples by which commands may seem to act before the declared frames do
SHORTER_LAG: Final = 0.2  # Deviation of a lag that is shorter than the declared one, as a share of the transient
SHORTER_AGE: Final = 0.35  # The same of frames that are younger
LEAST_SLIDES: Final = 2.0  # Periods in which the brake slid, below which nothing is proven
SETTLES: Final = 4.0  # More of these after a command that was not obeyed
LEAST_FIT: Final = 3.0  # Mean square of the normalised innovations beyond which the filter's model does not hold
LEAST_ERROR: Final = 0.02  # Of the brake's equation, as a share of what full current adds in a sample
KEPT: Final = 32  # Samples of a run, and of its stop, that are kept to find the cause of a contradiction
OUTSIDE: Final = 0.1  # Share by which the estimated motor may lie outside the set

# Places in the row of memory.
VERDICT: Final = 0
ANGLE: Final = 1  # Last measurement [rad]
VELOCITY: Final = 2  # Last measurement [rad/s]
FLOWING: Final = 3  # Mean current of the periods that the velocity may not show yet [A]
LARGEST: Final = 4  # Largest of these so far [A]
DOUBTS: Final = 5  # Periods from now on in which the current is not known
SLIDES: Final = 6  # Periods so far in which the brake slid
COUNT: Final = 7  # Innovations so far
MISFIT: Final = 8  # Sum of the squares of the normalised innovations
LIKELIHOOD: Final = 9  # The same and the logarithms of their variances: minus twice a log-likelihood
LAGGING: Final = 10  # Current that follows the oldest command with the declared lag [A]
COMMANDS: Final = 11  # Commands of the last periods, newest first [A]
STATE: Final = COMMANDS + OLDEST_FRAME + 1  # Velocity [rad/s], motor, friction, spring, viscous, overshoot [rad/s]
SIZE: Final = 6
MATRIX: Final = STATE + SIZE  # Covariance of the state, by rows
MEMORY: Final = MATRIX + SIZE * SIZE  # Length of the row
MOTOR: Final = 1
OVERSHOOT: Final = 5


class ResponseModel(NamedTuple):
    """Numbers that the proof works with; numbers only, so that what uses it compiles."""

    sample_time: float  # [s]
    current: float  # Limit [A]
    age: int  # Least declared age of a frame
    oldest: int  # Greatest declared age of a frame
    lag: float  # Longest declared lag of current and velocity [s]
    extra: float  # Longest declared response beyond the least age [s]
    transient: float  # Deviation of one that is shorter, as a time [s]
    doubts: float  # Periods in which a command that was not obeyed may act
    early: float  # Time by which commands may seem to act before ``age`` [s]
    deviation: float  # Of a measured velocity, at least what the brake's equation leaves out [rad/s]
    slides: float  # Speed above which the direction of friction is certain; an overshoot that is covered [rad/s]
    holds: float  # Current that moves no brake of the set [A]
    moves: float  # Current that moves every brake of the set [A]
    change: float  # Largest change of the velocity in a sample [rad/s]
    motor_low: float  # k_m / J [rad/(s²·A)]
    motor_high: float
    friction_high: float  # [rad/s²]
    prior: tuple[float, float, float, float]  # Mean of k_m, T_c, γ k_1 and f_v, all over J
    deviations: tuple[float, float, float, float]  # Their standard deviations
    widest: float  # Standard deviation of the overshoot before the first sample [rad/s]


def declared_response(bench: Bench, law: ShieldLaw) -> float:
    """Longest declared response beyond the least age of a frame [s]."""
    bandwidth = bench.sensors.bandwidth
    observed = 2.0 / bandwidth if bandwidth is not None else 0.0
    return (law.age_high - law.age_low) * law.sample_time + law.lag + observed


def response_model(bench: Bench, law: ShieldLaw) -> ResponseModel:
    """The model of a bench and the law of its shield."""
    t, extra = law.sample_time, declared_response(bench, law)
    frames = (law.age_high - law.age_low) * t
    deviation = max(bench.noise.velocity, LEAST_ERROR * t * law.motor_high * law.current)
    low = law.motor_low, law.friction_low, law.spring_low, law.viscous_low
    high = law.motor_high, law.friction_high, law.spring_high, law.viscous_high
    a, b, c, d = (0.5 * (least + most) for least, most in zip(low, high, strict=True))
    e, f, g, h = ((most - least) / math.sqrt(12.0) for least, most in zip(low, high, strict=True))
    return ResponseModel(
        sample_time=t,
        current=law.current,
        age=law.age_low,
        oldest=law.age_high,
        lag=extra - frames,
        extra=extra,
        transient=SHORTER_AGE * frames + SHORTER_LAG * (extra - frames),
        doubts=law.age_high + 1.0 + math.ceil(3.0 * extra / t),
        early=(EARLY if law.age_low > 0 else LONGEST) * t,
        deviation=deviation,
        slides=max(law.velocity_noise, 6.0 * deviation),
        holds=law.friction_low / law.motor_high,
        moves=law.friction_high / law.motor_low,
        change=law.change,
        motor_low=law.motor_low,
        motor_high=law.motor_high,
        friction_high=law.friction_high,
        prior=(a, b, c, d),
        deviations=(e, f, g, h),
        widest=0.5 * LONGEST * t * law.motor_high * law.current,
    )


def unproven_law(bench: Bench, law: ShieldLaw) -> ShieldLaw:
    """The law until the response is proven: so slow that the longest response passes no limit.

    What is faster than its speed by the strongest motor at full current for that time, less what is declared, which the
    law covers itself.
    """
    unknown = LONGEST * law.sample_time - law.age_low * law.sample_time - declared_response(bench, law)
    fastest = max(bench.limits.velocity - unknown * law.motor_high * law.current, SLOWEST * law.homeward_speed)
    homeward = min(math.sqrt(STROKE) * law.homeward_speed, fastest)  # from it a brake stops within that share
    return law._replace(
        bottom=STROKE * law.bottom,
        outward_speed=min(law.outward_speed, fastest),
        homeward_speed=homeward,
        cruise=law.cruise * (homeward - law.creep) / (law.homeward_speed - law.creep),
    )


def begin(model: ResponseModel, memory: Any, angle: float, velocity: float) -> None:
    """Begin a run with its first measurement, in a row of length MEMORY that is overwritten [rad, rad/s]."""
    for i in range(MEMORY):
        memory[i] = 0.0
    memory[ANGLE] = angle
    memory[VELOCITY] = memory[STATE] = velocity
    memory[MATRIX] = model.deviation * model.deviation
    for i in range(SIZE - 2):
        memory[STATE + 1 + i] = model.prior[i]
        memory[MATRIX + (SIZE + 1) * (1 + i)] = model.deviations[i] * model.deviations[i]
    memory[MATRIX + (SIZE + 1) * OVERSHOOT] = model.widest * model.widest


def take(model: ResponseModel, memory: Any, follows: bool, angle: float, velocity: float, command: float) -> int:
    """Take one more sample.

    Args:
        model: of the bench.
        memory: row of the run, changed.
        follows: it is the next sample, and the command acted between the two, by the node's account.
        angle: measured [rad].
        velocity: measured [rad/s].
        command: that answered the sample before; 0 if none was sent [A].

    Returns:
        OPEN, PROVEN (no command acts later than declared) or CONTRADICTED.
    """
    for i in range(OLDEST_FRAME, 0, -1):
        memory[COMMANDS + i] = memory[COMMANDS + i - 1]
    memory[COMMANDS] = command
    _predict(model, memory, follows, angle, velocity)
    _correct(model, memory, velocity)
    memory[ANGLE], memory[VELOCITY] = angle, velocity
    memory[VERDICT] = verdict = _verdict(model, memory)
    return verdict


def _predict(model: ResponseModel, memory: Any, follows: bool, angle: float, velocity: float) -> None:
    """The state a period later: the velocity changes by the brake's equation, nothing else does."""
    ts, v, u = model.sample_time, memory[VELOCITY], memory[COMMANDS + model.age]
    before, flowing = memory[FLOWING], _flowing(model, memory)
    if model.lag == 0.0 and model.oldest == model.age:
        before = u
    memory[FLOWING] = flowing
    memory[LARGEST] = max(memory[LARGEST], abs(flowing))
    current, friction, noise = _driven(model, u, before, _transient(model, memory), v, velocity)
    memory[SLIDES] += 1.0 if min(abs(v), abs(velocity)) > model.slides and friction != 0.0 else 0.0
    if not follows:
        memory[DOUBTS] = model.doubts
        memory[SLIDES] = -SETTLES
    if memory[DOUBTS] > 0.0:
        memory[DOUBTS] -= 1.0
        noise += 3.0 * model.change
    moves = 1.0 if current != 0.0 or friction != 0.0 else 0.0
    pressed, speed = moves * 0.5 * (max(memory[ANGLE], 0.0) + max(angle, 0.0)), moves * 0.5 * (v + velocity)
    gains = (ts * current, -ts * friction, -ts * pressed, -ts * speed)
    for i in range(SIZE - 2):
        memory[STATE] += gains[i] * memory[STATE + 1 + i]
    for j in range(SIZE):
        for i in range(SIZE - 2):
            memory[MATRIX + j] += gains[i] * memory[MATRIX + SIZE * (1 + i) + j]
    for j in range(SIZE):
        for i in range(SIZE - 2):
            memory[MATRIX + SIZE * j] += gains[i] * memory[MATRIX + SIZE * j + 1 + i]
    memory[MATRIX] += noise * noise


def _flowing(model: ResponseModel, memory: Any) -> float:
    """Mean current of what the slowest declared response does not show yet [A]; the command itself if it has none."""
    ts, oldest = model.sample_time, memory[COMMANDS + model.oldest]
    unseen = (model.oldest - model.age) * ts + model.lag
    if unseen == 0.0:
        return float(memory[COMMANDS + model.age])
    total = 0.0
    for i in range(model.age, model.oldest):
        total += ts * memory[COMMANDS + i]
    if model.lag > 0.0:
        memory[LAGGING] = oldest + math.exp(-ts / model.lag) * (memory[LAGGING] - oldest)
        total += model.lag * memory[LAGGING]
    return float(total / unseen)


def _driven(
    model: ResponseModel, u: float, before: float, transient: float, v: float, velocity: float
) -> tuple[float, float, float]:
    """Current of a period [A], direction of its friction, and how much neither is certain [rad/s].

    From the command, the current that flowed before it, and the velocities before and after the period.
    """
    way = 1.0 if u > 0.0 else -1.0
    turned = model.sample_time * model.friction_high
    if min(v, velocity) > model.slides:
        return u, 1.0, 0.0
    if max(v, velocity) < -model.slides:
        return u, -1.0, 0.0
    if min(way * v, way * velocity) < -model.slides:  # it turns around
        return u, 0.0, turned + transient
    if max(abs(u), abs(before)) <= model.holds:
        return 0.0, 0.0, transient
    if min(way * u, way * before) >= model.moves:
        return u, way, 0.0
    return 0.5 * u, 0.0, turned + 0.5 * model.sample_time * model.motor_high * abs(u) + transient  # it may stick


def _transient(model: ResponseModel, memory: Any) -> float:
    """Deviation of what a response shows that is shorter than the longest declared one [rad/s].

    After a change of the current it lasts as long as any response may take: a later one looks like it at first.
    """
    u = memory[COMMANDS + model.age]
    changed: float = abs(u - memory[FLOWING])
    for i in range(model.age, OLDEST_FRAME + 1):
        changed = max(changed, abs(u - memory[COMMANDS + i]))
    return model.transient * model.motor_high * changed


def _correct(model: ResponseModel, memory: Any, velocity: float) -> None:
    """Take in the measured velocity: that of the state, less the overshoot's share of the current."""
    share = -memory[FLOWING] / model.current
    transient = _transient(model, memory)
    variance = model.deviation * model.deviation + transient * transient
    last = MATRIX + OVERSHOOT
    r0 = memory[MATRIX] + share * memory[last]
    r1 = memory[MATRIX + SIZE] + share * memory[last + SIZE]
    r2 = memory[MATRIX + 2 * SIZE] + share * memory[last + 2 * SIZE]
    r3 = memory[MATRIX + 3 * SIZE] + share * memory[last + 3 * SIZE]
    r4 = memory[MATRIX + 4 * SIZE] + share * memory[last + 4 * SIZE]
    r5 = memory[MATRIX + 5 * SIZE] + share * memory[last + 5 * SIZE]
    row = (r0, r1, r2, r3, r4, r5)
    variance = max(variance + r0 + share * r5, variance)  # rounding must not make it negative
    innovation = velocity - memory[STATE] - share * memory[STATE + OVERSHOOT]
    for i in range(SIZE):
        memory[STATE + i] += row[i] / variance * innovation
        for j in range(SIZE):
            memory[MATRIX + SIZE * i + j] -= row[i] * row[j] / variance
    memory[COUNT] += 1.0
    memory[MISFIT] += innovation * innovation / variance
    memory[LIKELIHOOD] += innovation * innovation / variance + math.log(variance)


def overshoot(model: ResponseModel, memory: Any, response: float) -> tuple[float, float]:
    """Overshoot beyond that of a response time [s], and its standard deviation [rad/s]."""
    share = model.current * response
    motor, cross = MATRIX + (SIZE + 1) * MOTOR, MATRIX + SIZE * MOTOR + OVERSHOOT
    own = MATRIX + (SIZE + 1) * OVERSHOOT
    variance = memory[own] - 2.0 * share * memory[cross] + share * share * memory[motor]
    return memory[STATE + OVERSHOOT] - share * memory[STATE + MOTOR], math.sqrt(max(variance, 0.0))


def fits(model: ResponseModel, memory: Any) -> bool:
    """Returns True if the filter's brake is one of the set, and explains what was measured."""
    motor = memory[STATE + MOTOR]
    inside = (1.0 - OUTSIDE) * model.motor_low < motor < (1.0 + OUTSIDE) * model.motor_high
    return bool(inside and memory[MISFIT] <= LEAST_FIT * memory[COUNT])


def _verdict(model: ResponseModel, memory: Any) -> int:
    """Verdict on the samples so far.

    What the shield allows for errors of the velocity covers an overshoot as well: half of it is tolerated.
    """
    covered = model.slides
    late, late_error = overshoot(model, memory, BEYOND * model.extra)
    early, early_error = overshoot(model, memory, -model.early)
    # The estimate is one for the full current: a model error of some rad/s is more of it under a smaller one.
    applied = memory[LARGEST] / model.current
    if applied * (late - CONTRADICTS * late_error) > 0.5 * covered:
        return CONTRADICTED
    if applied * (early + CONTRADICTS * early_error) < -0.5 * covered:
        return CONTRADICTED
    if memory[SLIDES] < LEAST_SLIDES or not fits(model, memory):
        return OPEN
    least, least_error = overshoot(model, memory, 0.0)
    # No command acts before it is sent: where the least declared age is 0, a low estimate is an error of the model.
    follows = model.age == 0 or least - PROVES * least_error > -covered
    return PROVEN if follows and late + PROVES * late_error < covered else OPEN


class Row(NamedTuple):
    """One sample and the command before it, as :func:`take` takes them."""

    follows: bool
    angle: float  # [rad]
    velocity: float  # [rad/s]
    command: float  # [A]


class Response:
    """The response of one run: the law that it may rely on, and its newest samples.

    Attributes:
        law: of the shield, :func:`unproven_law` until the response is proven.
        rows: the newest samples.
        stop: the first samples of the node's own stop; their command is the current by the node's account [A].
    """

    __slots__ = ("_counter", "_full", "_memory", "_slow", "law", "model", "rows", "stop")

    def __init__(self, bench: Bench, law: ShieldLaw) -> None:
        self._full = law
        self._slow = self.law = unproven_law(bench, law)
        self.model = response_model(bench, law)
        self._memory = [0.0] * MEMORY
        self.rows: list[Row] = []
        self.stop: list[Row] = []

    def begin(self, sample: SensorSample) -> None:
        """Begin a run with its first sample."""
        begin(self.model, self._memory, sample.angle, sample.velocity)
        self.rows, self._counter = [Row(False, sample.angle, sample.velocity, 0.0)], sample.counter
        self.law = self._slow

    @property
    def proven(self) -> bool:
        """Returns True if the velocity follows the commands as declared."""
        return self._memory[VERDICT] == PROVEN

    def take(self, sample: SensorSample, follows: bool, command: float) -> None:
        """Take one more sample, as :func:`take`; once the response is proven it is only kept.

        Raises StopError if the velocity follows the commands later, or earlier, than declared.
        """
        self.rows = [*self.rows[1 - KEPT :], Row(follows, sample.angle, sample.velocity, command)]
        self._counter = sample.counter
        if self.proven:
            return
        verdict = take(self.model, self._memory, follows, sample.angle, sample.velocity, command)
        if verdict == CONTRADICTED:
            raise StopError(Fault.RESPONSE_LATE, self.text)
        if verdict == PROVEN:
            self.law = self._full

    def watch(self, sample: SensorSample) -> None:
        """Keep one sample of the stop."""
        if len(self.stop) < KEPT:
            follows = sample.counter == next_counter(self._counter)
            self.stop.append(Row(follows, sample.angle, sample.velocity, sample.applied_current))
            self._counter = sample.counter

    @property
    def text(self) -> str:
        """Measured delay and what is declared of it [samples]."""
        model, memory = self.model, self._memory
        late, error = overshoot(model, memory, 0.0)
        delay = memory[STATE + MOTOR] * model.current * model.sample_time
        most = model.age + model.extra / model.sample_time
        found = f"{model.age + late / delay:z.1f} ± {error / delay:.1f}"
        return f"the velocity follows the commands {found} samples late, at most {most:.3g} are declared"
