"""N experiments side by side, one sample period after the other: shield, instruments, brake and Fisher information.

:func:`advance` is the one definition of a step; a :class:`Batch` runs it compiled.

Time: an experiment begins with the measurement y_0. The current that answers y_k is shielded with y_k and acts during
[k, k + 1], or later by the plant's command delay. The Fisher information is that of angle and velocity with the bench's
noise, whatever the plant's instruments make of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import SENSITIVE, STATES, no_sensitivity
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, LONGEST_DELAY, Instruments, Mechanics, Plant
from emb_bench.information.fisher import Kind, weights_of
from emb_bench.information.symmetric import Floats, add_increment, packed_size, upper
from emb_bench.sim.instruments import MEMORY, command, measure, settle
from emb_bench.sim.simulated_brake import pass_period, sent_current
from emb_runtime.config.bench import OLDEST_FRAME, PARAMETER_NAMES, BrakeParameters, Ranges
from emb_runtime.errors import UsageError
from emb_runtime.estimator.kalman import Model, State, believed, deviations, follow, make_model, start
from emb_runtime.estimator.speed_loop import current_for
from emb_runtime.policy.contract import SAMPLE
from emb_runtime.safety.response import OPEN, PROVEN, ResponseModel, response_model, take, unproven_law
from emb_runtime.safety.response import State as ResponseState
from emb_runtime.safety.response import begin as begin_response
from emb_runtime.safety.sensor_monitor import Cusum, Opposed, judge, largest_current
from emb_runtime.safety.sensor_monitor import State as MonitorState
from emb_runtime.safety.sensor_monitor import begin as begin_monitor
from emb_runtime.safety.sensor_thresholds import SensorThresholds, sensor_thresholds
from emb_runtime.safety.shield import PAST, damped_current
from emb_runtime.safety.shield_design import ShieldLaw, late_step, make_law

MEASURED: Literal["measured"] = "measured"
ESTIMATE: Literal["estimate"] = "estimate"
EVERYTHING: Literal["everything"] = "everything"
CURRENT: Literal["current"] = "current"
SPEED: Literal["speed"] = "speed"

Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]

# Numbers of a configuration
Count = Annotated[int, msgspec.Meta(ge=1, le=2**31)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Price = Annotated[float, msgspec.Meta(ge=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Gain = Annotated[float, msgspec.Meta(gt=0.0, le=1.0)]

MOST = 100.0  # Greatest estimate or deviation that is observed, of the nominal value
NUMBERS = 30  # Of a row that stores the state of an estimator or of a sensor monitor
RESPONSE = 44  # Verdict on the response, and numbers of its proof's state


class Conditions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Conditions in which an experiment of the training may differ from one on the bench."""

    shielded: bool = True  # True if the shield is between actor and brake; without it an action is clipped, no more
    horizon: int = 0  # Steps in one experiment; 0 for the bench's
    acts: Literal["current", "speed"] = CURRENT
    """Action of the actor: a current, or a target speed that the runtime's speed loop follows by the estimate."""
    observes: Literal["measured", "estimate", "everything"] = MEASURED
    """Observation of the actor: ``measured`` angle, velocity and step; these and the running ``estimate`` of the four
    parameters with its deviations; or ``everything`` (x₁, x₂, k, θ, the FIM)."""
    systematic: bool = False
    """Draw the offsets of encoder and current from the bench's priors; a wrong scale is what no shield can know."""
    information: Kind = "weighted"  # Fisher information that is collected: the thesis's, or the physical one
    draws: Literal["uniform", "normal"] = "uniform"
    """Distribution of the brakes in their ranges: normal is cut off at both ends, two standard deviations away."""
    normalised_by: Literal["true", "nominal"] = "true"
    """Values that the rewards divide the parameters by (eq. 4.17): those of each brake, or those of the bench."""
    tracking: Positive = 1.0  # Factor of the weights of the deviation from the quintic
    command_delay: tuple[int, int] = (0, 0)
    """Least and most samples that a command waits beside the plant's own delay, drawn for each experiment."""
    gain: Gain = 1.0  # Of the speed loop; less where commands act late

    def __post_init__(self) -> None:
        """Refuse what does not exist.

        Raises:
            UsageError: the delay or the horizon is out of its bounds.
        """
        low, high = self.command_delay
        if not 0 <= low <= high <= OLDEST_FRAME:
            raise UsageError(f"command_delay: expected least and most, from 0 to {OLDEST_FRAME}, got {low}, {high}")
        if self.horizon < 0:
            raise UsageError(f"horizon: expected steps, or 0 for the bench's, got {self.horizon}")
        if self.horizon and self.shielded:
            raise UsageError("horizon: the shield plans for the bench's; only an experiment without it has another")

    @property
    def varies(self) -> bool:
        """True if experiments have a delay of their own."""
        return self.command_delay[1] > 0

    def observation_size(self, count: int) -> int:
        """Length of the actor's observation if the information of this many parameters is collected."""
        sizes = {MEASURED: len(SAMPLE), ESTIMATE: len(SAMPLE) + 2 * len(PARAMETER_NAMES)}
        return sizes.get(self.observes, 3 + count + packed_size(count))

    @property
    def estimates(self) -> bool:
        """True if the estimator is in the loop."""
        return self.acts == SPEED or self.observes == ESTIMATE

    def applied(self, bench: Bench) -> Bench:
        """The bench with this horizon, and a shield that covers the drawn delays as well.

        It covers what the bench's shield covers or what is drawn, not the sum of both: right for a plant without a
        delay of its own.
        """
        timing = replace(bench.timing, horizon=self.horizon or bench.timing.horizon)
        shield = bench.shield
        if self.shielded and self.varies:
            (least, most), (low, high) = shield.frame_age, self.command_delay
            shield = shield._replace(frame_age=(min(least, low), max(most, high)))
        return replace(bench, timing=timing, shield=shield)


