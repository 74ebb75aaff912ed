"""Play an excitation on given brakes with given noise, through the environment that actors are trained in.

The brakes are drawn, or lie on the fixed grid of the thesis. All excitations go through the same shield, so that its
share of the result is visible.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeVar

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.information.symmetric import Floats, unpack
from emb_runtime.config.bench import BrakeParameters, Ranges
from emb_runtime.errors import PolicyRefusedError
from emb_train.envs.batch import Batch
from emb_train.envs.conditions import BENCH_CONDITIONS, Bools, Conditions
from emb_train.envs.excitations import Excitation, Seen

Played = TypeVar("Played", bound="Outcome")

STREAM = 0x65766C
"""Spawn key of the evaluation's random numbers: training has none, and its validations have another one."""


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
    batch = Batch(bench, ranges, parameters, len(draws), plant, conditions)
    begin_all(batch, draws)
    m, end, left = batch.m.copy(), batch.x[:, :2].copy(), np.zeros(len(draws), np.bool_)
    for _ in followed(batch, excitation):
        end = np.where(left[:, None], end, batch.x[:, :2])
        left |= batch.violated
        m = np.where(left[:, None], m, batch.m)
    return Outcome(unpack(m, len(parameters)), left, batch.home & ~left, end[:, 0], end[:, 1])


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


GRID = 40  # Brakes on the grid, as in the thesis (5.2.3)


def grid_draws(ranges: Ranges, parameter: str, seed: int) -> list[Draw]:
    """Brakes with ``parameter`` equally spaced over its range, both ends included; the others at mid-range.

    Brake i has noise from ``seed + i``.
    """
    values = np.linspace(getattr(ranges.low, parameter), getattr(ranges.high, parameter), GRID)
    return [Draw(seed + i, middle_of(ranges)._replace(**{parameter: float(v)})) for i, v in enumerate(values)]


def middle_of(ranges: Ranges) -> BrakeParameters:
    """The brake in the middle of the ranges."""
    return BrakeParameters(*(0.5 * (a + b) for a, b in zip(ranges.low, ranges.high, strict=True)))
