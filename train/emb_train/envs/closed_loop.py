"""One sample period of experiments side by side: shield, instruments, brake and Fisher information.

:func:`advance` is the one definition of a step. The scalar environment runs it as plain Python on a batch of one; the
vector environment, the compiled rollout and the trials of a reference run it compiled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import SENSITIVE, STATES, no_sensitivity
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Instruments, Mechanics, Plant
from emb_bench.information.fisher import Kind, weights_of
from emb_bench.information.symmetric import Floats, add_increment, packed_size
from emb_bench.sim.closed_loop import pass_period, sent_current
from emb_bench.sim.instruments import MEMORY, command
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.records import Reason
from emb_runtime.safety.sensor_monitor import CONFIRMED, judge, largest_current
from emb_runtime.safety.sensor_monitor import MEMORY as MONITOR
from emb_runtime.safety.sensor_thresholds import SensorThresholds, sensor_thresholds
from emb_runtime.safety.shield import PAST, damped_current
from emb_runtime.safety.shield_design import ShieldLaw
from emb_train.envs.conditions import Bools

Integers = NDArray[np.int64]

LOST = int(Reason.MISSED)  # Reason that stands for a lost sample


class Rules(NamedTuple):
    """The constants of an experiment; floats and integers only."""

    shielded: bool  # True if the shield has the last word; else the requested current is clipped to the limit
    sample_time: float  # [s]
    horizon: int  # Steps in one experiment
    angle_low: float  # [rad]
    angle_high: float  # [rad]
    velocity: float  # Largest speed [rad/s]
    angle_weight: float  # Of the angle in the FIM, see :func:`emb_bench.information.fisher.weights_of`
    velocity_weight: float  # Of the velocity
    damping_velocity: float  # Of the node that brakes by itself [rad/s]; infinite for one that lets go


class Setup(NamedTuple):
    """Constants that experiments side by side share; it compiles."""

    law: ShieldLaw  # Law of the shield; its limit of the current holds also without a shield
    whole: ShieldLaw
    """Law for the whole set, by which the sensors are judged; another than ``law`` where the shield learns."""
    thresholds: SensorThresholds
    """Of the sensor monitor: until the motion has shown its sign, it limits the current to a first move."""
    rules: Rules
    mechanics: Mechanics  # Mechanics of the brakes
    instruments: Instruments  # Instruments between the brakes and the bus
    chosen: Integers  # Indices in ``PARAMETERS`` of the n parameters whose information is collected, shape [n]


def make_setup(
    bench: Bench, law: ShieldLaw, plant: Plant, parameters: Sequence[str], kind: Kind, shielded: bool
) -> Setup:
    """The setup of experiments on a bench that collect this Fisher information of these parameters."""
    timing, limits = bench.timing, bench.limits
    damping = bench.node.damping_velocity if bench.node.stop == "damped" else math.inf
    rules = Rules(
        shielded,
        timing.sample_time,
        timing.horizon,
        *limits.angle,
        limits.velocity,
        *weights_of(bench, kind),
        damping,
    )
    thresholds = sensor_thresholds(bench, law)
    return Setup(law, law, thresholds, rules, plant.mechanics, plant.instruments, no_sensitivity(parameters)[0])


def with_law(setup: Setup, law: ShieldLaw) -> Setup:
    """The setup with another law of the shield; compiled code has no ``_replace``."""
    return Setup(law, setup.whole, setup.thresholds, setup.rules, setup.mechanics, setup.instruments, setup.chosen)


class Experiments(NamedTuple):
    """N experiments with n parameters: their brakes, their states, and the errors and losses of all their samples.

    Arrays only, so that it compiles; functions change them in place.
    """

    brakes: Floats  # Rows of :class:`BrakeParameters`, shape [N, 6]
    delay: Integers  # Samples that each experiment's commands wait beside its plant's delay, shape [N]
    x: Floats
    """True states, see :mod:`emb_bench.brake.motion`: angle [rad], velocity [rad/s] and two more, shape [N, 4]."""
    s: Floats  # Sensitivities of all four to the relative parameters, shape [N, n, 4]
    m: Floats  # Packed FIM, shape [N, n (n + 1) / 2]
    memory: Floats  # Of the instruments, shape [N, MEMORY]
    y: Floats  # Last received measured angle and velocity, shape [N, 2]
    applied: Floats  # The current that acted in the period before, as the node last reported it [A], shape [N]
    past: Floats  # The last sent currents, newest first [A], shape [N, PAST]; 0 where nothing was sent
    k: Integers  # Step, shape [N]
    noise: Floats  # Of the sensors for all samples of the experiment, shape [N, horizon + 1, 2]
    late: Floats  # Lateness with which each sample is taken [s], shape [N, horizon + 1]
    lost: Bools  # Mask of the samples that do not arrive, shape [N, horizon + 1]
    reasons: Integers
    """Reasons why the last current is not the requested one: :class:`emb_runtime.records.Reason` bits, shape [N]."""
    violated: Bools  # Mask of the brakes outside their limits, shape [N]
    monitor: Floats
    """Memory of the sensor monitor, which is asked only until it confirms the polarity, shape [N, MONITOR]."""


def no_experiments(count: int, n: int, steps: int) -> Experiments:
    """N experiments with n parameters that are over: each has to begin before its first step."""
    return Experiments(
        brakes=np.zeros((count, len(BrakeParameters._fields))),
        delay=np.zeros(count, np.int64),
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
        lost=np.zeros((count, steps + 1), np.bool_),
        reasons=np.zeros(count, np.int64),
        violated=np.zeros(count, np.bool_),
        monitor=np.zeros((count, MONITOR)),
    )


def delayed(instruments: Instruments, delay: int) -> Instruments:
    """The plant's instruments with the commands later by some samples; compiled code has no ``_replace``."""
    return Instruments(
        instruments.command_delay + delay,
        instruments.measurement_delay,
        instruments.encoder_offset,
        instruments.clock_jitter,
        instruments.observer_bandwidth,
    )