BENCH_CONDITIONS = Conditions()


class Rules(NamedTuple):
    """The constants of an experiment; floats and integers only."""

    shielded: bool  # True if the shield has the last word; else the requested current is clipped to the limit
    sample_time: float  # [s]
    horizon: int  # Steps in one experiment
    late_step: int  # Step in which the shield has an experiment that has ended, for it is to go home
    angle_low: float  # [rad]
    angle_high: float  # [rad]
    velocity: float  # Largest speed [rad/s]
    angle_weight: float  # Of the angle in the FIM, see :func:`emb_bench.information.fisher.weights_of`
    velocity_weight: float  # Of the velocity
    damping_velocity: float  # Of the node that brakes by itself [rad/s]; infinite for one that lets go
    estimates: bool  # True if the estimator is in the loop
    follows: bool  # True if what is requested is a target speed, which the speed loop follows
    gain: float  # Of the speed loop


class Setup(NamedTuple):
    """Constants that experiments side by side share; it compiles."""

    law: ShieldLaw  # Law of the shield; its limit of the current holds also without a shield
    unproven: ShieldLaw  # Law until the response is proven
    response: ResponseModel
    thresholds: SensorThresholds
    """Of the sensor monitor: until the motion has shown its sign, it limits the current to a first move."""
    rules: Rules
    mechanics: Mechanics  # Mechanics of the brakes
    instruments: Instruments  # Instruments between the brakes and the bus
    chosen: Integers  # Indices in ``PARAMETERS`` of the n parameters whose information is collected, shape [n]
    model: Model  # Of the estimator, the runtime's


def make_setup(bench: Bench, plant: Plant, parameters: Sequence[str], conditions: Conditions) -> Setup:
    """The setup of experiments on a bench, with conditions that are applied, that collect these parameters' FIM."""
    law, timing, limits = make_law(bench), bench.timing, bench.limits
    damping = bench.node.damping_velocity if bench.node.stop == "damped" else math.inf
    rules = Rules(
        conditions.shielded,
        timing.sample_time,
        timing.horizon,
        late_step(law),
        *limits.angle,
        limits.velocity,
        *weights_of(bench, conditions.information),
        damping,
        conditions.estimates,
        conditions.acts == SPEED,
        conditions.gain,
    )
    safety = law, unproven_law(bench, law), response_model(bench, law), sensor_thresholds(bench, law)
    model = make_model(bench, bench.range_set(bench.prior))
    return Setup(*safety, rules, plant.mechanics, plant.instruments, no_sensitivity(parameters)[0], model)


