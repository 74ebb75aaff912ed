"""Play an excitation on given brakes with given noise, through the environment that actors are trained in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.compiled import compiled
from emb_bench.information.symmetric import unpack
from emb_bench.sim.plant_spec import DEFAULT_PLANT
from emb_runtime.config.bench import Bench, BrakeParameters, Ranges
from emb_runtime.errors import PolicyRefusedError
from emb_train.envs.batch import Batch
from emb_train.envs.conditions import BENCH_CONDITIONS, Conditions
from emb_train.envs.excitations import ANGLE, Excitation, Seen

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

STREAM = 0x65766C
"""Spawn key of the evaluation's random numbers: training has none, and its validations have another one."""
SIDE_BY_SIDE = 1024
"""Experiments at a time: what bounds the memory."""


class Draw(NamedTuple):
    """One brake and the noise that is measured on it."""

    seed: int | np.random.SeedSequence
    """Of the noise."""
    brake: BrakeParameters


def fresh_draws(ranges: Ranges, seed: int, count: int) -> list[Draw]:
    """Brakes drawn from ranges, and their noise; draw i depends on ``seed`` and i alone.

    Args:
        ranges: uniform distributions of the parameters.
        seed: of the evaluation, apart from every seed of a training.
        count: how many.
    """
    seeds = [np.random.SeedSequence(seed, spawn_key=(STREAM, i)) for i in range(count)]
    return [
        Draw(s, BrakeParameters(*np.random.default_rng(s).uniform(ranges.low, ranges.high).tolist())) for s in seeds
    ]


@dataclass(frozen=True, eq=False)
class Outcome:
    """Final results of N experiments. One that leaves the limits is stopped there, as on the bench."""

    matrices: Floats
    """Fisher information without a prior, relative to the true parameters, shape [N, n, n]. Of an experiment that left
    the limits: that before it left them."""
    left: Bools
    """Mask of the experiments that left the limits, shape [N]."""
    home: Bools
    """Mask of the experiments that ended at home without having left the limits, shape [N]."""
    angle: Floats
    """At the end [rad], shape [N]."""
    velocity: Floats
    """At the end [rad/s], shape [N]."""


def play(
    bench: Bench,
    ranges: Ranges,
    parameters: Sequence[str],
    excitation: Excitation,
    draws: Sequence[Draw],
    plant: str = DEFAULT_PLANT,
    conditions: Conditions = BENCH_CONDITIONS,
) -> Outcome:
    """Play one excitation, through the shield unless the conditions have none.

    Args:
        bench: limits, noise, timing, shield.
        ranges: where the brakes lie.
        parameters: whose information is collected, in the order of ``PARAMETER_NAMES``.
        excitation: the source of current requests.
        draws: brakes and noise.
        plant: which of the bench's plants the brakes are.
        conditions: which information is collected; shield or none.

    Raises:
        PolicyRefusedError: the excitation requests no finite current, where the runtime stops.
        UsageError, BenchFileError: see :class:`emb_train.envs.batch.Batch`.
    """
    parts = [
        _side_by_side(bench, ranges, parameters, excitation, draws[i : i + SIDE_BY_SIDE], plant, conditions)
        for i in range(0, len(draws), SIDE_BY_SIDE)
    ]
    return Outcome(*(np.concatenate([getattr(p, f) for p in parts]) for f in Outcome.__dataclass_fields__))


def begin_all(batch: Batch, draws: Sequence[Draw]) -> None:
    """Begin the experiments of a batch, one for each draw."""
    for i, draw in enumerate(draws):
        batch.begin(i, np.random.default_rng(draw.seed), draw.brake)


def followed(batch: Batch, excitation: Excitation) -> Iterator[Seen]:
    """Let the experiments of a batch that have begun follow an excitation to the horizon.

    Yields:
        After each step, the excitation's observation before it, see :meth:`emb_train.envs.batch.Batch.seen`.

    Raises:
        PolicyRefusedError: it requests no finite current, where the runtime stops.
    """
    excitation.begin(len(batch.k))
    left = np.zeros(len(batch.k), np.bool_)
    for k in range(batch.setup.rules.horizon):
        seen = batch.seen()
        wanted = excitation(seen)
        if not np.isfinite(wanted[~left & batch.heard]).all():
            raise PolicyRefusedError(
                f"expected finite currents, got another at step {k}, not finite: this actor cannot be played"
            )
        batch.advance(wanted)
        left |= batch.violated
        yield seen


def _side_by_side(
    bench: Bench,
    ranges: Ranges,
    parameters: Sequence[str],
    excitation: Excitation,
    draws: Sequence[Draw],
    plant: str,
    conditions: Conditions,
) -> Outcome:
    batch = Batch(bench, ranges, parameters, len(draws), compiled, plant, conditions)
    begin_all(batch, draws)
    m, end, left = batch.m.copy(), batch.x[:, :2].copy(), np.zeros(len(draws), np.bool_)
    for _ in followed(batch, excitation):
        end = np.where(left[:, None], end, batch.x[:, :2])
        left |= batch.violated
        m = np.where(left[:, None], m, batch.m)
    return Outcome(unpack(m, len(parameters)), left, batch.home & ~left, end[:, 0], end[:, 1])


class Beside:
    """An excitation that is played while another one is called with the same observations.

    Attributes:
        apart: the largest difference of their answers so far [A]; NaN once one of them was none.
    """

    def __init__(self, played: Excitation, asked: Excitation) -> None:
        """Play the first, call both."""
        self._played, self._asked = played, asked
        self.apart = 0.0

    def begin(self, count: int) -> None:
        """Both begin."""
        self._played.begin(count)
        self._asked.begin(count)

    def __call__(self, seen: Seen) -> Floats:
        """See :class:`emb_train.envs.excitations.Excitation`."""
        wanted, other = self._played(seen), self._asked(seen)
        heard = ~np.isnan(seen[:, ANGLE])
        self.apart = float(np.maximum(self.apart, np.abs(wanted - other)[heard].max(initial=0.0)))
        return wanted


class Together:
    """Several excitations as one: each has an equal share of the experiments, the first ones the first."""

    def __init__(self, excitations: Sequence[Excitation]) -> None:
        """Of these."""
        self._excitations = excitations

    def begin(self, count: int) -> None:
        """Each begins with its share of a multiple of their number."""
        for excitation in self._excitations:
            excitation.begin(count // len(self._excitations))

    def __call__(self, seen: Seen) -> Floats:
        """See :class:`emb_train.envs.excitations.Excitation`."""
        shares = np.split(seen, len(self._excitations))
        return np.concatenate([e(share) for e, share in zip(self._excitations, shares, strict=True)])
