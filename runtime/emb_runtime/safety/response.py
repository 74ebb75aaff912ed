"""Response of a run, proven at low speed: how late the velocity follows the commands.

The shield relies on what a bench file declares: frames of some age, a current that lags, an observer. Until a run has
shown that its velocity follows the commands no later than that, the shield works with :func:`unproven_law`, whose speed
stays so low that no brake of the set passes a limit under the longest response that is assumed.

A Kalman filter estimates the brake and the *overshoot*: what the velocity still gains, at most, by a full current that
it does not show yet [rad/s]. A velocity that follows the commands has none; late frames, a lag of the current and an
observer all have one. The filter's state is the velocity, the four uncertain parameters, and the overshoot; the
measurement is the velocity less the overshoot's share of the current. Where the direction of friction, or the current,
is not certain, the velocity's variance grows by what that may change (process noise).

Plain scalar functions from one state to the next: the runtime, a simulation and a compiled batch run the same code.
Formulas, figures and what it cannot see: ``docs/explanation/sensor-monitor.md``.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple

from emb_runtime.can.e2e import next_counter
from emb_runtime.config.bench import OLDEST_FRAME, Bench
from emb_runtime.estimator.kalman import Four, Packed, Six
from emb_runtime.records import SensorSample
from emb_runtime.safety.shield_design import Box, ShieldLaw
from emb_runtime.safety.state_machine import Fault, StopError

# Verdicts; plain integers, because a compiled function cannot see an enum.
OPEN: Final = 0
PROVEN: Final = 1
CONTRADICTED: Final = 2

LONGEST: Final = 6.0  # Longest response that is assumed before it is proven, of all causes [samples]
STROKE: Final = 0.5  # Share of the free stroke that is used until then
SLOWEST: Final = 0.25  # Least share of the homeward speed that is used until then
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
STORED: Final = 32  # Newest samples of a run, and first ones of its stop, that tell the cause of a contradiction
OUTSIDE: Final = 0.1  # Share by which the estimated motor may lie outside the set


class State(NamedTuple):
    """State of the filter after a sample, and what the verdict counts."""

    angle: float  # Last measurement [rad]
    velocity: float  # Last measurement [rad/s]
    commands: Six  # Of the last OLDEST_FRAME + 1 periods, newest first [A]
    flowing: float  # Mean current of the periods that the velocity may not show yet [A]
    largest: float  # Largest of these so far [A]
    lagging: float  # Current that follows the oldest command with the declared lag [A]
    doubts: float  # Periods from now on in which the current is unknown
    slides: float  # Periods so far in which the brake slid
    innovations: float  # Number of innovations so far
    misfit: float  # Sum of the squares of the normalised innovations
    likelihood: float  # The same and the logarithms of their variances: minus twice a log-likelihood
    mean: Six  # Velocity [rad/s], motor, friction, spring, viscous, overshoot [rad/s]
    covariance: Packed  # Of the mean


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
    box: Box
    prior: Four  # Mean of k_m, T_c, γ k_1 and f_v, all over J
    deviations: Four  # Their standard deviations
    widest: float  # Standard deviation of the overshoot before the first sample [rad/s]


def declared_response(bench: Bench, law: ShieldLaw) -> float:
    """Longest declared response beyond the least age of a frame [s]."""
    bandwidth = bench.sensors.bandwidth
    observed = 2.0 / bandwidth if bandwidth is not None else 0.0
    return (law.age_high - law.age_low) * law.sample_time + law.delay.lag + observed


def response_model(bench: Bench, law: ShieldLaw) -> ResponseModel:
    """The model of a bench and the law of its shield."""
    t, box, extra = law.sample_time, law.box, declared_response(bench, law)
    frames = (law.age_high - law.age_low) * t
    deviation = max(bench.noise.velocity, LEAST_ERROR * t * box.motor_high * law.current)
    low = box.motor_low, box.friction_low, box.spring_low, box.viscous_low
    high = box.motor_high, box.friction_high, box.spring_high, box.viscous_high
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
        holds=box.friction_low / box.motor_high,
        moves=box.friction_high / box.motor_low,
        change=law.change,
        box=box,
        prior=(a, b, c, d),
        deviations=(e, f, g, h),
        widest=0.5 * LONGEST * t * box.motor_high * law.current,
    )


def unproven_law(bench: Bench, law: ShieldLaw) -> ShieldLaw:
    """The law until the response is proven: so slow that the longest response passes no limit.

    The limits of the speed are lower by what the strongest motor gains at full current in the longest response, less
    the declared one, which the law covers.
    """
    home, unknown = law.home, LONGEST * law.sample_time - law.age_low * law.sample_time - declared_response(bench, law)
    fastest = max(bench.limits.velocity - unknown * law.box.motor_high * law.current, SLOWEST * law.homeward_speed)
    homeward = min(math.sqrt(STROKE) * law.homeward_speed, fastest)  # from it a brake stops within that share
    return law._replace(
        bottom=STROKE * law.bottom,
        outward_speed=min(law.outward_speed, fastest),
        homeward_speed=homeward,
        home=home._replace(cruise=home.cruise * (homeward - home.creep) / (law.homeward_speed - home.creep)),
    )


def begin_response(model: ResponseModel, angle: float, velocity: float) -> State:
    """State at the first measurement of a run [rad, rad/s]."""
    (b, c, d, e), (sb, sc, sd, se), sa, sf = model.prior, model.deviations, model.deviation, model.widest
    return State(
        angle=angle, velocity=velocity, commands=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        flowing=0.0, largest=0.0, lagging=0.0, doubts=0.0, slides=0.0, innovations=0.0, misfit=0.0, likelihood=0.0,
        mean=(velocity, b, c, d, e, 0.0),
        covariance=(
            sa * sa, 0.0, 0.0, 0.0, 0.0, 0.0,
            sb * sb, 0.0, 0.0, 0.0, 0.0,
            sc * sc, 0.0, 0.0, 0.0,
            sd * sd, 0.0, 0.0,
            se * se, 0.0,
            sf * sf,
        ),
    )  # fmt: skip


def take(
    model: ResponseModel, state: State, follows: bool, angle: float, velocity: float, command: float
) -> tuple[State, int]:
    """Take one more sample.

    Args:
        model: of the bench.
        state: after the sample before.
        follows: it is the next sample, and the command acted between the two, by the node's account.
        angle: measured [rad].
        velocity: measured [rad/s].
        command: that answered the sample before; 0 if none was sent [A].

    Returns:
        The next state, and OPEN, PROVEN (no command acts later than declared) or CONTRADICTED.
    """
    c0, c1, c2, c3, c4, _ = state.commands
    commands = command, c0, c1, c2, c3, c4
    ts, v, u = model.sample_time, state.velocity, commands[model.age]
    flowing, lagging = _flowing(model, commands, state.lagging)
    transient = _transient(model, commands, flowing)
    before = u if model.lag == 0.0 and model.oldest == model.age else state.flowing
    current, friction, noise = _driven(model, u, before, transient, v, velocity)
    slides = state.slides + (1.0 if min(abs(v), abs(velocity)) > model.slides and friction != 0.0 else 0.0)
    doubts = state.doubts
    if not follows:
        doubts, slides = model.doubts, -SETTLES
    if doubts > 0.0:
        doubts -= 1.0
        noise += 3.0 * model.change
    moves = 1.0 if current != 0.0 or friction != 0.0 else 0.0
    pressed, speed = moves * 0.5 * (max(state.angle, 0.0) + max(angle, 0.0)), moves * 0.5 * (v + velocity)
    gains = (ts * current, -ts * friction, -ts * pressed, -ts * speed)
    # Measured is the velocity of the state, less the overshoot's share of the current.
    share, least = -flowing / model.current, model.deviation * model.deviation + transient * transient
    mean, covariance, innovation, variance = _filtered(state, gains, noise, velocity, share, least)
    square = innovation * innovation / variance
    after = State(
        angle, velocity, commands, flowing, max(state.largest, abs(flowing)), lagging, doubts, slides,
        state.innovations + 1.0, state.misfit + square, state.likelihood + (square + math.log(variance)), mean,
        covariance,
    )  # fmt: skip
    return after, _verdict(model, after)


def _filtered(
    state: State, gains: Four, noise: float, velocity: float, share: float, least: float
) -> tuple[Six, Packed, float, float]:
    """Mean and covariance after a period and its measurement, the innovation, and its variance.

    Args:
        state: after the sample before.
        gains: change of the velocity in the period, by each of motor, friction, spring and viscous.
        noise: standard deviation of this change [rad/s].
        velocity: measured [rad/s].
        share: of the overshoot in it.
        least: its variance [rad²/s²].
    """
    v, motor, friction, spring, viscous, over = state.mean
    p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15, p22, p23, p24, p25, p33, p34, p35, p44, p45, p55 = (
        state.covariance
    )
    a, b, c, d = gains
    v = v + a * motor + b * friction + c * spring + d * viscous
    p00 = p00 + a * p01 + b * p02 + c * p03 + d * p04
    p01 = p01 + a * p11 + b * p12 + c * p13 + d * p14
    p02 = p02 + a * p12 + b * p22 + c * p23 + d * p24
    p03 = p03 + a * p13 + b * p23 + c * p33 + d * p34
    p04 = p04 + a * p14 + b * p24 + c * p34 + d * p44
    p05 = p05 + a * p15 + b * p25 + c * p35 + d * p45
    p00 = p00 + a * p01 + b * p02 + c * p03 + d * p04 + noise * noise
    a, b, c = p00 + share * p05, p01 + share * p15, p02 + share * p25
    d, e, f = p03 + share * p35, p04 + share * p45, p05 + share * p55
    s = max(least + a + share * f, least)  # rounding must not make it negative
    y = velocity - v - share * over
    v, motor, friction = v + a / s * y, motor + b / s * y, friction + c / s * y
    spring, viscous, over = spring + d / s * y, viscous + e / s * y, over + f / s * y
    return (v, motor, friction, spring, viscous, over), (
        p00 - a * a / s, p01 - a * b / s, p02 - a * c / s, p03 - a * d / s, p04 - a * e / s, p05 - a * f / s,
        p11 - b * b / s, p12 - b * c / s, p13 - b * d / s, p14 - b * e / s, p15 - b * f / s,
        p22 - c * c / s, p23 - c * d / s, p24 - c * e / s, p25 - c * f / s,
        p33 - d * d / s, p34 - d * e / s, p35 - d * f / s,
        p44 - e * e / s, p45 - e * f / s,
        p55 - f * f / s,
    ), y, s  # fmt: skip


def _flowing(model: ResponseModel, commands: Six, lagging: float) -> tuple[float, float]:
    """Mean current of what the slowest declared response does not show yet, and the lagging current [A].

    The first is the command itself where no response is declared.
    """
    ts, oldest = model.sample_time, commands[model.oldest]
    unseen = (model.oldest - model.age) * ts + model.lag
    if unseen == 0.0:
        return commands[model.age], lagging
    total = 0.0
    for i in range(model.age, model.oldest):
        total += ts * commands[i]
    if model.lag > 0.0:
        lagging = oldest + math.exp(-ts / model.lag) * (lagging - oldest)
        total += model.lag * lagging
    return total / unseen, lagging


def _driven(
    model: ResponseModel, u: float, before: float, transient: float, v: float, velocity: float
) -> tuple[float, float, float]:
    """Current of a period [A], direction of its friction, and how much neither is certain [rad/s].

    From the command, the current that flowed before it, and the velocities before and after the period.
    """
    way = 1.0 if u > 0.0 else -1.0
    turned = model.sample_time * model.box.friction_high
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
    return 0.5 * u, 0.0, turned + 0.5 * model.sample_time * model.box.motor_high * abs(u) + transient  # it may stick


def _transient(model: ResponseModel, commands: Six, flowing: float) -> float:
    """Deviation of the velocity where the response is shorter than the longest declared one [rad/s].

    After a change of the current it lasts as long as any response may take: a longer one looks alike at first.
    """
    u = commands[model.age]
    changed = abs(u - flowing)
    for i in range(model.age, OLDEST_FRAME + 1):
        changed = max(changed, abs(u - commands[i]))
    return model.transient * model.box.motor_high * changed


def overshoot(model: ResponseModel, state: State, response: float) -> tuple[float, float]:
    """Overshoot beyond that of a response time [s], and its standard deviation [rad/s]."""
    share, p = model.current * response, state.covariance
    variance = p[20] - 2.0 * share * p[10] + share * share * p[6]
    return state.mean[5] - share * state.mean[1], math.sqrt(max(variance, 0.0))


def explains(model: ResponseModel, state: State) -> bool:
    """Returns True if the filter's brake is one of the set, and explains what was measured."""
    inside = (1.0 - OUTSIDE) * model.box.motor_low < state.mean[1] < (1.0 + OUTSIDE) * model.box.motor_high
    return inside and state.misfit <= LEAST_FIT * state.innovations


