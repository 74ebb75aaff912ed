"""A batch of experiments: brakes, instruments, shield, sensitivities and Fisher information, step by step.

:func:`advance` is the one definition of a step. The scalar environment runs it as plain Python on a batch of one, the
vector environment compiled on a batch of many; both draw an episode's parameters and noise from one generator per
episode slot at its reset, so equal seeds give equal episodes, bit for bit.

Time: a reset gives the measurement y_0. The action that answers y_k is shielded with y_k and acts during [k, k + 1],
or later by the plant's command delay. The Fisher information is that of angle and velocity with the bench's noise: what
the experiment tells, whatever the plant's instruments make of it on the way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import SENSITIVE, STATES, no_sensitivity
from emb_bench.brake.motion import advance as move
from emb_bench.information import Kind, weights_of
from emb_bench.instruments import MEMORY, command, measure, settle
from emb_bench.packed import add_increment, packed_size
from emb_bench.plant import DEFAULT_PLANT
from emb_runtime.bench import PARAMETER_NAMES, Bench, BrakeParameters, Ranges
from emb_runtime.envelope import ShieldLaw, make_law
from emb_runtime.errors import UsageError
from emb_runtime.plants import Instruments, Mechanics
from emb_runtime.shield import PAST, shield
from emb_train.conditions import BENCH_CONDITIONS, EVERYTHING, Conditions

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bools = NDArray[np.bool_]


class Rules(NamedTuple):
    """The constants of an experiment; floats and integers only, so that it compiles."""

    sample_time: float
    """[s]."""
    horizon: int
    """Steps in one experiment."""
    angle_low: float
    """[rad]."""
    angle_high: float
    """[rad]."""
    velocity: float
    """Largest speed [rad/s]."""
    angle_weight: float
    """Of the angle in the FIM, see :func:`emb_bench.information.weights_of`."""
    velocity_weight: float
    """Of the velocity."""
    shielded: bool
    """Whether the shield has the last word; else what is wanted is clipped to the limit."""


def rules_of(bench: Bench, kind: Kind = "weighted", shielded: bool = True) -> Rules:
    """The constants of this bench's experiment, with this Fisher information."""
    timing, limits = bench.timing, bench.limits
    weights = weights_of(bench, kind)
    return Rules(timing.sample_time, timing.horizon, *limits.angle, limits.velocity, *weights, shielded)


def clipped(wanted: float, limit: float) -> float:
    """A current within ±limit [A]; one that is not finite counts as 0 A, as it does for the shield."""
    return min(max(wanted, -limit), limit) if math.isfinite(wanted) else 0.0


