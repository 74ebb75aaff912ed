"""N experiments side by side, one sample period after the other: shield, instruments, brake and Fisher information.

:func:`advance` is the one definition of a step; a :class:`Batch` runs it compiled.

Time: an experiment begins with the measurement y_0. The current that answers y_k is shielded with y_k and acts during
[k, k + 1], or later by the plant's command delay. The Fisher information is that of angle and velocity with the bench's
noise; the plant's instruments do not enter it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from numba import typeof
from numba.typed import List
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
from emb_runtime.estimator.kalman import Model, State, believed, deviations, follow, initial_state, make_model
from emb_runtime.estimator.speed_loop import current_for
from emb_runtime.policy.contract import SAMPLE
from emb_runtime.safety.response import OPEN, PROVEN, ResponseModel, begin_response, response_model, take, unproven_law
from emb_runtime.safety.response import State as ResponseState
from emb_runtime.safety.sensor_monitor import State as MonitorState
from emb_runtime.safety.sensor_monitor import begin_monitor, judge, largest_current
from emb_runtime.safety.sensor_thresholds import SensorThresholds, sensor_thresholds
from emb_runtime.safety.shield import PAST, damped_current
from emb_runtime.safety.shield_design import ShieldLaw, late_step, make_law

Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]

# Numbers of a configuration
Count = Annotated[int, msgspec.Meta(ge=1, le=2**31)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Price = Annotated[float, msgspec.Meta(ge=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Gain = Annotated[float, msgspec.Meta(gt=0.0, le=1.0)]

MOST = 100.0  # Greatest estimate or deviation that is observed, of the nominal value


class Conditions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Conditions in which an experiment of the training may differ from one on the bench."""

    shielded: bool = True  # True if the shield is between actor and brake; without it an action is clipped, no more
    horizon: int = 0  # Steps in one experiment; 0 for the bench's
    acts: Literal["current", "speed"] = "current"
    """Action of the actor: a current, or a target speed that the runtime's speed loop follows by the estimate."""
    observes: Literal["measured", "estimate", "everything"] = "measured"
    """Observation of the actor: ``measured`` angle, velocity and step; these and the running ``estimate`` of the four
    parameters with its deviations; or ``everything`` (x₁, x₂, k, θ, the FIM)."""
    systematic: bool = False
    """Draw the offsets of encoder and current from the bench's priors, but no wrong scale, which no shield detects."""
    information: Kind = "weighted"  # Fisher information that is collected: the thesis's, or the physical one
    draws: Literal["uniform", "normal"] = "uniform"
    """Distribution of the brakes in their ranges: normal is cut off at both ends, two standard deviations away."""
    normalised_by: Literal["true", "nominal"] = "true"
    """Values that the rewards divide the parameters by (eq. 4.17): those of each brake, or those of the bench."""
    tracking: Positive = 1.0  # Factor of the weights of the deviation from the quintic
    command_delay: tuple[int, int] = (0, 0)
    """Least and most samples that a command waits beside the plant's delay, drawn for each experiment."""
    gain: Gain = 1.0  # Of the speed loop; less where commands act late

    def __post_init__(self) -> None:
        """Refuse impossible conditions.

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
        """True if a delay is drawn for each experiment."""
        return self.command_delay[1] > 0

    def observation_size(self, count: int) -> int:
        """Length of the actor's observation if the information of this many parameters is collected."""
        sizes = {"measured": len(SAMPLE), "estimate": len(SAMPLE) + 2 * len(PARAMETER_NAMES)}
        return sizes.get(self.observes, 3 + count + packed_size(count))

    @property
    def estimates(self) -> bool:
        """True if the estimator is in the loop."""
        return self.acts == "speed" or self.observes == "estimate"

    def applied(self, bench: Bench) -> Bench:
        """The bench with this horizon, and a shield that covers the drawn delays as well.

        It covers what the bench's shield covers or what is drawn, not the sum of both: right for a plant without a
        delay.
        """
        timing = replace(bench.timing, horizon=self.horizon or bench.timing.horizon)
        shield = bench.shield
        if self.shielded and self.varies:
            (least, most), (low, high) = shield.frame_age, self.command_delay
            shield = shield._replace(frame_age=(min(least, low), max(most, high)))
        return replace(bench, timing=timing, shield=shield)