class Experiments(NamedTuple):
    """N experiments with n parameters: their brakes, their states, and the errors of all their samples.

    Arrays only, so that it compiles; functions change them in place.
    """

    brakes: Floats  # Rows of :class:`BrakeParameters`, shape [N, 6]
    delay: Integers  # Samples that each experiment's commands wait beside its plant's delay, shape [N]
    errors: Floats
    """Systematic errors: of the angle [rad] and of the current [A], shape [N, 2]."""
    x: Floats
    """True states, see :mod:`emb_bench.brake.motion`: angle [rad], velocity [rad/s] and two more, shape [N, 4]."""
    s: Floats  # Sensitivities of all four to the relative parameters, shape [N, n, 4]
    m: Floats  # Packed FIM, shape [N, n (n + 1) / 2]
    memory: Floats  # Of the instruments, shape [N, MEMORY]
    y: Floats  # Newest measured angle and velocity, shape [N, 2]
    applied: Floats  # The current that acted in the period before, as the node last reported it [A], shape [N]
    past: Floats  # The last sent currents, newest first [A], shape [N, PAST]; 0 where nothing was sent
    k: Integers  # Step, shape [N]
    noise: Floats  # Of the sensors for all samples of the experiment, shape [N, horizon + 1, 2]
    late: Floats  # Lateness with which each sample is taken [s], shape [N, horizon + 1]
    reasons: Integers
    """Reasons why the last current is not the requested one: :class:`emb_runtime.records.Reason` bits, shape [N]."""
    violated: Bools  # Mask of the brakes outside their limits, shape [N]
    returning: Bools  # Mask of the experiments that have ended before their horizon and are on the way home, shape [N]
    monitor: Floats
    """State of the sensor monitor until it confirms the polarity, see :func:`monitor_of`; shape [N, NUMBERS]."""
    response: Floats
    """Verdict on the response, and the state of its proof until then, see :func:`response_of`; shape [N, RESPONSE]."""
    estimate: Floats  # State of the estimator, see :func:`state_of`; shape [N, NUMBERS]
    told: Floats
    """Its values, then their deviations, of k_m, k_1, T_c and f_v in SI units, shape [N, 8]."""


def no_experiments(count: int, n: int, steps: int) -> Experiments:
    """N experiments with n parameters that are over: each has to begin before its first step."""
    return Experiments(
        brakes=np.zeros((count, len(BrakeParameters._fields))),
        delay=np.zeros(count, np.int64),
        errors=np.zeros((count, 2)),
        x=np.zeros((count, STATES)),
        s=np.zeros((count, n, SENSITIVE)),
        m=np.zeros((count, packed_size(n))),
        memory=np.zeros((count, MEMORY)),
        y=np.zeros((count, 2)),
        applied=np.zeros(count),
        past=np.zeros((count, PAST)),
        k=np.full(count, steps),
        noise=np.zeros((count, steps + 1, 2)),
        late=np.zeros((count, steps + 1)),
        reasons=np.zeros(count, np.int64),
        violated=np.zeros(count, np.bool_),
        returning=np.zeros(count, np.bool_),
        monitor=np.zeros((count, NUMBERS)),
        response=np.zeros((count, RESPONSE)),
        estimate=np.zeros((count, NUMBERS)),
        told=np.zeros((count, 2 * len(PARAMETER_NAMES))),
    )


def numbers_of(row: Any) -> Any:
    """A row as a tuple, shape [NUMBERS]; compiled code makes none of an array."""
    return six(row, 0) + six(row, 6) + six(row, 12) + six(row, 18) + six(row, 24)


def six(row: Any, at: int) -> tuple[float, float, float, float, float, float]:
    """Six numbers of a row, from a place on."""
    return (
        float(row[at]), float(row[at + 1]), float(row[at + 2]), float(row[at + 3]), float(row[at + 4]),
        float(row[at + 5]),
    )  # fmt: skip


def state_of(row: Any) -> State:
    """The state of an estimator as :func:`store` left it."""
    f = numbers_of(row)
    return State(f[0], f[1:7], f[7:28], f[28], f[29])


def store(state: State, row: Any) -> None:
    """Store the state of an estimator, shape [NUMBERS]."""
    row[:] = (state.step, *state.mean, *state.covariance, state.innovation, state.worst)


