"""A batch of experiments: brakes, instruments, shield, sensitivities and Fisher information, step by step.

A step is :func:`emb_train.envs.closed_loop.advance`. Both environments draw an episode's parameters and noise from one
generator per episode slot at its reset, so equal seeds give equal episodes, bit for bit.

Time: a reset gives the measurement y_0. The action that answers y_k is shielded with y_k and acts during [k, k + 1],
or later by the plant's command delay. The Fisher information is that of angle and velocity with the bench's noise: what
the experiment is worth, whatever the plant's instruments make of it on the way.

A sample may be lost, see :class:`emb_train.envs.conditions.Conditions`. It is then as on the bench: nothing is sent in
its period, the node brakes by itself, and the last sample received stays. A current requested then has no effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, LONGEST_DELAY, Plant
from emb_bench.information.symmetric import Floats
from emb_bench.sim.instruments import measure, settle
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Ranges
from emb_runtime.errors import UsageError
from emb_runtime.safety.sensor_monitor import begin as begin_monitor
from emb_runtime.safety.shield_design import make_law
from emb_train.envs.closed_loop import advance, delayed, make_setup, no_experiments
from emb_train.envs.conditions import BENCH_CONDITIONS, EVERYTHING, Bools, Conditions, longest_loss
from emb_train.envs.critic_view import EXTRA, critic_size, describe, make_scale


class Batch:
    """N experiments that advance together.

    Attributes:
        setup: what they have in common.
        experiments: all of them; the following are some of its arrays.
        brakes: shape [N, 6].
        x: true states, shape [N, 4].
        y: last received measurements, shape [N, 2].
        m: packed FIMs, of the conditions' kind, shape [N, n (n + 1) / 2].
        k: steps, shape [N].
        past: last sent currents, newest first, shape [N, PAST].
        reasons: why the last sent current is not the requested one, shape [N].
        violated: True where the brake is outside its limits after the last step, shape [N].
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
            BenchFileError: the bench has no such plant, or no such set for the shield, or the shield cannot hold the
                limits there, as under a lag and a delay together.
            UsageError: a parameter is unknown or out of order, a brake of these ranges is not covered by the shield, or
                the plant has a delay of its own beside a drawn one.
        """
        if not parameters or tuple(p for p in PARAMETER_NAMES if p in parameters) != tuple(parameters):
            raise UsageError(
                f"expected some of {', '.join(PARAMETER_NAMES)} in this order, got {', '.join(parameters)}"
            )
        require_covered(bench, ranges, conditions)
        self.bench = bench = conditions.applied(bench)
        self.conditions = conditions
        self.parameters = tuple(parameters)
        self._ranges = ranges
        self._plant = bench.plant(plant)
        self.setup = make_setup(
            bench, make_law(bench), self._plant, parameters, conditions.information, conditions.shielded
        )
        require_possible(self._plant, conditions)
        self.scale = make_scale(bench, ranges, parameters, conditions.command_delay[1])
        self._deviations = np.array([bench.noise.angle, bench.noise.velocity])
        self._advance, self._describe = compiled(advance), compiled(describe)
        e = self.experiments = no_experiments(count, len(parameters), self.setup.rules.horizon)
        self.brakes, self.x, self.y, self.m, self.k = e.brakes, e.x, e.y, e.m, e.k
        self.past, self.reasons, self.violated = e.past, e.reasons, e.violated
        self.critic_size = critic_size(len(parameters)) + (EXTRA if conditions.varies else 0)
        self.observation_size = conditions.observation_size(len(parameters))

    def begin(self, i: int, rng: np.random.Generator, brake: BrakeParameters | None = None) -> None:
        """Begin a new experiment in row ``i``: at rest at the origin.

        Args:
            i: row.
            rng: draws the uncertain parameters first (also if ``brake`` is given), then the noise of all samples, then
                the jitter of their instants if there is any, then delay and losses if they vary.
            brake: the brake to use instead of a drawn one.
        """
        e = self.experiments
        parameters = rng.uniform(self._ranges.low, self._ranges.high)
        e.brakes[i] = parameters if brake is None else brake
        e.noise[i] = rng.standard_normal(e.noise.shape[1:]) * self._deviations
        jitter = self._plant.instruments.clock_jitter
        if jitter > 0.0:
            e.late[i] = rng.normal(0.0, jitter, e.late.shape[1])
        if self.conditions.varies:
            e.delay[i], e.lost[i] = self.conditions.drawn(rng, e.lost.shape[1], longest_loss(self.bench))
        e.x[i] = 0.0
        instruments = delayed(self._plant.instruments, int(e.delay[i]))
        settle(instruments, e.memory[i], 0.0)
        errors = (float(error) for error in (e.late[i, 0], *e.noise[i, 0]))
        e.y[i] = measure(instruments, e.memory[i], self.setup.rules.sample_time, 0.0, 0.0, 0.0, *errors)
        for of_the_past in (e.applied, e.s, e.m, e.past, e.k, e.reasons, e.violated):
            of_the_past[i] = 0
        begin_monitor(e.monitor[i], *e.y[i].tolist())

    def advance(self, wanted: Floats) -> None:
        """One sample period with the requested currents [A], shape [N]; one that is not finite counts as 0 A.

        Raises:
            UsageError: the shape is another, or a row was not begun or has reached the horizon. The compiled step would
                not notice: it does not check its indices.
        """
        if wanted.shape != self.k.shape:
            raise UsageError(
                f"expected one current for each of the {len(self.k)} experiments, got shape {wanted.shape}"
            )
        if (self.k >= self.setup.rules.horizon).any():
            raise UsageError("expected experiments that go on, got one that is over or was not begun: call reset first")
        self._advance(self.setup, self.experiments, wanted)

    @property
    def terminated(self) -> Bools:
        """Mask of the experiments that are over: horizon reached or limits left, shape [N]. Both are true terminals."""
        return self.violated | (self.k >= self.setup.rules.horizon)

    @property
    def home(self) -> Bools:
        """Mask of the brakes whose angle and velocity are those of home, inside the limits, shape [N]."""
        shield_ = self.bench.shield
        at_home = (np.abs(self.x[:, 0]) <= shield_.home_angle) & (np.abs(self.x[:, 1]) <= shield_.home_velocity)
        return at_home & ~self.violated

    @property
    def heard(self) -> Bools:
        """Mask of the experiments whose newest sample has arrived, shape [N]; in others a current has no effect now."""
        heard: Bools = ~self.experiments.lost[np.arange(len(self.k)), self.k]
        return heard

    def observation(self) -> NDArray[np.float32]:
        """Observation of the actor, by the conditions: :meth:`actor_observation`, or Table 4.2 without measurements.

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
        """Observation of an excitation: the actor's three and the current that acted in the last period [A], [N, 4].

        NaN but for the step where the sample was lost: on the bench no policy is called then.
        """
        seen = np.column_stack((self.y, self.k, self.experiments.applied)).astype(np.float32)
        for column in (0, 1, 3):
            seen[~self.heard, column] = np.nan
        return seen

    def info(self) -> dict[str, NDArray[Any]]:
        """Outputs of an environment beside the observation, each with N as its first dimension; all of them copies."""
        return {
            "critic": self.critic_observation(),
            "current": self.past[:, 0].copy(),
            "reasons": self.reasons.copy(),
            "fim": self.m.copy(),
            "violated": self.violated.copy(),
            "home": self.home,
            "heard": self.heard,
        }

    def critic_observation(self) -> NDArray[np.float32]:
        """Observation of the critic, see :func:`describe`, shape [N, critic_size]."""
        out = np.empty((len(self.k), self.critic_size), np.float32)
        self._describe(self.scale, self.experiments, out)
        return out


def require_possible(plant: Plant, conditions: Conditions) -> None:
    """Check that a plant can have the delay that is drawn.

    Raises:
        UsageError: it is longer than the instruments' memory, or comes on top of a delay of the plant, and the shield
            covers only one of them.
    """
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