BENCH_CONDITIONS = Conditions()


class Setup(NamedTuple):
    """Constants that experiments side by side share; it compiles."""

    law: ShieldLaw  # Law of the shield; its limit of the current holds also without a shield
    unproven: ShieldLaw  # Law until the response is proven
    response: ResponseModel
    thresholds: SensorThresholds
    """Of the sensor monitor: until the motion has shown its sign, it limits the current to a first move."""
    mechanics: Mechanics  # Mechanics of the brakes
    instruments: Instruments  # Instruments between the brakes and the bus
    parameters: Integers  # Indices in ``PARAMETERS`` of the n parameters whose information is collected, shape [n]
    model: Model  # Of the estimator, the runtime's
    shielded: bool  # True if the shield has the last word; else the requested current is clipped to the limit
    angle: tuple[float, float]  # Limits [rad]
    velocity: float  # Largest speed [rad/s]
    late_step: int  # Step in which the shield has an experiment that has ended, for it is to go home
    angle_weight: float  # Of the angle in the FIM, see :func:`emb_bench.information.fisher.weights_of`
    velocity_weight: float  # Of the velocity
    damping_velocity: float  # Of the node that brakes by itself [rad/s]; infinite for one that lets go
    estimates: bool  # True if the estimator is in the loop
    follows: bool  # True if an action is a target speed, which the speed loop follows
    gain: float  # Of the speed loop


def make_setup(bench: Bench, plant: Plant, parameters: Sequence[str], conditions: Conditions) -> Setup:
    """The setup of experiments on a bench, with conditions that are applied, that collect these parameters' FIM."""
    law, (angle_weight, velocity_weight) = make_law(bench), weights_of(bench, conditions.information)
    return Setup(
        law=law,
        unproven=unproven_law(bench, law),
        response=response_model(bench, law),
        thresholds=sensor_thresholds(bench, law),
        mechanics=plant.mechanics,
        instruments=plant.instruments,
        parameters=no_sensitivity(parameters)[0],
        model=make_model(bench, bench.range_set(bench.prior)),
        shielded=conditions.shielded,
        angle=bench.limits.angle,
        velocity=bench.limits.velocity,
        late_step=late_step(law),
        angle_weight=angle_weight,
        velocity_weight=velocity_weight,
        damping_velocity=bench.node.damping_velocity if bench.node.stop == "damped" else math.inf,
        estimates=conditions.estimates,
        follows=conditions.acts == "speed",
        gain=conditions.gain,
    )


class Loop(NamedTuple):
    """State of the runtime's loop after a sample."""

    monitor: MonitorState  # Sensor monitor, until it confirms the polarity
    proof: ResponseState  # Proof of the response, until its verdict
    verdict: int  # On the response
    estimate: State  # Of the estimator