def _verdict(model: ResponseModel, state: State) -> int:
    """Verdict on the samples so far.

    What the shield allows for errors of the velocity covers an overshoot as well: half of it is tolerated.
    """
    covered = model.slides
    late, late_error = overshoot(model, state, BEYOND * model.extra)
    early, early_error = overshoot(model, state, -model.early)
    # The estimate is one for the full current: a model error of some rad/s is more of it under a smaller one.
    applied = state.largest / model.current
    if applied * (late - CONTRADICTS * late_error) > 0.5 * covered:
        return CONTRADICTED
    if applied * (early + CONTRADICTS * early_error) < -0.5 * covered:
        return CONTRADICTED
    if state.slides < LEAST_SLIDES or not explains(model, state):
        return OPEN
    least, least_error = overshoot(model, state, 0.0)
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
        stop: the first samples of the node's stop; their command is the current by the node's account [A].
    """

    __slots__ = ("_counter", "_full", "_rows", "_slow", "_state", "_verdict", "law", "model", "stop")

    def __init__(self, bench: Bench, law: ShieldLaw) -> None:
        self._full = law
        self._slow = self.law = unproven_law(bench, law)
        self.model = response_model(bench, law)
        self._verdict = OPEN
        self._rows: deque[Row] = deque(maxlen=STORED)
        self.stop: list[Row] = []

    def begin_run(self, sample: SensorSample) -> None:
        """Begin a run with its first sample."""
        self._state, self._verdict = begin_response(self.model, sample.angle, sample.velocity), OPEN
        self._rows.clear()
        self._store(self._rows, sample, False, 0.0)
        self.law = self._slow

    def _store(self, rows: deque[Row] | list[Row], sample: SensorSample, follows: bool, command: float) -> None:
        rows.append(tuple.__new__(Row, (follows, sample.angle, sample.velocity, command)))
        self._counter = sample.counter

    @property
    def rows(self) -> list[Row]:
        """The newest samples."""
        return list(self._rows)

    @property
    def proven(self) -> bool:
        """Returns True if the velocity follows the commands as declared."""
        return self._verdict == PROVEN

    def add_sample(self, sample: SensorSample, follows: bool, command: float) -> None:
        """Add one more sample, as :func:`take`; once the response is proven it is only stored.

        Raises StopError if the velocity follows the commands later, or earlier, than declared.
        """
        self._store(self._rows, sample, follows, command)
        if self.proven:
            return
        self._state, self._verdict = take(self.model, self._state, follows, sample.angle, sample.velocity, command)
        if self._verdict == CONTRADICTED:
            raise StopError(Fault.RESPONSE_LATE, self.description)
        if self._verdict == PROVEN:
            self.law = self._full

    def watch(self, sample: SensorSample) -> None:
        """Store one of the first samples of the stop."""
        if len(self.stop) < STORED:
            follows = sample.counter == next_counter(self._counter)
            self._store(self.stop, sample, follows, sample.applied_current)

    @property
    def description(self) -> str:
        """Measured delay and what is declared of it [samples]."""
        model, state = self.model, self._state
        late, error = overshoot(model, state, 0.0)
        delay = state.mean[1] * model.current * model.sample_time
        most = model.age + model.extra / model.sample_time
        found = f"{model.age + late / delay:z.1f} ± {error / delay:.1f}"
        return f"the velocity follows the commands with a delay of {found} samples, at most {most:.3g} are declared"
