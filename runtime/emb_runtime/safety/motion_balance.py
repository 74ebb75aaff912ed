"""Motion of a whole run against the one brake that explains it best.

In a period in which the brake slides, the velocity changes by t (k_m i − γ k_1 x⁺ − T_c sign(v) − f_v v)/J. The balance
fits this to all such periods by least squares, with what the currents of the two periods before still do, and sums up
what is left. A brake with other friction, a curved stiffness, a hysteresis or a delay leaves little, as its parameters
take up most of it. Sensors or a current whose scale changes, a zero or a current that is off, leave a sum that grows:
the unexplained velocity is the range of that sum (a CUSUM of least-squares residuals: Ploberger and Krämer, The CUSUM
test with OLS residuals, Econometrica 60, 1992).

A zero of the angle that is wrong by z adds the torque γ k_1 z wherever the spring presses, whatever the angle; a
current that is not reported adds one as well. This torque is one more regressor, at the end of a run, of least squares
on the velocities less their mean in each stretch of sliding: the errors of velocities are independent, those of their
changes are not.

An observer shows the velocity late, and how late is known from above only. There the velocity is the change of the
angle in a period: the mean of that period, which lags for no brake. From one mean to the next acts the mean torque of
both periods.

Plain scalar functions on one row of numbers, so that the runtime and a compiled batch run the same code. What it sees
and what it cannot: ``docs/explanation/sensor-monitor.md``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from emb_runtime.config.bench import Bench
from emb_runtime.records import SensorSample
from emb_runtime.safety.state_machine import Fault, StopError

SLIDES: Final = 12.0  # Speed above which the direction of friction is certain, in standard deviations of the velocity
PHYSICAL: Final = 4  # Coefficients of the brake
COEFFICIENTS: Final = 8  # And of the two earlier currents, curved stiffness, friction by the load
STRIDE: Final = 20  # Samples between two entries, at first
ENTRIES: Final = 32  # When so many are stored, every second one is dropped and the stride doubles
PAST: Final = 2  # Earlier currents that may still act
LEAST_PERIODS: Final = 40  # Periods in which the brake slid, below which nothing is judged
NOISE: Final = 25.0  # Allowed for noise, in standard deviations of the velocity
MISFIT: Final = 0.05  # Allowed for what the brake is beside its coefficients, as a share of the largest speed
LATE: Final = 0.16  # Allowed beside that for a current that acts a sample late, likewise
LOAD: Final = 0.03  # May be explained by friction that grows with the load, likewise
BREAK: Final = 0.6  # Allowed beside that for each stretch, whose ends noise decides, in standard deviations
REST_SAMPLES: Final = 20  # Last samples of a node at rest that are looked at; even
MOVING: Final = 2.0  # Mean velocity that no brake at rest has, in standard deviations of a measurement
TERMS: Final = COEFFICIENTS + 1  # And the spring's origin, as a share of the travel
ORIGIN_ALLOWED: Final = 2.2  # Distance of the origin from 0 that an honest run may show, beside what follows [rad]
ORIGIN_ERRORS: Final = 6.0  # Errors of the origin that are allowed, in standard deviations
ORIGIN_LATE: Final = 20.0  # Allowed where all of the current acts late, or the velocity lags [rad]
PRODUCTS: Final = TERMS * (TERMS + 3) // 2
EQUATIONS: Final = COEFFICIENTS * (COEFFICIENTS + 1) // 2
WIDTH: Final = COEFFICIENTS + 1

# Places in the row.
ANGLE: Final = 0  # Last measurement [rad]
VELOCITY: Final = 1  # Last measurement [rad/s]
CURRENT: Final = 2  # Current of the last period, then of the one before [A]
FOLLOWED: Final = 4  # Samples without a gap before the last one
PERIODS: Final = 5  # Periods that were taken in
STRETCHES: Final = 6  # Stretches of such periods without a break
SLID: Final = 7  # 1.0 if the last period was taken in
SAMPLES: Final = 8  # Samples since the last entry
SPACING: Final = 9  # Samples from one entry to the next
STORED: Final = 10  # Entries
NORMAL: Final = 11  # Normal equations: upper triangle by rows
RIGHT: Final = NORMAL + EQUATIONS  # Their right side
SUMS: Final = RIGHT + COEFFICIENTS  # Sums of each regressor so far, and of the change of the velocity
TABLE: Final = SUMS + WIDTH  # Entries: these sums, as they were
WORK: Final = TABLE + ENTRIES * WIDTH  # Equations during elimination
SOLUTION: Final = WORK + COEFFICIENTS * WIDTH  # Coefficients, as :func:`solve` left them
COUNT: Final = SOLUTION + COEFFICIENTS  # Velocities in the present stretch
SUM: Final = COUNT + 1  # Sums of the regressors since its begin, and the change of the velocity
FIRST: Final = SUM + TERMS + 1  # Sums of these over its velocities
SECOND: Final = FIRST + TERMS + 1  # Sums of their products: upper triangle by rows
CENTRED: Final = SECOND + PRODUCTS  # The same of earlier stretches, less the means
ORIGIN_WORK: Final = CENTRED + PRODUCTS  # Equations during elimination
ORIGIN: Final = ORIGIN_WORK + TERMS * (TERMS + 1)  # Coefficients, as :func:`origin` left them
MEMORY: Final = ORIGIN + TERMS  # Length of the row


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
    allowed: float  # Unexplained velocity of an honest run; infinite where nothing is judged [rad/s]
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


def begin(memory: Any, angle: float, velocity: float) -> None:
    """Begin a run with its first measurement, in a row of length MEMORY that is overwritten [rad, rad/s]."""
    for i in range(MEMORY):
        memory[i] = 0.0
    memory[ANGLE], memory[VELOCITY], memory[SPACING] = angle, velocity, STRIDE


def take(model: BalanceModel, memory: Any, follows: bool, angle: float, velocity: float, current: float) -> bool:
    """Take in one more sample.

    Args:
        model: of the bench.
        memory: row of the run, changed.
        follows: it is the next sample, and the command acted between the two; else nothing is summed up.
        angle: measured [rad].
        velocity: measured [rad/s].
        current: that the node reports of the period [A].

    Returns:
        True if an entry was stored: now :func:`unexplained` may have grown.
    """
    x, v, u1, u2 = memory[ANGLE], memory[VELOCITY], memory[CURRENT], memory[CURRENT + 1]
    followed = memory[FOLLOWED] + 1.0 if follows else 0.0
    acted, pressed = current, 0.5 * (x + angle)
    if model.derived:
        velocity, acted, pressed = (angle - x) / model.sample_time, 0.5 * (current + u1), x
    memory[ANGLE], memory[VELOCITY], memory[CURRENT], memory[CURRENT + 1] = angle, velocity, current, u1
    memory[FOLLOWED] = followed
    sign = 1.0 if min(v, velocity) > model.slides else -1.0 if max(v, velocity) < -model.slides else 0.0
    if followed > PAST and sign != 0.0:
        pressed = max(pressed, 0.0)
        row = (
            model.motor * acted,
            -model.spring * pressed,
            -model.coulomb * sign,
            -model.viscous * 0.5 * (v + velocity),
            model.motor * (u1 - current),
            model.motor * (u2 - u1),
            -model.curved * pressed * pressed,
            -model.spring * pressed * sign,
        )
        _add(memory, row, velocity - v)
        _add_to_stretch(memory, row, -model.spring * model.travel if pressed > 0.0 else 0.0, velocity - v)
        memory[STRETCHES] += 1.0 - memory[SLID]
        memory[SLID] = 1.0
    else:
        memory[SLID] = 0.0
        _end_stretch(memory)
    memory[SAMPLES] += 1.0
    if memory[SAMPLES] < memory[SPACING]:
        return False
    memory[SAMPLES] = 0.0
    _store(memory)
    return True


def _add(memory: Any, row: tuple[float, ...], change: float) -> None:
    place = NORMAL
    for i in range(COEFFICIENTS):
        for j in range(i, COEFFICIENTS):
            memory[place] += row[i] * row[j]
            place += 1
        memory[RIGHT + i] += row[i] * change
        memory[SUMS + i] += row[i]
    memory[SUMS + COEFFICIENTS] += change
    memory[PERIODS] += 1.0


def _store(memory: Any) -> None:
    stored = int(memory[STORED])
    if stored == ENTRIES:
        stored //= 2
        for i in range(stored):
            for j in range(WIDTH):
                memory[TABLE + i * WIDTH + j] = memory[TABLE + (2 * i + 1) * WIDTH + j]
        memory[SPACING] *= 2.0
    for j in range(WIDTH):
        memory[TABLE + stored * WIDTH + j] = memory[SUMS + j]
    memory[STORED] = stored + 1.0


def unexplained(model: BalanceModel, memory: Any) -> float:
    """Velocity that the best brake leaves unexplained: the range of the sum of its residuals [rad/s].

    Friction that grows with the load can look like much that is none: it may explain ``model.load`` and no more.
    """
    without = _range(model, memory, COEFFICIENTS - 1) - model.load
    return max(_range(model, memory, COEFFICIENTS), without)


def _range(model: BalanceModel, memory: Any, count: int) -> float:
    """Range of the sum of the residuals, with the first coefficients only."""
    solve(model, memory, count)
    low, high = 0.0, 0.0
    for at in range(SUMS, TABLE + int(memory[STORED]) * WIDTH, WIDTH):
        left = memory[at + COEFFICIENTS]
        for j in range(count):
            left -= memory[SOLUTION + j] * memory[at + j]
        low, high = min(left, low), max(left, high)
    return float(high - low)


def allowance(model: BalanceModel, memory: Any) -> float:
    """Unexplained velocity of an honest run, after :func:`unexplained` [rad/s]; infinite where too little slid."""
    if memory[PERIODS] < LEAST_PERIODS:
        return math.inf
    late = SOLUTION + PHYSICAL
    acting_late = abs(memory[late]) + abs(memory[late + 1])
    return float(model.allowed + model.stretch * memory[STRETCHES] + model.late * acting_late)


def solve(model: BalanceModel, memory: Any, count: int) -> None:
    """Solve the normal equations for the first coefficients, by Gauss's elimination, in the row.

    They are factors of the nominal k_m, k_1, T_c and f_v, shares of the two currents before that still act, the
    curvature, and the share of the load in friction. Where the run says nothing of one, it is nominal.
    """
    place = NORMAL
    for i in range(count):
        for j in range(i, COEFFICIENTS):
            memory[WORK + i * WIDTH + j] = memory[place]
            place += 1
        nominal = 1.0 if i < PHYSICAL else 0.0
        memory[WORK + i * WIDTH + i] += model.prior
        memory[WORK + i * WIDTH + COEFFICIENTS] = memory[RIGHT + i] + model.prior * nominal
    _eliminate(memory, WORK, SOLUTION, count, WIDTH)


def origin(model: BalanceModel, memory: Any) -> tuple[float, float]:
    """Angle at which the spring of the nominal brake begins, and how far from 0 that may be [rad]."""
    _end_stretch(memory)
    prior, width = model.deviation * model.deviation, TERMS + 1
    place = CENTRED
    for i in range(TERMS):
        for j in range(i, width):
            memory[ORIGIN_WORK + i * width + j] = memory[place]
            place += 1
        memory[ORIGIN_WORK + i * width + i] += prior
        memory[ORIGIN_WORK + i * width + TERMS] += prior if i < PHYSICAL else 0.0
    _eliminate(memory, ORIGIN_WORK, ORIGIN, TERMS, width)
    pivot = memory[ORIGIN_WORK + (TERMS - 1) * width + TERMS - 1]  # the last is the inverse of a variance
    error = model.travel * model.deviation / math.sqrt(pivot)
    late = abs(memory[ORIGIN + PHYSICAL]) + abs(memory[ORIGIN + PHYSICAL + 1])
    allowed = ORIGIN_ALLOWED + ORIGIN_ERRORS * error + ORIGIN_LATE * late
    return -model.travel * float(memory[ORIGIN + TERMS - 1]), float(allowed)


def _add_to_stretch(memory: Any, row: tuple[float, ...], torque: float, change: float) -> None:
    memory[COUNT] = max(memory[COUNT], 1.0) + 1.0  # with the velocity at its begin, where all sums are 0
    for i in range(COEFFICIENTS):
        memory[SUM + i] += row[i]
    memory[SUM + COEFFICIENTS] += torque
    memory[SUM + TERMS] += change
    place = SECOND
    for i in range(TERMS):
        left = memory[SUM + i]
        memory[FIRST + i] += left
        for j in range(i, TERMS + 1):
            memory[place] += left * memory[SUM + j]
            place += 1
    memory[FIRST + TERMS] += memory[SUM + TERMS]


def _end_stretch(memory: Any) -> None:
    count = memory[COUNT]
    if count == 0.0:
        return
    place = 0
    for i in range(TERMS):
        for j in range(i, TERMS + 1):
            memory[CENTRED + place] += memory[SECOND + place] - memory[FIRST + i] * memory[FIRST + j] / count
            place += 1
    for at in range(COUNT, CENTRED):
        memory[at] = 0.0


def _eliminate(memory: Any, work: int, solution: int, count: int, width: int) -> None:
    """Solve ``count`` symmetric equations by Gauss's elimination, in the row.

    At the place ``work`` lies their upper triangle, in rows of ``width`` with the right side at the end; what solves
    them comes to the place ``solution``.
    """
    for i in range(count):
        top = work + i * width
        for j in range(i + 1, count):
            factor = memory[top + j] / memory[top + i]
            for k in range(j, width):
                memory[work + j * width + k] -= factor * memory[top + k]
    for i in range(count - 1, -1, -1):
        top = work + i * width
        value = memory[top + width - 1]
        for j in range(i + 1, count):
            value -= memory[top + j] * memory[solution + j]
        memory[solution + i] = value / memory[top + i]


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

    __slots__ = ("_memory", "_model")

    def __init__(self, bench: Bench) -> None:
        self._model = balance_model(bench)
        self._memory = [0.0] * MEMORY

    def begin(self, sample: SensorSample) -> None:
        """Begin a run with its first sample."""
        begin(self._memory, sample.angle, sample.velocity)

    def take(self, sample: SensorSample, follows: bool) -> None:
        """Take in one more sample, as :func:`take`; raises StopError if the motion so far has no explanation."""
        if take(self._model, self._memory, follows, sample.angle, sample.velocity, sample.applied_current):
            self.judge()

    def judge(self) -> tuple[float, float]:
        """Unexplained velocity and what is allowed, infinite where nothing is judged [rad/s].

        Raises StopError if it is more than that.
        """
        found = unexplained(self._model, self._memory)
        most = allowance(self._model, self._memory)
        if found > most:
            raise StopError(
                Fault.MOTION_UNEXPLAINED,
                f"{found:.0f} rad/s of the motion are not those of any one brake (at most {most:.0f} rad/s are)",
            )
        return found, most

    def judge_zero(self) -> None:
        """Raise StopError if the spring, at the end of a run, does not begin at the zero of the angle."""
        place, most = origin(self._model, self._memory)
        if abs(place) > most and allowance(self._model, self._memory) < math.inf:
            raise StopError(
                Fault.MOTION_UNEXPLAINED,
                f"the spring begins at {place:.1f} rad, at most {most:.1f} rad from 0 is expected: the angle's zero is "
                "wrong, or a current acts that is not reported",
            )