class Experiments(NamedTuple):
    """N experiments of T steps with n parameters: their brakes, their states, and the errors of all their samples.

    Arrays and a list of numba, so that it compiles; functions change them in place. A series has an item for each
    sample, 0 to T.
    """

    brakes: Floats  # Rows of :class:`BrakeParameters`, shape [N, 6]
    delay: Integers  # Samples that each experiment's commands wait beside its plant's delay, shape [N]
    errors: Floats  # Systematic errors: of the angle [rad] and of the current [A], shape [N, 2]
    noise: Floats
    """Series: errors of the measured angle [rad] and velocity [rad/s], and the lateness of the sample [s], shape
    [N, T + 1, 3]."""
    k: Integers  # Step, shape [N]
    x: Floats
    """Series: true states, see :mod:`emb_bench.brake.motion`: angle [rad], velocity [rad/s] and two more, 0 after the
    newest; shape [N, T + 1, 4]."""
    s: Floats  # Sensitivities of all four to the relative parameters, shape [N, n, 4]
    m: Floats  # Series: packed FIM, shape [N, T + 1, n (n + 1) / 2]
    applied: Floats
    """Series: the current that acted in the period before the sample, as the node reports it, 0 after the newest [A];
    shape [N, T + 1]."""
    memory: Floats  # Of the instruments, shape [N, MEMORY]
    y: Floats  # Newest measured angle and velocity, shape [N, 2]
    past: Floats  # The last sent currents, newest first [A], shape [N, PAST]; 0 where nothing was sent
    reasons: Integers
    """Reasons why the last current is not the requested one: :class:`emb_runtime.records.Reason` bits, shape [N]."""
    violated: Bools  # Mask of the brakes outside their limits, shape [N]
    returning: Bools  # Mask of the experiments that have ended before their horizon and are on the way home, shape [N]
    loops: list[Loop]  # States of the loop that answers the samples, N
    told: Floats  # Estimates of k_m, k_1, T_c and f_v in SI units, then their deviations, shape [N, 8]


def no_experiments(setup: Setup, count: int, steps: int) -> Experiments:
    """N experiments of these steps that are over: each has to begin before its first step."""
    n = len(setup.parameters)
    return Experiments(
        brakes=np.zeros((count, len(BrakeParameters._fields))),
        delay=np.zeros(count, np.int64),
        errors=np.zeros((count, 2)),
        noise=np.zeros((count, steps + 1, 3)),
        k=np.full(count, steps),
        x=np.zeros((count, steps + 1, STATES)),
        s=np.zeros((count, n, SENSITIVE)),
        m=np.zeros((count, steps + 1, packed_size(n))),
        applied=np.zeros((count, steps + 1)),
        memory=np.zeros((count, MEMORY)),
        y=np.zeros((count, 2)),
        past=np.zeros((count, PAST)),
        reasons=np.zeros(count, np.int64),
        violated=np.zeros(count, np.bool_),
        returning=np.zeros(count, np.bool_),
        loops=compiled(first_loops)(setup, count),
        told=np.zeros((count, 2 * len(PARAMETER_NAMES))),
    )


def first_loops(setup: Setup, count: int) -> Any:
    """The loops of N experiments whose first measurement is zero."""
    loops = List()
    for _ in range(count):
        loops.append(first_loop(setup, 0.0, 0.0))
    return loops


def first_loop(setup: Setup, angle: float, velocity: float) -> Loop:
    """The loop at the first measurement [rad, rad/s]."""
    proof, estimate = begin_response(setup.response, angle, velocity), initial_state(setup.model)
    if setup.estimates:
        estimate = follow(setup.model, estimate, angle, velocity, 0.0, 0.0)
    return Loop(begin_monitor(angle, velocity), proof, OPEN, estimate)


def begin_one(setup: Setup, e: Experiments, i: int) -> None:
    """Take the first sample of experiment ``i``, in place."""
    e.loops[i] = first_loop(setup, float(e.y[i, 0]), float(e.y[i, 1]))
    tell(setup.model, e.loops[i].estimate, e.told[i])


def delayed(instruments: Instruments, delay: int, offset: float) -> Instruments:
    """The plant's instruments with later commands [samples] and an offset [rad]; compiled code has no ``_replace``."""
    return Instruments(
        instruments.command_delay + delay,
        instruments.measurement_delay,
        instruments.encoder_offset + offset,
        instruments.clock_jitter,
        instruments.observer_bandwidth,
    )


def advance(setup: Setup, experiments: Experiments, requested: Floats) -> None:
    """One sample period of all experiments with requested currents [A], or target speeds [rad/s], in place."""
    for i in range(experiments.k.shape[0]):
        advance_one(setup, experiments, i, float(requested[i]))