def response_of(row: Any) -> ResponseState:
    """The state of the proof of the response as it is stored behind the verdict, shape [RESPONSE]."""
    return ResponseState(
        float(row[1]), float(row[2]), six(row, 3), *six(row, 9), float(row[15]), float(row[16]), six(row, 17),
        six(row, 23) + six(row, 29) + six(row, 35) + (float(row[41]), float(row[42]), float(row[43])),
    )  # fmt: skip


def store_response(state: ResponseState, verdict: int, row: Any) -> None:
    """Store the verdict on the response and the state of its proof, shape [RESPONSE]."""
    sums = (
        state.flowing, state.largest, state.lagging, state.doubts, state.slides, state.innovations, state.misfit,
        state.likelihood,
    )  # fmt: skip
    row[:] = (float(verdict), state.angle, state.velocity, *state.commands, *sums, *state.mean, *state.covariance)


def monitor_of(row: Any) -> MonitorState:
    """The state of a sensor monitor as :func:`store_monitor` left it."""
    f = numbers_of(row)
    travel, motion, opposed = Cusum(f[2], f[3]), Cusum(f[6], f[7]), Opposed(f[8], f[9], f[10], Cusum(f[11], f[12]))
    shown = f[27] > 0.0, f[28] > 0.0
    return MonitorState(f[0], f[1], travel, f[4], f[5], motion, opposed, f[13:19], f[19:25], f[25:27], *shown)


def store_monitor(state: MonitorState, row: Any) -> None:
    """Store the state of a sensor monitor, shape [NUMBERS]."""
    travel, motion, opposed = state.travel, state.motion, state.opposed
    obeys, confirmed = 1.0 if state.obeys else 0.0, 1.0 if state.confirmed else 0.0
    row[:] = (
        state.angle, state.velocity, travel.up, travel.down, state.up_from, state.down_from, motion.up, motion.down,
        opposed.travel, opposed.integral, opposed.begin, opposed.motion.up, opposed.motion.down,
        *state.lows, *state.highs, *state.flowing, obeys, confirmed, 0.0,
    )  # fmt: skip


def delayed(instruments: Instruments, delay: int, offset: float = 0.0) -> Instruments:
    """The plant's instruments with later commands [samples] and an offset [rad]; compiled code has no ``_replace``."""
    return Instruments(
        instruments.command_delay + delay,
        instruments.measurement_delay,
        instruments.encoder_offset + offset,
        instruments.clock_jitter,
        instruments.observer_bandwidth,
    )


def advance(setup: Setup, experiments: Experiments, wanted: Floats) -> None:
    """One sample period of all experiments with requested currents [A], or target speeds [rad/s], in place."""
    rules, model = setup.rules, setup.model
    for i in range(experiments.k.shape[0]):
        current = float(wanted[i])
        if rules.follows:
            state = state_of(experiments.estimate[i])
            current = current_for(model, state, believed(model, state), current, rules.gain)
        advance_one(setup, experiments, i, current)
        if rules.estimates:
            estimate_one(model, experiments, i)