def advance(setup: Setup, experiments: Experiments, wanted: Floats) -> None:
    """One sample period of all experiments, in place."""
    for i in range(experiments.k.shape[0]):
        advance_one(setup, experiments, i, float(wanted[i]))


def advance_one(setup: Setup, experiments: Experiments, i: int, wanted: float) -> None:
    """One sample period of experiment ``i``, in place; arguments as for :func:`advance`."""
    brakes, delay, x, s, m, memory, y, applied, past, k, noise, late, lost, reasons, violated, monitor = experiments
    rules = setup.rules
    p = BrakeParameters(
        float(brakes[i, 0]),
        float(brakes[i, 1]),
        float(brakes[i, 2]),
        float(brakes[i, 3]),
        float(brakes[i, 4]),
        float(brakes[i, 5]),
    )
    instruments = delayed(setup.instruments, int(delay[i]))
    y1, y2 = float(y[i, 0]), float(y[i, 1])
    u1, u2, u3, u4, u5 = float(past[i, 0]), float(past[i, 1]), float(past[i, 2]), float(past[i, 3]), float(past[i, 4])
    sent, asked = 0.0, math.nan
    if lost[i, k[i]]:
        reasons[i] = LOST
    else:
        most = largest_current(setup.whole, setup.thresholds, monitor[i], setup.law.current)
        asked, reasons[i] = sent_current(
            setup.law, rules.shielded, y1, y2, wanted, (u1, u2, u3, u4, u5), int(k[i]), most
        )
        sent = 0.0 if math.isnan(asked) else asked
    current = command(instruments, memory[i], asked)
    if math.isnan(current):
        current = damped_current(float(x[i, 1]), setup.law.current, rules.damping_velocity)
    k[i] += 1
    errors = (float(noise[i, k[i], 0]), float(noise[i, k[i], 1]), float(late[i, k[i]]))
    y1, y2 = pass_period(
        setup.mechanics, instruments, p, rules.sample_time, current, errors, x[i], setup.chosen, s[i], memory[i]
    )
    add_increment(m[i], s[i], rules.angle_weight, rules.velocity_weight)
    past[i, 0], past[i, 1], past[i, 2], past[i, 3], past[i, 4] = sent, u1, u2, u3, u4
    if not lost[i, k[i]]:
        y[i, 0], y[i, 1], applied[i] = y1, y2, current
        if monitor[i, CONFIRMED] == 0.0:
            periods = 1
            while lost[i, k[i] - periods]:
                periods += 1
            judge(
                setup.whole, setup.thresholds, monitor[i], periods * rules.sample_time, y1, y2,
                not math.isnan(asked), float(past[i, min(periods, PAST) - 1]), current,
            )  # fmt: skip
    inside = rules.angle_low <= x[i, 0] <= rules.angle_high and abs(x[i, 1]) <= rules.velocity
    violated[i] = not inside