def advance_one(setup: Setup, e: Experiments, i: int, requested: float) -> None:
    """One sample period of experiment ``i`` with a requested current [A], or a target speed [rad/s], in place."""
    law, limit, model, t_s, k = setup.law, setup.law.current, setup.model, setup.law.sample_time, int(e.k[i])
    y1, y2, u, b = float(e.y[i, 0]), float(e.y[i, 1]), e.past[i], e.brakes[i]
    brake = BrakeParameters(float(b[0]), float(b[1]), float(b[2]), float(b[3]), float(b[4]), float(b[5]))
    instruments = delayed(setup.instruments, int(e.delay[i]), float(e.errors[i, 0]))

    # The answer to the newest sample: speed loop, sensor monitor, shield
    monitor, proof, verdict, estimate = e.loops[i]
    if setup.follows:
        requested = current_for(model, estimate, believed(model, estimate), requested, setup.gain)
    most = largest_current(law, setup.thresholds, monitor, limit)
    valid, step = setup.unproven if monitor.obeys and verdict != PROVEN else law, k
    if e.returning[i]:
        requested, step = 0.0, max(step, setup.late_step)
    past = float(u[0]), float(u[1]), float(u[2]), float(u[3]), float(u[4])
    commanded, e.reasons[i] = sent_current(valid, setup.shielded, y1, y2, requested, past, step, most)
    obeyed, sent = not math.isnan(commanded), 0.0 if math.isnan(commanded) else commanded

    # The brake and its node until the next sample
    x, s, m, memory = e.x[i, k + 1], e.s[i], e.m[i, k + 1], e.memory[i]
    x[:], m[:] = e.x[i, k], e.m[i, k]
    current = command(instruments, memory, commanded)
    if math.isnan(current):
        current = damped_current(float(x[1]), limit, setup.damping_velocity)
    errors = float(e.noise[i, k + 1, 0]), float(e.noise[i, k + 1, 1]), float(e.noise[i, k + 1, 2])
    acting, (low, high) = current + e.errors[i, 1], setup.angle
    y1, y2 = pass_period(setup.mechanics, instruments, brake, t_s, acting, errors, x, setup.parameters, s, memory)
    add_increment(m, s, setup.angle_weight, setup.velocity_weight)
    e.violated[i] = not (low <= x[0] <= high and abs(x[1]) <= setup.velocity)
    e.k[i], e.y[i, 0], e.y[i, 1], e.applied[i, k + 1] = k + 1, y1, y2, current
    u[0], u[1], u[2], u[3], u[4] = sent, past[0], past[1], past[2], past[3]

    # The new sample: proof of the response, sensor monitor, estimator
    if verdict == OPEN:
        proof, verdict = take(setup.response, proof, obeyed, y1, y2, sent)
    if not monitor.confirmed:
        monitor, _ = judge(law, setup.thresholds, monitor, t_s, y1, y2, obeyed, sent, current)
    if setup.estimates:
        estimate = follow(model, estimate, y1, y2, float(k + 1), current)
        tell(model, estimate, e.told[i])
    e.loops[i] = Loop(monitor, proof, verdict, estimate)


