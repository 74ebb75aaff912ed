"""Play an excitation on given brakes with given noise, through the environment that actors are trained in.

The brakes are drawn, or lie on the fixed grid of the thesis, there beside baselines without learning. All go through
the same shield, so that its share of the result is visible.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeVar

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.information.symmetric import Floats, unpack
from emb_runtime.config.bench import Bench, BrakeParameters, Ranges
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.errors import PolicyRefusedError
from emb_train.envs.batch import Batch
from emb_train.envs.conditions import BENCH_CONDITIONS, Bools, Conditions
from emb_train.envs.excitations import ANGLE, Constant, Excitation, Seen, switch

Played = TypeVar("Played", bound="Outcome")

STREAM = 0x65766C
"""Spawn key of the evaluation's random numbers: training has none, and its validations have another one."""
SIDE_BY_SIDE = 1024  # Experiments at a time: what bounds the memory


class Draw(NamedTuple):
    """One brake and the noise that is measured on it."""

    seed: int | np.random.SeedSequence  # Of the noise
    brake: BrakeParameters


def fresh_draws(ranges: Ranges, seed: int, count: int) -> list[Draw]:
    """Brakes drawn from ranges, and their noise; draw i depends on ``seed`` and i alone."""
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
    left: Bools  # Mask of the experiments that left the limits, shape [N]
    home: Bools  # Mask of the experiments that ended at home without having left the limits, shape [N]
    angle: Floats  # At the end [rad], shape [N]
    velocity: Floats  # At the end [rad/s], shape [N]


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

    Raises:
        PolicyRefusedError: the excitation requests no finite current, where the runtime stops.
        UsageError, BenchFileError: see :class:`emb_train.envs.batch.Batch`.
    """
    parts = [
        _side_by_side(bench, ranges, parameters, excitation, draws[i : i + SIDE_BY_SIDE], plant, conditions)
        for i in range(0, len(draws), SIDE_BY_SIDE)
    ]
    return joined(parts)


def joined(parts: Sequence[Played]) -> Played:
    """Results of all experiments of these parts, in their order."""
    kind = type(parts[0])
    return kind(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(kind)))


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


GRID = 40  # Brakes on the grid, as in the thesis (5.2.3)
TOGETHER = SIDE_BY_SIDE // GRID  # Excitations that are played at a time


@dataclass(frozen=True)
class GridResult:
    """Result of an excitation on the grid."""

    name: str
    fim: Floats  # Weighted Fisher information at the end, normalised by the true value, shape [GRID]
    violations: int  # Experiments that left the limits
    home: int  # Experiments that ended at home

    @property
    def mean(self) -> float:
        """Mean weighted Fisher information over the grid."""
        return float(self.fim.mean())


def grid_of(ranges: Ranges, parameter: str) -> list[BrakeParameters]:
    """Brakes with ``parameter`` equally spaced over its range, both ends included; the others at mid-range."""
    values = np.linspace(getattr(ranges.low, parameter), getattr(ranges.high, parameter), GRID)
    return [middle_of(ranges)._replace(**{parameter: float(v)}) for v in values]


def middle_of(ranges: Ranges) -> BrakeParameters:
    """The brake in the middle of the ranges."""
    return BrakeParameters(*(0.5 * (a + b) for a, b in zip(ranges.low, ranges.high, strict=True)))


def grid_draws(ranges: Ranges, parameter: str, seed: int) -> list[Draw]:
    """The grid with noise: brake i has ``seed + i``, as in the vector environment."""
    return [Draw(seed + i, brake) for i, brake in enumerate(grid_of(ranges, parameter))]


def run_grid(
    bench: Bench,
    ranges: Ranges,
    parameter: str,
    excitations: Sequence[Excitation],
    seed: int,
    plant: str = DEFAULT_PLANT,
) -> list[GridResult]:
    """Run excitations on the grid, all with the same noise.

    Returns:
        One result for each excitation, without a name. An experiment that leaves the limits keeps the information that
        it had then.
    """
    draws, results = grid_draws(ranges, parameter, seed), []
    for i in range(0, len(excitations), TOGETHER):
        some = excitations[i : i + TOGETHER]
        played = play(bench, ranges, (parameter,), Together(some), draws * len(some), plant)
        rows = (a.reshape(len(some), GRID) for a in (played.matrices, played.left, played.home))
        results += [GridResult("", m, int(left.sum()), int(home.sum())) for m, left, home in zip(*rows, strict=True)]
    return results


def reference_ladder(
    bench: Bench, ranges: Ranges, parameter: str, seed: int, plant: str = DEFAULT_PLANT
) -> list[GridResult]:
    """Baselines without learning: constant current of either sign, and the best single switch found on this grid."""
    limit, horizon = bench.limits.current, bench.timing.horizon
    times = range(max(1, horizon // 100), horizon, max(1, horizon // 100))
    ladder: list[tuple[str, Excitation]] = [(f"constant {u:+g} A", Constant(u)) for u in (limit, -limit)]
    ladder += [(f"{u:+g} A, from step {t} {-u:+g} A", switch(u, t, horizon)) for u in (limit, -limit) for t in times]
    results = run_grid(bench, ranges, parameter, [e for _, e in ladder], seed, plant)
    named = [GridResult(n, r.fim, r.violations, r.home) for (n, _), r in zip(ladder, results, strict=True)]
    best = max(named[2:], key=lambda r: r.mean)
    return [*named[:2], GridResult(f"best blind switch: {best.name}", best.fim, best.violations, best.home)]