def advance_one(setup: Setup, e: Experiments, i: int, wanted: float) -> None:
    """One sample period of experiment ``i`` with a requested current [A], in place."""
    rules, x, memory, response, k = setup.rules, e.x[i], e.memory[i], e.response[i], int(e.k[i])
    instruments = delayed(setup.instruments, int(e.delay[i]), float(e.errors[i, 0]))
    y1, y2, u = float(e.y[i, 0]), float(e.y[i, 1]), e.past[i]
    seen = monitor_of(e.monitor[i])
    most = largest_current(setup.law, setup.thresholds, seen, setup.law.current)
    law = setup.unproven if seen.obeys and response[0] != PROVEN else setup.law
    step = k
    if e.returning[i]:
        wanted, step = 0.0, max(step, rules.late_step)
    past = float(u[0]), float(u[1]), float(u[2]), float(u[3]), float(u[4])
    asked, e.reasons[i] = sent_current(law, rules.shielded, y1, y2, wanted, past, step, most)
    sent = 0.0 if math.isnan(asked) else asked
    current = command(instruments, memory, asked)
    if math.isnan(current):
        current = damped_current(float(x[1]), setup.law.current, rules.damping_velocity)
    errors = float(e.noise[i, k + 1, 0]), float(e.noise[i, k + 1, 1]), float(e.late[i, k + 1])
    brake, acting = BrakeParameters(*six(e.brakes[i], 0)), current + e.errors[i, 1]
    states = x, setup.chosen, e.s[i], memory
    y1, y2 = pass_period(setup.mechanics, instruments, brake, rules.sample_time, acting, errors, *states)
    add_increment(e.m[i], e.s[i], rules.angle_weight, rules.velocity_weight)
    e.k[i], e.y[i, 0], e.y[i, 1], e.applied[i] = k + 1, y1, y2, current
    u[0], u[1], u[2], u[3], u[4] = sent, past[0], past[1], past[2], past[3]
    obeyed = not math.isnan(asked)
    if response[0] == OPEN:
        proof, verdict = take(setup.response, response_of(response), obeyed, y1, y2, sent)
        store_response(proof, verdict, response)
    if not seen.confirmed:
        seen, _ = judge(setup.law, setup.thresholds, seen, rules.sample_time, y1, y2, obeyed, sent, current)
        store_monitor(seen, e.monitor[i])
    inside = rules.angle_low <= x[0] <= rules.angle_high and abs(x[1]) <= rules.velocity
    e.violated[i] = not inside


def estimate_one(model: Model, experiments: Experiments, i: int) -> None:
    """Take the newest sample of experiment ``i`` into its estimator, in place."""
    y, row, told = experiments.y[i], experiments.estimate[i], experiments.told[i]
    state = follow(model, state_of(row), y[0], y[1], float(experiments.k[i]), experiments.applied[i])
    store(state, row)
    values, widths = believed(model, state), deviations(model, state)
    for j in range(4):
        told[j], told[4 + j] = values[j] * model.nominal[j], widths[j] * model.nominal[j]


