"""Conditions of an experiment in training: shield or none, horizon, observation, kind of information.

The defaults are those of a bench that runs a deployed actor. The thesis trains under others (sections 4.6, 5.2, 6.2):
no shield, an action is clipped to ±6 A, and leaving the limits ends the experiment.

An actor that was trained on the nominal bench alone has never met a late, lossy or badly homed one:
:class:`Randomisation` lets every experiment of a training have its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from emb_bench.information.fisher import Kind
from emb_bench.information.symmetric import Floats, packed_size
from emb_runtime.config.bench import OLDEST_FRAME, Bench
from emb_runtime.config.plants import Instruments, Mechanics
from emb_runtime.errors import UsageError

MEASURED: Literal["measured"] = "measured"
EVERYTHING: Literal["everything"] = "everything"

_LOWEST = {"encoder_offset": -10.0}
_GREATEST = {"frame_loss": 0.5, "current_lag": 0.1, "encoder_offset": 10.0}
"""Limits of the values, those of the bench file for a plant; of the frames, at most half may be lost."""


class Randomisation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Ranges of what an experiment has of its own beside its brake: (least, most), drawn uniformly at its start.

    It comes on top of what the plant has of the same kind. The shield is widened to cover delay or lag, one at a time
    (see :meth:`Conditions.applied`), and plans for lost frames anyway. It does not cover their sum with a plant's,
    which is refused where there is a shield (see :func:`emb_train.envs.batch.require_possible`), nor an offset: the
    limits are then kept for the angle that is measured.
    """

    command_delay: tuple[int, int] = (0, 0)  # Samples that a command waits before it acts
    measurement_delay: tuple[int, int] = (0, 0)  # Samples that a measurement waits before it is sent
    frame_loss: tuple[float, float] = (0.0, 0.0)
    """Probability with which a sample does not arrive: then nothing is sent, and the node brakes. The first one of an
    experiment always arrives, for that begins it, and never as many in a row are lost as end a run."""
    current_lag: tuple[float, float] = (0.0, 0.0)
    """Time constant of the current loop [s]; for plants with the solver ``exact``."""
    encoder_offset: tuple[float, float] = (0.0, 0.0)  # Reading of the encoder at the true origin [rad]

    def __post_init__(self) -> None:
        """Refuse what does not exist.

        Raises:
            UsageError: a range is not (least, most) within what an experiment may have.
        """
        for name, (least, most) in msgspec.structs.asdict(self).items():
            lowest, greatest = _LOWEST.get(name, 0), _GREATEST.get(name, OLDEST_FRAME)
            if not lowest <= least <= most <= greatest:  # written so that NaN fails
                raise UsageError(
                    f"{name}: expected least and most, from {lowest:g} to {greatest:g}, got {least:g}, {most:g}"
                )

    @property
    def delay(self) -> tuple[int, int]:
        """Least and most samples that command and measurement wait together."""
        return self.command_delay[0] + self.measurement_delay[0], self.command_delay[1] + self.measurement_delay[1]


NOTHING_RANDOM = Randomisation()


def parse_randomisation(texts: Sequence[str]) -> Randomisation:
    """Randomisation given on a command line, each text like ``command_delay=0,2``.

    Raises:
        UsageError: there is nothing of that name, it comes twice, or it is not two numbers in their range.
    """
    given: dict[str, Any] = {}
    for text in texts:
        name, _, pair = text.partition("=")
        if name not in OWN or name in given:
            raise UsageError(f"expected NAME=LEAST,MOST with each of {', '.join(OWN)} at most once, got '{text}'")
        given[name] = pair.split(",")
    try:
        return msgspec.convert(given, Randomisation, strict=False)  # a word becomes the number that it says
    except msgspec.ValidationError as err:
        raise UsageError(f"expected two numbers, LEAST,MOST: {err}") from err


class Conditions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Conditions in which an experiment of the training may differ from one on the bench."""

    shielded: bool = True  # True if the shield is between actor and brake; without it an action is clipped, no more
    shield_ranges: str | None = None
    """The set of the bench that the shield holds the limits for; None for the one that the bench names."""
    horizon: int = 0  # Steps in one experiment; 0 for the bench's
    observes: Literal["measured", "everything"] = MEASURED
    """Observation of the actor: ``measured`` angle, velocity and step, or ``everything`` (x₁, x₂, k, θ, the FIM)."""
    information: Kind = "weighted"  # Fisher information that is collected: the thesis's, or the physical one
    randomised: Randomisation = NOTHING_RANDOM  # Ranges of what an experiment has of its own beside its brake

    def __post_init__(self) -> None:
        """Refuse what does not exist.

        Raises:
            UsageError: a name or the horizon is out of its range, or no shield covers what is randomised.
        """
        if self.shielded and self.randomised.delay[1] > OLDEST_FRAME:
            raise UsageError(
                f"a shield covers {OLDEST_FRAME} samples of delay, got {self.randomised.delay[1]} at most; narrow "
                "command_delay or measurement_delay"
            )
        if self.shielded and self.randomised.delay[1] > 0 and self.randomised.current_lag[1] > 0.0:
            raise UsageError("current_lag: a shield covers a lag or a delay, one at a time; randomise one of them")
        if self.horizon < 0:
            raise UsageError(f"horizon: expected steps, or 0 for the bench's, got {self.horizon}")
        if self.horizon and self.shielded:
            raise UsageError("horizon: the shield plans for the bench's; only an experiment without it has another")

    def observation_size(self, count: int) -> int:
        """Length of the actor's observation if the information of this many parameters is collected."""
        return 3 if self.observes == MEASURED else 3 + count + packed_size(count)

    def applied(self, bench: Bench) -> Bench:
        """The bench with this horizon, and a shield for this set of brakes that covers what is randomised as well.

        It covers what the bench's shield covers or what is randomised, not the sum of both: right for a plant without a
        delay and a lag of its own of the randomised kind.
        """
        timing = replace(bench.timing, horizon=self.horizon or bench.timing.horizon)
        shield = bench.shield._replace(ranges=self.shield_ranges or bench.shield.ranges)
        if self.shielded and self.randomised != NOTHING_RANDOM:
            least, most = self.randomised.delay
            age = min(shield.frame_age[0], least), max(shield.frame_age[1], most)
            lag = max(shield.current_lag, self.randomised.current_lag[1])
            shield = shield._replace(frame_age=age, current_lag=lag)
        return replace(bench, timing=timing, shield=shield)


BENCH_CONDITIONS = Conditions()


Bools = NDArray[np.bool_]

OWN = Randomisation.__struct_fields__  # Names of the columns of an experiment's own row
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
        m.break_away,
        m.stribeck_velocity,
        m.stribeck_exponent,
        m.f_l,
        m.quadratic,
        m.cubic,
        m.hysteresis,
        m.hysteresis_travel,
        m.current_lag + float(own[i, CURRENT_LAG]),
        m.coulomb_asymmetry,
        m.viscous_asymmetry,
        m.play,
    )
