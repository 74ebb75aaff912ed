"""Values that an experiment has of its own beside its brake: drawn at its start, on top of what its plant has."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import Bench
from emb_runtime.config.plants import Instruments, Mechanics
from emb_train.envs.conditions import Randomisation

Bools = NDArray[np.bool_]

OWN = tuple(f.name for f in fields(Randomisation))
"""Names of the columns of an experiment's own row."""
COMMAND_DELAY, MEASUREMENT_DELAY, FRAME_LOSS, CURRENT_LAG, ENCODER_OFFSET = range(len(OWN))
WHOLE = np.array([COMMAND_DELAY, MEASUREMENT_DELAY])

SHORTEST_LAG = 1e-5
"""A drawn lag below it is none, as in a bench file [s]: what happens within it takes more steps than it is worth."""


def longest_loss(bench: Bench) -> int:
    """Samples in a row that may be lost without an end of the run: neither the node nor the loop gives up [samples]."""
    node = math.ceil(bench.node.watchdog / bench.timing.sample_time - 1e-9)
    return max(min(node, bench.watch.stop_missed) - 1, 0)


def drawn(randomised: Randomisation, rng: np.random.Generator, samples: int, longest: int) -> tuple[Floats, Bools]:
    """Draws the values that one experiment has of its own.

    Args:
        randomised: from which it is drawn.
        rng: draws the same number of times, whatever is randomised.
        samples: of the experiment, the first and the last included.
        longest: as many samples in a row may be lost, see :func:`longest_loss`.

    Returns:
        Its own row, columns as in ``OWN``, and which samples do not arrive, shape [samples].
    """
    least, most = np.array([getattr(randomised, name) for name in OWN], np.float64).T
    share, chance = rng.random(len(OWN)), rng.random(samples)
    own = least + share * (most - least)
    own[WHOLE] = np.minimum(np.floor(least + share * (most - least + 1.0)), most)[WHOLE]
    if own[CURRENT_LAG] < SHORTEST_LAG:
        own[CURRENT_LAG] = 0.0
    lost = chance < own[FRAME_LOSS]
    lost[[0, -1]] = False  # the first begins the experiment, the last only ends it
    sample = np.arange(samples)
    in_a_row = sample - np.maximum.accumulate(np.where(lost, 0, sample))
    lost &= in_a_row % (longest + 1) != 0
    return own, lost


def instruments_of(instruments: Instruments, own: Floats, i: int) -> Instruments:
    """The plant's instruments with the delays and the offset of experiment ``i``, whose own row is in ``own``."""
    return Instruments(
        instruments.command_delay + int(own[i, COMMAND_DELAY]),
        instruments.measurement_delay + int(own[i, MEASUREMENT_DELAY]),
        instruments.encoder_offset + float(own[i, ENCODER_OFFSET]),
        instruments.clock_jitter,
        instruments.observer_bandwidth,
    )


def mechanics_of(m: Mechanics, own: Floats, i: int) -> Mechanics:
    """The plant's mechanics with the lag of the current of experiment ``i``."""
    return Mechanics(
        m.solver,
        m.karnopp_velocity,
        m.break_away,
        m.stribeck_velocity,
        m.stribeck_exponent,
        m.f_l,
        m.quadratic,
        m.cubic,
        m.hysteresis,
        m.hysteresis_travel,
        m.current_lag + float(own[i, CURRENT_LAG]),
    )