class Batch:
    """N experiments that advance together.

    Attributes:
        setup: what they have in common.
        plant: of the bench, that the brakes are.
        experiments: all of them.
        most: greatest estimates and deviations that are observed, shape [8].
    """

    def __init__(
        self,
        bench: Bench,
        ranges: Ranges,
        parameters: Sequence[str],
        count: int,
        plant: str = DEFAULT_PLANT,
        conditions: Conditions = BENCH_CONDITIONS,
    ) -> None:
        """Prepare arrays; every row needs a :meth:`begin` before the first step.

        Args:
            bench: plant, limits, noise, timing, shield.
            ranges: where the parameters of each episode are drawn from.
            parameters: whose information is collected, in the order of ``PARAMETER_NAMES``.
            count: N.
            plant: which of the bench's plants.
            conditions: shield or none, how many steps, which information.

        Raises:
            BenchFileError: the bench has no such plant, or the shield cannot hold the limits, as under a lag and a
                delay together.
            UsageError: a parameter is unknown or out of order, a brake of these ranges is not covered by the shield, or
                the plant has a delay of its own beside a drawn one.
        """
        if not parameters or tuple(p for p in PARAMETER_NAMES if p in parameters) != tuple(parameters):
            raise UsageError(
                f"expected some of {', '.join(PARAMETER_NAMES)} in this order, got {', '.join(parameters)}"
            )
        self.bench = bench = conditions.applied(bench)
        self.conditions, self.parameters = conditions, tuple(parameters)
        self._ranges, self.plant = ranges, bench.plant(plant)
        require_possible(bench, ranges, self.plant, conditions)
        self.setup = make_setup(bench, self.plant, parameters, conditions)
        self.most = MOST * np.abs(np.array(self.setup.model.nominal * 2))
        self.experiments = no_experiments(count, len(parameters), self.setup.rules.horizon)
        self._columns = [BrakeParameters._fields.index(name) for name in parameters]
        low, high = np.array(ranges.low)[self._columns], np.array(ranges.high)[self._columns]
        self._middle, self._half = 0.5 * (low + high), np.where(high > low, 0.5 * (high - low), 1.0)

    def begin(self, i: int, rng: np.random.Generator, brake: BrakeParameters | None = None) -> None:
        """Begin a new experiment in row ``i``: at rest at the origin, with an estimator at its prior.

        Args:
            i: row.
            rng: draws the uncertain parameters first (also if ``brake`` is given), then the noise of all samples, then
                the jitter of their instants if there is any, then the delay if it varies, then the systematic errors
                if the conditions have them.
            brake: the brake to use instead of a drawn one.
        """
        e = self.experiments
        parameters = drawn(self._ranges, rng, self.conditions.draws)
        e.brakes[i] = parameters if brake is None else brake
        e.noise[i] = rng.standard_normal(e.noise.shape[1:]) * (self.bench.noise.angle, self.bench.noise.velocity)
        jitter = self.plant.instruments.clock_jitter
        if jitter > 0.0:
            e.late[i] = rng.normal(0.0, jitter, e.late.shape[1])
        if self.conditions.varies:
            low, high = self.conditions.command_delay
            e.delay[i] = rng.integers(low, high + 1)
        if self.conditions.systematic:
            priors = self.bench.systematic
            e.errors[i] = rng.standard_normal(2) * (priors.offset, priors.current_offset)
        e.x[i] = 0.0
        instruments = delayed(self.plant.instruments, int(e.delay[i]), float(e.errors[i, 0]))
        settle(instruments, e.memory[i], 0.0)
        errors = (float(error) for error in (e.late[i, 0], *e.noise[i, 0]))
        e.y[i] = measure(instruments, e.memory[i], self.setup.rules.sample_time, 0.0, 0.0, 0.0, *errors)
        for of_the_past in (e.applied, e.s, e.m, e.past, e.k, e.reasons, e.violated, e.returning):
            of_the_past[i] = 0
        store_monitor(begin_monitor(*e.y[i].tolist()), e.monitor[i])
        store_response(begin_response(self.setup.response, *e.y[i].tolist()), OPEN, e.response[i])
        if self.conditions.estimates:
            store(start(self.setup.model), e.estimate[i])
            compiled(estimate_one)(self.setup.model, e, i)

    def advance(self, wanted: Floats) -> None:
        """One sample period with the requested currents [A], or target speeds [rad/s], by the conditions; shape [N].

        A current that is not finite counts as 0 A, and so does a speed that is no number.

        Raises:
            UsageError: the shape is another, or a row was not begun or has reached the horizon. The compiled step would
                not notice: it does not check its indices.
        """
        k = self.experiments.k
        if wanted.shape != k.shape:
            acts, count = self.conditions.acts, len(k)
            raise UsageError(f"expected one {acts} for each of the {count} experiments, got shape {wanted.shape}")
        if (k >= self.setup.rules.horizon).any():
            raise UsageError("expected experiments that go on, got one that is over or was not begun: call reset first")
        compiled(advance)(self.setup, self.experiments, wanted)

    @property
    def terminated(self) -> Bools:
        """Mask of the experiments that are over: horizon reached or limits left, shape [N]. Both are true terminals."""
        return self.experiments.violated | (self.experiments.k >= self.setup.rules.horizon)

    @property
    def home(self) -> Bools:
        """Mask of the brakes whose angle and velocity are those of home, inside the limits, shape [N]."""
        e, shield_ = self.experiments, self.bench.shield
        at_home = (np.abs(e.x[:, 0]) <= shield_.home_angle) & (np.abs(e.x[:, 1]) <= shield_.home_velocity)
        return at_home & ~e.violated

    def observation(self) -> NDArray[np.float32]:
        """Observation of the actor, by the conditions: measured, with the estimate, or Table 4.2 without measurements.

        Returns:
            Shape [N, :meth:`Conditions.observation_size`].
        """
        if self.conditions.observes == EVERYTHING:
            return self.critic_observation()[:, : self.conditions.observation_size(len(self.parameters))].copy()
        measured = self.seen()[:, : len(SAMPLE)]
        if self.conditions.observes == ESTIMATE:
            return np.hstack([measured, self.estimate()], dtype=np.float32)
        return measured.copy()

    def estimate(self) -> Floats:
        """Estimates of k_m, k_1, T_c and f_v in SI units, then their deviations, bounded; shape [N, 8]."""
        bounded: Floats = np.minimum(self.experiments.told, self.most)
        return bounded

    def seen(self) -> NDArray[np.float32]:
        """Measured angle [rad] and velocity [rad/s], step, current that acted in the last period [A]; shape [N, 4]."""
        return np.column_stack((self.experiments.y, self.experiments.k, self.experiments.applied)).astype(np.float32)

    def information(self) -> Floats:
        """Packed FIMs as the rewards see them, by the conditions, shape [N, n (n + 1) / 2]; a copy."""
        if self.conditions.normalised_by == "true":
            return self.experiments.m.copy()
        nominal = np.array([getattr(self.bench.brake, name) for name in self.parameters])
        ratio = nominal / self.experiments.brakes[:, self._columns]
        i, j = upper(len(self.parameters))
        return self.experiments.m * ratio[:, i] * ratio[:, j]

    def info(self) -> dict[str, NDArray[Any]]:
        """Outputs of an environment beside the observation, each with N as its first dimension; all of them copies."""
        e = self.experiments
        kept = {"current": e.past[:, 0], "reasons": e.reasons, "fim": e.m, "violated": e.violated, "home": self.home}
        return {"critic": self.critic_observation()} | {name: values.copy() for name, values in kept.items()}

    def critic_observation(self) -> NDArray[np.float32]:
        """Observation of the critic: the true state in fixed scales of order one, shape [N, size].

        Thesis Table 4.2 (x_1, x_2, k, θ, FIM) and the sensitivities: without them the next increment of the FIM is not
        a function of the state, which would not be Markov. Where the delay of the commands is drawn, also that, the
        current in the motor, and the last sent currents, which may still be on their way.
        """
        e, limits = self.experiments, self.bench.limits
        outputs = np.array([limits.angle[1], limits.velocity])
        parts = [
            e.x[:, :2] / outputs,
            e.k[:, None] / self.bench.timing.horizon,
            (e.brakes[:, self._columns] - self._middle) / self._half,
            0.1 * np.copysign(np.log1p(np.abs(e.m)), e.m),
            (4.0 * e.s[:, :, :2] / outputs).reshape(len(e.k), 2 * len(self._columns)),
        ]
        if self.conditions.varies:
            parts += [
                e.delay[:, None] / self.conditions.command_delay[1],
                e.x[:, 3:] / limits.current,
                e.past / limits.current,
            ]
        return np.concatenate(parts, axis=1, dtype=np.float32)