def advance(
    law: ShieldLaw,
    rules: Rules,
    mechanics: Mechanics,
    instruments: Instruments,
    chosen: Integers,
    brakes: Floats,
    x: Floats,
    s: Floats,
    m: Floats,
    memory: Floats,
    y: Floats,
    past: Floats,
    k: Integers,
    noise: Floats,
    late: Floats,
    wanted: Floats,
    reasons: Integers,
    violated: Bools,
) -> None:
    """One sample period for N brakes, in place.

    Args:
        law: the shield's.
        rules: the experiment's.
        mechanics: how the brakes move.
        instruments: what lies between them and the bus.
        chosen: indices in ``UNKNOWNS`` of the n parameters, shape [n].
        brakes: rows of :class:`BrakeParameters`, shape [N, 6].
        x: true states, see :mod:`emb_bench.brake.motion`: angle [rad], velocity [rad/s] and two more, shape [N, 4].
        s: sensitivities of all four to the relative parameters, shape [N, n, 4].
        m: packed FIM, shape [N, n (n + 1) / 2].
        memory: of the instruments, shape [N, MEMORY].
        y: measured angle and velocity, shape [N, 2].
        past: the last sent currents, newest first [A], shape [N, PAST].
        k: step, shape [N].
        noise: of the sensors for all samples of the episode, shape [N, horizon + 1, 2].
        late: how much too late each of them is taken [s], shape [N, horizon + 1].
        wanted: currents asked for [A], shape [N].
        reasons: becomes the shield's :class:`emb_runtime.records.Reason` bits, shape [N].
        violated: becomes whether the brake has left its limits, shape [N].
    """
    for i in range(x.shape[0]):
        p = BrakeParameters(
            float(brakes[i, 0]),
            float(brakes[i, 1]),
            float(brakes[i, 2]),
            float(brakes[i, 3]),
            float(brakes[i, 4]),
            float(brakes[i, 5]),
        )
        y1, y2 = float(y[i, 0]), float(y[i, 1])
        u1, u2, u3, u4, u5 = (
            float(past[i, 0]),
            float(past[i, 1]),
            float(past[i, 2]),
            float(past[i, 3]),
            float(past[i, 4]),
        )
        if rules.shielded:
            u, reasons[i] = shield(law, y1, y2, float(wanted[i]), (u1, u2, u3, u4, u5), int(k[i]))
        else:
            u, reasons[i] = clipped(float(wanted[i]), law.current), 0
        before = float(x[i, 1])
        move(mechanics, p, x[i], command(instruments, memory[i], u), rules.sample_time, chosen, s[i])
        add_increment(m[i], s[i], rules.angle_weight, rules.velocity_weight)
        k[i] += 1
        x1, x2 = float(x[i, 0]), float(x[i, 1])
        y[i, 0], y[i, 1] = measure(
            instruments,
            memory[i],
            rules.sample_time,
            x1,
            x2,
            (x2 - before) / rules.sample_time,
            float(late[i, k[i]]),
            float(noise[i, k[i], 0]),
            float(noise[i, k[i], 1]),
        )
        past[i, 0], past[i, 1], past[i, 2], past[i, 3], past[i, 4] = u, u1, u2, u3, u4
        violated[i] = not (rules.angle_low <= x1 <= rules.angle_high and abs(x2) <= rules.velocity)


def signed_log(value: float) -> float:
    """sign(v) log(1 + |v|): of order one for what spans many decades."""
    return math.copysign(math.log1p(abs(value)), value)


def describe(
    rules: Rules,
    middle: Floats,
    half: Floats,
    brakes: Floats,
    columns: Integers,
    x: Floats,
    s: Floats,
    m: Floats,
    k: Integers,
    out: NDArray[np.float32],
) -> None:
    """What the critic sees (thesis Table 4.2, and the sensitivities), in fixed scales of order one, in place.

    Without the sensitivities the next increment of the FIM is not a function of the state: it would not be Markov.

    Args:
        rules: the experiment's.
        middle: of the range of each parameter, shape [n].
        half: its half width, shape [n]; 1 for a parameter that does not vary.
        brakes: rows of :class:`BrakeParameters`, shape [N, 6].
        columns: of the n parameters in ``brakes``, shape [n].
        x: true state, shape [N, 4].
        s: sensitivities, shape [N, n, 4].
        m: packed FIM, shape [N, n (n + 1) / 2].
        k: step, shape [N].
        out: becomes x_1, x_2, k, θ, FIM, sensitivities, shape [N, 3 + n + n (n + 1) / 2 + 2 n].
    """
    n = columns.shape[0]
    for i in range(x.shape[0]):
        out[i, 0] = x[i, 0] / rules.angle_high
        out[i, 1] = x[i, 1] / rules.velocity
        out[i, 2] = k[i] / rules.horizon
        at = 3
        for j in range(n):
            out[i, at + j] = (brakes[i, columns[j]] - middle[j]) / half[j]
        at += n
        for j in range(m.shape[1]):
            out[i, at + j] = 0.1 * signed_log(m[i, j])
        at += m.shape[1]
        for j in range(n):
            out[i, at + 2 * j] = 4.0 * s[i, j, 0] / rules.angle_high
            out[i, at + 2 * j + 1] = 4.0 * s[i, j, 1] / rules.velocity