def tell(model: Model, estimate: State, told: Floats) -> None:
    """Write the estimates of the parameters in SI units, and then their deviations, shape [8]."""
    values = believed(model, estimate)
    widths = deviations(model, estimate, values)
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
                the plant has a delay beside a drawn one.
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
        self.experiments = no_experiments(self.setup, count, bench.timing.horizon)
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
        noise, jitter = self.bench.noise, self.plant.instruments.clock_jitter
        e.noise[i, :, :2] = rng.standard_normal((e.noise.shape[1], 2)) * (noise.angle, noise.velocity)
        if jitter > 0.0:
            e.noise[i, :, 2] = rng.normal(0.0, jitter, e.noise.shape[1])
        if self.conditions.varies:
            low, high = self.conditions.command_delay
            e.delay[i] = rng.integers(low, high + 1)
        if self.conditions.systematic:
            priors = self.bench.systematic
            e.errors[i] = rng.standard_normal(2) * (priors.offset, priors.current_offset)
        instruments = delayed(self.plant.instruments, int(e.delay[i]), float(e.errors[i, 0]))
        settle(instruments, e.memory[i], 0.0)
        angle, velocity, late = map(float, e.noise[i, 0])
        e.y[i] = measure(instruments, e.memory[i], self.bench.timing.sample_time, 0.0, 0.0, 0.0, late, angle, velocity)
        for of_the_past in (e.k, e.x, e.s, e.m, e.applied, e.past, e.reasons, e.violated, e.returning):
            of_the_past[i] = 0
        compiled(begin_one)(self.setup, e, i)

    def advance(self, requested: Floats) -> None:
        """One sample period with the requested currents [A], or target speeds [rad/s], by the conditions; shape [N].

        A current that is not finite counts as 0 A, and so does a speed that is no number.

        Raises:
            UsageError: the shape is another, or a row was not begun or has reached the horizon. The compiled step would
                not notice: it does not check its indices.
        """
        k = self.experiments.k
        if requested.shape != k.shape:
            acts, count = self.conditions.acts, len(k)
            raise UsageError(f"expected one {acts} for each of the {count} experiments, got shape {requested.shape}")
        if (k >= self.bench.timing.horizon).any():
            raise UsageError("expected experiments that go on, got one that is over or was not begun: call reset first")
        self._step(self.setup, self.experiments, np.ascontiguousarray(requested, np.float64))

    @cached_property
    def _step(self) -> Callable[[Setup, Experiments, Floats], None]:
        """The machine code of a step for these types: to look at lists for their types again takes ten times a step."""
        step: Any = compiled(advance)
        if not hasattr(step, "compile"):  # numba is switched off
            return advance
        types = map(typeof, (self.setup, self.experiments, np.zeros(len(self.experiments.k))))
        code: Callable[[Setup, Experiments, Floats], None] = step.compile(tuple(types))
        return code

    def __getstate__(self) -> dict[str, Any]:
        """The state of a copy: without the machine code of a step, the loops in a plain list."""
        state = {name: value for name, value in vars(self).items() if name != "_step"}
        return state | {"experiments": self.experiments._replace(loops=list(self.experiments.loops))}

    def __setstate__(self, state: dict[str, Any]) -> None:
        loops = compiled(first_loops)(state["setup"], len(state["experiments"].loops))
        for i, loop in enumerate(state["experiments"].loops):
            loops[i] = loop
        vars(self).update(state | {"experiments": state["experiments"]._replace(loops=loops)})

    def newest(self, series: Floats) -> Floats:
        """Items of a series for the newest sample of each experiment, shape [N, ...]; a copy."""
        newest: Floats = series[np.arange(len(series)), self.experiments.k]
        return newest

    @property
    def x(self) -> Floats:
        """True angle [rad] and velocity [rad/s] at the newest samples, shape [N, 2]."""
        return self.newest(self.experiments.x[:, :, :2])

    @property
    def terminated(self) -> Bools:
        """Mask of the experiments that are over: horizon reached or limits violated, shape [N]; both true terminals."""
        return self.experiments.violated | (self.experiments.k >= self.bench.timing.horizon)

    @property
    def home(self) -> Bools:
        """Mask of the brakes whose angle and velocity are those of home, inside the limits, shape [N]."""
        x, shield_ = self.x, self.bench.shield
        at_home = (np.abs(x[:, 0]) <= shield_.home_angle) & (np.abs(x[:, 1]) <= shield_.home_velocity)
        return at_home & ~self.experiments.violated

    def observation(self) -> NDArray[np.float32]:
        """Observation of the actor, by the conditions: measured, with the estimate, or Table 4.2 without measurements.

        Returns:
            Shape [N, :meth:`Conditions.observation_size`].
        """
        if self.conditions.observes == "everything":
            return self.critic_observation()[:, : self.conditions.observation_size(len(self.parameters))].copy()
        measured = self.seen()[:, : len(SAMPLE)]
        if self.conditions.observes == "estimate":
            return np.hstack([measured, self.estimate()], dtype=np.float32)
        return measured.copy()

    def estimate(self) -> Floats:
        """Estimates of k_m, k_1, T_c and f_v in SI units, then their deviations, bounded; shape [N, 8]."""
        bounded: Floats = np.minimum(self.experiments.told, self.most)
        return bounded

    def seen(self) -> NDArray[np.float32]:
        """Measured angle [rad] and velocity [rad/s], step, current that acted in the last period [A]; shape [N, 4]."""
        e = self.experiments
        return np.column_stack((e.y, e.k, self.newest(e.applied))).astype(np.float32)

    def information(self, at: Integers) -> Floats:
        """Packed FIMs at a sample of each experiment as the rewards see them, by the conditions.

        Args:
            at: number of the sample, shape [N].

        Returns:
            Shape [N, n (n + 1) / 2].
        """
        m: Floats = self.experiments.m[np.arange(len(at)), at]
        if self.conditions.normalised_by == "true":
            return m
        nominal = np.array([getattr(self.bench.brake, name) for name in self.parameters])
        ratio = nominal / self.experiments.brakes[:, self._columns]
        i, j = upper(len(self.parameters))
        return m * ratio[:, i] * ratio[:, j]

    def info(self) -> dict[str, NDArray[Any]]:
        """Outputs of an environment beside the observation, each with N as its first dimension; all of them copies."""
        e = self.experiments
        views = {"current": e.past[:, 0], "reasons": e.reasons, "violated": e.violated, "home": self.home}
        made: dict[str, NDArray[Any]] = {"critic": self.critic_observation(), "fim": self.newest(e.m)}
        return made | {name: values.copy() for name, values in views.items()}

    def critic_observation(self) -> NDArray[np.float32]:
        """Observation of the critic: the true state in fixed scales of order one, shape [N, size].

        Thesis Table 4.2 (x_1, x_2, k, θ, FIM) and the sensitivities: without them the next increment of the FIM is not
        a function of the state, which would not be Markov. Where the delay of the commands is drawn, also that, the
        current in the motor, and the last sent currents, which may still be on their way.
        """
        e, limits, m = self.experiments, self.bench.limits, self.newest(self.experiments.m)
        outputs = np.array([limits.angle[1], limits.velocity])
        parts = [
            self.x / outputs,
            e.k[:, None] / self.bench.timing.horizon,
            (e.brakes[:, self._columns] - self._middle) / self._half,
            0.1 * np.copysign(np.log1p(np.abs(m)), m),
            (4.0 * e.s[:, :, :2] / outputs).reshape(len(e.k), 2 * len(self._columns)),
        ]
        if self.conditions.varies:
            parts += [
                e.delay[:, None] / self.conditions.command_delay[1],
                self.newest(e.x[:, :, 3:]) / limits.current,
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
    of_plant, drawn = plant.instruments.command_delay + plant.instruments.measurement_delay, conditions.command_delay[1]
    if conditions.shielded and of_plant > 0 and drawn > 0:
        raise UsageError(
            f"the plant '{plant.name}' has a delay, and the shield covers that or the drawn one, not their "
            "sum: draw none, or choose another plant"
        )
    if (most := plant.instruments.command_delay + drawn) > LONGEST_DELAY:
        raise UsageError(
            f"command_delay: with that of the plant '{plant.name}' at most {LONGEST_DELAY} samples, got {most}"
        )
