"""Motion of a run against the one brake that explains it best.

In a period in which the brake slides, the velocity changes by t (k_m i − γ k_1 x⁺ − T_c sign(v) − f_v v)/J. The balance
fits this to all such periods by least squares, with what the currents of the two periods before still do, and sums up
the residuals. A brake with other friction, a curved stiffness, a hysteresis or a delay leaves little, as its parameters
take up most of it. Sensors or a current whose scale changes, a zero or a current that is off, leave a sum that grows:
the unexplained velocity is the range of that sum (a CUSUM of least-squares residuals: Ploberger and Krämer, The CUSUM
test with OLS residuals, Econometrica 60, 1992).

A zero of the angle that is wrong by z adds the torque γ k_1 z wherever the spring presses, whatever the angle; a
current that is not reported adds one as well. This torque is one more regressor, at the end of a run, of least squares
on the velocities less their mean in each stretch of sliding: the errors of velocities are independent, those of their
changes are not.

An observer shows the velocity late, and the bench declares only the longest lag. There the velocity is the change of
the angle in a period: the mean of that period, which does not lag. From one mean to the next acts the mean torque of
both periods.

Plain functions of numbers and lists of them, so that the runtime and a compiled batch run the same code. What it sees
and what it cannot: ``docs/explanation/sensor-monitor.md``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from emb_runtime.config.bench import Bench
from emb_runtime.records import SensorSample
from emb_runtime.safety.state_machine import Fault, StopError

SLIDES: Final = 12.0  # Speed above which the direction of friction is certain, in standard deviations of the velocity
PHYSICAL: Final = 4  # Coefficients of the brake
COEFFICIENTS: Final = 8  # And of the two earlier currents, curved stiffness, friction by the load
STRIDE: Final = 20  # Samples between two entries, at first
ENTRIES: Final = 32  # When so many are stored, every second one is dropped and the stride doubles
PAST: Final = 2  # Earlier currents that may still act
LEAST_PERIODS: Final = 40  # Periods in which the brake slid, below which there is no verdict
NOISE: Final = 25.0  # Allowed for noise, in standard deviations of the velocity
MISFIT: Final = 0.05  # Allowed for what the brake is beside its coefficients, as a share of the largest speed
LATE: Final = 0.16  # Allowed beside that for a current that acts a sample late, likewise
LOAD: Final = 0.03  # May be explained by friction that grows with the load, likewise
BREAK: Final = 0.6  # Allowed beside that for each stretch, whose ends noise decides, in standard deviations
REST_SAMPLES: Final = 20  # Last samples of a node at rest that are looked at; even
MOVING: Final = 2.0  # Mean velocity that no brake at rest has, in standard deviations of a measurement
TERMS: Final = COEFFICIENTS + 1  # And the spring's origin, as a share of the travel
WIDTH: Final = TERMS + 1  # And the change of the velocity
ORIGIN_ALLOWED: Final = 2.2  # Distance of the origin from 0 that a fault-free run may show, beside what follows [rad]
ORIGIN_ERRORS: Final = 6.0  # Errors of the origin that are allowed, in standard deviations
ORIGIN_LATE: Final = 20.0  # Allowed where all of the current acts late, or the velocity lags [rad]
Rows = list[list[float]]


class BalanceModel(NamedTuple):
    """Numbers that the balance works with; floats and a flag, so that what uses it compiles."""

    motor: float  # Change of the velocity in a period by 1 A, on the nominal brake [rad/(s·A)]
    spring: float  # By 1 rad [1/s]
    coulomb: float  # By Coulomb friction [rad/s]
    viscous: float  # By 1 rad/s
    curved: float  # By 1 rad², where the stiffness doubles over the whole travel [1/(rad·s)]
    deviation: float  # Standard deviation of a velocity, as :func:`take` has it [rad/s]
    travel: float  # Largest angle [rad]
    slides: float  # Speed above which a period counts [rad/s]
    prior: float  # Weight of the nominal brake in the normal equations [rad²/s²]
    allowed: float  # Limit of the unexplained velocity; infinite where there is no verdict [rad/s]
    stretch: float  # Allowed beside that for each stretch [rad/s]
    load: float  # What friction that grows with the load may explain [rad/s]
    late: float  # Allowed beside that where all of the current acts a sample late [rad/s]
    sample_time: float  # [s]
    derived: bool  # True if the velocity is an observer's, which derives it from the angle


def balance_model(bench: Bench) -> BalanceModel:
    """The model of a bench."""
    brake, t = bench.brake, bench.timing.sample_time
    derived, fastest = bench.sensors.velocity == "observer", bench.limits.velocity
    deviation = math.sqrt(2.0) * bench.noise.angle / t if derived else bench.noise.velocity
    covered = bench.shield.frame_age[1] <= PAST and bench.shield.current_lag == 0.0
    return BalanceModel(
        motor=t * brake.k_m / brake.J,
        spring=t * brake.gamma * brake.k_1 / brake.J,
        coulomb=t * brake.T_c / brake.J,
        viscous=t * brake.f_v / brake.J,
        curved=t * brake.gamma * brake.k_1 / brake.J / bench.limits.angle[1],
        deviation=deviation,
        travel=bench.limits.angle[1],
        slides=SLIDES * deviation,
        prior=2.0 * deviation * deviation,
        allowed=max(NOISE * deviation, MISFIT * fastest) if covered else math.inf,
        stretch=BREAK * deviation,
        load=LOAD * fastest,
        late=LATE * fastest,
        sample_time=t,
        derived=derived,
    )


class Stretch(NamedTuple):
    """Sums over the velocities of a stretch of sliding, the one at its start included; lists are changed in place."""

    total: list[float]  # Sum of the rows since its start, shape [WIDTH]: the velocity gained, and what it consists of
    first: list[float]  # Sum of ``total`` over the velocities, shape [WIDTH]
    second: Rows  # Sum of its products: upper triangle of shape [TERMS, WIDTH]


class State(NamedTuple):
    """State of the balance after a sample; lists are changed in place.

    The row of a period is the change of the velocity by each coefficient, by the origin, and as measured [rad/s].
    """

    angle: float  # Last measurement [rad]
    velocity: float  # Last measurement [rad/s]
    current: float  # Of the last period [A]
    earlier: float  # Of the one before [A]
    followed: int  # Samples without a gap before the last one
    periods: int  # Periods that were taken in
    stretches: int  # Stretches of such periods without a break
    length: int  # Velocities in the present stretch; 0 if the last period was not taken in
    samples: int  # Samples since the last entry; 0 if the last one made an entry
    spacing: int  # Samples from one entry to the next
    total: list[float]  # Sum of all rows so far, shape [WIDTH]
    entries: Rows  # These sums as they were at first, where they are zero, and with some samples
    equations: Rows  # Sum of the products of all rows: upper triangle of shape [COEFFICIENTS, WIDTH]
    stretch: Stretch  # The present one
    centred: Rows  # Products of earlier stretches, less the means: upper triangle of shape [TERMS, WIDTH]


def begin_balance(angle: float, velocity: float) -> State:
    """State at the first measurement of a run [rad, rad/s]."""
    total, equations, centred = [0.0] * WIDTH, _zeros(COEFFICIENTS), _zeros(TERMS)
    return State(angle, velocity, 0.0, 0.0, 0, 0, 0, 0, 0, STRIDE, total, _zeros(1), equations, _new_stretch(), centred)


def _zeros(count: int) -> Rows:
    return [[0.0] * WIDTH for _ in range(count)]


def _new_stretch() -> Stretch:
    return Stretch([0.0] * WIDTH, [0.0] * WIDTH, _zeros(TERMS))


def take(model: BalanceModel, state: State, follows: bool, angle: float, velocity: float, current: float) -> State:
    """Take in one more sample.

    Args:
        model: of the bench.
        state: after the sample before.
        follows: it is the next sample, and the command acted between the two; else nothing is summed up.
        angle: measured [rad].
        velocity: measured [rad/s].
        current: that the node reports of the period [A].

    Returns:
        The next state. If an entry was made, :func:`unexplained` may have grown.
    """
    x, v, u1, u2 = state.angle, state.velocity, state.current, state.earlier
    followed = state.followed + 1 if follows else 0
    acted, pressed = current, 0.5 * (x + angle)
    if model.derived:
        velocity, acted, pressed = (angle - x) / model.sample_time, 0.5 * (current + u1), x
    sign = 1.0 if min(v, velocity) > model.slides else -1.0 if max(v, velocity) < -model.slides else 0.0
    periods, stretches, length = state.periods, state.stretches, state.length
    total, stretch, centred = state.total, state.stretch, state.centred
    if followed > PAST and sign != 0.0:
        pressed = max(pressed, 0.0)
        row = [
            model.motor * acted,
            -model.spring * pressed,
            -model.coulomb * sign,
            -model.viscous * 0.5 * (v + velocity),
            model.motor * (u1 - current),
            model.motor * (u2 - u1),
            -model.curved * pressed * pressed,
            -model.spring * pressed * sign,
            -model.spring * model.travel if pressed > 0.0 else 0.0,
            velocity - v,
        ]
        _add(total, row)
        _add_products(state.equations, row)
        _add(stretch.total, row)
        _add(stretch.first, stretch.total)
        _add_products(stretch.second, stretch.total)
        periods += 1
        stretches += 0 if length else 1
        length = max(length, 1) + 1  # with the velocity at its start, where all sums are 0
    elif length:
        centred = _centred(state)
        stretch, length = _new_stretch(), 0
    samples, spacing, entries = state.samples + 1, state.spacing, state.entries
    if samples == spacing:
        samples = 0
        if len(entries) > ENTRIES:
            entries, spacing = entries[::2], 2 * spacing
        entries.append(total.copy())
    return State(
        angle, velocity, current, u1, followed, periods, stretches, length, samples, spacing, total, entries,
        state.equations, stretch, centred,
    )  # fmt: skip


def _add(sums: list[float], row: list[float]) -> None:
    for j in range(WIDTH):
        sums[j] += row[j]


def _add_products(sums: Rows, row: list[float]) -> None:
    for i in range(len(sums)):
        line, factor = sums[i], row[i]
        for j in range(i, WIDTH):
            line[j] += factor * row[j]


def _centred(state: State) -> Rows:
    """Products of all stretches, the present one included, less the means."""
    first, out = state.stretch.first, _zeros(TERMS)
    for i in range(TERMS):
        for j in range(i, WIDTH):
            here = state.stretch.second[i][j] - first[i] * first[j] / state.length
            out[i][j] = state.centred[i][j] + here
    return out


def unexplained(model: BalanceModel, state: State) -> tuple[float, float]:
    """Velocity that the best brake leaves unexplained, and what a fault-free run may leave [rad/s].

    The first is the range of the sum of its residuals. Friction that grows with the load can look like much that is
    none: it may explain ``model.load`` and no more. The second is infinite where too little slid.
    """
    best, _ = solve(state.equations, COEFFICIENTS, model.prior)
    without, _ = solve(state.equations, COEFFICIENTS - 1, model.prior)
    found = max(_range(state, best), _range(state, without) - model.load)
    if state.periods < LEAST_PERIODS:
        return found, math.inf
    acting_late = abs(best[PHYSICAL]) + abs(best[PHYSICAL + 1])
    return found, model.allowed + model.stretch * state.stretches + model.late * acting_late


def _range(state: State, coefficients: list[float]) -> float:
    """Range of the sum of the residuals."""
    low = high = _residual(state.total, coefficients)
    for sums in state.entries:
        residual = _residual(sums, coefficients)
        low, high = min(residual, low), max(residual, high)
    return high - low


def _residual(sums: list[float], coefficients: list[float]) -> float:
    residual = sums[TERMS]
    for j in range(len(coefficients)):
        residual -= coefficients[j] * sums[j]
    return residual


def solve(equations: Rows, count: int, prior: float) -> tuple[list[float], float]:
    """Solve normal equations for the first coefficients, by Gauss's elimination; the ``prior`` is the nominal brake's.

    They are factors of the nominal k_m, k_1, T_c and f_v, shares of the two currents before that still act, the
    curvature, the share of the load in friction, and the origin. One that the run does not determine is nominal.

    Returns:
        The coefficients, and the weight of the last one: the inverse of its variance for errors of variance 1.
    """
    rows = [equations[i].copy() for i in range(count)]
    for i in range(count):
        rows[i][i] += prior
        rows[i][TERMS] += prior if i < PHYSICAL else 0.0
    for i in range(count):
        top = rows[i]
        for j in range(i + 1, count):
            factor, row = top[j] / top[i], rows[j]
            for k in range(j, WIDTH):
                row[k] -= factor * top[k]
    coefficients = [0.0] * count
    for i in range(count - 1, -1, -1):
        value = rows[i][TERMS]
        for j in range(i + 1, count):
            value -= rows[i][j] * coefficients[j]
        coefficients[i] = value / rows[i][i]
    return coefficients, rows[count - 1][count - 1]


def origin(model: BalanceModel, state: State) -> tuple[float, float]:
    """Angle at which the spring of the nominal brake begins, and how far from 0 that may be [rad]."""
    centred = _centred(state) if state.length else state.centred
    found, weight = solve(centred, TERMS, model.deviation * model.deviation)
    error = model.travel * model.deviation / math.sqrt(weight)
    late = abs(found[PHYSICAL]) + abs(found[PHYSICAL + 1])
    return -model.travel * found[COEFFICIENTS], ORIGIN_ALLOWED + ORIGIN_ERRORS * error + ORIGIN_LATE * late


def steady_motion(velocities: Sequence[float], deviation: float) -> float:
    """Velocity that a node at rest goes on to measure [rad/s]; 0 if it measures none, or fewer than REST_SAMPLES times.

    A brake without a current that moves is slowed down by friction, so that a velocity that stays is an error. The
    ``deviation`` is that of one measurement.
    """
    if len(velocities) < REST_SAMPLES:
        return 0.0
    half = REST_SAMPLES // 2
    before, after = sum(velocities[:half]) / half, sum(velocities[half:]) / half
    mean = 0.5 * (before + after)
    stays = abs(after - before) <= MOVING * deviation
    return mean if stays and abs(mean) > MOVING * deviation else 0.0


def unheld_motion(bench: Bench, stopping: Sequence[SensorSample]) -> float:
    """Velocity that stays at the end of a stop, where friction holds every brake of the bench's ranges [rad/s].

    0 where it is none, or where spring and current together may overcome the least friction: then the brake creeps on.
    """
    last = stopping[-REST_SAMPLES:]
    speed = steady_motion([sample.velocity for sample in last], bench.noise.velocity)
    box, along = bench.range_set(bench.shield.ranges), math.copysign(1.0 / REST_SAMPLES, speed)
    behind = -along * sum(sample.angle for sample in last)  # towards home: the spring drives it
    current = along * sum(sample.applied_current for sample in last)
    spring = box.high.gamma * box.high.k_1 * max(behind, 0.0)
    motor = max(box.low.k_m * current, box.high.k_m * current)
    return speed if spring + motor < box.low.T_c else 0.0


class MotionBalance:
    """The balance of one run on a bench."""

    __slots__ = ("_model", "_state")

    def __init__(self, bench: Bench) -> None:
        self._model = balance_model(bench)
        self._state = begin_balance(0.0, 0.0)

    def begin_run(self, sample: SensorSample) -> None:
        """Begin a run with its first sample."""
        self._state = begin_balance(sample.angle, sample.velocity)

    def add_sample(self, sample: SensorSample, follows: bool) -> None:
        """Add one more sample, as :func:`take`; raises StopError if the motion so far has no explanation."""
        self._state = take(self._model, self._state, follows, sample.angle, sample.velocity, sample.applied_current)
        if self._state.samples == 0:
            self.check_motion()

    def check_motion(self) -> tuple[float, float]:
        """Unexplained velocity and its limit, infinite where there is no verdict [rad/s].

        Raises StopError if it is more than that.
        """
        found, most = unexplained(self._model, self._state)
        if found > most:
            raise StopError(
                Fault.MOTION_UNEXPLAINED,
                f"{found:.0f} rad/s of the motion are not those of any one brake (at most {most:.0f} rad/s are)",
            )
        return found, most

    def check_origin(self) -> None:
        """Raise StopError if the spring, at the end of a run, does not begin at the zero of the angle."""
        place, most = origin(self._model, self._state)
        _, allowed = unexplained(self._model, self._state)
        if abs(place) > most and allowed < math.inf:
            raise StopError(
                Fault.MOTION_UNEXPLAINED,
                f"the spring begins at {place:.1f} rad, at most {most:.1f} rad from 0 is expected: the angle's zero is "
                "wrong, or a current acts that is not reported",
            )