class Batch:
    """N experiments that advance together. Arrays are as in :func:`advance`.

    Attributes:
        x: true states, shape [N, 4].
        y: measurements, shape [N, 2].
        m: packed FIMs, of the conditions' kind, shape [N, n (n + 1) / 2].
        k: steps, shape [N].
        past: last sent currents, newest first, shape [N, PAST].
        reasons: why the last sent current is not what was wanted, shape [N].
        violated: whether the limits have been left, shape [N].
    """

    def __init__(
        self,
        bench: Bench,
        ranges: Ranges,
        parameters: Sequence[str],
        count: int,
        translate: Callable[[Callable[..., None]], Callable[..., None]] = lambda fn: fn,
        plant: str = DEFAULT_PLANT,
        conditions: Conditions = BENCH_CONDITIONS,
    ) -> None:
        """Prepare arrays; every row needs a :meth:`begin` before the first step.

        Args:
            bench: plant, limits, noise, timing, shield.
            ranges: where the parameters of each episode are drawn from.
            parameters: whose information is collected, in the order of ``PARAMETER_NAMES``.
            count: N.
            translate: turns the plain functions into those that run: ``emb_bench.compiled.compiled`` or nothing.
            plant: which of the bench's plants.
            conditions: shield or none, how many steps, which information.

        Raises:
            BenchFileError: the bench has no such plant, or no such set for the shield.
            UsageError: a parameter is unknown or out of order, or a brake of these ranges is not covered by the shield.
        """
        if not parameters or tuple(p for p in PARAMETER_NAMES if p in parameters) != tuple(parameters):
            raise UsageError(
                f"expected some of {', '.join(PARAMETER_NAMES)} in this order, got {', '.join(parameters)}"
            )
        require_covered(bench, ranges, conditions)
        bench = conditions.applied(bench)
        self.bench = bench
        self.conditions = conditions
        self.rules = rules_of(bench, conditions.kind, conditions.shielded)
        self.parameters = tuple(parameters)
        self._ranges = ranges
        self._law = make_law(bench)
        self._plant = bench.plant(plant)
        self._chosen, _ = no_sensitivity(parameters)
        self._columns = np.array([BrakeParameters._fields.index(p) for p in parameters], np.int64)
        low, high = np.array(ranges.low)[self._columns], np.array(ranges.high)[self._columns]
        self._middle, self._half = 0.5 * (low + high), np.where(high > low, 0.5 * (high - low), 1.0)
        self._deviations = np.array([bench.noise.angle, bench.noise.velocity])
        self._advance, self._describe = translate(advance), translate(describe)
        n = len(parameters)
        self.brakes = np.zeros((count, len(BrakeParameters._fields)))
        self.x, self.y = np.zeros((count, STATES)), np.zeros((count, 2))
        self._s = np.zeros((count, n, SENSITIVE))
        self._memory = np.zeros((count, MEMORY))
        self.m = np.zeros((count, packed_size(n)))
        self.past = np.zeros((count, PAST))
        self.k = np.full(count, self.rules.horizon)  # as if over: no row advances before its first begin
        self.reasons = np.zeros(count, np.int64)
        self.violated = np.zeros(count, np.bool_)
        self._noise = np.zeros((count, bench.timing.horizon + 1, 2))
        self._late = np.zeros((count, bench.timing.horizon + 1))
        # What :mod:`emb_train.following` takes, in its order.
        law, parts, scale = self._law, self._plant, (self._middle, self._half, self._columns)
        self.constants = (law, self.rules, parts.mechanics, parts.instruments, self._chosen, *scale)
        moved = (self.brakes, self.x, self._s, self.m, self._memory, self.y, self.past, self.k)
        self.rows = (*moved, self._noise, self._late)
        self.critic_size = critic_size(n)
        self.observation_size = conditions.observation_size(n)

    def begin(self, i: int, rng: np.random.Generator, brake: BrakeParameters | None = None) -> None:
        """Begin a new experiment in row ``i``: at rest at the origin.

        Args:
            i: row.
            rng: draws the uncertain parameters first (also if ``brake`` is given), then the noise of all samples, then
                the jitter of their instants if there is any.
            brake: the brake to use instead of a drawn one.
        """
        drawn = rng.uniform(self._ranges.low, self._ranges.high)
        self.brakes[i] = drawn if brake is None else brake
        self._noise[i] = rng.standard_normal(self._noise.shape[1:]) * self._deviations
        instruments = self._plant.instruments
        if instruments.clock_jitter > 0.0:
            self._late[i] = rng.normal(0.0, instruments.clock_jitter, self._late.shape[1])
        self.x[i] = 0.0
        settle(instruments, self._memory[i], 0.0)
        errors = (float(e) for e in (self._late[i, 0], *self._noise[i, 0]))
        self.y[i] = measure(instruments, self._memory[i], self.rules.sample_time, 0.0, 0.0, 0.0, *errors)
        self._s[i] = 0.0
        self.m[i] = 0.0
        self.past[i] = 0.0
        self.k[i] = 0
        self.reasons[i] = 0
        self.violated[i] = False

    def advance(self, wanted: Floats) -> None:
        """One sample period with the currents asked for [A], shape [N]; one that is not finite counts as 0 A.

        Raises:
            UsageError: the shape is another, or a row was not begun or has reached the horizon. The compiled step would
                not notice: it does not check its indices.
        """
        if wanted.shape != self.k.shape:
            raise UsageError(
                f"expected one current for each of the {len(self.k)} experiments, got shape {wanted.shape}"
            )
        if (self.k >= self.rules.horizon).any():
            raise UsageError("expected experiments that go on, got one that is over or was not begun: call reset first")
        self._advance(
            self._law,
            self.rules,
            self._plant.mechanics,
            self._plant.instruments,
            self._chosen,
            self.brakes,
            self.x,
            self._s,
            self.m,
            self._memory,
            self.y,
            self.past,
            self.k,
            self._noise,
            self._late,
            wanted,
            self.reasons,
            self.violated,
        )

    @property
    def terminated(self) -> Bools:
        """Whether the experiment is over: horizon reached or limits left, shape [N]. Both are true terminals."""
        return self.violated | (self.k >= self.rules.horizon)

    @property
    def home(self) -> Bools:
        """Whether angle and velocity are those of being home, inside the limits, shape [N]."""
        shield_ = self.bench.shield
        at_home = (np.abs(self.x[:, 0]) <= shield_.home_angle) & (np.abs(self.x[:, 1]) <= shield_.home_velocity)
        return at_home & ~self.violated

    def observation(self) -> NDArray[np.float32]:
        """What the actor sees under the conditions: :meth:`actor_observation`, or all of Table 4.2 but measured values.

        Returns:
            Shape [N, observation_size].
        """
        if self.conditions.observes != EVERYTHING:
            return self.actor_observation()
        return self.critic_observation()[:, : self.observation_size].copy()

    def actor_observation(self) -> NDArray[np.float32]:
        """Measured angle [rad], measured velocity [rad/s], step; raw, shape [N, 3]."""
        out = np.empty((len(self.k), 3), np.float32)
        out[:, :2] = self.y
        out[:, 2] = self.k
        return out

    def seen(self) -> NDArray[np.float32]:
        """What an excitation may see: the actor's three and the current that acted in the last period [A], [N, 4]."""
        return np.column_stack((self.y, self.k, self.x[:, 3])).astype(np.float32)

    def critic_observation(self) -> NDArray[np.float32]:
        """See :func:`describe`, shape [N, critic_size]."""
        out = np.empty((len(self.k), self.critic_size), np.float32)
        self._describe(
            self.rules,
            self._middle,
            self._half,
            self.brakes,
            self._columns,
            self.x,
            self._s,
            self.m,
            self.k,
            out,
        )
        return out


def critic_size(n: int) -> int:
    """Length of the critic's observation for n parameters."""
    return 3 + n + packed_size(n) + 2 * n


def require_covered(bench: Bench, ranges: Ranges, conditions: Conditions = BENCH_CONDITIONS) -> None:
    """Check that the shield, if there is one, holds the limits for every brake of these ranges.

    Raises:
        UsageError: it does not; the message names the parameter and both ranges.
        BenchFileError: the bench has no set of the name that the conditions have for the shield.
    """
    if not conditions.shielded:
        return
    bench = conditions.applied(bench)
    box = bench.range_set(bench.shield.ranges)
    for name in box.uncovered(ranges.low, ranges.high):
        raise UsageError(
            f"the set of ranges '{ranges.name}' has {name} from {getattr(ranges.low, name):g} to "
            f"{getattr(ranges.high, name):g}, the shield's set '{box.name}' covers {getattr(box.low, name):g} to "
            f"{getattr(box.high, name):g}: narrow the first or widen the second in the bench file"
        )