def drawn(ranges: Ranges, rng: np.random.Generator, distribution: str) -> Floats:
    """Parameters of one brake, drawn from ranges (thesis 4.7.2, 6.2), shape [6]."""
    low, high = np.array(ranges.low), np.array(ranges.high)
    if distribution == "uniform":
        return rng.uniform(low, high)
    z = rng.standard_normal(len(low))
    while (beyond := np.abs(z) > 2.0).any():
        z[beyond] = rng.standard_normal(int(beyond.sum()))
    parameters: Floats = 0.5 * (low + high) + 0.25 * (high - low) * z
    return parameters


def require_possible(bench: Bench, ranges: Ranges, plant: Plant, conditions: Conditions) -> None:
    """Check that the shield, if there is one, covers ranges and delays, and that the instruments hold the delays.

    Raises:
        UsageError: the shield does not hold the limits for every brake; the drawn delay is longer than the instruments'
            memory, or comes on top of a delay of the plant, of which the shield covers only one.
    """
    box = bench.range_set(bench.shield.ranges)
    for name in box.uncovered(ranges.low, ranges.high) if conditions.shielded else ():
        raise UsageError(
            f"the set of ranges '{ranges.name}' has {name} from {getattr(ranges.low, name):g} to "
            f"{getattr(ranges.high, name):g}, the shield's set '{box.name}' covers {getattr(box.low, name):g} to "
            f"{getattr(box.high, name):g}: narrow the first or widen the second in the bench file"
        )
    own, drawn = plant.instruments.command_delay + plant.instruments.measurement_delay, conditions.command_delay[1]
    if conditions.shielded and own > 0 and drawn > 0:
        raise UsageError(
            f"the plant '{plant.name}' has a delay of its own, and the shield covers that or the drawn one, not their "
            "sum: draw none, or choose another plant"
        )
    if (most := plant.instruments.command_delay + drawn) > LONGEST_DELAY:
        raise UsageError(
            f"command_delay: with that of the plant '{plant.name}' at most {LONGEST_DELAY} samples, got {most}"
        )
